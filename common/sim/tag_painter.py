"""Printed tags in an image: ink on paper, in linear light, blurred by motion.

The appearance is that over a box of pixels while the tag moves.
"""

from functools import cache

import cv2
import numpy as np
import numpy.typing as npt

from common.arrays import Float, Image
from common.calibration.object_profile import TagFamily
from common.geometry.tag_family import tag_image
from common.sim.light import AMBIENT
from common.sim.object_surface import PAPER_CELLS
from common.sim.objects_seen import SeenSheet

Float32 = npt.NDArray[np.float32]
INK, PAPER = 0.035, 0.72  # reflectance of toner and of office paper
PAPER_BGR = np.array([0.97, 1.0, 1.0])
TEXELS = 8  # of a cell, when the tag is near
_BLEED = 4  # texels of paper beyond its edge: what covers it decides where it ends


@cache
def printed(family: TagFamily, number: int) -> Image:
    """Reflectance (n, n) of a tag with its paper, 255 = 1, `TEXELS` a cell."""
    cells = tag_image(family, number, round(PAPER_CELLS)) / 255.0
    ink = np.kron(INK + (PAPER - INK) * cells, np.ones((TEXELS, TEXELS)))
    return np.pad(np.rint(255.0 * ink), _BLEED, mode="edge").astype(np.uint8)


def sheet_appearance(seen: SeenSheet, moments_s: Float, box: tuple[int, int, int, int]) -> Float32:
    """Return the linear light of a tag over a box of pixels, as if it filled it.

    Shape (h, w, 3), blue first; box x0, y0, x1, y1.

    Args:
        seen: The tag.
        moments_s: Moments (n,) of the exposure, relative to its middle [s].
        box: The pixels.
    """
    x0, y0, x1, y1 = box
    texture = printed(seen.sheet.family, seen.sheet.number)
    own = len(texture) - 2 * _BLEED
    edge = _BLEED - 0.5 + own * np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    fine = 4  # rays per pixel and axis
    size = (fine * (x1 - x0), fine * (y1 - y0))
    total = np.zeros(size[::-1], np.float32)
    for moment in moments_s:
        # A pixel's middle is a whole number, its rays lie evenly about it.
        uv = (seen.paper_uv + moment * seen.speed - [x0, y0] + 0.5) * fine - 0.5
        way = cv2.getPerspectiveTransform(edge.astype(np.float32), uv.astype(np.float32))
        drawn = cv2.warpPerspective(
            texture, way, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        cv2.accumulate(drawn, total)
    grey = cv2.resize(total, (x1 - x0, y1 - y0), interpolation=cv2.INTER_AREA)
    light = (AMBIENT + (1.0 - AMBIENT) * max(seen.lit, 0.0)) / (255.0 * len(moments_s))
    return (grey[..., None] * (light * PAPER_BGR)).astype(np.float32)
