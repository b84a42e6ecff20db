"""Estimate relative depth from the fall-off of the LED light.

Kim et al. 2012 take sqrt(I) for distance; docs/theory/sources.md#nearness-and-distance has the correction.

Light from beside the lens falls with the square of the distance and comes back once: the root of the intensity is
*nearness*, not distance. With alpha the angle of the ray off the optical axis,

    depth = c cos(alpha) / sqrt(I / F),        F the flat field, what the LEDs make of a white surface

along the optical axis; c is the surface's whiteness, the LEDs' power and the camera's gain in one, and is not known. So
depth is *relative*: monotone, and right up to one factor where the surface is of one kind and faces the camera. Where
it is inclined by theta it looks farther away by 1 / sqrt(cos theta).

A pixel as dark as the noise of the difference has no depth (NaN); a saturated one is at most as far as it looks.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import TypeAlias, cast

import cv2
import numpy as np
import numpy.typing as npt

from common.arrays import Float, Image
from common.calibration.flat_field import flat_of
from slave.wrist.view import WristView

Float32: TypeAlias = npt.NDArray[np.float32]

SHRINK = 4  # the LED image is read at a quarter of its resolution


@dataclass(frozen=True, slots=True, eq=False)
class LedOptics:
    """What each pixel of the shrunken image is multiplied with.

    Attributes:
        cosine: (h, w) float32 of the angle off the optical axis.
        level: (h, w) float32 1 / sqrt(F).
        ray: (h, w, 3) float32 ray of depth 1 along the optical axis.
    """

    cosine: Float32
    level: Float32
    ray: Float32


def shrink(led: Image) -> Float32:
    """Return the difference of LED and ambient frame at a quarter of its resolution.

    In grey levels (h, w).
    """
    height, width = led.shape
    half = cv2.resize(led, (width // 2, height // 2), interpolation=cv2.INTER_AREA)  # in halves it is fast
    size = (width // SHRINK, height // SHRINK)
    return cast(Float32, cv2.resize(half.astype(np.float32), size, interpolation=cv2.INTER_AREA))


def nearness(grey: Float32, optics: LedOptics) -> Float32:
    """Return the nearness sqrt(I / F) (h, w) of grey levels >= 0.

    NaN where the levels are NaN; h rows from the top of the image.
    """
    return np.sqrt(grey) * optics.level[: len(grey)]


def depth_about(near: Float32, optics: LedOptics, u: float, v: float, radius_px: float) -> float:
    """Return the relative depth of what is nearest about a pixel of the image.

    Within a radius [px], of nearness (h, w).

    The nearest faces the camera, so it is the least inclined. NaN: too dark to measure.
    """
    row, column, reach = round(v / SHRINK), round(u / SHRINK), max(round(radius_px / SHRINK), 1)
    about = (slice(max(row - reach, 0), row + reach + 1), slice(max(column - reach, 0), column + reach + 1))
    dark = 4.0  # grey levels: what the noise of a difference of two frames leaves
    lit = near[about] > np.sqrt(dark) * optics.level[: len(near)][about]
    depth = optics.cosine[: len(near)][about][lit] / near[about][lit]
    return float(depth.min()) if len(depth) else float("nan")


def image_rows(view: WristView) -> Float:
    """Rows of the image [px] at the centres of the shrunken image's rows."""
    return _centres(view.optics.height_px)


def _centres(size_px: int) -> Float:
    return np.arange(size_px // SHRINK, dtype=np.float64) * SHRINK + 0.5 * (SHRINK - 1)


@lru_cache(maxsize=8)
def led_optics(view: WristView) -> LedOptics:
    """The maps of one wrist rig; made once."""
    v = image_rows(view)
    u = _centres(view.optics.width_px)
    xy = view.optics.undistort(np.stack(np.meshgrid(u, v), axis=-1))
    ray = np.concatenate([xy, np.ones((*xy.shape[:2], 1))], axis=-1)
    flat = np.ones(xy.shape[:2]) if view.flat_field is None else flat_of(view.flat_field, xy)
    return LedOptics(
        (1.0 / np.linalg.norm(ray, axis=-1)).astype(np.float32),
        (1.0 / np.sqrt(flat)).astype(np.float32),
        ray.astype(np.float32),
    )
