"""Look for blobs of the markers' colours: in the whole frame, or only where markers are expected.

    whole    one table look-up on every fourth pixel of every fourth row, and on a further grid where a colour shows on
             none of these points
    windows  the same points in the windows of tracked markers alone (`roi`). While a marker is lost, one strip of the
             frame is searched for its colour in every frame, all of it in `STRIPS` frames, and what is found there is
             looked at like a window

A blob has the same points, and so the same centroid and box, in both: a window is widened until it holds the blob and
all around it that may be a fragment of it.
"""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from common.arrays import Image
from slave.markers.blobs import FRAGMENT_GAP, MAX_CANDIDATES, SCALE, Blob
from slave.markers.classify import Codes, ColourTable
from slave.markers.engine import Engine
from slave.markers.group import skin_share
from slave.markers.roi import Window

FINER = (SCALE // 2, 0, 0)  # grids: step, dx, dy
OTHERS = ((SCALE, SCALE // 2, SCALE // 2), (SCALE, SCALE // 2, 0), (SCALE, 0, SCALE // 2))
STRIPS = 8  # of a frame: so many frames until a lost marker that lies still is found
ROUNDS = 3  # of widening: what reaches beyond that is larger than a marker


class Part(NamedTuple):
    """A part of the frame in columns and rows of the scan's grid; right and bottom exclusive."""

    left: int
    top: int
    right: int
    bottom: int

    def meets(self, other: "Part") -> bool:
        """Whether the two overlap or touch."""
        return (
            self.left <= other.right
            and other.left <= self.right
            and self.top <= other.bottom
            and other.top <= self.bottom
        )

    def joined(self, other: "Part") -> "Part":
        """The smallest part that holds both."""
        return Part(
            min(self.left, other.left),
            min(self.top, other.top),
            max(self.right, other.right),
            max(self.bottom, other.bottom),
        )


class Scanned(NamedTuple):
    """What a scan saw.

    Attributes:
        parts: What was scanned, and the codes (H, W) of its points.
        blobs: Of each marker's colour, the largest first.
    """

    parts: list[tuple[Part, Codes]]
    blobs: list[list[Blob]]

    def skin_share(self, skin: int, blob: Blob) -> float:
        """Share of the points around one of the blobs that are skin, 0..1; `skin`: its bit."""
        x, y = blob.u / SCALE, blob.v / SCALE
        for part, codes in self.parts:
            if part.left <= x <= part.right and part.top <= y <= part.bottom:
                dx, dy = SCALE * part.left, SCALE * part.top
                left, top, right, bottom = blob.left - dx, blob.top - dy, blob.right - dx, blob.bottom - dy
                return skin_share(codes, skin, blob._replace(left=left, top=top, right=right, bottom=bottom))
        raise ValueError(f"{blob} is not of this scan")


class Scanner:
    """Scans the frames of one camera. Holds how many there were, and which strip is searched next."""

    def __init__(self, width: int, height: int, engine: Engine) -> None:
        """Scan frames of this size [px] by `engine`."""
        self._all = Part(0, 0, width // SCALE, height // SCALE)
        self._scan = engine.scan_blobs
        self._frames = 0
        self._strip = 0

    @property
    def began(self) -> bool:
        """Whether there was a frame."""
        return self._frames > 0

    def whole(self, image: Image, table: ColourTable) -> Scanned:
        """Scan the whole frame (H, W, 3).

        A colour that the grid shows nowhere is sought on further grids: in the first frame on all of them, later on
        one more each time, in turn.
        """
        codes, blobs = self._scan(image, table, table.bits, SCALE, 0, 0, None)
        missing = [m for m, options in enumerate(blobs) if not options]
        if missing:
            codes = codes.copy()  # the next scan reuses it
            step, dx, dy = OTHERS[self._frames % len(OTHERS)] if self.began else FINER
            _, finer = self._scan(image, table, [table.bits[m] for m in missing], step, dx, dy, None)
            for m, options in zip(missing, finer, strict=True):
                blobs[m] = options
        self._frames += 1
        return Scanned([(self._all, codes)], blobs)

    def around(
        self, image: Image, table: ColourTable, windows: Sequence[Window | None], lost: Sequence[int]
    ) -> Scanned:
        """Scan where markers are expected, and for lost ones the next strip of the frame.

        Args:
            image: (H, W, 3) BGR.
            table: Colour table of the camera.
            windows: Of each marker; None: nothing is expected anywhere.
            lost: Rows of those markers that are sought.
        """
        expected = {m: [self._of_window(w)] for m, w in enumerate(windows) if w is not None}
        proposed = self._search(image, table, lost) if lost else {}
        parts = merged(part for some in (expected, proposed) for more in some.values() for part in more)
        scanned = [self._part(image, table, part) for part in parts]
        for _ in range(ROUNDS):
            wider = merged(self._widened(part, blobs) for part, _, blobs in scanned)
            if wider == parts:
                break
            parts = wider
            scanned = [self._part(image, table, part) for part in parts]
        else:
            for part, _, blobs in scanned:
                for m, options in enumerate(blobs):
                    blobs[m] = [blob for blob in options if self._of(blob, 1.0).joined(part) == part]
        found = _gathered([blobs for _, _, blobs in scanned], len(windows))
        for m in (expected.keys() | proposed.keys()) if parts else ():
            if not found[m]:
                grid = FINER if m in proposed else OTHERS[self._frames % len(OTHERS)]
                (found[m],) = _gathered([self._finer(image, table, m, part, grid) for part in parts], 1)
        self._frames += 1
        return Scanned([(part, codes) for part, codes, _ in scanned], found)

    def _search(self, image: Image, table: ColourTable, lost: Sequence[int]) -> dict[int, list[Part]]:
        """Where the next strip shows the colours of lost markers: row of the marker -> parts of the frame."""
        rows, k = self._all.bottom, self._strip
        self._strip = (k + 1) % STRIPS
        strip = Part(0, rows * k // STRIPS, self._all.right, rows * (k + 1) // STRIPS)
        found = self._on_grid(image, table, [table.bits[m] for m in lost], strip, FINER)[1]
        return {m: [self._of(blob) for blob in blobs] for m, blobs in zip(lost, found, strict=True) if blobs}

    def _part(self, image: Image, table: ColourTable, part: Part) -> tuple[Part, Codes, list[list[Blob]]]:
        codes, blobs = self._on_grid(image, table, table.bits, part, (SCALE, 0, 0))
        return part, codes.copy(), blobs

    def _finer(
        self, image: Image, table: ColourTable, m: int, part: Part, grid: tuple[int, int, int]
    ) -> list[list[Blob]]:
        return self._on_grid(image, table, [table.bits[m]], part, grid)[1]

    def _on_grid(
        self,
        image: Image,
        table: ColourTable,
        bits: Sequence[int],
        part: Part,
        grid: tuple[int, int, int],
    ) -> tuple[Codes, list[list[Blob]]]:
        step, dx, dy = grid
        times = SCALE // step
        size = times * (part.bottom - part.top), times * (part.right - part.left)
        return self._scan(image, table, bits, step, SCALE * part.left + dx, SCALE * part.top + dy, size)

    def _of_window(self, window: Window) -> Part:
        return self._within(
            window.u - window.x, window.v - window.y, window.u + window.x, window.v + window.y
        )

    def _of(self, blob: Blob, reach: float | None = None) -> Part:
        """The part that holds a blob, and around it what may be a fragment of it, or so many pixels."""
        more = FRAGMENT_GAP * math.sqrt(blob.area) + SCALE if reach is None else reach
        return self._within(blob.left - more, blob.top - more, blob.right + more, blob.bottom + more)

    def _within(self, left: float, top: float, right: float, bottom: float) -> Part:
        """From pixels to points of the grid in the image."""
        return Part(
            max(int(left) // SCALE, 0),
            max(int(top) // SCALE, 0),
            min(int(right) // SCALE + 1, self._all.right),
            min(int(bottom) // SCALE + 1, self._all.bottom),
        )

    def _widened(self, part: Part, blobs: list[list[Blob]]) -> Part:
        for options in blobs:
            for blob in options:
                part = part.joined(self._of(blob))
        return part


def merged(parts: Iterable[Part]) -> list[Part]:
    """Parts of which no two meet, so that no blob lies in two, and that hold all of these; empty ones are left out."""
    apart: list[Part] = []
    for part in parts:
        if part.left >= part.right or part.top >= part.bottom:
            continue
        rest = apart
        while met := [other for other in rest if part.meets(other)]:
            rest = [other for other in rest if other not in met]
            for other in met:
                part = part.joined(other)
        apart = [*rest, part]
    return apart


def _gathered(found: Sequence[list[list[Blob]]], count: int) -> list[list[Blob]]:
    """Blobs of `count` colours from several parts, the largest first."""
    if len(found) == 1:
        return found[0]
    every = [[blob for part in found for blob in part[m]] for m in range(count)]
    return [sorted(options, key=lambda blob: -blob.area)[:MAX_CANDIDATES] for options in every]
