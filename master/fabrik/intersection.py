"""Intersection of the rays of two or more cameras.

It yields points with covariance, and outliers.

Minimised is the reprojection error in pixels of the distorted images, weighted by the noise of each observation, from
the linear solution (Hartley and Zisserman, "Multiple View Geometry", 12.2) by Gauss-Newton. A point is NaN where fewer
than two cameras see it, where it lies behind one of them, or where its standard deviation exceeds half of its
distance: its depth is then not determined.

Rays of one point miss each other by noise alone: the squared error in standard deviations is chi-square distributed
with 2 C - 3 degrees of freedom. Where the rays of three or more cameras do not meet, all subsets with one camera less
are triangulated; the camera without which they meet is an outlier, if no other subset fits nearly as well. Otherwise
the marker is not placed: two cameras cannot show which of them is wrong. Of three in a row none is found where one is
off along the epipolar line of another: each pair meets, elsewhere.
"""

from math import sqrt
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from common.arrays import Bool, Float
from common.kernels import inner, kernel
from master.estimator.cameras import CameraArrays, project, undistort
from master.estimator.matrices import inverse_3_plus


class RaySettings(NamedTuple):
    """Numbers of triangulation by rays.

    Attributes:
        rig_px: Standard deviation per axis of what lens, mount and calibration leave at one marker, for the gate
            alone: two sure cameras may miss each other by 6 px. Cheap lenses fit to about half a pixel, and a mount
            gives way when touched.
        false_alarm: Probability that noise alone exceeds the gate: 4.9 standard deviations for two cameras.
        ambiguous: Least difference in chi-square that distinguishes one outlier from another: 1 in 100 by chance, one
            degree of freedom.
        common: Part of the variance of whole caps' centroids that is the same in all cameras. Rendered and detected:
            0.7 of all together, 0.8 by medians, of single fingers 0.3 (little) to 0.8 (index).
        common_px: Sigma above which a slave reports occlusion, or time adds its own; that part is not common.
    """

    rig_px: float = 0.85
    false_alarm: float = 1e-6
    ambiguous: float = float(chdtri(1, 0.01))
    common: float = 0.75
    common_px: float = 0.1


RAYS = RaySettings()


class Triangulation(NamedTuple):
    """Points of M markers, as seen.

    Attributes:
        points_m: (M, 3) rig frame; NaN: not determined.
        cov_m2: (M, 3, 3).
        residual_px: (M,) reprojection error, RMS over the cameras that see the marker.
        chi_square: (M,) of the reprojection errors, with what the rig is allowed.
        apart: (M,) two cameras or more see it, but their rays do not meet.
    """

    points_m: Float
    cov_m2: Float
    residual_px: Float
    chi_square: Float
    outliers: Bool


class Rays(NamedTuple):
    """What C cameras see of one marker, and the point that follows.

    Attributes:
        uv: (C, 2) [px] centroids; of a cap corrected.
        xy: (C, 2) normalised image points of what is seen.
        weight: (C,) [1/px^2]; 0: not seen.
        variance: (C,) [px^2] of the centroids.
        error: (C,) [px^2] squared reprojection errors.
        point, cov: (3,) [m], (3, 3) [m^2] of the noise.
        normal, rhs: (3, 3), (3,) normal equations.
        seen, J: (2,) [px], (2, 3) [px/m] of one camera.
    """

    uv: Float
    xy: Float
    weight: Float
    variance: Float
    error: Float
    point: Float
    cov: Float
    normal: Float
    rhs: Float
    seen: Float
    J: Float

    @classmethod
    def empty(cls, cameras: int) -> "Rays":
        """Room for a number of cameras."""
        return cls(
            np.empty((cameras, 2)),
            np.empty((cameras, 2)),
            np.empty(cameras),
            np.empty(cameras),
            np.empty(cameras),
            np.empty(3),
            np.empty((3, 3)),
            np.empty((3, 3)),
            np.empty(3),
            np.empty(2),
            np.empty((2, 3)),
        )


