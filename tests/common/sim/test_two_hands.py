"""Two hands before one rig: how near they pass, that the nearer hides the farther, and the truth of each."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from common.calibration import CameraCalibration, HandProfile, RigCalibration, load
from common.calibration.rig import painted_alike, rigs_by_hand
from common.errors import CalibrationError, PhalanxError
from common.sim.record import SceneTake
from common.sim.render import Renderer
from common.sim.scenes import scene_by_name

CALIBRATION = Path(__file__).parents[3] / "calib_json"
RIG = load(CALIBRATION / "rigs" / "desk-both.json", RigCalibration)
CAMERAS = {name: load(CALIBRATION / "cameras" / f"{name}.json", CameraCalibration) for name in RIG.cameras}
HANDS = {
    name: load(CALIBRATION / "hands" / f"{name}.json", HandProfile) for name in (RIG.hand, *RIG.other_hands)
}
SCENE = scene_by_name("hands", RIG, CAMERAS, HANDS[RIG.hand], 7, None, (HANDS["default-left"],))


def test_they_pass_at_ten_centimetres_in_depth_and_lie_side_by_side() -> None:
    times = np.arange(0.0, 20.0, 0.02)
    right, left = (
        np.array([one.truth(float(t)).joints.position_m[0] for t in times])
        for one in (SCENE, SCENE.others[0])
    )
    off = right - left
    for start, stop in ((1.5, 3.0), (7.4, 8.6), (17.2, 18.6)):
        during = (times > start) & (times < stop)
        k = np.flatnonzero(during)[np.abs(off[during, 0]).argmin()]
        assert abs(off[k, 0]) < 0.02, "one is before the other"
        assert 0.085 < abs(off[k, 2]) < 0.115
    beside = (times > 5.1) & (times < 5.5)
    assert (np.abs(off[beside, 0]) < 0.125).all()
    assert np.linalg.norm(off, axis=1).min() > 0.08, "they never touch"


def test_the_nearer_hand_hides_the_farther_and_both_have_a_truth() -> None:
    renderer = Renderer(SCENE, "left")
    _, (right, left) = renderer.observe_all(2.25)
    (alone,) = Renderer(SCENE.others[0], "left").observe_all(2.25)[1]
    assert (np.nan_to_num(left.visible) <= alone.visible + 1e-6).all()
    assert (alone.visible - np.nan_to_num(left.visible)).max() > 0.9, "the right hand is before it"
    (first,) = Renderer(replace(SCENE, others=()), "left").observe_all(2.25)[1]
    np.testing.assert_array_equal(right.uv, first.uv)


def test_a_take_has_clicks_and_truth_of_both() -> None:
    take = SceneTake(SCENE, 1 / 60, 3.5)
    frames = list(take.frames())
    manifest, truth = take.manifest(), take.truth()
    assert manifest.rig == RIG
    assert len(frames) == 2
    assert {"back", "left_back"} <= manifest.clicks["left"].keys()
    assert truth["joints"].shape == truth["joints_default-left"].shape == (1, 25, 3)
    np.testing.assert_allclose(
        manifest.clicks["left"]["left_back"], truth["uv_default-left"][0, 0, 5], atol=1e-9
    )


def test_names_with_a_side_are_of_the_hand_of_that_side() -> None:
    (first, second) = rigs_by_hand(RIG, HANDS)
    assert first[1].markers == second[1].markers == RIG.markers[:6]
    assert (first[2], second[2]) == (tuple(range(6)), tuple(range(6, 12)))
    assert painted_alike(RIG.markers)["left_thumb"] == "thumb"
    assert painted_alike(("wand1", "left_thumb")) == {"wand1": "wand1", "left_thumb": "left_thumb"}
    with pytest.raises(CalibrationError, match="'thumb' is mounted by default-right and right2"):
        rigs_by_hand(RIG, {"default-right": HANDS["default-right"], "right2": HANDS["default-right"]})
    with pytest.raises(
        PhalanxError, match=r"'grasp': shows one hand, rig 'desk-both' watches several: hands"
    ):
        scene_by_name("grasp", RIG, CAMERAS, HANDS[RIG.hand], 7, None, (HANDS["default-left"],))
