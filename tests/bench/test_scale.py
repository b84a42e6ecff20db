"""Rigs that are scaled look at the hand, the model is the line through what was measured, and the page takes it."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from bench.rigs.rooms import ROOM, detections, dome, room
from bench.rigs.scale import ScaleRun, into_page, summary
from master.rig.setup import load_setup

PAGE = Path(__file__).parents[2] / "docs" / "scale.html"


def run(cameras: int, pose_ms: float = 6.0, message_ms: float = 0.2) -> ScaleRun:
    cores = 90.0 * (pose_ms + cameras * message_ms) * 1e-3
    return ScaleRun(
        cameras, 90.0, 10.0, 900 * cameras, 900 * cameras, 0, 0, 0, 0, 0, 0, 90.0, 5.0, 9.0, cores, 5000.0, 2.0,
    )  # fmt: skip


@pytest.mark.parametrize("cameras", [2, 5, 16])
def test_the_cameras_of_a_room_all_see_the_hand(tmp_path: Path, cameras: int) -> None:
    setup = load_setup(room(tmp_path, cameras, 90.0), ROOM)
    np.testing.assert_allclose(dome(cameras)[0], np.eye(4), atol=1e-12)
    for pose in dome(cameras):
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)
    frames = detections(setup, 10.0)
    assert list(frames) == list(setup.camera_names)
    for name, sent in frames.items():
        uv = np.array([one.uv for one in sent])
        assert np.isfinite(uv[..., 0]).mean() == pytest.approx(0.95, abs=0.03)
        inside = (uv >= 0.0) & (uv < [setup.cameras[name].width_px, setup.cameras[name].height_px])
        assert inside[np.isfinite(uv)].mean() > 0.9


def test_the_model_is_the_line_through_the_runs() -> None:
    model = summary([run(2), run(4), run(16)])["model"]
    assert model["pose_ms"] == pytest.approx(6.0, abs=1e-3)
    assert model["message_ms"] == pytest.approx(0.2, abs=1e-4)
    assert model["off_line_percent"] == pytest.approx(0.0, abs=0.1)


def test_the_page_takes_what_was_measured_and_has_all_that_it_computes_with(tmp_path: Path) -> None:
    page = tmp_path / "scale.html"
    page.write_text(PAGE.read_text())
    into_page(page, summary([run(2), run(16)]))
    block = re.search(r'id="measured">\n(.*?)\n</script>', page.read_text(), re.DOTALL)
    assert block is not None
    used = set(re.findall(r"model\.(\w+)", PAGE.read_text()))
    assert used <= set(json.loads(block[1])["model"])
    page.write_text("<html></html>")
    with pytest.raises(ValueError, match="found 0"):
        into_page(page, {})


def test_the_page_that_is_shipped_has_measured_figures() -> None:
    block = re.search(r'id="measured">\n(.*?)\n</script>', PAGE.read_text(), re.DOTALL)
    assert block is not None
    found = json.loads(block[1])
    assert {"pose_ms", "message_ms", "datagram_bytes"} <= set(found["model"])
    assert set(found["runs"]) == {"2", "4", "8", "16"}
    assert "http://" not in PAGE.read_text()
    assert "https://" not in PAGE.read_text()
