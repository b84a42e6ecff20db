"""One frame of the whole-hand fit: a bounded least-squares problem, and its solution by Levenberg-Marquardt.

The residuals are the markers' distances, whitened by their covariance, and the priors. Only the normal equations
are formed; the Jacobian is closed form. A parameter that stands at its limit and is pushed outwards is left out
of the step (active set), every other step ends at its limit. So no iterate is ever outside. Searches from several
seeds go side by side: all arrays may have leading axes, and three cost little more than one.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from common.arrays import Float, Int
from common.geometry import rotation_vector_to_matrix, skew
from common.hand_model import HandModel
from master.estimator.attached import Attached
from master.estimator.parameters import HandParameters
from master.fusion.sensed_hand import SensedFree
from master.ik.palm import Facing, Orientation, PalmPrior
from master.ik.priors import AnglePrior
from master.ik.within import mean_within

MAX_ITERATIONS = 25
ENOUGH = 1e-7  # of half chi square: what a search may leave
_ROUGH = 1e-2  # the same where one of several seeds is to be chosen; with 1, poor depth led to wrong hands now and then
_LITTLE = 1e-4  # of a step: what a difference is taken over
_FIRST_DAMPING, _MAX_DAMPING = 1e-3, 1e6
_EYE = np.eye(3)


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
    """Where a search ended: pose, free angles (n,), and the linearisation there or just before."""

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
        points_m: (..., N, 3) [m] where they were seen, rig frame; with leading axes, those of the hands asked about.
        whiten: (..., N, 3, 3) inverse square roots of their covariances.
        prior: Beliefs about the angles, of one hypothesis or several.
        palm: Belief about the palm, or None.
        facing: Belief about the side it shows, or None.
        orientation: The palm's orientation as measured otherwise, or None.
        others: What other sensors say of palm and fingers, or None.
        _rows: (..., 3 N + 3 if facing + 6 if palm, 6 + n) what is the same everywhere of the residuals' Jacobian: by
            the shift, and that of the belief about the palm.
    """

    model: HandModel
    parameters: HandParameters
    markers: Attached
    points_m: Float
    whiten: Float
    prior: AnglePrior
    palm: PalmPrior | None
    facing: Facing | None
    orientation: Orientation | None = None
    others: SensedFree | None = None
    _rows: Float = field(init=False)

    def __post_init__(self) -> None:
        *lead, count, _ = self.points_m.shape
        believed = (0 if self.facing is None else 3) + (0 if self.palm is None else 6)
        rows = np.zeros((*lead, 3 * count + believed, 6 + len(self.parameters.free)))
        rows[..., : 3 * count, 3:6] = self.whiten.reshape(*lead, 3 * count, 3)
        if self.palm is not None:
            np.einsum("...ii->...i", rows[..., -6:, :6])[...] = self.palm.weight
        object.__setattr__(self, "_rows", rows)

    def of_hypothesis(self, which: Int | int) -> "HandProblem":
        """The problem under one hypothesis, or under one for each of several searches (S,)."""
        return replace(self, prior=self.prior.of_hypothesis(which))

    def of_points(self, points_m: Float) -> "HandProblem":
        """The same markers seen elsewhere (N, 3) [m], and nothing believed of the hand."""
        size = len(self.parameters.free)
        nothing = AnglePrior(np.zeros((size, size)), np.zeros(size), np.zeros(()), np.zeros(()))
        return replace(
            self, points_m=points_m, prior=nothing, palm=None, facing=None, orientation=None, others=None
        )

    def place(self, T_rig_palm: Float, x: Float) -> Float:
        """Where the markers (..., N, 3) [m] of hands (..., 4, 4), (..., n) are, rig frame."""
        local = self.markers.place(self.model.chains(self.parameters.angles(x)))
        return local @ np.swapaxes(T_rig_palm[..., :3, :3], -1, -2) + T_rig_palm[..., None, :3, 3]

    def mean_step(self, found: Minimum) -> Float:
        """From the likeliest hand to the mean of those within the limits: turn, shift and angles (6 + n,).

        Straight fingers are no chance: they do rest at their limit, so nothing is piled up there.
        """
        low = np.where(self.parameters.rests, -np.inf, self.parameters.low)
        return mean_within(found.linear.normal, found.linear.gradient, found.x, low, self.parameters.high)

    def marker_end(self, found: Minimum, step: Float) -> Float:
        """Where a step (6 + n,) from there brings the markers (N, 3) [m], as if they moved on straight lines."""
        here = self.place(found.T_rig_palm, found.x)
        if not step.any():
            return here
        return here + (self.place(*moved(found.T_rig_palm, found.x, _LITTLE * step)) - here) / _LITTLE

    def minimise(self, T_rig_palm: Float, x: Float, enough: float = ENOUGH) -> list[Minimum]:
        """For each hypothesis the end of a way downhill from the best of seeds (S, 4, 4), (S, n) in the bounds.

        Which seed is the best is found roughly, under the widest hypothesis, which is the last. A way ends where a
        step gains less than `enough`, and a ten-thousandth of the cost.
        """
        hypotheses, before = len(self.prior.constant), 0
        if len(x) > 1:
            rough = self.of_hypothesis(np.full(len(x), hypotheses - 1))
            T_rig_palm, x, here, before = rough._descend(T_rig_palm, x, max(enough, _ROUGH), rivals=True)
            lowest = int(np.argmin(here.cost))
            T_rig_palm, x = T_rig_palm[lowest], x[lowest]
        T = T_rig_palm.reshape(1, 4, 4).repeat(hypotheses, axis=0)
        x = x.reshape(1, -1).repeat(hypotheses, axis=0)
        T, x, here, iterations = self._descend(T, x, enough, rivals=False)
        return [Minimum(T[h], x[h], here.of(h), before + iterations) for h in range(hypotheses)]

    def _descend(
        self, T: Float, x: Float, enough: float, *, rivals: bool
    ) -> tuple[Float, Float, Linear, int]:
        """From seeds (S, 4, 4), (S, n), each under its own hypothesis, to where no step lowers the cost.

        Of `rivals` only the lowest end counts: a way that does not hope to come below one that has ended stops.
        """
        here, iterations = self.linearise(T, x), 0
        paces = [_Pace(enough) for _ in x]
        while iterations < MAX_ITERATIONS and any(pace.going for pace in paces):
            iterations += 1
            T_new, x_new, hoped = self._step(here, T, x, np.array([pace.damping for pace in paces]))
            costs, gains = here.cost.tolist(), hoped.tolist()
            last = [pace.arrives(*step) for pace, *step in zip(paces, costs, gains, strict=True)]
            T, x = _either(last, T_new, T), _either(last, x_new, x)
            if rivals:
                _give_up(paces, costs, gains)
            if not any(pace.going for pace in paces):
                break
            there = self.linearise(T_new, x_new)
            steps = zip(paces, costs, there.cost.tolist(), gains, strict=True)
            lower = [pace.improves(*step) for pace, *step in steps]
            T, x, here = _either(lower, T_new, T), _either(lower, x_new, x), here.or_where(lower, there)
        return T, x, here, iterations

    def linearise(self, T_rig_palm: Float, x: Float) -> Linear:
        """Cost, gradient and normal matrix at poses (..., 4, 4) and free angles (..., n); leading axes as `prior`."""
        R, lead, count = T_rig_palm[..., :3, :3], x.shape[:-1], self.points_m.shape[-2]
        chains = self.model.chains(self.parameters.angles(x))
        local = self.markers.place(chains)
        arm = local @ R.swapaxes(-1, -2)
        # The whitened markers, then the palm, by turn, shift and angles.
        J = np.empty((*lead, *self._rows.shape[-2:]))
        J[...] = self._rows
        marker = J[..., : 3 * count, :].reshape(*lead, count, 3, 6 + x.shape[-1])  # a view
        np.matmul(self.whiten, skew(-arm), out=marker[..., :3])
        turned = self.whiten @ R[..., None, :, :]
        np.matmul(turned, self.markers.jacobian(chains, local, x), out=marker[..., 6:])
        residual = np.empty(J.shape[:-1])
        off = arm + (T_rig_palm[..., None, :3, 3] - self.points_m)
        np.matmul(self.whiten, off[..., None], out=residual[..., : 3 * count].reshape(*lead, count, 3, 1))
        if self.facing is not None:
            at = slice(3 * count, 3 * count + 3)
            residual[..., at], J[..., at, :3] = self.facing.rows(R)
        if self.palm is not None:
            residual[..., -6:] = self.palm.off(T_rig_palm)
        J_t = J.swapaxes(-1, -2)
        gradient, normal = (J_t @ residual[..., None])[..., 0], J_t @ J
        normal[..., 6:, 6:] += self.prior.normal
        cost, prior_gradient = self.prior.cost_and_gradient(x)
        gradient[..., 6:] += prior_gradient
        cost = cost + 0.5 * np.vecdot(residual, residual)
        if self.orientation is not None:
            cost = cost + self.orientation.add_to(R, gradient, normal)
        if self.others is not None:
            cost = cost + self.others.add_to(R, x, gradient, normal)
        return Linear(cost, gradient, normal)

    def palm_cost(self, T_rig_palm: Float) -> float:
        """What a palm (4, 4) costs by the belief about it."""
        return 0.0 if self.palm is None else self.palm.cost(T_rig_palm)

    def _step(self, here: Linear, T: Float, x: Float, damping: Float) -> tuple[Float, Float, Float]:
        """The next poses (S, 4, 4) and angles (S, n), and how much lower the cost (S,) should be there."""
        low, high = self.parameters.low, self.parameters.high
        damped, downhill = here.normal.copy(), -here.gradient
        seeds, size = downhill.shape
        diagonal = damped.reshape(seeds, -1)[:, :: size + 1]  # a view
        diagonal *= 1.0 + damping[:, None]
        pulled = downhill[:, 6:]
        stays = np.where(pulled < 0.0, x <= low, x >= high)
        if stays.any():  # its row and column become those of a parameter that nothing moves
            moves = np.ones(downhill.shape)
            moves[:, 6:] -= stays
            damped *= moves[:, :, None]
            damped *= moves[:, None, :]
            diagonal += 1.0 - moves
            downhill *= moves
        step = np.asarray(np.linalg.solve(damped, downhill[..., None])[..., 0], np.float64)
        T_new, x_new = moved(T, x, step)
        return T_new, np.minimum(np.maximum(x_new, low), high), 0.5 * np.vecdot(downhill, step)


def moved(T_rig_palm: Float, x: Float, step: Float) -> tuple[Float, Float]:
    """Poses (..., 4, 4) and angles (..., n) after steps (..., 6 + n) of turn [rad], shift [m] and angles [rad]."""
    T = T_rig_palm.copy()
    T[..., :3, :3] = rotation_vector_to_matrix(step[..., :3]) @ T[..., :3, :3]
    T[..., :3, 3] += step[..., 3:6]
    return T, x + step[..., 6:]


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


def _give_up(paces: list[_Pace], costs: list[float], hoped: list[float]) -> None:
    """End the ways whose own model of the cost lies above the end of another."""
    lowest = min((cost for pace, cost in zip(paces, costs, strict=True) if not pace.going), default=np.inf)
    for pace, cost, gain in zip(paces, costs, hoped, strict=True):
        pace.going = pace.going and cost - gain <= lowest


def _either(use: list[bool], one: Float, other: Float) -> Float:
    """Row by row (S, ...): `one` where `use` (S,) is true, else the other."""
    if all(use):
        return one
    return np.where(np.array(use).reshape(-1, *[1] * (one.ndim - 1)), one, other) if any(use) else other
