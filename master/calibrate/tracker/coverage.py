"""Check of whether a motion constrains a registration.

Rotations about which of the object's axes, path, pace; and what is missing.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Float
from common.geometry.transforms import matrix_to_rotation_vector
from master.calibrate.tracker.tracks import PoseTrack, shared_epochs

LEAST_S, LEAST_ROTATION_RAD, LEAST_WAY_M = 8.0, np.radians(45.0), 0.10
LEAST_PACE_RAD_S = np.radians(20.0)
_ENDS = (0.03, 0.97)  # quantiles: an outlier pose is no motion
_ADVICE = {
    "seconds": f"go on until cameras and tracker have seen it together for {LEAST_S:.0f} s",
    "rotation": "turn it about its {axes} axis as well, a quarter turn and back",
    "way": "carry it a hand's width and more to all sides, nearer and farther",
    "pace": "move it faster, about once to and fro in two seconds: only that measures the lag of the clocks",
}


@dataclass(frozen=True, slots=True)
class Coverage:
    """What was seen of a motion by cameras and tracker together.

    Attributes:
        seen_s, tracked_s: How long cameras saw the object, and the tracker knew where it was [s].
        shared_s: How long both [s].
        rotation_rad: By how much it was turned about its own x, y, z, from one end to the other.
        way_m: How far it was carried along the rig's x, y, z, from one end to the other.
        pace_rad_s, pace_m_s: Its speeds, root of the mean square.
    """

    seen_s: float
    tracked_s: float
    shared_s: float
    rotation_rad: tuple[float, float, float]
    way_m: tuple[float, float, float]
    pace_rad_s: float
    pace_m_s: float

    @property
    def missing(self) -> tuple[str, ...]:
        """What to do besides, for a person; nothing: it is enough."""
        begun_s = 1.0  # before that there is no motion to speak of
        if self.shared_s < begun_s:
            return (_ADVICE["seconds"],)
        wanting: list[str] = []
        poor = [
            axis
            for axis, rotation in zip("xyz", self.rotation_rad, strict=True)
            if rotation < LEAST_ROTATION_RAD
        ]
        if poor:
            wanting.append(_ADVICE["rotation"].format(axes=" and its ".join(poor)))
        if max(self.way_m) < LEAST_WAY_M:
            wanting.append(_ADVICE["way"])
        least_pace_m_s = 0.05
        if self.pace_rad_s < LEAST_PACE_RAD_S and self.pace_m_s < least_pace_m_s:
            wanting.append(_ADVICE["pace"])
        if self.shared_s < LEAST_S:
            wanting.append(_ADVICE["seconds"])
        return tuple(wanting)

    @property
    def share(self) -> float:
        """How much of all that is wanted is there, 0 .. 1."""
        parts = [self.shared_s / LEAST_S, max(self.way_m) / LEAST_WAY_M]
        parts += [rotation / LEAST_ROTATION_RAD for rotation in self.rotation_rad]
        return float(np.mean(np.minimum(parts, 1.0)))

    def line(self) -> str:
        """One line for a person."""
        x, y, z = np.degrees(self.rotation_rad)
        return (
            f"both {self.shared_s:.0f} s (cameras {self.seen_s:.0f}, tracker {self.tracked_s:.0f}); turned about its x"
            f" {x:.0f}, y {y:.0f}, z {z:.0f} deg; carried {100 * max(self.way_m):.0f} cm"
        )


def coverage_of(seen: PoseTrack, tracker: PoseTrack, late_s: float = 0.0) -> Coverage:
    """Return what cameras and tracker saw together.

    At a lag that is right to a tenth of a second.
    """
    rows = shared_epochs(seen, tracker, late_s, len(seen))
    times = (_known_s(seen.t_s), _known_s(tracker.t_s), _known_s(seen.t_s[rows]))
    if len(rows) < 3:
        return Coverage(*times, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0, 0.0)
    R, p = seen.R[rows], seen.p_m[rows]
    total = R.sum(axis=0)
    left, _, right = np.linalg.svd(total)
    mean = left @ np.diag([1.0, 1.0, float(np.linalg.det(left @ right))]) @ right
    rotation_vectors = matrix_to_rotation_vector(mean.T @ R)
    pace = _pace(seen, seen.t_s[rows])
    return Coverage(*times, _span(rotation_vectors), _span(p), *pace)


def _known_s(t_s: Float) -> float:
    """Return the total time between consecutive poses [s].

    Gaps of a tenth of a second and more do not count.
    """
    steps: Float = np.diff(t_s)
    return float(steps[steps < 0.1].sum())


def _span(values: Float) -> tuple[float, float, float]:
    low, high = (np.asarray(np.quantile(values, end, axis=0), np.float64) for end in _ENDS)
    x, y, z = (high - low).tolist()
    return x, y, z


def _pace(track: PoseTrack, t_s: Float) -> tuple[float, float]:
    pace_s = 0.2
    first, begun, known = track.at(t_s - 0.5 * pace_s)
    last, ended, also = track.at(t_s + 0.5 * pace_s)
    both = known & also
    if not both.any():
        return 0.0, 0.0
    rotated = matrix_to_rotation_vector(first[both].swapaxes(1, 2) @ last[both]) / pace_s
    moved = (ended[both] - begun[both]) / pace_s
    return _rms(rotated), _rms(moved)


def _rms(vectors: Float) -> float:
    return float(np.sqrt((vectors * vectors).sum(axis=1).mean()))
