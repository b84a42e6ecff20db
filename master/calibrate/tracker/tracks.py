"""Two pose tracks of one object constrain a registration if they cover enough.

Tracks of cameras and tracking system can be interpolated at any time. Coverage: rotations about which of the
object's axes, path, pace; and what is missing.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float, Int
from common.errors import FitError
from common.geometry.transforms import matrix_to_rotation_vector, quaternion_to_matrix
from common.messages import ObjectPose, ObjectSource, TrackerPose
from master.calibrate.observations import between, thinned, turned
from master.calibrate.session import Progress, Session

_NOT_ITS_OWN = (ObjectSource.TRACKER, ObjectSource.HELD, ObjectSource.NONE)


@dataclass(frozen=True, slots=True, eq=False)
class PoseTrack:
    """Poses (N) of one thing in one frame, as received."""

    t_s: Float  # (N,) [s], rising
    R: Float  # (N, 3, 3) thing -> frame
    p_m: Float  # (N, 3) its origin [m], in the frame
    cov: Float  # (N, 6, 6) of place and of a small rotation about the frame's axes; NaN: not reported

    def __len__(self) -> int:
        return len(self.t_s)

    def at(self, t_s: Float) -> tuple[Float, Float, Bool]:
        """Rotations (T, 3, 3), positions (T, 3) at times (T,) [s], and which are known."""
        after, share, known = between(self.t_s, t_s)
        place = self.p_m[after - 1] + share * (self.p_m[after] - self.p_m[after - 1])
        return turned(self.R, after, share), place, known


def object_track(poses: Iterable[ObjectPose], zero_ns: int) -> PoseTrack:
    """Track of an object by cameras, rig frame; not of held or tracker-made poses."""
    own = [one for one in poses if one.tracked and one.source not in _NOT_ITS_OWN]
    return _track(own, [one.cov for one in own], zero_ns)


def tracker_track(poses: Sequence[TrackerPose], zero_ns: int) -> PoseTrack:
    """Track of the device in its system's frame; where it was lost is a gap."""
    return _track(poses, [np.full((6, 6), np.nan)] * len(poses), zero_ns)


def _track(poses: Sequence[ObjectPose | TrackerPose], cov: list[Float], zero_ns: int) -> PoseTrack:
    """A track that rises in time, each time once, without NaN."""
    times, first = np.unique(np.array([one.t_ns for one in poses], np.int64), return_index=True)
    places = np.array([one.position_m for one in poses], np.float64).reshape(-1, 3)[first]
    quaternions = np.array([one.orientation_wxyz for one in poses], np.float64).reshape(-1, 4)[first]
    known = np.isfinite(places.sum(axis=1) + quaternions.sum(axis=1))
    t_s = np.multiply(times[known] - zero_ns, 1e-9, dtype=np.float64)
    covs = np.array(cov, np.float64).reshape(-1, 6, 6)[first]
    return PoseTrack(t_s, quaternion_to_matrix(quaternions[known]), places[known], covs[known])


def nearest_rotation(matrix: Float) -> Float:
    """The rotation nearest to a matrix (3, 3)."""
    left, _, right = np.linalg.svd(matrix)
    return np.asarray(left @ np.diag([1.0, 1.0, float(np.linalg.det(left @ right))]) @ right)


def shared_epochs(seen: PoseTrack, tracker: PoseTrack, late_s: float, most: int) -> Int:
    """Seen poses at whose epochs the tracker's is known, at most so many, spread.

    `late_s` is how much later the tracker's poses hold than their stamps [s].
    """
    if len(seen) == 0 or len(tracker) < 2:
        return np.zeros(0, np.int64)
    return thinned(np.flatnonzero(tracker.at(seen.t_s - late_s)[2]), most)


