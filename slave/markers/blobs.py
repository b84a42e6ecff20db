"""Detection of the connected blobs of every colour in the scanned frame.

They are the candidates among which the markers are.

The scan looks at every fourth pixel of every fourth row, which any round marker from 6 px on cannot slip through;
smaller ones and slivers do now and then, so a colour that no point of the grid shows is sought on further grids.

Labels are made per colour, never on the union of all colours: the hue runs through other markers' ranges on the
rim between marker and skin, and such a fringe would split the blob. Points of a colour that fill their box are one
blob without further looking; only scattered ones are labelled, in the box around them, so the cost follows the
number of coloured points, not of markers.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from slave.markers.classify import Codes

SCALE = 4  # distance of the grid's lines [px]
MAX_CANDIDATES = 6  # of one colour, the largest ones
FULL = 0.6  # share of its box that one compact blob fills at least: an upright ellipse fills 0.79, two discs less
FRAGMENT_GAP = 0.5  # of the largest piece's size
POINT = float(SCALE * SCALE)  # px^2; areas are known to about this


class Blob(NamedTuple):
    """One connected blob of one colour, in pixels of the full image.

    Attributes:
        u, v: Centroid of the scanned points [px].
        area: Area [px^2], from the count of scanned points.
        left, top, right, bottom: Box [px] outside which no point of the grid has its colour, as wide as the grid
            leaves open; right and bottom exclusive.
    """

    u: float
    v: float
    area: float
    left: int
    top: int
    right: int
    bottom: int


def find_blobs(
    codes: Codes, bits: Sequence[int], step: int = SCALE, dx: int = 0, dy: int = 0
) -> list[list[Blob]]:
    """Blobs of each colour, largest first, at most `MAX_CANDIDATES` of a colour.

    Args:
        codes: (H, W) codes of the scan, contiguous (`ColourTable.scan`).
        bits: Bit mask of each marker.
        step, dx, dy: The grid of the scan.

    Returns:
        One list per marker, empty where its colour is not in the image.
    """
    found: list[list[Blob]] = [[] for _ in bits]
    mine = np.array(bits, codes.dtype)
    flat = codes.reshape(-1)
    index = np.flatnonzero((flat & np.bitwise_or.reduce(mine)) != 0)
    if index.size == 0:
        return found
    marker, place = ((flat[index] & mine[:, None]) != 0).nonzero()
    y, x = np.divmod(index[place], codes.shape[1])
    number = np.bincount(marker, minlength=len(bits))
    present = number.nonzero()[0]
    number = number[present]
    ends = number.cumsum()
    starts = ends - number
    boxes = zip(
        present.tolist(),
        starts.tolist(),
        number.tolist(),
        np.minimum.reduceat(x, starts).tolist(),
        (np.maximum.reduceat(x, starts) + 1).tolist(),
        y[starts].tolist(),  # the index runs row by row
        (y[ends - 1] + 1).tolist(),
        np.add.reduceat(x, starts).tolist(),
        np.add.reduceat(y, starts).tolist(),
        strict=True,
    )
    slack = step - 1
    for m, start, count, left, right, top, bottom, sum_x, sum_y in boxes:
        width, height = right - left, bottom - top
        if count >= FULL * width * height:
            stats = [(left, top, width, height, count, sum_x / count, sum_y / count)]
        else:
            mask = np.zeros((height, width), np.uint8)
            mask[y[start : start + count] - top, x[start : start + count] - left] = 1
            stats = _label(mask, left, top)
        found[m] = [
            Blob(
                dx + step * u,
                dy + step * v,
                float(step * step * area),
                dx + step * x0 - slack,
                dy + step * y0 - slack,
                dx + step * (x0 + w - 1) + slack + 1,
                dy + step * (y0 + h - 1) + slack + 1,
            )
            for x0, y0, w, h, area, u, v in stats
        ]
    return found


def with_fragments(blob: Blob, options: Sequence[Blob], extent: float, whole: float) -> tuple[Blob, float]:
    """Return `blob` joined with the pieces that an occluder split from it.

    The occluder is something in front of the marker. Also returns how far joining may mislead.

    Args:
        blob: The marker's largest piece.
        options: All blobs of its colour.
        extent: Largest width or height of the whole marker [px], as far as known, else inf.
        whole: Its whole area [px^2], as far as known, else nan: then only small pieces are joined, since a large one
            may as well be a thing beside it.

    Returns:
        The blob, its box widened over all pieces. And the way [px] of the centroid that joining makes, where it is
        not known that so much is missing: if the pieces are something else, the centroid is off by that.
    """
    left, top, right, bottom = blob.left, blob.top, blob.right, blob.bottom
    reach = FRAGMENT_GAP * math.sqrt(blob.area)
    known = math.isfinite(whole)
    # of the largest piece: a larger one is an alternative, where the whole is not known
    fragment_unknown = 0.3
    most = 1.3 * max(whole - blob.area, 0.0) if known else fragment_unknown * blob.area
    area, u, v = blob.area, blob.u * blob.area, blob.v * blob.area
    for piece in options:
        fragment_share = 0.04  # of the largest piece, below which a piece is noise or fringe
        fragment_least = 8.0  # px^2
        if (
            piece is blob
            or piece.area > blob.area
            or piece.area < max(fragment_least, fragment_share * blob.area)
        ):
            continue
        # Boxes leave open where between two points of the grid the colour ends: on average half of it, on each side.
        gap = max(piece.left - right, left - piece.right, piece.top - bottom, top - piece.bottom) + SCALE
        box = min(left, piece.left), min(top, piece.top), max(right, piece.right), max(bottom, piece.bottom)
        if (
            gap <= reach
            and area - blob.area + piece.area <= most + POINT
            and max(box[2] - box[0], box[3] - box[1]) <= extent
        ):
            left, top, right, bottom = box
            area, u, v = area + piece.area, u + piece.u * piece.area, v + piece.v * piece.area
    shift_px = 0.0 if known and area <= whole else math.hypot(u / area - blob.u, v / area - blob.v)
    return blob._replace(left=left, top=top, right=right, bottom=bottom), shift_px


def _label(
    mask: npt.NDArray[np.uint8], left: int, top: int
) -> list[tuple[int, int, int, int, int, float, float]]:
    """Label the connected parts of a mask, largest first.

    Each is left, top, width, height, points, mean x, mean y on the grid.
    """
    count, _, stats, centres = cv2.connectedComponentsWithStats(mask, connectivity=8, ltype=cv2.CV_16U)
    rows = [
        (left + x, top + y, w, h, area, left + u, top + v)
        for (x, y, w, h, area), (u, v) in zip(stats[1:].tolist(), centres[1:].tolist(), strict=True)
    ]
    return sorted(rows, key=lambda row: -row[4])[:MAX_CANDIDATES] if count > 2 else rows
