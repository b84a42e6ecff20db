import csv
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow.parquet
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.hand.model import FINGERS, JOINTS
from common.messages import Contact, Gesture, HandPose, ObjectPose
from master.outputs.poses import Poses, PosesFile, RunFiles
from master.outputs.result_files import Contacts, ObjectPoses
from master.recording.export.run import Wanted, export
from master.recording.export.table import (
    Column,
    contact_columns,
    gesture_columns,
    hand_columns,
    object_columns,
)
from tests.master.recording.export.made import BEGIN_NS, LEFT, NEAR_M, STEP_NS, poses_of, positions, results


def run_of(folder: Path, *hands: Sequence[HandPose], with_results: bool = False) -> Path:
    """The files of a run."""
    path = folder / "poses.npz"
    names = [poses[0].hand for poses in hands]
    files = RunFiles(path, dict.fromkeys(names, 6), ["cup"] if with_results else [])
    for poses in hands:
        for pose in poses:
            files.write(pose)
    for message in results(names[0]) if with_results else ():
        files.write(message)
    files.close()
    return path


def exported(source: Path, wanted: Wanted) -> list[str]:
    """Names of the files, in the order of writing."""
    paths = export(source, wanted, lambda _line: None, lambda _what, _done, _total: None)
    return [path.name for path in paths]


def rows_of(path: Path) -> list[dict[str, str]]:
    """As a spreadsheet reads it."""
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def places_of(rows: list[dict[str, str]]) -> np.ndarray:
    names = [f"{joint.replace('-', '_')}_{axis}_m" for joint in JOINTS for axis in "xyz"]
    return np.array([[float(row[name] or "nan") for name in names] for row in rows]).reshape(-1, 26, 3)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=4)
def test_positions_read_back_are_those_of_the_poses(
    tmp_path_factory: pytest.TempPathFactory, seed: int
) -> None:
    folder, poses = tmp_path_factory.mktemp("csv"), poses_of(seed, 3)
    source = run_of(folder, poses)
    for kind in ("csv", "parquet"):
        assert exported(source, Wanted(kind))[0] == f"poses.{kind}"
    assert np.abs(places_of(rows_of(folder / "poses.csv")) - positions(poses)).max() < NEAR_M
    table = pyarrow.parquet.read_table(folder / "poses.parquet").to_pydict()
    found = [table[f"{joint.replace('-', '_')}_x_m"] for joint in JOINTS]
    assert np.abs(np.array(found).T - positions(poses)[..., 0]).max() < NEAR_M


def test_a_row_says_what_the_pose_says_and_is_empty_where_nothing_was_observed(tmp_path: Path) -> None:
    valid = np.ones((2, 26), np.bool_)
    valid[1, 5] = False
    exported(run_of(tmp_path, poses_of(1, 2, valid=valid)), Wanted("csv"))
    first, second = rows_of(tmp_path / "poses.csv")
    assert int(first["t_ns"]) == BEGIN_NS
    assert float(second["seconds"]) == pytest.approx(STEP_NS * 1e-9)
    assert (first["thumb_tip_valid"], second["thumb_tip_valid"]) == ("true", "false")
    assert second["thumb_tip_x_m"] == ""
    assert second["index_finger_tip_x_m"] != ""
    assert float(first["thumb_tip_sigma_m"]) == pytest.approx(np.sqrt(3e-6))  # the mean of 1, 4 and 4 mm^2
    assert first["thumb_tip_source"] == "solved"
    assert float(first["thumb_ip_rad"]) == 0.1
    assert first["wrist_flexion_rad"] == ""


def test_every_result_of_a_run_has_its_table(tmp_path: Path) -> None:
    source = run_of(tmp_path, poses_of(1, 1), with_results=True)
    names = exported(source, Wanted("csv", tmp_path / "tables" / "wave.csv"))
    assert names == [
        "wave.csv",
        "wave-object_cup.csv",
        "wave-contact_made-right_cup.csv",
        "wave-gestures.csv",
    ]
    (cup,) = rows_of(tmp_path / "tables" / "wave-object_cup.csv")
    assert (cup["x_m"], cup["source"], cup["occluded"]) == ("", "none", "true")
    (touch,) = rows_of(tmp_path / "tables" / "wave-contact_made-right_cup.csv")
    assert (touch["index_distance_m"], touch["middle_distance_m"]) == ("-0.001", "")
    (pinch,) = rows_of(tmp_path / "tables" / "wave-gestures.csv")
    assert (pinch["kind"], pinch["name"], pinch["confidence"], pinch["angle_rad"]) == (
        "pinch",
        "index",
        "0.75",
        "",
    )