def first_lag(seen: PoseTrack, tracker: PoseTrack) -> float | None:
    """How much later the tracker's poses hold than stamped [s]; None: no overlap.

    To some milliseconds.
    """
    most_lag_s = 0.5
    begin = min(seen.t_s[0], tracker.t_s[0]) - most_lag_s
    grid_s = 0.01
    grid = np.arange(begin, max(seen.t_s[-1], tracker.t_s[-1]) + most_lag_s, grid_s)
    ours, theirs = _rotated(seen, grid), _rotated(tracker, grid)
    steps = round(most_lag_s / grid_s)
    costs: list[float] = []
    for lag in range(-steps, steps + 1):
        moved = np.full_like(theirs, np.nan)
        if lag >= 0:
            moved[lag:] = theirs[: len(theirs) - lag]
        else:
            moved[:lag] = theirs[-lag:]
        off = np.abs(ours - moved)
        off = off[np.isfinite(off)]
        least_overlap = 100  # of the grid: one second
        costs.append(float(np.mean(np.minimum(off, 0.3))) if len(off) >= least_overlap else np.inf)
    best = int(np.argmin(costs))
    if not np.isfinite(costs[best]):
        return None
    fine = 0.0
    if 0 < best < len(costs) - 1 and np.isfinite([costs[best - 1], costs[best + 1]]).all():
        before, here, after = costs[best - 1 : best + 2]
        curvature = before - 2.0 * here + after
        fine = 0.5 * (before - after) / curvature if curvature > 0.0 else 0.0
    return (best - steps + fine) * grid_s


def _rotated(track: PoseTrack, t_s: Float) -> Float:
    """Angle of rotation around each time [rad]; NaN where not known."""
    chord_s = 0.2
    first, _, known = track.at(t_s - 0.5 * chord_s)
    last, _, also = track.at(t_s + 0.5 * chord_s)
    angle = np.linalg.norm(matrix_to_rotation_vector(first.swapaxes(1, 2) @ last), axis=1)
    return np.where(known & also, angle, np.nan)


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
    """What was seen of a motion by cameras and tracker together."""

    # this and tracked_s: how long cameras saw the object, and the tracker knew where it was [s]
    seen_s: float
    tracked_s: float
    shared_s: float  # how long both [s]
    rotation_rad: tuple[float, float, float]  # range of rotation about its own x, y, z
    way_m: tuple[float, float, float]  # range of motion along the rig's x, y, z
    pace_rad_s: float  # this and pace_m_s: its speeds, root mean square
    pace_m_s: float

    @property
    def missing(self) -> tuple[str, ...]:
        """What to do besides, for a person; nothing: it is enough."""
        if self.shared_s < 1.0:  # before that there is no motion to speak of
            return (_ADVICE["seconds"],)
        wanting: list[str] = []
        turned = zip("xyz", self.rotation_rad, strict=True)
        poor = [axis for axis, rotation in turned if rotation < LEAST_ROTATION_RAD]
        if poor:
            wanting.append(_ADVICE["rotation"].format(axes=" and its ".join(poor)))
        if max(self.way_m) < LEAST_WAY_M:
            wanting.append(_ADVICE["way"])
        if self.pace_rad_s < LEAST_PACE_RAD_S and self.pace_m_s < 0.05:
            wanting.append(_ADVICE["pace"])
        if self.shared_s < LEAST_S:
            wanting.append(_ADVICE["seconds"])
        return tuple(wanting)

    @property
    def share(self) -> float:
        """Share of all that is wanted, 0 .. 1."""
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
    """What cameras and tracker saw together, at a lag right to a tenth of a second."""
    rows = shared_epochs(seen, tracker, late_s, len(seen))
    times = (_known_s(seen.t_s), _known_s(tracker.t_s), _known_s(seen.t_s[rows]))
    if len(rows) < 3:
        return Coverage(*times, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0, 0.0)
    R, p = seen.R[rows], seen.p_m[rows]
    mean = nearest_rotation(R.sum(axis=0))
    rotation_vectors = matrix_to_rotation_vector(mean.T @ R)
    rates = _rms_rates(seen, seen.t_s[rows])
    return Coverage(*times, _span(rotation_vectors), _span(p), *rates)


def _known_s(t_s: Float) -> float:
    """Total time between poses [s] without gaps of a tenth of a second and more."""
    steps: Float = np.diff(t_s)
    return float(steps[steps < 0.1].sum())


