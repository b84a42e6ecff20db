"""A bent wrist turns the palm before the camera; what the hand holds hides fingers and takes their light."""

from dataclasses import dataclass, field, replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from common.arrays import Float
from common.calibration import CameraCalibration, HandProfile, RigCalibration, load
from common.geometry.tapered_capsules import Capsules
from common.geometry.transforms import axis_rotation, quaternion_to_matrix, rigid
from common.hand.wrist import STRAIGHT, forearm_palm
from common.recording.frame_recording import Illumination
from common.sim.motion import Cylinder, HandMotion, HandState
from common.sim.scenes import scene_by_name
from common.sim.sensors import SimulatedImu
from common.sim.two_rigs import TWO_RIG_SCENES
from common.sim.wrist.capsules import THING_GROUP, bodies_of
from common.sim.wrist.render import SURFACE_AT_M, WristRenderer, led_levels
from common.sim.wrist.scene import WristScene
from common.sim.wrist.surface import HandSurface

CALIB = Path(__file__).resolve().parents[4] / "calib_json"
CAMERAS = {"wrist": load(CALIB / "cameras/wrist.json", CameraCalibration)}
RIG = load(CALIB / "rigs/wrist.json", RigCalibration)
HAND = load(CALIB / "hands/default-right.json", HandProfile)
DESK = load(CALIB / "rigs/desk.json", RigCalibration)
DESK_CAMERAS = {name: load(CALIB / f"cameras/{name}.json", CameraCalibration) for name in DESK.cameras}
SCENE = WristScene.by_name("poses@dark", RIG, CAMERAS, HAND, 5)
WRIST_ANGLES = np.radians([-18.0, 7.0])
LASER, LED = Illumination.LASER, Illumination.LED
ACROSS = rigid(axis_rotation(1, np.pi / 2), np.array([0.0, -0.033, 0.075]))  # a grip of the palm
COARSE = 4


@dataclass(frozen=True)
class Doing:
    """A motion with a bent wrist, and a cylinder that goes with the palm."""

    motion: HandMotion
    wrist_angles_rad: Float = field(default_factory=lambda: STRAIGHT)
    T_palm_thing: Float | None = None
    period_s: float = 60.0

    def at(self, t_s: float) -> HandState:
        state = self.motion.at(t_s)
        if self.T_palm_thing is None:
            return replace(state, wrist_angles_rad=self.wrist_angles_rad)
        held = Cylinder(state.T_rig_palm @ self.T_palm_thing, 0.025, 0.14, held=True)
        return replace(state, wrist_angles_rad=self.wrist_angles_rad, things=(held,))


def bodies_at(shown: WristScene, t_s: float) -> Capsules:
    return shown.bodies_of(shown.motion.at(t_s))


def doing(wrist_angles_rad: Float = STRAIGHT, thing: Float | None = None) -> WristScene:
    return replace(SCENE, motion=Doing(SCENE.motion, wrist_angles_rad, thing))


@pytest.mark.parametrize("t_s", [4.0, 19.0])
def test_a_flexed_wrist_is_seen_as_a_device_that_is_mounted_so(t_s: float) -> None:
    T = SCENE.T_camera_palm @ rigid(forearm_palm(WRIST_ANGLES), np.zeros(3))
    device = replace(SCENE, rig=msgspec.structs.replace(RIG, T_camera_palm=tuple(map(tuple, T.tolist()))))
    flexed, same = doing(WRIST_ANGLES), device.truth(t_s)
    truth = flexed.truth(t_s)
    np.testing.assert_array_equal(truth.wrist_angles_rad, WRIST_ANGLES)
    np.testing.assert_allclose(truth.joints.position_m, same.joints.position_m, atol=1e-12)
    np.testing.assert_allclose(truth.laser_uv, same.laser_uv, atol=1e-6)
    np.testing.assert_allclose(truth.laser_len_vis, same.laser_len_vis, atol=1e-9)
    np.testing.assert_array_equal(truth.tip_visible, same.tip_visible)
    assert np.nanmax(np.abs(truth.laser_uv - SCENE.truth(t_s).laser_uv)) > 20.0  # or nothing was bent
    for lit in (LASER, LED):
        one, other = (
            WristRenderer(s, "wrist", COARSE).render(t_s, lit).astype(int) for s in (flexed, device)
        )
        assert (np.abs(one - other) > 2).mean() < 1e-3  # rounding decides which texel an edge has


