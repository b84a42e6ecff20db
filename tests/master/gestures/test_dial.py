"""A dial over many grips: the sum of what it was turned while gripped, whatever the hand does between; bad instants."""

from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.arrays import Float
from common.calibration import HandProfile, load
from common.calibration.gesture_settings import default_gestures
from common.geometry.transforms import axis_rotation, matrix_to_quaternion, rigid, rotation_vector_to_matrix
from common.hand.model import TIPS, HandModel
from common.messages import Gesture, HandPose
from common.sim.gesture_postures import Knob, knob_grip
from common.sim.motion import angles_of, smooth_step
from master.gestures.dial import GripHistory
from master.gestures.poses import GestureRecogniser
from tests.master.gestures.shown_hands import FRAME_NS, shown

STILL = np.zeros((5, 4))
MODEL = HandModel.of(load(Path(__file__).parents[3] / "calib_json/hands/default-right.json", HandProfile))
KNOB = knob_grip(MODEL, 0.023, STILL)
OPENED = KNOB.posture_deg + np.array([[14.0, -14.0, -14.0], *[[0.0, -17.0, -16.0]] * 4])


def _pose(k: int, rotation_rad: float, loose: float, knob: Knob = KNOB) -> HandPose:
    """A hand about the knob at frame `k`, known to a millimetre: turned so far, open by a share."""
    rotation = rotation_vector_to_matrix(knob.axis * rotation_rad)
    T = rigid(rotation, knob.centre_m - rotation @ knob.centre_m)
    angles = angles_of(MODEL, knob.posture_deg + loose * (OPENED - knob.posture_deg), STILL)
    return shown(angles, k * FRAME_NS, MODEL, T, markers=1)


def _grips(rotations_deg: list[float], rest: int) -> tuple[Float, Float, Float]:
    """Palm [rad], share open and knob [rad], frame by frame: each grip turns the knob, then opens and turns back."""
    palm, loose, knob = [np.zeros(25)], [np.zeros(25)], [np.zeros(25)]
    there = 0.0
    for rotation in np.radians(rotations_deg):
        gone = rotation * _smooth(30)
        opens, still = _smooth(12), np.zeros(rest)
        parts = [
            gone,
            rotation + still,
            np.full(12, rotation),
            rotation * (1.0 - opens),
            np.zeros(12),
            np.zeros(10),
        ]
        palm.append(np.concatenate(parts))
        loose.append(np.concatenate([0.0 * gone, still, opens, np.ones(12), 1.0 - opens, np.zeros(10)]))
        knob.append(there + np.concatenate([gone, np.full(rest + 46, rotation)]))
        there += rotation
    return np.concatenate(palm), np.concatenate(loose), np.concatenate(knob)


def _smooth(count: int) -> Float:
    """(count,) from above 0 to 1."""
    return np.array([smooth_step((k + 1) / count) for k in range(count)])


def _dial(poses: list[HandPose]) -> list[Gesture]:
    recogniser = GestureRecogniser(default_gestures(), MODEL)
    return [one for pose in poses for one in recogniser.push(pose) if one.kind == "dial"]


@settings(max_examples=3, deadline=None)
@given(
    rotations_deg=st.lists(st.floats(-50.0, 50.0), min_size=2, max_size=3),
    rest=st.integers(min_value=4, max_value=10),
)
def test_a_dial_is_turned_by_the_sum_of_its_grips_without_a_step(
    rotations_deg: list[float], rest: int
) -> None:
    palm, loose, knob = _grips(rotations_deg, rest)
    gestures = _dial([_pose(k, palm[k], loose[k]) for k in range(len(palm))])
    assert [one.phase for one in gestures if one.phase != "update"] == ["begin"]
    off = np.degrees([one.angle_rad - knob[one.t_ns // FRAME_NS] for one in gestures])
    assert np.abs(off).max() < 1.5 * len(
        rotations_deg
    )  # each time it is let go by less than a degree and a half
    steps = np.diff([one.angle_rad for one in gestures])
    assert np.degrees(np.abs(steps).max()) < np.degrees(np.abs(np.diff(knob)).max()) + 1.5


def test_one_bad_instant_in_a_quick_turn_is_led_over() -> None:
    rotation = np.radians(np.clip(2.0 * (np.arange(80) - 25), 0.0, 90.0))
    poses = [_pose(k, float(rotation[k]), 0.0) for k in range(80)]
    bad = poses[45].position_m.copy()
    bad[TIPS[0]] += 0.02 * KNOB.axis + 0.01  # the thumb somewhere else
    poses[45] = msgspec.structs.replace(poses[45], position_m=bad)
    gestures = {one.t_ns // FRAME_NS: np.degrees(one.angle_rad) for one in _dial(poses)}
    assert abs(gestures[45] - 40.0) < 1.5
    assert gestures[46] == pytest.approx(42.0, abs=0.1)


def test_an_uncertain_palm_does_not_delay_a_grip_whose_tips_stand_still() -> None:
    def uncertain(k: int) -> HandPose:
        pose = _pose(k, 0.0, 0.0)
        if k % 3:
            return pose
        # The same tips on a hand whose palm and pads are turned over: no grip, were it not for the others.
        over = axis_rotation(2, np.pi)
        wxyz = matrix_to_quaternion(over @ MODEL.forward(np.eye(4), pose.angles_rad).rotation)
        return msgspec.structs.replace(pose, orientation_wxyz=wxyz)

    gestures = _dial([uncertain(k) for k in range(40)])
    begun = [one.t_ns for one in gestures if one.phase == "begin"]
    hold_ns = default_gestures().dial.hold_s * 1e9
    assert len(begun) == 1
    assert hold_ns <= begun[0] <= hold_ns + 3 * FRAME_NS


def test_a_hand_that_opens_and_closes_turns_no_dial_further_than_its_fingers() -> None:
    # Opened for longer than it may take to grip again: the dial ends where it stood.
    palm, loose, _ = _grips([40.0], 6)
    cut = 25 + 30 + 6 + 12
    poses = [_pose(k, palm[k], loose[k]) for k in range(cut)]
    poses += [_pose(k, palm[cut], 1.0) for k in range(cut, cut + 90)]
    gestures = _dial(poses)
    assert gestures[-1].phase == "end"
    assert np.degrees(gestures[-1].angle_rad) == pytest.approx(40.0, abs=1.5)


def test_a_grip_that_slowly_widens_goes_on_and_a_loose_one_does_not() -> None:
    history = GripHistory(9e-4)
    wide = np.linspace(0.0, 2e-3, 60)
    for k, w in enumerate(wide):
        assert history.sound(k * FRAME_NS, float(w), 2.5e-3)
        history.push(k * FRAME_NS, float(w), 0.1)
    assert not history.sound(60 * FRAME_NS, 2.6e-3, 2.5e-3)
    assert history.loosens
    assert history.ahead_rad(60 * FRAME_NS) == pytest.approx(0.1)
    assert not history.sound(61 * FRAME_NS, float("nan"), 2.5e-3)


def test_nothing_is_led_over_before_anything_was_seen() -> None:
    assert GripHistory(9e-4).ahead_rad(0) is None
