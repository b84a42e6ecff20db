"""Our solvers and others on the same targets: all run, the known answers come out, and planted bad ones are seen."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from bench.hands import ik
from bench.hands.draws import (
    FACING_ROTATION,
    INSIDE_RAD,
    MARKERS,
    Angles,
    Noise,
    PaperFingers,
    PointHand,
    bench_model,
    draw,
    finger_solvers,
    seen,
    tips_in_palm,
)
from bench.hands.poses import SCENARIOS
from bench.report import Row
from common.arrays import Float
from common.geometry.transforms import rigid, rotation_vector_to_matrix
from common.hand.model import HandModel
from master.estimator.parameters import HandParameters
from master.estimator.priors import posture_prior_of
from master.estimator.settings import DEFAULT
from master.fabrik.linear_algebra import Vector

MODEL = bench_model()


def value(lines: list[Row], name: str) -> float:
    (found,) = [row.value for row in lines if row.name == name]
    return found


# -- fingers ----------------------------------------------------------------------------------------------------


def test_on_reachable_targets_ours_and_scipy_miss_none_and_the_papers_way_misses_many() -> None:
    lines = ik.rows(hands=80)
    for name in (ik.CLOSED, ik.WARM_STARTED, "scipy"):
        assert value(lines, f"{name}: missed by > 1 mm") == 0.0
    assert value(lines, f"{ik.CLOSED}: missed by > 1 um") == 0.0
    assert value(lines, f"{ik.WARM_STARTED}: missed by > 100 um") == 0.0
    found, _ = ik.timed(MODEL, ik.ways(MODEL)[ik.PAPER], draw(MODEL, 4, 12, coupling_off_rad=0.0))
    assert found.missed_percent > 10.0
    assert found.violations == 0
    assert all(row.value > 0.0 for row in lines if row.unit == "us")


def test_a_solver_that_leaves_the_limits_or_misses_is_seen() -> None:
    truth = draw(MODEL, 5, 10, coupling_off_rad=0.0)
    closed = ik.ways(MODEL)[ik.CLOSED]

    def bent_back(tips: Sequence[Vector]) -> Angles:
        angles = [list(finger) for finger in closed(tips)]
        angles[1][1] = -0.2
        return angles

    found, _ = ik.timed(MODEL, bent_back, truth)
    assert found.violations == 10
    assert found.worst_deg == pytest.approx(np.degrees(0.2))
    assert found.missed_percent == pytest.approx(20.0)  # the index of each hand


def test_the_papers_fingers_start_at_their_last_pose() -> None:
    truth = draw(MODEL, 6, 2, coupling_off_rad=0.0)
    first, second = (tips_in_palm(truth.T_rig_palm[k], truth.caps_m[k]) for k in range(2))
    warm, cold = PaperFingers(finger_solvers(MODEL)), PaperFingers(finger_solvers(MODEL))
    warm.push(first)
    assert not np.allclose(warm.push(second), cold.push(second))


# -- the whole hand ---------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class ScipyHand:
    """The residuals of the whole-hand fit of a natural hand: whitened caps, priors, limits. Numerical Jacobian.

    Attributes:
        model: The hand.
        parameters: Its free angles and their bounds.
        whiten: (M, 3, 3) inverse square roots of the caps' covariances [1/m].
        rows, mean: (n, n) and (n,): priors are the residuals rows @ (x - mean).
    """

    model: HandModel
    parameters: HandParameters
    whiten: Float
    rows: Float
    mean: Float

    @classmethod
    def of(cls, model: HandModel, noise: Noise) -> "ScipyHand":
        """Prepare for caps with this noise, and the default priors."""
        parameters = HandParameters.of(model)
        posture_prior = posture_prior_of(model, parameters).natural_component()
        normal, pull = posture_prior.normal[0], posture_prior.pull[0]
        cov = noise.cov_m2 + DEFAULT.bones_m**2 * np.eye(3)
        return cls(
            model,
            parameters,
            np.asarray(np.linalg.inv(np.linalg.cholesky(cov)), np.float64),
            np.asarray(np.linalg.cholesky(normal).T, np.float64),
            np.asarray(np.linalg.solve(normal, pull), np.float64),
        )

    def residuals(self, T_rig_palm: Float, x: Float, points_m: Float) -> Float:
        """Residuals [sigma] of a palm (4, 4) and free angles (n,) [rad]: caps (M, 3) [m], then priors."""
        joints = self.model.forward(T_rig_palm, self.parameters.angles(x))
        off = self.model.marker_points(joints, MARKERS) - points_m
        return np.concatenate([(self.whiten @ off[..., None]).ravel(), self.rows @ (x - self.mean)])

    def solve(self, points_m: Float, T_rig_palm: Float, angles_rad: Float) -> tuple[Float, Float]:
        """Return palm (4, 4) and angles (5, 4) [rad] for caps (M, 3) [m], from a palm and angles to start with."""
        R, low, high = T_rig_palm[:3, :3], self.parameters.low, self.parameters.high
        room = high - low > 2 * INSIDE_RAD
        angles = np.clip(np.zeros(len(low)), low, high)

        def hand(v: Float) -> tuple[Float, Float]:
            angles[room] = v[6:]
            return rigid(rotation_vector_to_matrix(v[:3]) @ R, v[3:6]), angles

        def residual(v: Float) -> Float:
            return self.residuals(*hand(v), points_m)

        inside = np.clip(self.parameters.of_angles(angles_rad), low + INSIDE_RAD, high - INSIDE_RAD)[room]
        start = np.concatenate([np.zeros(3), T_rig_palm[:3, 3], inside])
        anywhere = np.full(6, np.inf)
        bounds = np.concatenate([-anywhere, low[room]]), np.concatenate([anywhere, high[room]])
        end = np.asarray(least_squares(residual, start, bounds=bounds, x_scale="jac").x, np.float64)
        T, x = hand(end)
        return T, self.model.clamp(self.parameters.angles(x))


def test_scipy_finds_the_hand_when_the_posture_prior_is_the_truth_and_markers_are_exact() -> None:
    way = ScipyHand.of(MODEL, SCENARIOS["1 mm"].noise)
    angles = MODEL.clamp(way.parameters.angles(way.mean))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_vector_to_matrix(np.array([0.2, -0.1, 0.3])) @ FACING_ROTATION, 0.1
    caps = MODEL.marker_points(MODEL.forward(T, angles), MARKERS)
    start = T.copy()
    start[:3, :3] = FACING_ROTATION
    found, bent = way.solve(caps, start, np.zeros((5, 4)))
    np.testing.assert_allclose(found, T, atol=1e-4)
    np.testing.assert_allclose(np.degrees(bent), np.degrees(angles), atol=0.1)


@pytest.mark.parametrize("noise", [SCENARIOS[name].noise for name in ("1 mm", "depth 4.5 mm")], ids=str)
def test_the_estimator_ends_where_scipy_ends_on_the_same_residuals(noise: Noise) -> None:
    count = 20
    way = ScipyHand.of(MODEL, noise)
    exact = replace(DEFAULT, tolerance=1e-12, tolerance_share=0.0)  # to the end
    solver = PointHand(MODEL, MARKERS, continuous=False, natural=True, faces=False, settings=exact)
    truth = draw(MODEL, 21, count)
    points, _ = seen(truth, noise, 21)

    def cost(T: Float, angles: Float, k: int) -> float:
        return 0.5 * float(np.square(way.residuals(T, way.parameters.of_angles(angles), points[k])).sum())

    same = 0
    for k in range(count):
        found = solver.push(k, points[k], noise.cov_m2).solution
        assert found is not None
        ours = cost(found.T_rig_palm, found.angles_rad, k)
        theirs, bent = way.solve(points[k], found.T_rig_palm, found.angles_rad)
        assert ours == pytest.approx(cost(theirs, bent, k), rel=1e-6)
        off = MODEL.forward(theirs, bent).position_m - found.joints.position_m
        assert np.linalg.norm(off, axis=1).max() < 1e-5
        # From the truth there may be another minimum, either way; nearly always it is the same.
        elsewhere = cost(*way.solve(points[k], truth.T_rig_palm[k], truth.angles_rad[k]), k)
        same += ours == pytest.approx(elsewhere, rel=1e-6)
    assert same >= count - 1
