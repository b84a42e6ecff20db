"""Contact of a hand that closes round a bar, against the air between bones and bar that the grip itself computes."""

from pathlib import Path

import msgspec
import numpy as np
import pytest

from common.arrays import Float
from common.calibration import HandProfile, load
from common.calibration.object_profile import CylinderShape, ObjectProfile
from common.geometry.transforms import matrix_to_quaternion, rigid, rotation_vector_to_matrix
from common.hand.model import HandModel
from common.messages import JOINT_COUNT, HandPose, ObjectPose
from common.sim.grasp import bar_in_palm, closed_round, gaps_m
from common.sim.motion import REST, angles_of
from master.objects.contact import ContactMonitor
from tests.results import object_pose, pose_of

HAND = HandModel.of(load(Path(__file__).parents[3] / "calib_json/hands/default-right.json", HandProfile))
RADIUS_M = 0.012
BAR = ObjectProfile(
    version=1, name="bar", tracker="puck", shape=(CylinderShape(radius_m=RADIUS_M, length_m=0.18),)
)
PALM = rigid(rotation_vector_to_matrix(np.array([0.3, -0.5, 0.2])), np.array([0.1, 0.0, 0.5]))
IN_PALM = bar_in_palm(HAND, RADIUS_M)
STILL = np.zeros((5, 4))
CLOSED = angles_of(HAND, closed_round(HAND, IN_PALM, RADIUS_M, STILL, np.full(4, 0.54)), STILL)
OPEN = angles_of(HAND, np.array(REST, dtype=np.float64), STILL)


def hand(angles: Float, t_ns: int = 0, sigma_m: float = 1e-3) -> HandPose:
    joints = HAND.forward(PALM, angles)
    cov = np.tile(sigma_m**2 * np.eye(3), (JOINT_COUNT, 1, 1))
    return pose_of(HAND, joints, t_ns=t_ns, cov_m2=cov, angles_rad=angles)


def bar(T: Float, t_ns: int = 0, cov: Float | None = None) -> ObjectPose:
    known = np.zeros((6, 6)) if cov is None else cov
    return object_pose("bar", T[:3, 3], matrix_to_quaternion(T[:3, :3]), t_ns=t_ns, cov=known)


def watch(T: Float = PALM @ IN_PALM, t_ns: int = 0) -> ContactMonitor:
    watching = ContactMonitor(HAND, [BAR])
    watching.push_object(bar(T, t_ns))
    return watching


@pytest.mark.parametrize("angles", [CLOSED, OPEN], ids=["closed", "open"])
def test_distances_are_those_of_the_grip(angles: Float) -> None:
    contact = watch().push(hand(angles))[0]
    air = gaps_m(HAND, angles, IN_PALM, RADIUS_M)[:, 2]
    # The grip takes the bar as endless and bones at 13 places.
    np.testing.assert_allclose(contact.distance_m, air, atol=3e-4)


def test_all_fingers_of_a_closed_hand_touch_and_it_holds() -> None:
    contact = watch().push(hand(CLOSED))[0]
    assert contact.touching.all()
    assert contact.held


def test_an_open_hand_touches_nothing() -> None:
    contact = watch(PALM @ rigid(np.eye(3), np.array([0.0, -0.1, 0.0])) @ IN_PALM).push(hand(OPEN))[0]
    assert not contact.touching.any()
    assert not contact.held


def test_the_points_are_on_the_surface_as_far_away_as_is_said() -> None:
    contact = watch().push(hand(OPEN))[0]
    T = PALM @ IN_PALM
    own = (contact.point_m - T[:3, 3]) @ T[:3, :3]
    on_side = np.abs(np.linalg.norm(own[:, :2], axis=1) - RADIUS_M) < 1e-9
    on_end = np.abs(np.abs(own[:, 2]) - 0.09) < 1e-9
    assert (on_side | on_end).all()


def test_sigma_is_that_of_hand_and_object_along_the_normal() -> None:
    cov = np.zeros((6, 6))
    cov[:3, :3] = 4e-6 * np.eye(3)
    watching = ContactMonitor(HAND, [BAR])
    watching.push_object(bar(PALM @ IN_PALM, 0, cov))
    contact = watching.push(hand(OPEN, sigma_m=2e-3))[0]
    np.testing.assert_allclose(contact.sigma_m, 1e-3 * np.sqrt(4.0 + 4.0 + 1.0), rtol=1e-6)


def test_touch_has_hysteresis() -> None:
    away = PALM @ rigid(np.eye(3), np.array([0.0, 0.006, 0.0])) @ IN_PALM
    fresh = watch(away).push(hand(CLOSED))[0]
    watching = watch()
    watching.push(hand(CLOSED))
    watching.push_object(bar(away, 16_000_000))
    watching.push_object(bar(away, 17_000_000))
    after = watching.push(hand(CLOSED, 17_000_000))[0]
    assert after.touching.sum() > fresh.touching.sum()
    watching.push_object(bar(PALM @ rigid(np.eye(3), np.array([0.0, -0.05, 0.0])) @ IN_PALM, 33_000_000))
    assert not watching.push(hand(CLOSED, 33_000_000))[0].touching.any()


def test_the_object_is_brought_to_the_instant_of_the_hand() -> None:
    T = PALM @ IN_PALM
    shift = rigid(np.eye(3), np.array([0.0, 0.0, 0.0]))
    shift[:3, 3] = 0.02 * PALM[:3, 1]
    watching = ContactMonitor(HAND, [BAR])
    watching.push_object(bar(invert_shift(shift) @ T, 0))
    watching.push_object(bar(shift @ T, 20_000_000))
    there = watching.push(hand(CLOSED, 10_000_000))[0]
    np.testing.assert_allclose(there.distance_m, watch().push(hand(CLOSED))[0].distance_m, atol=1e-9)


def invert_shift(T: Float) -> Float:
    out = T.copy()
    out[:3, 3] = -T[:3, 3]
    return out


def test_what_is_not_known_is_nan_and_does_not_touch() -> None:
    watching = watch()
    pose = hand(CLOSED)
    valid = pose.valid.copy()
    valid[5] = False  # end of the thumb
    contact = watching.push(msgspec.structs.replace(pose, valid=valid))[0]
    assert np.isnan(contact.distance_m).tolist() == [True, False, False, False, False]
    late = watching.push(hand(CLOSED, 500_000_000))[0]
    assert np.isnan(late.distance_m).all()
    assert not late.touching.any()
    assert not late.held


def test_an_object_that_is_lost_has_no_contact() -> None:
    watching = watch()
    nowhere = msgspec.structs.replace(
        bar(PALM, 10_000_000), position_m=np.full(3, np.nan), orientation_wxyz=np.full(4, np.nan)
    )
    watching.push_object(nowhere)
    assert np.isnan(watching.push(hand(CLOSED, 10_000_000))[0].distance_m).all()


def test_an_unsure_distance_is_no_touch() -> None:
    assert not watch().push(hand(CLOSED, sigma_m=0.04))[0].touching.any()


def test_another_hand_is_not_answered() -> None:
    assert watch().push(msgspec.structs.replace(hand(CLOSED), hand="other")) == []
