"""Pinch, dial, taps and pointing of hands whose truth is known: told in time, with the right values, nothing else."""

from collections.abc import Iterable, Iterator
from itertools import pairwise
from pathlib import Path

import msgspec
import numpy as np
import pytest

from common.arrays import Float
from common.calibration import HandProfile, load
from common.calibration.gesture_settings import (
    DialSettings,
    GestureSettings,
    PinchSettings,
    check_actions,
    default_gestures,
)
from common.errors import CalibrationError
from common.geometry.transforms import axis_rotation, matrix_to_quaternion, rigid
from common.hand.model import TIPS, HandModel
from common.messages import Gesture, HandPose
from common.sim.gesture_postures import knob_grip, pinch_posture
from common.sim.motion import POSES, REST, angles_of, smooth_step
from master.gestures.poses import GestureRecogniser
from tests.master.gestures.shown_hands import FRAME_NS, shown

ROOT = Path(__file__).parents[3]
STILL = np.zeros((5, 4))


@pytest.fixture(scope="module")
def model() -> HandModel:
    return HandModel.of(load(ROOT / "calib_json/hands/default-right.json", HandProfile))


def _pose(
    model: HandModel, k: int, T: Float, posture_deg: Float, sigma_m: Float | float = 1e-3, markers: int = 1
) -> HandPose:
    """A hand at frame `k` whose tips are known to `sigma_m` (5,)."""
    angles = angles_of(model, np.asarray(posture_deg, dtype=np.float64), STILL)
    pose = shown(angles, k * FRAME_NS, model, T, markers=markers)
    cov = pose.cov_m2.copy()
    cov[TIPS] = np.square(np.broadcast_to(sigma_m, 5))[:, None, None] * np.eye(3)
    return msgspec.structs.replace(pose, cov_m2=cov)


def _actions(recogniser: GestureRecogniser, poses: Iterable[HandPose]) -> list[Gesture]:
    return [one for pose in poses for one in recogniser.push(pose) if one.kind != "pose"]


def _closing(model: HandModel, target: Float, there: int = 30) -> Iterator[HandPose]:
    """From rest to a posture in 20 frames, held, and back."""
    rest = np.array(REST, dtype=np.float64)
    for k in range(60 + there):
        share = smooth_step(k / 20) * smooth_step((40 + there - k) / 20)
        yield _pose(model, k, np.eye(4), rest + share * (target - rest))


