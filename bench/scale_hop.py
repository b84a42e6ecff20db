"""What a relay and two routers in a chain add to the age of a message: real processes, encrypted, on this machine."""

import os
import socket
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from bench.local_rig import free_port
from common.bus.bus import Subscription
from common.bus.certificates import MASTER, OPERATOR
from common.bus.keys import FOLDER, access_of
from common.bus.zenoh_bus import ZenohBus
from common.errors import BusError
from common.messages import Gesture

SITE, HOPS = "room-a", 3  # relay, router, router
_READY_S, _MESSAGES, _PERIOD_S = 60.0, 300, 0.01


def hop_ms(folder: Path) -> tuple[float, float]:
    """What each hop adds, median and 99 % [ms], against who reads at the master.

    Args:
        folder: For keys; a new one.

    Raises:
        BusError: A router does not come up.
        subprocess.CalledProcessError: No keys can be made.
    """
    keys = folder / "keys"
    run = [sys.executable, "-m", "master"]
    subprocess.run([*run, "fleet", "keys", str(keys), "--make"], check=True, stdout=subprocess.DEVNULL)
    ends = [f"tls/127.0.0.1:{free_port(socket.SOCK_STREAM)}" for _ in range(3)]
    commands = (
        ["fleet", "relay", "--listen", ends[1]],
        ["fleet", "relay", "--listen", ends[2], "--connect", ends[1]],
        ["fleet", "relay", "--bus", ends[0], "--router", ends[1], "--site", SITE],
    )
    with ExitStack() as stack:
        master = ZenohBus(ends[0], None, access_of({}, MASTER, keys))
        stack.callback(master.close)
        for words in commands:
            process = subprocess.Popen(
                [*run, *words], env=os.environ | {FOLDER: str(keys)}, stdout=subprocess.DEVNULL
            )
            stack.callback(process.wait)
            stack.callback(process.kill)
        near = _reader(ends[0], keys, None)
        stack.callback(near.close)
        far = _reader(ends[2], keys, SITE)
        stack.callback(far.close)
        received = [bus.subscribe("gesture", depth=4 * _MESSAGES) for bus in (near, far)]
        _until_received(master, received)
        ages = [_ages(master, source) for source in received]
    # The rare long ones at the master are of another moment of the machine: they are no part of what hops add.
    typical = float(np.median(ages[0]))
    p50, p99 = (float(value) for value in np.percentile(ages[1], [50, 99]))
    return (p50 - typical) / HOPS, (p99 - typical) / HOPS


def _reader(endpoint: str, keys: Path, site: str | None) -> ZenohBus:
    deadline = time.monotonic() + _READY_S
    while True:
        try:
            return ZenohBus(None, endpoint, access_of({}, OPERATOR, keys), beyond=True, namespace=site)
        except BusError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.2)


def _until_received(master: ZenohBus, received: list[Subscription]) -> None:
    deadline = time.monotonic() + _READY_S
    for source in received:
        while source.get(0.05) is None:
            if time.monotonic() > deadline:
                raise BusError("nothing comes through the routers")
            master.publish("gesture", "hand", _now())


def _ages(master: ZenohBus, source: Subscription) -> list[float]:
    """Ages of messages [ms] as a reader who waits for each gets them."""
    while source.get(0.3) is not None:
        pass
    ages: list[float] = []
    for _ in range(_MESSAGES):
        master.publish("gesture", "hand", _now())
        message = source.get(1.0)
        if isinstance(message, Gesture):
            ages.append((time.monotonic_ns() - message.t_ns) * 1e-6)
        time.sleep(_PERIOD_S)
    return ages


def _now() -> Gesture:
    nowhere = np.full(3, np.nan)
    t_ns = time.monotonic_ns()
    return Gesture("hand", t_ns, "tap", "star", "end", t_ns, 1.0, np.nan, np.nan, np.nan, nowhere, nowhere)
