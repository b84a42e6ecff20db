"""Smooths the pose of an object as it arrives, so that one at rest does not tremble.

The same filter as of the hand (`master.ik.part_filter`), with place and turn as its parts. The place is that of the
middle of the features, about which the turn is unsure; at the object's own origin, a lever away, the noise of the turn
would shake the place as well. A turn counts by how far it moves what is a decimetre away.
"""

import numpy as np

from common.arrays import Float
from common.geometry import matrix_to_rotation_vector, rigid, rotation_vector_to_matrix
from master.ik.part_filter import PartFilter

_ARM_M = 0.1
_ANEW_S = 0.5
_FRESH = 0.15  # of the variance of a pose, new in each frame: most of its error stays


class Steady:
    """Push machine. Holds the filter, and the pose that it showed last."""

    def __init__(self, middle_m: Float, jitter_m: float) -> None:
        """Set up.

        Args:
            middle_m: (3,) middle of the features, object frame [m].
            jitter_m: Standard deviation that may be left of the noise of an object at rest [m].
        """
        self._middle, self._jitter_m = middle_m, jitter_m
        self._filter: PartFilter | None = None
        self._t_ns, self._R, self._values = 0, np.eye(3), np.zeros(6)

    def push(self, t_ns: int, T: Float, cov: Float) -> Float:
        """The pose (4, 4) to show, of one that was measured with a covariance (6, 6)."""
        dt = (t_ns - self._t_ns) * 1e-9
        if self._filter is None or dt > _ANEW_S:
            self._filter, dt = PartFilter((3, 3), self._jitter_m), 0.0
            self._R, self._values = T[:3, :3], np.zeros(6)
        turn = _ARM_M * matrix_to_rotation_vector(T[:3, :3] @ self._R.T)
        signals = np.concatenate([T[:3, :3] @ self._middle + T[:3, 3], self._values[3:] + turn])
        noise = _FRESH * np.concatenate([np.diagonal(cov)[:3], _ARM_M**2 * np.diagonal(cov)[3:]])
        values = self._filter.push(dt, signals, noise)
        self._R = rotation_vector_to_matrix((values - self._values)[3:] / _ARM_M) @ self._R
        self._values, self._t_ns = values, t_ns
        return rigid(self._R, values[:3] - self._R @ self._middle)

    def held(self, t_ns: int, T: Float) -> Float:
        """The pose to show of one that was led on: as it is."""
        return T

    def forget(self) -> None:
        """Begin anew with the next pose."""
        self._filter = None
