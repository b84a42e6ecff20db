"""Objects in the simulated scene: where they are, which features a camera sees of them, and that a picture shows it."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

from common.arrays import Float
from common.calibration import CameraCalibration, HandProfile, RigCalibration, load
from common.calibration.object_profile import ObjectProfile, TagFamily, Tags, tag_corners
from common.errors import CalibrationError
from common.geometry.tag_family import dictionary, tag_image
from common.geometry.transforms import axis_rotation, invert, rigid, transform
from common.recording.frame_recording import open_recording
from common.sim.motion import PERIOD_S, HandState
from common.sim.objects_seen import INK, PAPER, TEXELS, printed
from common.sim.painter import MarkerView, Painter
from common.sim.record import record_scene
from common.sim.render import Renderer
from common.sim.scene import Card, Scene
from common.sim.scenes import SHUTTLE_M_S, scene_by_name
from common.sim.tracked import facing
from common.sim.view import View

ROOT = Path(__file__).resolve().parents[3]
RIGS = {
    n: load(ROOT / f"calib_json/rigs/{n}.json", RigCalibration) for n in ("desk", "desk-wand", "desk-cube")
}
CAMERAS = {n: load(ROOT / f"calib_json/cameras/{n}.json", CameraCalibration) for n in ("left", "right")}
OBJECTS = {n: load(ROOT / f"calib_json/objects/{n}.json", ObjectProfile) for n in ("wand", "cube")}
HAND = load(ROOT / "calib_json/hands/default-right.json", HandProfile)


def scene_of(name: str, rig: str, seed: int = 7) -> Scene:
    return scene_by_name(name, RIGS[rig], CAMERAS, HAND, seed, OBJECTS)


class Placed:
    """A hand far aside, and an object at a place that glides."""

    period_s = PERIOD_S

    def __init__(self, pose: Float, velocity_m_s: Float | None = None, hand_m: Float | None = None) -> None:
        state = scene_of("object", "desk").motion.at(0.0)
        aside = np.array([0.5, 0.0, 0.0]) if hand_m is None else hand_m
        palm = rigid(state.T_rig_palm[:3, :3], state.T_rig_palm[:3, 3] + aside)
        self._state = replace(state, T_rig_palm=palm)
        self._pose, self._velocity = pose, np.zeros(3) if velocity_m_s is None else velocity_m_s

    def at(self, t_s: float) -> HandState:
        pose = rigid(self._pose[:3, :3], self._pose[:3, 3] + t_s * self._velocity)
        return replace(self._state, objects=(pose,))


def placed(rig: str, motion: Placed, objects: Mapping[str, ObjectProfile] = OBJECTS) -> Scene:
    return Scene.of_motion(RIGS[rig], CAMERAS, HAND, motion, 7, objects)


def markers_of(scene: Scene, camera: str, t_s: float = 0.0) -> MarkerView:
    """What a camera sees of everything, without its picture."""
    view = View(scene, camera)
    painter, snapshot = Painter(view), view.snapshot(t_s)
    return painter.truth(painter.cover(snapshot, view.cards(snapshot)), snapshot)


MIDDLE = rigid(facing(0.3), np.array([0.03, 0.0, 0.5]))


def test_a_rig_whose_objects_are_not_there_or_do_not_fit_is_refused() -> None:
    with pytest.raises(CalibrationError, match="no object file for 'wand'"):
        scene_by_name("object", RIGS["desk-wand"], CAMERAS, HAND, 7)
    bound = msgspec.structs.replace(RIGS["desk-wand"], free_markers=("wand1", "wand2"))
    with pytest.raises(CalibrationError, match=r"markers\.wand3"):
        Scene.standard(bound, CAMERAS, HAND, 7, OBJECTS)


def test_the_object_travels_turns_rests_and_comes_back() -> None:
    seed = 7
    motion = scene_of("object", "desk-wand", seed).motion
    step = 1.0 / 50.0
    times = np.arange(0.0, PERIOD_S, step)
    poses = np.array([motion.at(float(t)).objects[0] for t in times])
    again = motion.at(PERIOD_S + 7.0).objects[0]
    np.testing.assert_allclose(again, poses[350], atol=1e-9)
    np.testing.assert_allclose(motion.at(PERIOD_S - 1e-7).objects[0], poses[0], atol=1e-6)
    speed = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) / step
    assert 0.9 * SHUTTLE_M_S < speed.max() < 1.05 * SHUTTLE_M_S
    assert np.abs(np.diff(poses, n=2, axis=0)).max() / step**2 < 60.0  # no leap of the speed
    for start in (12.0, 32.0):
        rest = poses[(times > start) & (times < start + 2.9)]
        np.testing.assert_allclose(rest, np.broadcast_to(rest[0], rest.shape), atol=1e-12)
    assert 0.40 < poses[:, 2, 3].min() < poses[:, 2, 3].max() < 0.60
    tilt = poses[:, :3, 2] @ poses[0, :3, 2]
    assert tilt.min() < 0.2  # it turns by more than 78 degrees
    other = scene_of("object", "desk-wand", seed + 1).motion.at(3.0).objects[0]
    assert np.linalg.norm(other[:3, 3] - poses[150, :3, 3]) > 1e-3


def test_the_taken_thing_is_the_object_and_one_that_nothing_moves_rests() -> None:
    plain, held = scene_of("grasp", "desk"), scene_of("grasp", "desk-cube")
    for t in (0.0, 5.0, 8.0):
        (bar,) = plain.truth(t).things
        np.testing.assert_array_equal(held.truth(t).objects["cube"], bar.T_rig_object)
        assert held.truth(t).things == ()
        np.testing.assert_array_equal(held.truth(t).markers_m, plain.truth(t).markers_m)
    resting = scene_of("standard", "desk-wand")
    np.testing.assert_array_equal(resting.truth(1.0).objects["wand"], resting.truth(40.0).objects["wand"])
    seen = markers_of(resting, "left").objects["wand"]
    assert (seen.visible > 0.9).all()


def test_markers_of_the_truth_are_those_of_hand_and_object() -> None:
    now = scene_of("object", "desk-wand").truth(4.0)
    np.testing.assert_array_equal(now.markers_m[:6], scene_of("object", "desk").truth(4.0).markers_m)
    beads = np.array([bead.position_m for bead in OBJECTS["wand"].markers.values()])
    np.testing.assert_allclose(now.markers_m[6:], transform(now.objects["wand"], beads), atol=1e-15)


@pytest.mark.parametrize("velocity", [(0.0, 0.0, 0.0), (0.5, 0.6, -0.2)])
def test_corners_and_beads_are_where_the_object_is_when_their_row_is_exposed(
    velocity: tuple[float, ...],
) -> None:
    way = np.array(velocity)
    cube, wand = (placed(rig, Placed(MIDDLE, way)) for rig in ("desk-cube", "desk-wand"))
    for name in CAMERAS:
        optics, row_s = cube.optics[name], CAMERAS[name].row_time_us * 1e-6
        view = markers_of(cube, name, 0.02)
        seen = view.objects["cube"]
        tags = OBJECTS["cube"].tags
        assert tags is not None
        shown = np.flatnonzero(np.isfinite(seen.corners_uv).all(axis=(1, 2)))
        assert len(shown) >= 1
        for k in shown:
            own = transform(np.array(tags.tags[k].T_object_tag), tag_corners(tags.tags[k].edge_m))
            for corner, uv in zip(own, seen.corners_uv[k], strict=True):
                at = transform(cube.truth(0.02 + float(uv[1]) * row_s).objects["cube"], corner)
                np.testing.assert_allclose(optics.project(at[None])[0], uv, atol=2e-3)
        beads = markers_of(wand, name, 0.02)
        np.testing.assert_allclose(beads.t_s[6:], 0.02 + beads.uv[6:, 1] * row_s, atol=1e-5)
        for m in (6, 7, 8):
            middle = wand.truth(float(beads.t_s[m])).markers_m[m]
            # Perspective moves the centroid of the outline by less than 0.05 px; a rod hides some.
            np.testing.assert_allclose(optics.project(middle[None])[0], beads.uv[m], atol=0.3)


def test_a_lone_bead_covers_the_cone_of_rays_that_meet_its_ball() -> None:
    single = msgspec.structs.replace(OBJECTS["wand"], shape=())
    scene = placed("desk-wand", Placed(MIDDLE), {"wand": single})
    view, optics = markers_of(scene, "right"), scene.optics["right"]
    v, u = np.mgrid[0:1920, 0:2560] / 4.0 - 0.375  # sixteen rays a pixel
    for m, bead in zip((6, 7, 8), single.markers.values(), strict=True):
        middle = transform(invert(optics.T_rig_camera), scene.truth(0.0).markers_m[m])
        near = np.hypot(u - view.uv[m, 0], v - view.uv[m, 1]) < 15.0
        rays = optics.undistort(np.stack([u[near], v[near]], axis=-1))
        rays = np.append(rays, np.ones((len(rays), 1)), axis=1)
        cosine = rays @ middle / np.linalg.norm(rays, axis=1) / np.linalg.norm(middle)
        hit = cosine > np.sqrt(1.0 - (bead.radius_m / np.linalg.norm(middle)) ** 2)
        np.testing.assert_allclose(view.area[m], hit.sum() / 16.0, rtol=0.02)
        assert abs(u[near][hit].mean() - view.uv[m, 0]) < 0.03
        assert abs(v[near][hit].mean() - view.uv[m, 1]) < 0.03
        assert view.visible[m] == 1.0


def test_a_printed_tag_is_ink_on_paper_cell_by_cell() -> None:
    sheet = printed("aruco_5x5_100", 3) / 255.0
    cells = tag_image("aruco_5x5_100", 3, 1)
    inner = sheet[4:-4, 4:-4].reshape(len(cells), TEXELS, len(cells), TEXELS)
    np.testing.assert_allclose(inner.mean(axis=(1, 3)), np.where(cells > 0, PAPER, INK), atol=2e-3)


@pytest.mark.parametrize("family", ["aruco_5x5_100", "apriltag_36h11"])
def test_a_tag_is_read_at_half_a_metre_where_the_truth_has_it(family: TagFamily) -> None:
    known = OBJECTS["cube"].tags
    assert known is not None
    profile = msgspec.structs.replace(OBJECTS["cube"], tags=Tags(family, known.tags))
    rotated = rigid(axis_rotation(2, 0.4) @ facing(0.0), np.array([0.03, 0.0, 0.5]))
    scene = placed("desk-cube", Placed(rotated), {"cube": profile})
    found = dictionary(family, range(5))
    for name in CAMERAS:
        image, view = Renderer(scene, name).observe(0.0)
        corners, ids, _ = cv2.aruco.ArucoDetector(found).detectMarkers(image)
        assert ids is not None
        assert 1 in ids.ravel()  # the face along the object's y
        at = np.asarray(corners[ids.ravel().tolist().index(1)]).reshape(4, 2)
        off = at - view.objects["cube"].corners_uv[1]
        assert np.abs(off).max() < 1.8  # unrefined, on a blurred picture
        assert np.abs(off.mean(axis=0)).max() < 0.5
        side = np.linalg.norm(np.diff(view.objects["cube"].corners_uv[1], axis=0), axis=1)
        assert ((side > 27.0) & (side < 36.0)).all()


def test_what_lies_before_an_object_is_cut_out_of_it_and_it_hides_what_lies_behind() -> None:
    open_scene = placed("desk-wand", Placed(MIDDLE))
    at = markers_of(open_scene, "left")
    # A card that ends in the middle of the uppermost bead.
    top = int(np.argmin(at.uv[6:, 1])) + 6
    middle = open_scene.truth(0.0).markers_m[top]
    card = Card(0.0, 0.5, -0.4, float(middle[1]) * 0.3 / float(middle[2]), 0.3, 1e-6)
    half = markers_of(replace(open_scene, cards=(card,)), "left")
    assert 0.3 < half.visible[top] < 0.7
    assert half.uv[top, 1] > at.uv[top, 1] + 2.0  # the centroid of what is left
    lowest = int(np.argmax(at.uv[6:, 1])) + 6
    assert half.visible[lowest] == at.visible[lowest]
    # The hand before the wand, and the wand before the hand.
    bare = scene_of("object", "desk").truth(0.0)
    for nearer_m, shown in ((-0.08, False), (0.08, True)):
        tip = bare.markers_m[2] - [0.0, -0.03, 0.0]  # in the middle of a finger
        beads = np.array([bead.position_m for bead in OBJECTS["wand"].markers.values()])
        place = tip - facing(0.0) @ beads[1] - np.array([0.0, 0.0, nearer_m])
        scene = placed("desk-wand", Placed(rigid(facing(0.0), place), hand_m=np.zeros(3)))
        renderer = Renderer(scene, "left")
        image, view = renderer.observe(0.0)
        assert (view.visible[7] > 0.9) == shown
        assert (view.visible[7] < 0.6) != shown
        u, v = np.rint(scene.optics["left"].project(scene.truth(0.0).markers_m[7][None])[0]).astype(int)
        _, green, red = image[v, u].astype(int)
        assert (green > red + 40) == shown  # paint, or skin


def test_nothing_changes_for_a_rig_that_tracks_nothing() -> None:
    for name in ("grasp", "standard"):
        plain = scene_by_name(name, RIGS["desk"], CAMERAS, HAND, 7)
        image, view = Renderer(plain, "right").observe(5.0)
        same, again = Renderer(scene_of(name, "desk"), "right").observe(5.0)
        np.testing.assert_array_equal(image, same)
        np.testing.assert_array_equal(view.uv, again.uv)
        assert view.objects == {}
        # A tag at the edge of the view is in nobody's way.
        far = scene_of(name, "desk-cube")
        if name == "standard":
            np.testing.assert_array_equal(markers_of(far, "right").uv, markers_of(plain, "right").uv)


@pytest.mark.parametrize(("rig", "name"), [("desk-wand", "wand"), ("desk-cube", "cube")])
def test_a_recording_says_what_the_object_is_where_it_was_and_what_was_seen(
    tmp_path: Path, rig: str, name: str
) -> None:
    scene = scene_of("object", rig)
    record_scene(tmp_path / "r", scene, 2 / 60, 16.0)
    assert open_recording(tmp_path / "r").manifest.objects == {name: OBJECTS[name]}
    features = scene.tracked.features(0)
    meta = msgspec.json.decode((tmp_path / "r/truth_meta.json").read_bytes())
    assert tuple(meta["objects"][name]) == features
    with np.load(tmp_path / "r/truth.npz") as truth:
        at = [scene.truth(float(t)).objects[name] for t in truth["t_ref"]]
        np.testing.assert_array_equal(truth[f"object_{name}"], at)
        assert truth[f"object_{name}_visible"].shape == (2, 2, len(features))
        assert truth[f"object_{name}_visible"].max() > 0.9
        tags = sum(feature.startswith("tag") for feature in features)
        assert truth[f"object_{name}_corners"].shape == (2, 2, tags, 4, 2)
        assert truth["uv"].shape[2] == len(RIGS[rig].markers)


def test_a_faster_part_is_smeared_more() -> None:
    resting, moving = (
        placed("desk-cube", Placed(MIDDLE, np.array([speed, 0.0, 0.0]))) for speed in (0.0, 0.8)
    )
    sharp, smeared = (Renderer(scene, "left").render(0.0).astype(float) for scene in (resting, moving))
    steep = [np.abs(np.diff(image[..., 1], axis=1)).max() for image in (sharp, smeared)]
    assert steep[1] < 0.8 * steep[0]
    assert View(resting, "left").objects.local.shape == (2 + 8 + 5 * 8, 3)
