"""Centroid bias of a marker in an image whose lens distorts its outline.

It gives the image position of the marker's centre.

The centroid of a blob is not the image of the marker's centre: distortion magnifies the outer part of the marker more
(or less) than the inner one and so shifts the centroid, by the third derivative of the lens, in proportion to the
blob's area. For the lens of k1 = 0.1 at 500 px focal length, half way to the corner, that is 0.02 px for a finger cap
(500 px^2) and 1 px for a card that fills a tenth of the image. Perspective shifts the centroid as well, but not of a
target that faces the camera.

Where the outline is known, the shift is computed (`centre_of_blob`): sent through the lens, the outline is a polygon,
and its centroid follows from its corners. In every frame it is expanded to second order (`LensShift`).
"""

from math import pi
from typing import Final

import numpy as np

from common.arrays import Float
from common.geometry.camera_model import CameraModel

_CORNERS: Final = 64  # of the polygon; that for a circle is 0.2 % small, which is scaled away
_ROUNDS: Final = 3  # each leaves a few per cent of the shift: the outline starts around the centroid
_CELL_PX: Final = 8


def round_outline() -> Float:
    """A circle of unit area around the origin, (K, 2)."""
    angle = np.linspace(0.0, 2.0 * np.pi, _CORNERS, endpoint=False)
    return np.stack([np.cos(angle), np.sin(angle)], axis=1) / np.sqrt(np.pi)


def card_outline(width: float, height: float) -> Float:
    """Return an upright rectangle of unit area around the origin, (K, 2).

    The ratio of its sides is `width` : `height`.
    """
    corners = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
    along = np.linspace(0.0, 1.0, _CORNERS // 4, endpoint=False)[:, None]  # the lens bends the sides
    sides = [a + along * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
    return np.concatenate(sides) * np.array([width, height]) / np.sqrt(width * height)


def centre_of_blob(camera: CameraModel, uv: Float, area_px2: Float, outline: Float) -> Float:
    """Pixels (N, 2) at which the camera sees the centres of markers that face it.

    Args:
        camera: The camera.
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
    for _ in range(_ROUNDS):
        xy = camera.undistort(centre)
        area, _ = _polygon(camera.distort(xy[:, None] + size[:, None, None] * outline))
        size = size * np.sqrt(area_px2[known] / area)
        _, centroid = _polygon(camera.distort(xy[:, None] + size[:, None, None] * outline))
        centre = centre + seen - centroid
    out[known] = centre
    return out


class LensShift:
    """Centroid shift of round blobs in all cameras of a rig, from their areas.

    Holds no state between calls.

    With g the lens (normalised point -> pixel), S its determinant |dg/dx| and a region around x of the isotropic second
    moment m per axis, the centroid of the region's image is, to second order in its size (Taylor expansion of
    integral g S / integral S; the first moments vanish about the centre),

        g(x) + m (1/2 Laplacian g + dg/dx grad ln S),      m = area_px2 / (4 pi S) for a disc

    For the radial lens R(s) = 1 + k1 s + k2 s^2 + k3 s^3, s = x^2 + y^2, the bracket is
    f (12 R' + 6 s R'' + 4 s R'^2 / R) (x, y); p1 and p2 add 12 f (p2, p1), their products with k left out.
    It is tabulated once, on a grid of the image.

    Attributes:
        any: Whether a lens distorts.
    """

    def __init__(self, cameras: tuple[CameraModel, ...]) -> None:
        """Tabulate the lenses of these cameras."""
        self.any = any(camera.distortion.any() for camera in cameras)
        cells = np.array([[camera.width_px, camera.height_px] for camera in cameras]) // _CELL_PX + 1
        columns, rows = (int(n) for n in cells.max(axis=0))
        middles = np.empty((rows, columns, 2))
        middles[..., 0] = _CELL_PX * np.arange(columns)
        middles[..., 1] = _CELL_PX * np.arange(rows)[:, None]
        self._per_px2 = np.stack([_shift_per_px2(camera, middles) for camera in cameras])
        self._last = (cells - 1.0)[:, None]  # (C, 1, 2)
        self._camera = np.arange(len(cameras))[:, None]

    def centres(self, uv: Float, area_px2: Float) -> Float:
        """Where the cameras see the centres (C, M, 2) [px] of round blobs.

        Args:
            uv: Centroids (C, M, 2) [px], distorted images. NaN: not seen.
            area_px2: Areas (C, M) [px^2]. NaN: not known, the centroid is returned.
        """
        cell = np.fmin(np.fmax(uv / _CELL_PX + 0.5, 0.0), self._last).astype(np.int64)  # NaN: any
        shift = self._per_px2[self._camera, cell[..., 1], cell[..., 0]]
        return uv - shift * np.fmax(area_px2, 0.0)[..., None]


def _shift_per_px2(camera: CameraModel, uv: Float) -> Float:
    """Return the centroid shift by area [px/px^2] at image positions (..., 2) [px].

    It is 0 where the lens model is folded.
    """
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
