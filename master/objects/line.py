"""The line of one object: detections of markers and tags in, its pose at every frame of the leading camera out.

`ObjectLine` is a push machine without clock, socket or thread. For each instant (`master.objects.window`) the pose is
fitted (`master.objects.fit`) from where it was led to from the last one; where there is none, or that fit finds most of
what is seen in the wrong place, from what is seen alone (`master.objects.start`), the best of all starts.

**Too little is seen** to tell all of it, as two beads of three: then what was known before counts as well, as it was at
a time before all frames of this fit, so that nothing counts twice.

**One tag** has two poses that nearly explain it. Both are fitted; the one that was believed stays unless the other is
clearly better over several frames, and as far as the other is possible the covariance reaches over to it.

**Nothing is seen**: the pose is led on with dying speed, and after `HELD_S` there is none.
"""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from common.arrays import Float, Int
from common.calibration import RigCalibration
from common.camera_model import CameraModel
from common.geometry import matrix_to_quaternion, matrix_to_rotation_vector
from common.messages import MarkerDetections, ObjectPose, ObjectSource, TagDetections
from common.object_profile import ObjectProfile
from master.objects.chosen import Chosen, sighted_now
from master.objects.features import Features
from master.objects.fit import Fitted, Motion, Past, PoseFit
from master.objects.hidden import Hidden
from master.objects.start import poses_of_beads, poses_of_tags, two_poses
from master.objects.steady import Steady
from master.objects.window import Window, Windows
from master.stereo.place import CalibrationResidual
from master.stereo.triangulate import Triangulator

HELD_S = 0.5
_DIES_S = 0.12  # in which the speed of a thing that nobody sees dies
# What light does to a ball's centroid beyond what a slave says, and to a corner.
_BEAD_FLOOR_PX, _CORNER_FLOOR_PX = 0.08, 0.03
_POOR_M, _POOR_RAD = 6e-3, np.radians(4.0)  # less sure than this: the past counts
_UNTOLD_M, _UNTOLD_RAD = 0.02, np.radians(12.0)  # less sure than this it does not tell all of the pose
_LOST_M, _LOST_RAD = 0.05, np.radians(30.0)  # less sure than this is no pose
_MOST = 0.5  # share of what is seen that must be in its place
_START_MISFIT = 25.0  # chi square per number of what a pose from nothing rests on
_PUSHED_M_S2, _PUSHED_RAD_S2 = 5.0, 40.0  # what may happen to its speed meanwhile
_UNSEEN_M_S2, _ARM_M = 1.5, 0.1  # how it moves unseen, a turn counting by what it does a decimetre away
_TRACKED_M, _TRACKED_RAD = 15e-3, np.radians(10.0)  # less sure than this is led on rather than measured
_FRESH_PERIODS = 2.25  # an observation older than this is not now
_FLIP_RAD = np.radians(8.0)  # poses of a tag nearer than this are one
_BETTER = 12.0  # chi square, summed over frames, by which the other pose of a tag must be better
_FORGET = 0.8  # of that sum, from frame to frame


@dataclass(frozen=True, slots=True)
class SolvedObject:
    """A pose of an object, and when the last frame that contributed to it was handed to its slave [ns]."""

    pose: ObjectPose
    ready_t_ns: int


@dataclass(frozen=True, slots=True, eq=False)
class _Known:
    """A pose that was fitted."""

    t_ns: int
    fitted: Fitted
    oldest_ns: int


