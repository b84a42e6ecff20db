"""Pipeline of a wrist device alone: strobe cycles -> rows -> estimator -> pose.

`WristPipeline` is a push machine without clock, socket or thread: live and offline runs push the same messages and get
the same poses. The rig's frame is the camera's, so the palm stands where calibration found it. A finger that was not
seen for half a second is not valid, and NaN: nothing is made up for it.
"""

from collections import Counter
from contextlib import nullcontext
from math import nan

import numpy as np

from common.arrays import Bool, Float
from common.hand.model import CHAINS, FINGERS
from common.kernels import bound
from common.messages import HandPose, Source, WristDetections
from master.estimator.cycle_reader import CycleReader
from master.estimator.epoch import Epoch, Fitted, OrientationMeasurement
from master.estimator.estimator import Estimator
from master.estimator.forearm import NO_WORLD, Forearm
from master.estimator.kinematics import quaternions
from master.estimator.pipeline import SolvedPose, Stage
from master.estimator.settings import DEFAULT, Settings
from master.estimator.wrist_model import WristModel, loosened
from master.monitor.volume import inside
from master.rig.wrist import WristSetup

_ORIENTATION_INFO = np.eye(3) * 1e6  # of a palm that stands: a thousandth of a radian
_PALM = np.setdiff1d(np.arange(26), CHAINS)
_NO_AXES = np.zeros((3, 3))
_NO_POINTS = np.empty((0, 3)), np.empty((0, 3, 3))
_STRAIGHT = np.zeros(2), np.zeros((2, 2))


class WristPipeline:
    """Push machine. Holds the estimator and when each finger was seen last."""

    def __init__(
        self,
        setup: WristSetup,
        *,
        continuous: bool = True,
        stage: Stage = lambda name: nullcontext(),
        settings: Settings = DEFAULT,
    ) -> None:
        """Join the parts.

        Args:
            setup: Device and hand.
            continuous: False: every message is an unrelated pose; no memory but of what is constant.
            stage: Opens a timer by stage name.
            settings: Of the estimator.
        """
        self.counts: Counter[str] = Counter()
        self._setup, self._stage, self._continuous = setup, stage, continuous
        self._model, self._hand = WristModel.of(setup, loose=False), loosened(setup.model)
        self._estimator = Estimator(
            (setup.optics,), self._hand, (), (), continuous=continuous, settings=settings, wrist=self._model
        )
        self._quaternions = bound(quaternions, np.empty((26, 3, 3)), np.empty((26, 4)))
        self._reader = CycleReader(setup, self._model.cubic, self.counts)
        T = setup.T_camera_palm
        self._orientation = OrientationMeasurement(
            np.ascontiguousarray(T[:3, :3]), _ORIENTATION_INFO, sure=True, axes=_NO_AXES
        )
        self._place = np.ascontiguousarray(T[:3, 3])
        self._forearm = None if setup.imu is None else Forearm(setup.imu, self.counts)
        never_ns = -(2**62)
        self._last_ns, self._seen_ns = never_ns, np.full(5, never_ns)
        self._forget_ns = round(1e9 * settings.forget_s)

    def push(self, message: WristDetections) -> list[SolvedPose]:
        """Solve one strobe cycle and return its pose.

        A message that is not later than the last is counted and dropped.
        """
        t_ns = message.t_ns + self._setup.late_ns
        if t_ns <= self._last_ns:
            self.counts["late"] += 1
            return []
        self._last_ns = t_ns
        with self._stage("laser"):
            rows, laser_m = self._reader.read(message, t_ns)
        with self._stage("hand"):
            hand = self._estimator.push(
                Epoch(
                    t_ns,
                    _NO_POINTS[0],
                    np.zeros(3),
                    orientation=self._orientation,
                    wrist=rows,
                    place=self._place,
                )
            )
            pose = self._pose(t_ns, hand, laser_m)
        self.counts["poses"] += 1
        return [SolvedPose(pose, message.ready_t_ns)]

    def push_orientation(self, t_ns: int, orientation_wxyz: Float, heading_sigma_rad: float = nan) -> None:
        """Take the orientation (4,) that the IMU reports of itself.

        It is the orientation of the forearm, and so of the palm, in the IMU's world frame.
        """
        if self._forearm is None:
            self.counts["orientation.unplaced"] += 1
        else:
            self._forearm.push(t_ns, orientation_wxyz, heading_sigma_rad)

    def flush(self) -> list[SolvedPose]:
        """At the end of a recording: nothing waits."""
        return []

    def _pose(self, t_ns: int, hand: Fitted, laser_m: Float) -> HandPose:
        """The message of a hand; fingers that were not seen lately are not valid."""
        model, world = (
            self._hand,
            NO_WORLD if self._forearm is None else self._forearm.world_at(t_ns, *_STRAIGHT),
        )
        measured: Bool = hand.solver_mode > 0
        self._seen_ns[measured] = t_ns
        known: Bool = t_ns - self._seen_ns <= (self._forget_ns if self._continuous else 0)
        for event, fingers in (
            ("tip_refused", hand.refused),
            ("off", hand.off),
            ("ambiguous", hand.ambiguous),
            ("held", known & ~measured),
            ("unseen", ~known),
        ):
            for f, happens in enumerate(fingers.tolist()):
                if happens:
                    self.counts[f"{event}.{FINGERS[f]}"] += 1
        tracked, source, orientation = hand.tracked, hand.source, np.empty((26, 4))
        if hand.solution is None:
            valid, position, angles = np.zeros(26, np.bool_), np.full((26, 3), nan), np.full((5, 4), nan)
            orientation[:], cov = nan, np.full((26, 3, 3), nan)
        else:
            solution, valid = hand.solution, np.ones(26, np.bool_)
            position, cov = solution.joints.position_m, solution.cov_m2
            angles = solution.angles_rad
            self._quaternions(solution.joints.rotation, orientation)
            if not known.all():
                lost = CHAINS[~known].ravel()
                valid[lost], tracked[lost], source[lost] = False, False, Source.NONE
                position[lost], orientation[lost], cov[lost] = nan, nan, nan
                angles[~known] = nan
            tracked[_PALM], source[_PALM] = tracked[CHAINS[measured]].any(), Source.WRIST
        return HandPose.known_good(
            hand=model.profile.name,
            t_ns=t_ns,
            position_m=position,
            orientation_wxyz=orientation,
            radius_m=model.radius_m,
            valid=valid,
            tracked=tracked,
            cov_m2=cov,
            source=source,
            angles_rad=angles,
            markers_m=_NO_POINTS[0],
            markers_raw_m=_NO_POINTS[0],
            markers_cov_m2=_NO_POINTS[1],
            inside_volume=inside(self._setup.volume, position),
            laser_m=laser_m,
            palm_world_wxyz=world[0],
            palm_world_sigma_rad=world[1],
            solver_mode=hand.solver_mode,
            ambiguous=hand.ambiguous,
        )
