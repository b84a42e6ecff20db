"""The adjustment engine: shared unknowns, and own unknowns of each epoch.

A calibration minimises a sum of squared residuals, outliers weighed down by a robust loss, over S shared
unknowns (lenses, bones, a mounting) and L own unknowns of each of T epochs (the pose of a board, a hand). An
epoch touches only its own unknowns, so these are eliminated by a sparse factorisation, and the Schur complement
that is left is the information about the shared ones (Triggs et al., Bundle adjustment - a modern synthesis,
2000, section 6). Steps are those of Levenberg and Marquardt.

A calibration is a function `equations(x) -> Normal`, which adds its rows and priors, and a function
`stepped(x, shared, own) -> x`, which applies a step to its own kind of unknowns (rotations turn, numbers add).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar, cast

import numpy as np
from scipy.sparse import bsr_array, csc_array
from scipy.sparse.linalg import splu  # pyright: ignore[reportUnknownVariableType]

from common.arrays import Bool, Float, Int
from common.geometry.transforms import rotation_vector_to_matrix

X = TypeVar("X")
Loss = Callable[[Float], tuple[Float, Float]]
"""Of chi squares (...): what they cost, and the weight (...) of their residuals, the derivative of that."""


def cauchy(sigmas: float) -> Loss:
    """Cauchy's loss: at that many standard deviations a residual counts a half."""
    return lambda chi2: (sigmas**2 * np.log1p(chi2 / sigmas**2), 1.0 / (1.0 + chi2 / sigmas**2))


def geman_mcclure(sigmas: float) -> Loss:
    """Geman and McClure's loss: the cost of a residual is bounded."""

    def loss(chi2: Float) -> tuple[Float, Float]:
        share = 1.0 / (1.0 + chi2 / sigmas**2)
        return chi2 * share, share**2

    return loss


def tukey(sigmas: float) -> Loss:
    """Tukey's biweight: beyond that many sigmas a residual does not count."""

    def loss(chi2: Float) -> tuple[Float, Float]:
        near = np.clip(1.0 - chi2 / sigmas**2, 0.0, 1.0)
        return sigmas**2 / 3.0 * (1.0 - near**3), near**2

    return loss


def weigh(residual: Float, loss: Loss | None, group: int, share: Float | float = 1.0) -> tuple[float, Float]:
    """Cost and weights (E, R) of residuals (E, R), as of `Normal.add`."""
    count = len(residual)
    known = np.isfinite(residual)
    chi2 = (np.where(known, residual, 0.0).reshape(count, -1, group) ** 2).sum(axis=-1)
    cost, weight = (chi2, np.ones_like(chi2)) if loss is None else loss(chi2)
    share = np.broadcast_to(np.asarray(share, np.float64), (count,))
    root = np.sqrt(share[:, None] * np.repeat(weight, group, axis=1)) * known
    return float((share * cost.sum(axis=-1)).sum()), root