class ObjectLine:
    """Push machine. Holds the sightings that wait, the last poses, the filter, and how sure a tag's pose is."""

    def __init__(
        self, profile: ObjectProfile, rig: RigCalibration, models: Mapping[str, CameraModel]
    ) -> None:
        """Set up.

        Args:
            profile: The object; it has beads or tags.
            rig: Whose markers its beads are.
            models: The rig's cameras by name, in its order.

        Raises:
            CalibrationError: A bead is none of the rig's markers.
        """
        self.name = profile.name
        self._cameras = tuple(models.values())
        self._features = Features.of(profile, rig.markers)
        late = {name: round(1e3 * us) for name, us in rig.stamp_offset_us.items()}
        self._windows = Windows(models, self._features, predict=rig.pairing == "predict", late_ns=late)
        least_px = np.where(self._features.radius_m > 0.0, _BEAD_FLOOR_PX, _CORNER_FLOOR_PX)
        floor_px = np.maximum(CalibrationResidual.of(rig).rays_px, least_px)
        self._fit = PoseFit(self._cameras, self._features.points, self._features.radius_m, floor_px)
        self._triangulator = Triangulator.of(self._cameras) if len(models) > 1 else None
        self._hidden = Hidden(self._features, self._cameras)
        middle = self._features.points.mean(axis=0) if len(self._features.points) else np.zeros(3)
        self._steady = Steady(middle, rig.filter.jitter_m)
        self._known: deque[_Known] = deque(maxlen=16)
        self._doubt = 0.0
        self._sure_ns = -(2**63)
        self._lost_behind = False
        self._last_ns = -(2**63)

    def push(self, message: MarkerDetections | TagDetections) -> list[SolvedObject]:
        """Take what one camera found; return the poses it completes, oldest first.

        Raises:
            ValueError: The camera is not of the rig.
        """
        return self._solved(self._windows.push(message))

    def flush(self) -> list[SolvedObject]:
        """At the end of a recording: the poses that still wait for a camera."""
        return self._solved(self._windows.flush())

    def _solved(self, windows: list[Window]) -> list[SolvedObject]:
        out: list[SolvedObject] = []
        for window in windows:
            if window.t_ns > self._last_ns:
                self._last_ns = window.t_ns
                out.append(SolvedObject(self._solve(window), window.ready_t_ns))
        return out

    def _solve(self, window: Window) -> ObjectPose:
        predicted = self._predicted(window.t_ns)
        seen = self._chosen(window, None if predicted is None else predicted.T)
        now = (
            seen is not None
            and float(np.abs(seen.seen.tau_s).min()) <= _FRESH_PERIODS * window.period_ns * 1e-9
        )
        fitted = None
        if seen is not None and now:
            fitted = self._found(window, seen, predicted)
        if fitted is None or seen is None:
            return self._held(window, predicted)
        oldest = window.t_ns + round(float(seen.seen.tau_s.min()) * 1e9)
        self._known.append(_Known(window.t_ns, fitted, oldest))
        if fitted.alone:
            self._sure_ns = window.t_ns
        elif window.t_ns - self._sure_ns > HELD_S * 1e9:
            self._known.clear()
            return self._none(window)
        tracked = fitted.alone or not _poor(fitted, _TRACKED_M, _TRACKED_RAD)
        shown = self._hidden.look(window, fitted.motion.T, seen.used(fitted))
        self._lost_behind = shown.occluded
        T = self._steady.push(window.t_ns, fitted.motion.T, fitted.cov[:6, :6])
        features = self._features.feature[seen.seen.point[fitted.used]]
        near = fitted.used & (np.abs(seen.seen.tau_s) <= _FRESH_PERIODS * window.period_ns * 1e-9)
        return ObjectPose(
            object=self.name,
            t_ns=window.t_ns,
            position_m=T[:3, 3],
            orientation_wxyz=matrix_to_quaternion(T[:3, :3]),
            cov=fitted.cov[:6, :6],
            residual_m=float(np.sqrt((fitted.residual_m[near] ** 2).mean())) if near.any() else np.nan,
            source=int(self._source(features) if tracked else ObjectSource.HELD),
            tracked=tracked,
            seen=shown.seen,
            expected=shown.expected,
            occluded=shown.occluded,
        )

    def _source(self, features: Int) -> ObjectSource:
        """What a pose that rests on these features comes from; both are called markers."""
        return ObjectSource.MARKERS if (features < self._features.beads).any() else ObjectSource.TAGS

    def _found(self, window: Window, seen: Chosen, predicted: Motion | None) -> Fitted | None:
        """The pose at the instant; None: what is seen is not it, or does not tell."""
        if predicted is not None:
            past = self._past(window.t_ns, seen)
            led = self._fitted(seen, predicted, past, window.t_ns)
            if led is not None and self._holds(seen, led):
                return self._of_two(window, seen, led, past)
        best: tuple[Fitted, Chosen] | None = None
        for T in self._starts(window):
            again = self._chosen(window, T)
            if again is None or (fitted := self._fitted(again, Motion.still(T), None, window.t_ns)) is None:
                continue
            good = self._holds(again, fitted) and self._begins(again, fitted)
            if good and (best is None or fitted.cost < best[0].cost):
                best = fitted, again
        if best is None:
            return None
        # What was known of where it went is of another thing.
        self._known.clear()
        self._doubt = 0.0
        return self._of_two(window, best[1], best[0], None)

    def _chosen(self, window: Window, T: Float | None) -> Chosen | None:
        """What is seen of the object, near a pose (4, 4) if there is one."""
        return Chosen.of(window, self._features, self._cameras, T, self._hidden.doubt_px)

    def _fitted(self, seen: Chosen, start: Motion, past: Past | None, t_ns: int) -> Fitted | None:
        """The fit, with the past where the present does not tell enough; how it may have moved since is then in it."""
        alone = self._fit(seen.seen, start, feature=seen.feature)
        if alone is not None and not _poor(alone, _POOR_M, _POOR_RAD):
            return alone
        both = None if past is None else self._fit(seen.seen, start, past, feature=seen.feature)
        if alone is None:
            return None if both is None else replace(both, alone=False)
        if both is None or not _poor(alone, _UNTOLD_M, _UNTOLD_RAD):
            return alone if both is None else both
        return _unheeded(both, alone, (t_ns - self._sure_ns) * 1e-9)

    def _holds(self, seen: Chosen, fitted: Fitted) -> bool:
        """Whether a pose is determined, and most of what is seen now is in its place."""
        if _poor(fitted, _LOST_M, _LOST_RAD):
            return False
        return float(fitted.weight.mean()) >= _MOST and len(np.unique(seen.feature[fitted.used])) >= 1

    def _begins(self, seen: Chosen, fitted: Fitted) -> bool:
        """Whether a pose may begin with no past: three beads, or a tag, that fit."""
        features = np.unique(seen.feature[fitted.used])
        enough = len(features) >= 3 or bool((features >= self._features.beads).any())
        return enough and float(fitted.misfit[fitted.used].mean()) < _START_MISFIT

    def _predicted(self, t_ns: int) -> Motion | None:
        """Where the object is led to; None: it was not seen for long."""
        if not self._known:
            return None
        last = self._known[-1]
        dt = (t_ns - last.t_ns) * 1e-9
        if dt > HELD_S:
            self._known.clear()
            return None
        return last.fitted.motion.at(_DIES_S * float(1.0 - np.exp(-dt / _DIES_S)))

    def _past(self, t_ns: int, seen: Chosen) -> Past | None:
        """What is known from before all that is seen in this window."""
        oldest = t_ns + round(float(seen.seen.tau_s.min()) * 1e9)
        known = next((k for k in reversed(self._known) if k.t_ns <= oldest), self._known[0])
        dt = max((t_ns - known.t_ns) * 1e-9, 1e-3)
        step = np.eye(12)
        step[:6, 6:] = dt * np.eye(6)
        pushed = np.repeat([_PUSHED_M_S2, _PUSHED_RAD_S2], 3)
        grown = step @ known.fitted.cov @ step.T
        grown[range(12), range(12)] += np.concatenate([0.5 * dt * dt * pushed, dt * pushed]) ** 2
        return Past(known.fitted.motion.at(dt), np.asarray(np.linalg.inv(grown), np.float64))

    def _starts(self, window: Window) -> list[Float]:
        """Poses (4, 4) that the nearest frames suggest."""
        sighted = sighted_now(window, self._features)
        poses = poses_of_tags(sighted, self._features, self._cameras)[:8]
        if self._triangulator is not None and self._features.beads >= 3:
            poses += poses_of_beads(sighted, self._features, self._triangulator)
        return poses

    def _of_two(self, window: Window, seen: Chosen, fitted: Fitted, past: Past | None) -> Fitted:
        """Of the two poses of the only tag that is seen the one to believe, its covariance grown by the other."""
        features = np.unique(seen.feature[fitted.used])
        if len(features) != 1 or features[0] < self._features.beads:
            self._doubt *= _FORGET
            return fitted
        other = self._other(window, seen, fitted, int(features[0]))
        if other is None:
            self._doubt *= _FORGET
            return fitted
        better = 0.5 * (fitted.cost - other.cost)
        self._doubt = _FORGET * self._doubt + 2.0 * better * (1.0 - _FORGET) * 2.0
        if past is None and not self._known:
            if better > 0.0:
                fitted, other, better = other, fitted, -better
        elif self._doubt > _BETTER:
            fitted, other, better, self._doubt = other, fitted, -better, 0.0
        share = 1.0 / (1.0 + np.exp(np.clip(-better, -50.0, 50.0)))
        off = np.concatenate(
            [
                other.motion.T[:3, 3] - fitted.motion.T[:3, 3],
                matrix_to_rotation_vector(other.motion.T[:3, :3] @ fitted.motion.T[:3, :3].T),
            ]
        )
        cov = fitted.cov.copy()
        cov[:6, :6] += share * np.outer(off, off)
        return replace(fitted, cov=cov)

    def _other(self, window: Window, seen: Chosen, fitted: Fitted, feature: int) -> Fitted | None:
        """The fit of the only tag's other pose, where there is another."""
        corners = self._features.corners_of(feature - self._features.beads)
        own = self._features.points[corners]
        best: Fitted | None = None
        for sighted in sighted_now(window, self._features):
            if sighted.feature != feature:
                continue
            camera = self._cameras[sighted.camera]
            for _, T in two_poses(own, camera.undistort(sighted.uv[0])):
                there = camera.T_rig_camera @ T
                if _turned(there, fitted.motion.T) < _FLIP_RAD:
                    continue
                other = self._fit(seen.seen, Motion.still(there), feature=seen.feature)
                if other is None or _turned(other.motion.T, fitted.motion.T) < _FLIP_RAD:
                    continue
                if best is None or other.cost < best.cost:
                    best = other
        return best

    def _held(self, window: Window, predicted: Motion | None) -> ObjectPose:
        """The pose while nothing tells: led on, or none."""
        known = self._known[-1] if self._known else None
        if predicted is None or known is None or window.t_ns - self._sure_ns > HELD_S * 1e9:
            return self._none(window)
        dt = (window.t_ns - known.t_ns) * 1e-9
        shown = self._hidden.look(
            window, predicted.T, np.zeros((len(self._cameras), self._features.count), np.bool_)
        )
        self._lost_behind = shown.occluded
        cov = known.fitted.cov[:6, :6].copy()
        grown = np.repeat([_PUSHED_M_S2, _PUSHED_RAD_S2], 3) * 0.5 * dt * dt
        speed = known.fitted.motion.rates[1].ravel() * (dt - _DIES_S * (1.0 - np.exp(-dt / _DIES_S)))
        cov[range(6), range(6)] += grown**2 + speed**2
        T = self._steady.held(window.t_ns, predicted.T)
        return ObjectPose(
            object=self.name,
            t_ns=window.t_ns,
            position_m=T[:3, 3],
            orientation_wxyz=matrix_to_quaternion(T[:3, :3]),
            cov=cov,
            residual_m=np.nan,
            source=int(ObjectSource.HELD),
            tracked=False,
            seen=0,
            expected=shown.expected,
            occluded=shown.occluded,
        )

    def _glimpsed(self, window: Window) -> bool:
        """Whether a camera sees some of the beads and not all, while there is no pose."""
        count = self._features.beads
        looks = [window.near(c, 0) for c in range(len(self._cameras))]
        seen = [int(np.isfinite(look.uv[:, 0]).sum()) for look in looks if look is not None]
        return any(0 < n < count for n in seen)

    def _none(self, window: Window) -> ObjectPose:
        """No pose; what hid it when it was lost is taken to hide it still."""
        self._steady.forget()
        return ObjectPose(
            object=self.name,
            t_ns=window.t_ns,
            position_m=np.full(3, np.nan),
            orientation_wxyz=np.full(4, np.nan),
            cov=np.full((6, 6), np.nan),
            residual_m=np.nan,
            source=int(ObjectSource.NONE),
            tracked=False,
            seen=0,
            expected=0,
            occluded=self._lost_behind or self._glimpsed(window),
        )


