"""One frame of the whole-hand fit: a bounded least-squares problem, and its solution by Levenberg-Marquardt.

The residuals are the markers' distances, whitened by their covariance, and the priors. Only the normal equations
are formed; the Jacobian is closed form. A parameter that stands at its limit and is pushed outwards is left out
of the step (active set), every other step ends at its limit. So no iterate is ever outside. Searches from several
seeds go side by side: all arrays may have leading axes, and three cost little more than one.
"""

from dataclasses import dataclass, field

import numpy as np

from common.arrays import Float
from common.geometry import rotation_vector_to_matrix, skew, unskew
from common.hand_model import HandModel
from master.ik.attached import Attached
from master.ik.parameters import HandParameters
from master.ik.priors import AnglePrior

MAX_ITERATIONS = 25
ENOUGH = 1e-7  # of half chi square: what a search may leave
_FIRST_DAMPING, _MAX_DAMPING = 1e-3, 1e6
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

    def or_where(self, use: list[bool], other: "Linear") -> "Linear":
        """With those of `use` (S,) taken from the other."""
        if all(use):
            return other
        cost, gradient = _either(use, other.cost, self.cost), _either(use, other.gradient, self.gradient)
        return Linear(cost, gradient, _either(use, other.normal, self.normal))


@dataclass(frozen=True, slots=True, eq=False)
class Minimum:
    """Where the search ended: pose, free angles (n,), and the linearisation there or just before."""

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

    def minimise(self, T_rig_palm: Float, x: Float, enough: float = ENOUGH) -> Minimum:
        """The lowest end of the ways downhill from seeds (S, 4, 4), (S, n) inside the bounds.

        A way ends where a step gains less than `enough`, and a ten-thousandth of the cost.
        """
        T, here, iterations = T_rig_palm, self.linearise(T_rig_palm, x), 0
        paces = [_Pace(enough) for _ in x]
        while iterations < MAX_ITERATIONS and any(pace.going for pace in paces):
            iterations += 1
            T_new, x_new, hoped = self._step(here, T, x, np.array([pace.damping for pace in paces]))
            costs, gains = here.cost.tolist(), hoped.tolist()
            last = [pace.arrives(*step) for pace, *step in zip(paces, costs, gains, strict=True)]
            T, x = _either(last, T_new, T), _either(last, x_new, x)
            if not any(pace.going for pace in paces):
                break
            there = self.linearise(T_new, x_new)
            steps = zip(paces, costs, there.cost.tolist(), gains, strict=True)
            lower = [pace.improves(*step) for pace, *step in steps]
            T, x, here = _either(lower, T_new, T), _either(lower, x_new, x), here.or_where(lower, there)
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

    def palm_cost(self, T_rig_palm: Float) -> float:
        """What a palm (4, 4) costs by the belief about it."""
        if self.palm is None:
            return 0.0
        off = self.palm.weight * _moved(T_rig_palm, self.palm.T_rig_palm)
        return 0.5 * float(off @ off)

    def _step(self, here: Linear, T: Float, x: Float, damping: Float) -> tuple[Float, Float, Float]:
        """The next poses (S, 4, 4) and angles (S, n), and how much lower the cost (S,) should be there."""
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
        hoped = 0.5 * np.vecdot(downhill, step)
        return T_new, np.minimum(np.maximum(x + step[:, 6:], low), high), hoped


@dataclass(slots=True)
class _Pace:
    """How boldly one search goes on. Holds its damping, by what it grows next, and whether the search goes on.

    The damping follows the gain ratio: Madsen, Nielsen, Tingleff, "Methods for Non-Linear Least Squares Problems",
    2nd edition, 2004, equation 2.21.
    """

    enough: float
    damping: float = _FIRST_DAMPING
    growth: float = 2.0
    going: bool = True

    def arrives(self, cost: float, hoped: float) -> bool:
        """Whether this step is the last: an all but undamped model, which is right so near, hopes for no more."""
        arrived = self.going and self.damping <= _FIRST_DAMPING and hoped < self._little(cost)
        self.going = self.going and not arrived
        return arrived

    def improves(self, before: float, cost: float, hoped: float) -> bool:
        """Whether a step lowers the cost as it goes on; damps the next one accordingly."""
        if not self.going:
            return False
        gain = before - cost
        if not gain > 0.0:
            self.damping, self.growth = self.damping * self.growth, 2.0 * self.growth
            self.going = self.damping <= _MAX_DAMPING
            return False
        self.damping = max(self.damping * max(1 / 3, 1.0 - (2.0 * gain / hoped - 1.0) ** 3), 1e-9)
        self.growth, self.going = 2.0, gain >= self._little(cost)
        return True

    def _little(self, cost: float) -> float:
        return self.enough + 1e-4 * cost


def _either(use: list[bool], one: Float, other: Float) -> Float:
    """Row by row (S, ...): `one` where `use` (S,) is true, else the other."""
    if all(use):
        return one
    return np.where(np.array(use).reshape(-1, *[1] * (one.ndim - 1)), one, other) if any(use) else other


def _moved(T: Float, T_before: Float) -> Float:
    """Turn (..., 3) (sine of the angle times the axis) and shift (..., 3) [m] from one pose to the other: (..., 6)."""
    turned = unskew(T[..., :3, :3] @ T_before[:3, :3].T)
    return np.concatenate([turned, T[..., :3, 3] - T_before[:3, 3]], axis=-1)
