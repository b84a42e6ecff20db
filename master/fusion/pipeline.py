"""One hand from marker cameras, a wrist device and its IMU: not a switch between them but one fit.

`FusedPipeline` is a push machine without clock, socket or thread. Every pose is the marker line's (`master.estimator`),
with one belief more in its fit (`master.fusion.sensed_hand`), of two parts that share the doubt of the wrist's bend:

- the fingers' angles as the wrist device has them, each with its covariance (`finger_track`),
- the palm's turn as the IMU on the forearm has it, through wrist and heading that are learnt while markers tell the
  palm (`forearm`).

A sensor that says nothing adds nothing; there is no state in which one is used and another not. Poses come at the
instants of the cameras. Where these are silent they come at the device's triples: the fingers are seen, and where the
hand is is held, with a doubt that grows.
"""

from collections import Counter
from math import nan
from typing import cast

import msgspec
import numpy as np

from common.arrays import Bool, Code, Float
from common.messages import Detections, HandPose, WristDetections
from common.wrist_bend import STRAIGHT
from master.estimator.epoch import Fitted
from master.estimator.ground import ON_MARKERS
from master.estimator.parameters import HandParameters
from master.estimator.pipeline import MarkerPipeline, SolvedPose, Stage
from master.fusion.finger_track import REACH_NS, FingerTrack
from master.fusion.forearm import Forearm
from master.fusion.sensed_hand import SensedHand
from master.fusion.told_forearm import told_forearm
from master.wrist.fingers import SeenFingers, WristFingers
from master.wrist.setup import WristSetup

_SILENT_FRAMES = 2.2  # of the slowest camera: when so long no instant came, the device's triples lead
_WIDE_BEND = np.radians(15.0) ** 2 * np.eye(2)
_EXPECTED_NS = 100_000_000  # a hand solved so lately tells where fingers are now
_NO_COMMON = np.zeros((3, 2))
_NO_ANGLES, _NO_WORTH = np.full((5, 4), nan), (np.zeros((5, 4, 4)), np.zeros((5, 4, 2)), np.zeros((5, 2, 2)))
_NONE_TOLD, _NO_LEVEL = np.zeros(5, np.bool_), np.zeros(5, np.uint8)


class WristSide:
    """Push machine. Holds what wrist device and IMU of a hand said last, and the angles that were solved last.

    Attributes:
        seen: The last triple.
    """

    def __init__(
        self, wrist: WristFingers, forearm: Forearm | None, parameters: HandParameters, *, continuous: bool
    ) -> None:
        """Join device and forearm; None: the device has no IMU, or it is not known how that is mounted."""
        self._wrist, self.forearm, self._parameters = wrist, forearm, parameters
        self._track, self._continuous = FingerTrack(continuous=continuous), continuous
        self.seen: SeenFingers | None = None
        self._solved: tuple[int, Float] = -(2**62), _NO_ANGLES

    @classmethod
    def of(
        cls, setup: WristSetup, counts: Counter[str], stage: Stage, *, continuous: bool = True
    ) -> "WristSide":
        """The wrist side of a device.

        Raises:
            CalibrationError: Its tables cannot be made, or its IMU's world is not placed in the rig.
        """
        wrist = WristFingers(setup, counts, continuous=continuous, stage=stage)
        forearm = None if setup.imu is None or not setup.imu.placed else Forearm(setup.imu, counts)
        return cls(wrist, forearm, HandParameters.of(setup.model), continuous=continuous)

    def push(self, message: WristDetections) -> SeenFingers | None:
        """Take a triple; None: it is late."""
        bend, _cov = self.bend(message.t_ns)
        last_ns, expected = self._solved
        fresh = self._continuous and abs(message.t_ns - last_ns) <= _EXPECTED_NS
        seen = self._wrist.push(message, bend, expected if fresh else None)
        if seen is not None:
            self._track.push(seen, bend)
            self.seen = seen
        return seen

    def bend(self, t_ns: int) -> tuple[Float, Float]:
        """Bend of the wrist (2,) and its covariance (2, 2)."""
        return (STRAIGHT, _WIDE_BEND) if self.forearm is None else self.forearm.bend_at(t_ns)

    def at(self, t_ns: int) -> SensedHand | None:
        """As `OtherSensors.at`."""
        fingers = self._track.at(t_ns)
        turned = None if self.forearm is None else self.forearm.palm_and_bend_at(t_ns)
        if fingers is None and turned is None:
            return None
        bend, cov = self.bend(t_ns)
        palm, palm_bend = (None, _NO_COMMON) if turned is None else turned
        if fingers is None:
            return SensedHand(_NO_ANGLES, *_NO_WORTH, _NONE_TOLD, _NO_LEVEL, cov, palm, palm_bend)
        worth = fingers.left()
        return SensedHand(
            fingers.angles_rad + fingers.by_bend @ (bend - fingers.bend_rad),
            worth.angles,
            worth.with_bend,
            worth.bend,
            fingers.told,
            fingers.level,
            cov,
            palm,
            palm_bend,
        )

    def solved(self, t_ns: int, hand: Fitted) -> None:
        """As `OtherSensors.solved`: where markers tell how the palm lies, the forearm learns from the epoch."""
        if hand.solution is None:
            return
        self._solved = t_ns, hand.solution.angles_rad
        if self.forearm is not None and hand.rests[5] & ON_MARKERS:
            bend, _cov = self.forearm.bend_at(t_ns)
            sensed = None if hand.sensed is None else cast(SensedHand, hand.sensed.belief)
            self.forearm.saw(t_ns, told_forearm(hand.solution, sensed, bend, self._parameters))


