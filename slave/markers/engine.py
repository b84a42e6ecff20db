"""Choice of the code that scans and measures, by name alone."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

from common.arrays import Image
from slave.drivers import engine_of
from slave.markers.centroid import Measured, measure
from slave.markers.classify import SCALE, Blob, Codes, ColourTable, find_blobs

ScanBlobs: TypeAlias = Callable[
    [Image, ColourTable, Sequence[int], int, int, int, tuple[int, int] | None], tuple[Codes, list[list[Blob]]]
]
Measure: TypeAlias = Callable[
    [Image, ColourTable, Sequence[int], Sequence[Blob], Sequence[bool]], list[Measured | None]
]


@dataclass(frozen=True, slots=True)
class Engine:
    """The two steps of a detector that look at pixels.

    Attributes:
        scan_blobs: Image, table, bits, step, dx, dy, size of the grid as of `ColourTable.scan` -> codes of the scan
            (may be reused by the next call), and the blobs of each colour (`classify.find_blobs`).
        measure: As `centroid.measure`.
        prepare: Makes ready for a table what would else be made in the first frame: machine code, brief tables.
    """

    scan_blobs: ScanBlobs
    measure: Measure
    prepare: Callable[[ColourTable], None]


def scan_blobs(
    image: Image,
    table: ColourTable,
    bits: Sequence[int],
    step: int = SCALE,
    dx: int = 0,
    dy: int = 0,
    size: tuple[int, int] | None = None,
) -> tuple[Codes, list[list[Blob]]]:
    """Codes of the scan, which the next call reuses, and blobs of each colour."""
    codes = table.scan(image, step, dx, dy, size)
    return codes, find_blobs(codes, bits, step, dx, dy)


NUMPY = Engine(scan_blobs, measure, lambda _table: None)


def engine_named(name: str) -> Engine:
    """The engine of a name; raises what `engine_of` raises."""
    return engine_of(name, NUMPY, _numba)


def _numba() -> Engine:
    from slave.markers.fast import NUMBA

    return NUMBA
