"""Kernels for small symmetric matrices."""

from math import sqrt

import numpy as np

from common.arrays import Bool, Float
from common.kernels import inner, kernel

_SWEEPS, _NOTHING = 30, 1e-36  # of Jacobi; squares of what is beside the diagonal, by those on it


@kernel
def factor(A: Float, held: Bool, L: Float) -> bool:
    """Write Cholesky's factor of A (n, n); False where it is not positive definite.

    Without the `held` unknowns.
    """
    n = A.shape[0]
    for j in range(n):
        total = 1.0 if held[j] else A[j, j]
        for k in range(j):
            total -= L[j, k] * L[j, k]
        if not total > 0.0:
            return False
        L[j, j] = sqrt(total)
        for i in range(j + 1, n):
            total = 0.0 if held[i] or held[j] else A[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            L[i, j] = total / L[j, j]
    return True


@kernel
def substitute(L: Float, b: Float, held: Bool, out: Float) -> None:
    """Write the solution (n,) of L L' out = b, `held` unknowns 0."""
    n = b.shape[0]
    for i in range(n):
        total = 0.0 if held[i] else b[i]
        for k in range(i):
            total -= L[i, k] * out[k]
        out[i] = total / L[i, i]
    for i in range(n - 1, -1, -1):
        total = out[i]
        for k in range(i + 1, n):
            total -= L[k, i] * out[k]
        out[i] = total / L[i, i]


@kernel
def inverse(A: Float, scale: float, out: Float) -> bool:
    """Write scale times the inverse of A (n, n); False: not positive definite.

    Then `out` means nothing.
    """
    n = A.shape[0]
    L, one, column = np.zeros((n, n)), np.zeros(n), np.empty(n)
    free = np.zeros(n, np.bool_)
    if not factor(A, free, L):
        return False
    for j in range(n):
        one[j] = scale
        substitute(L, one, free, column)
        one[j] = 0.0
        for i in range(n):
            out[i, j] = column[i]
    return True


@kernel
def inverse_3(A: Float, extra: float, out: Float) -> None:
    """Write the inverse (3, 3) of symmetric A + `extra` I, by cofactors."""
    a, b, c = A[0, 0] + extra, A[0, 1], A[0, 2]
    d, e, f = A[1, 1] + extra, A[1, 2], A[2, 2] + extra
    out[0, 0], out[0, 1], out[0, 2] = d * f - e * e, c * e - b * f, b * e - c * d
    out[1, 1], out[1, 2], out[2, 2] = a * f - c * c, b * c - a * e, a * d - b * b
    determinant = a * out[0, 0] + b * out[0, 1] + c * out[0, 2]
    for i in range(3):
        for j in range(i, 3):
            out[i, j] /= determinant
            out[j, i] = out[i, j]


@kernel
def diagonalise(A: Float, V: Float) -> None:
    """Turn symmetric A (n, n) into its eigenvalues, V into its eigenvectors.

    The eigenvalues come to stand on the diagonal of A, unsorted, the eigenvectors in the columns of V (cyclic Jacobi:
    Golub, Van Loan, Matrix Computations, 8.5). Only the lower triangle of A is read. NaN stays NaN.
    """
    n = A.shape[0]
    for i in range(n):
        for j in range(n):
            V[i, j] = 1.0 if i == j else 0.0
    for _ in range(_SWEEPS):
        off, on = 0.0, 0.0
        for i in range(n):
            on += A[i, i] * A[i, i]
            for j in range(i):
                off += A[i, j] * A[i, j]
        if not off > _NOTHING * on:
            return
        for q in range(1, n):
            for p in range(q):
                _rotate(A, V, p, q)


@inner
def _rotate(A: Float, V: Float, p: int, q: int) -> None:
    """Turn axes p < q by what makes A[q, p] zero."""
    n, a = A.shape[0], A[q, p]
    if a == 0.0:
        return
    half = 0.5 * (A[q, q] - A[p, p]) / a
    t = 1.0 / (abs(half) + sqrt(half * half + 1.0))
    t = -t if half < 0.0 else t
    c = 1.0 / sqrt(t * t + 1.0)
    s = t * c
    for k in range(n):
        if k not in (p, q):
            i, j = max(k, p), min(k, p)
            m, o = max(k, q), min(k, q)
            x, y = A[i, j], A[m, o]
            A[i, j], A[m, o] = c * x - s * y, s * x + c * y
        x, y = V[k, p], V[k, q]
        V[k, p], V[k, q] = c * x - s * y, s * x + c * y
    A[p, p] -= t * a
    A[q, q] += t * a
    A[q, p] = 0.0


@kernel
def spread(A: Float) -> tuple[float, float]:
    """Return the standard deviations of covariance A (3, 3), least and greatest.

    Those along its axes; 0 for an eigenvalue below 0.
    """
    D, V = A.copy(), np.empty((3, 3))
    diagonalise(D, V)
    a, b, c = D[0, 0], D[1, 1], D[2, 2]
    return sqrt(max(min(a, b, c), 0.0)), sqrt(max(a, b, c, 0.0))
