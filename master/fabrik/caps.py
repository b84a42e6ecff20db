"""Painted finger tips and lenses shift centroids; tables correct them.

A cap is the rounded end of a finger: half a sphere of the tip's radius about the tip joint, and a stretch of
cylinder behind it whose length follows from the profile's offset (the centroid of half a sphere and of a
cylinder of length L lies (r - L) / 2 ahead of the centre). A camera sees the part that faces it, and the
centroid of that silhouette is the mean of the facing surface weighted by the cosine of its tilt.

The centroid of a blob is not the image of the marker's centre either: distortion magnifies the outer part of
the marker more (or less) than the inner one and so shifts the centroid, by the third derivative of the lens,
in proportion to the blob's area. For the lens of k1 = 0.1 at 500 px focal length, half way to the corner,
that is 0.02 px for a finger cap (500 px^2) and 1 px for a card that fills a tenth of the image. Perspective
shifts the centroid as well, but not of a target that faces the camera. Where the outline is known, it is sent
through the lens as a polygon (`centre_of_blob`); in every frame it is expanded to second order (`LensShift`).
"""

from functools import lru_cache
from math import acos, cos, pi, sin, sqrt
from typing import NamedTuple

import numpy as np

from common.arrays import Float, Int
from common.geometry.camera_model import CameraModel
from common.hand.model import HandModel
from common.kernels import inner, kernel
from master.estimator.epoch import SolvedHand
from master.estimator.sensors import CameraArrays, project
from master.fabrik.intersection import Rays
from master.fabrik.settings import CAPS


class CapTables(NamedTuple):
    """How the M markers of a rig look from all sides; K of them are caps.

    `appearances` (K, A + 1, 3), over the angle between finger and sight, 0 to pi: shift of the seen centroid
    along the finger and towards the eye [m], and the area seen [m^2].
    """

    row: Int  # (M,) row of `appearances`; -1: flat, its centroid is what is seen
    appearances: Float
    radius_m: Float  # (K,)
    joint: Int  # (K,) index of the tip joint
    finger: Int  # (K,)

    @classmethod
    def of(cls, model: HandModel, markers: tuple[str, ...]) -> "CapTables":
        """Tabulate the caps of a hand, cached; markers on the palm or no hand are flat."""
        return _tables(model, markers)

    @classmethod
    def flat(cls, count: int) -> "CapTables":
        """Tables of markers that are all flat."""
        nothing = np.zeros(0, np.int64)
        appearances = np.zeros((0, CAPS.angles + 1, 3))
        return cls(np.full(count, -1, np.int64), appearances, np.zeros(0), nothing, nothing)

    def pointing(self, hand: SolvedHand, age_s: float) -> tuple[Float, Float]:
        """Directions of the caps of a hand of `age_s` [s] ago.

        Returns:
            Unit vectors (M, 3), rig frame, and their covariances (M, 3, 3) [rad^2]; NaN and 0 for flat markers.
        """
        ahead, tilt = np.full((len(self.row), 3), np.nan), np.zeros((len(self.row), 3, 3))
        caps = self.row >= 0
        ahead[caps] = -hand.joints.rotation[self.joint, :, 2]
        rotation_m2 = (CAPS.rotation_rad_s * age_s) ** 2 * np.eye(3)
        tilt[caps] = hand.tilt_cov_rad2[self.finger] + rotation_m2
        return ahead, tilt


@lru_cache(maxsize=CAPS.tables)
def _tables(model: HandModel, markers: tuple[str, ...]) -> CapTables:
    out = CapTables.flat(len(markers))
    joints, fingers, appearances = list[int](), list[int](), list[Float]()
    for m, name in enumerate(markers):
        mount = model.mount(name) if name in model.mounts else None
        if mount is None or mount.joint is None or mount.finger is None:
            continue
        points, normals, areas = cap_surface(float(model.radius_m[mount.joint]), float(-mount.offset_m[2]))
        # The sampled cap is placed so that its centroid is exactly the profile's point.
        points -= np.average(points, axis=0, weights=areas)
        out.row[m] = len(appearances)
        appearances.append(_appearances(points, normals, areas))
        joints.append(mount.joint)
        fingers.append(mount.finger)
    if not appearances:
        return out
    radii = np.array([model.radius_m[joint] for joint in joints])
    return out._replace(
        appearances=np.array(appearances),
        radius_m=radii,
        joint=np.array(joints, np.int64),
        finger=np.array(fingers, np.int64),
    )


