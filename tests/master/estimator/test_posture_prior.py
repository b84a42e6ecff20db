"""Tests of the priors of a hand: natural or free by evidence, couplings that can be switched, its orientation."""

from dataclasses import replace
from math import inf

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.arrays import Float
from common.calibration import Couplings
from common.geometry.transforms import rotation_vector_to_matrix
from common.hand.model import PALM, HandModel
from common.messages import Source
from master.estimator.epoch import FittedHand, OrientationMeasurement
from master.estimator.estimator import Estimator
from master.estimator.settings import DEFAULT
from tests.hand_helpers import RIGHT, natural_angles, palm, small_cov, walls
from tests.master.estimator.fitted import (
    STEP_NS,
    estimator,
    fit,
    forgetful,
    found,
    orientation_of,
    palm_deg,
    pip_deg,
    places,
    push,
    residual_m,
)

ANYWAY = replace(DEFAULT, back_normal_rad=inf)  # the back may look anywhere
SOLVER, NATURAL_ONLY = forgetful(settings=ANYWAY), forgetful(natural=True, settings=ANYWAY)
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
    machine: Estimator,
    T: Float,
    angles: Float,
    noise: Float,
    orientation: OrientationMeasurement | None = None,
) -> FittedHand:
    return found(fit(places(T, angles) + noise, COV, by=machine, orientation=orientation))


# -- natural or free --------------------------------------------------------------------------------------------


def test_markers_distinguish_a_free_hand_from_a_natural_one() -> None:
    rng = np.random.default_rng(5)
    free, natural = list[float](), list[float]()
    for _ in range(40):
        T = palm(rng.uniform(-45, 45, 3))
        noise = rng.normal(0.0, SIGMA_M, (6, 3))
        free.append(solved(SOLVER, T, independent_angles(rng), noise).natural_weight)
        natural.append(solved(SOLVER, T, natural_angles(rng), noise).natural_weight)
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
    assert solved(NATURAL_ONLY, palm(), independent_angles(rng), np.zeros((6, 3))).natural_weight == 1.0


@given(seeds)
@settings(max_examples=30)
def test_a_mean_of_two_hands_fits_the_markers_as_well_as_each(seed: int) -> None:
    """Fingers move on arcs: what lies between two hands that fit would be off by millimetres."""
    rng = np.random.default_rng(seed)
    T, angles, noise = palm(rng.uniform(-45, 45, 3)), natural_angles(rng), rng.normal(0.0, SIGMA_M, (6, 3))
    hand = solved(SOLVER, T, angles, noise)
    assert residual_m(hand, places(T, angles) + noise).max() < 5.0 * SIGMA_M


def test_the_evidence_of_frames_is_joined_in_time() -> None:
    """Whether a hand obeys the prior does not change from frame to frame: of noisy frames one alone is less sure."""
    rng, one_by_one, joined = np.random.default_rng(8), list[float](), list[float]()
    slow, machine = DEFAULT.changed("component_memory_s", 0.3), estimator()
    assert slow.component_memory_s == 0.3
    truth = natural_angles(rng)
    for k in range(60):
        points = places(palm(), truth) + rng.normal(0.0, 2.0 * SIGMA_M, (6, 3))
        hand, alone = found(push(machine, k * STEP_NS, points, COV).solution), found(fit(points, COV))
        joined.append(hand.natural_weight)
        one_by_one.append(alone.natural_weight)
    assert np.std(joined[20:]) < 0.5 * np.std(one_by_one[20:])
    assert np.mean(joined[20:]) > 0.8


def test_a_hand_that_leaves_the_posture_prior_gets_the_free_component_within_a_second() -> None:
    """A relaxed hand, then one that points with two fingers spread; and back."""
    rng, machine, natural = np.random.default_rng(9), estimator(), list[float]()
    unnatural = np.zeros((5, 4))
    unnatural[0] = np.radians([20.0, 20.0, 0.0, 40.0])
    unnatural[1:, 0] = np.radians([-18.0, 15.0, -15.0, 18.0])
    unnatural[1:, 1] = np.radians([0.0, 60.0, 0.0, 70.0])
    unnatural[[2, 4], 2:] = np.radians([20.0, 40.0 / 3])
    for k in range(240):
        truth = unnatural if 60 <= k < 150 else natural_angles(np.random.default_rng(3))
        points = places(palm(), truth) + rng.normal(0.0, 0.5 * SIGMA_M, (6, 3))
        natural.append(found(push(machine, k * STEP_NS, points, COV).solution).natural_weight)
    assert natural[59] > 0.8
    assert natural[120] < 0.2
    assert natural[239] > 0.8
    assert natural[61] > natural[75] > natural[120]  # by and by