def test_two_hands_are_two_tables_and_one_may_be_chosen(tmp_path: Path) -> None:
    right, left = poses_of(1, 2), poses_of(2, 3, LEFT)
    source = run_of(tmp_path, right, left)
    assert exported(source, Wanted("csv")) == ["poses.csv", "poses-made-left.csv"]
    assert len(rows_of(tmp_path / "poses-made-left.csv")) == 3
    assert exported(source, Wanted("csv", tmp_path / "one", only=("made-left",))) == ["poses.csv"]
    assert np.abs(places_of(rows_of(tmp_path / "one" / "poses.csv")) - positions(left)).max() < NEAR_M


def test_a_run_without_poses_is_a_table_without_rows(tmp_path: Path) -> None:
    PosesFile(tmp_path / "poses.npz", "made-right", 6).close()
    for kind in ("csv", "parquet"):
        exported(tmp_path / "poses.npz", Wanted(kind))
    assert rows_of(tmp_path / "poses.csv") == []
    header = (tmp_path / "poses.csv").read_text().replace('"', "").strip().split(",")
    table = pyarrow.parquet.read_table(tmp_path / "poses.parquet")
    assert table.num_rows == 0
    assert table.column_names == header


def test_parquet_says_unit_and_frame_of_its_columns(tmp_path: Path) -> None:
    exported(run_of(tmp_path, poses_of(1, 1)), Wanted("parquet"))
    schema = pyarrow.parquet.read_schema(tmp_path / "poses.parquet")
    about = {key.decode(): value.decode() for key, value in schema.field("wrist_x_m").metadata.items()}
    assert (about["unit"], about["frame"]) == ("m", "rig")
    assert schema.metadata[b"table"] == b"hand made-right"
    assert schema.metadata[b"begin_t_ns"] == str(BEGIN_NS).encode()


def all_columns(tmp_path: Path) -> list[list[Column]]:
    source = run_of(tmp_path, poses_of(1, 1), with_results=True)
    cup, _, pinch = results("made-right")
    assert isinstance(cup, ObjectPose)
    assert isinstance(pinch, Gesture)
    return [
        hand_columns(Poses.of(poses_of(1, 1)), BEGIN_NS),
        object_columns(ObjectPoses.stacked([cup], object="cup"), BEGIN_NS),
        contact_columns(Contacts.load(source.parent / "contact_made-right_cup.npz"), BEGIN_NS),
        gesture_columns([pinch], BEGIN_NS),
    ]


def test_a_name_is_there_once_and_ends_with_its_unit(tmp_path: Path) -> None:
    for columns in all_columns(tmp_path):
        names = [one.name for one in columns]
        assert len(set(names)) == len(names)
        for one in columns:
            assert one.text, one.name
            if one.unit and one.name != "seconds":
                assert one.name.endswith(f"_{one.unit}"), one.name


def test_the_page_names_every_column(tmp_path: Path, root: Path) -> None:
    page = (root / "docs" / "export.md").read_text()
    words = set(re.findall(r"`(\w+)`", page))
    for mark, names in (("JOINT", [name.replace("-", "_") for name in JOINTS]), ("FINGER", FINGERS)):
        words |= {word.replace(mark, name) for word in words if mark in word for name in names}
    tables = all_columns(tmp_path)
    assert f"{len(tables[0])} columns" in page
    for columns in tables:
        assert {one.name for one in columns} <= words


def test_every_field_of_a_result_has_a_column(tmp_path: Path) -> None:
    _, cup, touch, pinch = (" ".join(one.name for one in columns) for columns in all_columns(tmp_path))
    for kind, shown, other in (
        (ObjectPose, cup, {"object", "position_m", "orientation_wxyz", "cov"}),
        (Contact, touch, {"hand", "object", "point_m"}),
        (Gesture, pinch, {"origin_m"}),
    ):
        for name in set(kind.__struct_fields__) - other:
            assert name in shown, name
