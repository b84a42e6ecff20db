"""The pipeline of the marker rig turns frames and IMU samples into poses.

`MarkerPipeline` is a push machine without clock, socket or thread: live and offline runs push the same
messages and get the same poses. It is built from calibration by `master.rig.setup`.

An IMU on the palm measures its axes in a world of its own, whose z axis is vertical:

    R_rig_palm = R_rig_world R_world_imu R_palm_imu^T

Gravity holds the tilt against the vertical. The heading about it is only summed up from angular rates and
drifts, unless a magnetometer holds it. So the covariance is narrow across the vertical and wide about it. A
heading of which nothing is known is taken from the hand as it was solved, and left to it.
"""

from collections import Counter, deque
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, replace
from math import acos, atan2, hypot, isnan, nan, sin, sqrt
from typing import TYPE_CHECKING

import numpy as np

from common.arrays import Bool, Float, Int
from common.calibration import UNIT_WITHIN, ImuCalibration, Quaternion, Volume
from common.errors import CalibrationError
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import (
    Wxyz,
    matrix_of,
    matrix_to_quaternion,
    quaternion_to_matrix,
    rotation_vector_to_matrix,
)
from common.hand.model import HandModel
from common.kernels import bound
from common.messages import Detections, HandPose, WristDetections, restamped
from common.messages.parts import MAX_NAME_CHARACTERS
from master.estimator.epoch import (
    Epoch,
    Fitted,
    HandEstimate,
    MarkerPositions,
    OrientationMeasurement,
    SolvedHand,
)
from master.estimator.estimator import Estimator, pose_of
from master.estimator.kinematics import quaternions
from master.estimator.sensors import CameraArrays
from master.estimator.settings import DEFAULT
from master.estimator.smoothing import HandOneEuro
from master.fabrik.caps import LensShift
from master.fabrik.intersection import Prior, among, associate, triangulate
from master.fabrik.rays import RayPositions, RayTriangulator
from master.fabrik.settings import NEVER_NS
from master.fabrik.solver import FabrikSolver, Stage
from master.fabrik.sync import FrameSet

if TYPE_CHECKING:  # it imports this file
    from master.estimator.wrist_pipeline import WristSide

_REACH_NS = round(1e9 * DEFAULT.sample_reach_s)


@dataclass(frozen=True, slots=True, eq=False)
class _Sample:
    t_ns: int
    q_wxyz: Wxyz
    drift_rad: float


@dataclass(frozen=True, slots=True, eq=False)
class Between:
    """Orientation of an IMU at a time."""

    q_wxyz: Wxyz
    gap_s: float  # how far from samples that is [s]
    drift_rad: float  # how far its heading has drifted since the first sample, standard deviation [rad]


