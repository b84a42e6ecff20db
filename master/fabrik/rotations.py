"""Kernels on single vectors (x, y, z) and rotations (three rows), as tuples.

Tuples stay in registers where the code is compiled, and on one vector an array operation would cost ten times the
arithmetic where it is not.
"""

from math import cos, sin, sqrt

import numpy as np

from common.arrays import Float
from common.kernels import inner, kernel

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
    return (
        a[0] * x + b[0] * y + c[0] * z,
        a[1] * x + b[1] * y + c[1] * z,
        a[2] * x + b[2] * y + c[2] * z,
    )


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
