"""Which way what the LEDs light is facing: normals of an image of relative depth (D14).

Points are rays times depth, a normal is the cross product of the differences of neighbouring points. That says rightly
in which direction a surface falls away, but by far too much how steeply: skin seen aslant gives back less light and
so looks farther (`led_depth`), on a finger five times as much as it is. The same light tells the slant: at incidence
theta the depth appears as depth / sqrt(cos theta), and what faces the camera within a finger's breadth appears as it
is. So the direction is taken from the neighbours and the slant from the brightest around.
"""

import cv2
import numpy as np

from slave.wrist.led_depth import Float32, LedOptics, RelativeDepth

BREADTH = 17  # shrunken pixels: a finger, and no neighbour's far side
FAR = np.float32(1e6)
_TINY = np.float32(1e-20)


def normals(seen: RelativeDepth, optics: LedOptics) -> Float32:
    """Unit normals (h, w, 3), camera frame, of depths (h, w); NaN where a pixel or a neighbour has none.

    Scale of the depth is of no matter. On things of a finger's breadth they are within 5 degrees on average up
    to a slant of 60 degrees; a broader surface looks flatter than it is.
    """
    return normals_of(seen.depth, optics.ray, optics.cosine)


def normals_of(depth: Float32, ray: Float32, cosine: Float32) -> Float32:
    """The same of part of an image: depth (h, w), rays (h, w, 3) of depth 1 and their cosines to the axis (h, w)."""
    if min(depth.shape) < 3:
        return np.full((*depth.shape, 3), np.nan, dtype=np.float32)
    smooth = cv2.GaussianBlur(depth, (3, 3), 0.8, borderType=cv2.BORDER_REPLICATE)
    out = np.full((*depth.shape, 3), np.nan, dtype=np.float32)
    points = ray * smooth[..., None]
    across = points[1:-1, 2:] - points[1:-1, :-2]
    down = points[2:, 1:-1] - points[:-2, 1:-1]
    steep = np.empty_like(down)  # down x across: x right, y down, so towards the camera
    for k, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        steep[..., k] = down[..., i] * across[..., j] - down[..., j] * across[..., i]
    view = -ray[1:-1, 1:-1] * cosine[1:-1, 1:-1, None]
    aside = steep - np.einsum("hwk,hwk->hw", steep, view)[..., None] * view
    aside /= np.sqrt(np.einsum("hwk,hwk->hw", aside, aside))[..., None] + _TINY
    nearest = cv2.erode(np.nan_to_num(smooth, nan=float(FAR)), np.ones((BREADTH, BREADTH), dtype=np.uint8))
    slant = np.clip((nearest / smooth)[1:-1, 1:-1] ** 2, 0.0, 1.0)[..., None]
    out[1:-1, 1:-1] = slant * view + np.sqrt(1.0 - slant * slant) * aside
    return out
