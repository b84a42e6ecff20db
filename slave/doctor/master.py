"""Check whether the master is received.

It tests whether a beacon of this rig arrives within a second, and from where. Nothing is sent.
"""

import os
import socket
import time
from collections.abc import Iterator
from pathlib import Path

from common.bus.keys import RIG_KEY, rig_key
from common.clock import SystemClock
from common.errors import PhalanxError
from common.link.udp import UdpSocket
from slave.doctor.finding import Finding, fail, ok, unseen, warn
from slave.doctor.system import System
from slave.link import SlaveLink

NOT_RECEIVED = (
    "is phalanx-master running, with --beacon of this network? Are both in one network, and does its wireless router "
    "let clients talk to each other? UDP port {} must pass"
)


def check_master(
    system: System, keys: Path, master: str | None, port: int, bind: str = "0.0.0.0"
) -> Iterator[Finding]:
    """Listen for a beacon, as a slave with the same key does."""
    addresses: set[str] = set()
    if master is not None:
        try:
            addresses = {str(one[4][0]) for one in socket.getaddrinfo(master, None, socket.AF_INET)}
            yield ok("master's name", f"{master} is {', '.join(sorted(addresses))}")
        except OSError as error:
            yield fail(
                "master's name", f"{master}: {error.strerror}", "give its address, or NAME.local (mDNS)"
            )
    try:
        file = keys / RIG_KEY
        key = rig_key(system.environment, file if file.exists() else None)
    except (PhalanxError, OSError) as error:
        yield unseen(
            "beacon", f"without a rig key no beacon can be distinguished from a foreign one: {error}"
        )
        return
    yield _listen(SlaveLink("doctor", key, SystemClock(), os.urandom), port, bind, addresses)


def _listen(link: SlaveLink, port: int, bind: str, addresses: set[str]) -> Finding:
    try:
        beacons = UdpSocket((bind, port), shared=True, timeout_s=0.1)
    except PhalanxError as error:
        return fail("beacon", str(error), "stop what has the port, or use --beacon-port on both sides")
    listen_s = 1.0  # the beacon comes four times a second and more
    end_s = time.monotonic() + listen_s
    try:
        while time.monotonic() < end_s:
            if (arrived := beacons.receive()) is None:
                continue
            datagram, address = arrived
            before = link.refused.total()
            link.receive_beacon(datagram, address, time.monotonic_ns())
            if link.refused.total() == before:
                return _received(address[0], addresses)
    finally:
        beacons.close()
    refused = {str(reason.value): count for reason, count in link.refused.items()}
    if "version" in refused:
        return fail(
            "beacon", "a master of another version of the wire", "install the same version on both sides"
        )
    if refused:
        stated = ", ".join(f"{reason} {count}" for reason, count in refused.items())
        return fail("beacon", f"received, but not of this rig: {stated}", "compare rig.key of both sides")
    return fail("beacon", f"none in {listen_s:g} s on UDP port {port}", NOT_RECEIVED.format(port))


def _received(address: str, expected: set[str]) -> Finding:
    if expected and address not in expected:
        return warn("beacon", f"from {address}, which is not the master named", "is a second master running?")
    return ok("beacon", f"from {address}, of this rig")
