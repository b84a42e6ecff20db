"""Files of objects, contact, gestures and tags: what is written is read back, and what is broken is named."""

import json
from math import nan
from pathlib import Path

import numpy as np
import pytest

from common.errors import RecordingError
from common.messages import Contact, Gesture, ObjectPose, ObjectSource, ResultMessage
from master.outputs.poses import RunFiles
from master.outputs.result_files import (
    GESTURES,
    Contacts,
    ObjectPoses,
    contact_path,
    gesture_line,
    load_gesture_messages,
    object_path,
)
from master.replay.recorded import recorded_tags
from tests.master.outputs.test_outputs_files import random_pose

HAND = "default-right"


def object_pose(k: int, name: str = "cube") -> ObjectPose:
    rng = np.random.default_rng(k)
    lost, quaternion = k % 4 == 3, rng.normal(size=4)
    return ObjectPose(
        object=name,
        t_ns=2**60 + k,
        position_m=np.full(3, nan) if lost else rng.normal(size=3),
        orientation_wxyz=np.full(4, nan) if lost else quaternion / np.linalg.norm(quaternion),
        cov=rng.normal(size=(6, 6)),
        residual_m=nan if lost else float(rng.uniform()),
        source=int(ObjectSource.NONE if lost else ObjectSource.TAGS),
        tracked=not lost,
        seen=k % 5,
        expected=5,
        occluded=k % 2 == 0,
        latency_ns=k,
    )


def contact(k: int, hand: str = HAND, name: str = "cube") -> Contact:
    rng = np.random.default_rng(k)
    five = rng.normal(size=5)
    return Contact(
        hand, name, 2**60 + k, five, abs(five), rng.normal(size=(5, 3)), five > 0.0, five[0], k % 2 == 0
    )


def gesture(k: int) -> Gesture:
    known = {"distance_m": 0.004, "strength": 0.5, "origin_m": np.array([0.1, 0.2, 0.3])} if k % 2 else {}
    return Gesture(HAND, 2**60 + k, "pinch", "index", "update", 2**60, 0.25 * (k % 4), **known)  # pyright: ignore[reportArgumentType]


def written(folder: Path) -> list[ResultMessage]:
    sink = RunFiles(folder / "poses.npz", {HAND: 6, "device": 0}, ["cube"])
    results: list[ResultMessage] = []
    for k in range(9):
        results += [random_pose(k), object_pose(k), contact(k), gesture(k)]
    for one in results:
        sink.write(one)
    sink.close()
    sink.close()
    return results


def test_results_are_read_back_exactly(tmp_path: Path) -> None:
    results = written(tmp_path)
    poses, near = (
        ObjectPoses.load(object_path(tmp_path, "cube")),
        Contacts.load(contact_path(tmp_path, HAND, "cube")),
    )
    assert (poses.object, near.hand, near.object, len(poses), len(near)) == ("cube", HAND, "cube", 9, 9)
    for kind, table in ((ObjectPose, poses), (Contact, near)):
        for k, message in enumerate(one for one in results if isinstance(one, kind)):
            for field in set(kind.__struct_fields__) - {"object", "hand"}:
                np.testing.assert_array_equal(
                    getattr(table, field)[k], getattr(message, field), err_msg=field
                )
    output = load_gesture_messages(tmp_path / GESTURES)
    gestures = [one for one in results if isinstance(one, Gesture)]
    assert len(output) == len(gestures)
    for one, other in zip(output, gestures, strict=True):
        for field in Gesture.__struct_fields__:
            np.testing.assert_array_equal(getattr(one, field), getattr(other, field), err_msg=field)
    assert not contact_path(tmp_path, "device", "cube").exists(), "a wrist device alone touches nothing"


def test_the_same_run_makes_the_same_bytes(tmp_path: Path) -> None:
    first, second = tmp_path / "a", tmp_path / "b"
    for folder in (first, second):
        folder.mkdir()
        written(folder)
    names = {path.name for path in first.iterdir()}
    assert names == {
        *("poses.npz", "poses-device.npz", "object_cube.npz", f"contact_{HAND}_cube.npz", "gestures.jsonl")
    }
    for name in names:
        assert (first / name).read_bytes() == (second / name).read_bytes()


def test_a_gesture_is_a_line_that_any_program_reads() -> None:
    line = gesture_line(gesture(0))
    assert line.endswith(b"\n")
    assert line.count(b"\n") == 1
    content = json.loads(line)
    assert content["type"] == "Gesture"
    assert (content["kind"], content["distance_m"], content["origin_m"]) == ("pinch", None, [None] * 3)


def test_a_run_without_objects_or_gestures_has_an_empty_file_of_them(tmp_path: Path) -> None:
    RunFiles(tmp_path / "poses.npz", {HAND: 6}).close()
    assert {path.name for path in tmp_path.iterdir()} == {"poses.npz", "gestures.jsonl"}
    assert load_gesture_messages(tmp_path / GESTURES) == []
    RunFiles(tmp_path / "poses.npz", {HAND: 6}, ["cube"]).close()
    assert len(ObjectPoses.load(object_path(tmp_path, "cube"))) == 0


