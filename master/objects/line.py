"""The pipeline of one object fits, filters and extrapolates its pose.

Detections of markers and tags go in, the pose at every frame of the leading camera comes out. `ObjectLine` is
a push machine without clock, socket or thread. For each epoch (`master.objects.window`) the pose is fitted
(`master.objects.fit`) from where it was led to from the last one; where there is none, or that fit finds most
of what is seen in the wrong place, from what is seen alone (`master.objects.association`), the best of all
starts.

**Too little is seen** to determine all of it, as two beads of three: then the prior estimate counts as well,
as it was at a time before all frames of this fit, so that nothing counts twice. **One tag** has two poses
that nearly explain it (`SingleTag`). **Nothing is seen**: the pose is led on with dying speed, and after
`HELD_S` there is none.

The 1 € filter is that of the rig, as of the hand (`master.estimator.smoothing`), with position and rotation
as its groups and the noise as it is measured. The position is that of the middle of the features, about which
the rotation is unsure; at the object's own origin, a lever away, the noise of the rotation would shake the
position as well. A rotation counts by how far it moves what is a decimetre away.
"""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from common.arrays import Float
from common.calibration import RigCalibration
from common.calibration.object_profile import ObjectProfile
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import (
    matrix_to_quaternion,
    matrix_to_rotation_vector,
    rigid,
    rotation_vector_to_matrix,
)
from common.messages import MarkerDetections, ObjectPose, ObjectSource, TagDetections
from master.estimator.sensors import CameraArrays
from master.fabrik.depth import CalibrationResidual
from master.fabrik.one_euro import NoiseEstimator, OneEuro, OneEuroParameters
from master.objects.association import (
    SingleTag,
    observations_of,
    poses_of_beads,
    poses_of_tags,
    sighted_now,
)
from master.objects.fit import Fitted, Motion, Observations, Past, PoseFit
from master.objects.surface import Features
from master.objects.window import Hidden, Window, Windows


class PoseFilter:
    """Push machine: 1 € filter of an object's pose; holds noise and the last output."""

    def __init__(self, middle_m: Float, parameters: OneEuroParameters) -> None:
        """Set up; `middle_m` (3,): of the features, object frame; parameters in [m, s]."""
        self._middle, self._parameters = middle_m, parameters
        self._filter: OneEuro | None = None
        self._noise = NoiseEstimator()
        self._t_ns, self._R, self._values = 0, np.eye(3), np.zeros(6)

    def push(self, t_ns: int, T: Float, cov: Float) -> Float:
        """The pose (4, 4) to show, of one that was measured with a covariance (6, 6)."""
        reset_s = 0.5
        if self._filter is None or (t_ns - self._t_ns) * 1e-9 > reset_s:
            self._filter, self._noise = OneEuro(self._parameters, (3, 3)), NoiseEstimator()
            self._R, self._values = T[:3, :3], np.zeros(6)
        arm_m = 0.1
        rotation = arm_m * matrix_to_rotation_vector(T[:3, :3] @ self._R.T)
        signals = np.concatenate([T[:3, :3] @ self._middle + T[:3, 3], self._values[3:] + rotation])
        independent_share = 0.15  # of the variance of a pose, new in each frame: most of its error stays
        noise = independent_share * np.concatenate([np.diagonal(cov)[:3], arm_m**2 * np.diagonal(cov)[3:]])
        values = self._filter.push(t_ns, signals, self._noise.push(t_ns, signals, noise))
        self._R = rotation_vector_to_matrix((values - self._values)[3:] / arm_m) @ self._R
        self._values, self._t_ns = values, t_ns
        return rigid(self._R, values[:3] - self._R @ self._middle)

    def forget(self) -> None:
        """Begin anew with the next pose."""
        self._filter = None


HELD_S = 0.5
_DIES_S = 0.12  # in which the speed of a thing that nobody sees dies
_PUSHED: Float = np.repeat([5.0, 40.0], 3)  # [m/s^2, rad/s^2] what may happen to its speed meanwhile
_UNSEEN_M_S2, _ARM_M = 1.5, 0.1  # how it moves unseen, a turn counting by what it does a decimetre away
_SCALE: Float = np.array([1.0] * 3 + [_ARM_M] * 3)
_SIX, _TWELVE = np.arange(6), np.arange(12)


