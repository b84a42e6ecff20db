"""The adjustment engine: shared unknowns, and own unknowns of each epoch.

A calibration minimises a sum of squared residuals, outliers weighed down by a robust loss, over S shared
unknowns (lenses, bones, a mounting) and L own unknowns of each of T epochs (the pose of a board, a hand, the
coefficients of a curve at a knot). A row touches only those of one epoch, or of a few that follow each other, so
these are eliminated by a band's Cholesky factors, and the Schur complement that is left is the information about
the shared ones (Triggs et al., Bundle adjustment - a modern synthesis, 2000, section 6). Steps are those of
Levenberg and Marquardt.

A calibration is a function `equations(x) -> Normal`, which adds its rows and priors, and a function
`stepped(x, shared, own) -> x`, which applies a step to its own kind of unknowns (rotations turn, numbers add).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from scipy.linalg import solveh_banded  # pyright: ignore[reportUnknownVariableType]
from scipy.sparse import csr_array

from common.arrays import Bool, Float, Int
from common.geometry.transforms import rotation_vector_to_matrix

X = TypeVar("X")
Loss = Callable[[Float], tuple[Float, Float]]
"""Of chi squares (...): what they cost, and the weight (...) of their residuals, the derivative of that."""


def huber(sigmas: float) -> Loss:
    """Huber's loss: beyond that many standard deviations the cost is linear."""

    def loss(chi2: Float) -> tuple[Float, Float]:
        weight = np.minimum(1.0, sigmas / np.sqrt(np.maximum(chi2, 1e-12)))
        return np.where(weight < 1.0, 2.0 * sigmas * np.sqrt(chi2) - sigmas**2, chi2), weight

    return loss


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
        own: (W, T, L, L): [d, t] couples the own unknowns of epochs t + d (rows) and t (columns).
        mixed, own_gradient: (T, L, S) and (T, L) of the own unknowns.
    """

    def __init__(self, shared: int, epochs: int = 0, own: int = 0, reach: int = 1) -> None:
        """No rows yet; a row touches own unknowns of `reach` neighbouring epochs (W)."""
        self.cost = 0.0
        self.shared: Float = np.zeros((shared, shared))
        self.gradient: Float = np.zeros(shared)
        self.own: Float = np.zeros((reach, epochs, own, own))
        self.mixed: Float = np.zeros((epochs, own, shared))
        self.own_gradient: Float = np.zeros((epochs, own))

    def add(
        self,
        residual: Float,
        shared: Float,
        own: Float | None = None,
        *,
        epochs: Int | slice = slice(None),
        weights: Float | None = None,
        columns: Int | slice = slice(None),
        loss: Loss | None = None,
        group: int = 1,
        share: Float | float = 1.0,
    ) -> None:
        """Add rows, whitened, of some epochs.

        Args:
            residual: (E, R) predicted minus observed, in standard deviations; NaN: not observed.
            shared: (E, R, C) derivatives by the shared unknowns `columns`.
            own: (E, R, L) derivatives by the own unknowns of `epochs` (E,).
            weights: (E, W) by which `own` is the derivative by those of the W epochs from `epochs` on, as of the
                coefficients of a spline; None: 1, by the epoch alone.
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
        if own is None:
            return
        back = np.swapaxes(np.where(root > 0.0, own * root, 0.0), 1, 2)
        square, cross = back @ np.swapaxes(back, 1, 2), back @ heavy
        weights = np.ones((count, 1)) if weights is None else weights
        every: Int = np.arange(self.own.shape[1], dtype=np.int64)
        first, width = every[epochs], weights.shape[1]
        for d in range(width):
            self.own[d] += self._summed(first, weights[:, : width - d] * weights[:, d:], square)
        self.own_gradient += self._summed(first, weights, (back @ residual[..., None])[..., 0])
        self.mixed[..., columns] += self._summed(first, weights, cross)

    def _summed(self, first: Int, weights: Float, values: Float) -> Float:
        """Weighted sums (T, ...) of values (E, ...) that count from epochs `first` on."""
        epochs: Int = first[:, None] + np.arange(weights.shape[1], dtype=np.int64)
        rows = np.broadcast_to(np.arange(len(first))[:, None], epochs.shape)
        shape = len(self.own_gradient), len(first)
        gather = csr_array((weights.ravel(), (epochs.ravel(), rows.ravel())), shape=shape)
        total = np.asarray(gather @ values.reshape(len(first), -1), np.float64)
        return total.reshape(-1, *values.shape[1:])

    def hold(self, held: Bool) -> None:
        """Keep own unknowns (T, L) in the next step, as an angle at its limit."""
        moves = np.where(held, 0.0, 1.0)
        for d, blocks in enumerate(self.own):
            blocks[: len(moves) - d] *= moves[d:, :, None] * moves[: len(moves) - d, None, :]
        np.einsum("tii->ti", self.own[0])[...] += held
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
            LinAlgError: The own unknowns' equations cannot be solved.
        """
        size, (count, length) = len(self.gradient), self.own_gradient.shape
        information = self.shared + damping * np.diag(np.diag(self.shared))
        if not count:
            return information, self.gradient, self.mixed, self.own_gradient
        sides = np.concatenate([self.mixed, self.own_gradient[..., None]], axis=-1).reshape(-1, size + 1)
        solved = np.asarray(
            solveh_banded(self._band(damping), sides, lower=True, check_finite=False), np.float64
        )
        back = sides[:, :size].T @ solved
        solved = solved.reshape(count, length, size + 1)
        return (
            information - back[:, :size],
            self.gradient - back[:, size],
            solved[..., :size],
            solved[..., size],
        )

    def _band(self, damping: float) -> Float:
        """The own unknowns' information, damped.

        (W L, T L): row i of column j is [j + i, j] of the matrix.
        """
        reach, count, length, _ = self.own.shape
        out = np.zeros((reach * length, count, length))
        for d, blocks in enumerate(self.own):
            row, column = np.nonzero(np.tri(length) if d == 0 else np.ones((length, length)))
            out[d * length + row - column, :, column] = blocks[:, row, column].T
        nothing = 1e-9  # information of what nothing constrains
        out[0] += damping * out[0] + nothing
        return out.reshape(reach * length, count * length)

    def step(self, damping: float) -> tuple[Float, Float] | None:
        """Marquardt's step of shared (S,) and own unknowns (T, L); None: more damping."""
        try:
            information, gradient, by_shared, by_own = self.eliminated(damping)
            # To a unit diagonal: pixels, radians and metres differ by orders of magnitude.
            scale = _unit_scale(information if damping == 0.0 else self.shared)
            scaled = information * scale[:, None] * scale
            step = -scale * np.asarray(np.linalg.solve(scaled, gradient * scale), np.float64)
        except np.linalg.LinAlgError:
            return None
        return step, -by_own - by_shared @ step

    def predicted_gain(self, shared: Float, own: Float, damping: float) -> float:
        """By how much a step of this damping would lower the cost if all were linear."""
        on = np.einsum("tii->ti", self.own[0])
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
