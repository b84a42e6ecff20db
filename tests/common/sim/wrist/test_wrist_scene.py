"""The simulated laser line lies where light goes: on the plane, on the skin, in no shadow; its sums are right."""

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.arrays import Float
from common.calibration import CameraCalibration, HandProfile, RigCalibration, load
from common.errors import CalibrationError, PhalanxError
from common.geometry.camera_model import CameraModel
from common.geometry.tapered_capsules import Capsules, distances, first_hits, terms
from common.hand.model import HandModel
from common.sim.scenes import renderer_of, view_by_name
from common.sim.sensors import SimulatedImu
from common.sim.wrist.capsules import PALM_GROUP, THENAR_GROUP, THUMB_GROUP, HandCapsules
from common.sim.wrist.render import WristRenderer
from common.sim.wrist.scene import AMBIENTS, MOTIONS, LaserSheet, LineTruth, WristScene

CALIB = Path(__file__).resolve().parents[4] / "calib_json"
CAMERAS = {"wrist": load(CALIB / "cameras/wrist.json", CameraCalibration)}
RIGS = {
    side: load(CALIB / f"rigs/{name}.json", RigCalibration)
    for side, name in (("right", "wrist"), ("left", "wrist-left"))
}
HANDS = {side: load(CALIB / f"hands/default-{side}.json", HandProfile) for side in ("right", "left")}
DESK = load(CALIB / "rigs/desk.json", RigCalibration)
DESK_CAMERAS = {name: load(CALIB / f"cameras/{name}.json", CameraCalibration) for name in DESK.cameras}


AHEAD = np.array([0.0, 0.0, 0.12])


def scene(name: str, seed: int = 3, side: str = "right") -> WristScene:
    return WristScene.by_name(name, RIGS[side], CAMERAS, HANDS[side], seed)


def depth_inside(capsules: Capsules, points: Float) -> Float:
    """How deep points (N, 3) are in the bodies (N, B) [m]; negative: outside.

    A body is a row of balls; the depth in a ball is concave along the row, so its best one is found by thirds.
    """
    low = np.zeros((len(points), len(capsules.start_m)))
    high = np.ones_like(low)

    def depth(share: Float) -> Float:
        centre = capsules.start_m + share[..., None] * (capsules.stop_m - capsules.start_m)
        radius = capsules.start_radius_m + share * (capsules.stop_radius_m - capsules.start_radius_m)
        return radius - np.linalg.norm(points[:, None] - centre, axis=-1)

    for _ in range(36):
        third = (high - low) / 3.0
        left = depth(low + third) < depth(high - third)
        low, high = np.where(left, low + third, low), np.where(left, high, high - third)
    return depth(0.5 * (low + high))


def random_capsules(rng: np.random.Generator, count: int) -> Capsules:
    start = rng.uniform(-0.03, 0.03, (count, 3)) + AHEAD
    way = rng.normal(size=(count, 3))
    stop = start + rng.uniform(0.012, 0.05, (count, 1)) * way / np.linalg.norm(way, axis=1, keepdims=True)
    return Capsules(start, stop, rng.uniform(0.005, 0.011, count), rng.uniform(0.004, 0.011, count))


@settings(max_examples=30)
@given(st.integers(0, 10**6))
def test_a_ray_ends_on_the_surface_and_meets_nothing_before(seed: int) -> None:
    rng = np.random.default_rng(seed)
    capsules = random_capsules(rng, 3)
    aim = rng.uniform(-0.035, 0.035, (6, 3)) + AHEAD
    rays = aim / np.linalg.norm(aim, axis=1, keepdims=True)
    reach = distances(capsules, np.zeros(3), rays)
    single = np.stack(
        [
            first_hits(terms(capsules, np.zeros(3), np.float32)[:, b], rays.T.astype(np.float32))
            for b in range(3)
        ],
        axis=1,
    )
    for ray, far, coarse in zip(rays, reach, single, strict=True):
        for b in range(3):
            body = capsules.of(slice(b, b + 1))
            before = np.linspace(0.0, min(float(far[b]), 0.3), 60)[:-1, None] * ray
            assert depth_inside(body, before).max() < 2e-5
            if np.isfinite(far[b]):
                on_surface = far[b] * ray
                assert abs(depth_inside(body, on_surface[None])[0, 0]) < 2e-5
                normal = capsules.normals(np.array([b]), on_surface[None])[0]
                assert normal @ ray < 1e-3
                assert depth_inside(body, (on_surface + 1e-3 * normal)[None])[0, 0] == pytest.approx(
                    -1e-3, abs=2e-5
                )
                if normal @ ray < -0.2:  # where it is grazed, single precision may miss
                    assert coarse[b] == pytest.approx(far[b], abs=1e-5)


