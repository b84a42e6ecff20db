"""The solution of an epoch against scipy on the same residuals, and against trying everything."""

import os
import subprocess
import sys
from inspect import isfunction
from pathlib import Path

import msgspec
import numpy as np
import pytest
from scipy.optimize import least_squares

from common.arrays import Float
from common.calibration import Couplings
from common.geometry.transforms import rigid, rotation_vector_to_matrix
from common.hand.model import HandModel
from master.estimator.epoch import Epoch, FittedHand
from master.estimator.estimator import Estimator
from master.estimator.priors import posture_prior_of
from master.estimator.settings import DEFAULT
from master.estimator.update import fit_epoch
from tests.hand_helpers import BACK_NORMAL, MARKERS, RIGHT, natural_angles, palm, small_cov
from tests.master.estimator.fitted import (
    FREE,
    PAIR,
    PARAMETERS,
    STEP_NS,
    bent,
    estimator,
    fit,
    forgetful,
    found,
    places,
    push,
    seen,
)

SIGMA_PX = 0.5
FINE = DEFAULT.changed("tolerance", 1e-12).changed("tolerance_share", 0.0)
MACHINE = forgetful(natural=True, settings=FINE)
POSTURE_PRIOR = posture_prior_of(RIGHT, PARAMETERS, FINE)


class Residuals:
    """Of a natural hand whose back faces the cameras: square roots of what the estimator sums up."""

    def __init__(self, near: Float) -> None:
        self.near, self.root = near, np.linalg.cholesky(POSTURE_PRIOR.normal[0])
        self.mean = np.linalg.solve(POSTURE_PRIOR.normal[0], POSTURE_PRIOR.pull[0])

    def hand(self, at: Float) -> tuple[Float, Float]:
        """Palm (4, 4) and free angles (n,) of a step from the palm where it begins, and angles."""
        R = rotation_vector_to_matrix(at[:3]) @ self.near[:3, :3]
        return rigid(R, self.near[:3, 3] + at[3:6]), at[6 : 6 + FREE]

    def prior_rows(self, T: Float, x: Float) -> Float:
        return np.append(self.root.T @ (x - self.mean), (T[:3, 1] - BACK_NORMAL) / FINE.back_normal_rad)

    def solve(self, start: Float, spare: int = 0) -> tuple[Float, Float, float]:
        """Palm, angles and cost of the least squares from free angles (n,); `spare`: unknowns without limits."""
        wide = np.full(6 + spare, 0.5)
        low = np.concatenate([-wide[:6], PARAMETERS.low - 1e-7, -wide[6:]])
        high = np.concatenate([wide[:6], PARAMETERS.high + 1e-7, wide[6:]])
        at = np.clip(np.concatenate([np.zeros(6), start, np.zeros(spare)]), low + 1e-9, high - 1e-9)
        scale = np.concatenate([np.full(3, 0.1), np.full(3, 0.01), np.full(FREE, 0.1), np.full(spare, 1e-3)])
        done = least_squares(
            self, at, bounds=(low, high), x_scale=scale, xtol=1e-14, ftol=1e-14, gtol=1e-12, max_nfev=400
        )
        return *self.hand(done.x), float(done.cost)

    def __call__(self, at: Float) -> Float:
        raise NotImplementedError


class OfPoints(Residuals):
    """And markers at places."""

    def __init__(self, near: Float, points: Float, cov: Float) -> None:
        super().__init__(near)
        self.points = points
        self.white = np.linalg.cholesky(np.linalg.inv(cov + FINE.bones_m**2 * np.eye(3)))

    def __call__(self, at: Float) -> Float:
        T, x = self.hand(at)
        off = places(T, PARAMETERS.angles(x)) - self.points
        return np.append(np.einsum("mij,mi->mj", self.white, off).ravel(), self.prior_rows(T, x))


class OfPixels(Residuals):
    """And markers in images, each with a shift of its own that is an unknown as well."""

    def __init__(self, near: Float, epoch: Epoch, sigma_px: float) -> None:
        super().__init__(near)
        assert epoch.uv is not None
        self.uv, self.sigma_px = epoch.uv, sigma_px

    def __call__(self, at: Float) -> Float:
        T, x = self.hand(at)
        joints, moved = RIGHT.forward(T, PARAMETERS.angles(x)), at[6 + FREE :].reshape(6, 3)
        points = RIGHT.marker_points(joints, MARKERS) + moved
        off = np.stack(
            [(camera.project(points) - uv) / self.sigma_px for camera, uv in zip(PAIR, self.uv, strict=True)]
        )
        own = moved / FINE.bones_m
        return np.concatenate([off[np.isfinite(off)], own.ravel(), self.prior_rows(T, x)])


def compare(hand: FittedHand, T: Float, x: Float, share: float) -> None:
    """To a share of what each unknown is sure of."""
    rotation = hand.T_rig_palm[:3, :3] @ T[:3, :3].T
    off = (
        np.array(
            [
                rotation[2, 1] - rotation[1, 2],
                rotation[0, 2] - rotation[2, 0],
                rotation[1, 0] - rotation[0, 1],
            ]
        )
        / 2.0
    )
    step = np.concatenate([off, hand.T_rig_palm[:3, 3] - T[:3, 3], hand.x - x])
    assert (np.abs(step) / np.sqrt(np.diag(hand.measurement_cov))).max() < share


