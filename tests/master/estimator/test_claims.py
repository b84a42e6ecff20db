"""Tests of how sure each joint is over time: claims hold, grow while nothing is seen, and stay bounded."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bench.joint_certainty import NOISE_M, Coverage, compared, joined, kinds
from common.arrays import Float
from common.geometry import rigid
from common.hand_model import CHAINS, PALM, TIPS, HandModel
from common.sim.motion import HandMotion, ScriptedMotion
from common.sim.poses import StudyPoses
from master.ik.doubt import surer
from master.ik.tracker import HandTracker
from tests.hand_helpers import FACING, MARKERS, RIGHT, natural_angles, palm, small_cov

STEP_NS = 16_666_667
INDEX = 1
NOBODY = tuple(range(6))
CENTRE = np.array([0.0, 0.0, 0.5])


def spd(rng: np.random.Generator, n: int) -> Float:
    a = rng.normal(size=(n, n + 2)) * 10.0 ** rng.uniform(-2.0, 1.0, (n, 1))
    return a @ a.T


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=40)
def test_the_surer_of_two_is_no_larger_than_either_whatever_their_order(seed: int) -> None:
    rng = np.random.default_rng(seed)
    one, other = spd(rng, 5), spd(rng, 5)
    both = surer(one, other)
    size = np.abs(one).max() + np.abs(other).max()
    for cov in (one, other):
        assert np.linalg.eigvalsh(cov - both).min() > -1e-7 * size
    np.testing.assert_allclose(both, surer(other, one), atol=1e-7 * size)
    np.testing.assert_allclose(surer(one, one), one, atol=1e-9 * size)
    np.testing.assert_allclose(surer(one, 4.0 * one), one, atol=1e-9 * size)
    assert np.linalg.eigvalsh(both).min() > 0.0


def test_no_direction_is_claimed_surer_than_its_surer_witness() -> None:
    """Kalman's sum would say 0.5 and 0.5."""
    np.testing.assert_allclose(surer(np.eye(2), np.eye(2)), np.eye(2), atol=1e-12)
    np.testing.assert_allclose(surer(np.diag([1.0, 9.0]), np.diag([4.0, 1.0])), np.eye(2), atol=1e-12)


def course(gone: tuple[int, ...], frames: int, speed_m_s: float = 0.0, still: int = 20) -> list[Float]:
    """Covariances (26, 3, 3) [m^2], first of the last frame with all markers, then of those without some."""
    tracker, angles, out = (
        HandTracker(RIGHT, MARKERS),
        natural_angles(np.random.default_rng(3)),
        list[Float](),
    )
    for k in range(still + frames):
        t = min(k, still) * STEP_NS * 1e-9
        T = rigid(palm()[:3, :3], palm()[:3, 3] + [speed_m_s * t, 0.0, 0.0])
        points = RIGHT.marker_points(RIGHT.forward(T, angles), MARKERS)
        if k >= still:
            points[list(gone)] = np.nan
        hand = tracker.push(k * STEP_NS, points, small_cov(), FACING)
        assert hand.solution is not None
        if k >= still - 1:
            out.append(hand.solution.cov_m2)
    return out


def sigma_m(cov_m2: list[Float], joint: int) -> Float:
    return np.sqrt([np.trace(cov[joint]) for cov in cov_m2])


def test_a_pose_that_is_held_makes_no_joint_surer() -> None:
    tracker, angles, claims = (
        HandTracker(RIGHT, MARKERS),
        natural_angles(np.random.default_rng(3)),
        list[Float](),
    )
    points = RIGHT.marker_points(RIGHT.forward(palm(), angles), MARKERS)
    for k in range(30):
        hand = tracker.push(k * STEP_NS, points, small_cov(), FACING)
        assert hand.solution is not None
        claims.append(np.sqrt(np.trace(hand.solution.cov_m2, axis1=1, axis2=2)))
    np.testing.assert_allclose(claims[-1], claims[0], rtol=0.15)


def test_doubt_about_a_hidden_finger_grows_and_stays_within_its_reach() -> None:
    covs = course((INDEX,), 300)
    tip = sigma_m(covs, TIPS[INDEX])
    assert (np.diff(tip[:60]) > 0.0).all()
    assert tip[18] > 3.0 * tip[0]  # 300 ms
    assert tip[-1] < 0.1  # a finger's length: somewhere within its limits
    for seen in (TIPS[2], PALM):
        assert sigma_m(covs, seen)[-1] < 1.6 * sigma_m(covs, seen)[0]