class Trajectory:
    """Push machine: sixteen fitted poses, and when one was last fully constrained."""

    def __init__(self) -> None:
        poses = 16
        self._known: deque[tuple[int, Fitted]] = deque(maxlen=poses)
        self._sure_ns = -(2**63)

    def __bool__(self) -> bool:
        return bool(self._known)

    def push(self, t_ns: int, fitted: Fitted) -> bool:
        """Add a pose; False: not fully constrained for too long, all are forgotten."""
        self._known.append((t_ns, fitted))
        if fitted.measured_only:
            self._sure_ns = t_ns
        elif self.unsure_s(t_ns) > HELD_S:
            self._known.clear()
            return False
        return True

    def clear(self) -> None:
        """What was known of where it went is of another thing."""
        self._known.clear()

    def unsure_s(self, t_ns: int) -> float:
        """Return the time [s] since the pose was last fully constrained."""
        return (t_ns - self._sure_ns) * 1e-9

    def predicted(self, t_ns: int) -> Motion | None:
        """Where the object is led to; None: it was not seen for long."""
        if not self._known:
            return None
        last_ns, last = self._known[-1]
        dt = (t_ns - last_ns) * 1e-9
        if dt > HELD_S:
            self._known.clear()
            return None
        return last.motion.at(_DIES_S * float(1.0 - np.exp(-dt / _DIES_S)))

    def past(self, t_ns: int, oldest_ns: int) -> Past:
        """Return the prior at an epoch, from before its oldest observation."""
        known_ns, known = next((k for k in reversed(self._known) if k[0] <= oldest_ns), self._known[0])
        dt = max((t_ns - known_ns) * 1e-9, 1e-3)
        step = np.eye(12)
        step[_SIX, _SIX + 6] = dt
        grown = step @ known.cov @ step.T
        grown[_TWELVE, _TWELVE] += np.concatenate([0.5 * dt * dt * _PUSHED, dt * _PUSHED]) ** 2
        return Past(known.motion.at(dt), np.asarray(np.linalg.inv(grown), np.float64))

    def held_cov(self, t_ns: int) -> Float | None:
        """Return the covariance (6, 6) predicted unobserved; None: to be held no more."""
        if not self._known or self.unsure_s(t_ns) > HELD_S:
            return None
        known_ns, known = self._known[-1]
        dt = (t_ns - known_ns) * 1e-9
        cov = known.cov[:6, :6].copy()
        grown = _PUSHED * 0.5 * dt * dt
        speed = known.motion.rates[1].ravel() * (dt - _DIES_S * (1.0 - np.exp(-dt / _DIES_S)))
        cov[_SIX, _SIX] += grown**2 + speed**2
        return cov


def with_unobserved(fitted: Fitted, measured: Fitted, since_s: float, poor_m: float) -> Fitted:
    """Grow a fit's covariance in the directions the observations do not constrain.

    By what may have happened there for `since_s`. A turn about the line through two beads shows in nothing
    but what it does to other turns, which is too little to rest on: its covariance grows as that of a thing
    that nobody sees. `measured` is `fitted` without the past; what is less sure than `poor_m` is not
    reported.
    """
    size, axes = np.linalg.eigh(measured.cov[:6, :6] * np.outer(_SCALE, _SCALE))
    unobserved = axes[:, size > poor_m**2] / _SCALE[:, None]
    cov = fitted.cov.copy()
    cov[:6, :6] += (0.5 * _UNSEEN_M_S2 * min(since_s, HELD_S) ** 2) ** 2 * (unobserved @ unobserved.T)
    return replace(fitted, cov=cov, measured_only=False)


# What light does to a ball's centroid beyond what a slave reports, and to a corner.
_BEAD_FLOOR_PX, _CORNER_FLOOR_PX = 0.08, 0.03
_POOR_M, _POOR_RAD = 6e-3, np.radians(4.0)  # less sure than this: the past counts
# less sure than this it does not determine all of the pose
_INCOMPLETE_M, _INCOMPLETE_RAD = 0.02, np.radians(12.0)
_LOST_M, _LOST_RAD = 0.05, np.radians(30.0)  # less sure than this is no pose
_TRACKED_M, _TRACKED_RAD = 15e-3, np.radians(10.0)  # less sure than this is led on rather than measured