def test_the_forearm_stays_before_its_camera_when_the_wrist_bends() -> None:
    flexed, straight = bodies_at(doing(WRIST_ANGLES), 4.0), bodies_at(SCENE, 4.0)
    forearm = SCENE.capsules.forearm
    np.testing.assert_allclose(flexed.start_m[forearm], straight.start_m[forearm], atol=1e-12)
    moved = np.linalg.norm(flexed.stop_m - straight.stop_m, axis=1)
    assert np.delete(moved, forearm).min() > 0.001


def test_a_palm_that_never_bends_is_prepared_once_and_one_that_hardly_bends_looks_alike() -> None:
    surface = HandSurface(SCENE, COARSE)
    assert surface.palm(bodies_at(SCENE, 7.0), np.zeros(2)) is surface.straight
    hardly = doing(np.array([1e-9, 0.0]))
    assert (
        surface.palm(bodies_at(hardly, 7.0), hardly.motion.at(7.0).wrist_angles_rad) is not surface.straight
    )
    one, other = (WristRenderer(s, "wrist", COARSE).render(7.0, LED).astype(int) for s in (SCENE, hardly))
    assert (one != other).mean() < 1e-3


def test_a_palm_bent_out_of_the_picture_leaves_it_empty() -> None:
    away = doing(np.array([-1.6, 0.0]))
    assert not len(
        HandSurface(away, COARSE).palm(bodies_at(away, 7.0), away.motion.at(7.0).wrist_angles_rad).seen.pixel
    )
    assert WristRenderer(away, "wrist", COARSE).render(7.0, LED).max() < 12
    assert np.isnan(away.truth(7.0).laser_uv).all()


def test_a_thing_out_of_everybodys_way_changes_nothing() -> None:
    away = rigid(np.eye(3), np.array([0.0, 0.4, 0.0]))  # on the back of the hand
    shown = doing(thing=away)
    for lit in (LASER, LED):
        one, other = (WristRenderer(s, "wrist", COARSE).render(7.0, lit) for s in (SCENE, shown))
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(shown.truth(7.0).laser_uv, SCENE.truth(7.0).laser_uv)


def test_a_thing_takes_the_laser_from_the_fingers_and_hides_them() -> None:
    shown, t_s = doing(thing=ACROSS), 16.0
    with_it, without = shown.truth(t_s), SCENE.truth(t_s)
    assert (without.laser_len_vis[2:6] > 0.005).sum() >= 3  # a pose with fingers in the light
    assert (with_it.laser_len_lit <= without.laser_len_lit + 1e-9).all()
    assert (with_it.laser_len_lit[2:6] == 0.0).sum() >= 3
    assert (with_it.tip_visible <= without.tip_visible).all()
    bodies = bodies_at(shown, t_s)
    curve = shown.sheet.cross(bodies)
    on_it = curve.points[curve.group == THING_GROUP]
    assert len(on_it) > 100
    start, stop = bodies.start_m[-1], bodies.stop_m[-1]
    along = np.clip((on_it - start) @ (stop - start) / ((stop - start) @ (stop - start)), 0.0, 1.0)
    off = np.linalg.norm(on_it - start - along[:, None] * (stop - start), axis=1)
    np.testing.assert_allclose(off, 0.025, atol=1e-9)
    assert np.abs(on_it @ shown.sheet.normal - shown.sheet.offset_m).max() < 1e-9


