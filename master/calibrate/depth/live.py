"""Depth sweep with the running slaves.

It opens the link as a master does, and a person is at the keyboard.
"""

import sys
from pathlib import Path

from common.arrays import Float
from common.clock import SystemClock
from common.errors import CalibrationError
from common.link.link_key import LinkKey
from common.terminal import echo
from master.calibrate.depth.session import run_session
from master.calibrate.depth.source import Measured, Pair, straightened
from master.calibrate.depth.sweep import Sweep
from master.calibrate.depth.tables import parse_distances, write_table
from master.run.ingest import Ingest

Link = tuple[tuple[str, int], tuple[str, int], LinkKey]


def sweep_live(
    pair: Pair,
    marker: str | None,
    distances: str,
    frames: int,
    seconds: float,
    link: Link,
    table: Path | None,
    outline: Float,
) -> Measured:
    """Lead the user through a sweep with the slaves that run."""
    assert pair.rig is not None
    names = pair.rig.markers
    if marker is None or marker not in names:
        raise CalibrationError(f"--marker: which paint has the target? one of {', '.join(names)}")
    wanted: list[float] = parse_distances(distances).tolist()
    beacon, bind, key = link
    clock = SystemClock()

    def keep(sweep: Sweep) -> None:
        if table is not None:
            write_table(table, sweep)

    ingest = Ingest(pair.rig.cameras, key, clock, beacon, bind, "")
    try:
        echo(
            f"listening on {ingest.address[0]}:{ingest.address[1]}; {len(wanted)} distances, marker {marker!r}"
        )
        sweep = run_session(
            ingest,
            pair.cameras,
            names.index(marker),
            wanted,
            frames=frames,
            seconds=seconds,
            clock=clock,
            ask=_ask,
            notify=_print,
            progress=_progress,
            keep=keep,
        )
    finally:
        ingest.close()
    sweep, note = straightened(sweep, pair, outline)
    rates = ", ".join(f"{file.name} {file.frame_rate_hz:g} Hz" for file in pair.files)
    about = f"{sweep.size} places of the marker {marker!r}, measured live (cameras set to {rates}){note}"
    return Measured(sweep, pair, (table.name if table is not None else "live",), about)


def _ask(prompt: str) -> str | None:
    echo(prompt, end="")
    line = sys.stdin.readline()
    return line.rstrip("\n") if line else None


def _print(line: str) -> None:
    if sys.stderr.isatty():
        echo("\r\033[K", end="", error=True)  # the progress goes
    echo(line)


def _progress(share: float) -> None:
    if sys.stderr.isatty():
        echo(f"\rreading {100 * share:3.0f} % ", end="", error=True)