def test_doubt_about_a_lost_hand_grows_the_faster_the_faster_it_went() -> None:
    still, moving = (sigma_m(course(NOBODY, 28, speed), PALM) for speed in (0.0, 0.5))
    for claims in (still, moving):
        assert (np.diff(claims)[1:] > 0.0).all()
        assert claims[1] > 0.95 * claims[0]  # no marker tells any more about which point the palm turns
    assert moving[-1] > 3.0 * still[-1]
    assert moving[-1] > 0.5 * 0.5 * 28 / 60  # half the way it would have gone on


def test_covariances_are_positive_definite_whatever_is_seen() -> None:
    rng, tracker = np.random.default_rng(1), HandTracker(RIGHT, MARKERS)
    for k in range(120):
        points = RIGHT.marker_points(RIGHT.forward(palm(), natural_angles(rng)), MARKERS)
        points[rng.random(6) < 0.5] = np.nan
        hand = tracker.push(k * STEP_NS, points, small_cov(), FACING)
        if hand.solution is not None:
            value = np.linalg.eigvalsh(hand.solution.cov_m2)
            assert value.min() > 0.0
            assert value.max() < 1.0


def test_what_moves_on_an_arc_is_as_wide_as_drawn_hands_are() -> None:
    """A hidden finger's tip, its angles drawn from what is claimed of them, strays as its covariance says."""
    tracker, angles = HandTracker(RIGHT, MARKERS), natural_angles(np.random.default_rng(3))
    points, hidden = RIGHT.marker_points(RIGHT.forward(palm(), angles), MARKERS), np.zeros((6, 1), bool)
    hidden[INDEX] = True
    for k in range(60):
        tracker.push(k * STEP_NS, np.where(hidden & (k >= 10), np.nan, points), small_cov(), FACING)
    found = tracker.last
    assert found is not None
    cov = tracker.doubt.cov
    assert cov is not None
    draws = np.random.default_rng(2).multivariate_normal(np.zeros(len(cov)), cov, 4000)
    parameters = tracker.parameters
    x = parameters.of_angles(found.angles_rad)
    drawn = parameters.angles(x + draws[:, 6:])
    places = RIGHT.forward(found.T_rig_palm, drawn).position_m[:, TIPS[INDEX]]
    off = places - found.joints.position_m[TIPS[INDEX]]
    claimed = found.cov_m2[TIPS[INDEX]]
    nees = np.vecdot(off, np.linalg.solve(claimed, off.T).T)
    assert 0.9 < (nees < 7.815).mean() < 0.99


@pytest.fixture(scope="module")
def coverage() -> dict[str, Coverage]:
    model, parts = RIGHT, list[Coverage]()
    motions: list[tuple[HandModel, HandMotion, int]] = [
        (model, kind(model, CENTRE, seed), seed) for seed in (21, 22) for kind in (ScriptedMotion, StudyPoses)
    ]
    for hand, motion, seed in motions:
        parts.append(compared(hand, motion, NOISE_M["1 mm"], seed))
    return dict(kinds(joined(parts)))


@pytest.mark.parametrize(
    ("kind", "least"),
    [("visible", 90.0), ("hidden up to 300 ms", 90.0), ("hidden for 300 ms", 88.0),
     ("lost for longer than 0.5 s", 85.0), ("whole hand gone, up to 0.5 s", 90.0)],
)  # fmt: skip
def test_regions_of_95_percent_hold_the_truth(coverage: dict[str, Coverage], kind: str, least: float) -> None:
    found = coverage[kind]
    assert len(found.chi_2) >= 150
    assert found.inside > least
    # Claims that are true of anything are none: they are of the order of the errors.
    claimed, error = np.sqrt(3.0 * np.mean(found.sigma_m**2)), np.sqrt(np.mean(found.error_m**2))
    assert claimed < 3.5 * error


def test_the_regions_would_not_hold_if_claims_were_half_as_wide(coverage: dict[str, Coverage]) -> None:
    for kind in ("visible", "lost for longer than 0.5 s"):
        assert (4.0 * coverage[kind].chi_2 < 7.815).mean() < 0.9


def test_joints_of_a_seen_finger_are_surer_than_of_a_hidden_one(coverage: dict[str, Coverage]) -> None:
    hidden, visible = coverage["hidden for 300 ms"], coverage["  of these the fingers'"]
    assert np.isin(hidden.joint, CHAINS[:, 1:]).all()
    assert np.median(hidden.sigma_m) > 2.0 * np.median(visible.sigma_m)
