"""Rays of cameras intersect in a marker, and decide which blob it is.

Minimised is the reprojection error in pixels of the distorted images, weighted by the noise of each
observation, from the linear solution (Hartley and Zisserman, "Multiple View Geometry", 12.2) by Gauss-Newton.
A point is NaN where fewer than two cameras see it, where it lies behind one of them, or where its standard
deviation exceeds half of its distance: its depth is then not determined. The squared error of rays of one
point is chi-square distributed with 2 C - 3 degrees of freedom. Where the rays of three or more cameras do
not meet, the camera without which they meet is an outlier, if no other subset fits nearly as well. Otherwise
the marker is not placed: two cameras cannot show which of them is wrong. Of three in a row none is found
where one is off along the epipolar line of another: each pair meets, elsewhere.

`associate`: a slave that cannot exclude a second place of a marker's colour names both. Of all combinations
of the two over the cameras the one of least cost is taken, in units of chi-square: reprojection error of the
rays, distance from where the hand's other markers predict the marker, distance from where it was, at most
`past_most`, and `overrule` for every camera whose first choice is not followed: it knows size, shape and
motion in its image. A combination counts only where its rays meet before the cameras, no farther from the
prediction than noise is once in a million; and one that overrules a camera only where it is no farther from
the marker's past, either. The past may have been a mistake: it can overrule one camera, but not two that
agree on a place. Where nothing is left, or where two combinations that overrule cameras fit alike at
different places, the marker is dropped for this epoch.
"""

from dataclasses import dataclass
from itertools import product
from math import sqrt
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from common.arrays import Bool, Float, Int
from common.kernels import constant, inner, kernel
from master.estimator.sensors import CameraArrays, project, undistort
from master.fabrik.linear_algebra import inverse_3_plus
from master.fabrik.settings import ASSOCIATION, RAYS


class Triangulation(NamedTuple):
    """Points of M markers, as seen."""

    points_m: Float  # (M, 3) rig frame; NaN: not determined
    cov_m2: Float  # (M, 3, 3)
    residual_px: Float  # (M,) reprojection error, RMS over the cameras that see the marker
    chi_square: Float  # (M,) of the reprojection errors, with what the rig is allowed
    outliers: Bool  # (M,) two cameras or more see it, but their rays do not meet


class Rays(NamedTuple):
    """What C cameras see of one marker, and the point that follows."""

    uv: Float  # (C, 2) [px] centroids; of a cap corrected
    xy: Float  # (C, 2) normalised image points of what is seen
    weight: Float  # (C,) [1/px^2]; 0: not seen
    variance: Float  # (C,) [px^2] of the centroids
    error: Float  # (C,) [px^2] squared reprojection errors
    point: Float  # (3,) [m]
    cov: Float  # (3, 3) [m^2] of the noise
    normal: Float  # (3, 3) normal equations
    rhs: Float  # (3,)
    seen: Float  # (2,) [px] of one camera
    J: Float  # (2, 3) [px/m]

    @classmethod
    def empty(cls, cameras: int) -> "Rays":
        """Room for a number of cameras."""
        by_camera = (cameras, 2), (cameras, 2), cameras, cameras, cameras
        return cls(*(np.empty(shape) for shape in (*by_camera, 3, (3, 3), (3, 3), 3, 2, (2, 3))))


@inner
def observe(
    cameras: CameraArrays, observed: Float, rejected: Bool, rays_px: float, m: int, rays: Rays
) -> int:
    """Write what the cameras see of marker m; return how many do.

    `observed` (C, M, 3 or more): u, v, sigma [px]; NaN: not seen. `rejected` (C, M) does not count.
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
    """Write the point by least squares of z xy = (R X + t)_xy; False: singular."""
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
    """Write the point of least reprojection error from its start, cov and errors.

    Returns whether the point is in front of the cameras and its depth is determined.
    """
    seen, J, cov, rhs = rays.seen, rays.J, rays.cov, rays.rhs
    for _ in range(RAYS.steps):
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
        limits: (C + 1,) most chi-square by the number of cameras.
        observed: (C, M, 3) u, v, sigma [px]; `rejected` (C, M) does not count.
        points, cov: (M, 3) [m], (M, 3, 3) [m^2] written; NaN: not determined.
        errors, outliers: (2, M) residual [px], chi-square; (M,); written.
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
    cameras: CameraArrays, uv: Float, sigma_px: float | Float = RAYS.sigma_px, rays_px: float = 0.0
) -> Triangulation:
    """Triangulate markers as they are seen, by the rays of all cameras.

    `uv` (C, M, 2) [px], distorted images; NaN: not seen. `sigma_px` per axis, one or (C, M); `rays_px`: what
    the calibration leaves.

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


