"""What a relay and two routers in a chain add to the age of a message: real processes, encrypted, on this machine."""

import socket
import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from bench.rigs.local import UP_S, Rig, free_port
from common.bus.bus import Subscription
from common.bus.keys import MASTER, OPERATOR, access_of
from common.bus.zenoh_bus import ZenohBus
from common.errors import BusError
from common.messages import Gesture

SITE, HOPS = "room-a", 3  # relay, router, router
_MESSAGES, _PERIOD_S = 300, 0.01


def hop_ms(folder: Path) -> tuple[float, float]:
    """Return what each hop adds, median and 99 % [ms], against a reader at the master.

    Args:
        folder: For keys; a new one.

    Raises:
        BusError: A router does not come up.
        subprocess.CalledProcessError: No keys can be made.
    """
    with ExitStack() as stack:
        rig = Rig(folder / "rig", ["cam00"])
        stack.callback(rig.close)
        near, *routers = [f"tls/127.0.0.1:{free_port(socket.SOCK_STREAM)}" for _ in range(3)]
        master = ZenohBus(near, None, access_of(rig.environment, MASTER))
        stack.callback(master.close)
        rig.start("router", "master", "fleet", "relay", "--listen", routers[0])
        rig.start("far router", "master", "fleet", "relay", "--listen", routers[1], "--connect", routers[0])
        rig.start("relay", "master", "fleet", "relay", "--bus", near, "--router", routers[0], "--site", SITE)
        inboxes: list[Subscription] = []
        for endpoint, site in ((near, None), (routers[1], SITE)):
            bus = _reader(endpoint, rig, site)
            stack.callback(bus.close)
            inboxes.append(bus.subscribe("gesture", depth=4 * _MESSAGES))
        _until_received(master, inboxes)
        ages_ms = [_ages_ms(master, inbox) for inbox in inboxes]
    # The rare long ones at the master are of another moment of the machine: they are no part of what hops add.
    typical = float(np.median(ages_ms[0]))
    p50, p99 = (float(value) for value in np.percentile(ages_ms[1], [50, 99]))
    return (p50 - typical) / HOPS, (p99 - typical) / HOPS


def _reader(endpoint: str, rig: Rig, site: str | None) -> ZenohBus:
    deadline = time.monotonic() + UP_S
    while True:
        try:
            access = access_of(rig.environment, OPERATOR)
            return ZenohBus(None, endpoint, access, beyond=True, namespace=site)
        except BusError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.2)


def _until_received(master: ZenohBus, inboxes: list[Subscription]) -> None:
    deadline = time.monotonic() + UP_S
    for inbox in inboxes:
        while inbox.get(0.05) is None:
            if time.monotonic() > deadline:
                raise BusError("nothing comes through the routers")
            master.publish("gesture", "hand", _now())


def _ages_ms(master: ZenohBus, inbox: Subscription) -> list[float]:
    """Return ages of messages [ms] as a reader who waits for each gets them."""
    while inbox.get(0.3) is not None:
        pass
    ages: list[float] = []
    for _ in range(_MESSAGES):
        master.publish("gesture", "hand", _now())
        message = inbox.get(1.0)
        if isinstance(message, Gesture):
            ages.append((time.monotonic_ns() - message.t_ns) * 1e-6)
        time.sleep(_PERIOD_S)
    return ages


def _now() -> Gesture:
    nowhere = np.full(3, np.nan)
    t_ns = time.monotonic_ns()
    return Gesture("hand", t_ns, "tap", "star", "end", t_ns, 1.0, np.nan, np.nan, np.nan, nowhere, nowhere)
