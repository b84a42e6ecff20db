"""Three markers on the back: where they sit, that the shipped hand has them, and that a detector tells all eight."""

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from common.calibration import CameraCalibration, HandProfile, RigCalibration, load
from common.errors import CalibrationError
from common.hand.fitting import with_three_back_markers
from common.hand.model import HandModel
from common.hand.profiles import generated_profile
from common.sim.light import marker_colour
from common.sim.render import Renderer
from common.sim.scene import Scene
from slave.markers.detector import MarkerDetector

BACK = ("back", "back2", "back3")


def offsets(profile: HandProfile) -> list[np.ndarray]:
    return [np.array(profile.markers[name].offset_m) for name in BACK]


@pytest.mark.parametrize("length_m", [0.16, 0.19, 0.22])
def test_they_span_the_back_above_the_metacarpals(length_m: float) -> None:
    profile = with_three_back_markers(generated_profile("any", "right", length_m), "any-back3")
    assert all(profile.markers[name].joint == "palm_frame" for name in BACK)
    sides = [np.linalg.norm(a - b) for a, b in combinations(offsets(profile), 2)]
    assert min(sides) > 0.2 * length_m
    a, b, c = offsets(profile)
    normal = np.cross(b - a, c - a)
    height = np.linalg.norm(normal) / max(sides)
    assert height > 0.15 * length_m  # far from one line
    knuckles = HandModel.of(profile).rest_position_m[[7, 12, 17, 22]]
    assert all(place[2] < knuckles[:, 2].max() for place in (a, b, c))


def test_left_is_the_mirror_image_of_right() -> None:
    right, left = (with_three_back_markers(generated_profile("a", s), "b") for s in ("right", "left"))
    for one, other in zip(offsets(right), offsets(left), strict=True):
        np.testing.assert_allclose(other, one * [-1, 1, 1], atol=1e-7)


def test_finger_markers_and_bones_stay(root: Path) -> None:
    plain = load(root / "calib_json" / "hands" / "default-right.json", HandProfile)
    shipped = load(root / "calib_json" / "hands" / "default-right-back3.json", HandProfile)
    assert shipped == with_three_back_markers(plain, "default-right-back3")
    assert shipped.rest_joints == plain.rest_joints
    assert set(shipped.markers) == {*plain.markers, "back2", "back3"}
    assert shipped.markers["index"] == plain.markers["index"]


@pytest.mark.parametrize("camera", ["left", "right"])
def test_a_detector_distinguishes_all_eight_colours(camera: str, root: Path) -> None:
    files = root / "calib_json"
    rig = load(files / "rigs" / "desk-back3.json", RigCalibration)
    cameras = {name: load(files / "cameras" / f"{name}.json", CameraCalibration) for name in rig.cameras}
    hand = load(files / "hands" / f"{rig.hand}.json", HandProfile)
    scene = Scene.standard(rig, cameras, hand, 9)
    renderer, detector = Renderer(scene, camera), MarkerDetector(cameras[camera], rig.markers)
    rows = [rig.markers.index(name) for name in BACK]
    missed = worst = whole = 0.0
    for t_s in np.arange(18.0, 20.0, 0.1).tolist():
        image, truth = renderer.observe(t_s)
        found = detector.push(image, round(t_s * 1e9))
        clear = (truth.visible > 0.95) & (truth.area > 40.0)  # a curled finger shows a few pixels only
        off = np.linalg.norm(found.uv - truth.uv, axis=1)
        whole += clear[rows].sum()
        missed += np.isnan(off[clear]).sum()
        worst = max(worst, float(np.nanmax(off[clear], initial=0.0)))
    assert whole > 50  # of 60: the back is to the cameras
    assert missed == 0
    assert worst < 5.0  # px: of the right paint, or it would be tens


def test_a_marker_without_paint_is_refused_with_those_there_are() -> None:
    with pytest.raises(CalibrationError, match=r"'back4'.*no such paint; it has thumb.*back2, back3"):
        marker_colour("back4")
