"""A master that tracks nothing: it gives the start and carries the bus, so that cameras can be seen before they are
calibrated. `python -m master.console.setup.meet --rig NAME --calibration DIR ...`, as `phalanx-master run`.
"""

import os
from contextlib import ExitStack

import typer

from common.clock import SystemClock
from common.errors import PhalanxError
from common.keys import link_key
from master.calibrate.cameras.capture_command import cameras_of
from master.ingest import Ingest
from master.master_bus import host_bus
from master.options import (
    CALIB_JSON,
    HERE_BEACON,
    HERE_BIND,
    HERE_BUS,
    Beacon,
    Bind,
    BusEnd,
    Calibration,
    KeyFile,
    Rig,
    address,
)
from master.stopping import stop_on_signals

_START_S = 5.0
_POLL_S = 0.2


def meet(
    rig: Rig = "desk",
    calibration: Calibration = CALIB_JSON,
    beacon: Beacon = HERE_BEACON,
    bind: Bind = HERE_BIND,
    bus: BusEnd = HERE_BUS,
    key_file: KeyFile = None,
) -> None:
    """Give the start to the slaves of a rig and say who is there, until Ctrl-C."""
    cameras = cameras_of(calibration, rig)
    ends = address(beacon, "--beacon"), address(bind, "--bind")
    stop = stop_on_signals()
    with ExitStack() as stack:
        link = host_bus(bus, cameras)
        stack.callback(link.close)
        ingest = Ingest(cameras, link_key(os.environ, key_file), SystemClock(), *ends, bus, _START_S)
        stack.callback(ingest.close)
        previous: frozenset[str] | None = None
        while not stop.wait(_POLL_S):
            while ingest.get(0.0) is not None:
                pass  # nothing is tracked
            if (here := ingest.connected) != previous:
                absent = ", ".join(name for name in cameras if name not in here)
                typer.echo(f"waiting for {absent}" if absent else f"all {len(cameras)} cameras are there")
                previous = here


def main() -> None:
    """The command line."""
    try:
        typer.run(meet)
    except PhalanxError as error:
        raise SystemExit(f"meet: {error}") from error


if __name__ == "__main__":
    main()
