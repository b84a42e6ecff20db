"""What other sensors say of a hand: what palm and fingers share through the bend, doubt of one finger, false ones."""

import numpy as np
import pytest

from common.arrays import Float
from common.hand_model import CHAINS
from common.messages import Level, Source
from master.estimator.parameters import HandParameters
from master.fusion.orientation import Orientation
from master.fusion.sensed_hand import MarkerCheck, SensedHand
from tests.hand_helpers import MARKERS, RIGHT, natural_angles, palm, small_cov
from tests.master.estimator.fitted import estimator, fit, found, push

PARAMETERS = HandParameters.of(RIGHT)
SLOPE = np.zeros((5, 4, 2))
SLOPE[1:, 1, 0] = -3.3  # of a device 10 cm under the wrist: a degree of flexion turns knuckles by three
T = palm()


def sensed(
    angles: Float, *, sigma_deg: float = 3.0, bend_deg: float = 8.0, turn: Orientation | None = None
) -> SensedHand:
    """Fingers by a device that is so sure of them once the bend is known."""
    own = np.tile(np.eye(4) / np.radians(sigma_deg) ** 2, (5, 1, 1))
    with_bend = -own @ SLOPE
    return SensedHand(
        angles,
        own,
        with_bend,
        np.swapaxes(SLOPE, 1, 2) @ own @ SLOPE,
        np.isfinite(angles[:, 0]),
        np.full(5, Level.IK, np.uint8),
        np.radians(bend_deg) ** 2 * np.eye(2),
        turn,
        np.zeros((3, 2)),
    )


def markers(angles: Float) -> Float:
    """Where the caps of that hand are (6, 3)."""
    return RIGHT.marker_points(RIGHT.forward(T, angles), MARKERS)


def test_the_bend_is_integrated_out_and_shared_by_all_fingers() -> None:
    angles = natural_angles(np.random.default_rng(1))
    cov = np.asarray(np.linalg.inv(sensed(angles).information[3:, 3:]), np.float64)
    slope, own = SLOPE.reshape(20, 2), np.radians(3.0) ** 2 * np.eye(20)
    np.testing.assert_allclose(cov, own + np.radians(8.0) ** 2 * slope @ slope.T, rtol=1e-6, atol=1e-12)


def test_what_the_bend_does_to_the_palm_it_does_to_the_fingers() -> None:
    angles = natural_angles(np.random.default_rng(2))
    turns = np.array([[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]])  # how a bend turns the palm, rig axes
    bend = np.radians(8.0) ** 2 * np.eye(2)
    turned = Orientation(T[:3, :3], turns @ bend @ turns.T + np.radians(1.0) ** 2 * np.eye(3))
    alone = sensed(angles, turn=turned)
    both = SensedHand(
        angles,
        alone.weight,
        alone.with_bend,
        alone.of_bend,
        alone.told,
        alone.level,
        bend,
        turned,
        turns @ bend,
    )
    cov = np.asarray(np.linalg.inv(both.information), np.float64)
    rows = np.concatenate([turns, SLOPE.reshape(20, 2)])
    own = np.diag(np.concatenate([np.full(3, np.radians(1.0) ** 2), np.full(20, np.radians(3.0) ** 2)]))
    np.testing.assert_allclose(cov, own + rows @ bend @ rows.T, rtol=1e-5, atol=1e-10)


@pytest.mark.parametrize("seed", range(4))
def test_a_bend_that_all_fingers_suggest_is_no_flexion_of_theirs(seed: int) -> None:
    truth = natural_angles(np.random.default_rng(seed))
    told = truth + SLOPE[..., 0] * np.radians(6.0)  # twenty degrees of all knuckles
    points = markers(truth)
    measured = np.arange(5)
    hand, welded = (
        found(fit(points, small_cov(), sensed=sensed(told, bend_deg=bend).for_fit(PARAMETERS, measured)))
        for bend in (8.0, 0.1)
    )
    off = np.degrees(np.abs(hand.angles_rad - truth)[1:, 1]).mean()
    assert off < 4.0
    assert off < 0.5 * np.degrees(np.abs(welded.angles_rad - truth)[1:, 1]).mean()


def test_hidden_fingers_are_bent_as_the_device_has_them_and_say_so() -> None:
    truth = natural_angles(np.random.default_rng(3))
    truth[1:, 1], truth[1:, 2], truth[1:, 3] = np.radians([[50.0], [80.0], [53.0]])
    points = markers(truth)
    points[:5] = np.nan  # the back alone is seen
    turned = Orientation(T[:3, :3], np.radians(2.0) ** 2 * np.eye(3))
    said = sensed(truth, bend_deg=1.0, turn=turned).for_fit(PARAMETERS, np.zeros(0, np.int64))
    hand = push(estimator(), 10**9, points, sensed=said)
    assert hand.solution is not None
    assert np.degrees(np.abs(hand.solution.angles_rad - truth)[1:, 2]).max() < 6.0
    assert np.linalg.norm(hand.solution.T_rig_palm[:3, 3] - T[:3, 3]) < 5e-3
    assert hand.tracked.all()
    assert (hand.source[CHAINS] == Source.WRIST).all()


def test_a_finger_that_is_elsewhere_than_its_marker_is_not_taken() -> None:
    truth = natural_angles(np.random.default_rng(4))
    truth[2, 1:] = np.radians([10.0, 18.0, 12.0])
    false = truth.copy()
    false[2, 1:3] += np.radians([10.0, 70.0])
    check, points = MarkerCheck(RIGHT, MARKERS), markers(truth)
    told = sensed(false, bend_deg=1.0)
    assert check(told, T, points, small_cov()).tolist() == [False, False, True, False, False]
    points[2] = np.nan
    assert not check(told, T, points, small_cov()).any()
    left = told.without(np.arange(5) == 2)
    assert left.fingers == {0, 1, 3, 4}
    assert not left.information[3 + 8 : 3 + 12].any()


def test_a_finger_that_the_fit_contradicts_counts_less_and_the_others_as_before() -> None:
    truth = natural_angles(np.random.default_rng(5))
    told = sensed(truth)
    assert told.weighed(truth) is None
    off = truth.copy()
    off[3, 2] += np.radians(30.0)
    less = told.weighed(off)
    assert less is not None
    share = less.weight[:, 0, 0] / told.weight[:, 0, 0]
    np.testing.assert_array_equal(share[[0, 1, 2, 4]], 1.0)
    assert share[3] == pytest.approx(8.0 / (4.0 + 100.0))