def _appearances(points: Float, normals: Float, areas: Float) -> Float:
    """Tabulate a cap whose finger points 0..180 degrees away from the eye.

    (CAPS.angles + 1, 3): the seen centroid along the finger and, square to it, towards the eye [m], from the
    cap's own; and the area seen [m^2]. A cap is round, so that the one angle is enough.
    """
    angle = np.arange(CAPS.angles + 1) * (np.pi / CAPS.angles)
    eye = np.stack([np.sin(angle), np.zeros_like(angle), -np.cos(angle)], axis=1)
    visible_m2 = np.maximum(eye @ normals.T, 0.0) * areas
    shown = visible_m2.sum(axis=1)
    least_area_m2 = 1e-9
    seen = visible_m2 @ points / np.maximum(shown, least_area_m2)[:, None]
    return np.stack([-seen[:, 2], seen[:, 0], shown], axis=1)


def cap_surface(radius_m: float, ahead_m: float) -> tuple[Float, Float, Float]:
    """Sample a cap in the tip joint's frame (-z to the finger's end).

    `ahead_m`: how far the cap's centroid lies ahead of the tip joint, at most half a radius.

    Returns:
        Points (N, 3) [m], outward normals (N, 3), areas (N,) [m^2].
    """
    length = max(radius_m - 2.0 * min(ahead_m, 0.5 * radius_m), 0.0)
    rings, spokes = CAPS.rings, CAPS.spokes
    phi = (np.arange(spokes) + 0.5) * 2 * np.pi / spokes
    circle = np.stack([np.cos(phi), np.sin(phi), np.zeros(spokes)], axis=1)
    # Rings of equal height have equal area, on a sphere as on a cylinder (Archimedes).
    height = (np.arange(rings) + 0.5) / rings
    points: list[Float] = []
    normals: list[Float] = []
    areas: list[Float] = []
    for h in height:
        normal = circle * np.sqrt(1 - h * h) - [0.0, 0.0, h]
        points.append(radius_m * normal)
        normals.append(normal)
        areas.append(np.full(spokes, 2 * np.pi * radius_m**2 / (rings * spokes)))
        points.append(radius_m * circle + [0.0, 0.0, length * h])
        normals.append(circle)
        areas.append(np.full(spokes, 2 * np.pi * radius_m * length / (rings * spokes)))
    return np.concatenate(points), np.concatenate(normals), np.concatenate(areas)


class Views(NamedTuple):
    """How one marker looks; T directions that a cap may have, C cameras."""

    area: Float  # (C,) [px^2]; NaN: not seen
    scale: Float  # (C,) [m/px] at the marker
    hidden: Float  # (C,) [px^2] variance that occlusion adds
    aim: Float  # (T, 3) directions
    bias: Float  # (T, C, 2) [px] seen centroid less the cap's own
    whole: Float  # (T, C) [m^2] area that the whole cap shows
    correction_jacobian_m: Float  # (T, 3) [m] by how much the correction moves the point
    back: Float  # (3,) from here on scratch
    shift: Float
    gain: Float
    step: Float
    both: Float

    @classmethod
    def empty(cls, cameras: int) -> "Views":
        """Room for a number of cameras."""
        T, by_camera = CAPS.tilted, (np.empty(cameras), np.empty(cameras), np.empty(cameras))
        by_direction = np.empty((T, 3)), np.empty((T, cameras, 2)), np.empty((T, cameras)), np.empty((T, 3))
        scratch = np.empty(3), np.empty(3), np.empty((3, 2)), np.empty((3, 3)), np.empty((3, 3))
        return cls(*by_camera, *by_direction, *scratch)


