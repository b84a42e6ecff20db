"""Motion of a rigid object about an epoch.

It is a Taylor series of its position and of its rotation.

X = R(theta(t)) R0 q + p(t),   p(t) = sum_k p_k t^k / k!,   theta(t) = sum_{k>0} theta_k t^k / k!
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Float
from common.geometry.transforms import matrix_to_rotation_vector, rigid, rotation_vector_to_matrix

ORDERS = 5
_FACTORIAL: Float = np.array([1.0, 1.0, 2.0, 6.0, 24.0])
_POWERS = np.arange(ORDERS)


def basis_at(tau_s: Float) -> Float:
    """Return weights (..., ORDERS) of the derivatives at times (...).

    The times are from the epoch [s].
    """
    return tau_s[..., None] ** _POWERS / _FACTORIAL


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """A pose and its derivatives.

    Attributes:
        T: (4, 4) `T_rig_object`.
        rates: (ORDERS, 2, 3) derivatives of place [m/s^k] and turn [rad/s^k], rig axes; those of order 0 are 0.
    """

    T: Float
    rates: Float

    @classmethod
    def still(cls, T: Float) -> "Motion":
        """An object at rest."""
        return cls(T, np.zeros((ORDERS, 2, 3)))

    def at(self, t_s: float, orders: int = 2) -> "Motion":
        """The pose at another time, by the first derivatives; these kept."""
        weights = t_s**_POWERS / _FACTORIAL
        weights[orders:] = 0.0
        way = np.einsum("k,kij->ij", weights, self.rates)
        rates = self.rates.copy()
        rates[orders:] = 0.0
        return Motion(_stepped(self.T, way), rates)

    def retracted(self, step: Float) -> "Motion":
        """The motion after a step (6 ORDERS,): of each order place, then turn."""
        change = step.reshape(ORDERS, 2, 3)
        rates = self.rates + change
        rates[0] = 0.0
        return Motion(_stepped(self.T, change[0]), rates)


def _stepped(T: Float, step: Float) -> Float:
    """A pose (4, 4) after a step of its place and of its turn (2, 3)."""
    return rigid(rotation_vector_to_matrix(step[1]) @ T[:3, :3], T[:3, 3] + step[0])


@dataclass(frozen=True, slots=True, eq=False)
class Past:
    """Prior from earlier frames at the epoch.

    It is of position, rotation and speeds: the estimate, and its information (12, 12).
    """

    motion: Motion
    precision: Float

    def off(self, motion: Motion) -> Float:
        """(12,) how far another motion is from this: what would have to be added to it."""
        own = self.motion
        return np.concatenate(
            [
                own.T[:3, 3] - motion.T[:3, 3],
                matrix_to_rotation_vector(own.T[:3, :3] @ motion.T[:3, :3].T),
                (own.rates[1] - motion.rates[1]).ravel(),
            ]
        )
