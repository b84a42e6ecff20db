"""Coarse colour table with one entry per cell of 8 x 8 x 8 colours.

It summarises the colour table for each cell and is small enough for the fastest caches.

The whole table (16 MiB and more) lies in slow memory; nearly all cells belong to the same markers throughout, so that
only one pixel in sixty has to be looked up there.
"""

from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np

from slave.markers.classify import Codes, ColourTable, Places
from slave.markers.fast_compile import compiled

CELLS = 32  # of each channel


class Cells(NamedTuple):
    """Codes (32^3,) of cells at (blue >> 3) | (green >> 3) << 5 | (red >> 3) << 10.

    Attributes:
        first: Of the cell's first colour, whose lowest three bits are 0: what a scan asks for.
        markers: Of all its colours, markers alone; the bit of skin indicates that they differ.
        skin: (1,) that bit.
    """

    first: Codes
    markers: Codes
    skin: Codes


_KNOWN: WeakKeyDictionary[ColourTable, Cells] = WeakKeyDictionary()  # a table never changes


def cells_of(table: ColourTable) -> Cells:
    """Return the cells of a table.

    Takes 15 ms at the first call; then they are cached as long as the table lives.
    """
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
