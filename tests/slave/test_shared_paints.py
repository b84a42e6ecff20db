"""One paint on two hands: colours of one hand are the other's, and no collision; on one hand they stay one."""

import json
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from common.calibration import CameraCalibration, load
from common.sim.record import record_scene
from common.sim.render import Renderer
from slave.commands.offline import calibrate_colours
from slave.markers.detector import MarkerDetector
from slave.tuning import in_use
from tests.common.sim.test_two_hands import CAMERAS, RIG, SCENE

OVERLAP = "overlap.thumb..left_thumb"


def test_colours_of_one_hand_are_those_of_the_other(tmp_path: Path) -> None:
    record_scene(tmp_path / "recording", replace(SCENE, others=(), watched=None), 1 / 60, 15.5)
    manifest = tmp_path / "recording" / "recording.json"
    recorded = json.loads(manifest.read_bytes())
    recorded["rig"] |= {
        "markers": RIG.markers,
        "other_hands": RIG.other_hands,
    }  # one hand is shown to a rig of two
    manifest.write_text(json.dumps(recorded))
    calibrate_colours(tmp_path / "recording", "left", tmp_path / "left.json")
    made = load(tmp_path / "left.json", CameraCalibration).markers or {}
    assert made.keys() == set(RIG.markers)
    assert all(made[f"left_{name}"] == made[name] for name in RIG.markers[:6])


def test_the_same_range_is_a_collision_on_one_hand_alone() -> None:
    camera = CAMERAS["left"]
    ranges = camera.markers or {}
    assert not [name for name in in_use(camera, RIG.markers) if name.startswith("overlap.")]
    same = msgspec.structs.replace(camera, markers={**ranges, "index": ranges["thumb"]})
    assert "overlap.thumb..index" in in_use(same, RIG.markers[:6])
    low = msgspec.structs.replace(ranges["thumb"], hsv_low=(ranges["thumb"].hsv_low[0] + 1, 64, 66))
    near = msgspec.structs.replace(camera, markers={**ranges, "left_thumb": low})
    assert OVERLAP in in_use(near, RIG.markers)


@pytest.mark.parametrize("t_s", [3.5, 13.0])
def test_both_blobs_of_a_paint_are_found_and_kept_apart(t_s: float) -> None:
    detector, renderer = MarkerDetector(CAMERAS["left"], RIG.markers), Renderer(SCENE, "left")
    before: np.ndarray | None = None
    for k in range(4):
        image, hands = renderer.observe_all(t_s + k / 60.0)
        uv = detector.push(image, round(1e9 * (t_s + k / 60.0))).uv
        for m in range(6):
            shown = [hand.uv[m] for hand in hands if hand.visible[m] > 0.9 and hand.area[m] > 70.0]
            rows = uv[[m, m + 6]]
            for place in shown if k > 0 else ():  # specks need more than one grid
                assert np.nanmin(np.linalg.norm(rows - place, axis=1)) < 1.5
        if before is not None:
            both = np.isfinite(uv[:, 0]) & np.isfinite(before[:, 0])
            assert np.linalg.norm(uv[both] - before[both], axis=1).max() < 15.0, "rows keep their blobs"
        before = uv
