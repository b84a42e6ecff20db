"""Classify every pixel by colour, and find the connected blobs of each colour.

The table has one entry per 24-bit pixel and one bit per marker. It is built from the HSV ranges of the camera file by
OpenCV's own conversion of all 2^24 colours, so a look-up equals `cvtColor` + `inRange` exactly, and costs the same
for one colour and for eight (CMVision, Bruce, Balch, Veloso 2000, has one table per axis; a packed one also carries
ranges that are no boxes). Under another light it is read at other colours (`ColourTable.white_balanced`).

The scan looks at every fourth pixel of every fourth row, which a round marker from 6 px on cannot slip through; a
colour that no point of the grid shows is sought on further grids. Labels are made per colour, never on the union: on
the rim between marker and skin the hue runs through other markers' ranges, and such a fringe would split the blob.
Points that fill their box are one blob; only scattered ones are labelled.
"""

import math
from collections.abc import Mapping, Sequence
from copy import copy
from typing import NamedTuple, TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from common.arrays import Bool, Float, Image, Int
from common.calibration import HsvRange
from common.errors import CalibrationError

Codes: TypeAlias = npt.NDArray[np.unsignedinteger]
Places: TypeAlias = npt.NDArray[np.uint32]
HUES = 180
# Skin of every tone lies between red and orange, less saturated than markers (Kalbfleisch: collides with red, orange
# and yellow markers, which is why those are not used).
SKIN = HsvRange(hsv_low=(174, 60, 70), hsv_high=(22, 190, 255))