def _span(values: Float) -> tuple[float, float, float]:
    low, high = (np.asarray(np.quantile(values, end, axis=0), np.float64) for end in _ENDS)
    x, y, z = (high - low).tolist()
    return x, y, z


def _rms_rates(track: PoseTrack, t_s: Float) -> tuple[float, float]:
    step_s = 0.2
    first, begun, known = track.at(t_s - 0.5 * step_s)
    last, ended, also = track.at(t_s + 0.5 * step_s)
    both = known & also
    if not both.any():
        return 0.0, 0.0
    rotated = matrix_to_rotation_vector(first[both].swapaxes(1, 2) @ last[both]) / step_s
    moved = (ended[both] - begun[both]) / step_s
    return _rms(rotated), _rms(moved)


def _rms(vectors: Float) -> float:
    return float(np.sqrt((vectors * vectors).sum(axis=1).mean()))


MOTION = (
    "hold the object with the tracker on it before the cameras for twenty seconds: turn it about all its axes, a"
    " quarter turn and back, and carry it to all sides"
)


class SeenMotion:
    """Push machine of the guided motion.

    State: all poses of the motion, and the lag once known.
    """

    def __init__(self) -> None:
        self.objects: list[ObjectPose] = []
        self.tracked: list[TrackerPose] = []
        self._lag_s: float | None = None

    def push(self, message: ObjectPose | TrackerPose) -> None:
        """Take one pose, of the object by cameras or of the device."""
        if isinstance(message, TrackerPose):
            self.tracked.append(message)
        elif message.tracked and message.source in (ObjectSource.MARKERS, ObjectSource.TAGS):
            self.objects.append(message)

    def progress(self, now_ns: int, since_s: float) -> Progress:
        """How far it is at a time, so long after the beginning, and what is missing."""
        silent = self.silent(now_ns) if since_s > SILENT_S else ""
        nothing = Progress(0.0, "", silent or "waiting for cameras and tracker")
        if not (self.objects and self.tracked):
            return nothing
        zero_ns = min(self.objects[0].t_ns, self.tracked[0].t_ns)
        seen, device = object_track(self.objects, zero_ns), tracker_track(self.tracked, zero_ns)
        if len(seen) < 2 or len(device) < 2:
            return nothing
        found = coverage_of(seen, device, self._lag_s or 0.0)
        if self._lag_s is None and found.shared_s > 5.0:
            self._lag_s = first_lag(seen, device)
        enough_s = 15.0  # of both, when all turns are there: more of it makes the result surer
        enough = not found.missing and found.shared_s >= enough_s
        hint = silent or next(iter(found.missing), "done" if enough else "go on like this")
        return Progress(found.share, found.line(), hint, enough)

    def silent(self, now_ns: int) -> str:
        """The side that sends nothing just now, and what to look at; empty: both send."""
        if not _recent([one.t_ns for one in self.tracked[-1:]], now_ns):
            return "no tracker data received: is `phalanx-slave run --tracker` running, and does the master know it?"
        if not np.isfinite([one.position_m for one in self.tracked[-20:]]).any():
            return "the tracker does not know where it is: let it see a base station"
        if not _recent([one.t_ns for one in self.objects[-1:]], now_ns):
            return "the cameras do not see the object: markers or tags to the cameras"
        return ""


def guide(session: Session[ObjectPose | TrackerPose], longest_s: float) -> SeenMotion:
    """Lead a person through the motion until it is enough, or the time is over.

    Raises:
        FitError: Nothing was received from the cameras or the tracker all the time.
    """
    seen, clock = SeenMotion(), session.clock
    session.follow(MOTION, seen.push, lambda since_s: seen.progress(clock.now_ns(), since_s), longest_s)
    if not (seen.objects and seen.tracked):
        raise FitError(seen.silent(clock.now_ns()) or f"nothing was seen: {MOTION}")
    return seen


SILENT_S = 3.0


def _recent(t_ns: list[int], now_ns: int) -> bool:
    return bool(t_ns) and now_ns - t_ns[0] < SILENT_S * 1e9
