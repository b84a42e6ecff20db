"""Where the centre of a marker is in an image whose lens bends the marker's outline.

The centroid of a blob is not the image of the marker's centre: distortion magnifies the outer part of the marker more
(or less) than the inner one and so shifts the centroid, by the third derivative of the lens, in proportion to the
blob's area. For the lens of k1 = 0.1 at 500 px focal length, half way to the corner, that is 0.02 px for a finger cap
(500 px^2) and 1 px for a card that fills a tenth of the image. Perspective shifts the centroid as well, but not of a
target that faces the camera.

The shift is computed, not expanded: the outline of the marker around its centre, sent through the lens, is a polygon,
and its centroid follows from its corners.
"""

from typing import Final

import numpy as np

from common.arrays import Float
from common.camera_model import CameraModel

_CORNERS: Final = 64  # of the polygon; that for a circle is 0.2 % small, which is scaled away
_ROUNDS: Final = 3  # each leaves a few per cent of the shift: the outline starts around the centroid


def round_outline() -> Float:
    """A circle of unit area around the origin, (K, 2)."""
    angle = np.linspace(0.0, 2.0 * np.pi, _CORNERS, endpoint=False)
    return np.stack([np.cos(angle), np.sin(angle)], axis=1) / np.sqrt(np.pi)


def card_outline(width: float, height: float) -> Float:
    """An upright rectangle of unit area around the origin with the sides' ratio `width` : `height`, (K, 2)."""
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


def _polygon(corners: Float) -> tuple[Float, Float]:
    """Areas (N,) and centroids (N, 2) of polygons (N, K, 2), by Green's theorem."""
    origin = corners.mean(axis=1, keepdims=True)  # near the centroid, so that nothing large is subtracted
    a = corners - origin
    b = np.roll(a, -1, axis=1)
    cross = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    area = 0.5 * cross.sum(axis=1)
    centroid = ((a + b) * cross[..., None]).sum(axis=1) / (6.0 * area[:, None])
    return np.abs(area), origin[:, 0] + centroid
