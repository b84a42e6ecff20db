"""Wrist scene of hand, motion, light and device, exact at every time.

It keeps no state.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, cast, get_args

import numpy as np

from common.arrays import Bool, Float, Int
from common.calibration import CameraCalibration, HandProfile, RigCalibration
from common.errors import CalibrationError, PhalanxError
from common.geometry.camera_model import CameraModel
from common.geometry.tapered_capsules import Capsules
from common.geometry.transforms import invert, rigid
from common.hand.model import WRIST, HandJoints, HandModel
from common.hand.wrist_joint import forearm_palm
from common.sim.motion import HandMotion, HandState
from common.sim.scene import STANDARD_SEED, CameraTiming
from common.sim.together import TOGETHER, together_motion
from common.sim.wrist.capsules import HandCapsules
from common.sim.wrist.laser import LaserSheet, LineTruth
from common.sim.wrist.motion import wrist_motion
from common.sim.wrist.things import bodies_of, with_things

Ambient = Literal["dark", "indoor", "bright", "sun"]
AMBIENTS: tuple[Ambient, ...] = get_args(Ambient)
MOTIONS = ("standard", "curl", "subject", "poses", "spread", "random")
WRIST_NAMES = f"{' | '.join((*MOTIONS, *TOGETHER))}, each with @{' | @'.join(AMBIENTS)}"


@dataclass(frozen=True, slots=True, eq=False)
class WristTruth:
    """Complete ground truth of a wrist scene at one time.

    In the frame of the wrist camera; groups palm, thumb ... little, thenar.

    Attributes:
        t_s: Time [s], scene time.
        angles_rad: (5, 4).
        joints: All joints, camera frame.
        laser_uv: (7, 2) centroid [px] of the lit and seen part of the laser line, by its length in the image; NaN
            where less than 0.2 mm of it is seen.
        laser_pt: (7, 3) that pixel on the laser plane [m].
        laser_xyz: (7, 3) centroid of the same part by its length in space [m].
        laser_len_vis, laser_len_lit: (7,) length that is lit and seen, length that is lit [m].
        laser_seg: (7,) the segment that carries most of the line (0 metacarpal, 1 proximal ... 3 distal); -1: none.
        tip_xyz, tip_uv: (5, 3) [m], (5, 2) [px] outermost point of the skin along each last bone.
        tip_visible: (5,) whether the camera sees that point, or it lies just behind the edge of its own finger.
        wrist_angles_rad: (2,) how the wrist is bent (`common.hand.wrist_joint`).
    """

    t_s: float
    angles_rad: Float
    joints: HandJoints
    laser_uv: Float
    laser_pt: Float
    laser_xyz: Float
    laser_len_vis: Float
    laser_len_lit: Float
    laser_seg: Int
    tip_xyz: Float
    tip_uv: Float
    tip_visible: Bool
    wrist_angles_rad: Float


@dataclass(frozen=True, slots=True, eq=False)
class WristScene:
    """Hand, motion, light and the device that looks at the hand.

    The frame of the rig is that of its camera.

    Attributes:
        rig: Laser, LEDs, palm pose.
        cameras: Camera name -> its file.
        model: The hand.
        motion: How it moves; its `T_rig_palm` is the palm's way through the room, which with the bend of the wrist is
            that of the forearm, where camera and IMU sit.
        ambient: The light of the room.
        seed: Of flesh, skin, room and noise.
        reflectance: How much light the skin gives back, of whatever light, against usual skin.
        optics: The camera.
        capsules: The hand's surface.
        sheet: The laser.
        T_camera_palm: (4, 4) of a straight wrist [m].
    """

    rig: RigCalibration
    cameras: Mapping[str, CameraCalibration]
    model: HandModel
    motion: HandMotion
    ambient: Ambient = "indoor"
    seed: int = STANDARD_SEED
    reflectance: float = 1.0
    optics: CameraModel = field(init=False)
    capsules: HandCapsules = field(init=False)
    sheet: LaserSheet = field(init=False)
    T_camera_palm: Float = field(init=False)
    _straight: HandJoints = field(init=False)

    def __post_init__(self) -> None:
        where = f"rig {self.rig.name!r}"
        if self.rig.kind != "wrist":
            raise CalibrationError(f"{where}: kind is {self.rig.kind!r}; a wrist scene needs 'wrist'")
        name = self.rig.cameras[0]
        if name not in self.cameras:
            raise CalibrationError(f"{where}: cameras: no camera file for {name!r}")
        for key in ("laser_plane", "laser", "T_camera_palm", "led"):
            if not getattr(self.rig, key):
                raise CalibrationError(f"{where}: {key}: missing; a wrist device is simulated as it is built")
        if not 0.0 < self.reflectance < np.inf:
            raise CalibrationError(
                f"{where}: reflectance {self.reflectance}: expected a positive number, 1 is usual"
            )
        optics = CameraModel.of(self.cameras[name], np.eye(4))
        object.__setattr__(self, "optics", optics)
        object.__setattr__(self, "T_camera_palm", np.array(self.rig.T_camera_palm, dtype=np.float64))
        object.__setattr__(self, "capsules", HandCapsules.of(self.model, self.seed))
        straight = self.model.forward(self.T_camera_palm, np.zeros((5, 4)))
        object.__setattr__(self, "_straight", straight)
        object.__setattr__(self, "sheet", LaserSheet.of(self.rig, self.capsules, straight))

    @classmethod
    def by_name(
        cls,
        name: str,
        rig: RigCalibration,
        cameras: Mapping[str, CameraCalibration],
        hand: HandProfile,
        seed: int = STANDARD_SEED,
    ) -> "WristScene":
        """Create the scene called MOTION or MOTION@AMBIENT.

        A motion of `TOGETHER` is also that of a marker rig.

        Raises:
            PhalanxError: No such motion or light; a rig, camera or hand that does not fit.
        """
        moves, _, ambient = name.partition("@")
        model = HandModel.of(hand)
        motion = wrist_motion(moves, model, seed) or together_motion(moves, model, np.zeros(3), seed)
        if motion is None or (ambient or "indoor") not in AMBIENTS:
            raise PhalanxError(f"scene {name!r}: for a wrist rig there are {WRIST_NAMES}")
        return cls(rig, cameras, model, motion, cast(Ambient, ambient or "indoor"), seed)

    @property
    def period_s(self) -> float:
        """Time [s] after which the scene repeats."""
        return self.motion.period_s

    def timing(self, camera: str) -> CameraTiming:
        """How the camera's frames lie in time: there is one, and its clock is right."""
        self.rig.cameras.index(camera)
        return CameraTiming(0, 0.0)

    def joints_at(self, t_s: float) -> HandJoints:
        """The joints at scene time `t_s` [s], camera frame."""
        return self._joints(self.motion.at(t_s))

    def bodies_at(self, t_s: float) -> Capsules:
        """Return all bodies that camera and laser meet at scene time `t_s`.

        In [s], camera frame: the flesh, after it the things.
        """
        return self.bodies_of(self.motion.at(t_s))

    def bodies_of(self, state: HandState) -> Capsules:
        """The same of a hand in that state."""
        return self._bodies(state, self._joints(state))

    def straight_bodies(self) -> Capsules:
        """The flesh while wrist and fingers are straight, camera frame."""
        return self.capsules.bodies(self._straight)

    def flexed_bodies(self, wrist_angles_rad: Float) -> Capsules:
        """Return the flesh of straight fingers while the wrist is flexed.

        Flexed by `wrist_angles_rad` (2,), camera frame.
        """
        return self.bodies_of(HandState(np.eye(4), np.zeros((5, 4)), wrist_angles_rad))

    def truth(self, t_s: float) -> WristTruth:
        """Exact state at scene time `t_s` [s]; before 0 the pose of 0."""
        state = self.motion.at(t_s)
        joints = self._joints(state)
        bodies = self._bodies(state, joints)
        line = LineTruth.of(self.sheet.cross(bodies), self.optics, self.sheet)
        tips = self.capsules.tips(bodies)
        # of its own finger before a tip: it lies 12 degrees behind the edge of a round tip
        tip_within_m = 0.003
        return WristTruth(
            t_s,
            state.angles_rad,
            joints,
            line.uv,
            line.plane_m,
            line.centroid_m,
            line.seen_m,
            line.lit_m,
            line.segment,
            tips,
            self.optics.project(tips),
            self.sheet.seen(bodies, tips, tip_within_m),
            state.wrist_angles_rad,
        )

    def _joints(self, state: HandState) -> HandJoints:
        """Where the camera, which sits on the forearm, sees them."""
        T = self.T_camera_palm
        if state.wrist_angles_rad.any():
            T = T @ rigid(forearm_palm(state.wrist_angles_rad), np.zeros(3))
        return self.model.forward(T, state.angles_rad)

    def _bodies(self, state: HandState, joints: HandJoints) -> Capsules:
        R_straight = self._straight.rotation[WRIST] if state.wrist_angles_rad.any() else None
        capsules = self.capsules.bodies(joints, R_straight)
        if not state.things:
            return capsules
        return with_things(capsules, bodies_of(state.things, joints.T_rig_palm @ invert(state.T_rig_palm)))