def test_what_the_files_were_not_opened_for_is_refused(tmp_path: Path) -> None:
    sink = RunFiles(tmp_path / "poses.npz", {HAND: 6}, ["cube"])
    with pytest.raises(ValueError, match="object 'wand' does not fit, opened for cube"):
        sink.write(object_pose(0, "wand"))
    with pytest.raises(ValueError, match="'another' and 'cube' does not fit"):
        sink.write(contact(0, "another"))
    sink.close()
    for one in (object_pose(0), contact(0), gesture(0)):
        with pytest.raises(ValueError, match="already closed"):
            sink.write(one)


def test_a_folder_that_is_not_there_is_said_at_once(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"cannot write: No such file .* choose another folder"):
        RunFiles(tmp_path / "none" / "poses.npz", {HAND: 6})


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        (b"{", "line 2: Input data was truncated"),
        (b"[1]", "line 2: Expected `object`"),
        (b'{"type": "Gesture"}', "line 2: Object missing required field `hand`"),
        (b'{"type": "HandPose"}', "line 2: Invalid value 'HandPose'"),
    ],
)
def test_a_broken_line_of_gestures_is_named(tmp_path: Path, line: bytes, expected: str) -> None:
    path = tmp_path / GESTURES
    path.write_bytes(gesture_line(gesture(1)) + line + b"\n")
    with pytest.raises(RecordingError, match=expected):
        load_gesture_messages(path)


def test_a_table_of_another_kind_is_named(tmp_path: Path) -> None:
    written(tmp_path)
    with pytest.raises(RecordingError, match=r"object_cube\.npz: key 'distance_m' is missing"):
        Contacts.load(object_path(tmp_path, "cube"))
    data = dict(np.load(object_path(tmp_path, "cube")))
    np.savez(tmp_path / "cut.npz", **(data | {"cov": data["cov"][:, :3]}))
    with pytest.raises(
        RecordingError, match=r"cut\.npz: cov: float64 \(9, 3, 6\), expected float64 \(9, 6, 6\)"
    ):
        ObjectPoses.load(tmp_path / "cut.npz")


def test_no_poses_of_an_object_are_a_table_without_rows() -> None:
    assert ObjectPoses.stacked([], object="cube").cov.shape == (0, 6, 6)


TAGS: dict[str, object] = {
    "t_ns": np.array([10, 20, 30]),
    "seq": np.array([0, 3, 6]),
    "ids": np.array([4, 1, 2], np.uint16),
    "uv": np.arange(24.0).reshape(3, 4, 2),
    "sigma_px": np.array([0.1, 0.2, 0.3]),
    "row": np.array([0, 0, 2]),
}


def save_tags(folder: Path, **changes: object) -> None:
    arrays = {name: array for name, array in (TAGS | changes).items() if array is not None}
    np.savez(folder / "tags_left.npz", **arrays)  # pyright: ignore[reportArgumentType]


def test_searched_frames_come_back_with_their_tags_in_order(tmp_path: Path) -> None:
    save_tags(tmp_path)
    frames = list(recorded_tags(tmp_path, "left"))
    assert [(one.seq, one.t_ns, one.ids.tolist()) for one in frames] == [
        (0, 10, [1, 4]),
        (3, 20, []),
        (6, 30, [2]),
    ]
    np.testing.assert_array_equal(frames[0].uv[0], np.arange(8.0, 16.0).reshape(4, 2))
    np.testing.assert_array_equal(frames[0].sigma_px, [0.2, 0.1])


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"row": None}, "'row' is missing"),
        ({"row": np.array([0, 0, 3])}, "row or ids: out of range"),
        ({"row": np.array([0, 0, -1])}, "row or ids: out of range"),
        ({"row": np.array([0, 0])}, r"row has shape \(2,\), expected \(3,\)"),
        ({"ids": np.array([4, 4, 2], np.uint16)}, "frame 0: ids: must rise"),
        ({"ids": np.array([4, 70000, 2])}, "row or ids: out of range"),
        ({"uv": np.zeros((3, 3, 2))}, r"uv has shape \(3, 3, 2\), expected \(3, 4, 2\)"),
        ({"uv": np.full((3, 4, 2), np.inf)}, "frame 0: uv: inf is not within"),
        ({"uv": np.full((3, 4, 2), nan)}, "frame 0: uv, sigma_px: a tag that was found"),
        ({"sigma_px": np.zeros(3)}, "frame 0: sigma_px: 0 is not within"),
        ({"t_ns": np.array([10.0, 20.0, 30.0])}, "tags_left"),
        ({"t_ns": np.array([10, 20])}, r"t_ns has shape \(2,\), expected \(3,\)"),
    ],
)
def test_tags_that_do_not_fit_are_named(tmp_path: Path, changes: dict[str, object], expected: str) -> None:
    save_tags(tmp_path, **changes)
    with pytest.raises(RecordingError, match=expected) as error:
        list(recorded_tags(tmp_path, "left"))
    assert "`phalanx-slave run -o` for camera 'left'" in str(error.value)


def test_missing_tags_say_which_command_makes_them(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"tags_left\.npz: cannot read.*phalanx-slave run -o"):
        list(recorded_tags(tmp_path, "left"))
