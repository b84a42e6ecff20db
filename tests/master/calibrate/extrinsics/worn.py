"""A scene before a marker rig and a wrist device of one hand at another pace, and errors of a fitted mounting."""

from dataclasses import dataclass
from dataclasses import replace as dataclass_replace

import msgspec
import numpy as np

from bench.both.scene import WRIST_RIG, Both
from bench.report import CALIBRATION
from common.arrays import Float
from common.errors import FitError
from common.geometry.transforms import matrix_to_rotation_vector, quaternion_to_matrix
from common.sim.motion import HandMotion, HandState
from common.sim.scenes import scene_by_name
from common.sim.wrist.scene import WristScene
from master.calibrate.extrinsics.extrinsics import Extrinsics
from master.rig.setup import RigSetup, load_setup

CAMERA_LATE_S, IMU_LATE_S = 6e-3, -4e-3


@dataclass(frozen=True, slots=True, eq=False)
class Paced:
    """A motion, so many times as fast."""

    motion: HandMotion
    pace: float

    @property
    def period_s(self) -> float:
        return self.motion.period_s / self.pace

    def at(self, t_s: float) -> HandState:
        return self.motion.at(self.pace * t_s)


def both_of(rig: str, seed: int, pace: float) -> Both:
    """The scene `both-moves` before a marker rig and the wrist device, whose hand is that of the marker rig."""
    markers, wrist = load_setup(CALIBRATION, rig), load_setup(CALIBRATION, WRIST_RIG)
    wrist_rig = msgspec.structs.replace(wrist.rig, hand=markers.rig.hand)
    seen = scene_by_name("both-moves", markers.rig, markers.cameras, markers.hand.profile, seed)
    seen = dataclass_replace(seen, motion=Paced(seen.motion, pace))
    wrist = RigSetup.of(wrist_rig, wrist.cameras, markers.hand)
    worn = WristScene(wrist_rig, wrist.cameras, markers.hand, seen.motion, seed=seed)
    return Both("both-moves", seed, seen, worn, markers, wrist)


def errors(found: Extrinsics, both: Both) -> Float:
    """Turn of the palm [deg], place of the wrist [mm], turn of the IMU against camera [deg], clocks [ms]: (5,)."""
    true, T = np.array(both.wrist.rig.T_camera_palm), np.array(found.rig.T_camera_palm)
    if both.wrist.rig.imu is None:
        raise FitError("no IMU")
    true_imu = true[:3, :3] @ quaternion_to_matrix(np.array(both.wrist.rig.imu.q_palm_imu))
    unknown = found.fit.unknown
    return np.array(
        [
            np.degrees(np.linalg.norm(matrix_to_rotation_vector(T[:3, :3] @ true[:3, :3].T))),
            1e3 * np.linalg.norm(T[:3, 3] - true[:3, 3]),
            np.degrees(np.linalg.norm(matrix_to_rotation_vector(unknown.R_camera_imu @ true_imu.T))),
            1e3 * abs(unknown.camera_late_s - CAMERA_LATE_S),
            1e3 * abs(unknown.imu_late_s - IMU_LATE_S),
        ]
    )
