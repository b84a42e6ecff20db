"""Pipeline of the marker rig.

It takes centroids of all cameras at one epoch, the card's line, and the estimator that starts from it.

`MarkerPipeline` is a push machine without clock, socket or thread: live and offline runs push the same messages
and get the same poses. It is built from calibration by `master.rig.files`.
"""

from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from math import nan
from typing import Protocol

import numpy as np

from common.arrays import Bool, Float, Int
from common.calibration import ImuCalibration, Volume
from common.geometry.camera_model import CameraModel
from common.hand.model import HandModel
from common.kernels import bound
from common.messages import HandPose, MarkerDetections, restamped
from master.estimator.cameras import CameraArrays
from master.estimator.epoch import Epoch, Fitted, OrientationMeasurement, WristRows
from master.estimator.estimator import Estimator
from master.estimator.gate import Prior, among, associate
from master.estimator.hand_tables import Mounts
from master.estimator.kinematics import quaternions
from master.estimator.palm_imu import OrientationTrack
from master.estimator.pose import pose_of
from master.estimator.smooth import HandOneEuro
from master.fabrik.blob_bias import LensShift
from master.fabrik.estimate import HandEstimate, MarkerPositions, SolvedHand
from master.fabrik.intersection import triangulate
from master.fabrik.rays import RayPositions, RayTriangulator
from master.fabrik.solver import FabrikSolver
from master.fabrik.sync import FrameSet

Stage = Callable[[str], AbstractContextManager[None]]
_NAME = 64  # characters of a name in `Health`


class WristSideOf(Protocol):
    """Measurements by a wrist device and its IMU of the hand the cameras watch.

    See `master.estimator.fused`.
    """

    def rows_at(self, t_ns: int) -> WristRows | None:
        """Return the rows of a strobe cycle that no epoch had.

        None: there is none.
        """
        ...

    def orientation_at(self, t_ns: int, estimator: Estimator) -> OrientationMeasurement | None:
        """Return the palm orientation measured by the IMU.

        None: the IMU does not report it.
        """
        ...

    def solved(self, t_ns: int, hand: Fitted, estimator: Estimator, *, oriented: bool) -> None:
        """Learn from an epoch that was solved."""
        ...

    def completed(self, pose: HandPose, estimator: Estimator) -> HandPose:
        """The pose with what else is known of the hand."""
        ...


@dataclass(frozen=True, slots=True)
class SolvedPose:
    """A pose, and when the last contributing frame was handed to its slave [ns]."""

    pose: HandPose
    ready_t_ns: int