def test_the_line_on_a_ball_is_the_arc_of_its_slice_that_faces_the_laser() -> None:
    sheet, optics = scene("curl").sheet, scene("curl").optics
    radius, above, far = 0.02, 0.012, 0.11
    forward = sheet.forward
    middle = sheet.origin + far * forward + above * sheet.normal
    capsules = HandCapsules(
        joint=np.array([1, 1]),
        start=np.zeros((2, 3)),
        stop=np.zeros((2, 3)),
        start_radius_m=np.full(2, radius),
        stop_radius_m=np.full(2, radius),
        group=np.array([0, 2]),
        segment=np.array([0, 3]),
        tip=np.zeros(5, dtype=np.int64),
        thumb=np.zeros(2, dtype=np.int64),
        forearm=np.zeros(0, dtype=np.int64),
        still=1,
    )
    ball = Capsules(
        np.array([[0.0, 0.0, -1.0], middle]),
        np.array([[0.0, 0.0, -1.001], middle + 1e-9]),
        np.full(2, radius),
        np.full(2, radius),
    )
    alone = replace(
        sheet,
        capsules=capsules,
        still=ball.of(slice(1)),
        still_m=np.full(len(sheet.angle_rad), np.inf),
        still_body=np.zeros(len(sheet.angle_rad), np.int64),
    )
    truth = LineTruth.of(alone.cross(ball), optics, alone)
    slice_radius = np.sqrt(radius**2 - above**2)
    whole = 2.0 * slice_radius * np.arccos(slice_radius / far)
    assert truth.lit_m[2] == pytest.approx(whole, rel=0.02)  # the last ray of each side ends before the edge
    assert truth.lit_m[2] < whole
    assert truth.segment.tolist() == [-1, -1, 3, -1, -1, -1, -1]
    # The camera, above the plane, looks down on the ball: it is behind the ball's upper half that part is hidden.
    assert 0.0 < truth.seen_m[2] <= truth.lit_m[2]


@pytest.mark.parametrize(("side", "t_s"), [("right", 0.4), ("left", 7.3), ("right", 21.0), ("left", 33.3)])
def test_the_line_is_on_the_plane_on_the_surface_and_in_no_shadow(side: str, t_s: float) -> None:
    shown = scene("standard", side=side)
    sheet = shown.sheet
    bodies = shown.capsules.bodies(shown.truth(t_s).joints)
    curve = sheet.cross(bodies)
    some = slice(None, None, 61)
    points = curve.points[some]
    assert len(points) > 10
    assert np.abs(points @ sheet.normal - sheet.offset_m).max() < 1e-9
    angle = np.arccos(
        np.clip(
            (points - sheet.origin) @ sheet.forward / np.linalg.norm(points - sheet.origin, axis=1),
            -1,
            1,
        )
    )
    laser = shown.rig.laser
    assert laser is not None
    assert laser.fan_rad is not None
    assert angle.max() <= 0.5 * laser.fan_rad + 1e-3
    assert np.abs(depth_inside(bodies, points).max(axis=1)).max() < 2e-5
    way = np.linspace(0.0, 1.0, 60)[1:-1, None]
    for point in points[::4]:
        assert depth_inside(bodies, sheet.origin + way * (point - sheet.origin)).max() < 2e-5
    for point in points[curve.seen[some]][::4]:
        assert depth_inside(bodies, way * point).max() < 2.5e-4
    hidden = points[~curve.seen[some] & (points[:, 2] > 0.0)]
    for point in hidden[::4]:
        assert depth_inside(bodies, np.linspace(0.0, 1.0, 300)[1:, None] * point).max() > 1e-6


