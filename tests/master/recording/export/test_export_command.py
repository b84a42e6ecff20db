from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rerun as rr

from common.calibration import save
from common.errors import PhalanxError, RecordingError
from common.messages import Message
from common.recording.messages import MessageWriter
from master.outputs.poses import PosesFile
from master.recording.export.bvh import Axes
from master.recording.export.run import SUFFIXES, Wanted, export, skeleton_of
from master.recording.export.take import Window
from master.recording.files import rigs_text
from tests.cli import invoke
from tests.hand_helpers import camera_file, rig_file
from tests.master.outputs.test_outputs_rerun import column
from tests.master.recording.export.made import (
    BEGIN_NS,
    LEFT,
    NEAR_M,
    RIGHT,
    STEP_NS,
    hands_tree,
    poses_of,
    positions,
    results,
)
from tests.master.recording.export.test_export_bvh import read_m
from tests.master.recording.export.test_export_tables import exported, places_of, rows_of, run_of


def recording_of(
    path: Path, messages: list[Message], tree: Path | None = None, late_ns: int = 4_000_000
) -> Path:
    """An .mcap in which each message came a little after its time."""
    files = {}
    if tree is not None:
        files = {one.relative_to(tree).as_posix(): one.read_bytes() for one in tree.rglob("*.json")}
    writer = MessageWriter(path, files, {"rigs": rigs_text(["bench"])})
    names = {"HandPose": "hand", "ObjectPose": "object", "Contact": "contact", "Gesture": "gesture"}
    for message in messages:
        writer.write(names[type(message).__name__], message, getattr(message, "t_ns") + late_ns)  # noqa: B009
    writer.close()
    return path


def bench(tree: Path) -> Path:
    """A calibration tree with the rig of the tests."""
    hands_tree(tree, RIGHT, LEFT)
    save(tree / "rigs" / "bench.json", rig_file())
    for name in ("left", "right"):
        save(tree / "cameras" / f"{name}.json", camera_file(name))
    return tree


def tree_folder(tmp_path: Path) -> Path:
    tree = tmp_path / "tree"
    for name in ("hands", "rigs", "cameras"):
        (tree / name).mkdir(parents=True)
    return bench(tree)


def test_a_recording_carries_its_hand_and_is_exported_like_a_run(tmp_path: Path) -> None:
    poses = poses_of(3, 5)
    source = recording_of(tmp_path / "wave.mcap", [*poses, *results("made-right")], tree_folder(tmp_path))
    nowhere = tmp_path / "nowhere"
    assert exported(source, Wanted("bvh", calibration=nowhere, axes=Axes("m", "rig"))) == ["wave.bvh"]
    assert np.abs(read_m(tmp_path / "wave.bvh", "m")[0] - positions(poses)).max() < NEAR_M
    names = exported(source, Wanted("csv"))
    assert names == [
        "wave.csv",
        "wave-object_cup.csv",
        "wave-contact_made-right_cup.csv",
        "wave-gestures.csv",
    ]
    rows = rows_of(tmp_path / "wave.csv")
    assert np.abs(places_of(rows) - positions(poses)).max() < NEAR_M
    assert float(rows[0]["seconds"]) == pytest.approx(-0.004)  # the recording begins with its arrival


def test_two_hands_of_a_recording_are_two_files(tmp_path: Path) -> None:
    poses = [*poses_of(3, 2), *poses_of(4, 3, LEFT)]
    source = recording_of(tmp_path / "wave.mcap", list(poses), tree_folder(tmp_path))
    assert exported(source, Wanted("gltf")) == ["wave.glb", "wave-made-left.glb"]
    assert exported(source, Wanted("gltf", tmp_path / "left.gltf", only=("made-left",))) == ["left.gltf"]


def test_a_part_of_time_is_cut_out_and_both_ends_belong_to_it(tmp_path: Path) -> None:
    poses = poses_of(3, 10)
    step = STEP_NS * 1e-9
    wanted = Wanted("csv", window=Window(2 * step, 5 * step))
    exported(run_of(tmp_path, poses, with_results=True), wanted)
    assert np.abs(places_of(rows_of(tmp_path / "poses.csv")) - positions(poses[2:6])).max() < NEAR_M
    assert rows_of(tmp_path / "poses-object_cup.csv") == []
    source = recording_of(tmp_path / "wave.mcap", list(poses), late_ns=0)
    exported(source, wanted)
    assert len(rows_of(tmp_path / "wave.csv")) == 4


