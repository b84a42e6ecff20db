"""One hand from marker cameras, a wrist device and its IMU: rows of one fit.

`FusedPipeline` is push-driven, without clock, socket or thread. An epoch of the cameras uses rows of the strobe cycle
before it, if there is a new one, and how the IMU has the forearm turned; where the cameras are silent, epochs are those
of the strobe cycles. A silent sensor adds no row: there is no state in which one is used and another not.
"""

from collections import Counter, deque
from math import nan

import msgspec
import numpy as np

from common.arrays import Bool, Code, Float
from common.hand.model import FINGERS
from common.messages import Detections, HandPose, WristDetections
from master.estimator.cycle_reader import CycleReader
from master.estimator.epoch import Fitted, OrientationMeasurement, WristRows
from master.estimator.estimator import Estimator
from master.estimator.forearm import LOST_RAD, Forearm
from master.estimator.observation_sources import ON_MARKERS
from master.estimator.pipeline import MarkerPipeline, SolvedPose
from master.estimator.wrist_device import HEADING, WRIST_ANGLES
from master.rig.wrist import WristSetup

_MAX_AGE_NS = 70_000_000  # an older strobe cycle constrains no finger now


class WristSide:
    """Push machine that holds the wrist device's pending strobe cycles.

    They wait for an epoch; it also holds the last strobe cycle and the samples of the IMU.

    Attributes:
        forearm: Of the IMU; None: there is none, or it is not known how it is mounted or placed.
    """

    def __init__(
        self, setup: WristSetup, reader: CycleReader, counts: Counter[str], *, continuous: bool
    ) -> None:
        """Join the parts.

        Args:
            setup: Device and hand.
            reader: Makes rows of strobe cycles.
            counts: Counted into, by event and finger: `late`, `outside`, `no_plane`, `tip_refused`, `off`, `ambiguous`;
                and as of `Forearm`.
            continuous: False: every message is an unrelated pose.
        """
        self.counts, self._setup, self._continuous = counts, setup, continuous
        forearm = None if setup.imu is None else Forearm(setup.imu, counts)
        self.forearm = forearm if forearm is not None and forearm.placed else None
        self.reader = reader
        kept = 8
        self._waiting: deque[WristDetections] = deque(maxlen=kept)
        self._last_ns = -(2**62)
        self.laser_m, self.laser_ns = np.full((5, 3), nan), -(2**62)
        self.solver_mode, self.ambiguous = np.zeros(5, np.uint8), np.zeros(5, np.bool_)

    def push(self, message: WristDetections) -> int | None:
        """Take a strobe cycle and return its time.

        None: it is not later than the last.
        """
        t_ns = message.t_ns + self._setup.late_ns
        if t_ns <= self._last_ns:
            self.counts["late"] += 1
            return None
        self._last_ns = t_ns
        self._waiting.append(message)
        return t_ns

    def rows_at(self, t_ns: int) -> WristRows | None:
        """Return the rows of the newest unused strobe cycle, for an epoch at `t_ns`.

        None: there is no fresh one.
        """
        late_ns, message = self._setup.late_ns, None
        if not self._continuous:
            near = min(self._waiting, key=lambda one: abs(one.t_ns + late_ns - t_ns), default=None)
            own_ns = 17_000_000  # half the period of the strobe cycles: of epochs that are unrelated
            message = near if near is not None and abs(near.t_ns + late_ns - t_ns) <= own_ns else None
        else:
            while self._waiting and self._waiting[0].t_ns + late_ns <= t_ns:
                message = self._waiting.popleft()
            if message is not None and t_ns - message.t_ns - late_ns > _MAX_AGE_NS:
                message = None
        if message is None:
            return None
        rows, self.laser_m = self.reader.read(message, t_ns)
        self.laser_ns = message.t_ns + late_ns
        return rows

    def orientation_at(self, t_ns: int, estimator: Estimator) -> OrientationMeasurement | None:
        """Return the palm orientation by the IMU at an epoch.

        None: the IMU does not report it, or its heading may be any.
        """
        if self.forearm is None:
            return None
        if self.forearm.lost:
            self.forearm.lost = False
            estimator.forget_heading()
        orientation = self.forearm.orientation_at(t_ns, estimator.extras, estimator.extras_cov)
        unknown = estimator.extras_cov[HEADING, HEADING] > LOST_RAD**2
        return None if unknown else orientation

    def solved(self, t_ns: int, hand: Fitted, estimator: Estimator, *, oriented: bool) -> None:
        """Learn from an epoch that was solved.

        Args:
            t_ns: The epoch.
            hand: As it was solved.
            estimator: What solved it.
            oriented: Whether it had a TURN row to begin with.
        """
        if hand.solver_mode.any():
            self.solver_mode, self.ambiguous = hand.solver_mode, hand.ambiguous
        self._count("tip_refused", hand.refused)
        self._count("off", hand.off)
        self._count("ambiguous", hand.ambiguous)
        if self.forearm is None or hand.solution is None or not hand.sources[5] & ON_MARKERS:
            return
        if oriented and self.forearm.contradicted(t_ns, by_palm=hand.rotation_rejected):
            estimator.forget_heading()
            oriented = False
        if oriented:
            return
        heading = self.forearm.heading_of(t_ns, hand.solution.T_rig_palm[:3, :3], estimator.extras)
        if heading is not None:
            self.counts["forearm.begun"] += 1
            wrist_angles = estimator.extras_cov[
                WRIST_ANGLES : WRIST_ANGLES + 2, WRIST_ANGLES : WRIST_ANGLES + 2
            ]
            estimator.begin_heading(
                heading, float(np.trace(wrist_angles) + np.trace(hand.solution.measurement_cov[:3, :3]))
            )

    def completed(self, pose: HandPose, estimator: Estimator) -> HandPose:
        """The pose with what else is known of the hand."""
        changes: dict[str, Float | Code | Bool] = {}
        if self.forearm is not None:
            wrist_angles, cov = (
                estimator.extras[WRIST_ANGLES : WRIST_ANGLES + 2].copy(),
                estimator.extras_cov[WRIST_ANGLES : WRIST_ANGLES + 2, WRIST_ANGLES : WRIST_ANGLES + 2],
            )
            changes["wrist_angles_rad"], changes["wrist_angles_sigma_rad"] = (
                wrist_angles,
                np.sqrt(np.diag(cov)),
            )
            world = self.forearm.world_at(pose.t_ns, wrist_angles, cov)
            changes["palm_world_wxyz"], changes["palm_world_sigma_rad"] = world
        if abs(pose.t_ns - self.laser_ns) <= _MAX_AGE_NS:
            changes["laser_m"], changes["solver_mode"], changes["ambiguous"] = (
                self.laser_m,
                self.solver_mode,
                self.ambiguous,
            )
        return msgspec.structs.replace(pose, **changes)

    def _count(self, event: str, fingers: Bool) -> None:
        for f, happens in enumerate(fingers.tolist()):
            if happens:
                self.counts[f"{event}.{FINGERS[f]}"] += 1


