"""The marker rig: centroids -> one instant -> the card's line -> its hand, or the estimator's that starts from it.

`MarkerPipeline` is a push machine without clock, socket or thread: live and offline runs push the same messages
and get the same poses. It is built from calibration by `master.rig`.
"""

from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from math import nan
from typing import Protocol

import numpy as np

from common.arrays import Bool, Float
from common.calibration import ImuCalibration, Volume
from common.camera_model import CameraModel
from common.hand_model import HandModel
from common.messages import HandPose, MarkerDetections, restamped
from master.fabrik.blob_bias import LensShift
from master.fabrik.depth import EXACT, CalibrationResidual
from master.fabrik.estimate import HandEstimate, MarkerPositions
from master.fabrik.solver import FabrikSolver
from master.fabrik.sync import FrameSet
from master.fusion.orientation import OrientationTrack
from master.fusion.sensed_hand import SensedHand
from master.ik.hand import HandSolution
from master.ik.hand_one_euro import HandOneEuro
from master.ik.tracker import HandTracker, TrackedHand, pose_of
from master.stereo.caps import CapModel
from master.stereo.drift import DepthDrift
from master.stereo.locate import CapLocator, Located
from master.stereo.place import Placement, ray_covariance
from master.stereo.rivals import RivalChooser
from master.stereo.whereabouts import HandBelief, Past

Stage = Callable[[str], AbstractContextManager[None]]
_HAND_DEPTH_M = 0.06  # a marker seen by one camera lies about as deep as the others, within this
# Where one camera sees all there is, its depth is held: perspective alone lets it drift.
_HELD_DEPTH_M = 0.004
_NAME = 64  # characters of a name in `Health`


class OtherSensors(Protocol):
    """What watches the same hand beside the cameras: a wrist device and its IMU (`master.fusion`)."""

    def at(self, t_ns: int) -> SensedHand | None:
        """What they say of the hand at an instant; None: nothing."""
        ...

    def solved(self, t_ns: int, hand: TrackedHand, told: SensedHand | None) -> None:
        """Learn from the hand as it was solved, with that among what it was solved from."""
        ...


@dataclass(frozen=True, slots=True)
class SolvedPose:
    """A pose, and when the last frame that contributed to it was handed to its slave [ns]."""

    pose: HandPose
    ready_t_ns: int


