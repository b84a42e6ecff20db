"""Pipeline of one object.

Detections of markers and tags go in, its pose at every frame of the leading camera comes out.

`ObjectLine` is a push machine without clock, socket or thread. For each epoch (`master.objects.window`) the pose is
fitted (`master.objects.fit`) from where it was led to from the last one; where there is none, or that fit finds most of
what is seen in the wrong place, from what is seen alone (`master.objects.start`), the best of all starts.

**Too little is seen** to determine all of it, as two beads of three: then the prior estimate counts as well
(`master.objects.trajectory`), as it was at a time before all frames of this fit, so that nothing counts twice.

**One tag** has two poses that nearly explain it (`master.objects.single_tag`).

**Nothing is seen**: the pose is led on with dying speed, and after `HELD_S` there is none.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from common.arrays import Float, Int
from common.calibration import RigCalibration
from common.calibration.object_profile import ObjectProfile
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import matrix_to_quaternion
from common.messages import MarkerDetections, ObjectPose, ObjectSource, TagDetections
from master.estimator.cameras import CameraArrays
from master.fabrik.depth import CalibrationResidual
from master.fabrik.one_euro import OneEuroParameters
from master.objects.association import Association, sighted_now
from master.objects.features import Features
from master.objects.fit import Fitted, PoseFit
from master.objects.hidden import Hidden
from master.objects.motion import Motion
from master.objects.pose_filter import PoseFilter
from master.objects.single_tag import SingleTag
from master.objects.start import poses_of_beads, poses_of_tags
from master.objects.trajectory import Trajectory, unheeded
from master.objects.window import Window, Windows

# What light does to a ball's centroid beyond what a slave reports, and to a corner.
_BEAD_FLOOR_PX, _CORNER_FLOOR_PX = 0.08, 0.03
_POOR_RAD = np.radians(4.0)  # less sure than this: the past counts
_INCOMPLETE_RAD = np.radians(12.0)  # less sure than this it does not determine all of the pose
_LOST_RAD = np.radians(30.0)  # less sure than this is no pose
_TRACKED_RAD = np.radians(10.0)  # less sure than this is led on rather than measured


@dataclass(frozen=True, slots=True)
class SolvedObject:
    """A pose of an object, with its latest input time.

    That is when the last frame that contributed to it was handed to its slave [ns].
    """

    pose: ObjectPose
    ready_t_ns: int


class ObjectLine:
    """Pipeline of one object from observations to poses.

    Push machine. Holds the observations that wait, where the object went, the filter, and how sure a tag's pose is.
    """

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
        self._windows = Windows(models, self._features, predict=rig.frame_sync == "predict", late_ns=late)
        least_px = np.where(self._features.radius_m > 0.0, _BEAD_FLOOR_PX, _CORNER_FLOOR_PX)
        floor_px = np.maximum(CalibrationResidual.of(rig).rays_px, least_px)
        self._fit = PoseFit(self._cameras, self._features.points, self._features.radius_m, floor_px)
        self._arrays = CameraArrays.of(self._cameras)
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
        max_age_periods = 2.25  # an observation older than this is not now
        now = (
            seen is not None
            and float(np.abs(seen.seen.tau_s).min()) <= max_age_periods * window.period_ns * 1e-9
        )
        fitted = None
        if seen is not None and now:
            fitted = self._found(window, seen, predicted)
        if fitted is None or seen is None:
            return self._held(window, predicted)
        if not self._trajectory.push(window.t_ns, fitted):
            return self._none(window)
        tracked_m = 15e-3  # less sure than this is led on rather than measured
        tracked = fitted.measured_only or not fitted.poorer(tracked_m, _TRACKED_RAD)
        shown = self._hidden.look(window, fitted.motion.T, seen.used(fitted))
        self._lost_behind = shown.occluded
        T = self._filter.push(window.t_ns, fitted.motion.T, fitted.cov[:6, :6])
        features = self._features.feature[seen.seen.point[fitted.used]]
        near = fitted.used & (np.abs(seen.seen.tau_s) <= max_age_periods * window.period_ns * 1e-9)
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

    def _found(self, window: Window, seen: Association, predicted: Motion | None) -> Fitted | None:
        """Return the pose at the epoch.

        None: what is seen is not the object, or does not constrain its pose.
        """
        if predicted is not None:
            led = self._fitted(seen, predicted, window.t_ns, led=True)
            if led is not None and self._holds(seen, led):
                return self._single_tag.of_two(window, seen, led, begins=False)
        best: tuple[Fitted, Association] | None = None
        for T in self._starts(window):
            again = self._associated(window, T)
            if (
                again is None
                or (fitted := self._fitted(again, Motion.still(T), window.t_ns, led=False)) is None
            ):
                continue
            good = self._holds(again, fitted) and self._begins(again, fitted)
            if good and (best is None or fitted.cost < best[0].cost):
                best = fitted, again
        if best is None:
            return None
        # What was known of where it went is of another thing.
        self._trajectory.clear()
        self._single_tag.forget()
        return self._single_tag.of_two(window, best[1], best[0], begins=True)

    def _associated(self, window: Window, T: Float | None) -> Association | None:
        """What is seen of the object, near a pose (4, 4) if there is one."""
        return Association.of(window, self._features, self._cameras, T, self._hidden.centroid_sigma_px)

    def _fitted(self, seen: Association, start: Motion, t_ns: int, *, led: bool) -> Fitted | None:
        """Fit the pose, with the past as prior where the present is too weak.

        The past is used only for a pose that was predicted (`led`), where the present does not constrain enough.

        How it may have moved since is then in it.
        """
        measured = self._fit(seen.seen, start, feature=seen.feature)
        poor_m = 6e-3  # less sure than this: the past counts
        if measured is not None and not measured.poorer(poor_m, _POOR_RAD):
            return measured
        both = None
        if led:
            oldest_ns = t_ns + round(float(seen.seen.tau_s.min()) * 1e9)
            past = self._trajectory.past(t_ns, oldest_ns)
            both = self._fit(seen.seen, start, past, feature=seen.feature)
        if measured is None:
            return None if both is None else replace(both, measured_only=False)
        incomplete_m = 0.02  # less sure than this it does not determine all of the pose
        if both is None or not measured.poorer(incomplete_m, _INCOMPLETE_RAD):
            return measured if both is None else both
        return unheeded(both, measured, self._trajectory.unsure_s(t_ns), poor_m)

    def _holds(self, seen: Association, fitted: Fitted) -> bool:
        """Whether a pose is determined, and most of what is seen now is in its place."""
        lost_m = 0.05  # less sure than this is no pose
        if fitted.poorer(lost_m, _LOST_RAD):
            return False
        most = 0.5  # share of what is seen that must be in its place
        return float(fitted.weight.mean()) >= most and len(np.unique(seen.feature[fitted.used])) >= 1

    def _begins(self, seen: Association, fitted: Fitted) -> bool:
        """Whether a pose may begin with no past: three beads, or a tag, that fit."""
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
        shown = self._hidden.look(
            window, predicted.T, np.zeros((len(self._cameras), self._features.count), np.bool_)
        )
        self._lost_behind = shown.occluded
        T = self._filter.held(window.t_ns, predicted.T)
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
        self._filter.forget()
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
