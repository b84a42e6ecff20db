"""Dark quadrilaterals on bright ground, as candidates for tags.

They are found before the code of a tag is read.
"""

import cv2
import numpy as np

from common.arrays import Float, Image

PROBES = np.array([0.2, 0.35, 0.5, 0.65, 0.8])  # of a side


def quads(grey: Image) -> Float:
    """Corners (N, 4, 2) [px], clockwise, to a pixel or two."""
    window = 23  # px of the local mean that a tag's border is darker than
    if min(grey.shape) < window:
        return np.zeros((0, 4, 2))
    darker = 6.0  # bytes
    dark = cv2.adaptiveThreshold(grey, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV, window, darker)
    outlines, _ = cv2.findContours(dark, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    found: list[tuple[float, Float]] = []  # area, corners
    for outline in outlines:
        least_outline, most_outline = 36, 1600  # px
        if least_outline <= len(outline) <= most_outline:
            straight = 0.06  # of the outline: by how much it may leave the four lines
            corners = cv2.approxPolyDP(outline, straight * len(outline), True).reshape(-1, 2)
            if len(corners) == 4 and cv2.isContourConvex(corners):
                sides = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1)
                area = cv2.contourArea(corners)
                least_side_px = 7.0
                least_fill = 0.4  # of the bounding box of the turned patch
                if sides.min() >= least_side_px and area >= least_fill * sides.max() * sides.min():
                    found.append((area, corners.astype(np.float64)))
    found.sort(key=lambda quad: -quad[0])
    if not found:
        return np.zeros((0, 4, 2))
    most = 16  # quads of one search that are looked at, the largest
    return _with_margin(_dark_inside(grey, _clockwise(np.array([corners for _, corners in found])))[:most])


def _with_margin(corners: Float) -> Float:
    """Return the same quadrilaterals with their sides moved outward.

    An outline runs through the middles of the outermost dark pixels.
    """
    along = np.roll(corners, -1, axis=1) - corners
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    before = np.roll(along, 1, axis=1)
    sine = before[..., 0] * along[..., 1] - before[..., 1] * along[..., 0]
    margin_px = 0.7
    return corners + margin_px * (before - along) / np.maximum(sine, 0.3)[..., None]


def _clockwise(corners: Float) -> Float:
    x, y = corners[..., 0], corners[..., 1]
    upright = (x * np.roll(y, -1, axis=1) - np.roll(x, -1, axis=1) * y).sum(axis=1) < 0.0
    return np.where(upright[:, None, None], corners[:, ::-1], corners)


def _dark_inside(grey: Image, corners: Float) -> Float:
    """Those that are darker than what is about them, along all of their sides."""
    end = np.roll(corners, -1, axis=1)
    along = end - corners
    outward = np.stack([along[..., 1], -along[..., 0]], axis=-1) / np.linalg.norm(along, axis=-1)[..., None]
    on = corners[:, :, None] + PROBES[:, None] * along[:, :, None]
    probe_px = 2.0  # from the edge
    at = np.stack([on + probe_px * outward[:, :, None], on - 0.5 * probe_px * outward[:, :, None]])
    place = np.rint(at).astype(int)
    height, width = grey.shape
    seen = grey[place[..., 1].clip(0, height - 1), place[..., 0].clip(0, width - 1)].astype(int)
    brighter = 12.0  # bytes, outside
    share = (seen[0] > seen[1] + brighter).reshape(len(corners), -1).mean(axis=1)
    agreeing = 0.8  # share of the probes
    return corners[share >= agreeing]
