"""Memory that rises at once and stays: when, by how much, and in which mapping of the process.

A slope hardly sees it: the median of the slopes of all pairs leaves one step out, as it is to leave out one minute of
nonsense. A step is what a buffer makes that comes late, or memory that is freed and kept by the C library.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from common.arrays import Float

STEP_MB = 2.0
LEAST_MINUTES = 3
_MINUTE_S = 60.0
_SHOWN_MB = 0.5
_MOST_SHOWN = 3
_KIB = 1024


@dataclass(frozen=True, slots=True)
class Step:
    """A rise of resident memory: minute in which it came, and how much [MB = 1e6 bytes]."""

    minute: int
    mb: float


@dataclass(frozen=True, slots=True)
class Mapping:
    """Addresses from `start` to before `end`, `ADDRESS NAME`, and how much of it is resident [MB]."""

    start: int
    end: int
    name: str
    mb: float


def steps_of(times_s: Sequence[float] | Float, mb: Sequence[float] | Float) -> list[Step] | None:
    """Rises of more than `STEP_MB` from the median of one minute to that of the next; None: too short to say.

    Rises in minutes that follow each other are one step. In the first minute files are read and tables filled: the
    second is held against the most that it had.

    Args:
        times_s: (N,) readings [s].
        mb: (N,) resident memory [MB].
    """
    times, values = np.asarray(times_s, np.float64), np.asarray(mb, np.float64)
    block = (times // _MINUTE_S).astype(np.int64)
    minutes = [int(k) for k in np.unique(block)]
    if len(minutes) < LEAST_MINUTES:
        return None
    medians = [float(np.median(values[block == k])) for k in minutes]
    medians[0] = float(values[block == minutes[0]].max())
    found: list[Step] = []
    for minute, before, after in zip(minutes[1:], medians, medians[1:], strict=False):
        rise = after - before
        if rise <= STEP_MB:
            continue
        if found and minute == found[-1].minute + 1:
            found[-1] = Step(minute, found[-1].mb + rise)
        else:
            found.append(Step(minute, rise))
    return found


def mapped(pid: int) -> list[Mapping]:
    """What a process has mapped, and how much of each is resident.

    Raises:
        OSError: There is no such process, or it belongs to somebody else.
    """
    found: list[Mapping] = []
    for line in Path(f"/proc/{pid}/smaps").read_text().splitlines():
        first, _, rest = line.partition(" ")
        if not first.endswith(":"):  # a mapping begins: addresses, rights, offset, device, inode, name
            start, _, end = first.partition("-")
            fields = rest.split(maxsplit=4)
            name = Path(fields[4]).name if len(fields) > 4 else "anonymous"
            found.append(Mapping(int(start, 16), int(end, 16), f"{start} {name}", 0.0))
        elif first == "Rss:":
            found[-1] = replace(found[-1], mb=float(rest.split()[0]) * _KIB * 1e-6)
    return found


def grown(before: Sequence[Mapping], after: Sequence[Mapping]) -> dict[str, float]:
    """Mapping -> by how much it has grown [MB], the largest first; those that grew by little are left out.

    The kernel joins neighbours and grows them at either end: a mapping is held against all that lay where it lies.
    """
    more = {
        one.name: one.mb - sum(old.mb for old in before if old.start < one.end and one.start < old.end)
        for one in after
    }
    kept = sorted((one for one in more.items() if one[1] > _SHOWN_MB), key=lambda one: -one[1])
    return dict(kept[:_MOST_SHOWN])