class Normal:
    """Normal equations of S shared unknowns, and L own unknowns of each of T epochs.

    Attributes:
        cost: Sum of the losses; without a robust loss, chi square.
        shared, gradient: (S, S) information and (S,) half the gradient of the cost.
        own, mixed, own_gradient: (T, L, L), (T, L, S) and (T, L) of the own unknowns.
    """

    def __init__(self, shared: int, epochs: int = 0, own: int = 0) -> None:
        self.cost = 0.0
        self.shared: Float = np.zeros((shared, shared))
        self.gradient: Float = np.zeros(shared)
        self.own: Float = np.zeros((epochs, own, own))
        self.mixed: Float = np.zeros((epochs, own, shared))
        self.own_gradient: Float = np.zeros((epochs, own))

    def add(
        self,
        residual: Float,
        shared: Float,
        own: Float | None = None,
        *,
        epochs: Int | slice = slice(None),
        columns: Int | slice = slice(None),
        loss: Loss | None = None,
        group: int = 1,
        share: Float | float = 1.0,
    ) -> None:
        """Add rows, whitened, of some epochs.

        Args:
            residual: (E, R) predicted minus observed, in standard deviations; NaN: not observed.
            shared: (E, R, C) derivatives by the shared unknowns `columns`.
            own: (E, R, L) derivatives by the own unknowns of `epochs` (E,), each at most once.
            columns: The C shared unknowns that these rows depend on, each once.
            loss: Robust loss of each `group` of neighbouring residuals, such as both coordinates of a point.
            share: (E,) what an epoch counts, where neighbours in time share their errors.
        """
        count, rows = residual.shape
        cost, root = weigh(residual, loss, group, share)
        self.cost += cost
        residual, root = np.nan_to_num(residual) * root, root[..., None]
        heavy = np.where(root > 0.0, shared * root, 0.0)
        flat = heavy.reshape(count * rows, -1)
        at = columns if isinstance(columns, slice) else np.ix_(columns, columns)
        self.shared[(at, at) if isinstance(at, slice) else at] += flat.T @ flat
        self.gradient[columns] += flat.T @ residual.ravel()
        if own is not None:
            back = np.swapaxes(np.where(root > 0.0, own * root, 0.0), 1, 2)
            self.own[epochs] += back @ np.swapaxes(back, 1, 2)
            self.own_gradient[epochs] += (back @ residual[..., None])[..., 0]
            cross = back @ heavy
            if isinstance(columns, slice):
                self.mixed[epochs, :, columns] += cross
            else:
                mixed = self.mixed[epochs]
                mixed[..., columns] += cross
                self.mixed[epochs] = mixed

    def hold(self, held: Bool) -> None:
        """Keep own unknowns (T, L) in the next step, as an angle at its limit."""
        moves = np.where(held, 0.0, 1.0)
        self.own *= moves[:, :, None] * moves[:, None, :]
        np.einsum("tii->ti", self.own)[...] += held
        self.mixed *= moves[..., None]
        self.own_gradient *= moves

    def add_prior(self, away: Float, sigma: Float) -> None:
        """Add a prior of the shared unknowns: `away` (S,) from its mean, `sigma` (S,)."""
        info = sigma**-2.0
        self.cost += float((away**2 * info).sum())
        self.shared[np.diag_indices_from(self.shared)] += info
        self.gradient += away * info

    def eliminated(self, damping: float = 0.0) -> tuple[Float, Float, Float, Float]:
        """The equations without the own unknowns.

        Returns:
            Information (S, S) and half the gradient (S,) of the shared unknowns; and (T, L, S), (T, L): the
            own unknowns' step is -(the second) - (the first) @ (step of the shared).

        Raises:
            RuntimeError: The own unknowns' equations cannot be solved.
        """
        size, (count, length) = len(self.gradient), self.own_gradient.shape
        information = self.shared + damping * np.diag(np.diag(self.shared))
        if not count:
            return information, self.gradient, self.mixed, self.own_gradient
        sides = np.concatenate([self.mixed, self.own_gradient[..., None]], axis=-1).reshape(-1, size + 1)
        # Positive definite, and in the order of time: no pivots, little fill.
        how = {"permc_spec": "NATURAL", "diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}
        solved = np.asarray(cast(Any, splu)(self._matrix(damping), **how).solve(sides), np.float64)
        back = sides[:, :size].T @ solved
        solved = solved.reshape(count, length, size + 1)
        return (
            information - back[:, :size],
            self.gradient - back[:, size],
            solved[..., :size],
            solved[..., size],
        )

    def _matrix(self, damping: float) -> csc_array:
        """The own unknowns' information (T L, T L), damped."""
        count, length = self.own_gradient.shape
        nothing = 1e-9  # information of what nothing constrains
        blocks = self.own + np.eye(length) * (damping * self.own + nothing)
        shape, at = (count * length, count * length), np.arange(count + 1, dtype=np.int64)
        return csc_array(bsr_array((blocks, at[:-1], at), shape=shape))

    def step(self, damping: float) -> tuple[Float, Float] | None:
        """Marquardt's step of shared (S,) and own unknowns (T, L); None: more damping."""
        try:
            information, gradient, by_shared, by_own = self.eliminated(damping)
            # To a unit diagonal: pixels, radians and metres differ by orders of magnitude.
            scale = _unit_scale(information if damping == 0.0 else self.shared)
            scaled = information * scale[:, None] * scale
            step = -scale * np.asarray(np.linalg.solve(scaled, gradient * scale), np.float64)
        except (RuntimeError, np.linalg.LinAlgError):
            return None
        return step, -by_own - by_shared @ step

    def predicted_gain(self, shared: Float, own: Float, damping: float) -> float:
        """By how much a step of this damping would lower the cost if all were linear."""
        on = np.einsum("tii->ti", self.own)
        squares = np.diag(self.shared) @ shared**2 + float((on * own**2).sum())
        return float(damping * squares - self.gradient @ shared - (self.own_gradient * own).sum())

    def covariance(self, basis: Float | None = None) -> Float:
        """Covariance (S, S) of the shared unknowns, where residuals have unit variance.

        What nothing determines has an enormous variance, large enough to be refused.

        Args:
            basis: (S, S') the steps that count, where others, such as the choice of a frame, change nothing
                (inner constraints; Triggs et al. 2000, section 9.2.2).
        """
        information = self.eliminated()[0]
        if basis is not None:
            information = basis.T @ information @ basis
        scale = _unit_scale(information)
        values, vectors = np.linalg.eigh(information * scale[:, None] * scale)
        inverse = (vectors / np.maximum(values, 1e-12)) @ vectors.T * scale[:, None] * scale
        return inverse if basis is None else basis @ inverse @ basis.T


def stepped_poses(T: Float, step: Float) -> Float:
    """Poses (..., 4, 4) after steps (..., 6): turned [rad] from the left, moved [m]."""
    out = T.copy()
    out[..., :3, :3] = rotation_vector_to_matrix(step[..., :3]) @ T[..., :3, :3]
    out[..., :3, 3] += step[..., 3:6]
    return out


def _unit_scale(information: Float) -> Float:
    return 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-30))


