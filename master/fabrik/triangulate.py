"""Points from the centroids of two cameras by the depth model of the rig: disparity, D = k x^z, X, Y, Z, covariance.

Kalbfleisch measures x = u_left - u_right on the images as they are, not rectified, and fits D = k x^z with a target on
the axis (section VI). There the law contains how the cameras are misaligned. Away from the axis lens, roll and yaw
change the disparity of the same depth: of the shipped desk rig, whose right camera is rolled by 0.3 degrees, by 0.8 px
at the edge of the volume, which is 8 mm. By the rig's own geometry that change is

    x(u, v, D) - x(axis, D) = a(u, v) + b(u, v) / D

to a hundredth of a pixel, so a and b are tabulated over the left image and what they say is taken from the disparity
before the law is asked. On the axis, and for parallel cameras without distortion, it is 0. In the same way the row at
which the right camera must see the marker is tabulated: a marker whose rows disagree is two things, and dropped.

A camera sees the side of a painted finger tip that faces it, so the centroid is up to half a radius off that of the
cap; by how much follows from the direction in which the finger pointed in the last frame (`CapView`).

Covariance by the derivatives: along the sight |dD/dx| sigma_x, across it D sigma_u / f, and what the law's fit left.
"""

from math import acos, sqrt
from typing import NamedTuple

import numpy as np

from common.arrays import Bool, Float, Int
from common.camera_model import CameraModel
from common.kernels import kernel
from master.stereo.depth import DepthLaw, PowerLaw

GRID = 48  # cells of the table along each side of the image
_DEPTHS_M = np.array([0.35, 0.45, 0.6, 0.8, 1.1])


class DisparityTables(NamedTuple):
    """A pair of cameras and its law as flat arrays.

    Attributes:
        power: Whether D = k x^z; else D = k / (x - z).
        k, z: Of the law.
        cell_px: (2,) width and height of a cell.
        table: (GRID + 1, GRID + 1, 6) at each corner (row, column): a, b of the disparity off the axis, a, b of the
            difference of rows, and x, y of the undistorted ray.
        R, centre: (3, 3), (3,) the left camera in the rig.
        camera_R: (2, 3, 3) rotations rig -> camera, for what each sees of a cap.
        focal_px: (2,).
    """

    power: bool
    k: float
    z: float
    cell_px: Float
    table: Float
    R: Float
    centre: Float
    camera_R: Float
    centres: Float
    focal_px: Float


def disparity_tables(cameras: tuple[CameraModel, ...], law: DepthLaw) -> DisparityTables:
    """Tabulate the pair's geometry over the left image."""
    left, right = cameras[:2]
    u = np.linspace(0.0, left.width_px, GRID + 1)
    v = np.linspace(0.0, left.height_px, GRID + 1)
    uv = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    xy = left.undistort(uv)
    axis = left.matrix[:2, 2]
    design = np.stack([np.ones_like(_DEPTHS_M), 1.0 / _DEPTHS_M], axis=1)
    table = np.empty((len(uv), 6))
    disparity, rows = np.empty((len(_DEPTHS_M), len(uv))), np.empty((len(_DEPTHS_M), len(uv)))
    for k, depth in enumerate(_DEPTHS_M):
        seen = right.project(_rig(left, np.concatenate([xy, np.ones((len(xy), 1))], axis=1) * depth))
        on_axis = right.project(_rig(left, np.array([[0.0, 0.0, depth]])))[0]
        disparity[k] = (uv[:, 0] - seen[:, 0]) - (axis[0] - on_axis[0])
        rows[k] = uv[:, 1] - seen[:, 1]
    solve = np.linalg.pinv(design)
    table[:, :2], table[:, 2:4], table[:, 4:] = (solve @ disparity).T, (solve @ rows).T, xy
    first, second = (law.k_m, law.z) if isinstance(law, PowerLaw) else (law.a_m_px, law.x0_px)
    return DisparityTables(
        isinstance(law, PowerLaw),
        first,
        second,
        np.array([left.width_px / GRID, left.height_px / GRID]),
        table.reshape(GRID + 1, GRID + 1, 6),
        np.ascontiguousarray(left.T_rig_camera[:3, :3]),
        np.ascontiguousarray(left.centre),
        np.array([camera.T_rig_camera[:3, :3].T for camera in cameras[:2]]),
        np.array([camera.centre for camera in cameras[:2]]),
        np.array([camera.matrix[0, 0] for camera in cameras[:2]]),
    )


