"""Tests of how sure each joint is over time: claims hold, grow while nothing is seen, and stay bounded."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bench.hands.certainty import NOISE_M, Coverage, compared, joined, kinds
from common.arrays import Float
from common.geometry.transforms import rigid
from common.hand.model import CHAINS, PALM, TIPS, HandModel
from common.records import boxed, record
from common.sim.motion import HandMotion, ScriptedMotion, StudyPoses
from master.estimator.covariance import CovarianceScratch
from master.estimator.sensors import NO_EXTRAS
from tests.hand_helpers import RIGHT, natural_angles, palm
from tests.master.estimator.fitted import (
    FREE,
    PARAMETERS,
    STEP_NS,
    estimator,
    fit,
    found,
    places,
    push,
)
from tests.master.estimator.kernels import surer_at

INDEX = 1
NOBODY = tuple(range(6))
CENTRE = np.array([0.0, 0.0, 0.5])


def surer(now: Float, past: Float) -> Float:
    """In each direction that of the surer of two covariances (n, n)."""
    out = np.empty_like(now)
    surer_at(now, past, boxed(record(CovarianceScratch, N=6 + FREE + NO_EXTRAS, M=16)), out)  # as of the line
    return out


def spd(rng: np.random.Generator, n: int) -> Float:
    a = rng.normal(size=(n, n + 9)) * 10.0 ** rng.uniform(-1.0, 1.0, (n, 1))
    return a @ a.T


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=40)
def test_the_surer_of_two_is_no_larger_than_either_whatever_their_order(seed: int) -> None:
    rng = np.random.default_rng(seed)
    one, other = spd(rng, 22), spd(rng, 22)
    both = surer(one, other)
    size = np.abs(one).max() + np.abs(other).max()
    for cov in (one, other):
        assert np.linalg.eigvalsh(cov - both).min() > -1e-6 * size
    np.testing.assert_allclose(both, surer(other, one), atol=1e-6 * size)
    np.testing.assert_allclose(surer(one, one), one, atol=1e-9 * size)
    np.testing.assert_allclose(surer(one, 4.0 * one), one, atol=1e-9 * size)
    assert np.linalg.eigvalsh(both).min() > 0.0


def test_no_direction_is_claimed_surer_than_its_surer_witness() -> None:
    """Kalman's sum would say 0.5 and 0.5."""
    one, other = np.tile([1.0, 9.0], 11), np.tile([4.0, 1.0], 11)
    np.testing.assert_allclose(surer(np.eye(22), np.eye(22)), np.eye(22), atol=1e-12)
    np.testing.assert_allclose(surer(np.diag(one), np.diag(other)), np.eye(22), atol=1e-12)


def test_an_epoch_that_says_nothing_leaves_the_state_as_it_was() -> None:
    """Where rounding leaves a covariance that is none."""
    past = spd(np.random.default_rng(1), 22)
    np.testing.assert_array_equal(surer(np.full((22, 22), -1.0), past), past)


def history(gone: tuple[int, ...], frames: int, speed_m_s: float = 0.0, still: int = 20) -> list[Float]:
    """Covariances (26, 3, 3) [m^2], first of the last frame with all markers, then of those without some."""
    machine, angles, out = estimator(), natural_angles(np.random.default_rng(3)), list[Float]()
    for k in range(still + frames):
        t = min(k, still) * STEP_NS * 1e-9
        T = rigid(palm()[:3, :3], palm()[:3, 3] + [speed_m_s * t, 0.0, 0.0])
        points = places(T, angles)
        if k >= still:
            points[list(gone)] = np.nan
        hand = found(push(machine, k * STEP_NS, points).solution)
        if k >= still - 1:
            out.append(hand.cov_m2)
    return out


def sigma_m(cov_m2: list[Float], joint: int) -> Float:
    return np.sqrt([np.trace(cov[joint]) for cov in cov_m2])


def test_a_pose_that_is_held_makes_no_joint_surer() -> None:
    machine, claims = estimator(), list[Float]()
    points = places(palm(), natural_angles(np.random.default_rng(3)))
    for k in range(30):
        hand = found(push(machine, k * STEP_NS, points).solution)
        claims.append(np.sqrt(np.trace(hand.cov_m2, axis1=1, axis2=2)))
    np.testing.assert_allclose(claims[-1], claims[0], rtol=0.15)