def test_truth_agrees_with_itself_and_with_the_plane() -> None:
    shown = scene("standard@dark")
    groups = 0
    for t_s in np.linspace(0.0, 59.0, 40).tolist():
        truth = shown.truth(t_s)
        line = np.isfinite(truth.laser_uv[:, 0])
        groups += int(line[1:6].sum())
        np.testing.assert_array_equal(line, truth.laser_len_vis >= 2e-4)
        assert (truth.laser_len_vis <= truth.laser_len_lit + 1e-12).all()
        np.testing.assert_array_equal(truth.laser_seg >= 0, truth.laser_len_vis > 0.0)
        np.testing.assert_allclose(
            shown.optics.project(truth.laser_pt[line]), truth.laser_uv[line], atol=1e-6
        )
        np.testing.assert_allclose(truth.laser_pt[line] @ shown.sheet.normal, shown.sheet.offset_m, atol=1e-9)
        assert np.linalg.norm(truth.laser_pt[line] - truth.laser_xyz[line], axis=1).max() < 0.012
        assert (truth.laser_seg[THENAR_GROUP] <= 0) & (truth.laser_seg[PALM_GROUP] <= 0)
        tip_gap = np.linalg.norm(truth.tip_xyz - truth.joints.position_m[[5, 10, 15, 20, 25]], axis=1)
        assert ((tip_gap > 0.005) & (tip_gap < 0.0105)).all()
    assert groups > 100  # or the loop would say nothing


def test_the_joint_of_the_thumb_parts_it_from_its_ball() -> None:
    shown = scene("poses")
    both = 0
    for t_s in np.arange(1.2, 60.0, 2.5).tolist():
        joints = shown.truth(t_s).joints.position_m
        curve = shown.sheet.cross(shown.capsules.bodies(shown.truth(t_s).joints))
        ball, beyond = (curve.points[curve.group == group] for group in (THENAR_GROUP, THUMB_GROUP))
        before, after = (joints[k + 1] - joints[k] for k in (2, 3))
        halving = before / np.linalg.norm(before) + after / np.linalg.norm(after)
        assert ((ball - joints[3]) @ halving <= 1e-9).all()
        assert ((beyond - joints[3]) @ halving > -1e-9).all()
        both += bool(len(ball)) and bool(len(beyond))
    assert both > 3  # or nothing was parted


def test_a_straight_finger_is_cut_far_out_and_a_bent_one_near_its_root() -> None:
    shown = scene("curl")
    straight, bent = shown.truth(0.0), shown.truth(2.8)
    assert (straight.laser_seg[2:6] >= 2).all()
    assert (bent.laser_seg[2:6] == 1).all()
    assert (straight.laser_pt[2:6, 2] - bent.laser_pt[2:6, 2] > 0.02).all()
    assert np.isfinite(straight.laser_uv[1:6]).all()
    assert bent.tip_visible[1:].all()


def test_a_left_hand_is_the_right_one_mirrored() -> None:
    flip = np.array([-1.0, 1.0, 1.0])
    right, left = (scene("curl", seed=5, side=side).truth(2.0) for side in ("right", "left"))
    np.testing.assert_allclose(left.joints.position_m, right.joints.position_m * flip, atol=1e-6)
    np.testing.assert_allclose(left.tip_xyz, right.tip_xyz * flip, atol=1e-6)


