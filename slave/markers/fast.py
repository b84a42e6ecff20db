"""Scan and measure markers in machine code, several times faster.

The engine of the `fast` extra (numba), with the arguments and results of `engine.scan_blobs` and `centroid.measure`.
The colour table (16 MiB and more) lies in slow memory; nearly all cells of 8 x 8 x 8 colours belong to the same
markers throughout, so a table of cells in the fastest caches answers all but one pixel in sixty, and the whole scan,
which asks only for colours whose lowest three bits are 0. Points of a colour are counted while the frame is read;
only scattered ones are labelled. Windows are measured one after the other (`fast_window`).
"""

from collections.abc import Sequence
from typing import NamedTuple
from weakref import WeakKeyDictionary, WeakSet

import numpy as np

from common.arrays import Float, Image, Int
from slave.markers import centroid, classify
from slave.markers.centroid import Measured
from slave.markers.classify import SCALE, Blob, Codes, ColourTable, Places
from slave.markers.engine import Engine
from slave.markers.fast_compile import compiled
from slave.markers.fast_window import ANSWERED, Rules, measure_windows

CELLS = 32  # of each channel


class Cells(NamedTuple):
    """Codes (32^3,) of cells at (blue >> 3) | (green >> 3) << 5 | (red >> 3) << 10."""

    first: Codes  # of the cell's first colour, whose lowest three bits are 0: what a scan asks for
    markers: Codes  # of all its colours, markers alone; the bit of skin: they differ
    skin: Codes  # (1,) that bit


_KNOWN: WeakKeyDictionary[ColourTable, Cells] = WeakKeyDictionary()  # a table never changes


def cells_of(table: ColourTable) -> Cells:
    """Return the cells of a table: 15 ms at the first call, then cached."""
    known = _KNOWN.get(table)
    if known is None:
        kind = table.entries.dtype
        skin = np.array([table.skin], np.uint64).astype(kind)
        known = Cells(np.empty(CELLS**3, kind), np.empty(CELLS**3, kind), skin)
        _fill(table.entries, table.places, skin, known.first, known.markers)
        _KNOWN[table] = known
    return known


@compiled
def _fill(entries: Codes, places: Places, skin: Codes, first: Codes, markers: Codes) -> None:
    flag = skin[0]
    for red in range(CELLS):
        for green in range(CELLS):
            for blue in range(CELLS):
                columns = places[0, 8 * blue : 8 * blue + 8]
                start = entries[places[2, 8 * red] | places[1, 8 * green] | columns[0]]
                any_of, all_of = start, start
                for r in places[2, 8 * red : 8 * red + 8]:
                    for g in places[1, 8 * green : 8 * green + 8]:
                        row = r | g
                        for b in columns:
                            code = entries[row | b]
                            any_of |= code
                            all_of &= code
                cell = red << 10 | green << 5 | blue
                first[cell] = start
                same = any_of & ~flag == all_of & ~flag
                markers[cell] = all_of & ~flag if same else flag


RULES = Rules(
    centroid.PAD,
    centroid.SIDE[0] // 2,
    centroid.CORE,
    centroid.DEEP,
    centroid.HOLE,
    centroid.MIN_PIXELS,
    SCALE,
    centroid.EVERY,
    float(centroid.WHITE),
    centroid.DARKEST,
    centroid.SHADED,
    float(centroid.NOISE[0, 0]),
    float(centroid.TILT[0, 0]),
    float(centroid.TILT[1, 1]),
)


def measure(
    image: Image, table: ColourTable, bits: Sequence[int], blobs: Sequence[Blob], alone: Sequence[bool]
) -> list[Measured | None]:
    """Measure the markers at `blobs`, as `centroid.measure`."""
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
    boxes = np.array(asked, np.int64)
    measure_windows(
        pixels, table.entries, table.places, cells, skin, centroid.LIGHT, boxes, RULES, answers, windows
    )
    found: list[Measured | None] = []
    for (left, top, right, bottom, _, _, start), answer in zip(asked, answers.tolist(), strict=True):
        there, u, v, area, contrast, blue, green, red, cut, thin, foreign, xx, xy, yy = answer
        if not there:
            found.append(None)
            continue
        height, width = bottom - top + 2 * pad, right - left + 2 * pad
        window = windows[start : start + height * width].reshape(height, width)
        bgr, x, y = [blue, green, red], left - pad, top - pad
        found.append(
            Measured(u, v, area, contrast, bgr, cut != 0.0, thin != 0.0, foreign, xx, xy, yy, window, x, y)
        )
    return found


