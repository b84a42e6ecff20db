"""Tests of the whole-hand fit: Jacobians, exact recovery, limits under any input, a palm that turns."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from common.arrays import Float
from common.calibration import Couplings
from common.errors import CalibrationError
from common.geometry import rigid, rotation_vector_to_matrix
from common.hand_model import CHAINS, TIPS, HandModel
from common.hand_presets import preset_couplings, preset_limits
from common.hand_profiles import generated_profile
from master.estimator.attached import Attached
from master.estimator.parameters import HandParameters
from master.ik.hand import HandSolution, HandSolver
from master.ik.hand_problem import HandProblem
from master.ik.palm import Facing, Orientation, PalmPrior
from master.ik.priors import AnglePrior, Priors
from tests.hand_helpers import (
    FACING,
    LEFT,
    MARKERS,
    RIGHT,
    any_rotation,
    natural_angles,
    palm,
    small_cov,
    within,
)

SOLVER = HandSolver(RIGHT, MARKERS)
seeds = st.integers(0, 2**32 - 1)


def made(side: str, preset: str, coupled: bool) -> HandModel:
    profile = generated_profile("made", side)
    limits = preset_limits("K" if preset == "K" else "D")
    couplings = preset_couplings("D") if coupled else Couplings(dip_per_pip=None)
    return HandModel.of(msgspec.structs.replace(profile, limits_rad=limits, couplings=couplings))


MODELS = {
    "right K": made("right", "K", True),
    "left D": made("left", "D", True),
    "free": made("right", "K", False),
}


def exact(model: HandModel, T: Float, angles: Float) -> Float:
    return model.marker_points(model.forward(T, angles), MARKERS)


def joint_mm(found: HandSolution, truth: Float) -> Float:
    return 1e3 * np.linalg.norm(found.joints.position_m - truth, axis=1)


# -- derivatives ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", MODELS)
@given(seeds)
@settings(max_examples=25)
def test_points_move_with_the_angles_as_the_jacobian_says(name: str, seed: int) -> None:
    model = MODELS[name]
    parameters = HandParameters.of(model)
    x = np.random.default_rng(seed).uniform(parameters.low, parameters.high)
    for points in (Attached.markers(model, parameters, MARKERS), Attached.joints(model, parameters)):

        def place(x: Float, points: Attached = points) -> Float:
            return points.place(model.chains(parameters.angles(x)))

        chains = model.chains(parameters.angles(x))
        J = points.jacobian(chains, points.place(chains), x)
        h = 1e-6
        for k in range(len(x)):
            e = h * np.eye(len(x))[k]
            np.testing.assert_allclose(J[:, :, k], (place(x + e) - place(x - e)) / (2 * h), atol=1e-8)


@pytest.mark.parametrize("name", MODELS)
@given(seeds)
@settings(max_examples=25)
def test_gradient_is_the_derivative_of_the_cost(name: str, seed: int) -> None:
    model, rng = MODELS[name], np.random.default_rng(seed)
    parameters = HandParameters.of(model)
    n = len(parameters.free)
    T = rigid(any_rotation(rng), rng.normal(0.0, 0.3, 3))
    x = rng.uniform(parameters.low, parameters.high)
    beliefs = AnglePrior.of(model, parameters, Priors()).and_single(rng.uniform(0, 9, n), rng.normal(size=n))
    problem = HandProblem(
        model,
        parameters,
        Attached.markers(model, parameters, MARKERS),
        exact(model, T, np.zeros((5, 4))) + rng.normal(0.0, 0.02, (6, 3)),
        rng.normal(0.0, 300.0, (6, 3, 3)),
        beliefs.of_hypothesis(seed % 2),
        # At the last pose itself the rotation vector is exact; away from it the sine stands for the angle.
        PalmPrior(rigid(T[:3, :3], T[:3, 3] + 0.01), np.repeat([20.0, 30.0], 3)),
        Facing(FACING, 2.0),
        Orientation(any_rotation(rng), np.diag(rng.uniform(0.01, 4.0, 3))),
    )

    def cost(step: Float) -> float:
        turned = rigid(rotation_vector_to_matrix(step[:3]) @ T[:3, :3], T[:3, 3] + step[3:6])
        return float(problem.linearise(turned, x + step[6:]).cost)

    here, h = problem.linearise(T, x), 1e-6
    numeric = np.array([(cost(h * e) - cost(-h * e)) / (2 * h) for e in np.eye(6 + n)])
    np.testing.assert_allclose(here.gradient, numeric, atol=1e-5 * max(1.0, np.abs(numeric).max()))
    assert np.linalg.eigvalsh(here.normal).min() > 0


# -- finding the hand -------------------------------------------------------------------------------------------


def believed(model: HandModel) -> tuple[Float, Priors]:
    """A pose that every prior expects, and the priors with a thumb that can be like that."""
    thumb = np.radians([8.0, 8.0, 12.0, 12.0])
    angles = np.zeros((5, 4))
    pip = Priors().pip_mean
    assert model.dip_per_pip is not None
    assert model.mcp_per_pip is not None
    angles[1:] = [0.0, model.mcp_per_pip * pip, pip, model.dip_per_pip * pip]
    angles[0] = thumb
    return angles, Priors(thumb_mean=(thumb[0], thumb[1], thumb[2], thumb[3]))


@pytest.mark.parametrize("model", [RIGHT, LEFT], ids=["right", "left"])
@given(seeds)
@settings(max_examples=30)
def test_a_hand_that_obeys_the_priors_is_found_exactly_in_any_orientation(
    model: HandModel, seed: int
) -> None:
    angles, priors = believed(model)
    rng = np.random.default_rng(seed)
    T = rigid(any_rotation(rng), rng.normal(0.0, 0.5, 3))
    found = HandSolver(model, MARKERS, priors).solve(exact(model, T, angles), small_cov())
    assert found is not None
    assert joint_mm(found, model.forward(T, angles).position_m).max() < 0.05
    np.testing.assert_allclose(np.degrees(found.angles_rad), np.degrees(angles), atol=0.1)
    assert found.cost < 1e-3
    assert found.residual_m.max() < 1e-4


def test_a_turned_palm_does_not_become_a_wrong_hand() -> None:
    """A palm taken for fixed costs about 15 mm mean joint error for +-20 deg, an estimated one 3-4 mm."""
    rng = np.random.default_rng(11)
    fixed = HandSolver(RIGHT, MARKERS, Priors(palm_walk_rad_s=1e-3, walk_rad_s=1e3))
    ours: list[float] = []
    theirs: list[float] = []
    turns: list[float] = []
    straight = SOLVER.solve(exact(RIGHT, palm(), np.zeros((5, 4))), small_cov(), None, 0.0, None, FACING)
    assert straight is not None
    believe_straight = replace(straight, T_rig_palm=palm())
    for _ in range(120):
        angles, turn = natural_angles(rng), rng.uniform(-20.0, 20.0, 3)
        T = palm(turn)
        truth = RIGHT.forward(T, angles).position_m
        points = exact(RIGHT, T, angles) + rng.normal(0.0, 1.0, (6, 3)) * [3e-4, 3e-4, 1e-3]
        found = SOLVER.solve(points, small_cov(), None, 0.0, None, FACING)
        assumed = fixed.solve(points, small_cov(), believe_straight, 1.0, None, FACING)
        assert found is not None
        assert assumed is not None
        ours.append(joint_mm(found, truth)[1:].mean())
        theirs.append(joint_mm(assumed, truth)[1:].mean())
        off = found.T_rig_palm[:3, :3] @ T[:3, :3].T
        turns.append(float(np.degrees(Rotation.from_matrix(off).magnitude())))
    assert np.mean(ours) < 6.0
    assert np.percentile(ours, 95) < 12.0
    assert np.mean(theirs) > 2.0 * np.mean(ours)
    assert np.median(turns) < 8.0


@pytest.mark.parametrize("gone", range(6))
def test_a_missing_marker_costs_its_own_finger_only(gone: int) -> None:
    angles, priors = believed(RIGHT)
    points = exact(RIGHT, palm(), angles)
    points[gone] = np.nan
    found = HandSolver(RIGHT, MARKERS, priors).solve(points, small_cov())
    assert found is not None
    assert np.isnan(found.residual_m[gone])
    assert np.isfinite(np.delete(found.residual_m, gone)).all()
    tips = joint_mm(found, RIGHT.forward(palm(), angles).position_m)[TIPS]
    assert tips[np.arange(5) != gone].max() < 6.0


def test_an_unseen_finger_is_believed_curled_and_not_flat() -> None:
    points = exact(RIGHT, palm(), np.zeros((5, 4)))
    points[2] = np.nan
    found = SOLVER.solve(points, small_cov(), None, 0.0, None, FACING)
    assert found is not None
    assert np.degrees(found.angles_rad[2, 2]) > 60.0


def test_a_belief_about_an_unseen_finger_is_taken() -> None:
    angles, _ = believed(RIGHT)
    points = exact(RIGHT, palm(), angles)
    points[2] = np.nan
    belief = angles.copy()
    belief[2] = np.radians([0.0, 30.0, 40.0, 40.0 * 2 / 3])
    found = SOLVER.solve(points, small_cov(), None, 0.0, (belief, np.full(5, np.radians(1.0))), FACING)
    assert found is not None
    np.testing.assert_allclose(np.degrees(found.angles_rad[2, 1:3]), [30.0, 40.0], atol=2.0)


# -- too little, too strange ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("keep", "facing", "enough"),
    [
        ((), None, False),
        ((5,), FACING, False),
        ((1, 5), None, False),
        ((1, 5), FACING, True),
        ((1, 2, 5), None, True),
        ((0, 1, 2, 3, 4, 5), None, True),
    ],
)
def test_fewer_than_needed_is_no_hand(keep: tuple[int, ...], facing: Float | None, enough: bool) -> None:
    points = np.full((6, 3), np.nan)
    points[list(keep)] = exact(RIGHT, palm(), natural_angles(np.random.default_rng(1)))[list(keep)]
    found = SOLVER.solve(points, small_cov(), None, 0.0, None, facing)
    assert (found is not None) is enough
    if found is not None:
        assert within(RIGHT, found.angles_rad)
        assert np.isfinite(found.cov_m2).all()


def test_markers_in_one_line_do_not_fix_a_hand() -> None:
    points = np.array([0.0, 0.1, 0.5]) + np.outer(np.linspace(0.0, 0.1, 6), [0.0, 0.0, 1.0])
    assert SOLVER.solve(points, small_cov()) is None
    # The line is the sight itself: which way the back of the hand looks does not turn the hand about it.
    assert SOLVER.solve(points, small_cov(), None, 0.0, None, FACING) is None
    across = points[:, [2, 1, 0]]
    assert SOLVER.solve(across, small_cov(), None, 0.0, None, FACING) is not None


def test_a_marker_without_a_covariance_is_not_seen() -> None:
    points = exact(RIGHT, palm(), natural_angles(np.random.default_rng(2)))
    cov = small_cov()
    cov[1, 0, 2] = np.nan
    with_nan = SOLVER.solve(points, cov, None, 0.0, None, FACING)
    points[1] = np.nan
    without = SOLVER.solve(points, small_cov(), None, 0.0, None, FACING)
    assert with_nan is not None
    assert without is not None
    np.testing.assert_array_equal(with_nan.angles_rad, without.angles_rad)
    cov[:] = np.nan
    assert SOLVER.solve(points, cov, None, 0.0, None, FACING) is None


absurd = st.one_of(
    st.floats(-1.0, 1.0), st.floats(-1e6, 1e6), st.sampled_from([0.0, -1e6, 1e6, 1e12, np.nan, np.inf])
)


@given(
    st.lists(absurd, min_size=18, max_size=18),
    st.lists(st.sampled_from([0.0, 1e-12, 1e-3, 1.0, 1e6, np.nan]), min_size=6, max_size=6),
    st.booleans(),
    st.sampled_from([None, 0.0, 0.016, 0.4]),
)
@settings(max_examples=150)
def test_whatever_is_seen_the_hand_stays_inside_its_limits(
    values: list[float], sigmas: list[float], face: bool, dt_s: float | None
) -> None:
    points = np.array(values).reshape(6, 3)
    cov = np.array(sigmas)[:, None, None] ** 2 * np.eye(3)
    last = None
    if dt_s is not None:
        last = SOLVER.solve(exact(RIGHT, palm(), natural_angles(np.random.default_rng(3))), small_cov())
    found = SOLVER.solve(points, cov, last, dt_s or 0.0, None, FACING if face else None)
    assert found is not None or dt_s is None
    if found is not None:
        assert within(RIGHT, found.angles_rad)
        assert np.isfinite(found.joints.position_m).all()
        identity = found.T_rig_palm[:3, :3] @ found.T_rig_palm[:3, :3].T
        np.testing.assert_allclose(identity, np.eye(3), atol=1e-9)


@pytest.mark.parametrize("name", MODELS)
@given(seeds)
@settings(max_examples=30)
def test_limits_hold_near_a_hand_too(name: str, seed: int) -> None:
    model, rng = MODELS[name], np.random.default_rng(seed)
    angles = rng.uniform(model.limits_rad[..., 0], model.limits_rad[..., 1])
    points = exact(model, palm(rng.uniform(-60, 60, 3)), angles) + rng.normal(0.0, 0.02, (6, 3))
    points[rng.random(6) < 0.2] = np.nan
    found = HandSolver(model, MARKERS).solve(points, small_cov())
    if found is not None:
        assert within(model, found.angles_rad)
        if model.dip_per_pip is not None:
            np.testing.assert_allclose(
                found.angles_rad[1:, 3], model.dip_per_pip * found.angles_rad[1:, 2], atol=1e-12
            )


def test_a_marker_the_profile_does_not_mount_is_refused() -> None:
    with pytest.raises(CalibrationError, match="'tail'"):
        HandSolver(RIGHT, ("index", "tail"))


# -- how sure -----------------------------------------------------------------------------------------------------


@given(seeds, st.floats(1.5, 10.0))
@settings(max_examples=30)
def test_covariance_is_one_and_grows_with_that_of_the_markers(seed: int, factor: float) -> None:
    rng = np.random.default_rng(seed)
    points = exact(RIGHT, palm(rng.uniform(-20, 20, 3)), natural_angles(rng))
    fine, coarse = (
        SOLVER.solve(points, small_cov(s), None, 0.0, None, FACING) for s in (1e-3, 1e-3 * factor)
    )
    assert fine is not None
    assert coarse is not None
    for cov in (fine.cov_m2, coarse.cov_m2):
        np.testing.assert_allclose(cov, np.swapaxes(cov, 1, 2), atol=1e-12)
        assert np.linalg.eigvalsh(cov).min() > -1e-15
    total = [np.trace(found.cov_m2[TIPS], axis1=1, axis2=2).sum() for found in (fine, coarse)]
    assert total[1] > total[0]


def test_an_unseen_tip_is_less_sure_than_a_seen_one() -> None:
    points = exact(RIGHT, palm(), believed(RIGHT)[0])
    both = SOLVER.solve(points, small_cov())
    points[3] = np.nan
    without = SOLVER.solve(points, small_cov())
    assert both is not None
    assert without is not None
    sigma = [np.sqrt(np.trace(found.cov_m2[TIPS[3]])) for found in (both, without)]
    assert sigma[0] < 3e-3
    assert sigma[1] > 10e-3


def test_the_error_is_as_large_as_the_covariance_says() -> None:
    """Squared joint errors over their variances average to about 1 for hands drawn near the priors."""
    rng = np.random.default_rng(4)
    ratio: list[float] = []
    for _ in range(60):
        angles, T = natural_angles(rng), palm(rng.uniform(-20.0, 20.0, 3))
        points = exact(RIGHT, T, angles) + rng.multivariate_normal(np.zeros(3), small_cov()[0], 6)
        found = SOLVER.solve(points, small_cov(), None, 0.0, None, FACING)
        assert found is not None
        error = found.joints.position_m - RIGHT.forward(T, angles).position_m
        variance = np.trace(found.cov_m2, axis1=1, axis2=2)
        ratio.append(float(np.mean((error**2).sum(axis=1) / variance)))
    assert 0.1 < np.mean(ratio) < 3.0


def test_the_tilt_of_a_finger_end_lies_across_it_and_grows_with_its_joints() -> None:
    angles = natural_angles(np.random.default_rng(3))
    found = SOLVER.solve(exact(RIGHT, palm(), angles), small_cov(), None, 0.0, None, FACING)
    assert found is not None
    ends, starts = CHAINS[:, 3], CHAINS[:, 2]
    along = found.joints.position_m[ends] - found.joints.position_m[starts]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    for f in range(5):
        cov = found.tilt_cov_rad2[f]
        assert abs(along[f] @ cov @ along[f]) < 1e-9 < np.trace(cov)
        assert np.degrees(np.sqrt(np.trace(cov))) < 40.0
    # a bending joint turns the end of its finger as fast as it bends itself: MCP, PIP and DIP = 2/3 PIP together
    walk = np.sqrt(np.linalg.eigvalsh(found.tilt_walk_rad2_s2)[1:, 2])
    p = SOLVER.priors
    np.testing.assert_allclose(
        walk, np.sqrt(p.palm_walk_rad_s**2 + p.walk_rad_s**2 * (1 + (1 + 2 / 3) ** 2)), rtol=0.02
    )


@pytest.mark.parametrize("turned_deg", [0.0, 20.0, 120.0, 180.0])
@given(seeds)
@settings(max_examples=8)
def test_where_a_search_begins_does_not_tell_where_it_ends(turned_deg: float, seed: int) -> None:
    """Nothing of a hand that may be near is believed: one that is not near leads to the same markers."""
    rng = np.random.default_rng(seed)
    T, cov = palm(), small_cov()
    points = exact(RIGHT, T, natural_angles(rng))
    turn = rotation_vector_to_matrix(np.radians(turned_deg) * np.array([0.6, 0.8, 0.0]))
    other = SOLVER.solve(exact(RIGHT, rigid(turn @ T[:3, :3], T[:3, 3] + 0.02), natural_angles(rng)), cov)
    assert other is not None
    found = SOLVER.solve(points, cov, facing=FACING, near=other)
    afresh = SOLVER.solve(points, cov, facing=FACING)
    assert found is not None
    assert afresh is not None
    assert found.cost < afresh.cost + 0.5
    assert found.residual_m.max() < afresh.residual_m.max() + 1e-3