def test_uncertainty_of_a_hidden_finger_grows_and_stays_within_its_reach() -> None:
    covs = history((INDEX,), 300)
    tip = sigma_m(covs, TIPS[INDEX])
    assert (np.diff(tip[:60]) > 0.0).all()
    assert tip[18] > 3.0 * tip[0]  # 300 ms
    assert tip[-1] < 0.1  # a finger's length: somewhere within its limits
    for seen in (TIPS[2], PALM):
        assert sigma_m(covs, seen)[-1] < 1.6 * sigma_m(covs, seen)[0]


def test_uncertainty_of_a_lost_hand_grows_the_faster_the_faster_it_went() -> None:
    still, moving = (sigma_m(history(NOBODY, 28, speed), PALM) for speed in (0.0, 0.5))
    for claims in (still, moving):
        assert (np.diff(claims)[1:] > 0.0).all()
        assert claims[1] > 0.95 * claims[0]  # no marker fixes any more the point about which the palm turns
    assert moving[-1] > 3.0 * still[-1]
    assert moving[-1] > 0.5 * 0.5 * 28 / 60  # half the way it would have gone on


def test_covariances_are_positive_definite_whatever_is_seen() -> None:
    rng, machine = np.random.default_rng(1), estimator()
    for k in range(120):
        points = places(palm(), natural_angles(rng))
        points[rng.random(6) < 0.5] = np.nan
        hand = push(machine, k * STEP_NS, points)
        if hand.solution is not None:
            value = np.linalg.eigvalsh(hand.solution.cov_m2)
            assert value.min() > 0.0
            assert value.max() < 1.0


def test_second_order_covariance_is_as_wide_as_drawn_hands_are() -> None:
    """A hidden finger's tip, its angles drawn from what is claimed of them, strays as its covariance says."""
    machine, hidden = estimator(), np.zeros((6, 1), bool)
    points = places(palm(), natural_angles(np.random.default_rng(3)))
    hidden[INDEX] = True
    hands = [push(machine, k * STEP_NS, np.where(hidden & (k >= 10), np.nan, points)) for k in range(60)]
    last = found(hands[-1].solution)
    cov = np.array(machine.state.cov)
    draws = np.random.default_rng(2).multivariate_normal(np.zeros(len(cov)), cov, 4000)
    drawn = PARAMETERS.angles(last.x + draws[:, 6 : 6 + len(last.x)])
    tips = RIGHT.forward(last.T_rig_palm, drawn).position_m[:, TIPS[INDEX]]
    off = tips - last.joints.position_m[TIPS[INDEX]]
    claimed = last.cov_m2[TIPS[INDEX]]
    nees = np.vecdot(off, np.linalg.solve(claimed, off.T).T)
    assert 0.9 < (nees < 7.815).mean() < 0.99


@pytest.mark.parametrize("gone", [(), (3,), (0, 4)])
def test_the_scatter_of_a_fit_is_that_which_its_covariance_says(gone: tuple[int, ...]) -> None:
    """One hand of the posture prior, its markers drawn anew: 95 % regions of all joints hold it, without being vast."""
    rng, inside, claims, errors = np.random.default_rng(13), list[Float](), list[Float](), list[Float]()
    for _ in range(80):
        T, angles = palm(rng.uniform(-15.0, 15.0, 3)), natural_angles(rng)
        points = places(T, angles) + rng.normal(0.0, 1e-3, (6, 3))
        points[list(gone)] = np.nan
        hand = found(fit(points, np.tile(1e-6 * np.eye(3), (6, 1, 1))))
        off = (hand.joints.position_m - RIGHT.forward(T, angles).position_m)[1:]
        cov = hand.cov_m2[1:]
        inside.append(np.vecdot(off, np.linalg.solve(cov, off[..., None])[..., 0]) < 7.815)
        claims.append(np.trace(cov, axis1=1, axis2=2))
        errors.append(np.vecdot(off, off))
    assert np.mean(inside) > 0.9
    assert np.sqrt(np.mean(claims)) < 3.5 * np.sqrt(np.mean(errors))


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
