"""Poses of fingers on their way to minima of the inverse model, and which of them are one."""

from dataclasses import dataclass

import numpy as np

from common.arrays import Float, Int

MINIMA = 3  # of one finger that are kept
_SAME_RAD = np.radians(4.0)  # nearer to each other than this, two candidates are on their way to one minimum
_HOPELESS = 40.0  # worse than the best by this, a candidate is none; a table is wrong by less


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """Poses (N) of fingers, and how they explain what was seen.

    Attributes:
        x_rad: (N, 3) abduction, flexion, PIP.
        finger: (N,) whose.
        misfit: (N,) energy; inf: the laser misses.
        length_px: (N,) of the laser line.
        J: (N, 4, 3) how what is seen changes [1/rad].
    """

    x_rad: Float
    finger: Int
    misfit: Float
    length_px: Float
    J: Float

    def of(self, rows: Int) -> "Found":
        """Some of them."""
        return Found(
            self.x_rad[rows], self.finger[rows], self.misfit[rows], self.length_px[rows], self.J[rows]
        )


def joined(one: Found, other: Found) -> Found:
    """Both."""
    return Found(
        np.concatenate([one.x_rad, other.x_rad]),
        np.concatenate([one.finger, other.finger]),
        np.concatenate([one.misfit, other.misfit]),
        np.concatenate([one.length_px, other.length_px]),
        np.concatenate([one.J, other.J]),
    )


def apart(x: Float, finger: Int, misfit: Float) -> Int:
    """Which of candidates (N, 3) of fingers (N,) are kept: sorted by finger and misfit, the best of each place."""
    order = np.lexsort((misfit, finger))
    x, finger, misfit = x[order], finger[order], misfit[order]
    rank = np.arange(len(x))
    better = (finger[:, None] == finger) & (rank < rank[:, None])
    close = (np.abs(x[:, None] - x)[..., 1:] < _SAME_RAD).all(axis=-1)
    first = np.searchsorted(finger, finger)
    keep = ~(better & close).any(axis=1) & ((misfit < misfit[first] + _HOPELESS) | (rank == first))
    keep &= (better & keep).sum(axis=1) < MINIMA
    return order[keep]
