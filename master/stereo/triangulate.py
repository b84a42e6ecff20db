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
from master.stereo.together import Together, together

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
        gain: (M, 3, 2 C) [m/px] by how much each point moves with each u, v, u, v ...; 0: not seen.
        residual_px: (M,) reprojection error, RMS over the cameras that saw the marker [px].
        error_px2: (M, C) squared reprojection error in each camera [px^2]; 0: not seen.
        views: (M,) cameras that saw the marker.
    """

    points: Float
    covariance: Float
    gain: Float
    residual_px: Float
    error_px2: Float
    views: Int


@dataclass(frozen=True, slots=True, eq=False)
class Triangulator:
    """Cameras of one rig, laid out for many triangulations.

    Attributes:
        cameras: In the order of the observations' first axis.
        pose: rig -> camera [R | t] (C, 1, 3, 4) [m].
        focal: fx, fy (C, 1, 2, 1) [px].
        radial: k1, k2, k3 of every camera (3, C, 1, 1).
        all: The cameras laid out for what each does by itself.
    """

    cameras: tuple[CameraModel, ...]
    pose: Float
    focal: Float
    radial: Float
    all: Together

    @classmethod
    def of(cls, cameras: Sequence[CameraModel]) -> "Triangulator":
        """Lay out two or more cameras.

        Raises:
            ValueError: Fewer than two.
        """
        if len(cameras) < 2:
            raise ValueError(f"triangulation needs two cameras or more, not {len(cameras)}")
        return cls(
            cameras=tuple(cameras),
            pose=np.stack([c.T_camera_rig[:3] for c in cameras])[:, None],
            focal=np.stack([c.matrix[[0, 1], [0, 1]] for c in cameras])[:, None, :, None],
            radial=np.stack([c.distortion[[0, 1, 4]] for c in cameras], axis=1)[..., None, None],
            all=together(tuple(cameras)),
        )

    def triangulate(self, uv: Float, sigma_px: float | Float = 0.1) -> Triangulation:
        """Points of one instant.

        Args:
            uv: Centroids (C, M, 2) [px], distorted images. NaN: not seen.
            sigma_px: Centroid noise per axis [px]: one number, or (C, M).

        Raises:
            ValueError: `uv` is not (C, M, 2) for this rig.
        """
        rows, weight = self._rows(uv, sigma_px)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            z = self._depths(_least_squares(rows)[0])  # (M, C)
            rows /= np.repeat(z, 2, axis=1)[..., None]
            points, covariance = _least_squares(rows)
            error = (rows[..., :3] @ points[..., None])[..., 0] + rows[..., 3]
            error = error.reshape(len(points), len(self.cameras), 2)
            gain = (covariance @ rows[..., :3].swapaxes(1, 2)) * np.repeat(weight.T, 2, axis=1)[:, None]
            return _judge(points, covariance, gain, self._depths(points), error, weight.T)

    def roughly(self, uv: Float, sigma_px: float | Float = 0.1) -> Float:
        """The linear solution alone, points (M, 3) [m]; in a third of the time, and not judged. As `triangulate`."""
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            return _least_squares(self._rows(uv, sigma_px)[0])[0]

    def _rows(self, uv: Float, sigma_px: float | Float) -> tuple[Float, Float]:
        """[A | b] of every observation in sigmas, by marker (M, 2C, 4), and weights 1 / sigma (C, M), 0: not seen."""
        count = len(self.cameras)
        if uv.ndim != 3 or uv.shape[0] != count or uv.shape[2] != 2:
            raise ValueError(f"uv must be ({count}, M, 2) for these cameras, not {uv.shape}")
        xy = self.all.undistort(uv)
        seen: Bool = np.isfinite(xy[..., 0] + xy[..., 1])
        # unseen ones get weight 0 and any finite value, so that they cannot spread
        xy = np.where(seen[..., None], xy, 0.0)
        weight = np.where(seen, 1.0 / sigma_px, 0.0)
        rows = self._pixel_jacobian(xy) @ (self.pose[:, :, :2] - xy[..., None] * self.pose[:, :, 2:])
        rows *= weight[..., None, None]
        return rows.swapaxes(0, 1).reshape(uv.shape[1], 2 * count, 4), weight

    def _depths(self, points: Float) -> Float:
        """Depth (M, C) [m] of points (M, 3) along the axis of every camera."""
        return points @ self.pose[:, 0, 2, :3].T + self.pose[:, 0, 2, 3]

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


def _least_squares(rows: Float) -> tuple[Float, Float]:
    """Minimise |A X + b| of rows [A | b] (M, N, 4): points (M, 3) and inverse normal matrices (M, 3, 3)."""
    normal = rows.swapaxes(1, 2) @ rows
    covariance = _inverse(normal[:, :3, :3])
    return -(covariance @ normal[:, :3, 3:])[..., 0], covariance


def _judge(
    points: Float, covariance: Float, gain: Float, z: Float, error: Float, weight: Float
) -> Triangulation:
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
    return Triangulation(points, covariance, gain, residual, squared, views.astype(np.int64))


def _inverse(matrix: Float) -> Float:
    """Inverses (M, 3, 3) of symmetric matrices by cofactors; NaN where singular, never an exception."""
    flat = matrix.reshape(-1, 9)
    minor = flat[:, _MINOR]  # (M, 4, 9)
    cofactor = minor[:, 0] * minor[:, 1] - minor[:, 2] * minor[:, 3]
    determinant = np.vecdot(flat[:, :3], cofactor[:, :3])
    trace = flat[:, 0] + flat[:, 4] + flat[:, 8]
    regular = determinant > _MIN_RELATIVE_DETERMINANT * trace * trace * trace
    return (cofactor / np.where(regular, determinant, np.nan)[:, None]).reshape(-1, 3, 3)