@dataclass(frozen=True, slots=True, eq=False)
class Minimum(Generic[X]):
    """Where an adjustment came to rest."""

    x: X
    normal: Normal  # the equations there
    steps: int  # steps taken
    settled: bool  # False: it would have gone on


def minimise(
    equations: Callable[[X], Normal],
    stepped: Callable[[X, Float, Float], X],
    x: X,
    *,
    steps: int = 100,
    gain: float = 0.0,
    gain_share: float = 1e-8,
    progress: Callable[[float], None] = lambda share: None,
) -> Minimum[X]:
    """Levenberg and Marquardt's minimum from a first guess.

    A step is taken when the cost falls. It has settled when a step gains no more than `gain`, or that share of
    the cost, or when no step gains anything.
    """
    normal, damping, harder, taken = equations(x), 1e-3, 2.0, 0
    while taken < steps:
        step = normal.step(damping)
        tried = None if step is None else stepped(x, *step)
        after = None if tried is None else equations(tried)
        if step is not None and tried is not None and after is not None and after.cost <= normal.cost:
            gained = normal.cost - after.cost  # the comparison is False where it is NaN
            ratio = gained / max(normal.predicted_gain(*step, damping), 1e-300)
            # Nielsen, Damping parameter in Marquardt's method, 1999
            damping, harder = max(damping * max(1.0 / 8.0, 1.0 - (2.0 * ratio - 1.0) ** 3), 1e-10), 2.0
            x, normal, taken = tried, after, taken + 1
            progress(min(taken / 15.0, 0.99))
            if gained <= max(gain, gain_share * normal.cost):
                return Minimum(x, normal, taken, settled=True)
        else:
            damping, harder = damping * harder, 2.0 * harder
            if damping > 1e8:
                return Minimum(x, normal, taken, settled=True)
    return Minimum(x, normal, taken, settled=False)
