"""`phalanx fleet relay` shows several masters in one place.

Relay of a master's messages to a router under the name of its site.

Read-only upward, nothing comes down.

Each stream has a thread and a bounded queue of its own, so that a slow link holds up neither the master nor another
stream; what did not fit is counted. Of the two ends of a relay only the lower one is asked anything.

`phalanx fleet relay`: several masters, seen from one place.

Nothing reaches down to the masters.
"""

import os
import secrets
import threading
from argparse import Namespace
from collections import Counter
from collections.abc import Callable, Sequence

from common.bus.bus import Bus, Subscription
from common.bus.keys import MASTER, access_of
from common.bus.zenoh_bus import ZenohBus
from common.clock import Clock, SystemClock
from common.command_line import UsageError, echo
from common.machine import program
from common.messages import Command, Health
from common.messages.streams import sender_of
from master.run.process import bus_of_master, stop_on_signals

STREAMS = ("hand", "object", "contact", "gesture", "health", "checklist")
NAME = "relay"


class Relay:
    """Relay that repeats messages until it is closed.

    Holds a thread for each stream, and the counts.

    `below` is the bus of the master, `above` that of the router; both belong to the caller.
    """

    def __init__(self, below: Bus, above: Bus, clock: Clock) -> None:
        """Start repeating, and report health below and above as `relay`.

        Raises:
            BusError: A bus is closed.
        """
        self.session = secrets.randbits(63)
        self._below, self._above, self._clock = below, above, clock
        self._repeated: Counter[str] = Counter(dict.fromkeys(STREAMS, 0))
        self._stop = threading.Event()
        depth = 256  # messages of a stream that may wait: 1.4 s of a hand at 90 Hz with its contact
        self._from = {stream: below.subscribe(stream, depth=depth) for stream in STREAMS}
        self._threads = [
            threading.Thread(target=self._repeat, args=(stream, source), name=f"relay {stream}", daemon=True)
            for stream, source in self._from.items()
        ]
        for thread in self._threads:
            thread.start()
        below.announce(NAME)
        above.announce(NAME)
        below.serve(NAME, self._answer)

    def health(self) -> Health:
        """Return the counts of each stream.

        repeated.NAME, and dropped.NAME and refused.NAME where there are any.
        """
        counts = {f"repeated.{stream}": number for stream, number in dict(self._repeated).items()}
        for stream, source in self._from.items():
            lost = {f"dropped.{stream}": source.dropped, f"refused.{stream}": source.refused}
            counts |= {name: number for name, number in lost.items() if number}
        return Health(NAME, self.session, self._clock.now_ns(), counts, {}, *program())

    def report(self, notify: Callable[[str], None], stop: threading.Event) -> None:
        """Report health once a second until `stop`.

        Health is published below, from where it is repeated above as all health is; a line is printed each minute.
        """
        minute = 0
        report_s = 1.0
        while not stop.wait(report_s):
            health = self.health()
            self._below.publish("health", NAME, health)
            minute += 1
            if minute % 60 == 1:
                notify(", ".join(f"{name} {number}" for name, number in health.counts.items() if number))

    def close(self) -> None:
        """End. Safe to call twice."""
        self._stop.set()
        for source in self._from.values():
            source.close()
        for thread in self._threads:
            join_s = 2.0
            thread.join(join_s)

    def _answer(self, command: Command) -> Health:
        """How it is.

        Raises:
            ValueError: Another verb than "report"; the asker reads so.
        """
        if command.verb != "report":
            raise ValueError(f"{NAME}: no command {command.verb!r}; there is report")
        return self.health()

    def _repeat(self, stream: str, source: Subscription) -> None:
        while not self._stop.is_set():
            wait_s = 0.2
            message = source.get(wait_s)
            if message is not None:
                self._above.publish(stream, sender_of(message), message)
                self._repeated[stream] += 1


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
