"""Tracked objects of a scene: poses, detectable points and ground truth.

Where each object is at a given time, and which of its points a camera can find.

The first object of a rig is what the motion moves: the one that travels (`travel`), or the thing that the hand takes,
in whose place it then is. Any other, and all of them in a scene that moves none, stand still beside the hand.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from common.arrays import Float
from common.calibration import RigCalibration
from common.calibration.object_profile import ObjectProfile
from common.errors import CalibrationError
from common.geometry.transforms import axis_rotation, rigid
from common.sim.motion import HandState

RESTING_M = np.array([0.19, 0.13, 0.12])  # of an object that nothing moves, against the middle of the view
TILT_RAD = np.radians(20.0)
_FACING = np.array(
    [[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]
)  # its y to the cameras, its z to the left


def facing(tilt_rad: float) -> Float:
    """Return the rotation of an object whose y axis points to the cameras.

    Rotation (3, 3), object -> rig; its z axis points to the left, raised by a tilt [rad].
    """
    return np.asarray(axis_rotation(2, tilt_rad) @ _FACING)


@dataclass(frozen=True, slots=True, eq=False)
class TrackedObjects:
    """The objects of a rig in one scene.

    Attributes:
        profiles: In the order of the rig.
        beads: Marker (place in the rig) -> object (place in `profiles`) and middle (3,) [m] of the bead in its frame.
    """

    profiles: tuple[ObjectProfile, ...]
    beads: Mapping[int, tuple[int, Float]]

    @classmethod
    def of(cls, rig: RigCalibration, files: Mapping[str, ObjectProfile]) -> "TrackedObjects":
        """Those that a rig names.

        Raises:
            CalibrationError: One has no file, or a bead that is not among the rig's free markers.
        """
        profiles: list[ObjectProfile] = []
        beads: dict[int, tuple[int, Float]] = {}
        for k, name in enumerate(rig.objects):
            if name not in files:
                raise CalibrationError(f"rig {rig.name!r}: objects: no object file for {name!r}")
            profiles.append(files[name])
            for marker, bead in files[name].markers.items():
                if marker not in rig.free_markers:
                    raise CalibrationError(
                        f"object {name!r}: markers.{marker}: rig {rig.name!r} has no such marker under 'free_markers'"
                    )
                beads[rig.markers.index(marker)] = k, np.array(bead.position_m, dtype=np.float64)
        return cls(tuple(profiles), beads)

    def poses(self, state: HandState, centre_m: Float) -> tuple[Float, ...]:
        """Return the pose `T_rig_object` of each object.

        Poses (4, 4) [m], of a scene whose centre is at (3,) [m], rig frame.
        """
        moved = state.objects or tuple(thing.T_rig_object for thing in state.things)
        return tuple(
            moved[k] if k < len(moved) else resting_pose(k, centre_m) for k in range(len(self.profiles))
        )

    def features(self, which: int) -> tuple[str, ...]:
        """What can be found of one object: its beads by name, then its tags by number."""
        profile = self.profiles[which]
        tags = () if profile.tags is None else profile.tags.tags
        return (*profile.markers, *(f"tag {tag.id}" for tag in tags))


def resting_pose(which: int, centre_m: Float) -> Float:
    """Return the rest pose of an object, where nothing moves it.

    Pose (4, 4) [m], rig frame, of the object of that number.
    """
    side = np.array([-1.0 if which % 2 == 0 else 1.0, 1.0 if which % 4 < 2 else -1.0, 1.0])
    return rigid(facing(TILT_RAD), centre_m + side * RESTING_M)
