"""Master that tracks nothing, so cameras can be seen before calibration.

It gives the start and carries the bus. Run as `python -m master.console.setup.meet --rig NAME --calibration
DIR ...`.
"""

import os
import sys
from argparse import ArgumentParser
from collections.abc import Sequence
from contextlib import ExitStack

from common.bus.keys import link_key
from common.clock import SystemClock
from common.command_line import echo
from common.errors import PhalanxError
from master.calibrate.cameras.capture import cameras_of
from master.commands.options import add_bus, add_calibration, add_link, add_rig, address
from master.run.ingest import Ingest
from master.run.process import host_bus, stop_on_signals


def meet(words: Sequence[str]) -> None:
    """Give the start to the slaves of a rig and print who is there, until Ctrl-C."""
    parser = ArgumentParser("meet", description="Give the start to the slaves of a rig.")
    for add in (add_rig, add_calibration, add_link, add_bus):
        add(parser)
    options = parser.parse_args(words)
    cameras = cameras_of(options.calibration, options.rig)
    ends = address(options.beacon, "--beacon"), address(options.bind, "--bind")
    stop = stop_on_signals()
    with ExitStack() as stack:
        link = host_bus(options.bus, cameras)
        stack.callback(link.close)
        ingest = Ingest(
            cameras, link_key(os.environ, options.key_file), SystemClock(), *ends, options.bus, 5.0
        )
        stack.callback(ingest.close)
        previous: frozenset[str] | None = None
        while not stop.wait(0.2):
            while ingest.get(0.0) is not None:
                pass  # nothing is tracked
            if (here := ingest.connected) != previous:
                absent = ", ".join(name for name in cameras if name not in here)
                echo(f"waiting for {absent}" if absent else f"all {len(cameras)} cameras are there")
                previous = here


def main() -> None:
    """The command line."""
    try:
        meet(sys.argv[1:])
    except PhalanxError as error:
        raise SystemExit(f"meet: {error}") from error


if __name__ == "__main__":
    main()
