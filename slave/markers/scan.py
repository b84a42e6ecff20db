"""Scan whole frames, or windows of them, and choose which by their cost.

    whole    one table look-up on every fourth pixel of every fourth row, and on a further grid where a colour shows on
             none of these points
    windows  the same points in the windows of tracked markers alone. While a marker is lost, one strip of the frame is
             searched for its colour in every frame, all of it in `STRIPS` frames

A blob has the same points, centroid and box in both: a window is widened until it holds the blob and all around it
that may be a fragment of it. The choice goes by the processor time of the detection against the time between two
frames; from time to time one frame is scanned whole, so that it shows when whole frames fit again.
"""

import logging
import math
from collections.abc import Iterable, Sequence
from statistics import median
from typing import Literal, NamedTuple, TypeAlias

import numpy as np

from common.arrays import Image
from common.calibration import CameraCalibration
from slave.drivers import SCANS
from slave.markers.classify import FRAGMENT_GAP, MAX_CANDIDATES, SCALE, Blob, Codes, ColourTable
from slave.markers.engine import Engine
from slave.markers.track import Window

FINER = (SCALE // 2, 0, 0)  # grids: step, dx, dy
OTHERS = ((SCALE, SCALE // 2, SCALE // 2), (SCALE, SCALE // 2, 0), (SCALE, 0, SCALE // 2))
STRIPS = 8  # of a frame: so many frames until a lost marker that lies still is found


# A part of the frame in columns and rows of the scan's grid: left, top, right, bottom; the last two exclusive.
Part: TypeAlias = tuple[int, int, int, int]


class Scanned(NamedTuple):
    """What a scan saw."""

    parts: list[tuple[Part, Codes]]  # what was scanned, and the codes (H, W) of its points
    blobs: list[list[Blob]]  # of each marker's colour, the largest first

    def skin_share(self, skin: int, blob: Blob) -> float:
        """Return the share 0..1 of skin around one of the blobs; `skin`: its bit."""
        x, y = blob.u / SCALE, blob.v / SCALE
        (x0, y0, _, _), codes = next(
            (part, codes) for part, codes in self.parts if part[0] <= x <= part[2] and part[1] <= y <= part[3]
        )
        # The box is as wide as the grid leaves open: its border lies one pixel before the points around the blob.
        top, left = max((blob.top - 1) // SCALE - y0, 0), max((blob.left - 1) // SCALE - x0, 0)
        window = codes[top : blob.bottom // SCALE + 1 - y0, left : blob.right // SCALE + 1 - x0]
        around = window.size - blob.area / SCALE**2
        return min(1.0, float(np.count_nonzero(window & skin)) / max(around, 1.0))


class Scanner:
    """Scans the frames of one camera. Holds which grid and strip are next."""

    def __init__(self, width: int, height: int, engine: Engine) -> None:
        """Scan frames of this size [px] by `engine`."""
        self._columns, self._rows = width // SCALE, height // SCALE
        self._scan = engine.scan_blobs
        self._cycle = -1  # negative before the first frame
        self._strip = 0

    @property
    def began(self) -> bool:
        """Whether there was a frame."""
        return self._cycle >= 0

    def whole(self, image: Image, table: ColourTable) -> Scanned:
        """Scan a frame; for colours that show nowhere also further grids, in turn."""
        codes, blobs = self._scan(image, table, table.bits, SCALE, 0, 0, None)
        missing = _missing(table, blobs)
        if missing:
            codes = codes.copy()  # the next scan reuses it
            step, dx, dy = OTHERS[self._cycle] if self.began else FINER
            self._cycle = (self._cycle + 1) % len(OTHERS)
            _, finer = self._scan(image, table, [table.bits[m] for m in missing], step, dx, dy, None)
            for m, options in zip(missing, finer, strict=True):
                blobs[m] = _with(blobs[m], options)
        elif not self.began:
            self._cycle = 0
        return Scanned([((0, 0, self._columns, self._rows), codes)], blobs)

    def around(
        self, image: Image, table: ColourTable, windows: Sequence[Sequence[Window]], lost: Sequence[int]
    ) -> Scanned:
        """Scan where markers are expected, and for lost ones the next strip of the frame."""
        wanted = {m for m, some in enumerate(windows) if some}
        asked = [self._around(w.u - w.x, w.v - w.y, w.u + w.x, w.v + w.y) for some in windows for w in some]
        proposed = self._search(image, table, lost) if lost else {}
        asked += [self._of(blob) for blobs in proposed.values() for blob in blobs]
        rounds = 3  # of scans, each wider, before that of the whole frame: what reaches so far is no marker
        for _ in range(rounds):
            parts = merged(asked)
            scanned = [self._part(image, table, part) for part in parts]
            clipped = [blob for part, _, blobs in scanned for blob in self._clipped(part, blobs)]
            if not clipped:
                break
            asked = [*parts, *(self._of(blob) for blob in clipped)]
        else:
            return self.whole(image, table)
        found = _gathered([blobs for _, _, blobs in scanned], len(windows))
        missing = _missing(table, found)
        for m in missing:
            if m in wanted or m in proposed:
                step, dx, dy = FINER if m in proposed else OTHERS[self._cycle]
                seen = [self._on_grid(image, table, [table.bits[m]], part, step, dx, dy)[1] for part in parts]
                found[m] = _with(found[m], _gathered(seen, 1)[0])
        if missing:
            self._cycle = (self._cycle + 1) % len(OTHERS)
        return Scanned([(part, codes) for part, codes, _ in scanned], found)

    def _search(self, image: Image, table: ColourTable, lost: Sequence[int]) -> dict[int, list[Blob]]:
        """Scan the next strip for lost markers: row of the marker -> blobs."""
        rows, k = self._rows, self._strip
        self._strip = (k + 1) % STRIPS
        strip = 0, rows * k // STRIPS, self._columns, rows * (k + 1) // STRIPS
        found = self._on_grid(image, table, [table.bits[m] for m in lost], strip, *FINER)[1]
        return {m: blobs for m, blobs in zip(lost, found, strict=True) if blobs}

    def _part(self, image: Image, table: ColourTable, part: Part) -> tuple[Part, Codes, list[list[Blob]]]:
        codes, blobs = self._on_grid(image, table, table.bits, part, SCALE, 0, 0)
        return part, codes.copy(), blobs

    def _on_grid(
        self, image: Image, table: ColourTable, bits: Sequence[int], part: Part, step: int, dx: int, dy: int
    ) -> tuple[Codes, list[list[Blob]]]:
        left, top, right, bottom = part
        times = SCALE // step
        size = times * (bottom - top), times * (right - left)
        return self._scan(image, table, bits, step, SCALE * left + dx, SCALE * top + dy, size)

    def _around(self, left: float, top: float, right: float, bottom: float) -> Part:
        """The part of the frame that holds this box [px]."""
        x1, y1 = min(int(right) // SCALE + 1, self._columns), min(int(bottom) // SCALE + 1, self._rows)
        return max(int(left) // SCALE, 0), max(int(top) // SCALE, 0), x1, y1

    def _of(self, blob: Blob) -> Part:
        """The part that holds a blob, and around it whatever may be a fragment of it."""
        reach = _reach(blob)
        return self._around(blob.left - reach, blob.top - reach, blob.right + reach, blob.bottom + reach)

    def _clipped(self, part: Part, blobs: list[list[Blob]]) -> list[Blob]:
        """Blobs that the part may not hold whole, or not with all their fragments."""
        # Where the part ends at the border of the image, nothing is cut off.
        x0, y0, x1, y1 = part
        left, top = SCALE * x0 if x0 > 0 else -math.inf, SCALE * y0 if y0 > 0 else -math.inf
        right = SCALE * x1 if x1 < self._columns else math.inf
        bottom = SCALE * y1 if y1 < self._rows else math.inf
        clipped: list[Blob] = []
        for options in blobs:
            for blob in options:
                reach = _reach(blob)
                if not (
                    left <= blob.left - reach
                    and blob.right + reach <= right
                    and top <= blob.top - reach
                    and blob.bottom + reach <= bottom
                ):
                    clipped.append(blob)
        return clipped


def _missing(table: ColourTable, blobs: Sequence[Sequence[Blob]]) -> list[int]:
    """Markers of whose paint there are fewer blobs than markers."""
    return [m for m, options in enumerate(blobs) if len(options) < table.sharing[m]]


def _with(blobs: list[Blob], more: list[Blob]) -> list[Blob]:
    """Add blobs of another grid to those of a colour, the largest first."""
    new = [one for one in more if not any(one.meets(blob) for blob in blobs)]
    return sorted([*blobs, *new], key=lambda blob: -blob.area)[:MAX_CANDIDATES] if blobs else new


def _reach(blob: Blob) -> float:
    """How far from a blob a fragment of it may begin [px]."""
    return FRAGMENT_GAP * math.sqrt(blob.area) + SCALE


def merged(parts: Iterable[Part]) -> list[Part]:
    """Merge parts that meet, so that no blob lies in two; leave out empty ones."""
    disjoint: list[Part] = []
    for part in parts:
        left, top, right, bottom = part
        if left >= right or top >= bottom:
            continue
        k = 0
        while k < len(disjoint):
            x0, y0, x1, y1 = disjoint[k]
            if left <= x1 and x0 <= right and top <= y1 and y0 <= bottom:
                left, top = x0 if x0 < left else left, y0 if y0 < top else top
                right, bottom = x1 if x1 > right else right, y1 if y1 > bottom else bottom
                del disjoint[k]
                k = 0  # it may meet now what it did not before
            else:
                k += 1
        disjoint.append((left, top, right, bottom))
    return disjoint


def _gathered(found: Sequence[list[list[Blob]]], count: int) -> list[list[Blob]]:
    """Blobs of `count` colours from several parts, the largest first."""
    if len(found) == 1:
        return found[0]
    every = [[blob for part in found for blob in part[m]] for m in range(count)]
    return [sorted(options, key=lambda blob: -blob.area)[:MAX_CANDIDATES] for options in every]


Scan: TypeAlias = Literal["auto", "full", "windows"]
JUDGED = 30  # whole frames whose median is judged
PROBE_EVERY = 600  # frames, 10 s at 60 Hz: one of so many is scanned whole while windows are chosen
PROBES = 3  # of them whose median is judged then
_LOG = logging.getLogger(__name__)


class ScanChoice:
    """Choice by what frames cost; `frames`: those scanned in windows only."""

    def __init__(self, scan: Scan, camera: CameraCalibration) -> None:
        """Choose for `camera`; "auto" begins with whole frames; ValueError: no such name."""
        if scan not in SCANS:
            raise ValueError(f"scan {scan!r}, not one of {', '.join(SCANS)}")
        self._scan, self._name = scan, camera.name
        self._windows = scan == "windows"
        self._costs: list[int] = []  # of whole frames [ns], until enough are there to be judged
        self._since = 0  # frames since one was scanned whole
        self.frames = 0
        self.tune(camera)

    def tune(self, camera: CameraCalibration) -> None:
        """The camera has another rate. From any thread."""
        self._period_ns = 1e9 / camera.frame_rate_hz

    @property
    def windows(self) -> bool:
        """Whether only windows are scanned in the next frame."""
        return self._windows and not (self._scan == "auto" and self._since >= PROBE_EVERY)

    def push(self, spent_ns: int) -> None:
        """Record the processor time [ns] of a frame scanned as `windows` specified."""
        if self.windows:
            self.frames += 1
            self._since += 1
            return
        self._since = 0
        if self._scan != "auto":
            return
        self._costs.append(spent_ns)
        if len(self._costs) < (PROBES if self._windows else JUDGED):
            return
        full_share = 0.9  # of the time between two frames: where whole frames take more, they do not fit
        fits_share = 0.7  # and where they take less again, they do
        cost_ns, share = median(self._costs), fits_share if self._windows else full_share
        self._costs.clear()
        if (cost_ns > share * self._period_ns) != self._windows:
            self._switch(cost_ns)

    def _switch(self, cost_ns: float) -> None:
        self._windows = not self._windows
        took = f"to scan a whole frame takes {cost_ns * 1e-6:.1f} ms of the {self._period_ns * 1e-6:.1f} ms of a frame"
        if self._windows:
            _LOG.warning(
                "%s: %s: from now on only windows about the markers are scanned, and a lost marker is sought strip by "
                "strip (--scan auto, docs/cameras.md)",
                self._name,
                took,
            )
        else:
            _LOG.warning("%s: %s again: from now on whole frames are scanned", self._name, took)
