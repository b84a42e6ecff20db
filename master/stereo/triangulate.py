"""Points from what two or more calibrated cameras saw, with their uncertainty.

Every marker has its own set of cameras (NaN: that camera did not see it). Minimised is the reprojection error
in pixels of the *distorted* images, weighted by each observation's noise:

    sum_c | J_c (pi(R_c X + t_c) - xy_c) |^2 / sigma_c^2

J_c is the 2x2 derivative of lens and camera matrix at the observed point. With z = R_3 X + t_3 the bracket is
(A_c X + b_c) / z, A = R_12 - xy R_3, b = t_12 - xy t_3: linear but for 1/z. So the linear solution (Hartley &
Zisserman, "Multiple View Geometry", 12.2) gives z, and one solution reweighted by 1/z (ibid. 12.2, iterative
linear method; a Gauss-Newton step with the derivative taken at the observation) gives the point. The covariance
is the inverse of its normal matrix. A point is NaN when fewer than two cameras see it, when it lies behind one
of them, or when the rays are so parallel that its standard deviation exceeds half of its distance: the depth is
then not determined.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float, Int
from common.camera_model import CameraModel
from common.geometry import invert

_MIN_RELATIVE_DETERMINANT = 1e-14
"""Of a 3x3 normal matrix, against the cube of its trace; the rounding of parallel rays stays below."""
_MINOR: Int = np.array(
    [
        [4, 5, 3, 7, 8, 6, 1, 2, 0],
        [8, 6, 7, 2, 0, 1, 5, 3, 4],
        [5, 3, 4, 8, 6, 7, 2, 0, 1],
        [7, 8, 6, 1, 2, 0, 4, 5, 3],
    ]
)
"""Elements of a flat 3x3 matrix: cofactor = [0] [1] - [2] [3]."""
_IDENTITY = np.eye(2)


@dataclass(frozen=True, slots=True, eq=False)
class Triangulation:
    """Points and how well they are known.

    Attributes:
        points: (M, 3) [m], rig frame. NaN: not determined.
        covariance: (M, 3, 3) [m^2].
        residual_px: (M,) reprojection error, RMS over the cameras that saw the marker [px].
        error_px2: (M, C) squared reprojection error in each camera [px^2]; 0: not seen.
        views: (M,) cameras that saw the marker.
    """

    points: Float
    covariance: Float
    residual_px: Float
    error_px2: Float
    views: Int


@dataclass(frozen=True, slots=True, eq=False)
class Triangulator:
    """Cameras of one rig, laid out for many triangulations.

    Attributes:
        cameras: In the order of the observations' first axis.
        rotation: rig -> camera (C, 3, 3).
        translation: rig -> camera (C, 1, 3) [m].
        focal: fx, fy (C, 1, 2, 1) [px].
        radial: k1, k2, k3 of every camera (3, C, 1, 1).
    """

    cameras: tuple[CameraModel, ...]
    rotation: Float
    translation: Float
    focal: Float
    radial: Float

    @classmethod
    def of(cls, cameras: Sequence[CameraModel]) -> "Triangulator":
        """Lay out two or more cameras.

        Raises:
            ValueError: Fewer than two.
        """
        if len(cameras) < 2:
            raise ValueError(f"triangulation needs two cameras or more, not {len(cameras)}")
        inverse = np.stack([invert(c.T_rig_camera) for c in cameras])
        return cls(
            cameras=tuple(cameras),
            rotation=inverse[:, :3, :3],
            translation=inverse[:, None, :3, 3],
            focal=np.stack([c.matrix[[0, 1], [0, 1]] for c in cameras])[:, None, :, None],
            radial=np.stack([c.distortion[[0, 1, 4]] for c in cameras], axis=1)[..., None, None],
        )

    def triangulate(self, uv: Float, sigma_px: float | Float = 0.1) -> Triangulation:
        """Points of one instant.

        Args:
            uv: Centroids (C, M, 2) [px], distorted images. NaN: not seen.
            sigma_px: Centroid noise per axis [px]: one number, or (C, M).

        Raises:
            ValueError: `uv` is not (C, M, 2) for this rig.
        """
        count = len(self.cameras)
        if uv.ndim != 3 or uv.shape[0] != count or uv.shape[2] != 2:
            raise ValueError(f"uv must be ({count}, M, 2), not {uv.shape}")
        xy = np.stack([c.undistort(u) for c, u in zip(self.cameras, uv, strict=True)])
        seen: Bool = np.isfinite(xy[..., 0] + xy[..., 1])
        # unseen ones get weight 0 and any finite value, so that they cannot spread
        xy = np.where(seen[..., None], xy, 0.0)
        weight = np.where(seen, 1.0 / sigma_px, 0.0)
        to_sigmas = self._pixel_jacobian(xy) * weight[..., None, None]
        rows = self.rotation[:, None, :2] - xy[..., None] * self.rotation[:, None, 2:3]
        offset = self.translation[..., :2] - xy * self.translation[..., 2:3]
        rows = _by_marker(to_sigmas @ rows)  # (M, 2C, 3)
        offset = _by_marker(to_sigmas @ offset[..., None])  # (M, 2C, 1)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            start, _ = _least_squares(rows, offset)
            z = self._depths(start)  # (M, C)
            inverse_z = np.repeat(1.0 / z, 2, axis=1)[..., None]
            points, covariance = _least_squares(rows * inverse_z, offset * inverse_z)
            error = ((rows @ points[..., None] + offset) * inverse_z).reshape(len(points), count, 2)
            return _judge(
                points, covariance, self._depths(points), error, np.broadcast_to(weight, seen.shape).T
            )

    def _depths(self, points: Float) -> Float:
        """Depth (M, C) [m] of points (M, 3) along the axis of every camera."""
        return points @ self.rotation[:, 2].T + self.translation[:, 0, 2]

    def _pixel_jacobian(self, xy: Float) -> Float:
        """d(u, v) / d(x, y) (C, M, 2, 2) [px] at normalised points (C, M, 2).

        Focal lengths and radial distortion; the tangential part turns it by less than 1 % and is left out.
        """
        k1, k2, k3 = self.radial
        r2 = xy[..., :1] * xy[..., :1] + xy[..., 1:] * xy[..., 1:]
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2.0 * k1 + r2 * (4.0 * k2 + r2 * (6.0 * k3))  # d radial / d(r^2), twice
        jacobian = (slope * xy)[..., None] * xy[..., None, :]
        jacobian += radial[..., None] * _IDENTITY
        jacobian *= self.focal
        return jacobian


def _by_marker(values: Float) -> Float:
    """(C, M, 2, k) -> (M, 2C, k)."""
    count, markers, _, k = values.shape
    return values.swapaxes(0, 1).reshape(markers, 2 * count, k)


def _least_squares(rows: Float, offset: Float) -> tuple[Float, Float]:
    """Minimise |rows X + offset|: points (M, 3) and inverse normal matrices (M, 3, 3)."""
    transposed = rows.swapaxes(1, 2)
    covariance = _inverse(transposed @ rows)
    return -(covariance @ (transposed @ offset))[..., 0], covariance


def _judge(points: Float, covariance: Float, z: Float, error: Float, weight: Float) -> Triangulation:
    """Residuals, and NaN for what is not determined; `error` (M, C, 2) in sigmas, `weight` (M, C)."""
    seen = weight > 0.0
    views = seen.sum(axis=1)
    squared = (error * error).sum(axis=2) / np.where(seen, weight * weight, np.inf)
    nearest = np.where(seen, z, np.inf).min(axis=1)
    variance = covariance[:, 0, 0] + covariance[:, 1, 1] + covariance[:, 2, 2]
    nan = ~((views >= 2) & (nearest > 0.0) & (4.0 * variance < nearest * nearest))
    residual = np.sqrt(squared.sum(axis=1) / views)
    points[nan] = np.nan
    covariance[nan] = np.nan
    residual[nan] = np.nan
    return Triangulation(points, covariance, residual, squared, views.astype(np.int64))


def _inverse(matrix: Float) -> Float:
    """Inverses (M, 3, 3) of symmetric matrices by cofactors; NaN where singular, never an exception."""
    flat = matrix.reshape(-1, 9)
    a, b, c, d = _MINOR
    cofactor = flat[:, a] * flat[:, b] - flat[:, c] * flat[:, d]
    determinant = (flat[:, :3] * cofactor[:, :3]).sum(axis=1)
    trace = flat[:, 0] + flat[:, 4] + flat[:, 8]
    regular = determinant > _MIN_RELATIVE_DETERMINANT * trace * trace * trace
    return (cofactor / np.where(regular, determinant, np.nan)[:, None]).reshape(-1, 3, 3)