class MarkerPipeline:
    """Push machine that holds sync, line, estimator and filter.

    Each has its own state; it also holds where markers were last.
    """

    def __init__(
        self,
        cameras: dict[str, CameraModel],
        model: HandModel,
        markers: tuple[str, ...],
        *,
        line: FabrikSolver,
        rays: RayTriangulator | None,
        rays_px: float = 0.0,
        estimator: Estimator | None,
        smooth: HandOneEuro | None = None,
        stamp_offset_us: Mapping[str, float] | None = None,
        volume: Volume | None = None,
        imu: ImuCalibration | None = None,
        side: "WristSideOf | None" = None,
        counts: Counter[str] | None = None,
        stage: Stage = lambda name: nullcontext(),
        dropped_epochs: Callable[[], bool] | None = None,
    ) -> None:
        """Join the parts.

        Args:
            cameras: In the rig's order.
            model: The hand.
            markers: Names in the order of every marker array.
            line: Brings the cameras to one epoch, and solves it first.
            rays: Places markers by the rays of all cameras; None: there is one camera.
            rays_px: Standard deviation per axis that the calibration leaves.
            estimator: Fits the hand to the pixels, from the line's hand; None: the line's hand is published.
            smooth: Filters the fitted hand; None: frames are unrelated, nothing is filtered.
            stamp_offset_us: Camera -> how much later its frames really are than their stamps; added to them.
            volume: What the rig states, or None; joints report whether they lie in it.
            imu: On the palm; its orientation is used where the rig states how it is mounted and how its world lies.
            side: Wrist device and IMU on the forearm of this hand; None: there are none.
            counts: Counted into; None: counts of its own.
            stage: Opens a timer by stage name.
            shed: Asked for each epoch whether to drop it for newer ones (`master.run.load_shedding`); None: none is.
        """
        self.model, self.markers = model, markers
        self.counts: Counter[str] = Counter() if counts is None else counts
        self._names, self._cameras = tuple(cameras), CameraArrays.of(tuple(cameras.values()))
        self._line, self._rays, self._rays_px = line, rays, rays_px
        self._estimator, self._smooth = estimator, smooth
        bound(quaternions, np.empty((26, 3, 3)), np.empty((26, 4)))  # compiles it here, so that no pose waits
        self._lens_shift = LensShift(tuple(cameras.values()))
        self._on_hand, self._hand_markers = line.on_hand, tuple(markers[int(m)] for m in line.on_hand)
        joints = [model.mount(name).joint for name in self._hand_markers]
        self._joint = np.array([0 if joint is None else joint for joint in joints])  # 0: the palm
        self._finger_of = Mounts.of(model, self._hand_markers).finger
        self._stage, self._volume, self._dropped_epochs, self._side = stage, volume, dropped_epochs, side
        self._orientation = None if imu is None or not imu.placed else OrientationTrack(imu, self.counts)
        self._last_ns = -(2**63)
        self._late_ns = {name: round(1e3 * us) for name, us in (stamp_offset_us or {}).items()}
        self._last: Fitted | None = None
        self._was_m = np.full((len(markers), 3), np.nan)
        never_ns = -(2**62)
        self._was_ns: Int = np.full(len(markers), never_ns, np.int64)

    def push(self, message: MarkerDetections) -> list[SolvedPose]:
        """Take one camera's detections; return the poses they complete, oldest first."""
        if late_ns := self._late_ns.get(message.camera):
            message = restamped(message, t_ns=message.t_ns + late_ns)
        with self._stage("frame_sync"):
            sets = self._line.sync.push(message)
        if self._line.sync.stale:
            self.counts["instants_outdated"] = self._line.sync.stale
        return self._solved(sets)

    def no_observation(self, t_ns: int, ready_t_ns: int) -> SolvedPose | None:
        """Return the pose at an epoch at which no camera saw anything.

        It comes from what else watches the hand; None: the epoch is past.
        """
        shape = (len(self._names), len(self.markers))
        unseen, nothing = np.full(shape, np.nan), np.full((*shape, 2), np.nan)
        missing = np.ones(len(self._names), np.bool_)
        poses = self._solved([FrameSet(t_ns, nothing, unseen, unseen, ready_t_ns, missing)])
        return poses[0] if poses else None

    def push_orientation(self, t_ns: int, orientation_wxyz: Float, heading_sigma_rad: float = nan) -> None:
        """Take the orientation (4,) that the IMU reports of itself.

        It serves the epochs about `t_ns`.
        """
        if self._orientation is None:
            self.counts["orientation.unplaced"] += 1
        else:
            self._orientation.push(t_ns, orientation_wxyz, heading_sigma_rad)

    def flush(self) -> list[SolvedPose]:
        """At the end of a recording: the poses that still wait for a camera."""
        return self._solved(self._line.sync.flush())

    def _solved(self, sets: list[FrameSet]) -> list[SolvedPose]:
        """Return the poses of epochs later than the last one.

        Others are counted: cameras came back with old frames.
        """
        poses: list[SolvedPose] = []
        for frames in sets:
            if frames.t_ns <= self._last_ns:
                self.counts["instants_late"] += 1
                continue
            self._last_ns = frames.t_ns
            if self._dropped_epochs is not None and self._dropped_epochs():
                self.counts["instants_shed"] += 1
                continue
            poses.append(self._solve(frames))
        return poses

    def _solve(self, frames: FrameSet) -> SolvedPose:
        t_ns, last, age_s = frames.t_ns, self._recent(frames.t_ns), 0.0
        if last is not None:
            age_s = (t_ns - self._estimator.t_ns) * 1e-9 if self._estimator else 0.0
        with self._stage("triangulate"):
            if self._lens_shift.any:
                frames = replace(frames, uv=self._lens_shift.centres(frames.uv, frames.area))
            if frames.alt_uv is not None:
                frames = self._associated(frames)
        line = self._line.solve(frames, last, age_s)
        hand: HandEstimate | Fitted = line
        found = line.markers
        if self._estimator is not None:
            found = self._triangulated(frames, line, last, age_s)
            hand = self._fitted(self._estimator, frames, line, found)
        if found.outliers.any() or found.rejected.any():
            self._count_outliers(found, frames)
        pose = pose_of(hand, self.model, t_ns, line.smooth_m, line.markers, self._volume)
        if self._side is not None and self._estimator is not None:
            pose = self._side.completed(pose, self._estimator)
        if self._line.continuous:
            placed = np.isfinite(line.markers.points_m[:, 0])
            self._was_m[placed], self._was_ns[placed] = line.markers.points_m[placed], t_ns
        self.counts["poses"] += 1
        self.counts["outside_volume"] += int(not pose.inside_volume[pose.valid].all())
        self.counts["instants_with_missing_camera"] += int(frames.missing.any())
        return SolvedPose(pose, frames.ready_t_ns)

    def _recent(self, t_ns: int) -> SolvedHand | None:
        """Return the hand that was fitted last, if it is still informative."""
        if self._estimator is None or self._last is None or not self._estimator.has_previous(t_ns):
            return None
        return self._last.solution

    def _triangulated(
        self, frames: FrameSet, line: HandEstimate, last: SolvedHand | None, age_s: float
    ) -> MarkerPositions:
        """The markers by the rays of all cameras; the line's own where it goes by these."""
        if self._rays is None or isinstance(line.markers, RayPositions):
            return line.markers
        with self._stage("triangulate"):
            warm_start = last or line.solution
            return self._rays(
                frames.uv, frames.sigma_px, frames.area, warm_start, age_s, as_seen=warm_start is None
            )

    def _fitted(
        self, estimator: Estimator, frames: FrameSet, line: HandEstimate, found: MarkerPositions
    ) -> Fitted:
        """The hand that explains the pixels of one epoch best."""
        with self._stage("hand"):
            uv, variance = frames.uv, frames.sigma_px**2 + self._rays_px**2
            own = np.zeros((len(self.markers), 3, 3))
            if isinstance(found, RayPositions):
                uv, variance, own = found.uv, found.variance_px2, found.own_m2
            others = self._side is not None or self._orientation is not None
            orientation = self._measured_orientation(frames.t_ns, line) if others else None
            hand = estimator.push(
                Epoch(
                    frames.t_ns,
                    found.points_m,
                    line.back_normal,
                    uv=uv,
                    variance_px2=variance,
                    own_m2=own,
                    orientation=orientation,
                    wrist=None if self._side is None else self._side.rows_at(frames.t_ns),
                    start=line.solution if line.solved else None,
                )
            )
            self._last = hand
            if self._side is not None:
                self._side.solved(frames.t_ns, hand, estimator, oriented=orientation is not None)
            if self._smooth is not None:
                on_hand = self._on_hand
                hand = self._smooth.push(frames.t_ns, hand, found.noise_m2[on_hand], found.points_m[on_hand])
            return hand

    def _measured_orientation(self, t_ns: int, line: HandEstimate) -> OrientationMeasurement | None:
        """How an IMU on the palm, or on the forearm, has the palm turned at an epoch."""
        if self._side is not None and self._estimator is not None:
            return self._side.orientation_at(t_ns, self._estimator)
        if self._orientation is None:
            return None
        return self._orientation.at(t_ns, self._recent(t_ns) or line.solution)

    def _associated(self, frames: FrameSet) -> FrameSet:
        """The epoch with one place for each marker."""
        assert frames.alt_uv is not None
        assert frames.alt_sigma_px is not None
        ambiguous = np.isfinite(frames.alt_uv[..., 0]).any(axis=0)
        if (
            not ambiguous.any()
        ):  # an alternative was named in a frame nearby, and is not carried to this epoch
            return replace(frames, alt_uv=None)
        first = triangulate(self._cameras, frames.uv, frames.sigma_px, self._rays_px)
        clear = np.where((ambiguous | first.outliers)[:, None], np.nan, first.points_m)
        others = self._line.solve_once(clear, first.cov_m2, frames.area)
        associated = associate(
            self._cameras,
            (frames.uv, frames.sigma_px, frames.area),
            (frames.alt_uv, frames.alt_sigma_px),
            among(clear, self._on_hand) if others is None else self._expected(others),
            (self._was_m, np.asarray((frames.t_ns - self._was_ns) * 1e-9, np.float64)),
            self._rays_px,
        )
        self._count("alternative", associated.taken)
        self._count("unclear", associated.dropped)
        return replace(
            frames,
            uv=associated.uv,
            sigma_px=associated.sigma_px,
            area=associated.area_px2,
            alt_uv=None,
        )

    def _expected(self, hand: SolvedHand) -> Prior:
        """Where a hand has the markers."""
        points = np.full((len(self.markers), 3), np.nan)
        cov = np.full((len(self.markers), 3, 3), np.nan)
        points[self._on_hand] = self.model.marker_points(hand.joints, self._hand_markers)
        cov[self._on_hand] = hand.cov_m2[self._joint]
        return Prior(points, cov)

    def _count(self, event: str, markers: Bool) -> None:
        """Count an event of each of the markers (M,) by name."""
        for m in np.flatnonzero(markers):
            self.counts[f"{event}.{self.markers[m]}"[:_NAME]] += 1

    def _count_outliers(self, found: MarkerPositions, frames: FrameSet) -> None:
        """Count markers whose rays do not meet, and what is rejected of each camera."""
        if found.outliers.any():
            self._count("apart", found.outliers)
            self.counts["epipolar_outliers"] += int(found.outliers.sum())
        sees = np.isfinite(frames.uv[..., 0]) & np.isfinite(found.points_m[:, 0])
        mostly = found.rejected.sum(axis=1) > 0.5 * sees.sum(axis=1)
        for c in np.flatnonzero(found.rejected.any(axis=1)):
            self.counts[f"rejected.{self._names[c]}"[:_NAME]] += int(found.rejected[c].sum())
            if mostly[c]:
                self.counts[f"mostly_rejected.{self._names[c]}"[:_NAME]] += 1
