"""Images of the simulated scene: markers to a twentieth of a pixel, hidden when hidden, and the same every time."""

import itertools
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from common.arrays import Bool, Float, Image
from common.calibration import CameraCalibration, HandProfile, HsvRange, RigCalibration, load
from common.errors import CalibrationError, RecordingError
from common.geometry.transforms import rigid
from common.recording.frame_recording import open_recording
from common.sim import light, raster
from common.sim.motion import HandState
from common.sim.raster import Shape
from common.sim.record import ANGLE_NAMES, record_scene
from common.sim.render import Renderer
from common.sim.scene import Card, Scene
from common.sim.surface import HandSurface, unit
from common.sim.view import View

ROOT = Path(__file__).resolve().parents[3]
RIG = load(ROOT / "calib_json/rigs/desk.json", RigCalibration)
CAMERAS = {name: load(ROOT / f"calib_json/cameras/{name}.json", CameraCalibration) for name in RIG.cameras}
HAND = load(ROOT / "calib_json/hands/default-right.json", HandProfile)
SCENE = Scene.standard(RIG, CAMERAS, HAND)
LEFT, RIGHT = (Renderer(SCENE, name) for name in RIG.cameras)


class Steady:
    """A hand that stands, or glides at a constant velocity."""

    period_s = 60.0

    def __init__(self, state: HandState, velocity_m_s: Sequence[float] = (0.0, 0.0, 0.0)) -> None:
        self._state, self._velocity = state, np.array(velocity_m_s)

    def at(self, t_s: float) -> HandState:
        T = self._state.T_rig_palm
        return HandState(rigid(T[:3, :3], T[:3, 3] + t_s * self._velocity), self._state.angles_rad)


def facing_centroid(centre: Float, base: Float, radius: float, view: View) -> tuple[Float, float]:
    """Centroid [px] and area [px^2] of a lone cap's outside that faces the camera, by adding up small facets.

    Independent of hulls and drawing: every facet counts with its projected area if it is turned to the camera.
    """
    axis = unit(centre - base)
    side = unit(np.cross(axis, np.array([0.3, 0.5, 0.9])))
    up = np.cross(axis, side)
    turn = np.linspace(0.0, 2.0 * np.pi, 181)
    height = float(np.linalg.norm(centre - base))
    rows = [0.5 * np.pi * k / 60 for k in range(61)]
    profile = [(-height + height * k / 20, 1.0) for k in range(20)]
    profile += [(radius * np.sin(a), np.cos(a)) for a in rows]
    ring = np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * up
    mesh = np.array([centre + s * axis + radius * w * ring for s, w in profile])
    total, moment = 0.0, np.zeros(2)
    for corners in ((0, 1, 2), (0, 2, 3)):
        p, q, r = (np.stack([mesh[:-1, :-1], mesh[1:, :-1], mesh[1:, 1:], mesh[:-1, 1:]])[k] for k in corners)
        normal = np.cross(q - p, r - p)
        out = np.sign(((p + q + r) / 3.0 - centre - 1e-3 * height * axis)[5, 0] @ normal[5, 0])
        facing = out * (normal * -p).sum(axis=-1) > 0.0
        p, q, r = (view.project(k) for k in (p, q, r))
        area = 0.5 * np.abs((q - p)[..., 0] * (r - p)[..., 1] - (q - p)[..., 1] * (r - p)[..., 0]) * facing
        total += float(area.sum())
        moment += ((p + q + r) / 3.0 * area[..., None]).sum(axis=(0, 1))
    return moment / total, total


@pytest.mark.parametrize("name", ["left", "right"])
def test_lone_caps_are_where_their_visible_surface_projects(name: str) -> None:
    errors: list[Float] = []
    shares: list[float] = []
    renderer = Renderer(SCENE, name)
    view = View(SCENE, name)
    for t in np.linspace(0.0, 60.0, 40):
        snapshot = view.snapshot(float(t))
        markers = renderer.markers(float(t))
        for cap in view.surface.caps:
            ends = snapshot.points[[cap.centre, cap.base]]
            want, area = facing_centroid(ends[0], ends[1], cap.radius_m, view)
            if markers.visible[cap.marker] > 0.999 and area > 15.0:
                errors.append(markers.uv[cap.marker] - want)
                shares.append(float(markers.area[cap.marker]) / area)
    assert len(errors) > 80
    assert np.abs(np.mean(errors, axis=0)).max() < 0.01  # the bias; 0.05 px is asked for
    assert np.std(errors, axis=0).max() < 0.03
    assert np.abs(errors).max() < 0.12
    assert abs(np.mean(shares) - 1.0) < 0.01


