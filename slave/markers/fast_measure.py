"""Machine code that measures markers as `centroid.measure` does.

One window after the other, with a few passes over each.

The formulas are those of `centroid` and `shares`; here they are written pixel by pixel. In place of stacks and
masks, each window has its own size, sums are taken only where the marker is, and pixels outside count as nothing.
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
from slave.markers.fast_window import ANSWERED, Rules, measure_windows

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
    float(shares.WHITE),
    shares.DARKEST,
    shares.SHADED,
    float(shares.NOISE[0, 0]),
    float(shares.TILT[0, 0]),
    float(shares.TILT[1, 1]),
)


def measure(
    image: Image, table: ColourTable, bits: Sequence[int], blobs: Sequence[Blob], alone: Sequence[bool]
) -> list[Measured | None]:
    """Measure the markers at `blobs`.

    Arguments and result are those of `centroid.measure`.
    """
    if not blobs:
        return []
    pad = centroid.PAD
    asked: list[tuple[int, ...]] = []
    size = 0
    for (_, _, _, left, top, right, bottom), bit, lonely in zip(blobs, bits, alone, strict=True):
        asked.append((left, top, right, bottom, bit, lonely, size))
        size += (bottom - top + 2 * pad) * (right - left + 2 * pad)
    answers = np.zeros((len(blobs), ANSWERED))
    windows = np.zeros(size, np.float32)
    pixels = np.ascontiguousarray(image).view()
    pixels.flags.writeable = False  # one type for all images: a second one would be compiled in the loop
    _, cells, skin = cells_of(table)
    measure_windows(
        pixels,
        table.entries,
        table.places,
        cells,
        skin,
        shares.LIGHT,
        np.array(asked, np.int64),
        RULES,
        answers,
        windows,
    )
    found: list[Measured | None] = []
    for (left, top, right, bottom, _, _, start), answer in zip(asked, answers.tolist(), strict=True):
        there, u, v, area, contrast, blue, green, red, cut, thin, foreign, xx, xy, yy = answer
        if not there:
            found.append(None)
            continue
        height, width = bottom - top + 2 * pad, right - left + 2 * pad
        window = windows[start : start + height * width].reshape(height, width)
        found.append(
            Measured(
                u,
                v,
                area,
                contrast,
                [blue, green, red],
                cut != 0.0,
                thin != 0.0,
                foreign,
                xx,
                xy,
                yy,
                window,
                left - pad,
                top - pad,
            )
        )
    return found
