"""Coverage says what is missing; a recording of frames is a source of streams."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from common.arrays import Float
from common.errors import RecordingError
from common.geometry.transforms import axis_rotation, rigid
from common.recording.frame_recording import FRAMES, MANIFEST
from master.calibrate.cameras.coverage import advice, advice_so_far, coverage
from master.calibrate.cameras.tracks import streams_of
from tests.master.calibrate.cameras.board_scenes import SIZE, scene

MIDDLE = np.array([0.1, 0.06, 0.0])
EVERYWHERE = np.stack(np.meshgrid(np.linspace(5, 635, 30), np.linspace(5, 475, 24)), axis=-1).reshape(-1, 2)


def _places(tilts_deg: list[float], distances_m: list[float], axis: int = 1) -> Float:
    return np.stack(
        [
            rigid(axis_rotation(axis, np.radians(tilt)), np.array([0.0, 0.0, z]))
            for tilt, z in zip(tilts_deg, distances_m, strict=True)
        ]
    )


def test_tilts_then_image_then_distances_are_asked_for() -> None:
    level = coverage(SIZE, [EVERYWHERE], _places([0, 5, -5], [0.3, 0.5, 0.7]), MIDDLE)
    assert level.tilt_spread_deg == pytest.approx(10.0)
    assert "about its level axis" in advice(level)
    nodding = coverage(SIZE, [EVERYWHERE], _places([0, 15, -15], [0.3, 0.5, 0.7], axis=0), MIDDLE)
    assert "about its upright axis" in advice(nodding)
    tilts = _places([0, 30, -30], [0.3, 0.5, 0.7])
    half = EVERYWHERE[EVERYWHERE[:, 0] < 320]
    left = coverage(SIZE, [half], tilts, MIDDLE)
    assert left.share == pytest.approx(0.5)
    assert "right" in advice(left)
    assert "beyond" in advice(coverage(SIZE, [EVERYWHERE], _places([0, 30, -30], [0.5, 0.5, 0.5]), MIDDLE))
    assert advice(coverage(SIZE, [EVERYWHERE], tilts, MIDDLE)) == ""


def test_advice_needs_no_lens() -> None:
    views = scene(41, 1, views=12).views(0.1, 41)
    assert isinstance(advice_so_far(views, "left"), str)
    flat = scene(41, 1, views=6, tilt_deg=2.0).views(0.1, 41)
    assert "tilt the board" in advice_so_far(flat, "left")
    assert advice_so_far(views, "nobody") == "show the board to nobody"


def test_frames_of_a_recording_are_streams_by_their_stamps(tmp_path: Path, datasets: Path) -> None:
    sources = sorted(path.parent for path in (datasets / "stereo").glob(f"*/{MANIFEST}"))
    assert sources
    source = sources[0]
    (tmp_path / MANIFEST).write_bytes((source / MANIFEST).read_bytes())
    rows = ["camera,seq,t_ns,illumination,file"]
    for i in range(100):
        for camera, late_ns in (("left", 0), ("right", 3_000_000)):
            if camera == "right" and i == 0:
                continue  # a dropped frame
            file = f"{camera}{i}.png"
            cv2.imwrite(str(tmp_path / file), np.full((480, 640), i, np.uint8))
            rows.append(f"{camera},{i},{i * 16_666_667 + late_ns},none,{file}")
    (tmp_path / FRAMES).write_text("\n".join(rows) + "\n")
    streams = streams_of(tmp_path, ["left", "right"], print)
    assert streams is not None
    assert [len(stream.numbers) for stream in streams.values()] == [100, 99]
    assert streams["right"].read(7)[0, 0, 0] == 7
    np.testing.assert_allclose(streams["right"].t_s[6] - streams["left"].t_s[7], 0.003, atol=1e-9)
    with pytest.raises(RecordingError, match="no camera 'top'"):
        streams_of(tmp_path, ["left", "top"], print)
