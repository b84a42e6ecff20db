"""Tests of rigs that are run together: several of one hand become one setup, and one of two hands becomes two."""

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from common.arrays import Float
from common.calibration import (
    HandProfile,
    ImuCalibration,
    Provenance,
    RigCalibration,
    Volume,
    load,
    parse,
    save,
)
from common.errors import CalibrationError
from common.geometry.transforms import axis_rotation, matrix_to_quaternion, rigid
from common.hand.model import HandModel
from common.hand.profiles import generated_profile
from common.messages import MarkerDetections
from master.rig.pipeline import build_pipeline
from master.rig.setup import RigSetup, load_setup, load_setups, setups_of
from master.run.app import StageTimes
from tests.hand_helpers import RIGHT, camera_file, detections, rig_file

ASIDE = rigid(axis_rotation(1, 1.2), np.array([0.4, 0.0, 0.3]))
STILL = (1.0, 0.0, 0.0, 0.0)


def rows(pose: Float) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(float(v) for v in row) for row in pose)


def setup_of(rig: RigCalibration, hand: HandModel = RIGHT) -> RigSetup:
    return RigSetup.of(rig, {name: camera_file(name) for name in rig.cameras}, hand)


def aside(**changes: object) -> RigSetup:
    """A second pair of cameras, elsewhere."""
    return setup_of(rig_file(("left2", "right2"), **{"name": "side", "T_world_rig": rows(ASIDE)} | changes))


@pytest.fixture
def bench() -> RigSetup:
    return setup_of(rig_file())


@pytest.fixture
def wrist(root: Path) -> RigSetup:
    """The shipped wrist device, worn by the made hand."""
    shipped = load_setup(root / "calib_json", "wrist")
    return RigSetup.of(shipped.rig, shipped.cameras, RIGHT)


def test_two_pairs_and_a_wrist_device_of_one_hand_are_one_setup(bench: RigSetup, wrist: RigSetup) -> None:
    both = RigSetup.joined([wrist, bench, aside()])
    assert both.camera_names == ("left", "right", "left2", "right2", "wrist")
    assert both.wrist_cameras == ("wrist",)
    assert both.wrist_rig is wrist.rig
    assert both.wrist is wrist.wrist
    assert both.imus == ("imu",)
    assert both.markers == bench.markers
    assert tuple(both.models) == both.rig.cameras == both.camera_names[:4]
    for name, pose in (("right", np.eye(4)), ("right2", ASIDE)):
        expected = pose @ bench.rig.camera_pose("right")
        np.testing.assert_allclose(both.models[name].T_rig_camera, expected, atol=1e-12)
    assert build_pipeline(both, StageTimes()).markers == bench.markers


def test_a_setup_alone_stays_as_it_is_but_in_the_shared_frame(bench: RigSetup, wrist: RigSetup) -> None:
    assert RigSetup.joined([bench]).rig is bench.rig
    assert RigSetup.joined([wrist]) is wrist
    alone = RigSetup.joined([aside()])
    np.testing.assert_allclose(alone.models["left2"].T_rig_camera, ASIDE, atol=1e-12)
    np.testing.assert_allclose(alone.rig.camera_pose("left2"), ASIDE, atol=1e-12)


def test_what_lies_in_the_frame_of_a_rig_moves_with_it() -> None:
    volume = Volume(low_m=(0.0, 0.0, 0.4), high_m=(0.1, 0.2, 0.8))
    imu = ImuCalibration(q_palm_imu=STILL, q_rig_world=STILL)
    shifted = rigid(np.eye(3), np.array([0.1, 0.0, 0.0]))
    moved = RigSetup.joined([aside(volume=volume, imu=imu, T_world_rig=rows(shifted))]).rig
    assert moved.volume is not None
    np.testing.assert_allclose((moved.volume.low_m, moved.volume.high_m), [(0.1, 0.0, 0.4), (0.2, 0.2, 0.8)])
    rotated = RigSetup.joined([aside(volume=volume, imu=imu)]).rig
    assert rotated.volume is None, "a box that stands askew is none along the axes"
    assert rotated.imu is not None
    assert rotated.imu.q_rig_world is not None
    np.testing.assert_allclose(np.abs(matrix_to_quaternion(ASIDE[:3, :3]) @ rotated.imu.q_rig_world), 1.0)


