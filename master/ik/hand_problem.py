"""One frame of the whole-hand fit: a bounded least-squares problem, and its solution by Levenberg-Marquardt.

The residuals are the markers' distances, whitened by their covariance, and the priors. Only the normal equations
are formed; the Jacobian is closed form. A parameter that stands at its limit and is pushed outwards is left out
of the step (active set), every other step ends at its limit. So no iterate is ever outside.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float
from common.geometry import rotation_vector_to_matrix
from common.hand_model import HandModel
from master.ik.attached import Attached, minus_skew
from master.ik.parameters import HandParameters
from master.ik.priors import AnglePrior

MAX_ITERATIONS = 25
_MAX_DAMPING = 1e6


@dataclass(frozen=True, slots=True, eq=False)
class Facing:
    """The back of the hand is believed to look along `direction` (3,), rig frame; `weight`: one per sigma."""

    direction: Float
    weight: float


@dataclass(frozen=True, slots=True, eq=False)
class PalmPrior:
    """The palm is believed near `T_rig_palm` (4, 4); `weight` (6,): one per sigma of turn and shift."""

    T_rig_palm: Float
    weight: Float


@dataclass(frozen=True, slots=True, eq=False)
class Linear:
    """Cost, gradient (6 + n,) and Gauss-Newton normal matrix (6 + n, 6 + n) at one point."""

    cost: float
    gradient: Float
    normal: Float


@dataclass(frozen=True, slots=True, eq=False)
class Minimum:
    """Where the search ended: pose, free angles (n,), and the linearisation there."""

    T_rig_palm: Float
    x: Float
    linear: Linear
    iterations: int


@dataclass(frozen=True, slots=True, eq=False)
class HandProblem:
    """What is known of one frame.

    Attributes:
        model: The hand.
        parameters: Its free angles and their bounds.
        markers: The N seen markers.
        points_m: (N, 3) [m] where they were seen, rig frame.
        whiten: (N, 3, 3) inverse square roots of their covariances.
        prior: Beliefs about the angles.
        palm: Belief about the palm, or None.
        facing: Belief about the side it shows, or None.
    """

    model: HandModel
    parameters: HandParameters
    markers: Attached
    points_m: Float
    whiten: Float
    prior: AnglePrior
    palm: PalmPrior | None
    facing: Facing | None

    def minimise(self, T_rig_palm: Float, x: Float) -> Minimum:
        """Go downhill from one seed inside the bounds."""
        T, damping, here = T_rig_palm, 1e-3, self.linearise(T_rig_palm, x)
        iterations = 0
        while iterations < MAX_ITERATIONS and damping <= _MAX_DAMPING:
            iterations += 1
            T_new, x_new = self._step(here, T, x, damping)
            there = self.linearise(T_new, x_new)
            if there.cost >= here.cost:
                damping *= 8.0
                continue
            gain = here.cost - there.cost
            T, x, here = T_new, x_new, there
            damping = max(damping / 8.0, 1e-9)
            if gain < 1e-4 * (1e-3 + here.cost):
                break
        return Minimum(T, x, here, iterations)

    def linearise(self, T_rig_palm: Float, x: Float) -> Linear:
        """Cost, gradient and normal matrix at a pose and free angles (n,)."""
        R, origin = T_rig_palm[:3, :3], T_rig_palm[:3, 3]
        chains = self.model.chains(self.parameters.angles(x))
        local = self.markers.place(chains)
        arm = local @ R.T
        count = len(local)
        J = np.empty((count, 3, 6 + len(x)))
        J[:, :, :3] = self.whiten @ minus_skew(arm)
        J[:, :, 3:6] = self.whiten
        J[:, :, 6:] = self.whiten @ R @ self.markers.jacobian(chains, local)
        J = J.reshape(3 * count, 6 + len(x))
        residual = (self.whiten @ (arm + origin - self.points_m)[..., None]).reshape(3 * count)
        gradient, normal = residual @ J, J.T @ J
        cost, prior_gradient = self.prior.cost_and_gradient(x)
        cost += 0.5 * float(residual @ residual)
        gradient[6:] += prior_gradient
        normal[6:, 6:] += self.prior.normal
        if self.facing is not None:
            dorsal, weight = R[:, 1], self.facing.weight
            off = weight * (dorsal - self.facing.direction)
            J_facing = weight * minus_skew(dorsal[None])[0]
            cost += 0.5 * float(off @ off)
            gradient[:3] += off @ J_facing
            normal[:3, :3] += J_facing.T @ J_facing
        if self.palm is not None:
            weight = self.palm.weight
            off = weight * _moved(T_rig_palm, self.palm.T_rig_palm)
            cost += 0.5 * float(off @ off)
            gradient[:6] += weight * off
            normal[range(6), range(6)] += weight * weight
        return Linear(cost, gradient, normal)

    def _step(self, here: Linear, T: Float, x: Float, damping: float) -> tuple[Float, Float]:
        low, high, gradient = self.parameters.low, self.parameters.high, here.gradient
        move: Bool = np.ones(len(gradient), dtype=bool)
        move[6:] = ~(((x <= low) & (gradient[6:] > 0)) | ((x >= high) & (gradient[6:] < 0)))
        damped = here.normal.copy()
        damped.flat[:: len(gradient) + 1] *= 1.0 + damping
        step = np.zeros(len(gradient))
        step[move] = np.linalg.solve(damped[move][:, move], -gradient[move])
        T_new = T.copy()
        T_new[:3, :3] = rotation_vector_to_matrix(step[:3]) @ T[:3, :3]
        T_new[:3, 3] += step[3:6]
        return T_new, np.minimum(np.maximum(x + step[6:], low), high)


def _moved(T: Float, T_before: Float) -> Float:
    """Turn (3,) (sine of the angle times the axis) and shift (3,) [m] from one pose to the other."""
    turned = T[:3, :3] @ T_before[:3, :3].T
    x, y, z = turned[2, 1] - turned[1, 2], turned[0, 2] - turned[2, 0], turned[1, 0] - turned[0, 1]
    return np.array([0.5 * x, 0.5 * y, 0.5 * z, *(T[:3, 3] - T_before[:3, 3])])