def test_what_both_hypotheses_have_between_them_is_uncertainty_as_well() -> None:
    """Where neither is certain the covariance holds both; the hand lies between."""
    rng, shares = np.random.default_rng(12), list[float]()
    for _ in range(120):
        T, truth = palm(rng.uniform(-30, 30, 3)), independent_angles(rng)
        noise = rng.normal(0.0, SIGMA_M, (6, 3))
        both, natural = solved(SOLVER, T, truth, noise), solved(NATURAL_ONLY, T, truth, noise)
        shares.append(both.natural_weight)
        if not 0.2 < both.natural_weight < 0.8:
            continue
        off = natural.x - both.x
        spread = np.sqrt(np.diag(both.measurement_cov)[6:])
        assert (np.abs(off) < 5.0 * spread + 1e-6).all()
    assert sum(0.2 < share < 0.8 for share in shares) > 3


# -- couplings --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("spread_deg", "free"), [(0.0, False), (5.0, False), (0.0, True)])
def test_the_dip_follows_exactly_loosely_or_not_at_all(spread_deg: float, free: bool) -> None:
    """A finger tip 8 degrees off the ratio, on a palm whose orientation is known, so that it shows."""
    keys: dict[str, object] = (
        {"dip_per_pip": None} if free else {"dip_spread_rad": float(np.radians(spread_deg))}
    )
    model = with_couplings(**keys)
    truth = np.zeros((5, 4))
    truth[1:, 1], truth[1:, 2], truth[1:, 3] = 0.4, 0.8, 0.8 * 2 / 3
    truth[2, 3] += np.radians(8.0)
    machine = forgetful(model)
    sure = orientation_of(palm()[:3, :3], 1e-6 * np.eye(3))
    hand = found(fit(places(palm(), truth, model), small_cov(), by=machine, orientation=sure))
    growth = np.degrees(hand.angles_rad[1:, 3] - hand.angles_rad[1:, 2] * 2 / 3)
    if spread_deg == 0.0 and not free:
        np.testing.assert_allclose(growth, 0.0, atol=1e-9)
    else:
        assert growth[1] > 0.1
        assert growth[1] > np.abs(growth[[0, 2, 3]]).max()


def test_neighbours_can_be_independent() -> None:
    """The middle finger has no marker and its neighbours show: it bends as they do, or as it likes."""
    truth = np.zeros((5, 4))
    truth[1:, 1], truth[1:, 2], truth[1:, 3] = 0.49, 0.9, 0.6
    points = places(palm(), truth)
    points[2] = np.nan
    bent = [
        float(np.degrees(found(fit(points, small_cov(), by=forgetful(model, natural=True))).angles_rad[2, 2]))
        for model in (RIGHT, with_couplings(neighbours=False))
    ]
    as_they_do = np.degrees(0.9)
    assert abs(bent[0] - as_they_do) < 10.0
    assert abs(bent[1] - as_they_do) > 25.0


def test_without_natural_flexion_the_markers_alone_bend_the_mcp() -> None:
    """Flat in the MCP and bent in the PIP defies natural flexion; without it the fit is nearer."""
    truth = np.zeros((5, 4))
    truth[1:, 2], truth[1:, 3] = 1.2, 0.8
    error: list[float] = []
    for model in (RIGHT, with_couplings(mcp_per_pip=None)):
        machine = forgetful(model, natural=True)
        error.append(pip_deg(solved(machine, palm(), truth, np.zeros((6, 3))), truth))
    assert error[1] < error[0]


def test_a_hidden_finger_that_is_curled_does_not_bend_its_neighbour() -> None:
    """Index straight and shown, the others out of sight: a pointing hand."""
    truth = np.zeros((5, 4))
    truth[2:, 1], truth[2:, 2], truth[2:, 3] = 1.2, 1.6, 1.6 * 2 / 3
    points = places(palm(), truth)
    points[[0, 2, 3, 4]] = np.nan
    hand = found(fit(points, small_cov()))
    assert np.degrees(hand.angles_rad[1, 2]) < 15.0
    assert (np.degrees(hand.angles_rad[2:, 2]) > 60.0).all()


