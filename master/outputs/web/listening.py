"""Web pages that other machines may open.

They are encrypted by a certificate of this machine's own, or plain where that is requested. The certificate
signs itself. It is not of the rig's authority on purpose: a certificate of that may be shown by whoever
listens only to be the master (docs/security.md), and nobody should have to trust a rig's authority in his
browser. The browser asks once; what it shows is compared with the fingerprint that is printed at the start.
"""

import os
import socket
import ssl
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from pathlib import Path

import psutil
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from common.bus.endpoints import loopback
from common.bus.keys import OPEN, OTHERS
from common.errors import PhalanxError

LIFE = timedelta(days=397)  # browsers refuse a longer life
_RENEW_BEFORE = timedelta(days=14)
_ANYWHERE = frozenset({"0.0.0.0", "::"})


@dataclass(frozen=True, slots=True)
class PageCertificate:
    """A page's own certificate."""

    context: ssl.SSLContext  # for the server's sockets: TLS 1.2 or later
    fingerprint: str  # SHA-256 as browsers show it, in pairs of hexadecimal digits


def is_loopback(host: str) -> bool:
    """Whether an address is reached from this machine alone; of names localhost."""
    return loopback(f"tcp/[{host}]:0")


def is_open(environment: Mapping[str, str]) -> bool:
    """Whether links may be plain: PHALANX_OPEN=1, which the option --open sets."""
    return environment.get(OPEN, "") == "1"


def private_folder(environment: Mapping[str, str]) -> Path:
    """Return the folder of page passwords and certificates, ~/.config/phalanx."""
    base = environment.get("XDG_CONFIG_HOME") or str(Path("~/.config").expanduser())
    return Path(base) / "phalanx"


def page_certificate(folder: Path, host: str, now: datetime | None = None) -> PageCertificate:
    """Return the page certificate kept in `folder`; make it where none fits.

    Args:
        folder: Made with mode 0700 where it is missing; page.pem holds certificate and key.
        host: Address that is listened on; the certificate names it, and this machine.
        now: The present.

    Raises:
        PhalanxError: The file is broken, others can read it, or it cannot be written.
    """
    path = folder / "page.pem"
    now = now or datetime.now(UTC)
    try:
        if not path.exists() or not _fits(read_private(path), host, now):
            write_private(path, _made(host, now))
        pem = read_private(path)
        context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
        context.minimum_version = ssl.TLSVersion.TLSv1_2
        context.load_cert_chain(path)
        digest = x509.load_pem_x509_certificate(pem).fingerprint(hashes.SHA256()).hex().upper()
    except (ssl.SSLError, x509.ExtensionNotFound, ValueError) as error:
        raise PhalanxError(f"{path}: cannot use the certificate of the page ({error}); delete it") from error
    return PageCertificate(context, ":".join(digest[i : i + 2] for i in range(0, len(digest), 2)))


def read_private(path: Path) -> bytes:
    """Read at most 64 KiB of a file of secrets; PhalanxError: others can read it."""
    try:
        mode = path.stat().st_mode
        with path.open("rb") as file:
            most_bytes = 65536
            data = file.read(most_bytes)
    except OSError as error:
        raise PhalanxError(f"{path}: cannot be read: {error.strerror}") from error
    if mode & OTHERS:
        raise PhalanxError(f"{path}: others can read it; run: chmod 600 {path}")
    return data


def write_private(path: Path, data: bytes) -> None:
    """Write a file that its owner alone can read, in such a folder; PhalanxError."""
    half = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        half.unlink(missing_ok=True)
        with os.fdopen(os.open(half, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
            file.write(data)
        half.replace(path)
    except OSError as error:
        raise PhalanxError(f"{path}: cannot be written: {error.strerror}") from error


def machine_names() -> frozenset[str]:
    """Names under which this machine is reached."""
    machine = socket.gethostname().lower()
    return frozenset({"localhost", machine, f"{machine.split('.')[0]}.local"})


def places_of(host: str) -> tuple[str, ...]:
    """Addresses of a page on `host` for a browser, those for other machines first."""
    if host not in _ANYWHERE:
        return (f"[{host}]" if ":" in host else host,)
    return (*dict.fromkeys(one for one in _addresses() if not ip_address(one).is_loopback), "127.0.0.1")


def _addresses() -> list[str]:
    """IPv4 addresses of this machine, in each network."""
    cards = psutil.net_if_addrs().values()
    return [one.address for card in cards for one in card if one.family == socket.AF_INET]


def _fits(pem: bytes, host: str, now: datetime) -> bool:
    certificate = x509.load_pem_x509_certificate(pem)
    names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    return now + _RENEW_BEFORE < certificate.not_valid_after_utc and _name(host) in (None, *names)


def _name(host: str) -> x509.GeneralName | None:
    if host in _ANYWHERE:
        return None
    try:
        return x509.IPAddress(ip_address(host))
    except ValueError:
        return x509.DNSName(host.lower())


def _made(host: str, now: datetime) -> bytes:
    private = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "Phalanx page")])
    names = {x509.DNSName(one) for one in machine_names()} | {x509.IPAddress(ip_address("127.0.0.1"))}
    own = _name(host)
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(private.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - timedelta(days=1))
        .not_valid_after(now + LIFE - timedelta(days=1))
        .add_extension(
            x509.SubjectAlternativeName([*names, *([own] if own and own not in names else [])]), False
        )
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH]), critical=False)
        .sign(private, hashes.SHA256())
    )
    return certificate.public_bytes(serialization.Encoding.PEM) + private.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
