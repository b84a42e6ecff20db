"""Things of a marker's colour beside the hand, ranges that overlap, and a simulated camera that is put wrong."""

import json
from pathlib import Path

import msgspec
import numpy as np
import pytest

from common.calibration import CameraCalibration, HsvRange, RigCalibration, load
from common.clock import SystemClock
from common.errors import CameraError
from slave.cameras.synthetic import FaultyCamera, SyntheticCamera
from slave.commands.simulated import FrameClock, scene_of
from slave.markers.classify import Blob
from slave.markers.detector import ambiguity_counts, ambiguity_metrics
from slave.markers.group import ColourAmbiguityMonitor
from slave.tuning import in_use, overlap

ROOT = Path(__file__).resolve().parents[3]
TREE = ROOT / "calib_json"


def _blob(u: float, v: float, side: float) -> Blob:
    half = side / 2
    return Blob(u, v, side * side, int(u - half), int(v - half), int(u + half), int(v + half))


def test_only_things_apart_from_the_hand_count() -> None:
    ambiguity = ColourAmbiguityMonitor(("index", "back"))
    index, back = _blob(100, 100, 12), _blob(150, 150, 20)
    near = _blob(112, 100, 11)  # a piece of the marker
    rim = _blob(150, 150, 10)  # the hue runs through another range on the rim of the other marker
    speck = _blob(400, 300, 4)
    ambiguity.push([[index, near, rim, speck], [back]], {0: index, 1: back})
    assert ambiguity.frames == {"index": 0, "back": 0}
    ambiguity.push([[index, _blob(400, 300, 12)], [back]], {0: index, 1: back})
    ambiguity.push([[_blob(400, 310, 12)], [back]], {1: back})  # the marker itself is hidden
    ambiguity.push([[_blob(400, 320, 12)], []], {})  # no hand to be beside of
    assert ambiguity.frames == {"index": 2, "back": 0}
    assert ambiguity.places == {"index": (400, 310)}


def test_ranges_overlap_by_the_hues_that_they_share() -> None:
    def colour(low: int, high: int, s: int = 60) -> HsvRange:
        return HsvRange(hsv_low=(low, s, 60), hsv_high=(high, s + 40, 255))

    assert overlap(colour(36, 49), colour(50, 60)) == 0
    assert overlap(colour(36, 50), colour(50, 60)) == 1
    assert overlap(colour(170, 5), colour(0, 10)) == 6  # through 0
    assert overlap(colour(36, 60), colour(50, 60, 150)) == 0  # of other saturations


def test_the_file_in_use_says_its_colours_by_number_and_has_no_overlap_as_it_comes() -> None:
    rig, camera = (
        load(TREE / "rigs/desk.json", RigCalibration),
        load(TREE / "cameras/left.json", CameraCalibration),
    )
    assert camera.markers is not None
    metrics = in_use(camera, rig.markers)
    assert not [name for name in metrics if name.startswith("overlap.")]
    wide = msgspec.structs.replace(camera.markers["back"], hsv_high=(62, 255, 255))
    other = in_use(msgspec.structs.replace(camera, markers=camera.markers | {"back": wide}), rig.markers)
    assert other["overlap.index..back"] == 3.0
    changed = {name for name, value in metrics.items() if other[name] != value}
    assert changed == {"colour.back"}


def test_a_simulated_camera_is_spoiled_as_its_file_says_and_well_without(tmp_path: Path) -> None:
    rig, camera = (
        load(TREE / "rigs/desk.json", RigCalibration),
        load(TREE / "cameras/left.json", CameraCalibration),
    )
    clock = FrameClock(SystemClock().now_ns())
    scene = scene_of(TREE, rig, "standard", 7)
    drawn = SyntheticCamera(scene, camera, clock.now_ns(), clock, 0, clock, clock.sleep)
    path = tmp_path / "faults.json"
    faulty = FaultyCamera(drawn, camera, path)
    before = faulty.read()
    assert before is not None
    patch = {"uv": [30, 450], "radius_px": 8, "bgr": [64, 178, 130]}
    path.write_text(json.dumps({"patches": [patch], "keep_one_in": 3, "exposes": 1.5}))
    clock.sleep(0.2)
    first, spoiled = faulty.read(), faulty.read()
    assert first is not None
    assert spoiled is not None
    np.testing.assert_array_equal(spoiled.image[450, 30], [64, 178, 130])
    assert spoiled.seq - first.seq == 3
    assert faulty.metrics()["exposure_us"] == 1.5 * camera.exposure_us
    path.unlink()
    clock.sleep(0.2)
    faulty.read()
    assert faulty.metrics()["exposure_us"] == camera.exposure_us
    path.write_text(json.dumps({"unplugged": True}))
    clock.sleep(0.2)
    with pytest.raises(CameraError, match="unplugged"):
        faulty.read()
    with pytest.raises(CameraError, match="unplugged"):
        FaultyCamera(drawn, camera, path)


def test_nothing_is_reported_of_a_detector_that_is_not_there() -> None:
    assert ambiguity_counts(None) == ambiguity_metrics(None) == {}