class MarkerPipeline:
    """Push machine. Holds line, tracker and filter, each with its own state."""

    def __init__(
        self,
        cameras: dict[str, CameraModel],
        model: HandModel,
        markers: tuple[str, ...],
        *,
        line: FabrikSolver,
        residual: CalibrationResidual = EXACT,
        tracker: HandTracker | None,
        steady: HandOneEuro | None = None,
        stamp_offset_us: Mapping[str, float] | None = None,
        volume: Volume | None = None,
        imu: ImuCalibration | None = None,
        others: OtherSensors | None = None,
        counts: Counter[str] | None = None,
        stage: Stage = lambda name: nullcontext(),
        shed: Callable[[], bool] = lambda: False,
    ) -> None:
        """Join the parts.

        Args:
            cameras: In the rig's order.
            model: The hand.
            markers: Names in the order of every marker array.
            line: Brings the cameras to one instant, and solves it first.
            residual: What the calibration is known to leave.
            tracker: Refines the hand from its own markers, some or all of these; None: the line's hand is published.
            steady: Filters the refined hand; None: frames are unrelated, nothing is filtered.
            stamp_offset_us: Camera -> how much later its frames really are than their stamps; added to them.
            volume: What the rig states, or None; joints say whether they lie in it.
            imu: On the palm; its orientation is used where the rig says how it is mounted and how its world lies.
            others: What else watches the hand; None: nothing does.
            counts: Counted into; None: counts of its own.
            stage: Opens a timer by stage name.
            shed: Asked for each instant whether it is left out, for newer ones wait (`master.hurry`).
        """
        self.model, self.markers = model, markers
        self.counts: Counter[str] = Counter() if counts is None else counts
        self._names, self._cameras = tuple(cameras), tuple(cameras.values())
        self._line, self._tracker, self._steady = line, tracker, steady
        self._lens_shift = LensShift(self._cameras)
        self._place = Placement(self._cameras, residual)
        self._choose = RivalChooser(self._cameras, self._place)
        self._on_hand = line.on_hand
        self._hand_markers = tuple(markers[int(m)] for m in self._on_hand)
        self._past, self._believe = Past(len(markers)), HandBelief(model, markers, self._on_hand)
        self._caps = CapModel(model, markers)
        self._located = CapLocator(self._cameras, self._caps, self._place)
        self._drift = DepthDrift()
        self._stage, self._volume, self._shed = stage, volume, shed
        self._orientation = None if imu is None or not imu.placed else OrientationTrack(imu, self.counts)
        self._others = others
        self._last_ns = -(2**63)
        self._late_ns = {name: round(1e3 * us) for name, us in (stamp_offset_us or {}).items()}
        self._centres = np.array([camera.centre for camera in self._cameras])
        self._focal_px = np.array([camera.matrix[0, 0] for camera in self._cameras])

    def push(self, message: MarkerDetections) -> list[SolvedPose]:
        """Take one camera's detections; return the poses they complete, oldest first."""
        if late_ns := self._late_ns.get(message.camera):
            message = restamped(message, t_ns=message.t_ns + late_ns)
        with self._stage("pairing"):
            instants = self._line.sync.push(message)
        if self._line.sync.outdated:
            self.counts["instants_outdated"] = self._line.sync.outdated
        return self._solved(instants)

    def blind(self, t_ns: int, ready_t_ns: int) -> SolvedPose | None:
        """The pose at an instant at which no camera saw anything, by what else watches the hand; None: it is past."""
        shape = (len(self._cameras), len(self.markers))
        unseen = np.full(shape, np.nan)
        nothing = np.full((*shape, 2), np.nan)
        instant = FrameSet(t_ns, nothing, unseen, unseen, ready_t_ns, np.ones(len(self._cameras), np.bool_))
        poses = self._solved([instant])
        return poses[0] if poses else None

    def push_orientation(self, t_ns: int, orientation_wxyz: Float, heading_sigma_rad: float = nan) -> None:
        """Take what the IMU says of its own orientation (4,), for the instants about `t_ns`."""
        if self._orientation is None:
            self.counts["orientation.unplaced"] += 1
        else:
            self._orientation.push(t_ns, orientation_wxyz, heading_sigma_rad)

    def flush(self) -> list[SolvedPose]:
        """At the end of a recording: the poses that still wait for a camera."""
        return self._solved(self._line.sync.flush())

    def _solved(self, instants: list[FrameSet]) -> list[SolvedPose]:
        """Poses of instants later than the last one; others are counted: cameras came back with old frames."""
        poses: list[SolvedPose] = []
        for instant in instants:
            if instant.t_ns <= self._last_ns:
                self.counts["instants_late"] += 1
                continue
            self._last_ns = instant.t_ns
            if self._shed():
                self.counts["instants_shed"] += 1
                continue
            poses.append(self._solve(instant))
        return poses

    def _solve(self, instant: FrameSet) -> SolvedPose:
        last, age_s = (None, 0.0) if self._tracker is None else self._tracker.recent(instant.t_ns)
        with self._stage("triangulate"):
            if self._lens_shift.any:
                instant = replace(instant, uv=self._lens_shift.centres(instant.uv, instant.area))
            instant = self._without_rivals(instant)
        line = self._line.solve(instant, last, age_s)
        hand: HandEstimate | TrackedHand = line
        markers = found = line.markers
        if self._tracker is not None:
            found = self._located_of(instant, line, last, age_s)
            hand = self._refined(self._tracker, instant, line, found, last, age_s)
        self._count_odd(found, instant)
        pose = pose_of(
            hand, self.model, instant.t_ns, line.smooth_m, markers.points_m, markers.cov_m2, self._volume
        )
        if self._line.continuous:
            self._past.saw(instant.t_ns, markers.points_m)
        self.counts["poses"] += 1
        self.counts["outside_volume"] += int(not pose.inside_volume[pose.valid].all())
        self.counts["instants_with_missing_camera"] += int(instant.missing.any())
        return SolvedPose(pose, instant.ready_t_ns)

    def _located_of(
        self, instant: FrameSet, line: HandEstimate, last: HandSolution | None, age_s: float
    ) -> Located:
        """The markers by the rays of all cameras: the line's own, unless that goes by a law of disparity."""
        if isinstance(line.markers, Located):
            return line.markers
        with self._stage("triangulate"):
            near = last or line.solution
            return self._located(
                instant.uv, instant.sigma_px, instant.area, near, age_s, as_seen=near is None
            )

    def _refined(
        self,
        tracker: HandTracker,
        instant: FrameSet,
        line: HandEstimate,
        found: Located,
        last: HandSolution | None,
        age_s: float,
    ) -> TrackedHand:
        """The hand that explains the pixels of one instant best, from the line's hand or the last one `age_s` ago."""
        with self._stage("hand"):
            # The covariances are those of the points before the filter, which do not lag: the fit takes these.
            points, cov = found.points_m, found.cov_m2
            aims = self._with_rays(instant, points, cov + found.repeated, last, age_s)
            measured = np.isfinite(points[self._on_hand, 0])
            turned = (
                None
                if self._orientation is None
                else self._orientation.at(instant.t_ns, last or line.solution)
            )
            told = None if self._others is None else self._others.at(instant.t_ns)
            hand = tracker.push(
                instant.t_ns,
                *aims,
                line.facing,
                measured,
                turned,
                told,
                line.solution if line.solved else None,
            )
            if self._others is not None:
                self._others.solved(instant.t_ns, hand, told)
            if self._steady is not None:
                hand = self._steady.push(
                    instant.t_ns, hand, found.noise_m2[self._on_hand], points[self._on_hand]
                )
            on_hand = np.isfinite(instant.uv[:, self._on_hand, 0])
            return self._drift.push(
                instant.t_ns,
                hand,
                placed=bool(measured.any()),
                seen=bool(on_hand.any()),
                sight=self._sight(hand, on_hand),
            )

    def _without_rivals(self, instant: FrameSet) -> FrameSet:
        """The instant with one place for each marker; the usual one has no rival and is passed on."""
        if instant.rival_uv is None or instant.rival_sigma_px is None:
            return instant
        in_doubt = np.isfinite(instant.rival_uv[..., 0]).any(axis=0)
        if not in_doubt.any():  # a rival was named in a frame nearby, and is not carried to this instant
            return replace(instant, rival_uv=None)
        first = self._place(instant.uv, instant.sigma_px)
        clear = np.where((in_doubt | first.apart(instant.uv))[:, None], np.nan, first.points)
        others = self._line.solve_once(clear, first.cov, instant.area)
        chosen = self._choose(
            instant.uv,
            instant.sigma_px,
            instant.rival_uv,
            instant.rival_sigma_px,
            self._believe(others, clear),
            self._past.at(instant.t_ns),
        )
        self._count("rival", chosen.taken)
        self._count("unclear", chosen.dropped)
        # The area is that of the first place.
        area = np.where(chosen.uv[..., 0] == instant.uv[..., 0], instant.area, np.nan)
        return replace(instant, uv=chosen.uv, sigma_px=chosen.sigma_px, area=area, rival_uv=None)

    def _count(self, event: str, markers: Bool) -> None:
        """Count an event of each of the markers (M,) by name."""
        for m in np.flatnonzero(markers):
            self.counts[f"{event}.{self.markers[m]}"[:_NAME]] += 1

    def _count_odd(self, found: MarkerPositions, instant: FrameSet) -> None:
        """Count markers whose rays do not meet, and cameras that were left out."""
        self._count("apart", found.apart)
        self.counts["epipolar_misfits"] += int(found.apart.sum())
        if found.left_out.any():
            self._count_left_out(found, instant)

    def _count_left_out(self, found: MarkerPositions, instant: FrameSet) -> None:
        """Count what was left out of each camera, and instants at which that is most of what it sees."""
        sees = np.isfinite(instant.uv[..., 0]) & np.isfinite(found.points_m[:, 0])
        mostly = found.left_out.sum(axis=1) > 0.5 * sees.sum(axis=1)
        for c in np.flatnonzero(found.left_out.any(axis=1)):
            self.counts[f"left_out.{self._names[c]}"[:_NAME]] += int(found.left_out[c].sum())
            if mostly[c]:
                self.counts[f"mostly_left_out.{self._names[c]}"[:_NAME]] += 1

    def _with_rays(
        self, instant: FrameSet, points: Float, cov: Float, last: HandSolution | None, age_s: float
    ) -> tuple[Float, Float]:
        """Points and covariances of the hand's markers, with those added that only one camera sees.

        Such a marker is somewhere on its ray. It is put there as far away as it was on the last hand, or as the
        other markers are, with a covariance as long as a hand along the ray and as thin as a centroid across:
        the fit takes the two numbers that were measured and no more. So tracking goes on while a camera is gone.
        """
        seen = np.isfinite(instant.uv[..., 0])
        lone = self._on_hand[(seen.sum(axis=0) == 1)[self._on_hand] & np.isnan(points[self._on_hand, 0])]
        found = points[self._on_hand]
        found = found[np.isfinite(found[:, 0])]
        if not len(lone) or (last is None and not len(found)):
            return points[self._on_hand], cov[self._on_hand]
        points, cov = points.copy(), cov.copy()
        near = np.broadcast_to(found.mean(axis=0), points.shape) if last is None else self._caps_of(last)
        view = np.argmax(seen[:, lone], axis=0)
        uv = instant.uv[view, lone]
        self._place.put(points, lone, view, uv, near)
        look = self._located.look(points, last, age_s)
        doubt = self._caps.doubt_px(instant.area, points, self._cameras, look.whole_m2)
        bias = look.bias_px[:, view, lone]
        self._place.put(points, lone, view, uv - bias[0], near)
        sight = points[lone] - self._centres[view]
        tilt_px2 = ((bias[1:] - bias[0]) ** 2).mean(axis=(0, 2))
        across = np.sqrt(instant.sigma_px[view, lone] ** 2 + doubt[view, lone] ** 2 + tilt_px2)
        across /= self._focal_px[view]
        across = across * np.linalg.norm(sight, axis=1)
        depth_m = _HAND_DEPTH_M if len(found) else _HELD_DEPTH_M
        cov[lone] = ray_covariance(sight, across, np.full(len(lone), depth_m))
        return points[self._on_hand], cov[self._on_hand]

    def _sight(self, hand: TrackedHand, on_hand: Bool) -> Float:
        """Unit vector (3,) from the camera that sees most of the hand's markers (C, M) to the hand."""
        centre = self._centres[int(on_hand.sum(axis=1).argmax())]
        if hand.solution is None:
            return np.array([0.0, 0.0, 1.0])
        sight = hand.solution.T_rig_palm[:3, 3] - centre
        return sight / np.linalg.norm(sight)

    def _caps_of(self, hand: HandSolution) -> Float:
        """Where a hand has its markers (M, 3) [m]; NaN: those on no hand."""
        points = np.full((len(self.markers), 3), np.nan)
        points[self._on_hand] = self.model.marker_points(hand.joints, self._hand_markers)
        return points