def covered(outline: Float, *nearer: Float) -> raster.Coverage:
    """What resting outlines (N, 2) [px] leave of the first, in an image of 200 x 200 pixels."""
    shape, *hiding = (Shape(corners, np.zeros(2)) for corners in (outline, *nearer))
    (cover,) = raster.cover([raster.Marker(shape, hiding)], 1e-3, (200, 200))
    return cover


def test_disc_coverage_equals_its_area_and_centre() -> None:
    angle = np.linspace(0.0, 2.0 * np.pi, 65)[:-1]
    disc = np.array([50.3, 40.8]) + 7.25 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    cover = covered(disc)
    np.testing.assert_allclose(raster.centroid(cover), [50.3, 40.8], atol=0.02)
    assert abs(float(cover.alpha.sum()) / (np.pi * 7.25**2) - 1.0) < 0.02
    assert cover.share == 1.0


def test_coverage_counts_what_hides_and_what_leaves_the_image() -> None:
    square = np.array([[10.0, 10.0], [30.0, 10.0], [30.0, 30.0], [10.0, 30.0]]) - 0.5
    cover = covered(square, square + np.array([10.0, 0.0]))
    assert abs(cover.share - 0.5) < 0.02
    np.testing.assert_allclose(raster.centroid(cover), [14.5, 19.5], atol=0.1)
    out = covered(square - np.array([20.0, 0.0]))
    assert abs(out.share - 0.5) < 0.03
    gone = covered(square - np.array([60.0, 0.0]))
    assert gone.share == 0.0
    assert np.isnan(raster.centroid(gone)).all()


def test_markers_measured_together_are_as_if_measured_alone() -> None:
    square = np.array([[10.0, 10.0], [30.0, 10.0], [30.0, 30.0], [10.0, 30.0]]) - 0.25
    triangle = np.array([[20.0, 5.0], [45.0, 25.0], [22.0, 60.0]])
    moving, still = Shape(square, np.array([900.0, -300.0])), Shape(triangle, np.zeros(2))
    markers = [raster.Marker(moving, (still,)), raster.Marker(still, (), moving), raster.Marker(still)]
    together = raster.cover(markers, 5e-3, (200, 200))
    for marker, cover in zip(markers, together, strict=True):
        (alone,) = raster.cover([marker], 5e-3, (200, 200))
        np.testing.assert_array_equal(cover.alpha, alone.alpha)
        assert (cover.x, cover.y, cover.share) == (alone.x, alone.y, alone.share)
    assert together[0].share < 0.9  # what lies before it counts
    assert together[1].share == 1.0  # what it hides of itself does not
    assert raster.cover([], 5e-3, (200, 200)) == []


def test_exposure_smears_coverage_about_its_middle() -> None:
    angle = np.linspace(0.0, 2.0 * np.pi, 65)[:-1]
    disc = np.array([50.3, 40.8]) + 7.25 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    (cover,) = raster.cover([raster.Marker(Shape(disc, np.array([1000.0, 0.0])))], 6e-3, (200, 200))
    np.testing.assert_allclose(raster.centroid(cover), [50.3, 40.8], atol=0.03)
    assert (cover.alpha > 0.0).any(axis=0).sum() >= 19  # 14.5 px wide, and 5 px of way between first and last


@pytest.mark.parametrize("radii", [(5.0, 2.0), (2.0, 5.0), (4.0, 4.0)])
def test_capsule_lies_about_both_discs_and_touches_them(radii: tuple[float, float]) -> None:
    ends = np.array([[10.0, 20.0], [31.0, 7.0]])
    size = np.array(radii)
    outline = raster.capsules(ends[:1], size[:1], ends[1:], size[1:])[0]
    reach = np.hypot(*(outline[:, None] - ends).transpose(2, 0, 1))
    assert (reach >= size - 1e-9).all()
    np.testing.assert_allclose((reach - size).min(axis=1), 0.0, atol=1e-9)


def test_swallowed_disc_leaves_the_larger_one() -> None:
    outline = raster.capsules(np.zeros((1, 2)), np.array([5.0]), np.array([[1.0, 0.0]]), np.array([2.0]))
    np.testing.assert_allclose(np.hypot(*outline[0].T), 5.0)


