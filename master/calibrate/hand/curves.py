"""Least squares over smooth curves and a few constants.

All angles and the palm's pose are uniform cubic B-splines (trajectory estimation in continuous time: Furgale,
Barfoot & Sibley, ICRA 2012), so frames need no common rate and no averaging. The normal matrix is a band of
blocks for the coefficients with a border for the constants; the band is eliminated block by block (Cholesky),
and the Schur complement that is left is the information about the constants alone.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from common.arrays import Float, Int

_WIDTH = 4  # coefficients that one epoch depends on


@dataclass(frozen=True, slots=True, eq=False)
class Knots:
    """Uniform cubic B-splines over T epochs."""

    spacing_s: float  # between coefficients [s]
    time_s: Float  # (K,) middle of each coefficient's bump [s]
    first: Int  # (T,) first of the four coefficients of each epoch
    weight: Float  # (T, 4) theirs; they add up to one

    @classmethod
    def over(cls, t_s: Float, spacing_s: float) -> "Knots":
        """Knots that cover rising times (T,) [s]."""
        x = (t_s - t_s[0]) / spacing_s
        first = np.floor(x).astype(np.int64)
        u = x - first
        weight = np.stack(
            [(1 - u) ** 3, 3 * u**3 - 6 * u**2 + 4, -3 * u**3 + 3 * u**2 + 3 * u + 1, u**3], axis=1
        )
        count = int(first[-1]) + _WIDTH
        return cls(spacing_s, t_s[0] + spacing_s * (np.arange(count) - 1.0), first, weight / 6.0)

    def at(self, coefficients: Float) -> Float:
        """Values (T, n) of curves with coefficients (K, n)."""
        picked = coefficients[self.first[:, None] + np.arange(_WIDTH)]
        return np.einsum("tw,twn->tn", self.weight, picked)

    def gathered(self, distance: int) -> csr_array:
        """Weight products (K, T) of coefficients k and k + distance at each epoch."""
        rows = self.first[:, None] + np.arange(_WIDTH - distance)
        value = self.weight[:, : _WIDTH - distance] * self.weight[:, distance:]
        return self._sparse(rows, value)

    def gathered_once(self) -> csr_array:
        """(K, T): the weights."""
        return self._sparse(self.first[:, None] + np.arange(_WIDTH), self.weight)

    def _sparse(self, rows: Int, value: Float) -> csr_array:
        columns = np.broadcast_to(np.arange(len(self.first))[:, None], rows.shape)
        shape = (len(self.time_s), len(self.first))
        return csr_array((value.ravel(), (rows.ravel(), columns.ravel())), shape=shape)


class BorderedNormal:
    """Normal equations of K * n coefficients and g constants, as added so far.

    Attributes:
        band: (K, 4, n, n) blocks: [k, d] couples coefficients k + d (row) and k (column).
        border, corner: (K, n, g) and (g, g).
        pull, pull_constants: (K, n) and (g,), minus the gradient.
    """

    def __init__(self, count: int, channels: int, constants: int) -> None:
        self.band: Float = np.zeros((count, _WIDTH, channels, channels))
        self.border: Float = np.zeros((count, channels, constants))
        self.corner: Float = np.zeros((constants, constants))
        self.pull: Float = np.zeros((count, channels))
        self.pull_constants: Float = np.zeros(constants)

    def add_epochs(self, knots: Knots, jacobian: Float, by_constants: Float, off: Float) -> None:
        """Add residuals of every epoch.

        Jacobians (T, r, n) by the curves and (T, r, g) by the constants, and off = observed less predicted
        (T, r), whitened.
        """
        flipped = np.swapaxes(jacobian, -1, -2)
        count, n, g = len(self.pull), jacobian.shape[-1], by_constants.shape[-1]
        square = (flipped @ jacobian).reshape(len(off), -1)
        for d in range(_WIDTH):
            self.band[:, d] += (knots.gathered(d) @ square)[:count].reshape(-1, n, n)
        once = knots.gathered_once()
        self.border += (once @ (flipped @ by_constants).reshape(len(off), -1)).reshape(-1, n, g)
        self.pull += once @ (flipped @ off[..., None])[..., 0]
        flat = by_constants.reshape(-1, g)
        self.corner += flat.T @ flat
        self.pull_constants += flat.T @ off.ravel()

    def add_links(self, jacobian: Float, by_constants: Float, off: Float) -> None:
        """Add residuals that each couple two neighbouring coefficients.

        Jacobians (K - 1, r, 2, n) by coefficients k and k + 1, (K - 1, r, g) by constants; off (K - 1, r).
        """
        now, then = jacobian[:, :, 0], jacobian[:, :, 1]
        now_t, then_t = np.swapaxes(now, -1, -2), np.swapaxes(then, -1, -2)
        self.band[:-1, 0] += now_t @ now
        self.band[1:, 0] += then_t @ then
        self.band[:-1, 1] += then_t @ now
        self.border[:-1] += now_t @ by_constants
        self.border[1:] += then_t @ by_constants
        self.pull[:-1] += (now_t @ off[..., None])[..., 0]
        self.pull[1:] += (then_t @ off[..., None])[..., 0]
        flat = by_constants.reshape(-1, by_constants.shape[-1])
        self.corner += flat.T @ flat
        self.pull_constants += flat.T @ off.ravel()

    def solve(self, damping: float) -> tuple[Float, Float, Float]:
        """Steps (K, n) of coefficients, (g,) of constants; information (g, g) on these.

        `damping` is added, as a share, to the diagonal (Marquardt).
        """
        count, n, g = self.border.shape
        sides = np.zeros((-(-count // 3), 3 * n, g + 1))  # of three coefficients, noughts behind
        given = np.concatenate([self.border, self.pull[..., None]], axis=-1)
        sides.reshape(-1, g + 1)[: count * n] = given.reshape(count * n, g + 1)
        solved = _solve_tridiagonal(*self._blocks(damping), sides)
        solved = solved.reshape(-1, g + 1)[: count * n]
        across, own_step = solved[:, :g], solved[:, g]
        border = self.border.reshape(-1, g)
        information = self.corner - border.T @ across
        damped = information + damping * np.diag(np.diag(self.corner))
        right = self.pull_constants - border.T @ own_step
        constants = np.asarray(np.linalg.solve(damped, right), np.float64)
        return (own_step - across @ constants).reshape(count, n), constants, information

    def _blocks(self, damping: float) -> tuple[Float, Float]:
        """The band as tridiagonal blocks (B, 3n, 3n) of three coefficients, on and below."""
        count, _, n, _ = self.band.shape
        blocks = -(-count // 3)
        band = np.zeros((3 * blocks + 3, *self.band.shape[1:]))
        band[:count] = self.band
        band[count : 3 * blocks, 0] = np.eye(n)  # of the last block what is not there
        band[:, 0] += np.eye(n) * (damping * band[:, 0] + 1e-9)
        on, below = np.zeros((2, blocks, 3, n, 3, n))
        for row in range(3):
            for column in range(3):
                if row >= column:
                    on[:, row, :, column] = band[column : 3 * blocks : 3, row - column]
                    on[:, column, :, row] = np.swapaxes(on[:, row, :, column], -1, -2)
                if row <= column:
                    below[:, row, :, column] = band[column : 3 * blocks : 3, row - column + 3]
        size = 3 * n
        return on.reshape(blocks, size, size), below.reshape(blocks, size, size)


def _solve_tridiagonal(on: Float, below: Float, sides: Float) -> Float:
    """Solution (B, s, r) of a positive definite block-tridiagonal system (Cholesky).

    On and below the diagonal (B, s, s): below[i] stands in row i + 1, column i, the last is not used; sides
    (B, s, r).
    """
    inverses: list[Float] = []
    links: list[Float] = []
    half: list[Float] = []
    for i in range(len(on)):
        square: Float = on[i]
        side: Float = sides[i]
        if i:
            square = square - links[-1] @ links[-1].T
            side = side - links[-1] @ half[-1]
        lower = np.asarray(np.linalg.cholesky(square), np.float64)
        inverse = np.asarray(np.linalg.inv(lower), np.float64)  # small blocks, well scaled
        inverses.append(inverse)
        half.append(inverse @ side)
        links.append(below[i] @ inverse.T)
    out = np.empty(sides.shape)
    out[-1] = inverses[-1].T @ half[-1]
    for i in range(len(on) - 2, -1, -1):
        out[i] = inverses[i].T @ (half[i] - links[i].T @ out[i + 1])
    return out