def _rig(camera: CameraModel, points: Float) -> Float:
    return points @ camera.T_rig_camera[:3, :3].T + camera.centre


class CapTables(NamedTuple):
    """How the painted cap of each of M markers looks from all sides.

    Attributes:
        row: (M,) row of `looks`; -1: flat, its centroid is what is seen.
        looks: (K, A + 1, 3) over the angle between finger and sight, 0 to pi: shift of the seen centroid along the
            finger and towards the eye [m], and the area seen.
    """

    row: Int
    looks: Float


@kernel
def depth(tables: DisparityTables, disparity: float) -> float:
    """Depth [m] by the law of a disparity [px]; NaN where there is none."""
    if tables.power:
        return tables.k * disparity**tables.z if disparity > 0.0 else np.nan
    off = disparity - tables.z
    return tables.k / off if off > 0.0 else np.nan


@kernel
def metres_per_pixel(tables: DisparityTables, depth_m: float) -> float:
    """|dD/dx| [m/px] at a depth [m]."""
    if tables.power:
        return -tables.z * depth_m / (depth_m / tables.k) ** (1.0 / tables.z)
    return depth_m * depth_m / tables.k


@kernel
def seen_shift(caps: CapTables, row: int, ahead: Float, back: Float, out: Float) -> None:
    """Write the seen centroid of a cap less its own (3,) [m], for unit vectors along the finger and to the eye."""
    cosine = ahead[0] * back[0] + ahead[1] * back[1] + ahead[2] * back[2]
    cosine = min(max(cosine, -1.0), 1.0)
    last = caps.looks.shape[1] - 1
    place = acos(cosine) * (last / np.pi)
    low = min(int(place), last - 1)
    part = place - low
    along = (1.0 - part) * caps.looks[row, low, 0] + part * caps.looks[row, low + 1, 0]
    towards = (1.0 - part) * caps.looks[row, low, 1] + part * caps.looks[row, low + 1, 1]
    towards /= max(sqrt(1.0 - cosine * cosine), 1e-9)
    for i in range(3):
        out[i] = along * ahead[i] + towards * (back[i] - cosine * ahead[i])


