"""Pose tracks of one object from cameras and tracking system.

They can be interpolated at any time.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float, Int
from common.geometry.transforms import (
    matrix_to_rotation_vector,
    quaternion_to_matrix,
    rotation_vector_to_matrix,
)
from common.messages import ObjectPose, ObjectSource, TrackerPose

_NOT_ITS_OWN = (ObjectSource.TRACKER, ObjectSource.HELD, ObjectSource.NONE)


@dataclass(frozen=True, slots=True, eq=False)
class PoseTrack:
    """Poses (N) of one thing in one frame, as received.

    Attributes:
        t_s: (N,) [s], rising.
        R: (N, 3, 3) thing -> frame.
        p_m: (N, 3) its origin [m], in the frame.
        cov: (N, 6, 6) of place and of a small turn about the frame's axes; NaN: not reported.
    """

    t_s: Float
    R: Float
    p_m: Float
    cov: Float

    def __len__(self) -> int:
        """How many poses."""
        return len(self.t_s)

    def at(self, t_s: Float) -> tuple[Float, Float, Bool]:
        """Interpolate rotations (T, 3, 3) and positions (T, 3) at times (T,) [s].

        From pose to pose; also returns (T,) which are known.
        """
        after, share, known = self._between(t_s)
        before = after - 1
        step = matrix_to_rotation_vector(self.R[before].swapaxes(1, 2) @ self.R[after])
        rotation = self.R[before] @ rotation_vector_to_matrix(share[:, None] * step)
        place = self.p_m[before] + share[:, None] * (self.p_m[after] - self.p_m[before])
        return rotation, place, known

    def _between(self, t_s: Float) -> tuple[Int, Float, Bool]:
        after = np.clip(np.searchsorted(self.t_s, t_s), 1, len(self.t_s) - 1)
        span = self.t_s[after] - self.t_s[after - 1]
        share = (t_s - self.t_s[after - 1]) / span
        gap_s = 0.06  # between poses: farther apart, what was between them is not known
        return after, np.clip(share, 0.0, 1.0), (share >= 0.0) & (share <= 1.0) & (span <= gap_s)


def object_track(poses: Iterable[ObjectPose], zero_ns: int) -> PoseTrack:
    """Return the track of an object as measured by cameras, rig frame.

    Poses that were held, or reported by the tracker itself, are rejected.
    """
    own = [one for one in poses if one.tracked and one.source not in _NOT_ITS_OWN]
    return _track(
        [one.t_ns - zero_ns for one in own],
        [one.position_m for one in own],
        [one.orientation_wxyz for one in own],
        [one.cov for one in own],
    )


def tracker_track(poses: Iterable[TrackerPose], zero_ns: int) -> PoseTrack:
    """Return the track of the device as reported, in its system's frame.

    Where it was lost is a gap.
    """
    every = list(poses)
    return _track(
        [one.t_ns - zero_ns for one in every],
        [one.position_m for one in every],
        [one.orientation_wxyz for one in every],
        [np.full((6, 6), np.nan)] * len(every),
    )


def _track(t_ns: list[int], place: list[Float], quaternion: list[Float], cov: list[Float]) -> PoseTrack:
    """Build a track that rises in time, each time once, without NaN."""
    times = np.array(t_ns, np.int64)
    order = np.argsort(times, kind="stable")
    places = np.array(place, dtype=np.float64).reshape(-1, 3)
    quaternions = np.array(quaternion, dtype=np.float64).reshape(-1, 4)
    known = np.isfinite(places.sum(axis=1) + quaternions.sum(axis=1))
    kept = order[known[order]]
    kept = kept[np.diff(times[kept], prepend=np.iinfo(np.int64).min) > 0] if len(kept) else kept
    rotation = quaternion_to_matrix(quaternions[kept]) if len(kept) else np.zeros((0, 3, 3))
    covs = np.array(cov, dtype=np.float64).reshape(-1, 6, 6)
    return PoseTrack(np.multiply(times[kept], 1e-9, dtype=np.float64), rotation, places[kept], covs[kept])


def shared_epochs(seen: PoseTrack, tracker: PoseTrack, late_s: float, most: int) -> Int:
    """Select the seen poses at whose epochs the tracker knows where it is.

    At most so many, spread.

    Args:
        seen: By the cameras.
        tracker: By the tracking system.
        late_s: How much later its poses hold than their time stamps [s].
        most: More of the same motion adds time, not knowledge.
    """
    if len(seen) == 0 or len(tracker) < 2:
        return np.zeros(0, np.int64)
    rows = np.flatnonzero(tracker.at(seen.t_s - late_s)[2])
    if len(rows) <= most:
        return rows
    return rows[np.unique(np.linspace(0, len(rows) - 1, most).astype(np.int64))]
