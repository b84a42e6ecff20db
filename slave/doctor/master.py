"""Check the keys of a device, and whether the master is received.

A beacon of this rig has to arrive within a second; nothing is sent. All keys exist, belong together, are for this
name, are valid, and nobody else can read them.
"""

import contextlib
import os
import socket
import time
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import serialization

from common.bus.keys import CLOCK_FIX, RIG_KEY, access_of, link_key, rig_key, secret_of, shown
from common.clock import SystemClock
from common.errors import PhalanxError
from common.link.datagram import UdpSocket
from slave.doctor.host import Finding, System, fail, ok, unseen, warn
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
            fix = "give its address, or NAME.local (mDNS)"
            yield fail("master's name", f"{master}: {error.strerror}", fix)
    try:
        file = keys / RIG_KEY
        key = rig_key(system.environment, file if file.exists() else None)
    except (PhalanxError, OSError) as error:
        why = (
            "only root may read it: sudo phalanx-slave doctor"
            if isinstance(error, PermissionError)
            else error
        )
        yield unseen("beacon", f"without a rig key no beacon can be distinguished from a foreign one: {why}")
        return
    yield _listen(SlaveLink("doctor", key, SystemClock(), os.urandom), port, bind, addresses)


def _listen(link: SlaveLink, port: int, bind: str, addresses: set[str]) -> Finding:
    try:
        beacons = UdpSocket((bind, port), shared=True, timeout_s=0.1)
    except PhalanxError as error:
        return fail("beacon", str(error), "stop what has the port, or use --beacon-port on both sides")
    listen_s = 1.0  # the beacon comes four times a second and more
    end_s = time.monotonic() + listen_s
    with contextlib.closing(beacons):
        while time.monotonic() < end_s:
            if (arrived := beacons.receive()) is None:
                continue
            datagram, address = arrived
            before = link.refused.total()
            link.receive_beacon(datagram, address, time.monotonic_ns())
            if link.refused.total() == before:
                if addresses and address[0] not in addresses:
                    text = f"from {address[0]}, which is not the master named"
                    return warn("beacon", text, "is a second master running?")
                return ok("beacon", f"from {address[0]}, of this rig")
    refused = {str(reason.value): count for reason, count in link.refused.items()}
    if "version" in refused:
        fix = "install the same version on both sides"
        return fail("beacon", "a master of another version of the wire", fix)
    if refused:
        stated = ", ".join(f"{reason} {count}" for reason, count in refused.items())
        return fail("beacon", f"received, but not of this rig: {stated}", "compare rig.key of both sides")
    return fail("beacon", f"none in {listen_s:g} s on UDP port {port}", NOT_RECEIVED.format(port))


FOLDER = "/etc/phalanx/keys"
SOON = timedelta(days=90)
MAKE = "on the PC: phalanx fleet keys DIR --make --device {}, then phalanx fleet deploy"
_PUBLIC = (serialization.Encoding.DER, serialization.PublicFormat.SubjectPublicKeyInfo)


def folder_of(system: System, given: Path | None) -> Path:
    """Folder of the keys: given, of the environment, or where an installer puts it."""
    if given is not None:
        return given
    named = system.environment.get("PHALANX_KEYS")
    return Path(named) if named else system.path(FOLDER)


def check_keys(
    system: System, folder: Path, name: str | None, now: datetime | None = None
) -> Iterator[Finding]:
    """The keys folder, as the device `name` uses it."""
    try:
        next(folder.iterdir(), None)
    except FileNotFoundError:
        yield fail("keys", f"{folder}: no such folder", MAKE.format(name or "NAME"))
        return
    except PermissionError:
        yield unseen("keys", f"{folder}: only root may look: sudo phalanx-slave doctor")
        return
    if folder.stat().st_mode & 0o077:
        yield warn("keys", f"{folder}: others may look into it", f"sudo chmod 700 {folder}")
    try:
        rig_key({}, folder / RIG_KEY)
    except (PhalanxError, OSError) as error:
        yield fail("rig key", str(error), MAKE.format(name or "NAME"))
    else:
        yield ok("rig key", str(folder / RIG_KEY))
    if name is None:
        yield unseen("certificate", "of whom? give --name")
        return
    try:
        link_key(system.environment, None, folder, name)
    except (PhalanxError, OSError) as error:
        yield fail("secret", str(error), MAKE.format(name))
    else:
        yield ok("secret", str(secret_of(folder, name)))
    yield _certificate(system, folder, name, now or datetime.now(UTC))


def _certificate(system: System, folder: Path, name: str, now: datetime) -> Finding:
    try:
        identity = access_of(system.environment, name, folder).identity()
        own = x509.load_pem_x509_certificate(identity.certificate.read_bytes())
        authority = x509.load_pem_x509_certificate(identity.authority.read_bytes())
        key = serialization.load_pem_private_key(identity.key.read_bytes(), None)
        validity = shown(identity.certificate.read_bytes())
        of_rig = shown(identity.authority.read_bytes())
    except (PhalanxError, OSError, ValueError) as error:
        return fail("certificate", str(error), MAKE.format(name))
    if key.public_key().public_bytes(*_PUBLIC) != own.public_key().public_bytes(*_PUBLIC):
        return fail("certificate", f"{identity.key}: the key of another certificate", MAKE.format(name))
    try:
        own.verify_directly_issued_by(authority)
    except (InvalidSignature, ValueError, TypeError):
        text = f"{identity.certificate}: not signed by {identity.authority}"
        return fail("certificate", text, MAKE.format(name))
    of_device = validity.invalid_at(now, f"the certificate of {name!r}")
    if fault := of_device or of_rig.invalid_at(now, "the certificate of this rig"):
        return fail("certificate", fault, CLOCK_FIX)
    until = validity.until
    if until - now < SOON:
        fix = "phalanx fleet keys DIR --renew, then phalanx fleet deploy"
        return warn("certificate", f"ends in {(until - now).days} days", fix)
    return ok("certificate", f"of {name}, signed by the rig's authority, until {until:%Y-%m-%d}")