@kernel
def seen_shift(caps: CapTables, row: int, ahead: Float, back: Float, out: Float) -> float:
    """Write a cap's seen centroid less its own (3,) [m]; return the area seen [m^2].

    `ahead`, `back`: unit vectors (3,) along the finger and to the eye; NaN: so is what is seen.
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

    The six are sigma points of two uncertain numbers: the mean square of what differs between them and the
    first is its variance (Julier and Uhlmann 1997; four would do where all is linear, but a cap seen from
    behind looks different from every side). `R` (K, 3, 3): -z is the finger's direction, rig frame;
    `tilt_rad2` (K, 3, 3) its covariance; `rotation_rad2`: variance that its age adds; `out` (CAPS.tilted, 3).
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
    for t in range(1, CAPS.tilted):
        angle = (t - 1) * np.pi / 3.0
        c, s = sqrt(2.0) * cos(angle), sqrt(2.0) * sin(angle)
        x = min(max(first * c, -most), most)
        y = min(max(mixed * c + second * s, -most), most)
        length = sqrt(1.0 + x * x + y * y)
        for i in range(3):
            out[t, i] = (x * R[row, i, 0] + y * R[row, i, 1] - R[row, i, 2]) / length


@inner
def any_direction(cameras: CameraArrays, point: Float, out: Float) -> None:
    """Write where a cap at a point may point (CAPS.any_tilted, 3), hand unknown.

    Towards the middle of the cameras, and four bent away from it as far as the cap is still seen.
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

    What is missing lies to one side, so the centroid of a cap moves by up to a radius, in each camera another
    way. The radius of a cap may be wrong, but it is wrong for all cameras: one that sees less of its share
    than another sees a cap that is partly hidden. Whatever part of a disc is cut off, its centroid moves by
    about that part of the radius, until half is gone. A flat marker (row -1) may show little because it is
    tilted or because skin hides it: a camera that sees much less of it than the one that sees most knows it
    to half of its side only.

    Args:
        area_px2: (C,) seen areas; NaN: not measured.
        scale_m: (C,) [m/px] at the marker.
        whole_m2: (count, C) area that the whole cap shows, square to the sight, in each direction that it may have:
            only what none of them explains is hidden. Not used of a flat marker.
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
            out[c] = (max(out[c], CAPS.least_hidden * most) * caps.radius_m[row] / scale_m[c]) ** 2


@inner
def appearance(
    cameras: CameraArrays, caps: CapTables, row: int, count: int, rays: Rays, views: Views
) -> None:
    """Write bias and area of a cap, none of a flat marker, for `count` directions."""
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


def round_outline() -> Float:
    """A circle of unit area around the origin, (K, 2)."""
    angle = np.linspace(0.0, 2.0 * np.pi, CAPS.corners, endpoint=False)
    return np.stack([np.cos(angle), np.sin(angle)], axis=1) / np.sqrt(np.pi)