class ColourTable:
    """Look-up table from a colour to the markers it may belong to.

    A bit of an entry belongs to a range, the bit after the last to skin. Tables made of it for another light share the
    entries.

    Attributes:
        bits: Of each marker; those of one paint, on two hands, share one.
        sharing: Of each marker how many have its bit.
        entries: (2^24,) codes of 1, 2, 4 or 8 bytes, at the sum of the `places` of blue, green and red.
        places: (3, 256) what each byte of blue, green and red adds to the index.
    """

    def __init__(self, ranges: Sequence[HsvRange]) -> None:
        """Build the table of 1 to 63 HSV ranges in marker order (0.1 s); else ValueError."""
        if not 1 <= len(ranges) <= 63:
            raise ValueError(f"{len(ranges)} colour ranges, from 1 to 63 are possible")
        distinct = {(one.hsv_low, one.hsv_high): one for one in ranges}
        order = list(distinct)
        self.bits = tuple(1 << order.index((one.hsv_low, one.hsv_high)) for one in ranges)
        self.sharing = tuple(self.bits.count(bit) for bit in self.bits)
        self.skin = 1 << len(order)
        self.entries = _build([*distinct.values(), SKIN])
        self.places = _places(np.tile(np.arange(256, dtype=np.uint8), (3, 1)))
        self._bytes: Image | None = None  # (3, 256); None: as they are
        self._coarse: Codes | None = None  # for the scan, where they are others
        self._index = np.empty((0, 0), np.int64)
        self._codes: Codes = np.empty((0, 0), self.entries.dtype)

    def white_balanced(self, tables: Image) -> "ColourTable":
        """The table for images whose bytes are mapped first by `tables` (3, 256): 1 ms."""
        other = copy(self)
        other._bytes = tables if self._bytes is None else np.take_along_axis(self._bytes, tables, axis=1)
        other._coarse, other.places = _coarse(self.entries, other._bytes), _places(other._bytes)
        other._index, other._codes = np.empty((0, 0), np.int64), np.empty((0, 0), self.entries.dtype)
        return other

    def codes(self, image: Image) -> Codes:
        """Class codes (H, W) of a BGR window (H, W, 3) of any strides; bit m: marker m."""
        return self.packed_codes(cv2.cvtColor(image, cv2.COLOR_BGR2BGRA).view(np.uint32)[..., 0])

    def packed_codes(self, packed: npt.NDArray[np.uint32]) -> Codes:
        """Class codes of pixels in words, blue in the lowest byte, the highest ignored."""
        if self._bytes is not None:
            mapped = np.zeros((1, 256, 4), np.uint8)
            mapped[0, :, :3] = self._bytes.T
            pixels = np.ascontiguousarray(packed).view(np.uint8).reshape(-1, 1, 4)
            return self.entries.take(cv2.LUT(pixels, mapped).view(np.uint32).reshape(packed.shape))
        return self.entries.take(packed & 0xFFFFFF)

    def scan(
        self, image: Image, step: int, dx: int = 0, dy: int = 0, size: tuple[int, int] | None = None
    ) -> Codes:
        """Class codes on a grid: every `step`-th pixel of every `step`-th row, from 2 on.

        Decimated, not averaged: an averaged pixel on the rim of a marker has a hue that no marker has.

        Args:
            image: (H, W, 3) BGR, C-contiguous.
            dx, dy: Where the grid begins [px]; less than `step` for the whole image.
            size: Rows and columns of the grid; None: (H // step, W // step).

        Returns codes of that size of the pixels (dy + step v, dx + step u), reused by the next call.
        """
        height, width = (image.shape[0] // step, image.shape[1] // step) if size is None else size
        row = image.shape[1] * 3
        # A pixel is read as four bytes, of which the last belongs to its neighbour. Read from one byte before it
        # instead, the first belongs to its other neighbour; so one of the two never leaves the image.
        late = dx % step == step - 1
        offset, strides = dy * row + 3 * dx - late, (step * row, 3 * step)
        words = np.ndarray((height, width), "<u4", buffer=image, offset=offset, strides=strides)
        if self._index.shape != words.shape:
            self._index = np.empty(words.shape, np.int64)
            self._codes = np.empty(words.shape, self.entries.dtype)
        # the scan looks colours up in steps of 8 levels: what it uses of the table fits a cache
        coarse = 0xF8F8F8
        if self._coarse is not None:
            np.bitwise_and(words >> (11 if late else 3), coarse >> 3, out=self._index, casting="unsafe")
            return self._coarse.take(self._index, out=self._codes, mode="clip")
        np.bitwise_and(words >> 8 if late else words, coarse, out=self._index, casting="unsafe")
        return self.entries.take(self._index, out=self._codes, mode="clip")


def table_of(markers: Sequence[str], ranges: Mapping[str, HsvRange] | None, where: str) -> ColourTable:
    """Table of markers in the rig's order; CalibrationError tells what range lacks."""
    missing = [name for name in markers if name not in (ranges or {})]
    if missing or ranges is None:
        raise CalibrationError(
            f"{where}: markers: no HSV range for {', '.join(missing)}; make them with "
            f"`phalanx-slave colours RECORDING --camera NAME -o FILE`"
        )
    return ColourTable([ranges[name] for name in markers])


def in_range(hsv: Image, colour: HsvRange) -> Bool:
    """Mask of pixels (..., 3) OpenCV HSV inside a range; the hue wraps through 0."""
    h, s, v = (_within(hsv[..., k], low, high) for k, (low, high) in enumerate(_limits(colour)))
    return h & s & v


def hue_distance(hues: npt.ArrayLike, hue: npt.ArrayLike) -> Float:
    """Distance of hues 0..180 on their circle."""
    d = np.abs(np.asarray(hues, np.float64) - np.asarray(hue, np.float64))
    return np.minimum(d, HUES - d)


def hue_span(colour: HsvRange) -> tuple[float, float]:
    """Middle of a range on the circle of hues, and how far it reaches to either side."""
    low = colour.hsv_low[0]
    half = (colour.hsv_high[0] - low) % HUES / 2.0
    return (low + half) % HUES, half


def _limits(colour: HsvRange) -> list[tuple[int, int]]:
    return list(zip(colour.hsv_low, colour.hsv_high, strict=True))


def _within(levels: Int | Image, low: int, high: int) -> Bool:
    """Whether levels are in a range, which wraps where `low` is above `high`."""
    above, below = levels >= low, levels <= high
    return above & below if low <= high else above | below


def _build(ranges: Sequence[HsvRange]) -> Codes:
    """Build the table: a colour has the bits that its H, S and V all have."""
    level = np.arange(256)
    bits: Codes = np.zeros((3, 256), np.min_scalar_type((1 << len(ranges)) - 1))  # of levels of H, S and V
    for m, colour in enumerate(ranges):
        for channel, (low, high) in zip(bits, _limits(colour), strict=True):
            channel[_within(level, low, high)] |= bits.dtype.type(1 << m)
    count = 16  # planes made at once: a thread beside a busy loop waits for its turn at every step
    # red, green, blue: the byte order of a packed little-endian pixel
    table: Codes = np.empty((256, 256, 256), bits.dtype)
    planes = np.empty((count, 256, 256, 3), np.uint8)
    planes[..., 0] = level
    planes[..., 1] = level[:, None]
    for start in range(0, 256, count):
        planes[..., 2] = level[start : start + count, None, None]
        flat = cv2.cvtColor(planes.reshape(count * 256, 256, 3), cv2.COLOR_BGR2HSV)
        hue, saturation, value = np.asarray(cv2.split(flat), np.uint8)
        codes = table[start : start + count].reshape(count * 256, 256)  # a view
        codes[:] = bits[0].take(hue) & bits[1].take(saturation) & bits[2].take(value)
    return table.reshape(-1)


def _places(levels: Image) -> Places:
    """Levels (3, 256) of blue, green and red, each where it stands in a packed pixel."""
    return levels.astype(np.uint32) << np.array([[0], [8], [16]], np.uint32)


def _coarse(table: Codes, levels: Image) -> Codes:
    """The scan's table (2^21,) at packed pixels >> 3, for bytes `levels` (3, 256)."""
    blue, green, red = levels[:, ::8]
    coarse = np.empty((32, 256, 256), table.dtype)  # the rest is never asked, and never becomes memory
    coarse[:, :32, :32] = table.reshape(256, 256, 256)[np.ix_(red, green, blue)]
    return coarse.reshape(-1)


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

    def holds(self, u: float, v: float, margin: float = 0.0) -> bool:
        """Whether a point is in the box, or as near to it as `margin` [px]."""
        return (
            self.left - margin <= u <= self.right + margin and self.top - margin <= v <= self.bottom + margin
        )

    def meets(self, other: "Blob", margin: float = 0.0) -> bool:
        """Whether the boxes overlap, or are less than `margin` [px] apart."""
        return (
            self.left < other.right + margin
            and other.left < self.right + margin
            and self.top < other.bottom + margin
            and other.top < self.bottom + margin
        )


def find_blobs(
    codes: Codes, bits: Sequence[int], step: int = SCALE, dx: int = 0, dy: int = 0
) -> list[list[Blob]]:
    """Blobs of each colour in a scan's codes (H, W), the largest first, not too many."""
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

    Args:
        options: All blobs of its colour.
        extent: Largest width or height of the whole marker [px], as far as known, else inf.
        whole: Its area [px^2], as far as known, else nan: then only small pieces are joined, since a large one may
            be a thing beside it.

    Returns the blob, its box widened over all pieces; and the shift [px] of the centroid by joining, by which it is
    off if the pieces are something else; 0 where it is known that so much is missing.
    """
    left, top, right, bottom = blob.left, blob.top, blob.right, blob.bottom
    reach = FRAGMENT_GAP * math.sqrt(blob.area)
    known = math.isfinite(whole)
    # of the largest piece: a larger one is an alternative, where the whole is not known
    fragment_unknown = 0.3
    most = 1.3 * max(whole - blob.area, 0.0) if known else fragment_unknown * blob.area
    area, u, v = blob.area, blob.u * blob.area, blob.v * blob.area
    least = max(8.0, 0.04 * blob.area)  # px^2, and of the largest piece: what is smaller is noise or fringe
    for piece in options:
        if piece is blob or not least <= piece.area <= blob.area:
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
    """Connected parts, largest first: left, top, width, height, points, mean x, y."""
    count, _, stats, centres = cv2.connectedComponentsWithStats(mask, connectivity=8, ltype=cv2.CV_16U)
    rows = [
        (left + x, top + y, w, h, area, left + u, top + v)
        for (x, y, w, h, area), (u, v) in zip(stats[1:].tolist(), centres[1:].tolist(), strict=True)
    ]
    return sorted(rows, key=lambda row: -row[4])[:MAX_CANDIDATES] if count > 2 else rows
