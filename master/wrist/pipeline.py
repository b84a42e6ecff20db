"""The wrist device's straight line: detections -> laser points on their plane, fingertips -> angles -> pose.

`WristPipeline` is a push machine without clock, socket or thread: live and offline runs push the same messages and get
the same poses. What is seen of the fingers is said by `master.wrist.fingers`; tracked is what that is told. A finger
that it says nothing of is

- **held**: not seen for less than half a second, where frames follow each other: the last angles, their doubt growing
  as that of a hidden finger of the marker rig.
- **none**: not valid, NaN. Nothing is made up for it.
"""

from collections import Counter
from contextlib import nullcontext
from dataclasses import replace
from math import nan

import numpy as np

from common.arrays import Bool, Code, Float
from common.messages import Source, WristDetections
from master.estimator.pipeline import SolvedPose, Stage
from master.estimator.settings import DEFAULT
from master.wrist.belief import FingerAngles
from master.wrist.fingers import FORGET_S, NEVER_NS, WristFingers, count
from master.wrist.inverse import InverseModel
from master.wrist.invert import Inverse
from master.wrist.palm_world import NO_WORLD, PalmWorld
from master.wrist.pose import PoseMaker
from master.wrist.setup import WristSetup


class WristPipeline:
    """Push machine. Holds of each finger the last angles and when it was seen."""

    def __init__(
        self,
        setup: WristSetup,
        *,
        continuous: bool = True,
        stage: Stage = lambda name: nullcontext(),
        inverse: Inverse | None = None,
        model: InverseModel | None = None,
    ) -> None:
        """Join the parts.

        Args:
            setup: Device and hand.
            continuous: False: every message is an unrelated pose; no filter, no memory.
            stage: Opens a timer by stage name.
            inverse: The table of this device and hand; None: a new one, which takes a second or two.
            model: The inverse model of the same, for levels above "fk"; None: a new one, which takes a second.
        """
        self.counts: Counter[str] = Counter()
        self._stage, self._continuous = stage, continuous
        self.fingers = WristFingers(
            setup, self.counts, continuous=continuous, stage=stage, inverse=inverse, model=model
        )
        self._pose = PoseMaker(setup)
        self._palm_world = None if setup.imu is None else PalmWorld(setup.imu, self.counts)
        self._angles, self._cov = np.full((5, 4), np.nan), np.full((5, 4, 4), np.nan)
        self._seen_ns = np.full(5, NEVER_NS)

    def push(self, message: WristDetections) -> list[SolvedPose]:
        """Take what one triple showed; return its pose. A message not later than the last is counted and dropped."""
        seen = self.fingers.push(message)
        if seen is None:
            return []
        with self._stage("hand"):
            shown, source = self._remembered(seen.t_ns, seen.found)
            world = NO_WORLD if self._palm_world is None else self._palm_world.at(seen.t_ns)
            pose = self._pose(seen.t_ns, shown, source, seen.laser_m, world)
        count(self.counts, "held", source == Source.HELD)
        count(self.counts, "unseen", source == Source.NONE)
        self.counts["poses"] += 1
        return [SolvedPose(pose, message.ready_t_ns)]

    def push_orientation(self, t_ns: int, orientation_wxyz: Float, heading_sigma_rad: float = nan) -> None:
        """Take what the IMU says of its own orientation (4,): that of the forearm, and so of the palm, in its world."""
        if self._palm_world is None:
            self.counts["orientation.unplaced"] += 1
        else:
            self._palm_world.push(t_ns, orientation_wxyz, heading_sigma_rad)

    def flush(self) -> list[SolvedPose]:
        """At the end of a recording: nothing waits."""
        return []

    def _remembered(self, t_ns: int, found: FingerAngles) -> tuple[FingerAngles, Code]:
        """The fingers with those that were seen a moment ago, and their sources (5,)."""
        seen = np.isfinite(found.angles_rad[:, 0])
        source: Code = np.where(seen, np.uint8(Source.WRIST), np.uint8(Source.NONE))
        if not self._continuous or seen.all():
            self._remember(t_ns, found, seen)
            return found, source
        gone_s = 1e-9 * (t_ns - self._seen_ns)
        held = ~seen & (gone_s <= FORGET_S)
        source[held] = Source.HELD
        angles, cov = found.angles_rad.copy(), found.cov_rad2.copy()
        angles[held] = self._angles[held]
        cov[held] = self._cov[held] + _strayed_rad2(gone_s[held])[:, None, None] * np.eye(4)
        self._remember(t_ns, found, seen)
        return replace(found, angles_rad=angles, cov_rad2=cov), source

    def _remember(self, t_ns: int, found: FingerAngles, seen: Bool) -> None:
        self._angles[seen], self._cov[seen], self._seen_ns[seen] = (
            found.angles_rad[seen],
            found.cov_rad2[seen],
            t_ns,
        )


def _strayed_rad2(gone_s: Float) -> Float:
    """Variances [rad^2] of angles a time after the finger was last seen (`master.estimator.state`)."""
    return DEFAULT.stray_rad**2 * (1.0 - np.exp(-np.square(gone_s / DEFAULT.stray_s)))
