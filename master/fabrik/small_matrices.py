"""Kernels for small symmetric matrices."""

from math import sqrt

import numpy as np

from common.arrays import Bool, Float
from common.kernels import kernel


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
