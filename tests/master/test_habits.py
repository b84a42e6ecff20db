"""Tests of what is believed of a hand: natural or free by evidence, couplings that can be switched, its orientation."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.arrays import Float
from common.calibration import Couplings
from common.geometry import rotation_vector_to_matrix
from common.hand_model import HandModel
from common.hand_presets import preset_limits
from master.ik.hand import HandSolution, HandSolver
from master.ik.palm import Orientation
from master.ik.priors import Priors
from tests.hand_helpers import FACING, MARKERS, RIGHT, natural_angles, palm, small_cov

SOLVER = HandSolver(RIGHT, MARKERS)
NATURAL_ONLY = HandSolver(RIGHT, MARKERS, replace(Priors(), free=None))
SIGMA_M = 1e-3
COV = np.repeat(SIGMA_M**2 * np.eye(3)[None], 6, axis=0)
seeds = st.integers(0, 2**32 - 1)


def independent_angles(rng: np.random.Generator) -> Float:
    """Legal angles whose joints know nothing of each other, but that the DIP follows."""
    angles = rng.uniform(RIGHT.limits_rad[..., 0], RIGHT.limits_rad[..., 1])
    angles[1:, 3] = angles[1:, 2] * 2 / 3
    return RIGHT.clamp(angles)


def with_couplings(**keys: object) -> HandModel:
    couplings = msgspec.structs.replace(Couplings(), **keys)
    return HandModel.of(msgspec.structs.replace(RIGHT.profile, couplings=couplings))


def solved(
    solver: HandSolver, T: Float, angles: Float, noise: Float, orientation: Orientation | None = None
) -> HandSolution:
    points = RIGHT.marker_points(RIGHT.forward(T, angles), MARKERS) + noise
    found = solver.solve(points, COV, orientation=orientation)
    assert found is not None
    return found


def pip_deg(found: HandSolution, truth: Float) -> float:
    return float(np.degrees(np.abs(found.angles_rad[1:, 2] - truth[1:, 2])).mean())


def palm_deg(found: HandSolution, T: Float) -> float:
    return float(np.degrees(np.linalg.norm(found.T_rig_palm[:3, :3] - T[:3, :3]) / np.sqrt(2)))


# -- natural or free --------------------------------------------------------------------------------------------


def test_markers_tell_a_free_hand_from_a_natural_one() -> None:
    rng = np.random.default_rng(5)
    free, natural = list[float](), list[float]()
    for _ in range(40):
        T = palm(rng.uniform(-45, 45, 3))
        noise = rng.normal(0.0, SIGMA_M, (6, 3))
        free.append(solved(SOLVER, T, independent_angles(rng), noise).natural)
        natural.append(solved(SOLVER, T, natural_angles(rng), noise).natural)
    assert np.mean(free) < 0.35
    assert np.mean(natural) > 0.8


def test_free_hands_are_solved_better_and_natural_ones_no_worse() -> None:
    rng = np.random.default_rng(6)
    gained: list[tuple[float, float]] = []
    for _ in range(40):
        T = palm(rng.uniform(-45, 45, 3))
        noise = rng.normal(0.0, SIGMA_M, (6, 3))
        both = [
            pip_deg(solved(NATURAL_ONLY, T, truth, noise), truth)
            - pip_deg(solved(SOLVER, T, truth, noise), truth)
            for truth in (independent_angles(rng), natural_angles(rng))
        ]
        gained.append((both[0], both[1]))
    free, natural = np.mean(gained, axis=0)
    assert free > 1.5
    assert natural > -0.6


def test_without_the_free_hypothesis_every_hand_is_natural() -> None:
    rng = np.random.default_rng(7)
    assert solved(NATURAL_ONLY, palm(), independent_angles(rng), np.zeros((6, 3))).natural == 1.0


@given(seeds)
@settings(max_examples=30)
def test_a_mean_of_two_hands_explains_the_markers_as_well_as_each(seed: int) -> None:
    """Fingers move on arcs: what lies between two hands that fit would be off by millimetres."""
    rng = np.random.default_rng(seed)
    found = solved(
        SOLVER, palm(rng.uniform(-45, 45, 3)), natural_angles(rng), rng.normal(0.0, SIGMA_M, (6, 3))
    )
    assert found.residual_m.max() < 5.0 * SIGMA_M


# -- couplings --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("spread_deg", "free"), [(0.0, False), (5.0, False), (0.0, True)])
def test_the_dip_follows_exactly_loosely_or_not_at_all(spread_deg: float, free: bool) -> None:
    """A finger tip 8 degrees off the ratio, on a palm whose orientation is known, so that it can be told."""
    keys: dict[str, object] = (
        {"dip_per_pip": None} if free else {"dip_spread_rad": float(np.radians(spread_deg))}
    )
    model = with_couplings(**keys)
    truth = np.zeros((5, 4))
    truth[1:, 1], truth[1:, 2], truth[1:, 3] = 0.4, 0.8, 0.8 * 2 / 3
    truth[2, 3] += np.radians(8.0)
    points = model.marker_points(model.forward(palm(), truth), MARKERS)
    sure = Orientation(palm()[:3, :3], 1e-6 * np.eye(3))
    found = HandSolver(model, MARKERS).solve(points, small_cov(), orientation=sure)
    assert found is not None
    strayed = np.degrees(found.angles_rad[1:, 3] - found.angles_rad[1:, 2] * 2 / 3)
    if spread_deg == 0.0 and not free:
        np.testing.assert_allclose(strayed, 0.0, atol=1e-9)
    else:
        assert strayed[1] > 0.1
        assert strayed[1] > np.abs(strayed[[0, 2, 3]]).max()


def test_neighbours_can_be_told_to_be_strangers() -> None:
    """The middle finger has no marker and nothing is said of it: it bends as its neighbours do, or not."""
    truth = np.zeros((5, 4))
    truth[1:, 1], truth[1:, 2], truth[1:, 3] = 0.9, 1.5, 1.0
    points = RIGHT.marker_points(RIGHT.forward(palm(), truth), MARKERS)
    points[2] = np.nan
    unknown = (np.zeros((5, 4)), np.full(5, np.inf))
    bent: list[float] = []
    for model in (RIGHT, with_couplings(neighbours=False)):
        solver = HandSolver(model, MARKERS, replace(Priors(), free=None))
        found = solver.solve(points, small_cov(), hidden=unknown, facing=FACING)
        assert found is not None
        bent.append(float(np.degrees(found.angles_rad[2, 2])))
    assert bent[0] > bent[1] + 15.0


def test_without_natural_flexion_the_mcp_is_told_by_the_markers_alone() -> None:
    """Flat in the MCP and bent in the PIP defies natural flexion; without it the fit is nearer."""
    truth = np.zeros((5, 4))
    truth[1:, 2], truth[1:, 3] = 1.2, 0.8
    error: list[float] = []
    for model in (RIGHT, with_couplings(mcp_per_pip=None)):
        solver = HandSolver(model, MARKERS, replace(Priors(), free=None))
        error.append(pip_deg(solved(solver, palm(), truth, np.zeros((6, 3))), truth))
    assert error[1] < error[0]


def test_a_hidden_finger_that_is_curled_does_not_bend_its_neighbour() -> None:
    """Index straight and shown, the others out of sight: a pointing hand."""
    truth = np.zeros((5, 4))
    truth[2:, 1], truth[2:, 2], truth[2:, 3] = 1.2, 1.6, 1.6 * 2 / 3
    points = RIGHT.marker_points(RIGHT.forward(palm(), truth), MARKERS)
    points[[0, 2, 3, 4]] = np.nan
    found = SOLVER.solve(points, small_cov(), facing=FACING)
    assert found is not None
    assert np.degrees(found.angles_rad[1, 2]) < 15.0
    assert (np.degrees(found.angles_rad[2:, 2]) > 60.0).all()


def test_a_hidden_finger_between_two_that_show_bends_as_they_do() -> None:
    truth = np.zeros((5, 4))
    truth[1:, 1], truth[1:, 2], truth[1:, 3] = 0.45, 0.6, 0.4
    points = RIGHT.marker_points(RIGHT.forward(palm(), truth), MARKERS)
    points[3] = np.nan
    found = SOLVER.solve(points, small_cov(), facing=FACING)
    assert found is not None
    assert np.degrees(abs(found.angles_rad[3, 2] - 0.6)) < 20.0


# -- limits -----------------------------------------------------------------------------------------------------


@given(seeds)
@settings(max_examples=60)
def test_abduction_narrows_with_flexion_in_every_solution(seed: int) -> None:
    limits = preset_limits("D")
    narrow = {
        f: msgspec.structs.replace(getattr(limits, f), spread_at_full_flexion=0.0)
        for f in ("index", "little")
    }
    model = HandModel.of(
        msgspec.structs.replace(RIGHT.profile, limits_rad=msgspec.structs.replace(limits, **narrow))
    )
    rng = np.random.default_rng(seed)
    points = RIGHT.marker_points(RIGHT.forward(palm(), independent_angles(rng)), MARKERS)
    found = HandSolver(model, MARKERS).solve(points + rng.normal(0.0, 5e-3, (6, 3)), COV)
    assert found is not None
    assert model.within_limits(found.angles_rad).all()
    low, high = model.abduction_limits_rad(found.angles_rad[:, 1])
    assert (found.angles_rad[:, 0] >= low - 1e-9).all()
    assert (found.angles_rad[:, 0] <= high + 1e-9).all()


# -- the palm's orientation by a sensor -------------------------------------------------------------------------


def test_a_measured_orientation_turns_the_palm() -> None:
    rng = np.random.default_rng(9)
    sigma = np.radians(2.0)
    alone, told = list[float](), list[float]()
    for _ in range(30):
        T, truth = palm(rng.uniform(-45, 45, 3)), independent_angles(rng)
        noise = rng.normal(0.0, SIGMA_M, (6, 3))
        seen = rotation_vector_to_matrix(rng.normal(0.0, sigma, 3)) @ T[:3, :3]
        alone.append(palm_deg(solved(SOLVER, T, truth, noise), T))
        told.append(palm_deg(solved(SOLVER, T, truth, noise, Orientation(seen, sigma**2 * np.eye(3))), T))
    assert np.mean(told) < 3.0
    assert np.mean(told) < 0.6 * np.mean(alone)


def test_an_axis_about_which_nothing_is_known_is_left_to_the_markers() -> None:
    """Heading 150 degrees off and claimed as unknown: the inclination is used, the heading is not believed."""
    up = np.array([0.0, -1.0, 0.0])
    rng = np.random.default_rng(10)
    sigma = np.radians(1.0)
    cov = sigma**2 * np.eye(3) + 100.0 * np.outer(up, up)
    alone, told = list[float](), list[float]()
    for _ in range(20):
        T, truth = palm(rng.uniform(-45, 45, 3)), independent_angles(rng)
        noise = rng.normal(0.0, SIGMA_M, (6, 3))
        turned = rotation_vector_to_matrix(np.radians(150.0) * up) @ T[:3, :3]
        alone.append(palm_deg(solved(SOLVER, T, truth, noise), T))
        told.append(palm_deg(solved(SOLVER, T, truth, noise, Orientation(turned, cov)), T))
    assert np.mean(told) < np.mean(alone)


def test_one_marker_is_enough_where_the_orientation_is_known() -> None:
    truth = np.zeros((5, 4))
    T = palm(np.array([20.0, -10.0, 30.0]))
    points = RIGHT.marker_points(RIGHT.forward(T, truth), MARKERS)
    points[:5] = np.nan
    assert SOLVER.solve(points, small_cov()) is None
    found = SOLVER.solve(points, small_cov(), orientation=Orientation(T[:3, :3], 1e-4 * np.eye(3)))
    assert found is not None
    assert palm_deg(found, T) < 1.0
    assert np.linalg.norm(found.joints.position_m[1] - T[:3, 3]) < 5e-3
    vague = Orientation(T[:3, :3], np.eye(3))
    assert SOLVER.solve(points, small_cov(), orientation=vague) is None
