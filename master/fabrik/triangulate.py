"""Triangulate centroids: disparity, D = k x^z, X, Y, Z, covariance.

Kalbfleisch measures x = u_left - u_right on the images as they are, not rectified, and fits D = k x^z with a
target on the axis, before the middle between the lenses (section VI). Away from the axis lens, roll and yaw
change the disparity of the same depth: of the shipped desk rig, whose right camera is rolled by 0.3 degrees,
by 0.8 px at the edge of the volume, or 8 mm. By the rig's own geometry that change is

    x(u, v, D) - x(axis, D) = a(u, v) + b(u, v) / D

to a hundredth of a pixel, so a and b are tabulated over the left image and their values are taken from the
disparity before the law is asked. So is the row at which the right camera must see the marker: a marker whose
rows disagree is two things, and dropped. The centroid of a finger tip is up to half a radius off that of its
cap (`master.fabrik.caps`).

Covariance by the derivatives: along the sight |dD/dx| sigma_x, across it D sigma_u / f, and what the law's
fit left; and by how far the point moves where the finger points elsewhere within one standard deviation.
"""

from math import sqrt
from typing import NamedTuple

import numpy as np

from common.arrays import Bool, Float
from common.geometry.camera_model import CameraModel
from common.kernels import constant, inner, kernel
from master.estimator.epoch import MarkerPositions, SolvedHand
from master.fabrik.caps import CapTables, hidden_part, seen_shift
from master.fabrik.depth import AffineDisparity, PowerLaw, disparity_on_axis
from master.fabrik.settings import CAPS, DEPTH

_DEPTHS_M = np.array(DEPTH.tabled_m)
_ONE = constant(1)  # direction


class DisparityTables(NamedTuple):
    """A pair of cameras and its law as flat arrays.

    `table` (GRID + 1, GRID + 1, 6) at each corner (row, column): a, b of the disparity off the axis, a, b of
    the difference of rows, and x, y of the undistorted ray.
    """

    power: bool  # whether D = k x^z; else D = k / (x - z)
    k: float
    z: float
    law_error: float  # relative standard deviation of the law
    row_sigma_px: float  # standard deviation of the difference of rows that the geometry leaves
    row_limit: float  # most of its chi square
    cell_px: Float  # (2,) width and height of a cell
    table: Float
    R: Float  # (3, 3) the left camera in the rig
    centre: Float  # (3,) [m]
    camera_R: Float  # (2, 3, 3) rotations rig -> camera, for what each sees of a cap
    centres: Float  # (2, 3) [m]
    focal_px: Float  # (2,)


def disparity_tables(
    cameras: tuple[CameraModel, ...],
    law: PowerLaw | AffineDisparity,
    law_error: float,
    row_sigma_px: float,
    row_limit: float,
) -> DisparityTables:
    """Tabulate the first two cameras over the left image; as of `DisparityTables`."""
    left, right = cameras[:2]
    grid = DEPTH.grid
    u = np.linspace(0.0, left.width_px, grid + 1)
    v = np.linspace(0.0, left.height_px, grid + 1)
    uv = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    xy = left.undistort(uv)
    design = np.stack([np.ones_like(_DEPTHS_M), 1.0 / _DEPTHS_M], axis=1)
    table = np.empty((len(uv), 6))
    disparity, rows = np.empty((len(_DEPTHS_M), len(uv))), np.empty((len(_DEPTHS_M), len(uv)))
    rays = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
    for k, depth_m in enumerate(_DEPTHS_M):
        seen = right.project(_rig(left, rays * depth_m))
        disparity[k] = (uv[:, 0] - seen[:, 0]) - disparity_on_axis(cameras, np.array([depth_m]))
        rows[k] = uv[:, 1] - seen[:, 1]
    solve = np.linalg.pinv(design)
    table[:, :2], table[:, 2:4], table[:, 4:] = (solve @ disparity).T, (solve @ rows).T, xy
    power = isinstance(law, PowerLaw)
    return DisparityTables(
        power,
        law.k_m if power else law.a_m_px,
        law.z if power else law.x0_px,
        law_error,
        row_sigma_px,
        row_limit,
        np.array([left.width_px / grid, left.height_px / grid]),
        table.reshape(grid + 1, grid + 1, 6),
        np.ascontiguousarray(left.T_rig_camera[:3, :3]),
        np.ascontiguousarray(left.centre),
        np.array([camera.T_rig_camera[:3, :3].T for camera in cameras[:2]]),
        np.array([camera.centre for camera in cameras[:2]]),
        np.array([camera.matrix[0, 0] for camera in cameras[:2]]),
    )