class OrientationSamples:
    """Push machine. Holds the newest samples, and when the first came.

    It counts what it rejects: `orientation.missing`, `orientation.not_unit`, `orientation.late`.
    """

    def __init__(self, counts: Counter[str], drift_rad_s: float, late_us: float = 0.0) -> None:
        """Begin empty; `drift_rad_s`: of unstated headings, `late_us`: added to stamps."""
        self.counts, self._drift_rad_s, self._late_ns = counts, drift_rad_s, round(1e3 * late_us)
        self._samples: deque[_Sample] = deque(maxlen=round(DEFAULT.samples))
        self._first_ns: int | None = None

    def __len__(self) -> int:
        return len(self._samples)

    def push(self, t_ns: int, orientation_wxyz: Float, heading_sigma_rad: float = nan) -> None:
        """Take one sample (4,), IMU axes -> its world, and how far its heading drifted.

        What is no rotation is rejected. A sample long before the newest means that a clock was set back, or
        that the newest came from a time that is not yet: the others are forgotten.
        """
        t_ns += self._late_ns
        w, x, y, z = orientation_wxyz.tolist()
        length = sqrt(w * w + x * x + y * y + z * z)
        if isnan(length):
            self.counts["orientation.missing"] += 1
        elif abs(length - 1.0) > UNIT_WITHIN:
            self.counts["orientation.not_unit"] += 1
        else:
            if self._samples and t_ns <= (newest_ns := self._samples[-1].t_ns):
                if newest_ns - t_ns <= _REACH_NS:
                    self.counts["orientation.late"] += 1
                    return
                self._samples.clear()
            self._first_ns = t_ns if self._first_ns is None else min(self._first_ns, t_ns)
            drift_rad = heading_sigma_rad
            if isnan(drift_rad):
                drift_rad = 1e-9 * (t_ns - self._first_ns) * self._drift_rad_s
            unit = w / length, x / length, y / length, z / length
            self._samples.append(_Sample(t_ns, unit, drift_rad))

    def between(self, t_ns: int) -> Between | None:
        """Return the orientation at a time; None: too far from any sample.

        The times to both sides count as resistors in parallel do: with one side alone it is the time to that.
        """
        before: _Sample | None = None
        after: _Sample | None = None
        for sample in reversed(self._samples):
            if sample.t_ns <= t_ns:
                before = sample
                break
            after = sample
        if before is not None and t_ns - before.t_ns > _REACH_NS:
            before = None
        if after is not None and after.t_ns - t_ns > _REACH_NS:
            after = None
        if before is not None and after is not None:
            a, b = t_ns - before.t_ns, after.t_ns - t_ns
            q = slerp(before.q_wxyz, after.q_wxyz, a / (a + b))
            return Between(q, 1e-9 * a * b / (a + b), after.drift_rad)
        one = before or after
        return None if one is None else Between(one.q_wxyz, 1e-9 * abs(t_ns - one.t_ns), one.drift_rad)


def slerp(first: Wxyz, second: Wxyz, share: float) -> Wxyz:
    """Return the unit quaternion at `share` 0...1 of the shorter arc (Shoemake 1985)."""
    (a, b, c, d), (w, x, y, z) = first, second
    cosine = a * w + b * x + c * y + d * z
    angle = acos(min(abs(cosine), 1.0))
    sine = sin(angle)
    straight = 1e-9  # sine of an angle below which an arc is a straight line
    if sine < straight:
        return first
    p, q = sin((1.0 - share) * angle) / sine, sin(share * angle) / sine
    q = q if cosine >= 0.0 else -q
    return p * a + q * w, p * b + q * x, p * c + q * y, p * d + q * z


_EYE = np.eye(3)


class OrientationTrack:
    """Push machine. Holds the samples of one IMU.

    It counts `orientation.used`, epochs that had one, `orientation.absent`, those that had none, and what
    `OrientationSamples` rejects.
    """

    def __init__(self, imu: ImuCalibration, counts: Counter[str] | None = None) -> None:
        """Follow the IMU of a rig file, counting into `counts` if given.

        Raises:
            CalibrationError: The file does not state how it is mounted, or how its world lies to the rig.
        """
        self._imu = imu
        self._palm_imu = rotation_of("q_palm_imu", imu.q_palm_imu)
        self._rig_world = rotation_of("q_rig_world", imu.q_rig_world)
        self._up = self._rig_world[:, 2]
        self.counts: Counter[str] = Counter() if counts is None else counts
        self._samples = OrientationSamples(self.counts, imu.heading_drift_rad_s, imu.stamp_offset_us)

    def push(self, t_ns: int, orientation_wxyz: Float, heading_sigma_rad: float = nan) -> None:
        """Take one sample, as of `OrientationSamples.push`."""
        self._samples.push(t_ns, orientation_wxyz, heading_sigma_rad)

    def at(self, t_ns: int, hand: SolvedHand | None) -> OrientationMeasurement | None:
        """Return the palm's orientation at a time, or None; `hand` may give the heading."""
        found = self._samples.between(t_ns)
        heading_rad = None if found is None else self._heading_rad(found.drift_rad)
        if found is None or (heading_rad is None and hand is None):
            self.counts["orientation.absent"] += 1
            return None
        self.counts["orientation.used"] += 1
        rotation = self._rig_world @ matrix_of(found.q_wxyz) @ self._palm_imu.T
        if heading_rad is None and hand is not None:
            rotation = _twist_about(self._up, hand.T_rig_palm[:3, :3] @ rotation.T) @ rotation
        tilt_2 = self._imu.orientation_sigma_rad**2 + (DEFAULT.palm_process_noise_rad_s * found.gap_s) ** 2
        about_2 = max((DEFAULT.heading_free_rad if heading_rad is None else heading_rad) ** 2, tilt_2)
        along = np.outer(self._up, self._up)
        information = _EYE / tilt_2 + (1.0 / about_2 - 1.0 / tilt_2) * along
        return OrientationMeasurement(rotation, information, sure=about_2 < DEFAULT.sure_rad**2)

    def _heading_rad(self, drift_rad: float) -> float | None:
        """Standard deviation of the heading after such a drift; None: not known."""
        if self._imu.heading_sigma_rad is None:
            return None
        predicted = hypot(self._imu.heading_sigma_rad, drift_rad)
        return predicted if predicted < DEFAULT.heading_lost_rad else None


