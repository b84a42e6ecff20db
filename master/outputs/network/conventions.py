"""Other programs name sides and clocks by these conventions.

Left or right side of a hand, as other programs name it.

A pose determines it by its shape, so no hand file is needed.

Conversion of times to the clocks that other programs use.

The master's time on this machine's clock, and on the wall's.

Messages of a master are stamped with its monotonic clock. Beside it, on one machine, that is our own; on another
machine it is offset, which the echoes of its reports give (`common.link.clock_offset`). A recording that is
played has the
times of its making, which other programs would take for long ago, or for a time to come and wait for it: its messages
are stamped as they are played, and keep their distances where it is played as fast as it was made.

OSC and ROS 2 want the wall clock, which may be set at any time; it is asked here (for the moment of sending also in
`ros2_link`), and never for a duration.
"""

import time
from collections.abc import Callable
from math import isfinite
from typing import Literal, Protocol

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


class Times(Protocol):
    """Turns the time of a message into that of another clock."""

    def local_ns(self, t_ns: int) -> int:
        """The monotonic time of this machine [ns] at the master's time `t_ns`."""
        ...

    def wall_ns(self, t_ns: int) -> int:
        """Return nanoseconds since 1970 at the master's time `t_ns`.

        UTC, by this machine's clock.
        """
        ...


class MasterTimes:
    """Estimates of the master's clock and the wall clock against ours.

    Holds how the master's clock runs against ours, as its echoes measure, how the wall clock does, and by how much
    the times of a recording that is played are shifted.

    Echoes come from one thread, times are asked for on any.
    """

    def __init__(
        self, monotonic_ns: Callable[[], int] = now_ns, wall_clock_ns: Callable[[], int] = time.time_ns
    ) -> None:
        self._echoes = OffsetEstimator()
        self._now_ns = monotonic_ns
        self._wall_ns = wall_clock_ns
        self._wall = self._compared()
        self._played_ns = 0

    def push(self, asked_ns: int, master_ns: int, answered_ns: int) -> None:
        """Take an echo of the master's clock.

        Our clock when the master was asked and when its answer came, its clock in between [ns].
        """
        self._echoes.push(asked_ns, master_ns, master_ns, answered_ns)

    @property
    def offset_ns(self) -> int:
        """Return the master's clock minus ours [ns].

        0 where no echo contradicts that both are one machine.
        """
        estimate = self._echoes.estimate()
        if estimate is None or abs(estimate.offset_ns) <= estimate.bound_ns:
            return 0
        return estimate.offset_ns

    def local_ns(self, t_ns: int) -> int:
        """This machine's monotonic time [ns] (see `Times`)."""
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
        """Nanoseconds since 1970 (see `Times`)."""
        # so often the wall clock is asked: it is set now and then, and slewed by its time service
        if abs(self._now_ns() - self._wall[0]) > 1_000_000_000:
            self._wall = self._compared()
        return self.local_ns(t_ns) + self._wall[1]

    def _compared(self) -> tuple[int, int]:
        """Our clock [ns], and by how much the wall clock is ahead of it then."""
        before, wall, after = self._now_ns(), self._wall_ns(), self._now_ns()
        middle = (before + after) // 2
        return middle, wall - middle
