"""The mesh hand stands where the rendered recordings have it: joints, labels, laser line, light."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from bench.wrist_mesh.light import Optics
from bench.wrist_mesh.render import Device, Moment
from bench.wrist_mesh.room import BLACK, Room
from bench.wrist_mesh.sets import set_named, write_set
from common.arrays import Image
from common.recording.frame_recording import load_manifest, open_recording


@pytest.mark.parametrize(("name", "k"), [("curl", 12), ("spread", 3), ("left_small", 0)])
def test_mesh_is_where_the_rendered_recordings_have_it(datasets: Path, name: str, k: int) -> None:
    folder = datasets / "wrist" / name
    device, truth = Device.of(load_manifest(folder), datasets), np.load(folder / "truth.npz")
    view = device.view(Moment(truth["angles"][k], np.zeros(2)))
    label = device.label(view)
    mine = device.truth(view, label)
    assert np.abs(mine["joints"] - truth["joints"][k]).max() < 5e-6
    theirs = _read(folder / f"label_{k:06d}.png")
    for finger in range(6):
        a, b = label // 10 == finger, theirs // 10 == finger
        if b.sum() < 500:  # a hidden finger's edge
            continue
        assert (a & b).sum() / (a | b).sum() > 0.97
    whole = truth["laser_len_vis"][k, 2:6] > 0.018
    off = np.abs(mine["laser_uv"] - truth["laser_uv"][k])[2:6][whole]
    assert off[:, 1].max() < 1.0
    ambient, _, led = device.light(view, Room.of("indoor", np.zeros(label.shape)), Optics())
    lit = _read(folder / "wrist" / f"{3 * k + 2:06d}.png")
    both = (label != 255) & (theirs != 255) & (lit < 250)
    assert np.abs(BLACK + ambient + led - lit)[both].mean() < 15.0


def _read(path: Path) -> Image:
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    return np.asarray(image, dtype=np.uint8)


def test_set_is_a_recording_that_repeats(datasets: Path, tmp_path: Path) -> None:
    for folder in ("one", "two"):
        write_set(set_named("motion@bright", datasets, 1, seed=3), datasets, tmp_path / folder, seed=3)
    recording = open_recording(tmp_path / "one")
    assert recording.manifest.continuous
    assert [row.illumination for row in recording.rows] == ["ambient", "laser", "led"]
    for row in recording.rows:
        assert (tmp_path / "one" / row.file).read_bytes() == (tmp_path / "two" / row.file).read_bytes()
    truth = np.load(tmp_path / "one" / "truth.npz")
    np.testing.assert_array_equal(truth["angles_3frames"][:, 1], truth["angles"])