def test_seeds_are_different_hands_and_one_seed_is_one_hand() -> None:
    model = HandModel.of(HANDS["right"])
    one, same, other = (HandCapsules.of(model, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one.start_radius_m, same.start_radius_m)
    assert np.abs(one.start_radius_m - other.start_radius_m).max() > 3e-4
    truths = [scene("standard", seed).truth(11.0) for seed in (1, 1, 2)]
    np.testing.assert_array_equal(truths[0].laser_uv, truths[1].laser_uv)
    assert not np.array_equal(truths[0].laser_uv, truths[2].laser_uv)


@pytest.mark.parametrize("name", MOTIONS)
def test_motions_are_closed_smooth_and_the_palm_stays(name: str) -> None:
    shown = scene(name)
    motion = shown.motion
    np.testing.assert_allclose(
        motion.at(shown.period_s - 1e-9).angles_rad, motion.at(0.0).angles_rad, atol=1e-4
    )
    np.testing.assert_array_equal(motion.at(-1.0).angles_rad, motion.at(0.0).angles_rad)
    angles = np.array([motion.at(t).angles_rad for t in np.arange(0.0, shown.period_s, 1 / 90)])
    assert np.abs(np.diff(angles, axis=0)).max() < np.radians(20.0) / 3.0  # 600 deg/s: nobody is faster
    assert np.degrees(np.ptp(angles[:, 1:, 2], axis=0)).min() > (5.0 if name == "spread" else 60.0)
    at = [shown.truth(t).joints.position_m[[0, 1, 7, 12, 17, 22]] for t in (0.0, 0.3 * shown.period_s)]
    np.testing.assert_allclose(at[0], at[1], atol=1e-12)


def test_the_guided_curl_keeps_the_natural_ratios() -> None:
    motion = scene("curl").motion
    for t_s in (1.0, 3.0, 5.0):
        fingers = motion.at(t_s).angles_rad[1:]
        np.testing.assert_allclose(fingers[:, 1], 0.54 * fingers[:, 2])
        np.testing.assert_allclose(fingers[:, 3], 0.84 * fingers[:, 2])
    assert np.degrees(motion.at(5.0).angles_rad[1, 2]) == pytest.approx(110.0)


def test_scenes_are_found_by_name_and_a_name_of_the_other_kind_is_reported() -> None:
    for motion in MOTIONS:
        shown = view_by_name(motion, RIGS["right"], CAMERAS, HANDS["right"], 7)
        assert isinstance(shown, WristScene)
        assert shown.ambient == "indoor"
    for ambient in AMBIENTS:
        shown = view_by_name(f"poses@{ambient}", RIGS["left"], CAMERAS, HANDS["left"], 7)
        assert isinstance(shown, WristScene)
        assert shown.ambient == ambient
    shown = view_by_name("curl", RIGS["right"], CAMERAS, HANDS["right"], 7)
    assert isinstance(shown, WristScene)
    assert isinstance(renderer_of(shown, "wrist"), WristRenderer)
    for name in ("hand-routine", "lights", "curl@night", "", "leap:x.npz"):
        with pytest.raises(PhalanxError, match=r"for a wrist rig there are standard \| curl"):
            view_by_name(name, RIGS["right"], CAMERAS, HANDS["right"], 7)
    with pytest.raises(PhalanxError, match="there are standard"):
        view_by_name("curl", DESK, DESK_CAMERAS, HANDS["right"], 7)
    with pytest.raises(CalibrationError, match="kind is 'markers'"):
        WristScene.by_name("curl", DESK, DESK_CAMERAS, HANDS["right"], 7)


@pytest.mark.parametrize("key", ["laser_plane", "laser", "T_camera_palm", "led"])
def test_a_device_that_is_not_known_is_refused_with_the_key(key: str) -> None:
    rig = msgspec.structs.replace(RIGS["right"], **{key: None})
    with pytest.raises(CalibrationError, match=key):
        WristScene.by_name("curl", rig, CAMERAS, HANDS["right"], 7)


def test_the_imu_of_a_wrist_feels_the_forearm() -> None:
    samples = list(SimulatedImu.of(scene("standard")).around(2.0, 4.0))
    assert len(samples) > 200
    gravity = [float(np.linalg.norm(sample.accel_m_s2)) for sample in samples]
    assert np.median(gravity) == pytest.approx(9.81, abs=0.5)
    assert max(float(np.linalg.norm(sample.gyro_rad_s)) for sample in samples) > 0.02


def test_the_device_is_one_that_could_be_built() -> None:
    for rig in RIGS.values():
        plane, laser = rig.laser_plane, rig.laser
        assert plane is not None
        assert laser is not None
        assert laser.origin is not None
        assert plane.offset_m == pytest.approx(np.dot(plane.normal, laser.origin), abs=1e-6)
        assert laser.baseline == pytest.approx(0.030, abs=0.001)  # Kim et al. 2012: 3 cm, 105 degrees
        assert laser.fan_rad == pytest.approx(np.radians(105.0))
        optics = CameraModel.of(CAMERAS["wrist"], np.eye(4))
        assert (optics.width_px, optics.height_px, CAMERAS["wrist"].frame_rate_hz) == (640, 400, 90.0)
        assert isinstance(scene("curl").sheet, LaserSheet)
