"""Rigid transforms, quaternions (wxyz) and small fits; `T_a_b` maps b to a."""

import numpy as np

from common.arrays import Float

Wxyz = tuple[float, float, float, float]  # one quaternion, as plain numbers

_EYE = np.eye(3)
_SKEW: Float = np.cross(_EYE[:, None], _EYE[None]).swapaxes(1, 2).reshape(3, 9)


def _shepperd() -> Float:
    """Linear map (9, 16) from a rotation to the forms 4 q[k] q of its quaternion q."""
    out = np.zeros((3, 3, 4, 4))
    for i, signs in enumerate(((1, 1, -1, -1), (1, -1, 1, -1), (1, -1, -1, 1))):
        out[i, i] = np.diag(signs)
        j, k = (i + 1) % 3, (i + 2) % 3
        out[k, j, 0, i + 1] = out[k, j, i + 1, 0] = 1.0
        out[j, k, 0, i + 1] = out[j, k, i + 1, 0] = -1.0
        for a, b in ((j, k), (k, j)):
            out[a, b, j + 1, k + 1] = out[a, b, k + 1, j + 1] = 1.0
    return out.reshape(9, 16)


_FORMS, _FORMS_OFFSET = _shepperd(), np.eye(4).ravel()


def quaternion_to_matrix(q_wxyz: Float) -> Float:
    """Rotation matrices (..., 3, 3) of quaternions (..., 4), normalised first."""
    q = np.asarray(q_wxyz, dtype=np.float64)
    q = q / np.sqrt((q * q).sum(axis=-1, keepdims=True))
    w, x, y, z = (q[..., k] for k in range(4))
    xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
    wx, wy, wz = w * x, w * y, w * z
    out = 2 * np.array((yy + zz, xy - wz, xz + wy, xy + wz, xx + zz, yz - wx, xz - wy, yz + wx, xx + yy))
    out[::4] = 1 - out[::4]  # the diagonal
    return np.moveaxis(out.reshape(3, 3, *w.shape), (0, 1), (-2, -1))


def quaternion_product(p: Wxyz, q: Wxyz) -> Wxyz:
    """The rotation p after q; for one pair, ten times faster than arrays."""
    a, b, c, d = p
    w, x, y, z = q
    return (
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    )


def matrix_of(q: Wxyz) -> Float:
    """Rotation matrix (3, 3) of one unit quaternion, as `quaternion_to_matrix`."""
    w, x, y, z = q
    xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
    wx, wy, wz = w * x, w * y, w * z
    return np.array(
        [
            [1.0 - 2.0 * (yy + zz), 2.0 * (xy - wz), 2.0 * (xz + wy)],
            [2.0 * (xy + wz), 1.0 - 2.0 * (xx + zz), 2.0 * (yz - wx)],
            [2.0 * (xz - wy), 2.0 * (yz + wx), 1.0 - 2.0 * (xx + yy)],
        ]
    )


def matrix_to_quaternion(rotation: Float) -> Float:
    """Unit quaternions (..., 4) wxyz with w >= 0 of rotation matrices (..., 3, 3).

    Takes the numerically largest of the four classic forms (Shepperd, 1978): exact also near half turns.
    """
    m = np.asarray(rotation, dtype=np.float64).reshape(-1, 9)
    # A quarter of each of the four forms is a row of a symmetric matrix that is linear in the rotation's elements.
    forms = m @ _FORMS + _FORMS_OFFSET
    best = np.argmax(forms[:, ::5], axis=1)  # of the diagonals
    q: Float = forms.reshape(-1, 4, 4)[np.arange(len(best)), best]
    q = q / np.sqrt(np.vecdot(q, q))[:, None]
    return np.where(q[:, :1] < 0, -q, q).reshape(*np.shape(rotation)[:-2], 4)


