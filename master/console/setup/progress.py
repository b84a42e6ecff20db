"""Progress of a calibration, read from the lines that it prints.

A line holds `7 of 25`, `40 %`, or a step with its number.
"""

import re
from collections.abc import Iterable

_COUNT = re.compile(r"\b(\d+) of (\d+)\b")
_SHARE = re.compile(r"\b(\d{1,3}) %")


def share_of(line: str) -> float | None:
    """Return the share of the work that a line reports as done, 0..1.

    None if it reports none.
    """
    if found := _COUNT.search(line):
        done, whole = int(found[1]), int(found[2])
        return min(done / whole, 1.0) if whole else None
    if found := _SHARE.search(line):
        return min(int(found[1]) / 100, 1.0)
    return None


def progress(lines: Iterable[str]) -> float | None:
    """Return the last share of work that any line reports.

    None if none does.
    """
    last = None
    for line in lines:
        share = share_of(line)
        last = last if share is None else share
    return last


def fault(lines: Iterable[str]) -> str:
    """Return the error that a failed command printed last.

    It includes what to do, as its author wrote it.
    """
    printed = [line.strip() for line in lines if line.strip()]
    for place, line in reversed(list(enumerate(printed))):
        if line.startswith(("phalanx: ", "phalanx-slave: ", "meet: ")):
            return " ".join([line.partition(": ")[2], *printed[place + 1 :]])
        if ": error: " in line:  # wrong usage
            return line.partition(": error: ")[2]
    return printed[-1] if printed else "it printed nothing"