@inner
def observe(
    cameras: CameraArrays, observed: Float, rejected: Bool, rays_px: float, m: int, rays: Rays
) -> int:
    """Write what the cameras see of marker m; return how many do.

    Args:
        cameras: Of the rig.
        observed: (C, M, 3 or more) u, v, sigma [px]; NaN: not seen.
        rejected: (C, M) what does not count.
        rays_px: Standard deviation that the calibration leaves.
        m: The marker.
        rays: Written.
    """
    count = 0
    for c in range(observed.shape[0]):
        u, v, sigma = observed[c, m, 0], observed[c, m, 1], observed[c, m, 2]
        rays.weight[c] = 0.0
        if rejected[c, m] or not np.isfinite(u + v + sigma) or not undistort(cameras, c, u, v, rays.seen):
            continue
        rays.uv[c, 0], rays.uv[c, 1] = u, v
        rays.xy[c, 0], rays.xy[c, 1] = rays.seen[0], rays.seen[1]
        rays.variance[c] = sigma * sigma
        rays.weight[c] = 1.0 / (sigma * sigma + rays_px * rays_px)
        count += 1
    return count


@inner
def _solve(rays: Rays) -> bool:
    """Write the inverse of the normal matrix into `cov`; False: singular."""
    inverse_3_plus(rays.normal, 0.0, rays.cov)
    trace = rays.normal[0, 0] + rays.normal[1, 1] + rays.normal[2, 2]
    spread = rays.cov[0, 0] + rays.cov[1, 1] + rays.cov[2, 2]
    singular = 1e14  # condition of a normal matrix; the rounding of parallel rays stays above
    return spread > 0.0 and trace * spread < singular


@inner
def _add(rays: Rays, row_x: float, row_y: float, row_z: float, weight: float, value: float) -> None:
    """Add a row of weighted least squares."""
    N, rhs = rays.normal, rays.rhs
    x, y, z = weight * row_x, weight * row_y, weight * row_z
    N[0, 0] += x * row_x
    N[0, 1] += x * row_y
    N[0, 2] += x * row_z
    N[1, 1] += y * row_y
    N[1, 2] += y * row_z
    N[2, 2] += z * row_z
    rhs[0] += x * value
    rhs[1] += y * value
    rhs[2] += z * value


@inner
def _clear(rays: Rays) -> None:
    """Begin a least squares of no row."""
    for i in range(3):
        rays.rhs[i] = 0.0
        for j in range(3):
            rays.normal[i, j] = 0.0


@inner
def linear(cameras: CameraArrays, rays: Rays) -> bool:
    """Write the point by linear least squares; False where it is singular.

    Of z xy = (R X + t)_xy, each row weighted.
    """
    _clear(rays)
    R, t = cameras.R, cameras.t
    for c in range(rays.weight.shape[0]):
        if rays.weight[c] == 0.0:
            continue
        w = rays.weight[c] * cameras.scale[c] * cameras.scale[c]
        for k in range(2):
            xy = rays.xy[c, k]
            x, y, z = R[c, k, 0] - xy * R[c, 2, 0], R[c, k, 1] - xy * R[c, 2, 1], R[c, k, 2] - xy * R[c, 2, 2]
            _add(rays, x, y, z, w, xy * t[c, 2] - t[c, k])
    if not _solve(rays):
        return False
    cov, rhs = rays.cov, rays.rhs
    for i in range(3):
        rays.point[i] = cov[i, 0] * rhs[0] + cov[i, 1] * rhs[1] + cov[i, 2] * rhs[2]
    return True


@inner
def refine(cameras: CameraArrays, rays: Rays) -> bool:
    """Write the point of least reprojection error, its covariance and errors.

    It starts from the point as it is.

    Returns:
        Whether the point is in front of the cameras and its depth is determined.
    """
    seen, J, cov, rhs = rays.seen, rays.J, rays.cov, rays.rhs
    steps = 8  # of Gauss-Newton; from the linear solution three are the rule
    for _ in range(steps):
        _clear(rays)
        for c in range(rays.weight.shape[0]):
            w = rays.weight[c]
            if w == 0.0:
                continue
            if not project(cameras, c, rays.point, seen, J):
                return False
            x, y = rays.uv[c, 0] - seen[0], rays.uv[c, 1] - seen[1]
            rays.error[c] = x * x + y * y
            _add(rays, J[0, 0], J[0, 1], J[0, 2], w, x)
            _add(rays, J[1, 0], J[1, 1], J[1, 2], w, y)
        if not _solve(rays):
            return False
        size = 0.0
        for i in range(3):
            step = cov[i, 0] * rhs[0] + cov[i, 1] * rhs[1] + cov[i, 2] * rhs[2]
            rays.point[i] += step
            size += step * step
        settled_m = 1e-7  # then the error is its square, about
        if size < settled_m * settled_m:
            break
    spread = rays.cov[0, 0] + rays.cov[1, 1] + rays.cov[2, 2]
    for c in range(rays.weight.shape[0]):
        if rays.weight[c] > 0.0:
            z = cameras.t[c, 2]
            for i in range(3):
                z += cameras.R[c, 2, i] * rays.point[i]
            if not (z > 0.0 and 4.0 * spread < z * z):
                return False
    return True


