"""`phalanx fleet relay`: several masters, seen from one place.

Nothing reaches down to the masters.
"""

import os
import threading
from argparse import Namespace
from collections.abc import Sequence

from common.bus.certificates import MASTER
from common.bus.keys import access_of
from common.bus.zenoh_bus import ZenohBus
from common.clock import SystemClock
from common.command_line import UsageError
from common.terminal import echo
from master.commands.relay_bus import Relay
from master.run.master_bus import bus_of_master
from master.run.stopping import stop_on_signals


def relay(options: Namespace) -> None:
    """Run a router, or a relay beside a master.

    Relays, readers and other routers connect to the router.

    Raises:
        UsageError: An option is of the other one.
    """
    if options.listen is not None:
        if options.router is not None:
            raise UsageError("--router is for --site; two routers are joined by --connect")
        _route(options.listen, options.connect)
        return
    if options.router is None:
        raise UsageError("--site: give the address of the router, --router ENDPOINT")
    if options.connect:
        raise UsageError("--connect is for --listen")
    stop = stop_on_signals()
    below = bus_of_master(
        options.bus, stop, lambda error: _notify("relay", f"waiting for the master: {error}")
    )
    if below is None:
        return
    try:
        above = bus_of_master(
            options.router,
            stop,
            lambda error: _notify("relay", f"waiting for the router: {error}"),
            options.site,
        )
        if above is not None:
            _repeat(below, above, options.site, stop)
    finally:
        below.close()


def _route(listen: str, connect: Sequence[str]) -> None:
    stop = stop_on_signals()
    bus = ZenohBus(listen, connect, access_of(os.environ, MASTER), router=True)
    try:
        _notify("router", f"listening on {listen}" + "".join(f", joined with {one}" for one in connect))
        joined = 0
        poll_s = 0.5
        while not stop.wait(poll_s):
            if bus.peers != joined:
                joined = bus.peers
                _notify("router", f"joined with {joined} of other routers")
    finally:
        bus.close()


def _repeat(below: ZenohBus, above: ZenohBus, site: str, stop: threading.Event) -> None:
    try:
        repeats = Relay(below, above, SystemClock())
        _notify("relay", f"repeating as {site}")
        try:
            repeats.report(lambda line: _notify("relay", line), stop)
        finally:
            repeats.close()
    finally:
        above.close()


def _notify(who: str, line: str) -> None:
    echo(f"{who}: {line}")