def test_cameras_together_are_placed_as_well_as_the_worst(bench: RigSetup) -> None:
    def measured(rms_px: float) -> dict[str, Provenance]:
        one = Provenance(date="2026-01-01T00:00:00Z", tool="t", data=(), residual={"rms_px": rms_px})
        return {"T_rig_camera": one}

    good = setup_of(rig_file(provenance=measured(0.1)))
    joined = RigSetup.joined([good, aside(provenance=measured(0.3))]).rig
    assert joined.provenance["T_rig_camera"].residual == {"rms_px": 0.3}


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"markers": ("thumb", "index", "back")}, "'bench' and 'side': markers: differ"),
        ({"frame_sync": "predict"}, "'bench' and 'side': frame_sync: differ"),
        ({"solver": "fabrik"}, "'bench' and 'side': solver: differ"),
        (
            {"T_world_rig": None},
            r"'bench' and 'side' in one frame \(T_world_rig\): T_rig_camera\.left2: 0 mm from",
        ),
    ],
)
def test_marker_rigs_that_contradict_each_other_are_refused(
    changes: dict[str, object], expected: str, bench: RigSetup
) -> None:
    with pytest.raises(CalibrationError, match=expected):
        RigSetup.joined([bench, aside(**changes)])


def test_rigs_together_triangulate_whatever_law_each_has(bench: RigSetup) -> None:
    law: dict[str, Any] = {"depth_model": "power_law", "power_law": {"k_m": 37.5, "z": -1.0}}
    for first, second in ((bench, aside(**law)), (setup_of(rig_file(**law)), aside())):
        both = RigSetup.joined([first, second])
        assert both.rig.depth_model == "stereo"
        assert build_pipeline(both, StageTimes()).markers == bench.markers


def test_what_a_hand_has_once_is_claimed_once(bench: RigSetup, wrist: RigSetup) -> None:
    with pytest.raises(CalibrationError, match="'bench' and 'bench' both have 'left'"):
        RigSetup.joined([bench, bench])
    left = HandModel.of(generated_profile("made-left", "left"))
    with pytest.raises(CalibrationError, match="different hands, 'made-right' and 'made-left'"):
        RigSetup.joined([bench, setup_of(rig_file(("left2", "right2")), left)])
    with pytest.raises(CalibrationError, match=r"'wrist' and 'wrist' are both .* one wrist device"):
        RigSetup.joined([wrist, wrist])
    palm = setup_of(rig_file(imu=ImuCalibration(name="palm")))
    with pytest.raises(CalibrationError, match="'bench' and 'wrist' both have an IMU"):
        RigSetup.joined([palm, wrist])


TWO = ("thumb", "index", "l-thumb", "l-back", "cube")


def left_hand() -> HandProfile:
    """A left hand whose markers have names of their own."""
    made = generated_profile("made-left", "left")
    markers = {f"l-{name}": mount for name, mount in made.markers.items()}
    return msgspec.structs.replace(made, markers=markers)


def two_hands(**changes: object) -> RigCalibration:
    values: dict[str, object] = {"markers": TWO, "free_markers": ("cube",), "other_hands": ("made-left",)}
    return msgspec.structs.replace(rig_file(), **(values | changes))


def setups(*rigs: RigCalibration) -> tuple[RigSetup, ...]:
    hands = {"made-right": RIGHT, "made-left": HandModel.of(left_hand())}
    cameras = {name: camera_file(name) for rig in rigs for name in rig.cameras}
    return setups_of(rigs, cameras, hands.__getitem__)


