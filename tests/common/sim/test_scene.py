"""The standard scene holds what it promises, and its paint sits where the profile says."""

from pathlib import Path

import msgspec
import numpy as np
import pytest

from common.arrays import Float
from common.calibration import CameraCalibration, HandProfile, RigCalibration, load
from common.errors import CalibrationError
from common.hand.model import CHAINS, HandModel
from common.sim.scene import STANDARD_CARDS, Card, Scene
from common.sim.surface import CYLINDER_SHARE, HandSurface, box_corners, cap_outline, unit, unit_circle

ROOT = Path(__file__).resolve().parents[3]
RIG = load(ROOT / "calib_json/rigs/desk.json", RigCalibration)
CAMERAS = {name: load(ROOT / f"calib_json/cameras/{name}.json", CameraCalibration) for name in RIG.cameras}
HAND = load(ROOT / "calib_json/hands/default-right.json", HandProfile)
SCENE = Scene.standard(RIG, CAMERAS, HAND)
TIMES = np.arange(0.0, 60.0, 0.1)


def test_standard_scene_is_what_it_says() -> None:
    assert SCENE.seed == 7
    assert SCENE.period_s == 60.0
    assert [SCENE.timing(name).start_offset_ns for name in RIG.cameras] == [0, 5_000_000]
    assert SCENE.timing("right").clock_ppm - SCENE.timing("left").clock_ppm == 50.0
    assert len(STANDARD_CARDS) == 2
    baseline = np.linalg.norm(RIG.camera_pose("right")[:3, 3] - RIG.camera_pose("left")[:3, 3])
    assert abs(baseline - 0.075) < 1e-4


def test_hand_stays_in_both_views_and_at_working_distance() -> None:
    for t in TIMES:
        truth = SCENE.truth(float(t))
        assert 0.38 < truth.markers_m[:, 2].min()
        assert truth.markers_m[:, 2].max() < 0.62
        for name in RIG.cameras:
            uv = SCENE.optics[name].project(truth.markers_m)
            assert ((uv > 8.0) & (uv < np.array([632.0, 472.0]))).all(), (t, name, uv)


def test_truth_is_one_consistent_state() -> None:
    truth = SCENE.truth(17.3)
    again = SCENE.model.forward(truth.T_rig_palm, truth.angles_rad)
    np.testing.assert_array_equal(truth.joints.position_m, again.position_m)
    np.testing.assert_array_equal(truth.markers_m, SCENE.model.marker_points(again, RIG.markers))
    np.testing.assert_array_equal(SCENE.truth(-3.0).markers_m, SCENE.truth(0.0).markers_m)
    np.testing.assert_allclose(SCENE.truth(77.3).markers_m, truth.markers_m, atol=1e-9)


def sampled_cap(centre: Float, base: Float, radius: float, n: int = 200_000) -> Float:
    """Random points, even over the area of half a sphere and a cylinder; no formula of the code under test."""
    rng = np.random.default_rng(5)
    axis = unit(centre - base)
    height = float(np.linalg.norm(centre - base))
    side = np.cross(axis, [0.3, 0.5, 0.9])
    side = unit(side)
    up = np.cross(axis, side)
    ball = unit(rng.normal(size=(n, 3)))
    ball = np.where((ball @ axis)[:, None] < 0.0, -ball, ball)
    turn = rng.uniform(0.0, 2.0 * np.pi, n)
    tube = (
        np.cos(turn)[:, None] * side
        + np.sin(turn)[:, None] * up
        - rng.uniform(0, height / radius, n)[:, None] * axis
    )
    on_ball = rng.random(n) < radius / (radius + height)  # areas 2 pi r^2 and 2 pi r h
    return centre + radius * np.where(on_ball[:, None], ball, tube)