def _poor(fitted: Fitted, most_m: float, most_rad: float) -> bool:
    """Whether place or turn is less sure than this in some direction."""
    place = np.linalg.eigvalsh(fitted.cov[:3, :3])[-1]
    turn = np.linalg.eigvalsh(fitted.cov[3:6, 3:6])[-1]
    return not (place < most_m**2 and turn < most_rad**2)


def _unheeded(fitted: Fitted, alone: Fitted, since_s: float) -> Fitted:
    """A fit with what may have happened in directions that what is seen alone does not tell, for so long [s].

    A turn about the line through two beads shows in nothing but what it does to other turns, which is too little to
    rest on: its doubt grows as that of a thing that nobody sees.
    """
    scale = np.array([1.0] * 3 + [_ARM_M] * 3)
    size, axes = np.linalg.eigh(alone.cov[:6, :6] * np.outer(scale, scale))
    blind = axes[:, size > _POOR_M**2] / scale[:, None]
    cov = fitted.cov.copy()
    cov[:6, :6] += (0.5 * _UNSEEN_M_S2 * min(since_s, HELD_S) ** 2) ** 2 * (blind @ blind.T)
    return replace(fitted, cov=cov, alone=False)


def _turned(T: Float, other: Float) -> float:
    """Angle between two poses [rad]."""
    return float(np.linalg.norm(matrix_to_rotation_vector(T[:3, :3] @ other[:3, :3].T)))
