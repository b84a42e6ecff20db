"""One frame of the whole-hand fit: a bounded least-squares problem, and its solution by Levenberg-Marquardt.

The residuals are the markers' distances, whitened by their covariance, and the priors. Only the normal equations
are formed; the Jacobian is closed form. A parameter that stands at its limit and is pushed outwards is left out
of the step (active set), every other step ends at its limit. So no iterate is ever outside. Searches from several
seeds go side by side: all arrays may have leading axes, and three cost little more than one.
"""

from dataclasses import dataclass, field

import numpy as np

from common.arrays import Bool, Float
from common.geometry import rotation_vector_to_matrix, skew, unskew
from common.hand_model import HandModel
from master.ik.attached import Attached
from master.ik.parameters import HandParameters
from master.ik.priors import AnglePrior

MAX_ITERATIONS = 25
_MAX_DAMPING = 1e6
_EYE = np.eye(3)


@dataclass(frozen=True, slots=True, eq=False)
class Facing:
    """The back of the hand is believed to look along `direction` (3,), unit, rig frame; `weight`: one per sigma."""

    direction: Float
    weight: float


@dataclass(frozen=True, slots=True, eq=False)
class PalmPrior:
    """The palm is believed near `T_rig_palm` (4, 4); `weight` (6,): one per sigma of turn and shift."""

    T_rig_palm: Float
    weight: Float


