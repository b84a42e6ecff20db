"""Linear algebra of kernels: vectors, rotations and symmetric matrices.

Single vectors (x, y, z) and rotations (three rows) are tuples: they stay in registers where the code is
compiled, and on one vector an array operation would cost ten times the arithmetic where it is not.
"""

from math import cos, log, sin, sqrt

import numpy as np

from common.arrays import Float
from common.kernels import inlined, inner, kernel
from master.fabrik.settings import FABRIK

Vector = tuple[float, float, float]
Matrix = tuple[Vector, Vector, Vector]

IDENTITY: Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@kernel
def dot(a: Vector, b: Vector) -> float:
    """Scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel
def cross(a: Vector, b: Vector) -> Vector:
    """Vector product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@kernel
def length(a: Vector) -> float:
    """Euclidean norm."""
    return sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])


@kernel
def minus(a: Vector, b: Vector) -> Vector:
    """Difference a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@inner
def plus(a: Vector, b: Vector) -> Vector:
    """Sum a + b."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@kernel
def rotate(m: Matrix, v: Vector) -> Vector:
    """Product m v."""
    return dot(m[0], v), dot(m[1], v), dot(m[2], v)


@inner
def transposed(m: Matrix) -> Matrix:
    """Inverse m^T of a rotation."""
    a, b, c = m
    return (a[0], b[0], c[0]), (a[1], b[1], c[1]), (a[2], b[2], c[2])


@kernel
def rotate_back(m: Matrix, v: Vector) -> Vector:
    """Product m^T v."""
    a, b, c = m
    x, y, z = v
    return (a[0] * x + b[0] * y + c[0] * z, a[1] * x + b[1] * y + c[1] * z, a[2] * x + b[2] * y + c[2] * z)


@kernel
def product(m: Matrix, n: Matrix) -> Matrix:
    """Product m n."""
    return rotate_back(n, m[0]), rotate_back(n, m[1]), rotate_back(n, m[2])


@kernel
def rotation_about(axis: Vector, angle: float) -> Matrix:
    """Rotation by `angle` [rad] about a unit vector (Rodrigues)."""
    x, y, z = axis
    c, s = cos(angle), sin(angle)
    k = 1.0 - c
    return (
        (c + k * x * x, k * x * y - s * z, k * x * z + s * y),
        (k * x * y + s * z, c + k * y * y, k * y * z - s * x),
        (k * x * z - s * y, k * y * z + s * x, c + k * z * z),
    )


@kernel
def between(a: Vector, b: Vector) -> Matrix:
    """Shortest rotation from direction a to b; identity where either has none."""
    scale = length(a) * length(b)
    tiny = 1e-18
    if not scale > tiny:
        return ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    x, y, z = cross(a, b)
    x, y, z = x / scale, y / scale, z / scale
    c = dot(a, b) / scale
    if c < -1.0 + 1e-12:
        return _half_rotation_across(a)
    k = 1.0 / (1.0 + c)
    return (
        (c + k * x * x, k * x * y - z, k * x * z + y),
        (k * x * y + z, c + k * y * y, k * y * z - x),
        (k * x * z - y, k * y * z + x, c + k * z * z),
    )


@inner
def _half_rotation_across(a: Vector) -> Matrix:
    """Half a turn about an axis across a, and across the coordinate least in a."""
    across = (1.0, 0.0, 0.0)
    if abs(a[1]) < abs(a[0]) and abs(a[1]) <= abs(a[2]):
        across = (0.0, 1.0, 0.0)
    elif abs(a[2]) < abs(a[0]):
        across = (0.0, 0.0, 1.0)
    x, y, z = cross(a, across)
    n = sqrt(x * x + y * y + z * z)
    x, y, z = x / n, y / n, z / n
    return (
        (2.0 * x * x - 1.0, 2.0 * x * y, 2.0 * x * z),
        (2.0 * x * y, 2.0 * y * y - 1.0, 2.0 * y * z),
        (2.0 * x * z, 2.0 * y * z, 2.0 * z * z - 1.0),
    )


def as_vector(array: Float) -> Vector:
    """A vector (3,) as a tuple."""
    x, y, z = np.asarray(array, dtype=np.float64).tolist()
    return x, y, z


def as_matrix(array: Float) -> Matrix:
    """A rotation (3, 3) as tuples."""
    return as_vector(array[0]), as_vector(array[1]), as_vector(array[2])


