"""Energy of a seam at each pixel.

Low in a minimum, high on the skin of a finger.
"""

import cv2
import numpy as np

from common.arrays import Image
from slave.wrist.seams import FENCE
from slave.wrist.search_bands import LATERAL, MARGIN, Float32

DARK = 6.0  # grey levels: what the noise of a difference of two frames leaves
SURFACE = 20.0  # energy of a bright, even surface: no seam crosses a finger
OPEN = 1.0  # energy in the dark beside one finger only
BEYOND_THUMB = 0.2  # energy in the dark beyond the thumb's tip
ASIDE = 3.0  # energy at the edge of a search band
ACROSS = 0.3  # energy where the thumb would lie across all fingers
WIDTHS = tuple(n + 2 * MARGIN for n in LATERAL)
STARTS = np.cumsum([0, *WIDTHS[:-1]]).tolist()
PRIOR = np.concatenate(
    [np.pad(ASIDE * np.linspace(-1.0, 1.0, n) ** 2, MARGIN, constant_values=FENCE) for n in LATERAL[:3]]
    + [np.pad(ACROSS * np.linspace(1.0, 0.0, LATERAL[3]), MARGIN, constant_values=FENCE)]
).astype(np.float32)
AROUND = np.ones((1, 7), dtype=np.uint8)
SIDE_KERNEL = np.ones((1, MARGIN), dtype=np.uint8)


def energy(straightened: Image, crossed: int) -> Float32:
    """Return the energy of the straightened search bands (S, K).

    From 0 in a black minimum to `SURFACE` on a finger, and `PRIOR`.

    A pixel is as much of a minimum as it lies below the darker of its two sides, and below what is brightest right
    beside it. The thumb's seam has the thumb on one side, and on the other perhaps nothing near: only the thumb's side
    counts. Where nothing is lit beside a pixel it is open, except for the thumb's seam on the first `crossed` circles:
    no thumb at all beyond it would mean that the seam lies outside of the thumb.
    """
    before = cv2.dilate(straightened, SIDE_KERNEL, anchor=(MARGIN - 1, 0))
    behind = cv2.dilate(straightened, SIDE_KERNEL, anchor=(0, 0))
    thumb = STARTS[3]
    side = cv2.min(before, behind)
    side[:, thumb:] = behind[:, thumb:]
    level = np.divide(straightened, cv2.dilate(straightened, AROUND) + np.float32(DARK), dtype=np.float32)
    above = 1.0 - cv2.subtract(side, straightened) / (side + np.float32(DARK))
    out = np.maximum(above, level)
    out *= out * out
    out *= SURFACE * out  # the sixth power
    bare = side <= DARK
    np.putmask(out[:, :thumb], bare[:, :thumb], OPEN)
    np.putmask(out[crossed:, thumb:], bare[crossed:, thumb:], BEYOND_THUMB)
    out += PRIOR
    return out
