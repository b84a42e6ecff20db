"""Points over time that two programs both report.

They are resampled, and their speeds computed.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float, Int

"""Between two frames that are farther apart nothing is known: 25 ms, or 1.5 frames of a slow file, at most 100 ms."""


def known(position_m: Float) -> Bool:
    """Whether points (..., 3) are known, (...)."""
    return np.asarray(np.isfinite(position_m).all(axis=-1), np.bool_)


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """Positions of J named points at T times.

    Attributes:
        t_ns: (T,) [ns], rising.
        position_m: (T, J, 3) [m]; NaN: not known.
    """

    t_ns: Int
    position_m: Float

    @property
    def gap_ns(self) -> int:
        """Frames that are farther apart have nothing between them."""
        typical = float(np.median(np.diff(self.t_ns))) if len(self.t_ns) > 1 else 0.0
        # gap ns
        most_gap_ns, gap_frames = 100_000_000, 1.5
        return int(min(max(25_000_000, gap_frames * typical), most_gap_ns))

    def at(self, t_ns: Int) -> Float:
        """Interpolate positions (N, J, 3) [m] at times (N,).

        Between two frames the interpolation is linear.

        NaN before the first frame, after the last, in a gap, and where one of the two frames does not know the point.
        """
        if len(self.t_ns) < 2:
            return np.full((len(t_ns), *self.position_m.shape[1:]), np.nan)
        after = np.clip(np.searchsorted(self.t_ns, t_ns), 1, len(self.t_ns) - 1)
        before = after - 1
        span = self.t_ns[after] - self.t_ns[before]
        share = (t_ns - self.t_ns[before]) / span
        between = (share >= 0.0) & (share <= 1.0) & (span <= self.gap_ns)
        share = np.where(between, share, np.nan)[:, None, None]
        first, second = self.position_m[before], self.position_m[after]
        # On a frame itself the other one does not matter.
        middle = first + share * (second - first)
        return np.where(share == 0.0, first, np.where(share == 1.0, second, middle))

    def velocity(self, t_ns: Int, half_ns: int) -> Float:
        """Velocities (N, J, 3) [m/s] by the difference over twice `half_ns`."""
        return (self.at(t_ns + half_ns) - self.at(t_ns - half_ns)) / (2e-9 * half_ns)