@pytest.mark.parametrize("t", [0.0, 13.4, 25.0])
def test_painted_surface_has_its_centroid_at_the_profiles_point(t: float) -> None:
    truth = SCENE.truth(t)
    surface = HandSurface.of(SCENE.model, RIG.markers)
    points = surface.key_points(truth.T_rig_palm, SCENE.model.chains(truth.angles_rad))
    assert len(surface.caps) == 5
    for cap in surface.caps:
        sample = sampled_cap(points[cap.centre], points[cap.base], cap.radius_m)
        assert np.linalg.norm(sample.mean(axis=0) - truth.markers_m[cap.marker]) < 0.1e-3
        tip = truth.joints.position_m[CHAINS[cap.finger, 3]]
        assert (
            np.linalg.norm(points[cap.centre] - tip) < 0.1e-3
        )  # the finger ends one tip radius beyond its joint


def test_painted_box_has_its_centroid_at_the_profiles_point() -> None:
    corners = box_corners()
    faces = [(0, 1, 2, 3), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)]  # top and sides
    area = [
        np.linalg.norm(corners[b] - corners[a]) * np.linalg.norm(corners[d] - corners[a])
        for a, b, _, d in faces
    ]
    middle = [corners[list(face)].mean(axis=0) for face in faces]
    np.testing.assert_allclose(np.average(middle, axis=0, weights=area), 0.0, atol=1e-9)
    np.testing.assert_allclose(np.ptp(corners, axis=0), [0.025, 0.003, 0.020], atol=1e-12)


def test_cap_outline_is_the_hull_of_the_surface() -> None:
    circle = unit_circle(96)
    centre = np.array([[0.03, -0.02, 0.45]])
    for axis in ([0.0, -1.0, 0.0], [0.5, -0.5, -0.7], [0.2, -0.4, 0.9]):
        base = centre - CYLINDER_SHARE * 0.007 * unit(np.array([axis]))
        outline = cap_outline(centre, base, np.array([0.007]), circle)[0]
        sample = sampled_cap(centre[0], base[0], 0.007)
        got, want = (points[:, :2] / points[:, 2:] * 500.0 for points in (outline, sample))
        for angle in np.linspace(0.0, 2.0 * np.pi, 60):
            way = np.array([np.cos(angle), np.sin(angle)])
            assert (
                abs((got @ way).max() - (want @ way).max()) < 0.04
            )  # px; the sample never quite reaches the edge


def test_card_hides_for_its_width_over_its_speed() -> None:
    card = Card(middle_s=5.0, width_m=0.06, top_m=-0.3, bottom_m=0.1, depth_m=0.3, speed_m_s=0.24)
    inside = [
        t
        for t in np.arange(3.0, 7.0, 1e-3)
        if (quad := card.corners(float(t), 0.0)) is not None and quad[0, 0] <= 0.0 <= quad[1, 0]
    ]
    assert len(inside) == pytest.approx(250, abs=2)
    assert card.corners(30.0, 0.0) is None


def test_wrong_parts_are_refused_by_name() -> None:
    with pytest.raises(CalibrationError, match="right"):
        Scene.standard(RIG, {"left": CAMERAS["left"]}, HAND)
    blind = msgspec.structs.replace(CAMERAS["right"], intrinsics=None)
    with pytest.raises(CalibrationError, match="intrinsics"):
        Scene.standard(RIG, {**CAMERAS, "right": blind}, HAND)
    moved = {**HAND.markers, "index": msgspec.structs.replace(HAND.markers["index"], joint="wrist")}
    model = HandModel.of(msgspec.structs.replace(HAND, markers=moved))
    with pytest.raises(CalibrationError, match=r"markers\.index"):
        HandSurface.of(model, RIG.markers)


def test_a_left_hand_and_a_hand_of_another_shape_take_part() -> None:
    left = load(ROOT / "calib_json/hands/default-left.json", HandProfile)
    truth = Scene.standard(RIG, CAMERAS, left).truth(0.0)
    right = SCENE.truth(0.0)
    centre = SCENE.centre_m[0]
    assert (truth.markers_m[0, 0] - centre) * (
        right.markers_m[0, 0] - centre
    ) < 0.0  # thumbs on opposite sides
