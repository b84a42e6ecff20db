"""`phalanx fleet status --wait`: wait until cameras and IMUs are received.

It reports whether these cameras and IMUs are received here; an installer rolls back if they are not.

Where a master runs, it is asked what it takes. Where none does, this command gives the start and counts the
datagrams that come. When it ends, slaves wait for their master again.
"""

import json
import os
import threading
import time
from argparse import Namespace
from collections.abc import Sequence

from common.bus.bus import Bus
from common.bus.keys import link_key
from common.bus.zenoh_bus import ZenohBus
from common.calibration import RigCalibration, load
from common.clock import SystemClock
from common.errors import BusError, PhalanxError
from common.link.datagram import Address
from common.link.link_key import LinkKey
from common.messages import Health
from common.messages.streams import MASTER
from common.terminal import echo
from master.commands.options import address
from master.run.ingest import Ingest
from master.run.master_bus import join_bus
from master.run.stopping import stop_on_signals

_POLL_S = 0.1
Received = dict[str, float]


def wait_for_senders(options: Namespace) -> int:
    """Wait until datagrams of all these senders arrive.

    Returns the exit code, 1 if one of them is not received.
    """
    stop = stop_on_signals()
    names: list[str] = options.wait
    most_s = 20.0
    seconds = options.seconds or most_s
    connection = _running(options.bus)
    if connection is not None:
        try:
            received = at_master(connection, names, seconds, stop)
        finally:
            connection.close()
    else:
        setup = load(options.calibration / "rigs" / f"{options.rig}.json", RigCalibration)
        received = here(names, setup, link_key(os.environ, options.key_file), address(options.beacon, "--beacon"),
                     address(options.bind, "--bind"), seconds, stop)  # fmt: skip
    if options.as_json:
        echo(json.dumps({"heard": received, "master": connection is not None}))
    for name in names if not options.as_json else ():
        echo(f"{name}: {f'{received[name]:.0f} datagrams a second' if name in received else 'not received'}")
    return int(len(received) < len(set(names)))


def at_master(bus: Bus, names: Sequence[str], seconds: float, stop: threading.Event) -> Received:
    """Return the rates at which the running master receives these senders.

    A map name -> datagrams a second, of those whose count rises.

    Raises:
        PhalanxError: It does not know one of them.
    """
    inbox = bus.subscribe("health", MASTER)
    first: Health | None = None
    received: Received = {}
    end = time.monotonic() + seconds
    while len(received) < len(set(names)) and time.monotonic() < end and not stop.is_set():
        health = inbox.get(_POLL_S)
        if not isinstance(health, Health):
            continue
        for name in names:
            if f"{name}.received" not in health.counts:
                raise PhalanxError(
                    f"the master that runs here does not know {name!r}: does it run with --rig of that?"
                )
        if first is None or first.session != health.session:
            first, received = health, {}
        passed_s = (health.t_ns - first.t_ns) * 1e-9
        for name in names:
            count = health.counts[f"{name}.received"] - first.counts[f"{name}.received"]
            if count > 0 and passed_s > 0.0:
                received[name] = count / passed_s
    inbox.close()
    return received


def here(
    names: Sequence[str],
    rig: RigCalibration,
    key: LinkKey | bytes,
    beacon: Address,
    bind: Address,
    seconds: float,
    stop: threading.Event,
) -> Received:
    """Start the senders and count their datagrams on this machine.

    Returns name -> datagrams a second, of those that are received.

    Raises:
        PhalanxError: A name is none of the rig's.
        BusError: The port is taken.
    """
    imus = () if rig.imu is None else (rig.imu.name,)
    for name in names:
        if name not in (*rig.cameras, *imus):
            raise PhalanxError(f"rig {rig.name!r} has no camera or IMU {name!r}")
    wrists = rig.cameras if rig.kind == "wrist" else ()
    try:
        start_s = 1.0
        ingest = Ingest(rig.cameras, key, SystemClock(), beacon, bind, "", start_s, imus=imus, wrists=wrists)
    except BusError as error:
        raise BusError(f"{error}; if a master runs here, give its address: --bus ENDPOINT") from error
    try:
        return _counted(ingest, names, seconds, stop)
    finally:
        ingest.close()


def _counted(ingest: Ingest, names: Sequence[str], seconds: float, stop: threading.Event) -> Received:
    began = time.monotonic()
    first: dict[str, float] = {}
    received: Received = {}
    while time.monotonic() - began < seconds and len(received) < len(set(names)) and not stop.is_set():
        ingest.get(_POLL_S)
        while ingest.get(0.0) is not None:
            pass  # that it came is enough
        now = time.monotonic()
        for name in names:
            count = ingest.counts_of(name).received
            if count:
                passed_s = now - first.setdefault(name, now)
                rate_s = 1.0  # how long datagrams are counted after the first of each
                if passed_s >= rate_s or now - began > seconds - _POLL_S:
                    received[name] = count / max(passed_s, rate_s)
    return received


def _running(endpoint: str) -> ZenohBus | None:
    """The bus of a master that runs; None: none does."""
    try:
        bus = join_bus(endpoint)
    except BusError as error:
        if error.__cause__ is None:  # the endpoint is malformed, or keys are missing
            raise
        return None
    appear_s = 1.5  # whoever has just connected is not known everywhere yet
    end = time.monotonic() + appear_s
    while time.monotonic() < end:
        if MASTER in bus.alive():
            return bus
        time.sleep(_POLL_S)
    bus.close()
    return None