@kernel
def triangulate(
    tables: DisparityTables,
    caps: CapTables,
    uv: Float,
    sigma_px: Float,
    ahead: Float,
    law_error: float,
    points: Float,
    cov: Float,
    rows_px: Float,
) -> None:
    """Write the points (M, 3) [m] of markers, their covariances, and by how much their rows disagree (M,) [px].

    Args:
        tables, caps: The pair and the markers.
        uv: (2, M, 2) centroids [px]; NaN: not seen.
        sigma_px: (2, M).
        ahead: (M, 3) unit vectors in which the fingers point, rig frame; NaN: not known, what is seen is taken.
        law_error: Relative standard deviation of the law.
        points, cov, rows_px: Written; NaN where a camera does not see the marker or the disparity is none.
    """
    bias, shift, back, ray = np.empty((2, 2)), np.empty(3), np.empty(3), np.empty(3)
    by = np.empty((3, 3))
    for m in range(uv.shape[1]):
        points[m, :] = np.nan
        cov[m, :, :] = np.nan
        rows_px[m] = np.nan
        if not np.isfinite(uv[0, m, 0] + uv[0, m, 1] + uv[1, m, 0] + uv[1, m, 1]):
            continue
        bias[:, :] = 0.0
        row = caps.row[m]
        turns = 2 if row >= 0 and np.isfinite(ahead[m, 0]) else 1
        z, rows, x, y = np.nan, 0.0, 0.0, 0.0
        for turn in range(turns):
            u, v = uv[0, m, 0] - bias[0, 0], uv[0, m, 1] - bias[0, 1]
            right_u, right_v = uv[1, m, 0] - bias[1, 0], uv[1, m, 1] - bias[1, 1]
            across, down = u / tables.cell_px[0], v / tables.cell_px[1]
            i = min(max(int(down), 0), tables.table.shape[0] - 2)
            j = min(max(int(across), 0), tables.table.shape[1] - 2)
            q, p = across - j, down - i
            w00, w01, w10, w11 = (1.0 - p) * (1.0 - q), (1.0 - p) * q, p * (1.0 - q), p * q
            a = w00 * tables.table[i, j, 0] + w01 * tables.table[i, j + 1, 0]
            a += w10 * tables.table[i + 1, j, 0] + w11 * tables.table[i + 1, j + 1, 0]
            b = w00 * tables.table[i, j, 1] + w01 * tables.table[i, j + 1, 1]
            b += w10 * tables.table[i + 1, j, 1] + w11 * tables.table[i + 1, j + 1, 1]
            rows = w00 * tables.table[i, j, 2] + w01 * tables.table[i, j + 1, 2]
            rows += w10 * tables.table[i + 1, j, 2] + w11 * tables.table[i + 1, j + 1, 2]
            rows_b = w00 * tables.table[i, j, 3] + w01 * tables.table[i, j + 1, 3]
            rows_b += w10 * tables.table[i + 1, j, 3] + w11 * tables.table[i + 1, j + 1, 3]
            x = w00 * tables.table[i, j, 4] + w01 * tables.table[i, j + 1, 4]
            x += w10 * tables.table[i + 1, j, 4] + w11 * tables.table[i + 1, j + 1, 4]
            y = w00 * tables.table[i, j, 5] + w01 * tables.table[i, j + 1, 5]
            y += w10 * tables.table[i + 1, j, 5] + w11 * tables.table[i + 1, j + 1, 5]
            disparity = u - right_u
            z = depth(tables, disparity)
            for _ in range(3):  # each leaves a thousandth
                z = depth(tables, disparity - a - b / z)
            if not np.isfinite(z):
                break
            rows = v - right_v - rows - rows_b / z
            for k in range(3):
                ray[k] = tables.R[k, 0] * x + tables.R[k, 1] * y + tables.R[k, 2]
                points[m, k] = tables.centre[k] + z * ray[k]
            if turn + 1 < turns:
                for c in range(2):
                    length = 0.0
                    for k in range(3):
                        back[k] = tables.centres[c, k] - points[m, k]
                        length += back[k] * back[k]
                    length = sqrt(length)
                    here_x = here_y = here_z = shift_x = shift_y = shift_z = 0.0
                    for k in range(3):
                        here_x -= tables.camera_R[c, 0, k] * back[k]
                        here_y -= tables.camera_R[c, 1, k] * back[k]
                        here_z -= tables.camera_R[c, 2, k] * back[k]
                    for k in range(3):
                        back[k] /= length
                    seen_shift(caps, row, ahead[m], back, shift)
                    for k in range(3):
                        shift_x += tables.camera_R[c, 0, k] * shift[k]
                        shift_y += tables.camera_R[c, 1, k] * shift[k]
                        shift_z += tables.camera_R[c, 2, k] * shift[k]
                    there = here_z + shift_z
                    bias[c, 0] = tables.focal_px[c] * ((here_x + shift_x) / there - here_x / here_z)
                    bias[c, 1] = tables.focal_px[c] * ((here_y + shift_y) / there - here_y / here_z)
        if not np.isfinite(z):
            points[m, :] = np.nan
            continue
        rows_px[m] = rows
        per_px, scale = metres_per_pixel(tables, z), z / tables.focal_px[0]
        for k in range(3):  # derivatives by u of the left camera, v of it, and u of the right one
            by[k, 0] = scale * tables.R[k, 0] - per_px * ray[k]
            by[k, 1] = scale * tables.R[k, 1]
            by[k, 2] = per_px * ray[k]
        left2, right2, law2 = sigma_px[0, m] ** 2, sigma_px[1, m] ** 2, (law_error * z) ** 2
        for k in range(3):
            for l in range(3):
                cov[m, k, l] = (
                    left2 * (by[k, 0] * by[l, 0] + by[k, 1] * by[l, 1])
                    + right2 * by[k, 2] * by[l, 2]
                    + law2 * ray[k] * ray[l]
                )