def test_a_rig_that_watches_two_hands_is_a_setup_for_each() -> None:
    right, left = setups(two_hands())
    assert (right.hand.profile.side, left.hand.profile.side) == ("right", "left")
    assert (right.markers, left.markers) == (("thumb", "index", "cube"), ("l-thumb", "l-back"))
    assert (right.hand_markers, left.hand_markers) == (("thumb", "index"), ("l-thumb", "l-back"))
    assert right.camera_names == left.camera_names
    uv = np.arange(10.0).reshape(5, 2)
    message = detections("left", 0, 0, uv)
    for setup, own in ((right, [0, 1, 4]), (left, [2, 3])):
        seen = setup.own(message)
        assert isinstance(seen, MarkerDetections)
        np.testing.assert_array_equal(seen.uv, uv[own])


def test_each_hand_keeps_the_rows_of_the_rigs_that_it_shares() -> None:
    side = rig_file(("left2", "right2"), name="side", markers=TWO[:2], T_world_rig=rows(ASIDE))
    right, left = setups(two_hands(free_markers=(), markers=TWO[:4]), side)
    assert right.camera_names == ("left", "right", "left2", "right2")
    assert left.camera_names == ("left", "right")
    theirs = detections("left2", 0, 0, np.zeros((2, 2)))
    assert right.own(theirs) is theirs


def test_a_marker_is_of_one_hand() -> None:
    with pytest.raises(CalibrationError, match="'stick' is mounted by none of made-right, made-left"):
        setups(two_hands(markers=("thumb", "stick", "l-thumb"), free_markers=()))
    with pytest.raises(CalibrationError, match="'made-left' mounts none of its markers"):
        setups(two_hands(markers=("thumb", "cube")))
    both = {"made-right": RIGHT, "made-left": HandModel.of(generated_profile("made-left", "left"))}
    cameras = {name: camera_file(name) for name in ("left", "right")}
    with pytest.raises(CalibrationError, match="'thumb' is mounted by made-right and made-left"):
        setups_of([two_hands()], cameras, both.__getitem__)
    with pytest.raises(CalibrationError, match="it watches 2 hands, this needs a rig of one"):
        setup_of(two_hands())


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"other_hands": ("made-right",)}, "other_hands: a hand stands twice"),
        ({"T_world_rig": rows(2.0 * np.eye(4))}, "T_world_rig: upper left 3x3 is not a rotation"),
        ({"kind": "wrist", "cameras": ("left",), "other_hands": ("l",)}, "other_hands: of marker rigs"),
        ({"kind": "wrist", "cameras": ("left",), "T_world_rig": rows(ASIDE)}, "T_world_rig: of marker rigs"),
    ],
)
def test_a_rig_file_that_contradicts_itself_is_refused(changes: dict[str, object], expected: str) -> None:
    raw = msgspec.json.encode(msgspec.structs.replace(rig_file(), **changes))
    with pytest.raises(CalibrationError, match=expected):
        parse(raw, RigCalibration, "rig.json")


def test_rigs_of_a_tree_are_set_up_by_hand(root: Path, tmp_path: Path) -> None:
    tree = root / "calib_json"
    (both,) = load_setups(tree, ("wrist", "desk"))
    assert both.camera_names == ("left", "right", "wrist")
    assert both.hand.profile.name == "default-right"
    with pytest.raises(CalibrationError, match="'wrist' and 'wrist-left' both have 'wrist'"):
        load_setups(tree, ("wrist", "wrist-left"))
    other = tmp_path / "other.json"
    save(other, generated_profile("other", "right"))
    assert load_setups(tree, ("desk", "wrist"), other)[0].hand.profile.name == "other"
    with pytest.raises(CalibrationError, match=r"other\.json: is one hand; .* default-right, default-left"):
        load_setups(tree, ("desk", "wrist-left"), other)


def test_the_rigs_of_two_hands_of_a_tree_are_two_setups(root: Path) -> None:
    tree = root / "calib_json"
    right, left = load_setups(tree, ("desk", "wrist-left"))
    assert (right.camera_names, left.camera_names) == (("left", "right"), ("wrist",))
    assert load(tree / "rigs/desk.json", RigCalibration) == right.rig