def _rig(camera: CameraModel, points: Float) -> Float:
    return points @ camera.T_rig_camera[:3, :3].T + camera.centre


@kernel
def depth(tables: DisparityTables, disparity: float) -> float:
    """Depth [m] by the law of a disparity [px]; NaN where there is none."""
    if tables.power:
        return tables.k * disparity**tables.z if disparity > 0.0 else np.nan
    off = disparity - tables.z
    return tables.k / off if off > 0.0 else np.nan


@inner
def metres_per_pixel(tables: DisparityTables, depth_m: float) -> float:
    """|dD/dx| [m/px] at a depth [m]."""
    if tables.power:
        return -tables.z * depth_m / (depth_m / tables.k) ** (1.0 / tables.z)
    return depth_m * depth_m / tables.k


@kernel
def place_centroids(
    tables: DisparityTables, u: float, v: float, right_u: float, right_v: float, ray: Float, point: Float
) -> tuple[float, float]:
    """Return the depth [m] and how far the rows disagree [px]; write the point.

    `u`, `v` [px] in the left image; `ray` (3,) of depth 1 and `point` (3,) [m], rig frame, are not written
    where the depth is NaN.
    """
    across, down = u / tables.cell_px[0], v / tables.cell_px[1]
    if not np.isfinite(across + down + right_u + right_v):
        return np.nan, np.nan
    last = tables.table.shape[0] - 2
    # Cut before they are whole numbers: what is beyond those is any cell, or none.
    i, j = int(min(max(down, 0.0), float(last))), int(min(max(across, 0.0), float(last)))
    q, p = across - j, down - i
    cell = np.empty(6)
    for c in range(6):
        upper = (1.0 - q) * tables.table[i, j, c] + q * tables.table[i, j + 1, c]
        lower = (1.0 - q) * tables.table[i + 1, j, c] + q * tables.table[i + 1, j + 1, c]
        cell[c] = (1.0 - p) * upper + p * lower
    disparity = u - right_u
    z = depth(tables, disparity)
    for _ in range(DEPTH.rounds):
        z = depth(tables, disparity - cell[0] - cell[1] / z)
    if not np.isfinite(z):
        return np.nan, np.nan
    for k in range(3):
        ray[k] = tables.R[k, 0] * cell[4] + tables.R[k, 1] * cell[5] + tables.R[k, 2]
        point[k] = tables.centre[k] + z * ray[k]
    return z, v - right_v - cell[2] - cell[3] / z


@kernel
def cap_bias(
    tables: DisparityTables, caps: CapTables, row: int, ahead: Float, point: Float, bias: Float, shown: Float
) -> None:
    """Write by how much each camera sees a cap's centroid off its own (2, 2) [px].

    Of the cap in `row` of `caps.appearances` at about `point` (3,) [m], which points `ahead` (3,), rig frame;
    `shown` (2,) [m^2]: the area that it shows.
    """
    back, shift = np.empty(3), np.empty(3)
    here, there = np.empty(3), np.empty(3)
    for c in range(2):
        length = 0.0
        for k in range(3):
            back[k] = tables.centres[c, k] - point[k]
            length += back[k] * back[k]
        length = sqrt(length)
        for k in range(3):
            back[k] /= length
        shown[c] = seen_shift(caps, row, ahead, back, shift)
        for i in range(3):
            here[i] = there[i] = 0.0
            for k in range(3):
                here[i] -= tables.camera_R[c, i, k] * back[k] * length
                there[i] += tables.camera_R[c, i, k] * (shift[k] - back[k] * length)
        bias[c, 0] = tables.focal_px[c] * (there[0] / there[2] - here[0] / here[2])
        bias[c, 1] = tables.focal_px[c] * (there[1] / there[2] - here[1] / here[2])


@inner
def _across(ahead: Float, tilt: Float, out: Float) -> None:
    """Write two directions (2, 3) across `ahead`, as long as tilt (3, 3) [rad^2]."""
    least = 0
    for k in range(1, 3):
        if abs(ahead[k]) < abs(ahead[least]):
            least = k
    i, j = (least + 1) % 3, (least + 2) % 3
    length = sqrt(ahead[i] * ahead[i] + ahead[j] * ahead[j])
    out[0, least], out[0, i], out[0, j] = 0.0, -ahead[j] / length, ahead[i] / length
    for k in range(3):
        a, b = (k + 1) % 3, (k + 2) % 3
        out[1, k] = ahead[a] * out[0, b] - ahead[b] * out[0, a]
    for t in range(2):
        variance = 0.0
        for a in range(3):
            for b in range(3):
                variance += out[t, a] * tilt[a, b] * out[t, b]
        for k in range(3):
            out[t, k] *= sqrt(max(variance, 0.0))