@dataclass(frozen=True, slots=True, eq=False)
class Linear:
    """Cost (...), gradient (..., 6 + n) and Gauss-Newton normal matrix (..., 6 + n, 6 + n) at a point."""

    cost: Float
    gradient: Float
    normal: Float

    def of(self, k: int) -> "Linear":
        """That of one of several."""
        return Linear(self.cost[k], self.gradient[k], self.normal[k])

    def replaced(self, by: Bool, other: "Linear") -> "Linear":
        """With those chosen by (S,) taken from the other."""
        cost, gradient = (
            np.where(by, other.cost, self.cost),
            np.where(by[:, None], other.gradient, self.gradient),
        )
        return Linear(cost, gradient, np.where(by[:, None, None], other.normal, self.normal))


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
        believed: (6 + n, 6 + n) normal matrix of what is believed of angles and palm.
    """

    model: HandModel
    parameters: HandParameters
    markers: Attached
    points_m: Float
    whiten: Float
    prior: AnglePrior
    palm: PalmPrior | None
    facing: Facing | None
    believed: Float = field(init=False)

    def __post_init__(self) -> None:
        size = 6 + len(self.parameters.free)
        believed = np.zeros((size, size))
        believed[6:, 6:] = self.prior.normal
        if self.palm is not None:
            believed.flat[: 6 * size : size + 1] = self.palm.weight * self.palm.weight
        object.__setattr__(self, "believed", believed)

    def minimise(self, T_rig_palm: Float, x: Float) -> Minimum:
        """The lowest end of the ways downhill from seeds (S, 4, 4), (S, n) inside the bounds."""
        T, here = T_rig_palm, self.linearise(T_rig_palm, x)
        damping, going = [1e-3] * len(x), [True] * len(x)
        iterations = 0
        while iterations < MAX_ITERATIONS and any(going):
            iterations += 1
            T_new, x_new = self._step(here, T, x, np.array(damping))
            there = self.linearise(T_new, x_new)
            better: list[bool] = []
            for k, (cost, before) in enumerate(zip(there.cost.tolist(), here.cost.tolist(), strict=True)):
                better.append(going[k] and cost < before)
                if better[k]:
                    damping[k] = max(damping[k] / 8.0, 1e-9)
                    going[k] = before - cost >= 1e-4 * (1e-3 + cost)
                else:
                    damping[k] *= 8.0
                    going[k] = going[k] and damping[k] <= _MAX_DAMPING
            if all(better):
                T, x, here = T_new, x_new, there
            elif any(better):
                use = np.array(better)
                T, x = np.where(use[:, None, None], T_new, T), np.where(use[:, None], x_new, x)
                here = here.replaced(use, there)
        best = int(np.argmin(here.cost))
        return Minimum(T[best], x[best], here.of(best), iterations)

    def linearise(self, T_rig_palm: Float, x: Float) -> Linear:
        """Cost, gradient and normal matrix at poses (..., 4, 4) and free angles (..., n)."""
        R, origin = T_rig_palm[..., :3, :3], T_rig_palm[..., None, :3, 3]
        chains = self.model.chains(self.parameters.angles(x))
        local = self.markers.place(chains)
        arm = local @ np.swapaxes(R, -1, -2)
        moved = np.empty((*arm.shape, 6 + x.shape[-1]))  # the markers by turn, shift and angles
        moved[..., :3], moved[..., 3:6] = skew(-arm), _EYE
        moved[..., 6:] = R[..., None, :, :] @ self.markers.jacobian(chains, local)
        rows = (*x.shape[:-1], 3 * arm.shape[-2])
        J = (self.whiten @ moved).reshape(*rows, moved.shape[-1])
        residual = (self.whiten @ (arm + origin - self.points_m)[..., None]).reshape(rows)
        gradient, normal = (residual[..., None, :] @ J)[..., 0, :], np.swapaxes(J, -1, -2) @ J
        normal += self.believed
        cost, prior_gradient = self.prior.cost_and_gradient(x)
        gradient[..., 6:] += prior_gradient
        cost = cost + 0.5 * np.vecdot(residual, residual)
        if self.facing is not None:
            dorsal, direction, weight = R[..., :, 1], self.facing.direction, self.facing.weight**2
            off = dorsal - direction
            cost = cost + 0.5 * weight * np.vecdot(off, off)
            gradient[..., :3] += weight * (dorsal @ skew(-direction))
            normal[..., :3, :3] += weight * (_EYE - dorsal[..., :, None] * dorsal[..., None, :])
        if self.palm is not None:
            off = self.palm.weight * _moved(T_rig_palm, self.palm.T_rig_palm)
            cost = cost + 0.5 * np.vecdot(off, off)
            gradient[..., :6] += self.palm.weight * off
        return Linear(cost, gradient, normal)

    def _step(self, here: Linear, T: Float, x: Float, damping: Float) -> tuple[Float, Float]:
        low, high = self.parameters.low, self.parameters.high
        damped, downhill = here.normal.copy(), -here.gradient
        seeds, size = downhill.shape
        diagonal = damped.reshape(seeds, -1)[:, :: size + 1]  # a view
        diagonal *= 1.0 + damping[:, None]
        pulled = downhill[:, 6:]
        stays = ((x <= low) & (pulled < 0)) | ((x >= high) & (pulled > 0))
        if stays.any():  # its row and column become those of a parameter that nothing moves
            held = np.zeros(downhill.shape, dtype=bool)
            held[:, 6:] = stays
            damped[held[:, :, None] | held[:, None, :]] = 0.0
            diagonal += held
            downhill[held] = 0.0
        step = np.asarray(np.linalg.solve(damped, downhill[..., None])[..., 0], np.float64)
        T_new = T.copy()
        T_new[:, :3, :3] = rotation_vector_to_matrix(step[:, :3]) @ T[:, :3, :3]
        T_new[:, :3, 3] += step[:, 3:6]
        return T_new, np.minimum(np.maximum(x + step[:, 6:], low), high)


def _moved(T: Float, T_before: Float) -> Float:
    """Turn (..., 3) (sine of the angle times the axis) and shift (..., 3) [m] from one pose to the other: (..., 6)."""
    turned = unskew(T[..., :3, :3] @ T_before[:3, :3].T)
    return np.concatenate([turned, T[..., :3, 3] - T_before[:3, 3]], axis=-1)
