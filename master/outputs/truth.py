"""True motion of the hand, row by row beside the poses.

Where a simulation or a recording knows it.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Float
from common.hand.model import MIDDLE_METACARPAL, MIDDLE_PROXIMAL
from master.outputs.poses import Poses


@dataclass(frozen=True, slots=True, eq=False)
class PosesTruth:
    """True joints and caps at the times of T poses.

    NaN: unknown there.

    Attributes:
        joints_m: (T, 26, 3) [m], rig frame.
        markers_m: (T, M, 3) [m], centroids of the painted caps, rig frame.
        laser_m: (T, 5, 3) [m], where the laser meets each finger, of a wrist device; None: a marker rig.
    """

    joints_m: Float
    markers_m: Float
    laser_m: Float | None = None

    @classmethod
    def of_webxr(cls, joints_m: Float, markers_m: Float, laser_m: Float | None = None) -> "PosesTruth":
        """Build the truth from the 25 WebXR joints (T, 25, 3) of a rendered recording.

        The palm is derived.
        """
        palm = (joints_m[:, MIDDLE_METACARPAL - 1] + joints_m[:, MIDDLE_PROXIMAL - 1]) / 2
        return cls(np.concatenate([palm[:, None], joints_m], axis=1), markers_m, laser_m)

    def rows(self, start: int, stop: int) -> "PosesTruth":
        """Rows start..stop-1, without copying."""
        laser_m = None if self.laser_m is None else self.laser_m[start:stop]
        return PosesTruth(self.joints_m[start:stop], self.markers_m[start:stop], laser_m)

    def errors_m(self, poses: Poses) -> dict[str, Float]:
        """Return the distances (T, K) [m] from the truth for each measured quantity.

        A mapping from quantity to distances; NaN where either of the two is not known.
        """
        joints = {"joints": self.joint_error_m(poses)}
        if self.laser_m is None:
            return joints | {"markers": self.marker_error_m(poses)}
        return joints | {"laser": distance_m(poses.laser_m, self.laser_m)}

    def joint_error_m(self, poses: Poses) -> Float:
        """Return the distance (T, 25) [m] of every joint but the palm from the truth.

        NaN where the pose is not valid or there is no truth.
        """
        error = distance_m(poses.position_m, self.joints_m)
        return np.where(poses.valid, error, np.nan)[:, 1:]

    def marker_error_m(self, poses: Poses) -> Float:
        """Distance (T, M) [m] of the unfiltered caps; NaN where not seen."""
        return distance_m(poses.markers_raw_m, self.markers_m)


def distance_m(a: Float, b: Float) -> Float:
    """Distances (...) of points (..., 3), same unit; NaN where either is."""
    return np.asarray(np.linalg.norm(a - b, axis=-1), np.float64)


def mean_known(values: Float) -> Float:
    """Return the mean (T,) over the second axis of (T, K), ignoring NaN values.

    NaN where no value is known.
    """
    known = ~np.isnan(values)
    count = known.sum(axis=1)
    total = np.where(known, values, 0.0).sum(axis=1)
    return np.divide(total, count, out=np.full(len(values), np.nan), where=count > 0)