@kernel
def _without_bias(
    tables: DisparityTables, uv: Float, m: int, bias: Float, ray: Float, point: Float
) -> tuple[float, float]:
    """Place centroids of marker m less `bias` (2, 2) [px], as `place_centroids`."""
    u, v = uv[0, m, 0] - bias[0, 0], uv[0, m, 1] - bias[0, 1]
    return place_centroids(tables, u, v, uv[1, m, 0] - bias[1, 0], uv[1, m, 1] - bias[1, 1], ray, point)


@inner
def _forget(m: int, points: Float, cov: Float, noise: Float) -> None:
    """Write that marker m is not placed."""
    points[m, :] = np.nan
    cov[m, :, :] = np.nan
    noise[m, :, :] = np.nan


class _Scratch(NamedTuple):
    """Of one marker: what is worked out on the way."""

    ray: Float  # (3,) of the left camera, and `point` (3,) [m] by it
    point: Float
    off: Float  # (3,) [m] the point, were the finger tilted
    aim: Float  # (3,) another direction of the finger
    bias: Float  # (2, 2) [px] of the centroids
    shown: Float  # (2,) area [m^2] that the whole cap shows each camera,
    whole: Float  # and the most of all directions (1, 2)
    tilted: Float  # (2, 3) standard deviations of the direction
    by: Float  # (3, 3) derivatives


@kernel
def _cap_spread(
    tables: DisparityTables,
    caps: CapTables,
    uv: Float,
    m: int,
    ahead: Float,
    tilt: Float,
    work: _Scratch,
    points: Float,
    cov: Float,
) -> None:
    """Write point and covariance of marker m by radius and direction.

    `ahead` (3,) is that of its finger, rig frame, `tilt` (3, 3) [rad^2] its covariance.
    """
    point, off, aim, by, bias = work.point, work.off, work.aim, work.by, work.bias
    for k in range(3):
        by[k, 0] = CAPS.radius_share * (point[k] - aim[k])
    for a in range(3):
        points[m, a] = point[a]
        for b in range(3):
            cov[m, a, b] = by[a, 0] * by[b, 0]
    _across(ahead, tilt, work.tilted)
    for t in range(2):
        length = 0.0
        for k in range(3):
            aim[k] = ahead[k] + work.tilted[t, k]
            length += aim[k] * aim[k]
        for k in range(3):
            aim[k] /= sqrt(length)
        cap_bias(tables, caps, caps.row[m], aim, point, bias, work.shown)
        for c in range(2):
            work.whole[0, c] = max(work.whole[0, c], work.shown[c])
        off[:] = np.nan
        _without_bias(tables, uv, m, bias, by[2], off)
        for a in range(3):
            for b in range(3):
                cov[m, a, b] += (off[a] - points[m, a]) * (off[b] - points[m, b])


@inner
def _add_noise(
    tables: DisparityTables,
    m: int,
    z: float,
    left2: float,
    right2: float,
    work: _Scratch,
    cov: Float,
    noise: Float,
) -> None:
    """Add noise of centroids, by variances [px^2], and of the law."""
    ray, by = work.ray, work.by
    per_px, scale = metres_per_pixel(tables, z), z / tables.focal_px[0]
    for k in range(3):  # derivatives by u of the left camera, v of it, and u of the right one
        by[k, 0] = scale * tables.R[k, 0] - per_px * ray[k]
        by[k, 1] = scale * tables.R[k, 1]
        by[k, 2] = per_px * ray[k]
    law2 = (tables.law_error * z) ** 2
    for a in range(3):
        for b in range(3):
            left = left2 * (by[a, 0] * by[b, 0] + by[a, 1] * by[b, 1])
            noise[m, a, b] = left + right2 * by[a, 2] * by[b, 2]
            cov[m, a, b] += noise[m, a, b] + law2 * ray[a] * ray[b]


