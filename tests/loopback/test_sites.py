"""Two sites, two routers in a chain, encrypted: a reader at the far end hears both by name; a router that was killed is
found again by everybody; no command comes down.

Routers and relays are real processes; a master is what tells: its end of the bus.
"""

import os
import subprocess
import sys
import time
from collections.abc import Callable, Generator
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from common.bus.bus import Subscription
from common.bus.keys import FOLDER, OPERATOR, access_of
from common.bus.keys import MASTER as AS_MASTER
from common.bus.zenoh_bus import ZenohBus
from common.errors import BusError
from common.messages import Command, Gesture, Health
from common.messages.streams import MASTER
from master.commands.keys import make
from tests.network_helpers import free_endpoint, until

SITES = {"room-a": "star", "room-b": "hash"}  # and the key that is tapped there, to tell them apart
READY_S, BACK_S = 60.0, 60.0


def probe(key: str) -> Gesture:
    """What a master tells."""
    nowhere = np.full(3, np.nan)
    return Gesture("right", 1, "tap", key, "end", 1, 1.0, np.nan, np.nan, np.nan, nowhere, nowhere)


class Building:
    """Two masters that tell, routers `near` (with the relays) and `far`, and a reader of each site at the latter."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self.folder, self.keys, self._stack = folder, folder / "keys", stack
        make(self.keys, [], datetime.now(UTC))
        tls = [free_endpoint().replace("tcp/", "tls/") for _ in range(4)]
        self.near, self.far = tls[:2]
        self.asked: list[Command] = []
        self.masters: dict[str, ZenohBus] = {}
        self.near_router = self.start("near", "fleet", "relay", "--listen", self.near)
        self.start("far", "fleet", "relay", "--listen", self.far, "--connect", self.near)
        for site, endpoint in zip(SITES, tls[2:], strict=True):
            self.masters[site] = bus = ZenohBus(endpoint, None, access_of({}, AS_MASTER, self.keys))
            stack.callback(bus.close)
            bus.serve(MASTER, self._obey)
            self.start(site, "fleet", "relay", "--bus", endpoint, "--router", self.near, "--site", site)
        self.readers = {site: self.opened(lambda site=site: self.reader(site)) for site in SITES}
        self.received = {site: bus.subscribe("gesture") for site, bus in self.readers.items()}

    def reader(self, site: str) -> ZenohBus:
        """Who reads one site at the far router."""
        access = access_of({}, OPERATOR, self.keys)
        return ZenohBus(None, self.far, access, beyond=True, namespace=site)

    def opened(self, bus: Callable[[], ZenohBus]) -> ZenohBus:
        """A bus, once somebody listens there."""
        found: list[ZenohBus] = []

        def attempt() -> bool:
            try:
                found.append(bus())
            except BusError:
                time.sleep(0.2)
            return bool(found)

        assert until(attempt, READY_S), self.logs()
        self._stack.callback(found[0].close)
        return found[0]

    def start(self, name: str, *words: str) -> subprocess.Popen[bytes]:
        """A process of the master's program; it is ended with the building."""
        environment = os.environ | {FOLDER: str(self.keys)}
        with (self.folder / f"{name}.log").open("a") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", "master", *words], env=environment, stdout=log, stderr=log
            )
        self._stack.callback(process.wait)
        self._stack.callback(process.kill)
        return process

    def announce(self) -> None:
        """Every master tells something."""
        for site, bus in self.masters.items():
            bus.publish("gesture", "right", probe(SITES[site]))

    def what_comes(self, wait_s: float) -> dict[str, set[str]]:
        """Tell until every reader has heard something, and once more; what each heard."""
        for source in self.received.values():
            _all(source)
        received: dict[str, set[str]] = {site: set() for site in SITES}

        def all_received() -> bool:
            self.announce()
            time.sleep(0.05)
            for site, source in self.received.items():
                received[site] |= _all(source)
            return all(received.values())

        assert until(all_received, wait_s), f"heard {received}; {self.logs()}"
        return received

    def logs(self) -> str:
        """The last words of every process."""
        return "\n".join(f"{one.stem}: {one.read_text()[-400:]}" for one in self.folder.glob("*.log"))

    def _obey(self, command: Command) -> Health:
        self.asked.append(command)
        return Health(MASTER, 1, 1, {}, {})


def _all(source: Subscription) -> set[str]:
    """The keys that waiting messages tell."""
    out: set[str] = set()
    while isinstance(one := source.get(0.0), Gesture):
        out.add(one.name)
    return out


@pytest.fixture(scope="module")
def building(tmp_path_factory: pytest.TempPathFactory) -> Generator[Building]:
    """All of it."""
    with ExitStack() as stack:
        yield Building(tmp_path_factory.mktemp("sites"), stack)


def test_a_reader_hears_the_site_that_it_names_and_no_other(building: Building) -> None:
    assert building.what_comes(READY_S) == {site: {key} for site, key in SITES.items()}


def test_no_command_comes_down_and_what_a_reader_says_neither(building: Building) -> None:
    building.what_comes(READY_S)
    below = building.masters["room-a"].subscribe("health")
    reader = building.readers["room-a"]
    with pytest.raises(BusError, match="no answer from 'master'"):
        reader.ask(Command(MASTER, "stop"), 0.5)
    reader.publish("health", "stranger", Health("stranger", 1, 1, {}, {}))
    time.sleep(0.5)
    assert building.asked == []
    sources: set[str] = set()
    while isinstance(one := below.get(0.0), Health):
        sources.add(one.source)
    assert "stranger" not in sources


def test_a_router_that_was_killed_is_found_again_by_relays_routers_and_readers(building: Building) -> None:
    building.what_comes(READY_S)
    building.near_router.kill()
    building.near_router.wait()
    building.near_router = building.start("near", "fleet", "relay", "--listen", building.near)
    assert building.what_comes(BACK_S) == {site: {key} for site, key in SITES.items()}
