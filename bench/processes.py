"""What the kernel says of a process: memory, processor time, threads, open files (Linux, /proc)."""

import os
from dataclasses import dataclass
from pathlib import Path

_TICKS = os.sysconf("SC_CLK_TCK")
_KIB = 1024
_ROLLED = {"Rss": "rss_mb", "Pss": "pss_mb", "Anonymous": "anonymous_mb"}


@dataclass(frozen=True, slots=True)
class Footprint:
    """A process at a moment.

    Attributes:
        rss_mb: Resident memory [MB = 1e6 bytes], pages that it shares with others included.
        pss_mb: The same, each shared page divided by those that share it.
        uss_mb: What would be free if it ended: pages that nobody shares.
        anonymous_mb: Pages that are no file's: heap, stacks, arrays.
        cpu_s: Processor time since it began, user and system.
        threads, files: How many it has.
    """

    rss_mb: float
    pss_mb: float
    uss_mb: float
    anonymous_mb: float
    cpu_s: float
    threads: int
    files: int


def footprint(pid: int) -> Footprint:
    """Read it.

    Raises:
        OSError: There is no such process, or it belongs to somebody else.
    """
    folder = Path(f"/proc/{pid}")
    rolled = _kib((folder / "smaps_rollup").read_text())
    mb = {mine: rolled[theirs] * _KIB * 1e-6 for theirs, mine in _ROLLED.items()}
    private = (rolled["Private_Clean"] + rolled["Private_Dirty"]) * _KIB * 1e-6
    threads = int(_kib((folder / "status").read_text())["Threads"])
    files = sum(1 for _ in (folder / "fd").iterdir())
    return Footprint(**mb, uss_mb=private, cpu_s=cpu_s(pid), threads=threads, files=files)


def cpu_s(pid: int) -> float:
    """Processor time of a process since it began [s], all its threads, user and system.

    Raises:
        OSError: There is no such process.
    """
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / _TICKS


def _kib(text: str) -> dict[str, float]:
    """`Name: number ...` of each line that has one."""
    pairs = (line.partition(":") for line in text.splitlines())
    return {
        name: float(value.split()[0])
        for name, _, value in pairs
        if value.split() and value.split()[0].isdigit()
    }