class Grid(NamedTuple):
    """Grid of the scan and constants of `classify`, as arguments of machine code."""

    step: int  # distance of its lines [px]
    dx: int  # dx, dy: where it begins [px]
    dy: int
    slack: int  # how far a blob's box reaches beyond its points [px]
    most: int  # blobs of one colour, at most
    full: float  # share of its box that one compact blob fills at least


def scan_blobs(
    image: Image,
    table: ColourTable,
    bits: Sequence[int],
    step: int = SCALE,
    dx: int = 0,
    dy: int = 0,
    size: tuple[int, int] | None = None,
) -> tuple[Codes, list[list[Blob]]]:
    """Codes of the scan and blobs of each colour, as `engine.scan_blobs`."""
    pixels = np.ascontiguousarray(image).view()
    pixels.flags.writeable = False  # one type for all images: a second one would be compiled in the loop
    cells = cells_of(table).first
    rows, columns = (image.shape[0] // step, image.shape[1] // step) if size is None else size
    codes = np.empty((rows, columns), cells.dtype)
    grid = Grid(step, dx, dy, step - 1, classify.MAX_CANDIDATES, classify.FULL)
    places, boxes = np.empty((len(bits) * grid.most, 3)), np.empty((len(bits) * grid.most, 5), np.int64)
    number = _scan_blobs(pixels, cells, np.array(bits, np.int64), grid, codes, places, boxes)
    found: list[list[Blob]] = [[] for _ in bits]
    for (u, v, area), (m, left, top, right, bottom) in zip(
        places[:number].tolist(), boxes[:number].tolist(), strict=True
    ):
        found[m].append(Blob(u, v, area, left, top, right, bottom))
    return codes, found


@compiled
def _scan_blobs(
    image: Image, cells: Codes, bits: Int, grid: Grid, codes: Codes, places: Float, boxes: Int
) -> int:
    """Fill in codes (H, W), a row per blob (u, v, area; m, box); number of rows."""
    hits = np.empty(codes.size, np.int64)
    wanted = 0
    for bit in bits:
        wanted |= bit
    count = _read(image, cells, wanted, grid, codes, hits)
    width = codes.shape[1]
    # Of each marker: points, sums of x and y, left, top, right, bottom (inclusive).
    sums = np.zeros((len(bits), 7), np.int64)
    flat = codes.reshape(-1)
    for k in range(count):
        place = np.int64(hits[k])
        code = np.int64(flat[place])
        y = place // width
        x = place - y * width
        for m in range(len(bits)):
            if code & bits[m] == 0:
                continue
            s = sums[m]
            if s[0] == 0:
                s[3], s[4], s[5] = x, y, x
            s[0] += 1
            s[1] += x
            s[2] += y
            s[3] = min(s[3], x)
            s[5] = max(s[5], x)
            s[6] = y  # they come row by row
    number = 0
    for m in range(len(bits)):
        n, sum_x, sum_y, left, top, right, bottom = sums[m]
        if n == 0:
            continue
        if n >= grid.full * ((right - left + 1) * (bottom - top + 1)):
            _put(grid, m, n, sum_x / n, sum_y / n, left, top, right, bottom, places[number], boxes[number])
            number += 1
        else:
            parts = _label(codes, bits[m], left, top, right, bottom, grid.most)
            for part in range(len(parts)):
                n, _, sum_x, sum_y, left, top, right, bottom = parts[part]
                _put(
                    grid, m, n, sum_x / n, sum_y / n, left, top, right, bottom, places[number], boxes[number]
                )
                number += 1
    return number


@compiled
def _read(image: Image, cells: Codes, wanted: int, grid: Grid, codes: Codes, hits: Int) -> int:
    """Read the codes of the grid points; collect and count those with a wanted bit."""
    count = 0
    height, width = codes.shape
    five, ten = np.uint64(5), np.uint64(10)
    three = np.uint64(3)
    line = 64 // 3  # pixels in a line of the processor's cache
    ahead = 0
    for v in range(height):
        row = image[grid.dy + grid.step * v, grid.dx : grid.dx + grid.step * width]
        # The next row is asked from memory while this one is worked on.
        later = image[min(grid.dy + grid.step * (v + 1), image.shape[0] - 1), grid.dx :][: len(row)]
        for x in range(0, len(later), line):
            ahead |= later[x, 0]
        into = codes[v]
        base = v * width
        for u in range(width):
            x = np.uint64(u * grid.step)
            blue, green, red = np.uint64(row[x, 0]), np.uint64(row[x, 1]), np.uint64(row[x, 2])
            code = cells[(blue >> three) | ((green >> three) << five) | ((red >> three) << ten)]
            into[np.uint64(u)] = code
            if np.int64(code) & wanted:
                hits[count] = base + u
                count += 1
    return count + (ahead >> 8)  # 0: bytes have 8 bits


@compiled
def _put(
    grid: Grid,
    m: int,
    points: int,
    x: float,
    y: float,
    left: int,
    top: int,
    right: int,
    bottom: int,
    place: Float,
    box: Int,
) -> None:
    """Convert a blob to image pixels; its box reaches to where the next points are."""
    step = grid.step
    place[0], place[1], place[2] = grid.dx + step * x, grid.dy + step * y, step * step * points
    box[0] = m
    box[1], box[2] = grid.dx + step * left - grid.slack, grid.dy + step * top - grid.slack
    box[3], box[4] = grid.dx + step * right + grid.slack + 1, grid.dy + step * bottom + grid.slack + 1


@compiled
def _label(codes: Codes, bit: int, left: int, top: int, right: int, bottom: int, most: int) -> Int:
    """Connected parts (8 neighbours) of a colour in its box, largest first.

    (N, 8): points, rank, sum of x, sum of y, left, top, right, bottom (inclusive). Of parts of one size the first is
    the one whose first block of 2 x 2 points comes first, as OpenCV numbers them.
    """
    width, height = right - left + 1, bottom - top + 1
    stride = width + 2
    mask = np.zeros(stride * (height + 2), np.uint8)
    for y in range(height):
        for x in range(width):
            if np.int64(codes[top + y, left + x]) & bit:
                mask[(y + 1) * stride + x + 1] = 1
    stack = np.empty(width * height, np.int64)
    parts = np.empty((most + 1, 8), np.int64)
    number = 0
    for start in range(len(mask)):
        if mask[start] == 0:
            continue
        part = parts[number]
        part[:] = 0
        part[1] = width * height
        part[4], part[5] = right, bottom
        mask[start] = 0
        stack[0] = start
        depth = 1
        while depth > 0:
            depth -= 1
            p = stack[depth]
            y = p // stride - 1
            x = p - (y + 1) * stride - 1
            part[0] += 1
            part[1] = min(part[1], (y // 2) * width + x // 2)
            part[2] += left + x
            part[3] += top + y
            part[4], part[6] = min(part[4], left + x), max(part[6], left + x)
            part[5], part[7] = min(part[5], top + y), max(part[7], top + y)
            for row in range(p - stride, p + stride + 1, stride):
                for q in range(row - 1, row + 2):
                    if mask[q]:
                        mask[q] = 0
                        stack[depth] = q
                        depth += 1
        k = number
        while k > 0 and (
            parts[k, 0] > parts[k - 1, 0]
            or (parts[k, 0] == parts[k - 1, 0] and parts[k, 1] < parts[k - 1, 1])
        ):
            for column in range(8):
                parts[k, column], parts[k - 1, column] = parts[k - 1, column], parts[k, column]
            k -= 1
        number = min(number + 1, most)
    return parts[:number]


_READY: WeakSet[ColourTable] = WeakSet()


def prepare(table: ColourTable) -> None:
    """Compile for this kind of table, unless done before, and make its cells.

    15 s on a desktop processor the first time a version runs; 0.5 s later, from the cache; 15 ms for another table.
    """
    if table in _READY:
        return
    nothing = np.zeros((32, 32, 3), np.uint8)
    scan_blobs(nothing, table, table.bits)
    measure(nothing, table, table.bits[:1], [Blob(16.0, 16.0, 64.0, 12, 12, 20, 20)], [False])
    _READY.add(table)


NUMBA = Engine(scan_blobs, measure, prepare)