@pytest.mark.parametrize("seed", range(3))
def test_points_are_fitted_as_scipy_fits_them(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T, angles = palm(rng.uniform(-25.0, 25.0, 3)), natural_angles(rng)
    points = places(T, angles) + rng.normal(0.0, 2e-3, (6, 3))
    hand = found(fit(points, small_cov(), by=MACHINE))
    near, x, cost = OfPoints(T, points, small_cov()).solve(PARAMETERS.of_angles(angles))
    compare(hand, near, x, 1e-3)
    assert 0.5 * hand.marker_chi2.sum() < cost


def pixels(seed: int) -> tuple[Float, Float, Epoch, FittedHand]:
    """Palm and angles of a natural hand, what two cameras see of it with 0.5 px of noise, and its fit."""
    rng = np.random.default_rng(seed)
    T, angles = palm(rng.uniform(-15.0, 15.0, 3)), natural_angles(rng)
    epoch = seen(T, angles).epoch(10**9, sigma_px=SIGMA_PX)
    assert epoch.uv is not None
    epoch.uv[:] += rng.normal(0.0, SIGMA_PX, epoch.uv.shape)
    return T, angles, epoch, found(MACHINE.push(epoch).solution)


@pytest.mark.parametrize("seed", range(3))
def test_pixels_are_fitted_as_scipy_fits_them_with_what_is_wrong_with_markers_as_unknowns(seed: int) -> None:
    """Not to the last digit: the shift of a marker is integrated out along straight lines."""
    _, _, epoch, hand = pixels(seed)
    near, x, _ = OfPixels(hand.T_rig_palm, epoch, SIGMA_PX).solve(hand.x, spare=18)
    compare(hand, near, x, 0.05)


@pytest.mark.parametrize("seed", range(4))
def test_a_first_frame_is_found_where_it_costs_least(seed: int) -> None:
    T, angles, epoch, hand = pixels(seed)
    _, _, least = OfPixels(T, epoch, SIGMA_PX).solve(PARAMETERS.of_angles(angles), spare=18)
    _, _, cost = OfPixels(hand.T_rig_palm, epoch, SIGMA_PX).solve(hand.x, spare=18)
    assert cost < least + 0.1


def test_no_other_bend_of_a_finger_costs_less() -> None:
    """Flexion and PIP of a finger, all that the limits allow in steps of a degree, the rest as it was found."""
    rng = np.random.default_rng(7)
    T, angles = palm(rng.uniform(-15.0, 15.0, 3)), natural_angles(rng)
    points = places(T, angles) + rng.normal(0.0, 2e-3, (6, 3))
    hand = found(fit(points, small_cov(), by=MACHINE))
    rows = OfPoints(hand.T_rig_palm, points, small_cov())
    columns = np.flatnonzero(np.isin(PARAMETERS.free, [4 * 2 + 1, 4 * 2 + 2]))

    def cost(x: Float) -> float:
        return 0.5 * float(np.sum(rows(np.concatenate([np.zeros(6), x])) ** 2))

    least, step = cost(hand.x), np.radians(1.0)
    grids = [np.arange(PARAMETERS.low[c], PARAMETERS.high[c], 3.0 * step) for c in columns]
    costs = np.empty([len(grid) for grid in grids])
    for i, flexion in enumerate(grids[0]):
        for j, pip in enumerate(grids[1]):
            x = hand.x.copy()
            x[columns] = flexion, pip
            costs[i, j] = cost(x)
    assert costs.min() >= least - 1e-6
    i, j = np.unravel_index(costs.argmin(), costs.shape)
    assert abs(grids[0][i] - hand.x[columns[0]]) < 6.0 * step
    assert abs(grids[1][j] - hand.x[columns[1]]) < 6.0 * step


def hands() -> dict[str, Float]:
    """What the estimator makes of two epochs, of pixels and of points; and of a hand whose DIPs are free."""
    rays, points, out = estimator(), estimator(natural=True), list[Float]()
    for k in range(2):
        T = palm(np.array([3.0 * k, -2.0 * k, k]))
        gone, cameras = ((2,), (0,)) if k else ((), None)  # then one camera, which lacks a marker
        epoch = seen(T, bent(k / 60.0)).epoch(k * STEP_NS, gone=gone, cameras=cameras)
        placed = push(points, k * STEP_NS, places(T, bent(k / 60.0)))
        for hand in (found(rays.push(epoch).solution), found(placed.solution)):
            out += [hand.T_rig_palm, hand.angles_rad, hand.cov_m2 * 1e3, np.array([hand.natural_weight])]
    return {"coupled": np.concatenate([one.ravel() for one in out]), "free": free_hand()}


def free_hand() -> Float:
    """Angles (5, 4) of a hand whose DIPs are free, before a rig of markers where Python is plain."""
    model = HandModel.of(msgspec.structs.replace(RIGHT.profile, couplings=Couplings(dip_per_pip=None)))
    points = places(palm(), natural_angles(np.random.default_rng(1)), model)
    if isfunction(fit_epoch):
        machine = Estimator(PAIR, model, MARKERS, MARKERS, continuous=False)
    else:
        machine = estimator(model, continuous=False)
    return found(fit(points, small_cov(), by=machine)).angles_rad


def test_plain_python_and_machine_code_give_the_same_hands(tmp_path: Path, root: Path) -> None:
    """And a hand of a rig of markers is that with a wrist device that sees nothing."""
    code = "import sys; import numpy as np; from tests.master.estimator import test_least_squares as own"
    code += "; assert own.isfunction(own.fit_epoch); np.savez(sys.argv[1], **own.hands())"
    settings = os.environ | {"NUMBA_DISABLE_JIT": "1", "PYTHONPATH": str(root)}
    file = tmp_path / "plain.npz"
    subprocess.run([sys.executable, "-c", code, str(file)], check=True, env=settings, cwd=root)
    assert not isfunction(fit_epoch)
    machine_code = hands()
    with np.load(file) as plain:
        for name, values in machine_code.items():
            np.testing.assert_allclose(plain[name], values, atol=1e-9, rtol=1e-9, err_msg=name)
    assert HandModel.of(RIGHT.profile).within_limits(machine_code["free"]).all()
