"""Orientation of one IMU between its samples.

It handles the shorter arc, gaps, values that are no rotation, and clocks set back.
"""

from collections import Counter, deque
from dataclasses import dataclass
from math import acos, isnan, nan, sin, sqrt

from common.arrays import Float
from common.calibration import UNIT_WITHIN
from common.geometry.transforms import Wxyz

REACH_NS = 50_000_000  # farther from an epoch a sample does not constrain it


@dataclass(frozen=True, slots=True, eq=False)
class _Sample:
    t_ns: int
    q_wxyz: Wxyz
    drift_rad: float


@dataclass(frozen=True, slots=True, eq=False)
class Between:
    """Orientation of an IMU at a time.

    Attributes:
        q_wxyz: Unit quaternion.
        away_s: How far from samples that is [s].
        drift_rad: How far its heading has drifted since the first sample, standard deviation [rad].
    """

    q_wxyz: Wxyz
    away_s: float
    drift_rad: float


class OrientationSamples:
    """Push machine. Holds the newest samples, and when the first came.

    Attributes:
        counts: Samples rejected: `orientation.missing`, `orientation.not_unit`, `orientation.late`.
    """

    def __init__(self, counts: Counter[str], drift_rad_s: float, late_us: float = 0.0) -> None:
        """Begin without any, counting into `counts`.

        Args:
            counts: What is rejected, by reason.
            drift_rad_s: How fast headings drift where samples do not state how far.
            late_us: How much later samples were taken than their time stamps; added to these.
        """
        self.counts, self._drift_rad_s, self._late_ns = counts, drift_rad_s, round(1e3 * late_us)
        kept = 512  # half a second of the fastest sensors; epochs lie at most two camera periods behind
        self._samples: deque[_Sample] = deque(maxlen=kept)
        self._first_ns: int | None = None

    def __len__(self) -> int:
        """How many it holds."""
        return len(self._samples)

    def push(self, t_ns: int, orientation_wxyz: Float, heading_sigma_rad: float = nan) -> None:
        """Take one sample of the IMU and how far its heading has drifted.

        The quaternion (4,) is IMU axes -> its world, q as good as -q.

        What is no rotation is rejected. A sample long before the newest means that a clock was set back, or that the
        newest came from a time that is not yet: the others are forgotten.
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
                if newest_ns - t_ns <= REACH_NS:
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
        """Return the orientation at a time.

        None: too far from any sample.

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
            q = slerp(before.q_wxyz, after.q_wxyz, a / (a + b))
            return Between(q, 1e-9 * a * b / (a + b), after.drift_rad)
        one = before or after
        return None if one is None else Between(one.q_wxyz, 1e-9 * abs(t_ns - one.t_ns), one.drift_rad)


def slerp(first: Wxyz, second: Wxyz, share: float) -> Wxyz:
    """Return the unit quaternion at `share` 0...1 between two.

    It lies on the shorter arc (Shoemake, 1985).
    """
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