class FusedPipeline:
    """Push machine that joins the marker line and its wrist side.

    It holds the marker line, whose wrist side it feeds, and when the cameras last made a pose.
    """

    def __init__(self, markers: MarkerPipeline, side: WristSide, slowest_hz: float) -> None:
        """Join the parts.

        Args:
            markers: The marker line with that wrist side; both count into the same.
            side: Wrist device and IMU.
            slowest_hz: Frame rate of the slowest marker camera.
        """
        self.counts, self._markers, self._side = markers.counts, markers, side
        # of the slowest camera: when so long no epoch came, the device's strobe cycles lead
        silent_frames = 2.2
        self._silent_ns = round(silent_frames * 1e9 / slowest_hz)
        self._last_ns: int | None = None

    def push(self, message: Detections) -> list[SolvedPose]:
        """Take what one camera saw; return the poses it completes, oldest first."""
        if not isinstance(message, WristDetections):
            poses = self._markers.push(message)
            if poses:
                self._last_ns = poses[-1].pose.t_ns
            return poses
        t_ns = self._side.push(message)
        if t_ns is None or (self._last_ns is not None and t_ns - self._last_ns <= self._silent_ns):
            return []
        solved = self._markers.no_observation(t_ns, message.ready_t_ns)
        self.counts["poses_by_wrist"] += 1
        return [] if solved is None else [solved]

    def push_orientation(self, t_ns: int, orientation_wxyz: Float, heading_sigma_rad: float = nan) -> None:
        """Take the orientation (4,) that the IMU on the forearm reports."""
        if self._side.forearm is None:
            self.counts["orientation.unplaced"] += 1
        else:
            self._side.forearm.push(t_ns, orientation_wxyz, heading_sigma_rad)

    def flush(self) -> list[SolvedPose]:
        """At the end of a recording: the poses that still wait for a camera."""
        return self._markers.flush()