class FusedPipeline:
    """Push machine. Holds the marker line, the wrist side, and when the cameras last made a pose."""

    def __init__(self, markers: MarkerPipeline, side: WristSide, slowest_hz: float) -> None:
        """Join the parts.

        Args:
            markers: The marker line, whose other sensors are `side`; both count into the same.
            side: Wrist device and IMU.
            slowest_hz: Frame rate of the slowest marker camera.
        """
        self.counts, self._markers, self._side = markers.counts, markers, side
        self._silent_ns = round(_SILENT_FRAMES * 1e9 / slowest_hz)
        self._last_ns: int | None = None

    def push(self, message: Detections) -> list[SolvedPose]:
        """Take what one camera saw; return the poses it completes, oldest first."""
        if not isinstance(message, WristDetections):
            poses = self._markers.push(message)
            if poses:
                self._last_ns = poses[-1].pose.t_ns
            return self._told(poses)
        seen = self._side.push(message)
        if seen is None or (self._last_ns is not None and seen.t_ns - self._last_ns <= self._silent_ns):
            return []
        solved = self._markers.blind(seen.t_ns, message.ready_t_ns)
        self.counts["poses_by_wrist"] += 1
        return self._told([] if solved is None else [solved])

    def push_orientation(self, t_ns: int, orientation_wxyz: Float, heading_sigma_rad: float = nan) -> None:
        """Take what the IMU on the forearm says of its own orientation (4,)."""
        if self._side.forearm is None:
            self.counts["orientation.unplaced"] += 1
        else:
            self._side.forearm.push(t_ns, orientation_wxyz, heading_sigma_rad)

    def flush(self) -> list[SolvedPose]:
        """At the end of a recording: the poses that still wait for a camera."""
        return self._told(self._markers.flush())

    def _told(self, poses: list[SolvedPose]) -> list[SolvedPose]:
        """Poses with what else is known of the hand."""
        return [SolvedPose(self._with_wrist(solved.pose), solved.ready_t_ns) for solved in poses]

    def _with_wrist(self, pose: HandPose) -> HandPose:
        side, t_ns = self._side, pose.t_ns
        changes: dict[str, Float | Code | Bool] = {}
        if side.forearm is not None:
            bend, cov = side.forearm.bend_at(t_ns)
            changes["wrist_bend_rad"], changes["wrist_bend_sigma_rad"] = bend, np.sqrt(np.diag(cov))
            changes["palm_world_wxyz"], changes["palm_world_sigma_rad"] = side.forearm.world_at(t_ns)
        seen = side.seen
        if seen is not None and abs(t_ns - seen.t_ns) <= REACH_NS:
            changes["laser_m"], changes["level"] = seen.laser_m, seen.found.level
            changes["ambiguous"] = seen.found.ambiguous
        belief = None if pose.valid.any() else side.at(t_ns)
        if belief is not None:
            changes["angles_rad"] = belief.angles_rad
        return msgspec.structs.replace(pose, **changes)
