"""Filter that smooths the pose of an object as it arrives.

An object at rest thus does not tremble.

The 1 € filter of its rig, as of the hand (`master.estimator.smooth`), with position and rotation as its groups and the
noise as it is measured. The position is that of the middle of the features, about which the rotation is unsure; at the
object's own origin, a lever away, the noise of the rotation would shake the position as well. A rotation counts by how
far it moves what is a decimetre away.
"""

import numpy as np

from common.arrays import Float
from common.geometry.transforms import matrix_to_rotation_vector, rigid, rotation_vector_to_matrix
from master.fabrik.noise import NoiseEstimator
from master.fabrik.one_euro import OneEuro, OneEuroParameters


class PoseFilter:
    """1 € filter of an object's pose.

    Push machine. Holds the filter, the measured noise, and the pose that it output last.
    """

    def __init__(self, middle_m: Float, parameters: OneEuroParameters) -> None:
        """Set up.

        Args:
            middle_m: (3,) middle of the features, object frame [m].
            parameters: Of the 1 € filter [m, s].
        """
        self._middle, self._parameters = middle_m, parameters
        self._filter: OneEuro | None = None
        self._noise = NoiseEstimator()
        self._t_ns, self._R, self._values = 0, np.eye(3), np.zeros(6)

    def push(self, t_ns: int, T: Float, cov: Float) -> Float:
        """The pose (4, 4) to show, of one that was measured with a covariance (6, 6)."""
        reset_s = 0.5
        if self._filter is None or (t_ns - self._t_ns) * 1e-9 > reset_s:
            self._filter, self._noise = OneEuro(self._parameters, (3, 3)), NoiseEstimator()
            self._R, self._values = T[:3, :3], np.zeros(6)
        arm_m = 0.1
        rotation = arm_m * matrix_to_rotation_vector(T[:3, :3] @ self._R.T)
        signals = np.concatenate([T[:3, :3] @ self._middle + T[:3, 3], self._values[3:] + rotation])
        independent_share = 0.15  # of the variance of a pose, new in each frame: most of its error stays
        noise = independent_share * np.concatenate([np.diagonal(cov)[:3], arm_m**2 * np.diagonal(cov)[3:]])
        values = self._filter.push(t_ns, signals, self._noise.push(t_ns, signals, noise))
        self._R = rotation_vector_to_matrix((values - self._values)[3:] / arm_m) @ self._R
        self._values, self._t_ns = values, t_ns
        return rigid(self._R, values[:3] - self._R @ self._middle)

    def held(self, t_ns: int, T: Float) -> Float:
        """The pose to show of one that was led on: as it is."""
        return T

    def forget(self) -> None:
        """Begin anew with the next pose."""
        self._filter = None