class Prior(NamedTuple):
    """Where M markers are expected (M, 3), rig frame, NaN: nowhere; (M, 3, 3)."""

    points_m: Float
    cov_m2: Float


@dataclass(frozen=True, slots=True, eq=False)
class Association:
    """One place for each marker."""

    uv: Float  # (C, M, 2) [px]; NaN: not seen, or dropped
    sigma_px: Float  # (C, M)
    area_px2: Float  # (C, M); NaN where the second place is taken, whose area is not known
    taken: Bool  # (M,) another combination than the cameras' first choices is taken
    dropped: Bool  # (M,) nothing fits, or it is ambiguous


def among(others_m: Float, on_hand: Int) -> Prior:
    """Expect markers `on_hand` around the others (M, 3); no hand is solved."""
    points, triangulated = np.full(others_m.shape, np.nan), others_m[on_hand]
    triangulated = triangulated[np.isfinite(triangulated[:, 0])]
    if len(triangulated):
        points[on_hand] = np.median(triangulated, axis=0)
    return Prior(points, np.tile(ASSOCIATION.spread_m**2 * np.eye(3), (len(points), 1, 1)))


def associate(
    cameras: CameraArrays,
    pixels: tuple[Float, Float, Float],
    alternatives: tuple[Float, Float],
    hand: Prior,
    past: tuple[Float, Float],
    rays_px: float = 0.0,
) -> Association:
    """Choose for every marker that has an alternative; pass on the others.

    Args:
        pixels: First places of one epoch (C, M, 2) [px], sigma (C, M) [px], area (C, M) [px^2]; NaN: not seen.
        alternatives: Second places (C, M, 2) [px] and sigma (C, M); NaN: none.
        hand: All markers as the hand's other markers predict them, those that have no alternative.
        past: Where each marker was last (M, 3) [m], and how long ago (M,) [s]; NaN: never.
        rays_px: Standard deviation per axis that the calibration leaves.
    """
    first_uv, first_sigma, area = pixels
    alternative: Bool = np.isfinite(alternatives[0][..., 0])
    taken = np.zeros(len(area[0]), np.bool_)
    out = Association(first_uv.copy(), first_sigma.copy(), area.copy(), taken, taken.copy())
    for m in np.flatnonzero(alternative.any(axis=0)):
        where = np.flatnonzero(alternative[:, m])
        out.uv[where[ASSOCIATION.most_cameras :], m] = np.nan
        where = where[: ASSOCIATION.most_cameras]
        # (K, r) whether the second place is taken in each such camera; the first combination: nowhere.
        second = np.array(list(product((False, True), repeat=len(where))))
        uv = np.repeat(out.uv[:, m : m + 1], len(second), axis=1)
        sigma_px = np.repeat(first_sigma[:, m : m + 1], len(second), axis=1)
        for c, use in zip(where, second.T, strict=True):
            uv[c, use], sigma_px[c, use] = alternatives[0][c, m], alternatives[1][c, m]
        age_s = past[1][m]
        moved = (ASSOCIATION.place_m + ASSOCIATION.speed_m_s * age_s) ** 2 * np.eye(3)
        was = past[0][m] if age_s <= ASSOCIATION.forget_s else np.full(3, np.nan)
        model = ASSOCIATION.model_m**2 * np.eye(3)
        priors = Prior(hand.points_m[m], hand.cov_m2[m] + model), Prior(was, moved)
        k = _best(cameras, uv, sigma_px, second.sum(axis=1), priors, rays_px)
        out.dropped[m], out.taken[m] = k is None, k is not None and k > 0
        out.uv[:, m] = np.nan if k is None else uv[:, k]
        out.sigma_px[:, m] = np.nan if k is None else sigma_px[:, k]
        out.area_px2[out.uv[:, m, 0] != first_uv[:, m, 0], m] = np.nan
    return out


