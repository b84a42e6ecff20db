"""Checks of the keys of a device.

All exist, belong together, are for this name, are valid, and nobody else can read them.
"""

from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import serialization

from common.bus.certificates import CLOCK_FIX, shown
from common.bus.keys import RIG_KEY, access_of, link_key, rig_key, secret_of
from common.errors import PhalanxError
from slave.doctor.finding import Finding, fail, ok, unseen, warn
from slave.doctor.system import System

FOLDER = "/etc/phalanx/keys"
SOON = timedelta(days=90)
MAKE = "on the PC: phalanx fleet keys DIR --make --device {}, then phalanx fleet deploy"
_PUBLIC = (serialization.Encoding.DER, serialization.PublicFormat.SubjectPublicKeyInfo)


def folder_of(system: System, given: Path | None) -> Path:
    """Return the folder of the keys.

    It is the given one, the one that the environment states, or where an installer puts them.
    """
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
        return fail(
            "certificate", f"{identity.certificate}: not signed by {identity.authority}", MAKE.format(name)
        )
    for whose, one in {
        f"the certificate of {name!r}": validity,
        "the certificate of this rig": of_rig,
    }.items():
        if fault := one.invalid_at(now, whose):
            return fail("certificate", fault, CLOCK_FIX)
    until = validity.until
    if until - now < SOON:
        return warn(
            "certificate",
            f"ends in {(until - now).days} days",
            "phalanx fleet keys DIR --renew, then phalanx fleet deploy",
        )
    return ok("certificate", f"of {name}, signed by the rig's authority, until {until:%Y-%m-%d}")
