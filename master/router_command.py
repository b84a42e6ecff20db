"""`phalanx-master router` and `relay`: several masters, seen from one place, and nothing that reaches down to them."""

import os
import threading
from typing import Annotated

import typer

from common.certificates import MASTER
from common.clock import SystemClock
from common.keys import access_of
from common.zenoh_bus import ZenohBus
from master.master_bus import bus_of_master
from master.options import HERE_BUS, BusEnd, site_name
from master.relay import Relay
from master.stopping import stop_on_signals

_POLL_S = 0.5


def router(
    listen: Annotated[
        str, typer.Option(metavar="ENDPOINT", help="Where relays, readers and other routers connect.")
    ],
    connect: Annotated[
        list[str] | None,
        typer.Option(metavar="ENDPOINT", help="Another router to be joined with; once for each."),
    ] = None,
) -> None:
    """Pass on what several masters tell: each sends by a relay, under the name of its site, and readers name the site.

    Routers that are connected are one: a reader at any of them sees every site. One that was away is joined again by
    itself, and so is everybody at it. docs/scale.md says when one is needed.

    Examples:

      phalanx-master router --listen tls/0.0.0.0:47810 --keys DIR

      phalanx-master router --listen tls/0.0.0.0:47810 --connect tls/192.168.2.1:47810 --keys DIR
    """
    stop = stop_on_signals()
    bus = ZenohBus(listen, connect or [], access_of(os.environ, MASTER), router=True)
    try:
        _print("router", f"listening on {listen}" + "".join(f", joined with {one}" for one in connect or []))
        joined = 0
        while not stop.wait(_POLL_S):
            if bus.peers != joined:
                joined = bus.peers
                _print("router", f"joined with {joined} of other routers")
    finally:
        bus.close()


def relay(
    site: Annotated[str, typer.Option(help="Name of the site, as readers give it.")],
    router: Annotated[str, typer.Option(metavar="ENDPOINT", help="The router.")],
    bus: BusEnd = HERE_BUS,
) -> None:
    """Repeat at a router what a master tells: hands, objects, contact, gestures, health and the checklist.

    It only tells: no command comes down, nothing that cameras send goes up. A process of its own beside the master; it
    waits for both, goes on when either was away, and counts what a slow link had no room for.

    Examples:

      phalanx-master relay --site room-a --router tls/192.168.2.1:47810 --keys DIR

      phalanx-master view --site room-a --bus tls/192.168.2.1:47810 --keys DIR --rig desk
    """
    site_name(site)
    stop = stop_on_signals()
    below = bus_of_master(bus, stop, lambda error: _print("relay", f"waiting for the master: {error}"))
    if below is None:
        return
    try:
        above = bus_of_master(
            router, stop, lambda error: _print("relay", f"waiting for the router: {error}"), site
        )
        if above is not None:
            _repeat(below, above, site, stop)
    finally:
        below.close()


def _repeat(below: ZenohBus, above: ZenohBus, site: str, stop: threading.Event) -> None:
    try:
        repeats = Relay(below, above, SystemClock())
        _print("relay", f"repeating as {site}")
        try:
            repeats.report(lambda line: _print("relay", line), stop)
        finally:
            repeats.close()
    finally:
        above.close()


def _print(who: str, line: str) -> None:
    typer.echo(f"{who}: {line}")
