"""A motion as marker rig, wrist camera and IMU would have it without noise, for the tests of the mounting."""

from dataclasses import dataclass
from functools import cache

import numpy as np
from msgspec.structs import replace

from bench.both.scene import Both
from common.calibration import RigCalibration
from common.geometry.transforms import matrix_to_quaternion, rotation_vector_to_matrix
from common.imu.fusion import OrientationFilter
from common.messages import HandPose, ImuSample, WristDetections
from common.sim.sensors import InertialPart, SimulatedImu
from master.calibrate.tree_files import matrix_of
from tests.master.calibrate.extrinsics.worn import both_of

SECONDS, PACE, HAND_HZ, CYCLE_HZ = 6.4, 2.0, 60.0, 20.0
ZERO_NS = 1_000_000_000
CAMERA_LATE_NS, IMU_LATE_NS = 6_000_000, -4_000_000
PERFECT = InertialPart(0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class Moved:
    """What was seen and felt; `rig` is wrong, `both` is right."""

    both: Both
    rig: RigCalibration
    poses: list[HandPose]
    cycles: list[WristDetections]
    samples: list[ImuSample]


@cache
def moved() -> Moved:
    """The motion before rig desk-back3, with clocks that differ, and a palm that is drawn 4 degrees and 4 mm off."""
    both = both_of("desk-back3", 3, PACE)
    rig, palm = both.wrist.rig, np.array(both.wrist.rig.T_camera_palm)
    palm[:3, :3] = rotation_vector_to_matrix(np.radians([3.0, -2.0, 2.0])) @ palm[:3, :3]
    palm[:3, 3] += [2e-3, -2e-3, 3e-3]
    assert rig.imu is not None
    wrong = replace(
        rig, T_camera_palm=matrix_of(palm), imu=replace(rig.imu, q_palm_imu=None, q_rig_world=None)
    )
    poses = [pose_at(both, t) for t in np.arange(0.0, SECONDS, 1.0 / HAND_HZ).tolist()]
    cycles = [cycle_at(both, t) for t in np.arange(0.1, SECONDS - 0.1, 1.0 / CYCLE_HZ).tolist()]
    sensor = SimulatedImu(SimulatedImu.of(both.wrist_scene)._motion, rig.imu, 3, PERFECT)
    fusion = OrientationFilter(sensor.rate_hz)
    samples = [fusion.push(one) for one in sensor.around(0.0, SECONDS, ZERO_NS - IMU_LATE_NS)]
    return Moved(both, wrong, poses, cycles, samples)


def pose_at(both: Both, t_s: float) -> HandPose:
    """The hand as markers would have it at scene time `t_s` [s]."""
    truth = both.scene.truth(t_s)
    yes, count = np.ones(26, np.bool_), len(truth.markers_m)
    return HandPose(
        hand="hand",
        t_ns=ZERO_NS + round(1e9 * t_s),
        position_m=truth.joints.position_m,
        orientation_wxyz=matrix_to_quaternion(truth.joints.rotation),
        radius_m=np.full(26, 0.01),
        valid=yes,
        tracked=yes,
        cov_m2=np.full((26, 3, 3), np.nan),
        source=np.zeros(26, np.uint8),
        angles_rad=truth.angles_rad,
        markers_m=truth.markers_m,
        markers_raw_m=truth.markers_m,
        markers_cov_m2=np.tile(2.5e-7 * np.eye(3), (count, 1, 1)),
        inside_volume=yes,
    )


def cycle_at(both: Both, t_s: float) -> WristDetections:
    """What the wrist camera would see in the triple whose laser shines at scene time `t_s` [s], stamped too early."""
    camera = both.wrist.rig.cameras[0]
    frame_s = 1.0 / both.wrist.cameras[camera].frame_rate_hz
    laser, led = both.wrist_scene.truth(t_s), both.wrist_scene.truth(t_s + frame_s)
    line = np.where((laser.laser_len_vis[1:6] > 3e-3)[:, None], laser.laser_uv[1:6], np.nan)
    tips = np.where(led.tip_visible[:, None], led.tip_uv, np.nan)
    t_ns = ZERO_NS + round(1e9 * t_s) - CAMERA_LATE_NS
    return WristDetections(
        camera=camera,
        session=1,
        seq=3 * round(t_s * CYCLE_HZ),
        t_ns=t_ns,
        ready_t_ns=t_ns,
        laser_uv=line,
        laser_sigma_px=np.where(np.isnan(line[:, 0]), np.nan, 0.5),
        laser_px=np.where(np.isnan(line[:, 0]), np.nan, 30.0),
        tip_uv=tips,
        tip_sigma_px=np.where(np.isnan(tips[:, 0]), np.nan, 3.0),
        tip_depth=np.full(5, np.nan),
    )
