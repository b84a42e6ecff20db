"""Find the connected blobs of every colour in the scanned frame: the candidates among which the markers are.

Labels are made per colour, never on the union of all colours: the hue runs through other markers' ranges on the
rim between paint and skin, and such a fringe would split the blob. Only the box around a colour's own pixels is
labelled, so the cost follows the number of coloured pixels, not of markers.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from slave.markers.classify import Codes

SCALE = 2  # the scan looks at every second pixel of every second row
MAX_CANDIDATES = 6  # of one colour, the largest ones
FRAGMENT_SHARE = 0.04  # of the largest piece, below which a piece is noise or fringe
FRAGMENT_GAP = 0.5  # of the largest piece's size
FRAGMENT_LEAST = 8.0  # px^2


@dataclass(frozen=True, slots=True)
class Blob:
    """One connected blob of one colour, in pixels of the full image.

    Attributes:
        u, v: Centroid of the scanned pixels [px].
        area: Area [px^2], from the count of scanned pixels.
        left, top, right, bottom: Box [px], right and bottom exclusive.
    """

    u: float
    v: float
    area: float
    left: int
    top: int
    right: int
    bottom: int


def find_blobs(codes: Codes, bits: Sequence[int]) -> list[list[Blob]]:
    """Blobs of each colour, largest first, at most `MAX_CANDIDATES` of a colour.

    Args:
        codes: (H, W) codes of the scan, contiguous (`ColourTable.half_codes`).
        bits: Bit mask of each marker.

    Returns:
        One list per marker, empty where its colour is not in the image.
    """
    width = codes.shape[1]
    flat = codes.reshape(-1)
    index = _nonzero(flat)
    if index.size == 0:
        return [[] for _ in bits]
    values = flat[index]
    rows = index // width
    columns = index - rows * width
    found: list[list[Blob]] = []
    for bit in bits:
        mine = (values & bit) != 0
        x, y = columns[mine], rows[mine]
        if x.size == 0:
            found.append([])
            continue
        left, right = int(x.min()), int(x.max()) + 1
        top, bottom = int(y[0]), int(y[-1]) + 1  # the index runs row by row
        mask = np.zeros((bottom - top, right - left), np.uint8)
        mask[y - top, x - left] = 1
        found.append(_label(mask, left, top))
    return found


def with_fragments(blob: Blob, options: Sequence[Blob], extent: float) -> Blob:
    """`blob`, its box widened over the pieces that something in front of the marker split from it.

    Args:
        blob: The marker's largest piece.
        options: All blobs of its colour.
        extent: Largest width or height of the whole marker [px], as far as known, else inf.
    """
    left, top, right, bottom = blob.left, blob.top, blob.right, blob.bottom
    reach = FRAGMENT_GAP * math.sqrt(blob.area) + SCALE
    for piece in options:
        if (
            piece is blob
            or piece.area < max(FRAGMENT_LEAST, FRAGMENT_SHARE * blob.area)
            or piece.area > blob.area
        ):
            continue
        gap = max(piece.left - right, left - piece.right, piece.top - bottom, top - piece.bottom)
        box = min(left, piece.left), min(top, piece.top), max(right, piece.right), max(bottom, piece.bottom)
        if gap <= reach and max(box[2] - box[0], box[3] - box[1]) <= extent:
            left, top, right, bottom = box
    return replace(blob, left=left, top=top, right=right, bottom=bottom)


def _nonzero(flat: Codes) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """Indices of the set codes; whole 8-byte words are tested first, since nearly all are empty."""
    per_word = 8 // flat.itemsize
    whole = flat.size - flat.size % per_word
    words = np.flatnonzero(flat[:whole].view(np.uint64))
    index = (words[:, None] * per_word + np.arange(per_word)).reshape(-1)
    if whole < flat.size:
        index = np.concatenate([index, np.arange(whole, flat.size)])
    return index[flat[index] != 0]


def _label(mask: np.ndarray[tuple[int, int], np.dtype[np.uint8]], left: int, top: int) -> list[Blob]:
    count, _, stats, centres = cv2.connectedComponentsWithStats(mask, connectivity=8, ltype=cv2.CV_16U)
    areas = stats[1:, cv2.CC_STAT_AREA]
    order = (-areas).argsort(kind="stable")[:MAX_CANDIDATES] if count > 2 else range(count - 1)
    blobs: list[Blob] = []
    for i in order:
        x, y, w, h, area = (int(value) for value in stats[i + 1])
        u, v = SCALE * (left + float(centres[i + 1, 0])), SCALE * (top + float(centres[i + 1, 1]))
        box = (SCALE * (left + x), SCALE * (top + y), SCALE * (left + x + w), SCALE * (top + y + h))
        blobs.append(Blob(u, v, float(SCALE * SCALE * area), *box))
    return blobs