def card_outline(width: float, height: float) -> Float:
    """Return an upright rectangle (K, 2) of unit area, `width` : `height`, around 0."""
    corners = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
    along = np.linspace(0.0, 1.0, CAPS.corners // 4, endpoint=False)[:, None]  # the lens bends the sides
    sides = [a + along * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
    return np.concatenate(sides) * np.array([width, height]) / np.sqrt(width * height)


def centre_of_blob(camera: CameraModel, uv: Float, area_px2: Float, outline: Float) -> Float:
    """Pixels (N, 2) at which the camera sees the centres of markers that face it.

    Args:
        uv: Centroids of the blobs (N, 2) [px], distorted image. NaN: not seen.
        area_px2: Areas of the blobs (N,) [px^2]. NaN: not known, the centroid is returned.
        outline: Corners (K, 2) of the marker's shape, of unit area, around its centre.
    """
    known = np.isfinite(uv).all(axis=1) & np.isfinite(area_px2)
    out = np.array(uv, dtype=np.float64)
    if not known.any():
        return out
    seen = out[known]
    size = np.sqrt(area_px2[known] / (camera.matrix[0, 0] * camera.matrix[1, 1]))
    centre = seen
    for _ in range(CAPS.rounds):
        xy = camera.undistort(centre)
        area, _ = _polygon(camera.distort(xy[:, None] + size[:, None, None] * outline))
        size = size * np.sqrt(area_px2[known] / area)
        _, centroid = _polygon(camera.distort(xy[:, None] + size[:, None, None] * outline))
        centre = centre + seen - centroid
    out[known] = centre
    return out


class LensShift:
    """Centroid shift of round blobs in all cameras of a rig, from their areas.

    With g the lens (normalised point -> pixel), S its determinant |dg/dx| and a region around x of the
    isotropic second moment m per axis, the centroid of the region's image is, to second order in its size
    (Taylor expansion of integral g S / integral S; the first moments vanish about the centre),

        g(x) + m (1/2 Laplacian g + dg/dx grad ln S),      m = area_px2 / (4 pi S) for a disc

    For the radial lens R(s) = 1 + k1 s + k2 s^2 + k3 s^3, s = x^2 + y^2, the bracket is
    f (12 R' + 6 s R'' + 4 s R'^2 / R) (x, y); p1 and p2 add 12 f (p2, p1), their products with k left out.
    It is tabulated once, on a grid of the image. `any`: whether a lens distorts.
    """

    def __init__(self, cameras: tuple[CameraModel, ...]) -> None:
        self.any = any(camera.distortion.any() for camera in cameras)
        cells = np.array([[camera.width_px, camera.height_px] for camera in cameras]) // CAPS.cell_px + 1
        columns, rows = (int(n) for n in cells.max(axis=0))
        middles = np.empty((rows, columns, 2))
        middles[..., 0] = CAPS.cell_px * np.arange(columns)
        middles[..., 1] = CAPS.cell_px * np.arange(rows)[:, None]
        self._per_px2 = np.stack([_shift_per_px2(camera, middles) for camera in cameras])
        self._last = (cells - 1.0)[:, None]  # (C, 1, 2)
        self._camera = np.arange(len(cameras))[:, None]

    def centres(self, uv: Float, area_px2: Float) -> Float:
        """Where cameras see blobs' centres (C, M, 2) [px]; area NaN: the centroids."""
        cell = np.fmin(np.fmax(uv / CAPS.cell_px + 0.5, 0.0), self._last).astype(np.int64)  # NaN: any
        shift = self._per_px2[self._camera, cell[..., 1], cell[..., 0]]
        return uv - shift * np.fmax(area_px2, 0.0)[..., None]


def _shift_per_px2(camera: CameraModel, uv: Float) -> Float:
    """Return the shift by area [px/px^2] at (..., 2) [px]; 0: the lens folds there."""
    k1, k2, p1, p2, k3 = camera.distortion.tolist()
    focal = camera.matrix[[0, 1], [0, 1]]
    xy = camera.undistort(uv)
    s = (xy * xy).sum(axis=-1, keepdims=True)
    R = 1.0 + s * (k1 + s * (k2 + s * k3))
    first, second = k1 + s * (2.0 * k2 + s * 3.0 * k3), 2.0 * k2 + 6.0 * s * k3
    bracket = (12.0 * first + 6.0 * s * second + 4.0 * s * first**2 / R) * xy + 12.0 * np.array([p2, p1])
    det = R * (R + 2.0 * s * first) + 8.0 * (xy @ np.array([p2, p1]))[..., None]
    # Beyond the fold of a polynomial that was fitted to less of the image no place has an original.
    found = (R > 0.0) & (det > 0.0) & (np.abs(camera.distort(xy) - uv).max(axis=-1, keepdims=True) < 1.0)
    shift = focal * bracket / (4.0 * pi * np.where(found, det, np.inf) * focal.prod())
    return np.where(found, shift, 0.0)


def _polygon(corners: Float) -> tuple[Float, Float]:
    """Areas (N,) and centroids (N, 2) of polygons (N, K, 2), by Green's theorem."""
    origin = corners.mean(axis=1, keepdims=True)  # near the centroid, so that nothing large is subtracted
    a = corners - origin
    b = np.roll(a, -1, axis=1)
    cross = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    area = 0.5 * cross.sum(axis=1)
    centroid = ((a + b) * cross[..., None]).sum(axis=1) / (6.0 * area[:, None])
    return np.abs(area), origin[:, 0] + centroid