@dataclass(frozen=True, slots=True)
class SolvedObject:
    """A pose, and when its last contributing frame was handed to its slave."""

    pose: ObjectPose
    ready_t_ns: int


def no_pose(name: str, t_ns: int, *, expected: int, occluded: bool) -> ObjectPose:
    """Return the message that it is not known where an object is."""
    nowhere = np.full(3, np.nan), np.full(4, np.nan), np.full((6, 6), np.nan), np.nan
    return ObjectPose(name, t_ns, *nowhere, int(ObjectSource.NONE), False, 0, expected, occluded)


class ObjectLine:
    """Push machine: observations of one object to poses, fitted, filtered, led on."""

    def __init__(
        self, profile: ObjectProfile, rig: RigCalibration, models: Mapping[str, CameraModel]
    ) -> None:
        """Set up an object of beads or tags in a rig, whose cameras are `models`.

        Raises:
            CalibrationError: A bead is none of the rig's markers.
        """
        self.name = profile.name
        self._cameras = tuple(models.values())
        self._features = Features.of(profile, rig.markers)
        late = {name: round(1e3 * us) for name, us in rig.stamp_offset_us.items()}
        self._windows = Windows(models, self._features, predict=rig.frame_sync == "predict", late_ns=late)
        least_px = np.where(self._features.radius_m > 0.0, _BEAD_FLOOR_PX, _CORNER_FLOOR_PX)
        floor_px = np.maximum(CalibrationResidual.of(rig).rays_px, least_px)
        self._arrays = CameraArrays.of(self._cameras)
        self._fit = PoseFit(self._arrays, self._features.points, self._features.radius_m, floor_px)
        self._hidden = Hidden(self._features, self._cameras)
        middle = self._features.points.mean(axis=0) if len(self._features.points) else np.zeros(3)
        self._filter = PoseFilter(middle, OneEuroParameters.of(rig.filter))
        self._trajectory = Trajectory()
        self._single_tag = SingleTag(self._features, self._cameras, self._fit)
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
        predicted = self._trajectory.predicted(window.t_ns)
        seen = self._associated(window, None if predicted is None else predicted.T)
        now_s = 2.25 * window.period_ns * 1e-9  # an observation older than this is not now
        fitted = None
        if seen is not None and float(np.abs(seen.tau_s).min()) <= now_s:
            fitted = self._found(window, seen, predicted)
        if fitted is None or seen is None:
            return self._held(window, predicted)
        if not self._trajectory.push(window.t_ns, fitted):
            return self._none(window)
        tracked = fitted.measured_only or not fitted.poorer(_TRACKED_M, _TRACKED_RAD)
        used = np.zeros((len(self._cameras), self._features.count), np.bool_)
        here = fitted.used & seen.now
        used[seen.camera[here], seen.feature[here]] = True
        count, expected, self._lost_behind = self._hidden.look(window, fitted.motion.T, used)
        T = self._filter.push(window.t_ns, fitted.motion.T, fitted.cov[:6, :6])
        # What rests on both is called of markers.
        beads = (self._features.feature[seen.point[fitted.used]] < self._features.beads).any()
        source = ObjectSource.MARKERS if beads else ObjectSource.TAGS
        near = fitted.used & (np.abs(seen.tau_s) <= now_s)
        return ObjectPose(
            object=self.name,
            t_ns=window.t_ns,
            position_m=T[:3, 3],
            orientation_wxyz=matrix_to_quaternion(T[:3, :3]),
            cov=fitted.cov[:6, :6],
            residual_m=float(np.sqrt((fitted.residual_m[near] ** 2).mean())) if near.any() else np.nan,
            source=int(source if tracked else ObjectSource.HELD),
            tracked=tracked,
            seen=count,
            expected=expected,
            occluded=self._lost_behind,
        )

    def _found(self, window: Window, seen: Observations, predicted: Motion | None) -> Fitted | None:
        """Return the pose; None: it is not the object, or not constrained."""
        if predicted is not None:
            led = self._fitted(seen, predicted, window.t_ns, led=True)
            if led is not None and self._holds(led):
                return self._single_tag.of_two(window, seen, led, begins=False)
        good: list[tuple[Fitted, Observations]] = []
        for T in self._starts(window):
            again = self._associated(window, T)
            fitted = None if again is None else self._fitted(again, Motion.still(T), window.t_ns, led=False)
            if again is not None and fitted is not None and self._begins(again, fitted):
                good.append((fitted, again))
        if not good:
            return None
        # What was known of where it went is of another thing.
        self._trajectory.clear()
        self._single_tag.forget()
        fitted, again = min(good, key=lambda one: one[0].cost)
        return self._single_tag.of_two(window, again, fitted, begins=True)

    def _associated(self, window: Window, T: Float | None) -> Observations | None:
        """What is seen of the object, near a pose (4, 4) if there is one."""
        return observations_of(window, self._features, self._cameras, T, self._hidden.centroid_sigma_px)

    def _fitted(self, seen: Observations, start: Motion, t_ns: int, *, led: bool) -> Fitted | None:
        """Fit the pose, with the past as prior where the present is too weak.

        Only of a pose that was predicted (`led`). How it may have moved since is then in it.
        """
        measured = self._fit(seen, start)
        if measured is not None and not measured.poorer(_POOR_M, _POOR_RAD):
            return measured
        both = None
        if led:
            oldest_ns = t_ns + round(float(seen.tau_s.min()) * 1e9)
            both = self._fit(seen, start, self._trajectory.past(t_ns, oldest_ns))
        if measured is None:
            return None if both is None else replace(both, measured_only=False)
        if both is None or not measured.poorer(_INCOMPLETE_M, _INCOMPLETE_RAD):
            return measured if both is None else both
        return with_unobserved(both, measured, self._trajectory.unsure_s(t_ns), _POOR_M)

    def _holds(self, fitted: Fitted) -> bool:
        """Whether a pose is determined, and most of what is seen now is in its place."""
        most = 0.5  # share of what is seen that must be in its place
        return (
            not fitted.poorer(_LOST_M, _LOST_RAD)
            and float(fitted.weight.mean()) >= most
            and bool(fitted.used.any())
        )

    def _begins(self, seen: Observations, fitted: Fitted) -> bool:
        """Whether a pose may begin: it holds, and three beads, or a tag, fit."""
        if not self._holds(fitted):
            return False
        features = np.unique(seen.feature[fitted.used])
        enough = len(features) >= 3 or bool((features >= self._features.beads).any())
        start_chi2 = 25.0  # chi square per number of what a pose from nothing rests on
        return enough and float(fitted.chi2[fitted.used].mean()) < start_chi2

    def _starts(self, window: Window) -> list[Float]:
        """Poses (4, 4) that the nearest frames suggest."""
        sighted = sighted_now(window, self._features)
        poses = poses_of_tags(sighted, self._features, self._cameras)[:8]
        if len(self._cameras) > 1 and self._features.beads >= 3:
            poses += poses_of_beads(sighted, self._features, self._arrays)
        return poses

    def _held(self, window: Window, predicted: Motion | None) -> ObjectPose:
        """Return the pose while nothing constrains it: predicted, or none."""
        cov = self._trajectory.held_cov(window.t_ns)
        if predicted is None or cov is None:
            return self._none(window)
        T, nothing = predicted.T, np.zeros((len(self._cameras), self._features.count), np.bool_)
        _, expected, self._lost_behind = self._hidden.look(window, T, nothing)
        pose = self.name, window.t_ns, T[:3, 3], matrix_to_quaternion(T[:3, :3]), cov
        return ObjectPose(*pose, np.nan, int(ObjectSource.HELD), False, 0, expected, self._lost_behind)

    def _glimpsed(self, window: Window) -> bool:
        """Whether a camera sees some of the beads and not all, while there is no pose."""
        count = self._features.beads
        looks = [window.near(c, 0) for c in range(len(self._cameras))]
        seen = [int(np.isfinite(look.uv[:, 0]).sum()) for look in looks if look is not None]
        return any(0 < n < count for n in seen)

    def _none(self, window: Window) -> ObjectPose:
        """No pose; what hid it when it was lost is taken to hide it still."""
        self._filter.forget()
        occluded = self._lost_behind or self._glimpsed(window)
        return no_pose(self.name, window.t_ns, expected=0, occluded=occluded)