def test_a_dark_thing_gives_little_light_back() -> None:
    shown, t_s = doing(thing=ACROSS), 16.0
    curve = shown.sheet.cross(bodies_at(shown, t_s))
    middle = curve.points[(curve.group == THING_GROUP) & curve.seen]
    u, v = np.round(shown.optics.project(middle[len(middle) // 2])).astype(int)
    around = np.s_[v - 3 : v + 4, u - 3 : u + 4]
    renderer, bare = (WristRenderer(s, "wrist", COARSE) for s in (shown, SCENE))
    assert 8.0 < renderer.render(t_s, LED)[around].mean() < 0.2 * bare.render(t_s, LED)[around].mean() + 8.0
    line = renderer.exposed(60.0, np.full(3, 0.1)).render(t_s, LASER).astype(float) - 2.0
    finger = bare.exposed(60.0, np.full(3, 0.1)).render(t_s, LASER).astype(float) - 2.0
    assert 3.0 < line[around].max() < 0.12 * finger.max()


def test_behind_a_thing_the_leds_do_not_shine() -> None:
    across = rigid(axis_rotation(0, np.pi / 2), np.array([0.0, 0.0, 0.5 * SURFACE_AT_M]))
    bar = bodies_of([Cylinder(across, 0.004, 0.06, False)], np.eye(4))
    leds = np.array([[0.01, 0.0, 0.0], [-0.01, 0.0, 0.0]])
    # The shadow of the bar's axis by each LED, the middle between them, and far outside.
    points = np.array([[x, 0.0, SURFACE_AT_M] for x in (-0.01, 0.01, 0.0, 0.05)], dtype=np.float32)
    normals = np.tile(np.array([0.0, 0.0, -1.0], dtype=np.float32), (4, 1))
    whole, shaded = led_levels(leds, points, normals), led_levels(leds, points, normals, bar)
    assert 0.3 < shaded[0] / whole[0] < 0.7
    assert shaded[0] == pytest.approx(shaded[1], rel=1e-5)
    np.testing.assert_array_equal(shaded[2:], whole[2:])
    on_bar = np.array([[0.0, 0.0, 0.5 * SURFACE_AT_M - 0.004]], dtype=np.float32)
    np.testing.assert_array_equal(
        led_levels(leds, on_bar, normals[:1], bar), led_levels(leds, on_bar, normals[:1])
    )


def test_the_round_ends_hold_as_much_as_flat_ones_and_a_disc_is_refused() -> None:
    T_camera_rig = rigid(axis_rotation(0, 0.5), np.array([0.01, 0.02, 0.1]))
    cone = bodies_of([Cylinder(ACROSS, 0.02, 0.1, True)], T_camera_rig)
    axis = (cone.stop_m - cone.start_m)[0]
    length = float(np.linalg.norm(axis))
    assert np.pi * 0.02**2 * length + 4.0 / 3.0 * np.pi * 0.02**3 == pytest.approx(np.pi * 0.02**2 * 0.1)
    np.testing.assert_allclose(axis / length, (T_camera_rig @ ACROSS)[:3, 2], atol=1e-12)
    with pytest.raises(ValueError, match="shorter than its width"):
        bodies_of([Cylinder(ACROSS, 0.05, 0.02, False)], T_camera_rig)


def test_an_imu_next_to_the_camera_feels_the_forearm_and_not_the_palm() -> None:
    @dataclass(frozen=True)
    class Nodding:
        """The palm stands in the room while the wrist bends by 0.5 rad/s: it is the forearm that turns."""

        period_s: float = 60.0

        def at(self, t_s: float) -> HandState:
            return replace(SCENE.motion.at(0.0), wrist_angles_rad=np.array([0.5 * (t_s - 1.0), 0.0]))

    imu = RIG.imu
    assert imu is not None
    assert imu.q_palm_imu is not None
    sensor = SimulatedImu.of(replace(SCENE, motion=Nodding()))
    half = SimulatedImu.of(replace(SCENE, motion=Doing(Nodding()))).sample(120, 1.0, 0)
    rotated = sensor.sample(120, 1.0, 0).gyro_rad_s - half.gyro_rad_s
    # R_rig_forearm = R_rig_palm R_x(-bend): the forearm turns about the palm's x, the other way.
    expected = quaternion_to_matrix(np.array(imu.q_palm_imu)).T @ np.array([-0.5, 0.0, 0.0])
    np.testing.assert_allclose(rotated, expected, atol=0.02)  # its scale is off by 1 %


@pytest.mark.parametrize("name", TWO_RIG_SCENES)
def test_what_marker_rigs_see_at_the_same_time_is_found_by_name(name: str) -> None:
    shown = WristScene.by_name(f"{name}@dark", RIG, CAMERAS, HAND, 7)
    seen = scene_by_name(name, DESK, DESK_CAMERAS, HAND, 7)
    assert shown.ambient == "dark"
    assert shown.period_s == seen.period_s
    for t_s in (0.9, 5.3):
        ours, theirs = shown.motion.at(t_s), seen.motion.at(t_s)
        np.testing.assert_array_equal(ours.angles_rad, theirs.angles_rad)
        np.testing.assert_array_equal(ours.wrist_angles_rad, theirs.wrist_angles_rad)
        assert len(ours.things) == len(theirs.things) == int(name == "grasp")
    assert np.degrees(np.abs([shown.truth(t).wrist_angles_rad for t in (0.9, 2.1, 5.3)])).max() > 1.0


def test_a_closed_hand_keeps_lines_and_tips_in_sight_beyond_the_bar_it_holds() -> None:
    shown = WristScene.by_name("grasp", RIG, CAMERAS, HAND, 7)
    held = [t for t in np.arange(0.0, 12.0, 0.2).tolist() if shown.motion.at(t).things[0].held]
    truths = [shown.truth(t) for t in held]
    assert len(truths) > 20
    assert np.mean([truth.laser_len_vis[1:6] > 0.002 for truth in truths]) > 0.8
    assert np.mean([truth.tip_visible for truth in truths]) > 0.5