@inner
def cholesky(A: Float, n: int, L: Float) -> bool:
    """Write L of A = L L' (n, n), lower triangle; False: not positive definite."""
    for j in range(n):
        total = A[j, j]
        for k in range(j):
            total -= L[j, k] * L[j, k]
        if not total > 0.0:
            return False
        L[j, j] = sqrt(total)
        scale = 1.0 / L[j, j]
        for i in range(j + 1, n):
            total = A[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            L[i, j] = total * scale
    return True


@inner
def substitute(L: Float, n: int, b: Float) -> None:
    """Solve L L' x = b (n,), in place."""
    for i in range(n):
        total = b[i]
        for k in range(i):
            total -= L[i, k] * b[k]
        b[i] = total / L[i, i]
    for i in range(n - 1, -1, -1):
        total = b[i]
        for k in range(i + 1, n):
            total -= L[k, i] * b[k]
        b[i] = total / L[i, i]


@inner
def inverse(L: Float, n: int, work: Float, out: Float) -> None:
    """Write the inverse (n, n) of L L'; `work`: (n, n)."""
    for j in range(n):
        work[j, j] = 1.0 / L[j, j]
        for i in range(j + 1, n):
            total = 0.0
            for k in range(j, i):
                total += L[i, k] * work[k, j]
            work[i, j] = -total / L[i, i]
    for i in range(n):
        for j in range(i + 1):
            total = 0.0
            for k in range(i, n):
                total += work[k, i] * work[k, j]
            out[i, j] = total
            out[j, i] = total


@inner
def half_log_determinant(L: Float, n: int) -> float:
    """Half the logarithm of the determinant of L L'."""
    total = 0.0
    for i in range(n):
        total += log(L[i, i])
    return total


@inlined
def copy(A: Float, out: Float) -> None:
    """Copy a matrix; faster to compile than a slice."""
    for i in range(A.shape[0]):
        for j in range(A.shape[1]):
            out[i, j] = A[i, j]


@inlined
def inverse_3(A: Float, B: Float, out: Float) -> None:
    """Write the inverse (3, 3) of symmetric A + B, by cofactors."""
    a, b, c = A[0, 0] + B[0, 0], A[1, 0] + B[1, 0], A[2, 0] + B[2, 0]
    d, e, f = A[1, 1] + B[1, 1], A[2, 1] + B[2, 1], A[2, 2] + B[2, 2]
    p, q, r = d * f - e * e, c * e - b * f, b * e - c * d
    s = 1.0 / (a * p + b * q + c * r)
    out[0, 0], out[0, 1], out[0, 2] = p * s, q * s, r * s
    out[1, 0], out[1, 1], out[1, 2] = q * s, (a * f - c * c) * s, (b * c - a * e) * s
    out[2, 0], out[2, 1], out[2, 2] = r * s, (b * c - a * e) * s, (a * d - b * b) * s


@inner
def eigen(A: Float, n: int, values: Float, vectors: Float) -> None:
    """Write eigenvalues (n,) and eigenvectors, columns (n, n), of symmetric A.

    The matrix is destroyed. Jacobi's cyclic rotations (Golub, Van Loan, "Matrix Computations", 8.5).
    """
    for i in range(n):
        for j in range(n):
            vectors[i, j] = 1.0 if i == j else 0.0
    for _ in range(FABRIK.sweeps):
        off, diagonal = 0.0, 0.0
        for i in range(n):
            diagonal += A[i, i] * A[i, i]
            for j in range(i):
                off += A[i, j] * A[i, j]
        if not off > 1e-22 * diagonal:
            break
        for p in range(n - 1):
            for q in range(p + 1, n):
                if abs(A[p, q]) <= 1e-14 * sqrt(abs(A[p, p] * A[q, q])):
                    continue
                theta = 0.5 * (A[q, q] - A[p, p]) / A[p, q]
                t = 1.0 / (abs(theta) + sqrt(theta * theta + 1.0))
                t = -t if theta < 0.0 else t
                c = 1.0 / sqrt(t * t + 1.0)
                s = t * c
                for k in range(n):
                    akp, akq = A[k, p], A[k, q]
                    A[k, p], A[k, q] = c * akp - s * akq, s * akp + c * akq
                for k in range(n):
                    apk, aqk = A[p, k], A[q, k]
                    A[p, k], A[q, k] = c * apk - s * aqk, s * apk + c * aqk
                for k in range(n):
                    vkp, vkq = vectors[k, p], vectors[k, q]
                    vectors[k, p], vectors[k, q] = c * vkp - s * vkq, s * vkp + c * vkq
    for i in range(n):
        values[i] = A[i, i]


@kernel
def inverse_3_plus(A: Float, extra: float, out: Float) -> None:
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

    They come to stand on the diagonal of A, unsorted, and in the columns of V (cyclic Jacobi, as `eigen`).
    Only the lower triangle of A is read. NaN stays NaN.
    """
    n = A.shape[0]
    for i in range(n):
        for j in range(n):
            V[i, j] = 1.0 if i == j else 0.0
    nothing = 1e-36  # squares of what is beside the diagonal, by those on it
    for _ in range(FABRIK.sweeps):
        off, on = 0.0, 0.0
        for i in range(n):
            on += A[i, i] * A[i, i]
            for j in range(i):
                off += A[i, j] * A[i, j]
        if not off > nothing * on:
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
    """Return least and greatest sigma of covariance A (3, 3); eigenvalues < 0 give 0."""
    D, V = A.copy(), np.empty((3, 3))
    diagonalise(D, V)
    a, b, c = D[0, 0], D[1, 1], D[2, 2]
    return sqrt(max(min(a, b, c), 0.0)), sqrt(max(a, b, c, 0.0))