# -- limits -----------------------------------------------------------------------------------------------------


def narrowing() -> Estimator:
    limits = walls("D")
    narrow = {
        f: msgspec.structs.replace(getattr(limits, f), spread_at_full_flexion=0.0)
        for f in ("index", "little")
    }
    model = HandModel.of(
        msgspec.structs.replace(RIGHT.profile, limits_rad=msgspec.structs.replace(limits, **narrow))
    )
    return forgetful(model, settings=ANYWAY)


NARROW = narrowing()


@given(seeds)
@settings(max_examples=60)
def test_abduction_narrows_with_flexion_in_every_solution(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = places(palm(), independent_angles(rng)) + rng.normal(0.0, 5e-3, (6, 3))
    hand = found(fit(points, COV, by=NARROW))
    assert NARROW.model.within_limits(hand.angles_rad).all()
    low, high = NARROW.model.abduction_limits_rad(hand.angles_rad[:, 1])
    assert (hand.angles_rad[:, 0] >= low - 1e-9).all()
    assert (hand.angles_rad[:, 0] <= high + 1e-9).all()


# -- the palm's orientation by a sensor -------------------------------------------------------------------------


def test_a_measured_orientation_turns_the_palm() -> None:
    rng = np.random.default_rng(9)
    sigma = np.radians(2.0)
    alone, by_imu = list[float](), list[float]()
    for _ in range(30):
        T, truth = palm(rng.uniform(-45, 45, 3)), independent_angles(rng)
        noise = rng.normal(0.0, SIGMA_M, (6, 3))
        seen = rotation_vector_to_matrix(rng.normal(0.0, sigma, 3)) @ T[:3, :3]
        alone.append(palm_deg(solved(SOLVER, T, truth, noise), T))
        by_imu.append(
            palm_deg(solved(SOLVER, T, truth, noise, orientation_of(seen, sigma**2 * np.eye(3))), T)
        )
    assert np.mean(by_imu) < 3.0
    assert np.mean(by_imu) < 0.6 * np.mean(alone)


def test_an_axis_about_which_nothing_is_known_is_left_to_the_markers() -> None:
    """Heading 150 degrees off and claimed as unknown: the inclination is used, the heading is not used."""
    up = np.array([0.0, -1.0, 0.0])
    rng = np.random.default_rng(10)
    sigma = np.radians(1.0)
    cov = sigma**2 * np.eye(3) + 100.0 * np.outer(up, up)
    alone, by_imu = list[float](), list[float]()
    for _ in range(20):
        T, truth = palm(rng.uniform(-45, 45, 3)), independent_angles(rng)
        noise = rng.normal(0.0, SIGMA_M, (6, 3))
        wrong = rotation_vector_to_matrix(np.radians(150.0) * up) @ T[:3, :3]
        alone.append(palm_deg(solved(SOLVER, T, truth, noise), T))
        by_imu.append(palm_deg(solved(SOLVER, T, truth, noise, orientation_of(wrong, cov, sure=False)), T))
    assert np.mean(by_imu) < np.mean(alone)


def test_one_marker_is_enough_where_the_orientation_is_known() -> None:
    truth = np.zeros((5, 4))
    T = palm(np.array([20.0, -10.0, 30.0]))
    points = places(T, truth)
    points[:5] = np.nan
    assert fit(points, small_cov()) is None
    hand = found(fit(points, small_cov(), orientation=orientation_of(T[:3, :3], 1e-4 * np.eye(3))))
    assert palm_deg(hand, T) < 1.0
    assert np.linalg.norm(hand.joints.position_m[1] - T[:3, 3]) < 5e-3
    assert fit(points, small_cov(), orientation=orientation_of(T[:3, :3], np.eye(3), sure=False)) is None


def test_a_palm_turns_with_the_imu_between_frames() -> None:
    """The last palm is turned by what the IMU says that it has turned since, before it is a prior."""
    truth, machine = np.zeros((5, 4)), estimator()
    wide = np.radians(8.0) ** 2 * np.eye(3)
    for k in range(30):
        T = palm(np.array([0.0, 0.0, 4.0 * k]))  # 240 degrees a second
        points = places(T, truth)
        if k >= 20:
            points[:5] = np.nan
        hand = push(machine, k * STEP_NS, points, orientation=orientation_of(T[:3, :3], wide, sure=True))
        assert palm_deg(hand.solution, T) < 12.0
        assert hand.source[PALM] == Source.SOLVED
