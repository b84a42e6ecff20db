"""Scene of hand, motion, occluders and cameras, with exact truth at every time.

Stateless: every process that builds the scene from the same files and seed sees the same world.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from common.arrays import Float
from common.calibration import CameraCalibration, HandProfile, RigCalibration
from common.calibration.object_profile import ObjectProfile
from common.errors import CalibrationError
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import transform
from common.hand.model import HandJoints, HandModel
from common.sim.light import LightSchedule
from common.sim.motion import Cylinder, HandMotion, HandState, ScriptedMotion
from common.sim.tracked import TrackedObjects

STANDARD_SEED = 7
HAND_DEPTH_M = 0.47
DESK_DEPTH_M = 0.78
LATE_NS = 5_000_000
APART_PPM = 50.0


@dataclass(frozen=True, slots=True, eq=False)
class SceneTruth:
    """Complete ground truth of a scene at one time.

    Attributes:
        t_s: Time [s], scene time.
        T_rig_palm: (4, 4) palm frame -> rig frame [m].
        angles_rad: (5, 4).
        joints: Positions (26, 3) [m] and rotations of all joints, rig frame.
        markers_m: (M, 3) centroids of the painted surfaces [m], rig frame; middles of the beads of objects.
        wrist_angles_rad: (2,) how the wrist is bent between forearm and palm (`common.hand.wrist`).
        things: What stands about, or is held, and is not tracked.
        objects: Tracked object -> `T_rig_object` (4, 4) [m].
    """

    t_s: float
    T_rig_palm: Float
    angles_rad: Float
    joints: HandJoints
    markers_m: Float
    wrist_angles_rad: Float
    things: tuple[Cylinder, ...]
    objects: Mapping[str, Float] = field(default_factory=dict[str, Float])


@dataclass(frozen=True, slots=True)
class Card:
    """Dark card that passes steadily between the cameras and the hand, once a period.

    Attributes:
        middle_s: When its middle is before the reference point [s].
        width_m: Along the way: width over speed is the time a resting marker is hidden.
        top_m, bottom_m: Its edges along the rig's y [m].
        depth_m: Its distance from the cameras.
        speed_m_s: Along the rig's x; negative from right to left.
    """

    middle_s: float
    width_m: float
    top_m: float
    bottom_m: float
    depth_m: float
    speed_m_s: float

    def corners(self, t_s: float, x0_m: float) -> Float | None:
        """Corners (4, 3) [m], rig frame, or None while it is far outside every view."""
        x = x0_m + self.speed_m_s * (t_s - self.middle_s)
        if abs(x - x0_m) > 0.6:
            return None
        lean = 0.012  # the far edge is a little deeper: a card is never held quite straight
        left, right = (x - self.width_m / 2, self.depth_m), (x + self.width_m / 2, self.depth_m + lean)
        ring = ((left, self.top_m), (right, self.top_m), (right, self.bottom_m), (left, self.bottom_m))
        return np.array([[x, y, z] for (x, z), y in ring])


STANDARD_CARDS = (
    Card(middle_s=28.9, width_m=0.055, top_m=-0.40, bottom_m=0.012, depth_m=0.32, speed_m_s=0.24),
    Card(middle_s=58.4, width_m=0.095, top_m=-0.40, bottom_m=0.075, depth_m=0.32, speed_m_s=-0.24),
)


@dataclass(frozen=True, slots=True)
class CameraTiming:
    """Start of a camera's frames after the others [ns], rate of its clock [ppm]."""

    start_offset_ns: int
    clock_ppm: float


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Hand, motion, occluders and the cameras that look at them.

    Attributes:
        cards: Occluders.
        seed: Of textures and noise.
        centre_m: Middle of the volume (3,), rig frame [m].
        light: How the light changes; None: as it was when the colours were calibrated.
        objects: Files of the objects that the rig names.
        others: Scenes of the other hands before the same cameras, each with its hand's part of the rig.
        watched: The whole rig, of all hands; None: of one hand, `rig` itself.
        optics, tracked: The cameras; the objects.
    """

    rig: RigCalibration
    cameras: Mapping[str, CameraCalibration]
    model: HandModel
    motion: HandMotion
    centre_m: Float
    cards: tuple[Card, ...] = ()
    seed: int = STANDARD_SEED
    light: LightSchedule | None = None
    objects: Mapping[str, ObjectProfile] = field(default_factory=dict[str, ObjectProfile])
    others: tuple["Scene", ...] = ()
    watched: RigCalibration | None = None
    optics: Mapping[str, CameraModel] = field(init=False)
    tracked: TrackedObjects = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "optics", optics_of(self.rig, self.cameras))
        object.__setattr__(self, "tracked", TrackedObjects.of(self.rig, self.objects))

    @classmethod
    def standard(
        cls,
        rig: RigCalibration,
        cameras: Mapping[str, CameraCalibration],
        hand: HandProfile,
        seed: int = STANDARD_SEED,
        objects: Mapping[str, ObjectProfile] | None = None,
    ) -> "Scene":
        """Standard scene: every motion in each half of 60 s, two occlusions.

        Raises:
            CalibrationError: A camera of the rig is missing or has no intrinsics; a marker is on no finger;
                an object of the rig has no file.
        """
        motion = ScriptedMotion(HandModel.of(hand), view_centre(rig), seed)
        return cls.of_motion(rig, cameras, hand, motion, seed, objects, STANDARD_CARDS)

    @classmethod
    def of_motion(
        cls,
        rig: RigCalibration,
        cameras: Mapping[str, CameraCalibration],
        hand: HandProfile,
        motion: HandMotion,
        seed: int = STANDARD_SEED,
        objects: Mapping[str, ObjectProfile] | None = None,
        cards: tuple[Card, ...] = (),
    ) -> "Scene":
        """Create a scene for any motion, by default without occluders; raises as above."""
        return cls(
            rig, cameras, HandModel.of(hand), motion, view_centre(rig), cards, seed, objects=objects or {}
        )

    @property
    def period_s(self) -> float:
        """Time [s] after which the scene repeats."""
        return self.motion.period_s

    def truth(self, t_s: float) -> SceneTruth:
        """Exact state at scene time `t_s` [s]; before 0 the pose of 0."""
        state = self.motion.at(t_s)
        joints = self.model.forward(state.T_rig_palm, state.angles_rad)
        poses = self.object_poses(state)
        return SceneTruth(
            t_s,
            state.T_rig_palm,
            state.angles_rad,
            joints,
            self._marker_points(joints, poses),
            state.wrist_angles_rad,
            self.untracked(state),
            dict(zip(self.rig.objects, poses, strict=True)),
        )

    def object_poses(self, state: HandState) -> tuple[Float, ...]:
        """`T_rig_object` (4, 4) [m] of every tracked object, in the order of the rig."""
        return self.tracked.poses(state, self.centre_m)

    def untracked(self, state: HandState) -> tuple[Cylinder, ...]:
        """Untracked things; a tracked object replaces the one that the hand takes."""
        return state.things[len(self.rig.objects) :]

    def _marker_points(self, joints: HandJoints, poses: tuple[Float, ...]) -> Float:
        """Centroids (M, 3) [m] of all markers; NaN for a free one on no object."""
        if not self.rig.free_markers:
            return self.model.marker_points(joints, self.rig.markers)
        points = np.full((len(self.rig.markers), 3), np.nan)
        own = [m for m, name in enumerate(self.rig.markers) if name not in self.rig.free_markers]
        points[own] = self.model.marker_points(joints, tuple(self.rig.markers[m] for m in own))
        for marker, (which, at) in self.tracked.beads.items():
            points[marker] = transform(poses[which], at)
        return points

    def occluders(self, t_s: float) -> tuple[Float, ...]:
        """Corners (4, 3) [m] of every card that is near the view, rig frame."""
        t = max(t_s, 0.0) % self.period_s
        corners = (card.corners(t, float(self.centre_m[0])) for card in self.cards)
        return tuple(quad for quad in corners if quad is not None)

    def timing(self, camera: str) -> CameraTiming:
        """Timing of a camera: each 5 ms after the one before, clocks 50 ppm apart."""
        place = self.rig.cameras.index(camera)
        return CameraTiming(place * LATE_NS, place * APART_PPM)


def optics_of(rig: RigCalibration, cameras: Mapping[str, CameraCalibration]) -> dict[str, CameraModel]:
    """The rig's cameras as geometry.

    Raises:
        CalibrationError: One has no file, no place or no intrinsics: a simulated camera must have a lens.
    """
    for name in rig.cameras:
        if name not in cameras:
            raise CalibrationError(f"rig {rig.name!r}: cameras: no camera file for {name!r}")
    return {name: CameraModel.of(cameras[name], rig.camera_pose(name)) for name in rig.cameras}


def view_centre(rig: RigCalibration) -> Float:
    """Centre (3,) [m] of the scene: before the first two cameras, where hands work."""
    centres = np.stack([rig.camera_pose(name)[:3, 3] for name in rig.cameras[:2]])
    return centres.mean(axis=0) + np.array([0.0, 0.01, HAND_DEPTH_M])