def _best(
    cameras: CameraArrays,
    uv: Float,
    sigma_px: Float,
    overruled: Int,
    priors: tuple[Prior, Prior],
    rays_px: float,
) -> int | None:
    """Return which of K combinations is the marker, 0: first choices; None: none.

    `uv`, `sigma_px` (C, K, 2), (C, K) [px]; `overruled` (K,) cameras whose first choice each does not follow;
    `priors` of the one marker, by hand and past: (3,), (3, 3).
    """
    seen = np.flatnonzero(np.isfinite(uv[:, 0, 0]))
    if len(seen) == 1:
        c = int(seen[0])
        places, fits, cost = uv[c], np.ones(len(overruled), np.bool_), np.zeros(len(overruled))
        cov = sigma_px[c, :, None, None] ** 2 * np.eye(2)
        priors = _in_image(cameras, c, priors[0]), _in_image(cameras, c, priors[1])
        same = np.inf  # of two places that one camera sees alone, it knows best itself
    else:
        found = triangulate(cameras, uv, sigma_px, rays_px)
        places, cov, cost = found.points_m, found.cov_m2, found.chi_square
        fits, same = np.isfinite(places[:, 0]) & ~found.outliers, ASSOCIATION.same_m
    from_hand, from_past = (_distances(places, cov, *prior) for prior in priors)
    farthest = float(chdtri(places.shape[1], ASSOCIATION.false_alarm))
    fits = fits & (from_hand <= farthest) & ((from_past <= farthest) | (overruled == 0))
    if not fits.any():
        return None
    cost = cost + from_hand + np.minimum(from_past, ASSOCIATION.past_most) + ASSOCIATION.overrule * overruled
    cost = np.where(fits, cost, np.inf)
    best = int(np.argmin(cost))
    near = (cost <= cost[best] + ASSOCIATION.overrule) & (
        np.linalg.norm(places - places[best], axis=1) > same
    )
    return None if best > 0 and near[overruled > 0].any() else best


def rehearse(cameras: CameraArrays) -> None:
    """Call every kernel once, so that none is compiled while a hand is tracked."""
    nothing = Prior(np.full((1, 3), np.nan), np.full((1, 3, 3), np.nan))
    _in_image(cameras, 0, Prior(nothing.points_m[0], nothing.cov_m2[0]))
    one = np.ones((len(cameras.scale), 1))
    pixels, alternatives = np.full((*one.shape, 2), 1e2), np.full((*one.shape, 2), 1e3)
    associate(cameras, (pixels, one, one), (alternatives, one), nothing, (nothing.points_m, one[0]))


@kernel
def _seen_at(cameras: CameraArrays, c: int, point: Float, uv: Float, J: Float) -> None:
    """Write where a camera sees a point: an entry from Python to what kernels call."""
    project(cameras, c, point, uv, J)


def _in_image(cameras: CameraArrays, c: int, prior: Prior) -> Prior:
    """A prior of one marker as camera `c` sees it: (2,) [px], (2, 2) [px^2]."""
    uv, J = np.full(2, np.nan), np.zeros((2, 3))
    _seen_at(cameras, constant(c), np.ascontiguousarray(prior.points_m), uv, J)
    return Prior(uv, J @ prior.cov_m2 @ J.T)


def _distances(places: Float, cov: Float, expected: Float, expected_cov: Float) -> Float:
    """Squared Mahalanobis distances (K,) of places (K, n) from an expected one."""
    if not np.isfinite(expected).all():
        return np.zeros(len(places))
    off = np.where(np.isfinite(places), places - expected, 0.0)
    both = np.where(np.isfinite(cov), cov, 0.0) + expected_cov
    return (off * np.linalg.solve(both, off[..., None])[..., 0]).sum(axis=1)
