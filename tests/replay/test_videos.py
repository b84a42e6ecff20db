"""Rendered recordings as videos of another program: the hand is where it is in the pictures themselves."""

import csv
import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

from common.arrays import Float
from common.calibration import CameraCalibration, load, save
from common.recording.pictures import decode
from tests.conftest import ROOT
from tests.replay.replayed import colours_of, command


@dataclass(frozen=True)
class Take:
    """Videos of a recording, its calibration tree, and the recording with its true markers."""

    recording: Path
    folder: Path

    def replay(self, *options: str) -> tuple[Float, str]:
        """Markers (T, M, 3) [m] that a replay of the videos finds, unfiltered; what it printed."""
        videos = [str(self.folder / f"{camera}.avi") for camera in ("left", "right")]
        tree, out = str(self.folder / "calib"), self.folder / "out"
        output = command(
            ROOT, "master", "replay", *videos, "--calibration", tree, "--out", str(out), *options
        )
        with np.load(out / "poses.npz") as poses:
            return poses["markers_raw_m"], output

    def off_mm(self, markers: Float) -> float:
        """Median distance from the true caps [mm]."""
        with np.load(self.recording / "truth.npz") as truth:
            true = truth["paint_centroid"]
        return 1e3 * float(np.nanmedian(np.linalg.norm(markers - true, axis=-1)))


@pytest.fixture(scope="module")
def take(datasets: Path, tmp_path_factory: pytest.TempPathFactory) -> Take:
    """`translate_8ms`: 1 m/s at most, the right camera 8 ms late, rolling shutters; as MJPEG at 30 Hz."""
    recording = datasets / "stereo" / "translate_8ms"
    if not recording.is_dir():
        pytest.skip(f"no rendered stereo recordings at {recording.parent}")
    folder = tmp_path_factory.mktemp("take")
    tree = colours_of(datasets, folder / "calib")
    (tree / "rigs").mkdir()
    manifest = json.loads((recording / "recording.json").read_text())
    (tree / "rigs" / "desk.json").write_text(json.dumps(manifest["rig"]))
    times = ["camera,frame,time"]
    with (recording / "frames.csv").open() as table:
        rows = list(csv.DictReader(table))
    for camera, content in manifest["cameras"].items():
        file = tree / "cameras" / f"{camera}.json"
        markers = load(file, CameraCalibration).markers
        save(file, msgspec.structs.replace(msgspec.convert(content, CameraCalibration), markers=markers))
        writer = cv2.VideoWriter(
            str(folder / f"{camera}.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (640, 480)
        )
        writer.set(cv2.VIDEOWRITER_PROP_QUALITY, 95)
        for k, row in enumerate(row for row in rows if row["camera"] == camera):
            writer.write(decode((recording / row["file"]).read_bytes(), (640, 480)))
            times.append(f"{camera},{k},{1e-9 * int(row['t_ns']):.9f}")
        writer.release()
    (folder / "times.csv").write_text("\n".join(times) + "\n")
    return Take(recording, folder)


def test_a_hand_in_videos_with_times_is_where_it_is(take: Take) -> None:
    markers, output = take.replay("--times", str(take.folder / "times.csv"))
    assert take.off_mm(markers) < 3.0
    assert "simultaneous" not in output
