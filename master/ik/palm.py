"""What is believed of the palm as a whole: the side it shows, its orientation by a sensor, and where it was.

Beliefs about the side and the past are rows of the least-squares problem (`master.ik.hand_problem`): residuals, and
their derivatives by a small turn of the palm in rig axes and, for the last, a shift. What a sensor says of the
orientation adds its cost, gradient and Gauss-Newton normal matrix.
"""

from dataclasses import dataclass, field

import numpy as np

from common.arrays import Float
from common.geometry import matrix_to_rotation_vector, skew, unskew

_EYE = np.eye(3)
_SURE_RAD = np.radians(15.0)  # about every axis: better known than this, it says how the palm lies
_SMALL_RAD = 1e-4  # below it a rotation vector is taken as that long in the derivative


@dataclass(frozen=True, slots=True, eq=False)
class Facing:
    """The back of the hand is believed to look along `direction` (3,), unit, rig frame; `weight`: one per sigma."""

    direction: Float
    weight: float

    def rows(self, R: Float) -> tuple[Float, Float]:
        """Residuals (..., 3) of rotations (..., 3, 3), and their derivatives (..., 3, 3) by a turn."""
        dorsal = self.weight * R[..., :, 1]
        return dorsal - self.weight * self.direction, skew(-dorsal)


@dataclass(frozen=True, slots=True, eq=False)
class Orientation:
    """The palm's orientation as something else measured it, an IMU for instance.

    Attributes:
        rotation: (3, 3) palm frame -> rig frame.
        cov_rad2: (3, 3) [rad^2] of the rotation vector, in rig axes, that turns it to the true one; positive
            definite, and large about an axis about which nothing is known.
        information: (3, 3) its inverse.
    """

    rotation: Float
    cov_rad2: Float
    information: Float = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "information", np.linalg.inv(self.cov_rad2))

    @property
    def sure(self) -> bool:
        """Whether it is known about every axis; an IMU without heading is not."""
        return float(np.linalg.eigvalsh(self.cov_rad2)[-1]) < _SURE_RAD**2

    def add_to(self, R: Float, gradient: Float, normal: Float) -> Float:
        """The cost (...) of rotations (..., 3, 3); adds to gradients (..., 6 + n) and normals (..., 6 + n, 6 + n)."""
        off = matrix_to_rotation_vector(R @ self.rotation.T)
        J = turn_of_vector(off)
        weighed = off @ self.information
        gradient[..., :3] += (weighed[..., None, :] @ J)[..., 0, :]
        normal[..., :3, :3] += np.swapaxes(J, -1, -2) @ (self.information @ J)
        return 0.5 * np.vecdot(weighed, off)


@dataclass(frozen=True, slots=True, eq=False)
class PalmPrior:
    """The palm is believed near `T_rig_palm` (4, 4); `weight` (6,): one per sigma of turn and shift."""

    T_rig_palm: Float
    weight: Float

    def cost(self, T_rig_palm: Float) -> float:
        """That of one pose (4, 4)."""
        off = self.off(T_rig_palm)
        return 0.5 * float(off @ off)

    def off(self, T: Float) -> Float:
        """Turn (sine of the angle times the axis) and shift from the belief to poses (..., 4, 4): (..., 6), sigmas.

        Their derivatives by turn and shift are taken as the weights.
        """
        out = np.empty((*T.shape[:-2], 6))
        out[..., :3] = unskew(T[..., :3, :3] @ self.T_rig_palm[:3, :3].T)
        out[..., 3:] = T[..., :3, 3] - self.T_rig_palm[:3, 3]
        out *= self.weight
        return out


def turn_of_vector(vector: Float) -> Float:
    """Derivatives (..., 3, 3) of rotation vectors (..., 3) by a small turn in front of them.

    The inverse of the left Jacobian of SO(3) (Sola, Deray, Atchuthan 2018, "A micro Lie theory", eq. 146).
    """
    angle = np.maximum(np.sqrt(np.vecdot(vector, vector)), _SMALL_RAD)[..., None, None]
    k = skew(vector)
    factor = 1.0 / (angle * angle) - 0.5 / (angle * np.tan(0.5 * angle))
    return _EYE - 0.5 * k + factor * (k @ k)
