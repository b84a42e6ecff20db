"""The quaternions of one IMU between its samples: the shorter arc, gaps, what is no rotation, clocks set back."""

from collections import Counter, deque
from dataclasses import dataclass

import numpy as np

from common.arrays import Float
from common.calibration import UNIT_WITHIN

REACH_NS = 50_000_000  # farther from an instant a sample tells nothing of it
_KEPT = 512  # half a second of the fastest sensors; instants lie at most two camera periods behind
_STRAIGHT = 1e-9  # sine of an angle below which an arc is a straight line


@dataclass(frozen=True, slots=True, eq=False)
class _Sample:
    t_ns: int
    q_wxyz: Float


class OrientationSamples:
    """Push machine. Holds the newest samples, and when the first came.

    Attributes:
        counts: Samples left out: `orientation.missing`, `orientation.not_unit`, `orientation.late`.
    """

    def __init__(self, counts: Counter[str]) -> None:
        """Begin without any, counting into `counts`."""
        self.counts = counts
        self._samples: deque[_Sample] = deque(maxlen=_KEPT)
        self._first_ns: int | None = None

    def __len__(self) -> int:
        """How many it holds."""
        return len(self._samples)

    def push(self, t_ns: int, orientation_wxyz: Float) -> None:
        """Take one sample: quaternion (4,), IMU axes -> its world, q as good as -q.

        What is no rotation is left out. A sample long before the newest means that a clock was set back, or that the
        newest came from a time that is not yet: the others are forgotten.
        """
        length = float(np.linalg.norm(orientation_wxyz))
        if np.isnan(length):
            self.counts["orientation.missing"] += 1
        elif abs(length - 1.0) > UNIT_WITHIN:
            self.counts["orientation.not_unit"] += 1
        else:
            if self._samples and t_ns <= (newest_ns := self._samples[-1].t_ns):
                if newest_ns - t_ns <= REACH_NS:
                    self.counts["orientation.late"] += 1
                    return
                self._samples.clear()
            self._first_ns = t_ns if self._first_ns is None else min(self._first_ns, t_ns)
            self._samples.append(_Sample(t_ns, orientation_wxyz / length))

    def heard_s(self, t_ns: int) -> float | None:
        """How long before an instant the first sample was [s], at least 0; None: there was none."""
        return None if self._first_ns is None else 1e-9 * max(t_ns - self._first_ns, 0)

    def between(self, t_ns: int) -> tuple[Float, float] | None:
        """Quaternion (4,) at an instant, and how far from samples that is [s]; None: too far.

        The times to both sides count as resistors in parallel do: with one side alone it is the time to that.
        """
        before: _Sample | None = None
        after: _Sample | None = None
        for sample in reversed(self._samples):
            if sample.t_ns <= t_ns:
                before = sample
                break
            after = sample
        if before is not None and t_ns - before.t_ns > REACH_NS:
            before = None
        if after is not None and after.t_ns - t_ns > REACH_NS:
            after = None
        if before is not None and after is not None:
            a, b = t_ns - before.t_ns, after.t_ns - t_ns
            return slerp(before.q_wxyz, after.q_wxyz, a / (a + b)), 1e-9 * a * b / (a + b)
        one = before or after
        return None if one is None else (one.q_wxyz, 1e-9 * abs(t_ns - one.t_ns))


def slerp(first: Float, second: Float, share: float) -> Float:
    """Unit quaternion (4,) on the shorter arc between two, at `share` 0...1 of the way (Shoemake, 1985)."""
    cosine = float(first @ second)
    other = second if cosine >= 0.0 else -second
    angle = np.arccos(min(abs(cosine), 1.0))
    sine = np.sin(angle)
    if sine < _STRAIGHT:
        return first
    return (np.sin((1.0 - share) * angle) * first + np.sin(share * angle) * other) / sine