def rotation_vector_to_matrix(vector: Float) -> Float:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3) [rad] (Rodrigues)."""
    # A turn too small to be distinguished from none is taken as this small, not divided by.
    angle = np.maximum(np.sqrt(np.vecdot(vector, vector)), 1e-9)[..., None, None]
    k = skew(vector)
    return _EYE + np.sin(angle) / angle * k + (1 - np.cos(angle)) / (angle * angle) * (k @ k)


def matrix_to_rotation_vector(rotation: Float) -> Float:
    """Rotation vectors (..., 3) [rad], at most half a turn, of matrices (..., 3, 3)."""
    q = matrix_to_quaternion(rotation)
    sine = np.sqrt(np.vecdot(q[..., 1:], q[..., 1:]))
    half = np.arctan2(sine, q[..., 0])
    return q[..., 1:] * np.where(sine > 1e-9, 2.0 * half / np.maximum(sine, 1e-9), 2.0)[..., None]


def skew(vector: Float) -> Float:
    """Matrices (..., 3, 3) with `skew(a) @ b == cross(a, b)`."""
    return (vector @ _SKEW).reshape(*vector.shape, 3)


def cross(a: Float, b: Float) -> Float:
    """Cross products of (..., 3) arrays, for small ones much faster than numpy's."""
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    out[..., 0] = a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1]
    out[..., 1] = a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2]
    out[..., 2] = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return out


def axis_rotation(axis: int, angle: float) -> Float:
    """Rotation (3, 3) by `angle` [rad] about coordinate axis 0 (x), 1 (y) or 2 (z)."""
    c, s = np.cos(angle), np.sin(angle)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = c
    matrix[i, j], matrix[j, i] = -s, s
    return matrix


def transform(T_a_b: Float, points_b: Float) -> Float:
    """Points (..., 3) from frame b to frame a by the rigid transform (4, 4)."""
    return points_b @ T_a_b[:3, :3].T + T_a_b[:3, 3]


def invert(T_a_b: Float) -> Float:
    """The inverse `T_b_a` (4, 4) of a rigid transform."""
    inverse = np.eye(4)
    inverse[:3, :3] = T_a_b[:3, :3].T
    inverse[:3, 3] = -T_a_b[:3, :3].T @ T_a_b[:3, 3]
    return inverse


def rigid(rotation: Float, translation: Float) -> Float:
    """Rigid transform (4, 4) of a rotation (3, 3) and a translation (3,)."""
    T = np.eye(4)
    T[:3, :3] = rotation
    T[:3, 3] = translation
    return T


def fit_rigid(points_a: Float, points_b: Float, weight: Float | None = None) -> Float:
    """Fit `T_a_b` (..., 4, 4) by least squares to points_a ~ T_a_b points_b.

    Kabsch, 1976. Points are (..., N, 3), `weight` (N,) non-negative; None: all one.
    """
    count = points_a.shape[-2]
    w = np.full(count, 1.0 / count) if weight is None else weight / weight.sum()
    mean_a, mean_b = w @ points_a, w @ points_b
    spread = ((points_a - mean_a[..., None, :]) * w[:, None]).swapaxes(-1, -2)
    u, _, vt = np.linalg.svd(spread @ (points_b - mean_b[..., None, :]))
    u[..., 2] *= np.sign(np.linalg.det(u @ vt))[..., None]
    T = np.zeros((*u.shape[:-2], 4, 4))
    T[..., :3, :3] = rotation = u @ vt
    T[..., :3, 3] = mean_a - (rotation @ mean_b[..., None])[..., 0]
    T[..., 3, 3] = 1.0
    return T


def intersect_plane(origin: Float, direction: Float, normal: Float, offset: float) -> Float:
    """Points (..., 3) [m] where rays meet the plane `normal . X = offset`.

    Origins (..., 3) [m], directions (..., 3) of any length; NaN where the ray is parallel to the plane or meets it
    behind its origin.
    """
    along = direction @ normal
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (offset - origin @ normal) / along
    t = np.where((np.abs(along) > 1e-12 * np.linalg.norm(direction, axis=-1)) & (t > 0), t, np.nan)
    return origin + t[..., None] * direction