@inner
def chi_square(rays: Rays) -> float:
    """Chi-square of the reprojection errors."""
    total = 0.0
    for c in range(rays.weight.shape[0]):
        if rays.weight[c] > 0.0:
            total += rays.error[c] / (rays.variance[c] + RAYS.rig_px * RAYS.rig_px)
    return total


@inner
def outlier(cameras: CameraArrays, limit: float, rays: Rays) -> int:
    """Return the camera without which the rays meet; -1: none, or ambiguous."""
    least, second, found = np.inf, np.inf, -1
    for c in range(rays.weight.shape[0]):
        weight = rays.weight[c]
        if weight == 0.0:
            continue
        rays.weight[c] = 0.0
        if linear(cameras, rays) and refine(cameras, rays):
            value = chi_square(rays)
            if value <= limit and value < least:
                least, second, found = value, least, c
            elif value <= limit:
                second = min(second, value)
        rays.weight[c] = weight
    return found if second > least + RAYS.ambiguous else -1


@kernel
def intersect(
    cameras: CameraArrays,
    rays_px: float,
    limits: Float,
    observed: Float,
    rejected: Bool,
    rays: Rays,
    points: Float,
    cov: Float,
    errors: Float,
    outliers: Bool,
) -> None:
    """Triangulate M markers as they are seen.

    Args:
        cameras: Of the rig.
        rays_px: Standard deviation that the calibration leaves.
        limits: (C + 1,) most chi-square by the number of cameras.
        observed: (C, M, 3) u, v, sigma [px].
        rejected: (C, M) what does not count.
        rays: Room.
        points, cov: (M, 3) [m], (M, 3, 3) [m^2] written; NaN: not determined.
        errors: (2, M) written: residual [px], chi-square.
        apart: (M,) written.
    """
    for m in range(observed.shape[1]):
        count = observe(cameras, observed, rejected, rays_px, m, rays)
        found = count >= 2 and linear(cameras, rays) and refine(cameras, rays)
        total = 0.0
        for c in range(observed.shape[0]):
            total += rays.error[c] if rays.weight[c] > 0.0 else 0.0
        errors[0, m] = sqrt(total / count) if found else np.nan
        errors[1, m] = chi_square(rays) if found else np.nan
        outliers[m] = count >= 2 and not errors[1, m] <= limits[count]
        for i in range(3):
            points[m, i] = rays.point[i] if found else np.nan
            for j in range(3):
                cov[m, i, j] = rays.cov[i, j] if found else np.nan


def limits_of(cameras: int) -> Float:
    """Most chi-square of one point by the number of its cameras, (C + 1,)."""
    return np.array(
        [np.inf] * 2 + [float(chdtri(2 * n - 3, RAYS.false_alarm)) for n in range(2, cameras + 1)]
    )


def triangulate(
    cameras: CameraArrays, uv: Float, sigma_px: float | Float = 0.1, rays_px: float = 0.0
) -> Triangulation:
    """Triangulate markers as they are seen, by the rays of all cameras.

    Args:
        cameras: Two or more.
        uv: (C, M, 2) centroids [px], distorted images; NaN: not seen.
        sigma_px: Standard deviation per axis: one number, or (C, M).
        rays_px: Standard deviation per axis that the calibration leaves.

    Raises:
        ValueError: `uv` is not (C, M, 2) for these cameras, or they are fewer than two.
    """
    count = len(cameras.scale)
    if count < 2:
        raise ValueError(f"triangulation needs two cameras or more, not {count}")
    if uv.ndim != 3 or uv.shape[0] != count or uv.shape[2] != 2:
        raise ValueError(f"uv must be ({count}, M, 2) for these cameras, not {uv.shape}")
    markers = uv.shape[1]
    observed = np.empty((count, markers, 3))
    observed[..., :2], observed[..., 2] = uv, sigma_px
    points, cov, errors = np.empty((markers, 3)), np.empty((markers, 3, 3)), np.empty((2, markers))
    outliers = np.empty(markers, np.bool_)
    none, scratch = np.zeros((count, markers), np.bool_), Rays.empty(count)
    intersect(cameras, rays_px, limits_of(count), observed, none, scratch, points, cov, errors, outliers)
    return Triangulation(points, cov, errors[0], errors[1], outliers)
