"""Tests of the offline line: files in, the same bytes out on every run, errors that name the file."""

import json
from pathlib import Path

import msgspec
import numpy as np
import pytest

from common.errors import RecordingError
from common.recording.frame_recording import FrameRecording, Manifest
from master.commands.summary import read_summary, write_summary
from master.outputs.poses import Poses
from master.replay.offline import fingers_of, solve
from tests.hand_helpers import MARKERS, RIGHT
from tests.synthetic_run import SyntheticRun, hand_at, synthetic_run


@pytest.fixture(scope="module")
def short_run() -> SyntheticRun:
    return synthetic_run(10)


def write_detections(folder: Path, run: SyntheticRun, **changes: object) -> None:
    for camera in run.setup.rig.cameras:
        own = [m for m in run.messages if m.camera == camera]
        data = {
            "t_ns": np.array([m.t_ns for m in own]),
            "seq": np.array([m.seq for m in own]),
            "uv": np.array([m.uv for m in own]),
            "area_px2": np.array([m.area for m in own]),
            "quality": np.array([m.quality for m in own]),
            "sigma_px": np.array([m.sigma_px for m in own]),
            "alt_uv": np.array([m.alt_uv for m in own]),
        } | changes
        np.savez(folder / f"detections_{camera}.npz", **{k: v for k, v in data.items() if v is not None})  # pyright: ignore[reportArgumentType]


def recording(folder: Path, run: SyntheticRun) -> FrameRecording:
    manifest = Manifest(version=1, kind="markers", cameras=run.setup.cameras, rig=run.setup.rig)
    return FrameRecording(folder, manifest, ())


def write_truth(folder: Path, run: SyntheticRun) -> None:
    times = [m.t_ns + round(239.5 * 20.6e3) for m in run.messages if m.camera == "left"]
    joints = [hand_at(t * 1e-9) for t in times]
    np.savez(
        folder / "truth.npz",
        t_ref=np.array(times) * 1e-9 - 1.0,
        joints=np.array([j.position_m[1:] for j in joints]),
        angles=np.zeros((len(times), 21)),
        paint_centroid=np.array([RIGHT.marker_points(j, MARKERS) for j in joints]),
        frac=np.ones((len(times), 2, 6)),
    )


def test_a_run_is_written_scored_and_repeated_byte_by_byte(tmp_path: Path, short_run: SyntheticRun) -> None:
    write_detections(tmp_path, short_run)
    write_truth(tmp_path, short_run)
    progress: list[tuple[int, int]] = []
    outs = [tmp_path / "first", tmp_path / "second"]
    summary: dict[str, object] = {}
    for out in outs:
        out.mkdir()
        opened = recording(tmp_path, short_run)
        summary = solve(opened, [short_run.setup], tmp_path, out, lambda d, t: progress.append((d, t)))
    assert (outs[0] / "poses.npz").read_bytes() == (outs[1] / "poses.npz").read_bytes()
    assert progress[:20] == [(k, 20) for k in range(1, 21)]
    poses = Poses.load(outs[0] / "poses.npz")
    assert len(poses) == summary["poses"] == summary["poses_valid"] == 10
    assert (poses.latency_ns == 0).all()
    stored = json.loads((outs[1] / "summary.json").read_text())
    assert stored == json.loads(json.dumps(summary))
    # The names that other tools rely on; numbers only.
    for key in ("marker_mm", "joint_mm", "joint_mm_visible", "pip_deg", "pip_deg_visible"):
        assert isinstance(stored[key], float)
    assert stored["joint_mm"] < 6.0
    assert stored["marker_mm"] < 3.0
    assert set(stored["stage_us"]) == {"frame_sync", "triangulate", "filter", "fabrik", "hand", "gestures"}
    assert stored["counts"]["poses"] == 10


def test_frames_lost_before_they_were_recorded_are_counted(tmp_path: Path, short_run: SyntheticRun) -> None:
    first = next(m.seq for m in short_run.messages if m.camera == "left")
    gaps = np.array([first + k + (2 if k >= 4 else 0) + (k >= 7) for k in range(10)])
    write_detections(tmp_path, short_run, seq=gaps)
    summary = solve(recording(tmp_path, short_run), [short_run.setup], tmp_path, tmp_path)
    assert summary["lost"] == 6  # three of each camera


def test_without_a_truth_there_are_no_scores(tmp_path: Path, short_run: SyntheticRun) -> None:
    write_detections(tmp_path, short_run)
    summary = solve(recording(tmp_path, short_run), [short_run.setup], tmp_path, tmp_path)
    assert "joint_mm" not in summary
    assert "marker_mm" not in summary


def test_files_without_sigma_and_rivals_are_solved_with_a_sigma_from_their_quality(
    tmp_path: Path, short_run: SyntheticRun
) -> None:
    clear, old = tmp_path / "clear", tmp_path / "old"
    poses: list[Poses] = []
    for folder in (clear, old):
        folder.mkdir()
        rejected = {"sigma_px": None, "alt_uv": None} if folder is old else {}
        write_detections(folder, short_run, **rejected)
        solve(recording(folder, short_run), [short_run.setup], folder, folder)
        poses.append(Poses.load(folder / "poses.npz"))
    # The run's markers are of full quality and state the 0.1 px that is the default for those.
    np.testing.assert_array_equal(poses[0].cov_m2, poses[1].cov_m2)
    write_detections(old, short_run, sigma_px=None, alt_uv=None, quality=np.full((10, 6), np.nan))
    solve(recording(old, short_run), [short_run.setup], old, old)
    unknown = Poses.load(old / "poses.npz")
    assert np.trace(unknown.cov_m2[5, 10]) > 2.0 * np.trace(poses[0].cov_m2[5, 10])  # the index's tip