@pytest.mark.parametrize(("finger", "name"), [(1, "index"), (2, "middle"), (3, "ring"), (4, "little")])
def test_a_pinch_of_each_finger_begins_goes_on_and_ends(model: HandModel, finger: int, name: str) -> None:
    gestures = _actions(
        GestureRecogniser(default_gestures(), model), _closing(model, pinch_posture(model, finger, STILL))
    )
    assert [(one.kind, one.name, one.phase) for one in gestures if one.phase != "update"] == [
        ("pinch", name, "begin"),
        ("pinch", name, "end"),
    ]
    closed = gestures[len(gestures) // 2]
    assert closed.distance_m == pytest.approx(
        -0.0005, abs=2e-3
    )  # as the posture was made; the little reaches less
    assert closed.strength > 0.99
    assert {one.began_t_ns for one in gestures} == {gestures[0].t_ns}
    assert all(b.t_ns - a.t_ns == FRAME_NS for a, b in pairwise(gestures))


@pytest.mark.parametrize("name", ["small_grasp", "open_palm", "counting_two"])
def test_a_fist_and_open_hands_say_nothing(model: HandModel, name: str) -> None:
    gestures = _actions(GestureRecogniser(default_gestures(), model), _closing(model, np.array(POSES[name])))
    assert not gestures


def test_fingers_that_are_not_known_say_nothing(model: HandModel) -> None:
    pinched = pinch_posture(model, 1, STILL)
    recogniser = GestureRecogniser(default_gestures(), model)
    poses = (_pose(model, k, np.eye(4), pinched, np.array([0.03, 0.03, 1e-3, 1e-3, 1e-3])) for k in range(60))
    assert not _actions(recogniser, poses)


def test_a_pinch_outlasts_a_brief_loss_and_not_a_long_one(model: HandModel) -> None:
    pinched, settings = pinch_posture(model, 1, STILL), default_gestures()
    lost = np.array([1e-3, 0.05, 1e-3, 1e-3, 1e-3])
    brief = round(0.8 * settings.pinch.lost_s / (FRAME_NS * 1e-9))
    recogniser = GestureRecogniser(settings, model)

    def run(first: int, count: int, sigma: Float | float) -> list[str]:
        poses = (_pose(model, k, np.eye(4), pinched, sigma) for k in range(first, first + count))
        return [one.phase for one in _actions(recogniser, poses)]

    assert run(0, 10, 1e-3)[0] == "begin"
    assert set(run(10, brief, lost)) == {"update"}
    assert set(run(10 + brief, 5, 1e-3)) == {"update"}
    assert "end" in run(15 + brief, 2 * brief, lost)


def test_a_wrist_device_alone_turns_a_dial_by_its_imu(model: HandModel) -> None:
    knob, recogniser = knob_grip(model, 0.022, STILL), GestureRecogniser(default_gestures(), model)
    gestures: list[Gesture] = []
    for k in range(60):
        rotation = np.radians(max(k - 20, 0))
        dispatcher = axis_rotation(1, 0.7) @ _about(np.zeros(3), knob.axis, rotation)[:3, :3]
        pose = _pose(model, k, np.eye(4), knob.posture_deg, markers=0)
        gestures += _actions(
            recogniser, [msgspec.structs.replace(pose, palm_world_wxyz=matrix_to_quaternion(dispatcher))]
        )
    assert gestures[0].phase == "begin"
    assert np.degrees(gestures[-1].angle_rad) == pytest.approx(39.0, abs=0.1)


def test_a_ray_goes_from_the_tip_where_knuckle_and_tip_point(model: HandModel) -> None:
    gestures = _actions(
        GestureRecogniser(default_gestures(), model), _closing(model, np.array(POSES["pointing"]))
    )
    assert {one.kind for one in gestures} == {"point"}
    assert [one.phase for one in gestures if one.phase != "update"] == ["begin", "end"]
    middle = gestures[len(gestures) // 2]
    joints = model.forward(
        np.eye(4), angles_of(model, np.array(POSES["pointing"], dtype=np.float64), STILL)
    ).position_m
    np.testing.assert_allclose(middle.origin_m, joints[10], atol=1e-9)
    way = joints[10] - joints[7]
    np.testing.assert_allclose(middle.direction, way / np.linalg.norm(way), atol=1e-9)


def test_no_hand_ends_what_had_begun(model: HandModel) -> None:
    settings, pinched = default_gestures(), pinch_posture(model, 1, STILL)
    recogniser = GestureRecogniser(settings, model)
    _actions(recogniser, (_pose(model, k, np.eye(4), pinched) for k in range(5)))
    gone = [
        msgspec.structs.replace(
            _pose(model, k, np.eye(4), pinched),
            valid=np.zeros(26, dtype=bool),
            tracked=np.zeros(26, dtype=bool),
            position_m=np.full((26, 3), np.nan),
        )
        for k in range(5, 60)
    ]
    assert [one.phase for one in _actions(recogniser, gone)] == ["end"]


def test_thresholds_that_contradict_each_other_are_refused() -> None:
    base: GestureSettings = default_gestures()
    with pytest.raises(CalibrationError, match=r"here: pinch.end_gap_m"):
        check_actions(PinchSettings(end_gap_m=0.001), base.dial, base.tap, base.point, "here")
    with pytest.raises(CalibrationError, match=r"here: dial.open_m"):
        check_actions(base.pinch, DialSettings(open_m=0.001), base.tap, base.point, "here")


def _about(centre_m: Float, axis: Float, angle_rad: float) -> Float:
    """(4, 4) a turn about an axis through a point, by Rodrigues' formula written out."""
    k = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    rotation = np.eye(3) + np.sin(angle_rad) * k + (1.0 - np.cos(angle_rad)) * (k @ k)
    return rigid(rotation, centre_m - rotation @ centre_m)
