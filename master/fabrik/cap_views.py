"""Kernels over the tables of `master.fabrik.caps`: what a camera sees of a cap."""

from math import acos, cos, sin, sqrt
from typing import NamedTuple

import numpy as np

from common.arrays import Float
from common.kernels import inner, kernel
from master.estimator.cameras import CameraArrays, project
from master.fabrik.caps import CAPS, CapTables
from master.fabrik.intersection import Rays

TILTED = 7  # directions of a cap of a known hand
ANY = 5  # and while no hand is known


class Views(NamedTuple):
    """How one marker looks; T directions that a cap may have, C cameras.

    Attributes:
        area: (C,) [px^2]; NaN: not seen.
        scale: (C,) [m/px] at the marker.
        hidden: (C,) [px^2] variance that occlusion adds.
        aim: (T, 3) directions.
        bias: (T, C, 2) [px] seen centroid less the cap's own.
        whole: (T, C) [m^2] area that the whole cap shows.
        moved: (T, 3) [m] by how much the correction moves the point.
        back, shift: (3,) room.
        gain, step, both: (3, 2), (3, 3), (3, 3) room.
    """

    area: Float
    scale: Float
    hidden: Float
    aim: Float
    bias: Float
    whole: Float
    correction_jacobian_m: Float
    back: Float
    shift: Float
    gain: Float
    step: Float
    both: Float

    @classmethod
    def empty(cls, cameras: int) -> "Views":
        """Room for a number of cameras."""
        return cls(
            np.empty(cameras),
            np.empty(cameras),
            np.empty(cameras),
            np.empty((TILTED, 3)),
            np.empty((TILTED, cameras, 2)),
            np.empty((TILTED, cameras)),
            np.empty((TILTED, 3)),
            np.empty(3),
            np.empty(3),
            np.empty((3, 2)),
            np.empty((3, 3)),
            np.empty((3, 3)),
        )


@kernel
def seen_shift(caps: CapTables, row: int, ahead: Float, back: Float, out: Float) -> float:
    """Write a cap's seen centroid less its own (3,) [m]; return the area seen [m^2].

    Args:
        caps, row: The cap.
        ahead, back: Unit vectors (3,) along the finger and to the eye; NaN: so is what is seen.
        out: Written.
    """
    cosine = ahead[0] * back[0] + ahead[1] * back[1] + ahead[2] * back[2]
    if not np.isfinite(cosine):  # no row of the table
        out[0] = out[1] = out[2] = np.nan
        return np.nan
    cosine = min(max(cosine, -1.0), 1.0)
    last = caps.appearances.shape[1] - 1
    place = acos(cosine) * (last / np.pi)
    low = min(max(int(place), 0), last - 1)
    part = place - low
    along = (1.0 - part) * caps.appearances[row, low, 0] + part * caps.appearances[row, low + 1, 0]
    towards = (1.0 - part) * caps.appearances[row, low, 1] + part * caps.appearances[row, low + 1, 1]
    towards /= max(sqrt(1.0 - cosine * cosine), 1e-9)
    for i in range(3):
        out[i] = along * ahead[i] + towards * (back[i] - cosine * ahead[i])
    return (1.0 - part) * caps.appearances[row, low, 2] + part * caps.appearances[row, low + 1, 2]


@kernel
def tilted(row: int, R: Float, tilt_rad2: Float, rotation_rad2: float, out: Float) -> None:
    """Write the direction of a cap, and six tilted as far as it is uncertain.

    The six are sigma points of two uncertain numbers: the mean square of what differs between them and the first is
    its variance (Julier and Uhlmann 1997; four would do where all is linear, but a cap seen from behind looks
    different from every side).

    Args:
        row: Which.
        R: (K, 3, 3) rotations of the tip joints, rig frame; -z is the finger's direction.
        tilt_rad2: (K, 3, 3) covariance of these directions; only that across them counts.
        rotation_rad2: Variance that their age adds.
        out: Written: (TILTED, 3) unit vectors.
    """
    xx, xy, yy = rotation_rad2, 0.0, rotation_rad2
    for a in range(3):
        for b in range(3):
            xx += R[row, a, 0] * tilt_rad2[row, a, b] * R[row, b, 0]
            xy += R[row, a, 0] * tilt_rad2[row, a, b] * R[row, b, 1]
            yy += R[row, a, 1] * tilt_rad2[row, a, b] * R[row, b, 1]
    least_tilt_rad2 = 1e-30
    # Its Cholesky factor, which gives a round hexagon its shape.
    first = sqrt(max(xx, least_tilt_rad2))
    mixed = xy / first
    second = sqrt(max(yy - mixed * mixed, 0.0))
    most = CAPS.most_tilt
    for i in range(3):
        out[0, i] = -R[row, i, 2]
    for t in range(1, TILTED):
        angle = (t - 1) * np.pi / 3.0
        c, s = sqrt(2.0) * cos(angle), sqrt(2.0) * sin(angle)
        x = min(max(first * c, -most), most)
        y = min(max(mixed * c + second * s, -most), most)
        length = sqrt(1.0 + x * x + y * y)
        for i in range(3):
            out[t, i] = (x * R[row, i, 0] + y * R[row, i, 1] - R[row, i, 2]) / length


