"""People who wear a wrist device for the first time: their files, their true hands, and simulated detections.

The files are wrong in the pose of the palm (3 degrees and 2 mm per axis) and in the knuckles (5 mm per axis);
the bones are those of a participant of the study, measured. Detections are the simulated truth with noise, and one
tip in twenty is none.
"""

from dataclasses import dataclass

import numpy as np
from msgspec.structs import replace

from bench.report import rig_files
from bench.study.people import participant
from common.arrays import Float
from common.calibration import CameraCalibration, HandProfile, RigCalibration
from common.geometry.transforms import matrix_to_rotation_vector, transform
from common.hand.model import CHAINS, JOINTS, HandModel
from common.messages import WristDetections
from common.sim.wrist.scene import WristScene

LASER_PX, TIP_PX, FALSE_TIPS, FALSE_PX = 0.4, 3.0, 0.05, 60.0
EVERY_S = 0.2


@dataclass(frozen=True, slots=True, eq=False)
class Person:
    """One of them.

    Attributes:
        seed: Same seed, same person.
        camera: Of the device.
        rig, hand: As the files have them.
        true_rig, true_hand: As they are.
    """

    seed: int
    camera: CameraCalibration
    rig: RigCalibration
    hand: HandProfile
    true_rig: RigCalibration
    true_hand: HandProfile

    @classmethod
    def of(cls, seed: int, knuckles_m: float = 5e-3) -> "Person":
        """Draw one; even seeds have right hands. `knuckles_m`: how far each knuckle is off, per axis, either way."""
        left = bool(seed % 2)
        rig, cameras, typical = rig_files("wrist-left" if left else "wrist")
        camera = cameras[rig.cameras[0]]
        who = participant(seed, 1, rig, typical)
        moved = np.random.default_rng([seed, 5]).uniform(-knuckles_m, knuckles_m, (4, 3))
        return cls(seed, camera, rig, who.measured, who.rig, with_knuckles(who.hand, moved))

    def shown(self, scene: str) -> WristScene:
        """What this person does."""
        return WristScene.by_name(
            scene, self.true_rig, {self.camera.name: self.camera}, self.true_hand, self.seed
        )

    def detected(self, scene: str, times_s: Float | None = None) -> tuple[list[WristDetections], Float]:
        """What the slave sees of a scene at these times (T,), and the true angles (T, 5, 4) [rad]."""
        shown, rng = self.shown(scene), np.random.default_rng([self.seed, 6])
        times_s = np.arange(0.0, shown.period_s, EVERY_S) if times_s is None else times_s
        out: list[WristDetections] = []
        angles: list[Float] = []
        for k, t_s in enumerate(times_s.tolist()):
            truth = shown.truth(t_s)
            laser = truth.laser_uv[1:6] + rng.normal(0.0, LASER_PX, (5, 2))
            tip = np.where(truth.tip_visible[:, None], truth.tip_uv, np.nan) + rng.normal(0.0, TIP_PX, (5, 2))
            wrong = rng.uniform(size=5) < FALSE_TIPS
            tip[wrong] += rng.uniform(-FALSE_PX, FALSE_PX, (int(wrong.sum()), 2))
            out.append(detections(self.camera.name, k, laser, tip))
            angles.append(truth.angles_rad)
        return out, np.array(angles)

    def errors(self, rig: RigCalibration, hand: HandProfile) -> tuple[Float, Float]:
        """Turn of the palm (3,) [deg], camera axes, and where knuckles are beside the true ones (4, 3) [mm]."""
        pose, true = (np.array(one.T_camera_palm) for one in (rig, self.true_rig))
        rotation = np.degrees(matrix_to_rotation_vector(pose[:3, :3] @ true[:3, :3].T))
        return rotation, 1e3 * (transform(pose, knuckles(hand)) - transform(true, knuckles(self.true_hand)))


def detections(camera: str, k: int, laser: Float, tip: Float) -> WristDetections:
    """Triple `k` with laser points and tips (5, 2) [px]."""
    unseen, none = np.isnan(laser[:, 0]), np.isnan(tip[:, 0])
    return WristDetections(
        camera=camera,
        session=0,
        seq=3 * k,
        t_ns=k * 100_000_000,
        ready_t_ns=k * 100_000_000,
        laser_uv=laser,
        laser_sigma_px=np.where(unseen, np.nan, LASER_PX),
        laser_px=np.full(5, np.nan),
        tip_uv=tip,
        tip_sigma_px=np.where(none, np.nan, TIP_PX),
        tip_depth=np.full(5, np.nan),
    )


def knuckles(hand: HandProfile) -> Float:
    """(4, 3) of index ... little [m], palm frame."""
    return HandModel.of(hand).rest_position_m[CHAINS[1:, 0]]


def with_knuckles(hand: HandProfile, moved_m: Float) -> HandProfile:
    """The hand with the knuckles of index ... little, and their fingers, moved by (4, 3) [m], palm frame."""
    joints = dict(hand.rest_joints)
    for chain, moved in zip(CHAINS[1:], moved_m, strict=True):
        for name in (JOINTS[int(joint)] for joint in chain):
            x, y, z = (np.array(joints[name].position_m) + moved).tolist()
            joints[name] = replace(joints[name], position_m=(x, y, z))
    return replace(hand, rest_joints=joints)
