"""Measure markers as `centroid.measure` does, as machine code: one window after the other, a few passes over each.

The formulas are those of `centroid` and `shares`; here they are written pixel by pixel. In place of stacks and
masks, each window has its own size, sums are taken only where the paint is, and pixels outside count as nothing.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from common.arrays import Image
from slave.markers import centroid, shares
from slave.markers.blobs import SCALE, Blob
from slave.markers.centroid import Measured
from slave.markers.classify import ColourTable
from slave.markers.fast_cells import cells_of
from slave.markers.fast_window import (
    AREA,
    BLUE,
    CONTRAST,
    CUT,
    FOREIGN,
    FOUND,
    LEFT,
    RED,
    START,
    THIN,
    TOP,
    XX,
    XY,
    YY,
    Rules,
    U,
    V,
    measure_windows,
)

Float32 = npt.NDArray[np.float32]

RULES = Rules(
    centroid.PAD,
    centroid.SIDE[0] // 2,
    centroid.CORE,
    centroid.DEEP,
    centroid.HOLE,
    centroid.MIN_PIXELS,
    SCALE,
    shares.EVERY,
    shares.DARKEST,
    shares.SHADED,
    float(shares.NOISE[0, 0]),
    float(shares.TILT[0, 0]),
    float(shares.TILT[1, 1]),
)


def measure(
    image: Image, table: ColourTable, bits: Sequence[int], blobs: Sequence[Blob], alone: Sequence[bool]
) -> list[Measured | None]:
    """Measure the markers at `blobs`; arguments and answer are those of `centroid.measure`."""
    if not blobs:
        return []
    pad = 2 * centroid.PAD
    sizes = [(b.bottom - b.top + pad, b.right - b.left + pad) for b in blobs]
    asked: list[tuple[int, ...]] = []
    start = 0
    for b, bit, lonely, (height, width) in zip(blobs, bits, alone, sizes, strict=True):
        asked.append((b.left, b.top, b.right, b.bottom, bit, lonely, start))
        start += height * width
    answers = np.zeros((len(blobs), 14))
    windows = np.zeros(start, np.float32)
    cells = cells_of(table).markers
    skin = np.array([table.skin], np.uint64).astype(cells.dtype)
    pixels = np.ascontiguousarray(image).view()
    pixels.flags.writeable = False  # one type for all images: a second one would be compiled in the loop
    measure_windows(
        pixels, table.entries, cells, skin, shares.LIGHT, np.array(asked, np.int64), RULES, answers, windows
    )
    found: list[Measured | None] = []
    for row, request, (height, width) in zip(answers.tolist(), asked, sizes, strict=True):
        if not row[FOUND]:
            found.append(None)
            continue
        start = request[START]
        found.append(
            Measured(
                row[U],
                row[V],
                row[AREA],
                row[CONTRAST],
                [value / shares.WHITE for value in row[BLUE : RED + 1]],
                row[CUT] != 0.0,
                row[THIN] != 0.0,
                row[FOREIGN],
                row[XX],
                row[XY],
                row[YY],
                windows[start : start + height * width].reshape(height, width),
                request[LEFT] - centroid.PAD,
                request[TOP] - centroid.PAD,
            )
        )
    return found