@inner
def any_direction(cameras: CameraArrays, point: Float, out: Float) -> None:
    """Write directions in which a cap may point while no hand is known.

    Towards the middle of the cameras, and four bent away from it as far as the cap is still seen.

    Args:
        cameras: Of the rig.
        point: (3,) [m] about where the cap is.
        out: Written: (ANY, 3) unit vectors and more rows.
    """
    back, length = out[0], 0.0
    count = cameras.centre.shape[0]
    for i in range(3):
        back[i] = -point[i]
        for c in range(count):
            back[i] += cameras.centre[c, i] / count
        length += back[i] * back[i]
    length = sqrt(length)
    for i in range(3):
        back[i] /= length
    right, down = out[1], out[2]
    length = 0.0
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        right[i] = back[a] * cameras.R[0, 1, b] - back[b] * cameras.R[0, 1, a]
        length += right[i] * right[i]
    length = sqrt(length)
    for i in range(3):
        right[i] /= length
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        down[i] = back[a] * right[b] - back[b] * right[a]
    away, across = cos(CAPS.bent_rad), sin(CAPS.bent_rad)
    for i in range(3):
        x, y, z = across * right[i], across * down[i], away * back[i]
        out[1, i], out[2, i], out[3, i], out[4, i] = z + x, z + y, z - x, z - y


@kernel
def hidden_part(
    caps: CapTables, row: int, area_px2: Float, scale_m: Float, whole_m2: Float, count: int, out: Float
) -> None:
    """Write the variance (C,) [px^2] of centroids of a marker that is partly hidden.

    What is missing lies to one side, so the centroid of a cap moves by up to a radius, in each camera another way. The
    radius of a cap may be wrong, but it is wrong for all cameras: one that sees less of its share than another sees a
    cap that is partly hidden. Whatever part of a disc is cut off, its centroid moves by about that part of the radius,
    until half is gone. A flat marker may show little because it is tilted or because skin hides it: a camera that sees
    much less of it than the one that sees most knows it to half of its side only.

    Args:
        caps, row: The marker; row -1: flat.
        area_px2: (C,) seen areas; NaN: not measured.
        scale_m: (C,) [m/px] at the marker.
        whole_m2: (count, C) area that the whole cap shows, square to the sight, in each direction that it may have:
            only what none of them explains is hidden. Not used of a flat marker.
        count: Directions.
        out: Written; 0: nothing is hidden.
    """
    cameras, largest = area_px2.shape[0], 0.0
    for c in range(cameras):
        out[c] = 0.0
        size = area_px2[c] * scale_m[c] * scale_m[c]
        if size > largest:
            largest = size
    if row < 0:
        for c in range(cameras):
            share = area_px2[c] * scale_m[c] * scale_m[c] / largest if largest > 0.0 else np.nan
            if share < CAPS.flat_share:
                out[c] = largest * ((1.0 - share) * 0.5 / scale_m[c]) ** 2
        return
    most = 0.0
    for c in range(cameras):
        if not np.isfinite(area_px2[c] * scale_m[c]):
            continue
        shows, alike = 0.0, np.nan
        for t in range(count):
            best = 0.0
            least_area_m2 = 1e-9
            for other in range(cameras):
                size = area_px2[other] * scale_m[other] * scale_m[other]
                best = max(best, size / max(whole_m2[t, other], least_area_m2)) if size > 0.0 else best
            share = area_px2[c] * scale_m[c] * scale_m[c] / max(whole_m2[t, c], least_area_m2)
            shows = max(shows, share)
            if best > 0.0 and not share / best <= alike:
                alike = share / best
        out[c] = max(1.0 - shows / CAPS.least_share, 0.0)
        if alike < CAPS.alike_share:
            out[c] = max(out[c], 1.0 - alike)
        most = max(most, out[c])
    for c in range(cameras):
        if np.isfinite(area_px2[c] * scale_m[c]):
            out[c] = (max(out[c], CAPS.reach * most) * caps.radius_m[row] / scale_m[c]) ** 2


@inner
def appearance(
    cameras: CameraArrays, caps: CapTables, row: int, count: int, rays: Rays, views: Views
) -> None:
    """Write bias and area of a cap in all cameras for `count` directions.

    A flat marker has neither.
    """
    back, shift = views.back, views.shift
    for c in range(rays.weight.shape[0]):
        distance = 0.0
        for i in range(3):
            back[i] = cameras.centre[c, i] - rays.point[i]
            distance += back[i] * back[i]
        distance = sqrt(distance)
        views.scale[c] = distance / cameras.scale[c]
        for t in range(count):
            views.bias[t, c, 0] = views.bias[t, c, 1] = views.whole[t, c] = 0.0
        if row < 0 or rays.weight[c] == 0.0 or not project(cameras, c, rays.point, rays.seen, rays.J):
            continue
        u, v, J, R, depth = rays.seen[0], rays.seen[1], rays.J, cameras.R, cameras.t[c, 2]
        for i in range(3):
            back[i] /= distance
            depth += R[c, 2, i] * rays.point[i]
        for t in range(count - 1, -1, -1):  # last the first one, whose shift is used below
            shown = seen_shift(caps, row, views.aim[t], back, shift)
            if np.isfinite(shown):
                views.whole[t, c] = shown
                # Of a pinhole this is exact.
                nearer = depth / (
                    depth + R[c, 2, 0] * shift[0] + R[c, 2, 1] * shift[1] + R[c, 2, 2] * shift[2]
                )
                views.bias[t, c, 0] = nearer * (J[0, 0] * shift[0] + J[0, 1] * shift[1] + J[0, 2] * shift[2])
                views.bias[t, c, 1] = nearer * (J[1, 0] * shift[0] + J[1, 1] * shift[1] + J[1, 2] * shift[2])
        for i in range(3):
            shift[i] += rays.point[i]
        if project(cameras, c, shift, rays.seen, rays.J):
            # With the lens the bias of the first direction is exact; the rest is nearly the same for those around it.
            rest_u, rest_v = rays.seen[0] - u - views.bias[0, c, 0], rays.seen[1] - v - views.bias[0, c, 1]
            for t in range(count):
                views.bias[t, c, 0] += rest_u
                views.bias[t, c, 1] += rest_v
