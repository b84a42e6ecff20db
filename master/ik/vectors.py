"""Vectors and rotations as tuples of floats, for solvers that work on single ones thousands of times.

On one vector an array operation costs ten times the arithmetic. Matrices are three rows.
"""

from math import cos, sin, sqrt

import numpy as np

from common.arrays import Float

Vector = tuple[float, float, float]
Matrix = tuple[Vector, Vector, Vector]

IDENTITY: Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
_TINY = 1e-18


def dot(a: Vector, b: Vector) -> float:
    """Scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vector, b: Vector) -> Vector:
    """Vector product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def length(a: Vector) -> float:
    """Euclidean norm."""
    return sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])


def rotate(m: Matrix, v: Vector) -> Vector:
    """m v."""
    x, y, z = v
    a, b, c = m
    return (
        a[0] * x + a[1] * y + a[2] * z,
        b[0] * x + b[1] * y + b[2] * z,
        c[0] * x + c[1] * y + c[2] * z,
    )


def rotate_back(m: Matrix, v: Vector) -> Vector:
    """m^T v."""
    x, y, z = v
    a, b, c = m
    return (
        a[0] * x + b[0] * y + c[0] * z,
        a[1] * x + b[1] * y + c[1] * z,
        a[2] * x + b[2] * y + c[2] * z,
    )


def product(m: Matrix, n: Matrix) -> Matrix:
    """m n."""
    (a, b, c), (d, e, f), (g, h, i) = n

    def row(r: Vector) -> Vector:
        x, y, z = r
        return x * a + y * d + z * g, x * b + y * e + z * h, x * c + y * f + z * i

    return row(m[0]), row(m[1]), row(m[2])


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


def as_matrix(array: Float) -> Matrix:
    """A rotation (3, 3) as tuples."""
    return as_vector(array[0]), as_vector(array[1]), as_vector(array[2])


def as_vector(array: Float) -> Vector:
    """A vector (3,) as a tuple."""
    x, y, z = np.asarray(array, dtype=np.float64).tolist()
    return x, y, z


def minus(a: Vector, b: Vector) -> Vector:
    """a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def transposed(m: Matrix) -> Matrix:
    """m^T."""
    a, b, c = m
    return (a[0], b[0], c[0]), (a[1], b[1], c[1]), (a[2], b[2], c[2])


def turned(orientation: Matrix, bone: Vector, wanted: Vector) -> Matrix:
    """The orientation turned the shortest way so that its bone points as wanted."""
    return product(between(rotate(orientation, bone), wanted), orientation)


def between(a: Vector, b: Vector) -> Matrix:
    """Shortest rotation from direction a to direction b; identity where either has none."""
    scale = length(a) * length(b)
    if not scale > _TINY:
        return IDENTITY
    x, y, z = (component / scale for component in cross(a, b))
    c = dot(a, b) / scale
    if c < -1.0 + 1e-12:
        # half a turn about any axis across a
        least = min(range(3), key=lambda i: abs(a[i]))
        x, y, z = cross(a, (float(least == 0), float(least == 1), float(least == 2)))
        n = sqrt(x * x + y * y + z * z)
        x, y, z = x / n, y / n, z / n
        return (
            (2 * x * x - 1, 2 * x * y, 2 * x * z),
            (2 * x * y, 2 * y * y - 1, 2 * y * z),
            (2 * x * z, 2 * y * z, 2 * z * z - 1),
        )
    k = 1.0 / (1.0 + c)
    return (
        (c + k * x * x, k * x * y - z, k * x * z + y),
        (k * x * y + z, c + k * y * y, k * y * z - x),
        (k * x * z - y, k * y * z + x, c + k * z * z),
    )