def test_a_cut_recording_is_exported_up_to_the_cut_and_it_is_said(tmp_path: Path) -> None:
    source = recording_of(tmp_path / "wave.mcap", list(poses_of(3, 200)), tree_folder(tmp_path))
    data = source.read_bytes()
    source.write_bytes(data[: len(data) * 2 // 3])
    output: list[str] = []
    export(source, Wanted("csv"), output.append, lambda _what, _done, _total: None)
    assert "no end" in output[0]
    assert 0 < len(rows_of(tmp_path / "wave.csv")) < 200


def test_an_rrd_of_a_recording_knows_its_rig(tmp_path: Path) -> None:
    poses = poses_of(3, 3)
    source = recording_of(tmp_path / "wave.mcap", [*poses, *results("made-right")], tree_folder(tmp_path))
    assert exported(source, Wanted("rrd", calibration=tmp_path / "nowhere")) == ["wave.rrd"]
    times, joints = column(tmp_path / "wave.rrd", "/world/hand/made-right/joints", "positions")
    assert times == [BEGIN_NS + i * STEP_NS for i in range(3)]
    assert np.abs(np.array(joints) - positions(poses)).max() < NEAR_M
    assert len(rr.chunk.RrdReader(tmp_path / "wave.rrd").blueprints()) == 1


def test_what_lacks_is_named_with_its_mending(tmp_path: Path) -> None:
    source = run_of(tmp_path, poses_of(1, 2))
    tree = tree_folder(tmp_path)
    empty = tmp_path / "empty"
    cases = [
        (tmp_path / "none.npz", Wanted("csv"), "no such file"),
        (tmp_path, Wanted("csv"), "is a folder"),
        (source, Wanted("bvh", calibration=empty), "no profile of hand 'made-right'.*give --hand FILE"),
        (
            source,
            Wanted("bvh", profiles=(tree / "hands" / "made-left.json",), calibration=empty),
            "made-left.json is of 'made-left'",
        ),
        (source, Wanted("csv", only=("gloved",)), "--only gloved: it has made-right"),
        (source, Wanted("bvh", tmp_path / "a.fbx"), "--to bvh writes .bvh"),
        (source, Wanted("rrd", calibration=tree), "say with --rig"),
        (source, Wanted("gltf", calibration=tree, window=Window(60.0)), "none of its 0 poses is valid"),
    ]
    for path, wanted, text in cases:
        with pytest.raises(PhalanxError, match=text):
            exported(path, wanted)
    with pytest.raises(PhalanxError, match="is before --from 3"):
        Window(3.0, 2.0)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["gestures.jsonl", "poses.npz", "tree"]


def test_an_empty_run_makes_no_motion_and_leaves_no_file(tmp_path: Path) -> None:
    PosesFile(tmp_path / "poses.npz", "made-right", 6).close()
    for kind in ("bvh", "gltf"):
        with pytest.raises(PhalanxError, match="none of its 0 poses is valid"):
            exported(tmp_path / "poses.npz", Wanted(kind, calibration=tree_folder(tmp_path / kind)))
    assert not list(tmp_path.glob("*.bvh")) + list(tmp_path.glob("*.gl*"))
    silent = recording_of(tmp_path / "silent.mcap", [], tree_folder(tmp_path / "silent"))
    for kind in SUFFIXES:
        with pytest.raises(
            PhalanxError, match=r"silent.mcap: holds no poses of a hand, nothing to export as"
        ):
            exported(silent, Wanted(kind))


def test_of_two_hands_the_one_that_was_never_seen_is_said(tmp_path: Path) -> None:
    unseen = poses_of(2, 3, LEFT, valid=np.zeros((3, 26), np.bool_))
    output: list[str] = []
    wanted = Wanted("bvh", calibration=tree_folder(tmp_path))
    paths = export(run_of(tmp_path, poses_of(1, 2), unseen), wanted, output.append, lambda _w, _d, _t: None)
    assert [path.name for path in paths] == ["poses.bvh"]
    assert "made-left" in output[-1]


def test_a_profile_is_found_by_its_name_whatever_its_file_is_called(tmp_path: Path) -> None:
    tree = tree_folder(tmp_path)
    (tree / "hands" / "made-right.json").rename(tree / "hands" / "me.json")
    assert skeleton_of("made-right", tree, ()).side == "right"


def test_a_name_that_is_a_path_is_refused(tmp_path: Path) -> None:
    source = run_of(tmp_path, poses_of(1, 2))
    with np.load(source) as file:
        arrays: dict[str, Any] = dict(file)
    for name in ("../evil", "", "a/b"):
        arrays["hand"] = np.array(name)
        np.savez(source, **arrays)
        for wanted in (Wanted("csv", tmp_path / "out"), Wanted("bvh", tmp_path / "out")):
            with pytest.raises(RecordingError, match="is no name of a hand"):
                exported(source, wanted)


def test_a_failed_export_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source, tree = run_of(tmp_path, poses_of(1, 2)), tree_folder(tmp_path)
    exported(source, Wanted("bvh", calibration=tree))
    before = (tmp_path / "poses.bvh").read_bytes()

    def full(*_args: object, **_more: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savetxt", full)
    with pytest.raises(PhalanxError, match=r"poses.bvh: cannot write: No space left"):
        exported(source, Wanted("bvh", calibration=tree))
    assert (tmp_path / "poses.bvh").read_bytes() == before
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


def test_the_command_line_writes_and_refuses_options_of_other_formats(tmp_path: Path) -> None:
    source, tree = run_of(tmp_path, poses_of(1, 2)), tree_folder(tmp_path)
    arguments = [
        str(source),
        "--to",
        "bvh",
        "--calibration",
        str(tree),
        "--rate",
        "30",
        "--unit",
        "mm",
        "--from",
        "0",
    ]
    done = invoke("export", *arguments)
    assert done.exit_code == 0, done.output
    assert "1 frames at 30 Hz" in done.output
    for option in (["--from", "nan"], ["--until", "inf"]):
        wrong = invoke("export", source, "--to", "bvh", "--calibration", tree, *option)
        assert wrong.exit_code == 2
        assert f"{option[0]}: {option[1]}: must be a finite number" in wrong.output
    for option in (["--rate", "30"], ["--unit", "mm"], ["--up", "rig"], ["--rig", "bench"]):
        with pytest.raises(PhalanxError, match=option[0]):
            invoke("export", source, "--to", "csv", *option)
