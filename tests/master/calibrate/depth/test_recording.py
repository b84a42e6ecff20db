"""Sweeps from tables and recordings: pairing by time, stretches at rest, distances, and what a user gets wrong."""

import csv
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from common.arrays import Float
from common.errors import CalibrationError, RecordingError
from common.recording.frame_recording import FrameRecording, open_recording
from common.recording.recorded_files import write_npz
from master.calibrate.depth.source import Pairs, by_file, by_list, by_truth, pair_of, read_pairs, still_runs
from master.calibrate.depth.sweep import Sweep, parse_distances, read_table, write_table
from master.fabrik.depth import AffineDisparity

CAMERAS = ("left", "right")
NAMES = ("thumb", "index", "middle", "ring", "little", "back")
RIG = AffineDisparity(37.3, 2.64)
EYE = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]


def recording(folder: Path, t_ns: Sequence[int], late_ns: int = 0) -> FrameRecording:
    """A manifest and a frame table; the images are not looked at."""
    camera = {
        "version": 1, "width_px": 640, "height_px": 480, "frame_rate_hz": 30.0, "exposure_us": 5000,
        "analogue_gain": 1.0, "colour_gains": [1.0, 1.0], "row_time_us": 0.0,
    }  # fmt: skip
    rig = {
        "version": 1, "name": "desk", "kind": "markers", "cameras": CAMERAS, "hand": "h", "markers": NAMES,
        "T_rig_camera": {"left": EYE, "right": [[1, 0, 0, 0.075], *EYE[1:]]},
    }  # fmt: skip
    folder.mkdir()
    cameras = {name: camera | {"name": name} for name in CAMERAS}
    manifest = {"version": 1, "kind": "markers", "cameras": cameras, "rig": rig}
    (folder / "recording.json").write_text(json.dumps(manifest))
    with (folder / "frames.csv").open("w", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(["camera", "seq", "t_ns", "illumination", "file"])
        for i, t in enumerate(t_ns):
            table.writerow(["left", i, t, "none", f"left/{i}.png"])
            table.writerow(["right", i, t + late_ns, "none", f"right/{i}.png"])
    return open_recording(folder)


def detections(
    folder: Path, t_ns: Sequence[int], disparity: Float, late_ns: int = 0, marker: int = 1
) -> Path:
    """detections_<camera>.npz of one marker half way between the cameras."""
    for camera, side, late in (("left", 0.5, 0), ("right", -0.5, late_ns)):
        n = len(t_ns)
        uv, one = np.full((n, 6, 2), np.nan), np.full((n, 6), np.nan)
        uv[:, marker] = np.stack([319.5 + side * disparity, np.full(n, 239.5)], axis=1)
        one[:, marker] = 1.0
        times = np.array(t_ns, np.int64) + late
        write_npz(
            folder / f"detections_{camera}.npz",
            {
                "t_ns": times, "seq": np.arange(n), "uv": uv, "area_px2": 900 * one, "quality": one,
                "sigma_px": 0.06 * one,
            },
        )  # fmt: skip
    return folder


def process_noise(
    distances: Sequence[float], stand: int, move: int, noise: float = 0.05
) -> tuple[list[int], Float]:
    """Times (30 Hz) and disparities of a target that stands `stand` frames at each distance and then moves on."""
    rng = np.random.default_rng(1)
    parts: list[Float] = []
    for k, d in enumerate(distances):
        parts.append(np.full(stand, d))
        if k + 1 < len(distances):
            parts.append(np.linspace(d, distances[k + 1], move + 2)[1:-1])
    disparity = RIG.disparity(np.concatenate(parts))
    return [k * 33_333_333 for k in range(disparity.size)], disparity + rng.normal(0, noise, disparity.size)


def test_frames_are_paired_by_time_whatever_their_counters_say(tmp_path: Path) -> None:
    t, x = process_noise([1.0, 0.5], 20, 5)
    opened = recording(tmp_path / "r", t, 12_000_000)
    detections(tmp_path, t, x, 12_000_000)
    pairs, target = read_pairs(opened, tmp_path, CAMERAS, None)
    assert target == "index"
    assert pairs.t_ns.tolist() == t
    assert pairs.uv[0, :, 0] - pairs.uv[1, :, 0] == pytest.approx(x)


def test_frames_that_belong_to_no_other_are_left_out_or_refused(tmp_path: Path) -> None:
    t, x = process_noise([1.0], 20, 0)
    opened = recording(tmp_path / "r", t)
    detections(tmp_path, t, x, 10_000_000_000)
    with pytest.raises(RecordingError, match=r"no frame of 'right' lies within 16\.7 ms"):
        read_pairs(opened, tmp_path, CAMERAS, None)
    detections(tmp_path, t, x, 10 * 33_333_333)
    pairs, _ = read_pairs(opened, tmp_path, CAMERAS, "index")
    assert pairs.t_ns.size == 10


def test_the_target_must_be_named_where_there_are_several(tmp_path: Path) -> None:
    t, x = process_noise([1.0], 20, 0)
    opened = recording(tmp_path / "r", t)
    detections(tmp_path, t, x)
    with pytest.raises(CalibrationError, match=r"'nose'.*thumb, index"):
        read_pairs(opened, tmp_path, CAMERAS, "nose")
    for camera in CAMERAS:
        with np.load(tmp_path / f"detections_{camera}.npz") as file:
            data = dict(file)
        for values in data.values():
            if values.ndim > 1:
                values[:, 3] = values[:, 1]
        write_npz(tmp_path / f"detections_{camera}.npz", data)
    with pytest.raises(CalibrationError, match=r"--marker is missing.*index, ring"):
        read_pairs(opened, tmp_path, CAMERAS, None)


def pairs_of(tmp_path: Path, distances: Sequence[float], stand: int, move: int) -> Pairs:
    t, x = process_noise(distances, stand, move)
    opened = recording(tmp_path / "r", t)
    return read_pairs(opened, detections(tmp_path, t, x), CAMERAS, None)[0]


def test_a_recording_without_a_camera_of_its_rig_is_refused(tmp_path: Path) -> None:
    t, _ = process_noise([1.0], 20, 0)
    manifest = recording(tmp_path / "r", t).manifest
    with pytest.raises(
        CalibrationError, match=r"camera 'right', the recording has not; it has left: record both"
    ):
        pair_of(manifest.marker_rig(), {"left": manifest.cameras["left"]})


def test_stretches_at_rest_are_found_and_averaged(tmp_path: Path) -> None:
    distances = [1.0, 0.8, 0.6, 0.4, 0.2]
    pairs = pairs_of(tmp_path, distances, 30, 12)
    runs = still_runs(pairs)
    assert [int(run[0]) // 42 for run in runs] == [0, 1, 2, 3, 4]
    assert all(0 <= run[0] % 42 <= run[-1] % 42 < 30 for run in runs)  # nothing of the way between
    sweep = by_list(pairs, np.array(distances))
    assert sweep.disparity_px == pytest.approx(RIG.disparity(np.array(distances)), abs=0.05)
    assert set(sweep.frames.tolist()) <= {24, 25, 26}
    assert sweep.sigma_px == pytest.approx(0.05, abs=0.02)
    assert sweep.place[0] == "frames 3-28"


def test_a_target_that_moves_does_not_stand_however_unsure_its_centroids_are(tmp_path: Path) -> None:
    pairs = pairs_of(tmp_path, [1.0, 0.8], 30, 12)
    between = np.arange(72) // 30 == 1  # the way, and the first frames after it
    unsure = replace(pairs, sigma_px=np.where(between, 5.0, pairs.sigma_px))
    runs = still_runs(unsure)
    assert [int(run[0]) // 42 for run in runs] == [0, 1]
    assert all(run[-1] % 42 < 30 for run in runs)  # nothing of the way between


def test_a_target_that_never_rests_has_no_stretch(tmp_path: Path) -> None:
    assert still_runs(pairs_of(tmp_path, [1.0, 0.2], 1, 100)) == []


def test_distances_that_do_not_fit_the_recording_are_refused_with_its_numbers(tmp_path: Path) -> None:
    pairs = pairs_of(tmp_path, [1.0, 0.8, 0.6], 30, 12)
    with pytest.raises(CalibrationError, match=r"names 5 places.*114 frame pairs.*3 times: 0\.1-0\.9 s"):
        by_list(pairs, np.linspace(1.0, 0.2, 5))


def test_a_file_of_distances_by_time_frame_or_counter(tmp_path: Path) -> None:
    pairs = pairs_of(tmp_path, [1.0, 0.5], 40, 20)
    file = tmp_path / "d.csv"
    file.write_text("t_s, distance_m\n0.6,1.0\n2.6,0.5\n")
    sweep = by_file(pairs, file)
    assert sweep.frames.tolist() == [15, 15]
    assert sweep.disparity_px == pytest.approx(RIG.disparity(np.array([1.0, 0.5])), abs=0.06)
    for key in ("frame", "seq"):
        file.write_text(f"{key},distance_m\n3,1.0\n77,0.5\n")
        assert by_file(pairs, file).place == ("frame 3", "frame 77")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("t_s,distance_m\n1.7,0.7\n", "line 2: the target moves"),
        ("t_s,distance_m\n0.5,1.0\n99,0.5\n", "line 3: no frame pair with t_s 99"),
        ("seq,distance_m\n500,0.5\n", "no frame pair with seq 500; the recording has 100 pairs"),
        ("when,distance_m\n1,0.5\n", "one of t_s, frame, seq"),
        ("t_s,distance_m\n", "no rows"),
        ("t_s,distance_m\n0.5,far\n", "line 2: distance_m: 'far' is not a number"),
        ("t_s,distance_m\n0.5\n", "line 2: distance_m: '' is not a number"),
    ],
)
def test_a_wrong_file_of_distances_is_refused(tmp_path: Path, text: str, words: str) -> None:
    pairs = pairs_of(tmp_path, [1.0, 0.5], 40, 20)
    (tmp_path / "d.csv").write_text(text)
    with pytest.raises(CalibrationError, match=words):
        by_file(pairs, tmp_path / "d.csv")


def test_a_rendered_recording_brings_its_distances(tmp_path: Path) -> None:
    t, x = process_noise([1.0], 3, 0)
    opened = recording(tmp_path / "r", t)
    pairs, _ = read_pairs(opened, detections(tmp_path, t, x), CAMERAS, None)
    assert by_truth(opened, pairs) is None
    write_npz(tmp_path / "r" / "truth.npz", {"depth": np.array([1.0, 0.9, 0.8])})
    sweep = by_truth(opened, pairs)
    assert sweep is not None
    assert sweep.distance_m.tolist() == [1.0, 0.9, 0.8]
    write_npz(tmp_path / "r" / "truth.npz", {"depth": np.ones(7)})
    with pytest.raises(RecordingError, match="7"):
        by_truth(opened, pairs)
    write_npz(tmp_path / "r" / "truth.npz", {"depth": np.ones(3)})
    with pytest.raises(RecordingError, match="have a frame 9"):
        by_truth(opened, replace(pairs, seq=np.array([0, 1, 9])))


def test_a_table_comes_back_as_it_was_written(tmp_path: Path) -> None:
    uv = np.arange(12.0).reshape(3, 2, 2)
    sweep = Sweep.of(np.array([0.2, 0.3, 0.4]), uv, np.full((3, 2), 50.0), ("a", "b", "c"))
    write_table(tmp_path / "s.csv", sweep)
    back = read_table(tmp_path / "s.csv")
    assert back.distance_m.tolist() == [0.2, 0.3, 0.4]
    assert back.uv.tolist() == uv.tolist()
    assert back.area_px2.tolist() == [[50.0] * 2] * 3
    assert back.place == ("line 2", "line 3", "line 4")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("distance_m,disparity_px\n0.5,nan\n", "line 2: disparity_px is nan"),
        ("distance_m,u_left_px\n0.5,1\n", "u_left_px and u_right_px, are missing"),
        ("d,disparity_px\n0.5,1\n", "distance_m is missing; it has d, disparity_px"),
        ("", "no rows"),
        ("distance_m;disparity_px\n1.0;39.9\n", "separated by commas"),
        ("distance_m,disparity_px\n1,00,39,9\n", "line 2: more cells than columns"),
        ("distance_m,disparity_px,disparity_px\n1,39.9,3\n", "column disparity_px stands there twice"),
    ],
)
def test_a_wrong_table_is_refused(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "s.csv").write_text(text)
    with pytest.raises(CalibrationError, match=words):
        read_table(tmp_path / "s.csv")


def test_a_table_that_is_none_is_refused(tmp_path: Path) -> None:
    (tmp_path / "s.csv").write_bytes(b"\xff\xfe\x00\x81")
    with pytest.raises(CalibrationError, match="not a table"):
        read_table(tmp_path / "s.csv")
    with pytest.raises(CalibrationError, match="cannot read"):
        read_table(tmp_path / "absent.csv")


def test_distances_in_words() -> None:
    assert parse_distances("1.00:0.20:-0.05") == pytest.approx(np.linspace(1.0, 0.2, 17))
    assert parse_distances("1,0.5,0.3").tolist() == [1.0, 0.5, 0.3]


@pytest.mark.parametrize(
    "text", ["1:0.2", "1:0.2:0.05", "1:0.2:-0.03", "1:0.2:0", "a", "1,nan", "", "0:1:1e-9"]
)
def test_distances_that_mean_nothing_are_refused(text: str) -> None:
    with pytest.raises(CalibrationError, match="--distances"):
        parse_distances(text)
