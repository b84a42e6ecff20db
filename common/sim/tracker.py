"""Vive tracker on a simulated object.

It reports what base stations would measure, in a frame of their own, y up.

Where T_rig_tracking and T_object_tracker are not measured yet they are as somebody would have set them up, so that the
procedure that measures them has something to find. The noise is that of Lighthouse: 0.3 mm and 0.05 degrees that
wander within a tenth of a second, beside some white noise (Niehorster, Li & Lappe, i-Perception 2017, found 0.2 mm RMS
at rest); and now and then something stands between tracker and base station for half a second.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Float
from common.calibration import RigCalibration
from common.calibration.object_profile import ObjectProfile
from common.errors import CalibrationError
from common.geometry.transforms import axis_rotation, invert, rigid, rotation_vector_to_matrix
from common.sim.scene import Scene

WANDER_M, WANDER_RAD = 3e-4, np.radians(0.05)
WHITE_M, WHITE_RAD = 1e-4, np.radians(0.01)
_WAVES = 6  # of each wandering quantity
_RATES_HZ = (0.5, 8.0)
# Set up by somebody: the stations' frame has y up and its origin behind the cameras, turned by some angle; the rig's
# y points down. The tracker is screwed to the object's side.
SET_UP_TRACKING = rigid(axis_rotation(1, 0.96) @ np.diag([1.0, -1.0, -1.0]), np.array([0.62, 1.35, -0.84]))
SET_UP_TRACKER = rigid(
    rotation_vector_to_matrix(np.array([0.9, -0.5, 1.4])), np.array([0.031, -0.022, -0.064])
)


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedTracker:
    """Simulated tracker that reports its pose at any time of a scene.

    Pure in time: the same seed gives the same reports.

    Attributes:
        scene: What happens.
        name: Object that it sits on.
        T_rig_tracking: (4, 4) frame of the base stations -> rig.
        T_object_tracker: (4, 4) tracker -> object.
        seed: Of the noise.
    """

    scene: Scene
    name: str
    T_rig_tracking: Float
    T_object_tracker: Float
    seed: int

    @classmethod
    def of(cls, scene: Scene, profile: ObjectProfile, seed: int) -> "SimulatedTracker":
        """Create the tracker of an object of the scene's rig.

        It sits where the files of the rig and the object state.

        Raises:
            CalibrationError: The scene does not know the object.
        """
        if profile.name not in scene.rig.objects:
            raise CalibrationError(f"object {profile.name!r}: rig {scene.rig.name!r} has no such object")
        return cls(scene, profile.name, tracking_of(scene.rig), tracker_of(profile), seed)

    def pose(self, t_s: float) -> Float | None:
        """Return the pose `T_tracking_device` of the tracker at a time of the scene.

        Shape (4, 4) [m], time in [s]; None: it sees no base station.
        """
        hidden_every_s, hidden_s = 17.0, 0.5
        phase = np.random.default_rng([self.seed, 5]).uniform(0.0, hidden_every_s)
        if (t_s + phase) % hidden_every_s < hidden_s:
            return None
        truth = self.scene.truth(t_s).objects[self.name]
        place = invert(self.T_rig_tracking) @ truth @ self.T_object_tracker
        off = self._off(t_s)
        return rigid(rotation_vector_to_matrix(off[3:]) @ place[:3, :3], place[:3, 3] + off[:3])

    def _off(self, t_s: float) -> Float:
        """Error (6,) of a moment: place [m], turn [rad], in the stations' frame."""
        rng = np.random.default_rng([self.seed, 6])
        rates = rng.uniform(*_RATES_HZ, (6, _WAVES))
        phases = rng.uniform(0.0, 2.0 * np.pi, (6, _WAVES))
        waves = np.sin(2.0 * np.pi * rates * t_s + phases).sum(axis=1) * np.sqrt(2.0 / _WAVES)
        white = np.random.default_rng([self.seed, 7, round(max(t_s, 0.0) * 1e6)]).normal(size=6)
        wander = np.repeat([WANDER_M, WANDER_RAD], 3)
        return wander * waves + np.repeat([WHITE_M, WHITE_RAD], 3) * white


def tracking_of(rig: RigCalibration) -> Float:
    """Return `T_rig_tracking` of a rig's file, or a simulated one.

    Shape (4, 4); that of a simulated rig where it is not measured yet.
    """
    return SET_UP_TRACKING if rig.T_rig_tracking is None else np.array(rig.T_rig_tracking, dtype=np.float64)


def tracker_of(profile: ObjectProfile) -> Float:
    """Return `T_object_tracker` of an object's file, or a simulated one.

    Shape (4, 4); that of a simulated object where it is not measured yet.
    """
    mounted = profile.T_object_tracker
    return SET_UP_TRACKER if mounted is None else np.array(mounted, dtype=np.float64)