def test_fist_hides_every_tip_and_the_open_hand_shows_all() -> None:
    assert (LEFT.markers(0.0).visible > 0.99).all()
    fist = LEFT.markers(13.5).visible  # small grasp
    assert (fist[:5] < 0.05).all()
    assert fist[5] > 0.99
    pointing = LEFT.markers(12.2).visible
    assert pointing[1] > 0.99
    assert (pointing[[2, 3, 4]] < 0.05).all()


def gaps(hidden: Bool, step_s: float) -> list[float]:
    """Lengths [s] of the runs of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], hidden.astype(int), [0]])))
    return [float(b - a) * step_s for a, b in zip(edges[::2], edges[1::2], strict=True)]


@pytest.mark.parametrize(("start", "least"), [(27.8, 3), (57.2, 4)])
def test_card_makes_gaps_of_real_length(start: float, least: int) -> None:
    times = np.arange(start, start + 2.2, 1 / 60)
    for renderer in (LEFT, RIGHT):
        seen = np.array([renderer.markers(float(t)).visible for t in times])
        found = [gap for m in range(6) for gap in gaps(seen[:, m] < 0.5, 1 / 60)]
        assert len(found) >= least
        assert all(0.16 <= gap <= 0.57 for gap in found), found


def test_card_is_drawn_not_just_claimed() -> None:
    card = Card(middle_s=0.0, width_m=0.5, top_m=-0.4, bottom_m=0.4, depth_m=0.3, speed_m_s=0.01)
    image = Renderer(replace(SCENE, cards=(card,)), "left").render(0.0)
    assert image[100:380, 150:490].max() < 90


def test_rolling_shutter_and_speed_move_a_marker_by_its_rows_time() -> None:
    state = SCENE.motion.at(0.0)
    still = replace(SCENE, motion=Steady(state), cards=())
    moving = replace(SCENE, motion=Steady(state, (1.0, 0.0, 0.0)), cards=())
    a, b = (Renderer(scene, "left").markers(0.0) for scene in (still, moving))
    row_s = CAMERAS["left"].row_time_us * 1e-6
    np.testing.assert_allclose(a.t_s, a.uv[:, 1] * row_s, atol=4.0 * row_s)
    for m in range(6):
        truth = moving.truth(float(b.t_s[m]))
        start = moving.truth(0.0)
        way = SCENE.optics["left"].project(truth.markers_m[m]) - SCENE.optics["left"].project(
            start.markers_m[m]
        )
        np.testing.assert_allclose(
            b.uv[m] - a.uv[m], way, atol=0.15
        )  # the view of a cap changes a little, too
        assert way[0] > 2.0


def hsv_of(image: Image) -> Image:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2HSV), dtype=np.uint8)


def inside(hsv: Image, colour: HsvRange) -> Bool:
    return np.asarray(((hsv >= colour.hsv_low) & (hsv <= colour.hsv_high)).all(axis=-1))


def test_colours_of_the_camera_files_find_their_marker_and_nothing_else() -> None:
    for name, renderer in zip(RIG.cameras, (LEFT, RIGHT), strict=True):
        markers = CAMERAS[name].markers
        assert markers is not None
        colours = {marker: markers[marker] for marker in RIG.markers}  # those of other rigs are there, too
        for t in (0.0, 9.5, 16.2, 21.4, 25.0, 28.8, 45.6, 50.1):
            image, view = renderer.observe(t)
            hsv = hsv_of(image)
            v, u = np.mgrid[0:480, 0:640]
            for m, colour in enumerate(colours.values()):
                found = inside(hsv, colour)
                if view.area[m] > 40.0 and view.visible[m] > 0.9:
                    assert found.sum() > 0.5 * view.area[m], (name, t, m)
                near = np.zeros_like(found)
                for uv in view.uv:  # the rim between two colours may look like a third
                    near |= np.hypot(u - uv[0], v - uv[1]) < 25.0
                assert not (found & ~near).any(), (name, t, m)


@pytest.mark.parametrize("rig", ["desk", "desk-back3", "desk-wand"])
def test_hsv_ranges_of_two_markers_of_one_rig_never_meet(rig: str) -> None:
    shown = load(ROOT / f"calib_json/rigs/{rig}.json", RigCalibration)
    for camera in CAMERAS.values():
        assert camera.markers is not None
        spans = sorted((camera.markers[m].hsv_low[0], camera.markers[m].hsv_high[0]) for m in shown.markers)
        assert len(spans) == len(shown.markers)
        assert all(a[1] < b[0] for a, b in itertools.pairwise(spans))
        skin = cv2.cvtColor(
            np.array([[light.shades(light.SKIN_LINEAR_RGB)[3]]], np.uint8), cv2.COLOR_BGR2HSV
        )[0, 0]
        assert all(not lo <= int(skin[0]) <= hi for lo, hi in spans)


def test_image_is_bytes_of_the_right_size_and_the_same_every_time() -> None:
    image = LEFT.render(21.0)
    assert image.shape == (480, 640, 3)
    assert image.dtype == np.uint8
    np.testing.assert_array_equal(image, Renderer(SCENE, "left").render(21.0))
    assert (image != RIGHT.render(21.0)).any()
    noise = image.astype(float)[:60] - LEFT.render(21.2).astype(float)[:60]
    assert 1.0 < noise.std() / np.sqrt(2.0) < 3.0  # fresh sensor noise on a desk that stays


def test_srgb_tables_invert_each_other() -> None:
    ramp = np.arange(256, dtype=np.uint8).reshape(1, -1, 1)
    assert np.abs(light.encode(light.decode(ramp)).astype(int) - ramp.astype(int)).max() <= 1
    assert light.to_srgb(np.array(0.2140411)) == pytest.approx(0.5, abs=1e-6)  # IEC 61966-2-1


def test_unknown_camera_and_paint_are_refused() -> None:
    with pytest.raises(CalibrationError, match="middle-camera"):
        Renderer(SCENE, "middle-camera")
    with pytest.raises(CalibrationError, match="elbow"):
        light.marker_colour("elbow")


def test_recording_has_the_form_and_the_exact_truth(tmp_path: Path) -> None:
    folder = tmp_path / "short"
    assert record_scene(folder, SCENE, 3 / 60, start_s=20.5) == 3
    recording = open_recording(folder)
    assert recording.manifest.marker_rig() == RIG
    left, right = recording.frames_of("left"), recording.frames_of("right")
    assert [row.seq for row in left] == [0, 1, 2]
    assert right[0].t_ns - left[0].t_ns == 5_000_000
    assert left[0].t_ns == 21_500_000_000
    image = cv2.imread(str(folder / right[1].file))
    np.testing.assert_array_equal(image, RIGHT.render(20.5 + 1 / 60 + 0.005))
    with np.load(folder / "truth.npz") as truth:
        assert truth["uv"].shape == (3, 2, 6, 2)
        assert truth["frac"].shape == (3, 2, 6)
        assert truth["joints"].shape == (3, 25, 3)
        assert truth["angles"].shape == (3, 21)
        reference = SCENE.truth(float(truth["t_ref"][1]))
        np.testing.assert_allclose(truth["paint_centroid"][1], reference.markers_m)
        np.testing.assert_allclose(truth["T_palm"][1], reference.T_rig_palm)
        pip = [ANGLE_NAMES.index(f"{f}_pip") for f in ("index", "middle", "ring", "little")]
        np.testing.assert_allclose(truth["angles"][1][pip], reference.angles_rad[1:, 2])
        # README of the rendered recordings: t_ref is the middle of the exposure of the centre row, left camera.
        np.testing.assert_allclose(truth["t_ref"] - truth["t_row0"][:, 0], 239.5 * 20.6e-6)
        for m, marker in enumerate(RIG.markers):
            np.testing.assert_allclose(recording.manifest.clicks["left"][marker], truth["uv"][0, 0, m])
    with pytest.raises(RecordingError, match="already"):
        record_scene(folder, SCENE, 1 / 60)


def test_surface_moves_rigidly_with_the_palm() -> None:
    surface = HandSurface.of(SCENE.model, RIG.markers)
    angles = SCENE.truth(3.0).angles_rad
    T = SCENE.truth(24.0).T_rig_palm
    chains = SCENE.model.chains(angles)
    moved, still = surface.key_points(T, chains), surface.key_points(np.eye(4), chains)
    hand = [k for k in range(len(surface.weights)) if k != 28]  # the far end of the sleeve follows the elbow
    np.testing.assert_allclose(moved[hand], still[hand] @ T[:3, :3].T + T[:3, 3], atol=1e-12)