def _twist_about(axis: Float, rotation: Float) -> Float:
    """Return the rotation (3, 3) about a unit axis (3,) nearest to one: its twist."""
    w, *v = matrix_to_quaternion(rotation)
    return rotation_vector_to_matrix(2.0 * atan2(float(np.array(v) @ axis), float(w)) * axis)


def rotation_of(key: str, value: Quaternion | None) -> Float:
    """The rotation (3, 3) of a key of the rig file.

    Raises:
        CalibrationError: It is missing.
    """
    if value is None:
        raise CalibrationError(
            f"imu.{key}: missing; the orientation of the IMU cannot be used without: a quaternion wxyz of length 1"
        )
    return quaternion_to_matrix(np.array(value))


@dataclass(frozen=True, slots=True)
class SolvedPose:
    """A pose, and when the last contributing frame was handed to its slave [ns]."""

    pose: HandPose
    ready_t_ns: int


class MarkerPipeline:
    """Push machine that holds sync, line, estimator, filter, and last marker places."""

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
        side: "WristSide | None" = None,
        slowest_hz: float,
        counts: Counter[str] | None = None,
        stage: Stage = lambda name: nullcontext(),
        dropped_epochs: Callable[[], bool] | None = None,
    ) -> None:
        """Join the parts; cameras in the rig's order, markers in that of every array.

        Args:
            line: Brings the cameras to one epoch, and solves it first.
            rays: Places markers by the rays of all cameras; None: there is one camera.
            rays_px: Standard deviation per axis that the calibration leaves.
            estimator: Fits the hand to the pixels, from the line's hand; None: the line's hand is published.
            smooth: Filters the fitted hand; None: frames are unrelated, nothing is filtered.
            stamp_offset_us: Camera -> how much later its frames really are than their stamps; added to them.
            volume: Joints report whether they lie in it; None: none is stated.
            imu: On the palm; used where the rig states how it is mounted and how its world lies.
            side: Wrist device and IMU on the forearm of this hand; None: there are none.
            slowest_hz: Frame rate of the slowest camera; when longer than its frames take no epoch came, the
                strobe cycles of the wrist device lead.
            stage: Opens a timer by stage name.
            dropped_epochs: Asked for each epoch whether to drop it for newer ones; None: none is.
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
        self._stage, self._volume, self._dropped_epochs, self._side = stage, volume, dropped_epochs, side
        self._orientation = None if imu is None or not imu.placed else OrientationTrack(imu, self.counts)
        self._silent_ns = round(DEFAULT.silent_frames * 1e9 / slowest_hz)
        self._by_cameras_ns: int | None = None
        self._last_ns = NEVER_NS
        self._late_ns = {name: round(1e3 * us) for name, us in (stamp_offset_us or {}).items()}
        self._last: Fitted | None = None
        self._was_m = np.full((len(markers), 3), np.nan)
        self._was_ns: Int = np.full(len(markers), NEVER_NS, np.int64)

    def push(self, message: Detections) -> list[SolvedPose]:
        """Take what one camera saw; return the poses it completes, oldest first."""
        if isinstance(message, WristDetections):
            return self._push_cycle(message)
        if late_ns := self._late_ns.get(message.camera):
            message = restamped(message, t_ns=message.t_ns + late_ns)
        with self._stage("frame_sync"):
            sets = self._line.sync.push(message)
        if self._line.sync.stale:
            self.counts["instants_outdated"] = self._line.sync.stale
        poses = self._solved(sets)
        if poses:
            self._by_cameras_ns = poses[-1].pose.t_ns
        return poses

    def _push_cycle(self, cycle: WristDetections) -> list[SolvedPose]:
        """Take a strobe cycle; it waits for an epoch, or is one without cameras."""
        t_ns, last_ns = None if self._side is None else self._side.push(cycle), self._by_cameras_ns
        if t_ns is None or (last_ns is not None and t_ns - last_ns <= self._silent_ns):
            return []
        shape = (len(self._names), len(self.markers))
        unseen, nothing = np.full(shape, np.nan), np.full((*shape, 2), np.nan)
        missing = np.ones(len(self._names), np.bool_)
        self.counts["poses_by_wrist"] += 1
        return self._solved([FrameSet(t_ns, nothing, unseen, unseen, cycle.ready_t_ns, missing)])

    def push_orientation(self, t_ns: int, orientation_wxyz: Float, heading_sigma_rad: float = nan) -> None:
        """Take the orientation (4,) of the IMU, for the epochs about `t_ns`."""
        imu = self._orientation if self._side is None else self._side.forearm
        if imu is None:
            self.counts["orientation.unplaced"] += 1
        else:
            imu.push(t_ns, orientation_wxyz, heading_sigma_rad)

    def flush(self) -> list[SolvedPose]:
        """At the end of a recording: the poses that still wait for a camera."""
        return self._solved(self._line.sync.flush())

    def _solved(self, sets: list[FrameSet]) -> list[SolvedPose]:
        """Return the poses of epochs after the last; others (old frames) are counted."""
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
        # an alternative was named in a frame nearby, and is not carried to this epoch
        if not ambiguous.any():
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
            frames, uv=associated.uv, sigma_px=associated.sigma_px, area=associated.area_px2, alt_uv=None
        )

    def _expected(self, hand: SolvedHand) -> Prior:
        points = np.full((len(self.markers), 3), np.nan)
        cov = np.full((len(self.markers), 3, 3), np.nan)
        points[self._on_hand] = self.model.marker_points(hand.joints, self._hand_markers)
        cov[self._on_hand] = hand.cov_m2[self._joint]
        return Prior(points, cov)

    def _count(self, event: str, markers: Bool) -> None:
        for m in np.flatnonzero(markers):
            self.counts[f"{event}.{self.markers[m]}"[:MAX_NAME_CHARACTERS]] += 1

    def _count_outliers(self, found: MarkerPositions, frames: FrameSet) -> None:
        """Count markers whose rays do not meet, and what is rejected of each camera."""
        if found.outliers.any():
            self._count("apart", found.outliers)
            self.counts["epipolar_outliers"] += int(found.outliers.sum())
        sees = np.isfinite(frames.uv[..., 0]) & np.isfinite(found.points_m[:, 0])
        mostly = found.rejected.sum(axis=1) > 0.5 * sees.sum(axis=1)
        for c in np.flatnonzero(found.rejected.any(axis=1)):
            self.counts[f"rejected.{self._names[c]}"[:MAX_NAME_CHARACTERS]] += int(found.rejected[c].sum())
            if mostly[c]:
                self.counts[f"mostly_rejected.{self._names[c]}"[:MAX_NAME_CHARACTERS]] += 1