@kernel
def triangulate(
    tables: DisparityTables,
    caps: CapTables,
    uv: Float,
    sigma_px: Float,
    area_px2: Float,
    ahead: Float,
    tilt: Float,
    points: Float,
    cov: Float,
    noise: Float,
    outliers: Bool,
) -> None:
    """Triangulate M markers with covariance.

    Args:
        uv, sigma_px, area_px2: (2, M, 2) centroids [px], (2, M); NaN: not seen.
        ahead, tilt: (M, 3) in which the fingers point, rig frame, (M, 3, 3) [rad^2]; NaN: what is seen is taken.
        points: (M, 3) [m], written; NaN: a camera does not see the marker, there is no such disparity, or its
            standard deviation exceeds half of its depth.
        cov, noise: (M, 3, 3) [m^2] covariance and its noise part, written; NaN where the point is.
        outliers: (M,) written: the rows disagree.
    """
    ray, point, aim = np.empty(3), np.empty(3), np.empty(3)
    bias, whole, variance = np.empty((2, 2)), np.empty((1, 2)), np.empty(2)
    seen_px2, scale_m = np.empty(2), np.empty(2)
    work = _Scratch(
        ray, point, np.empty(3), aim, bias, np.empty(2), whole, np.empty((2, 3)), np.empty((3, 3))
    )
    for m in range(uv.shape[1]):
        _forget(m, points, cov, noise)
        outliers[m] = False
        if not np.isfinite(uv[0, m, 0] + uv[0, m, 1] + uv[1, m, 0] + uv[1, m, 1]):
            continue
        whole[:], bias[:] = 0.0, 0.0
        row = caps.row[m]
        known = row >= 0 and np.isfinite(ahead[m, 0])
        z, rows = _without_bias(tables, uv, m, bias, ray, point)
        if not np.isfinite(z):
            continue
        if known:
            cap_bias(tables, caps, row, ahead[m], point, bias, whole[0])
            for k in range(3):
                aim[k] = point[k]
            z, rows = _without_bias(tables, uv, m, bias, ray, point)
            if not np.isfinite(z):  # so near that what is seen of the cap is no disparity
                continue
            _cap_spread(tables, caps, uv, m, ahead[m], tilt[m], work, points, cov)
        else:
            spread2 = CAPS.any_m**2 if row >= 0 else CAPS.relief_m**2
            for a in range(3):
                points[m, a] = point[a]
                for b in range(3):
                    cov[m, a, b] = spread2 if a == b else 0.0
        for c in range(2):
            seen_px2[c], scale_m[c] = area_px2[c, m], z / tables.focal_px[c]
        hidden_part(caps, row, seen_px2, scale_m, whole, _ONE, variance)
        rows2 = tables.row_sigma_px * tables.row_sigma_px + sigma_px[0, m] ** 2 + sigma_px[1, m] ** 2
        if rows * rows > tables.row_limit * (rows2 + variance[0] + variance[1]):
            _forget(m, points, cov, noise)
            outliers[m] = True
            continue
        left2, right2 = sigma_px[0, m] ** 2 + variance[0], sigma_px[1, m] ** 2 + variance[1]
        _add_noise(tables, m, z, left2, right2, work, cov, noise)
        # A point is placed with its covariance, and where its depth is determined (`master.fabrik.rays`).
        if not 4.0 * (cov[m, 0, 0] + cov[m, 1, 1] + cov[m, 2, 2]) < z * z or not np.isfinite(cov[m].sum()):
            _forget(m, points, cov, noise)


class DepthTriangulator:
    """Triangulates the markers of a rig by its depth law. Holds no state."""

    def __init__(self, tables: DisparityTables, caps: CapTables) -> None:
        self._tables, self._caps = tables, caps

    def __call__(
        self,
        uv: Float,
        sigma_px: Float,
        area_px2: Float,
        hand: SolvedHand | None,
        age_s: float,
        *,
        as_seen: bool = False,
    ) -> MarkerPositions:
        """Triangulate centroids uv (C, M, 2) [px] of the first two cameras; NaN: unseen.

        `hand`, `age_s`: a hand of a moment ago, which determines what side of each cap is seen; None: any
        that shows it. `as_seen`: there is no estimate of a hand: what is seen of a marker is taken for its
        centroid.
        """
        count = uv.shape[1]
        ahead, tilt = np.full((count, 3), np.nan), np.zeros((count, 3, 3))
        if hand is not None:
            ahead, tilt = self._caps.pointing(hand, age_s)
        elif not as_seen:
            ahead[self._caps.row >= 0], tilt[:] = -self._tables.R[:, 2], CAPS.any_rad**2 * np.eye(3)
        points, cov = np.empty((count, 3)), np.empty((count, 3, 3))
        noise, outliers = np.empty((count, 3, 3)), np.empty(count, np.bool_)
        triangulate(
            self._tables, self._caps, uv, sigma_px, area_px2, ahead, tilt, points, cov, noise, outliers
        )
        return MarkerPositions(points, cov, noise, outliers, np.zeros(uv.shape[:2], np.bool_))