def test_no_detections_at_all_are_no_poses(tmp_path: Path, short_run: SyntheticRun) -> None:
    empty = {
        "t_ns": np.zeros(0, np.int64),
        "seq": np.zeros(0, np.int64),
        "uv": np.zeros((0, 6, 2)),
        "area_px2": np.zeros((0, 6)),
        "quality": np.zeros((0, 6)),
        "sigma_px": np.zeros((0, 6)),
        "alt_uv": np.zeros((0, 6, 2)),
    }
    write_detections(tmp_path, short_run, **empty)
    summary = solve(recording(tmp_path, short_run), [short_run.setup], tmp_path, tmp_path)
    assert summary["poses"] == 0
    assert len(Poses.load(tmp_path / "poses.npz")) == 0


def test_a_missing_file_says_which_command_makes_it(tmp_path: Path, short_run: SyntheticRun) -> None:
    write_detections(tmp_path, short_run)
    (tmp_path / "detections_right.npz").unlink()
    with pytest.raises(
        RecordingError, match=r"detections_right\.npz.*`phalanx-slave run -o` for camera 'right'"
    ):
        solve(recording(tmp_path, short_run), [short_run.setup], tmp_path, tmp_path)


@pytest.mark.parametrize("keep", [0, 1, 100, 2000])
def test_a_cut_file_is_named(tmp_path: Path, short_run: SyntheticRun, keep: int) -> None:
    write_detections(tmp_path, short_run)
    path = tmp_path / "detections_left.npz"
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(RecordingError, match=r"detections_left\.npz"):
        solve(recording(tmp_path, short_run), [short_run.setup], tmp_path, tmp_path)


BROKEN: dict[str, tuple[dict[str, object], str]] = {
    "no uv": ({"uv": None}, "'uv' is missing"),
    "five markers": ({"uv": np.zeros((10, 5, 2))}, r"\(10, 5, 2\), expected \(10, 6, 2\)"),
    "too few areas": ({"area_px2": np.zeros((9, 6))}, "detections_left"),
    "text": ({"uv": np.full((10, 6, 2), "x")}, "detections_left"),
    "times of two axes": ({"t_ns": np.zeros((10, 2), np.int64)}, "t_ns has shape"),
    "times in seconds": ({"t_ns": np.zeros(10)}, "detections_left"),
    "too few sigmas": ({"sigma_px": np.ones((10, 5))}, r"sigma_px has shape \(10, 5\)"),
    "no sigma where one is seen": (
        {"sigma_px": np.full((10, 6), np.nan)},
        "row 0: sigma_px: must be positive",
    ),
    "a sigma of zero": ({"sigma_px": np.zeros((10, 6))}, "row 0: sigma_px: 0 is not within"),
    "rivals of five": ({"alt_uv": np.zeros((10, 5, 2))}, r"\(10, 5, 2\), expected \(10, 6, 2\)"),
    "infinitely far": ({"uv": np.full((10, 6, 2), np.inf)}, "row 0: uv: inf is not within"),
    "fewer numbers than times": ({"seq": np.zeros(3, np.int64)}, "t_ns has shape"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_arrays_that_do_not_fit_are_named(tmp_path: Path, short_run: SyntheticRun, case: str) -> None:
    changes, text = BROKEN[case]
    write_detections(tmp_path, short_run, **changes)
    with pytest.raises(RecordingError, match=text) as error:
        solve(recording(tmp_path, short_run), [short_run.setup], tmp_path, tmp_path)
    assert "detections_left.npz" in str(error.value)


def test_fingers_of_markers(short_run: SyntheticRun) -> None:
    assert fingers_of(short_run.setup) == (0, 1, 2, 3, 4, -1)


def test_unrelated_frames_are_solved_without_memory(tmp_path: Path, short_run: SyntheticRun) -> None:
    write_detections(tmp_path, short_run)
    related = recording(tmp_path, short_run)
    manifest = msgspec.structs.replace(related.manifest, continuous=False)
    solve(FrameRecording(tmp_path, manifest, ()), [short_run.setup], tmp_path, tmp_path)
    poses = Poses.load(tmp_path / "poses.npz")
    np.testing.assert_array_equal(poses.markers_m, poses.markers_raw_m)


def test_summaries_are_json_objects(tmp_path: Path) -> None:
    path = tmp_path / "summary.json"
    write_summary(path, {"poses": 3, "counts": {"a": 1}})
    assert read_summary(path) == {"poses": 3, "counts": {"a": 1}}
    for content in (b"[1]", b"{", b"\xff", b""):
        path.write_bytes(content)
        with pytest.raises(RecordingError, match=r"summary\.json"):
            read_summary(path)
    with pytest.raises(RecordingError, match="cannot write"):
        write_summary(tmp_path / "nowhere" / "summary.json", {})
