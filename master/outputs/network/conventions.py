"""Other programs name sides and clocks by these conventions.

Messages of a master are stamped with its monotonic clock: on one machine our own, else offset as the echoes
of its reports give (`common.link.clock_offset`). A recording that is played has the times of its making,
which other programs would take for long ago: its messages are stamped as they are played. OSC and ROS 2 want
the wall clock, which may be set at any time; it is asked here (for the moment of sending also in `ros2`), and
never for a duration.
"""

import time
from collections.abc import Callable
from math import isfinite
from typing import Literal

from common.clock import now_ns
from common.hand.model import JOINTS, WRIST
from common.link.clock_offset import OffsetEstimator
from common.messages import HandPose

Side = Literal["left", "right"]
_THUMB, _LITTLE = JOINTS.index("thumb-metacarpal"), JOINTS.index("pinky-finger-phalanx-proximal")


def side_of(pose: HandPose) -> Side | None:
    """Which hand it is; None where wrist, thumb or little finger are not known.

    The wrist's x axis points from a right hand's thumb to its little finger, and from a left hand's little finger to
    its thumb: y is dorsal and -z goes to the fingers on both.
    """
    ax, ay, az = (pose.position_m[_LITTLE] - pose.position_m[_THUMB]).tolist()
    w, x, y, z = pose.orientation_wxyz[WRIST].tolist()
    # The first column of the quaternion's matrix: numbers, as arrays this small would cost ten times as much.
    along = ax * (1.0 - 2.0 * (y * y + z * z)) + 2.0 * ay * (x * y + w * z) + 2.0 * az * (x * z - w * y)
    if not isfinite(along):
        return None
    return "right" if along > 0.0 else "left"


class MasterTimes:
    """Master's and wall clock against ours; pushed by one thread, read by any."""

    def __init__(
        self, monotonic_ns: Callable[[], int] = now_ns, wall_clock_ns: Callable[[], int] = time.time_ns
    ) -> None:
        self._echoes = OffsetEstimator()
        self._now_ns = monotonic_ns
        self._wall_ns = wall_clock_ns
        self._wall = self._compared()
        self._played_ns = 0

    def push(self, asked_ns: int, master_ns: int, answered_ns: int) -> None:
        """Take an echo: our clock at question and answer, the master's between [ns]."""
        self._echoes.push(asked_ns, master_ns, master_ns, answered_ns)

    @property
    def offset_ns(self) -> int:
        """The master's clock minus ours [ns]; 0 where both may be one machine."""
        estimate = self._echoes.estimate()
        if estimate is None or abs(estimate.offset_ns) <= estimate.bound_ns:
            return 0
        return estimate.offset_ns

    def local_ns(self, t_ns: int) -> int:
        """The monotonic time of this machine [ns] at the master's time `t_ns`."""
        estimate = self._echoes.estimate()
        if estimate is not None and abs(estimate.offset_ns) > estimate.bound_ns:
            t_ns = estimate.to_local(t_ns)
        now = self._now_ns()
        # of a live message against now; beyond it is a recording's
        ahead_ns, late_ns = 200_000_000, 5_000_000_000
        if -ahead_ns <= now - t_ns <= late_ns:
            return t_ns
        if not -ahead_ns <= now - (t_ns + self._played_ns) <= late_ns:
            self._played_ns = now - t_ns
        return t_ns + self._played_ns

    def wall_ns(self, t_ns: int) -> int:
        """Nanoseconds since 1970 (UTC, this machine's clock) at the master's time."""
        # so often the wall clock is asked: it is set now and then, and slewed by its time service
        if abs(self._now_ns() - self._wall[0]) > 1_000_000_000:
            self._wall = self._compared()
        return self.local_ns(t_ns) + self._wall[1]

    def _compared(self) -> tuple[int, int]:
        """Our clock [ns], and by how much the wall clock is ahead of it then."""
        before, wall, after = self._now_ns(), self._wall_ns(), self._now_ns()
        middle = (before + after) // 2
        return middle, wall - middle
