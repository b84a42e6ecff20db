"""Endpoints say where a bus is, and a diagnosis says why one refuses.

`tls/HOST:PORT` (or `quic/`) is encrypted, and both sides prove who they are. `tcp/` is neither: it stays on a loopback
address, which other machines cannot reach, unless `--open` is given. zenoh does not report that a certificate was
refused, so a handshake by hand finds the cause.
"""

import logging
import socket
import ssl
import threading
import time
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from ipaddress import AddressValueError, IPv4Address, ip_address

from common.bus.keys import CLOCK_FIX, OPEN, Identity, Shown, keys_folder, shown
from common.errors import BusError

SCHEMES = ("tcp", "tls", "quic")
ANYWHERE = "0.0.0.0"


def encrypted(endpoint: str) -> bool:
    """Whether both sides of the endpoint need a certificate of the rig."""
    return endpoint.split("/", 1)[0] in ("tls", "quic")


def check(endpoint: str, open_bus: bool) -> None:
    """Refuse an invalid endpoint, or one that sends plain text off this machine.

    Args:
        endpoint: As `tls/192.168.1.2:47802`.
        open_bus: Whether plain text may leave it.

    Raises:
        BusError: It must not; the message states what to do.
    """
    if endpoint.split("/", 1)[0] not in SCHEMES:
        raise BusError(f"bus endpoint {endpoint!r}: must begin with {', '.join(s + '/' for s in SCHEMES)}")
    if "#" in endpoint:  # zenoh would take other certificates from there, or do without
        raise BusError(f"bus endpoint {endpoint!r}: must have no settings of its own behind #")
    if encrypted(endpoint) or open_bus or loopback(endpoint):
        return
    raise BusError(
        f"bus endpoint {endpoint!r}: is neither encrypted nor authenticated, and leaves this machine. Write"
        f" tls/{endpoint.split('/', 1)[1]} and give keys (phalanx fleet keys DIR --make, then --keys DIR); or, in a"
        f" closed laboratory where everybody is trusted, --open (or {OPEN}=1) on both sides"
    )


def loopback(endpoint: str) -> bool:
    """Return whether the endpoint's address is reachable from this machine only."""
    host = host_of(endpoint)
    if host == "localhost":
        return True
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return False


def host_of(endpoint: str) -> str:
    """The host of an endpoint: `tls/[::1]:47802` -> `::1`."""
    return endpoint.split("/", 1)[-1].split("?")[0].split("#")[0].rpartition(":")[0].strip("[]")


def port_of(endpoint: str) -> int:
    """The port of an endpoint; 0: it has none."""
    text = endpoint.split("?")[0].split("#")[0].rpartition(":")[2]
    return int(text) if text.isdecimal() else 0


def default_bus(environment: Mapping[str, str]) -> str:
    """The bus of a program that was given none: on this machine, encrypted if keyed."""
    port = 47802
    return f"{'tcp' if keys_folder(environment) is None else 'tls'}/127.0.0.1:{port}"


def reached_at(endpoint: str, address: str) -> str:
    """Return the address of a listener that listens on all addresses of a machine.

    `address` is the machine's address from which it was received.
    """
    if host_of(endpoint) != ANYWHERE:
        return endpoint
    try:
        IPv4Address(address)
    except AddressValueError:
        return endpoint
    return endpoint.replace(ANYWHERE, address, 1)


_PATIENCE_S = 0.5
_LOG = logging.getLogger(__name__)


def why_refused(endpoint: str, identity: Identity) -> str:
    """Try a handshake by hand; what went wrong, as text for the user, or empty.

    Takes up to a second. An answer that comes after the handshake is read, too: with TLS 1.3 the side that listens
    refuses a certificate only then. For `quic/` no cause can be determined.
    """
    if not endpoint.startswith("tls/"):
        return ""
    try:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        context.check_hostname = False  # addresses change; who signed is what counts
        context.minimum_version = ssl.TLSVersion.TLSv1_3
        context.load_verify_locations(identity.authority)
        context.load_cert_chain(identity.certificate, identity.key)
    except (OSError, ssl.SSLError) as error:
        return f"the keys of {identity.name!r} do not fit together ({error})"
    try:
        with (
            socket.create_connection((host_of(endpoint), port_of(endpoint)), _PATIENCE_S) as plain,
            context.wrap_socket(plain) as sealed,
        ):
            sealed.settimeout(_PATIENCE_S)
            sealed.recv(1)
    except TimeoutError:
        return ""  # accepted: whoever refuses reports it at once
    except ssl.SSLCertVerificationError as error:
        # X509_V_ERR_CERT_NOT_YET_VALID, X509_V_ERR_CERT_HAS_EXPIRED of OpenSSL
        not_yet_valid, expired = 9, 10
        if error.verify_code in (not_yet_valid, expired):
            return _why_invalid(endpoint, identity)
        return (
            f"who listens there has no certificate of this rig's master ({error.verify_message}): another rig's, or"
            " somebody who plays the master"
        )
    except ssl.SSLError as error:
        message = (error.reason or str(error)).lower().replace("_", " ")
        if "certificate expired" in message:
            return _why_expired_there(identity)
        return (
            f"who listens there refused the certificate of {identity.name!r}, or speaks no TLS ({message}): keys of"
            " another rig?"
        )
    except OSError as error:
        return f"nobody listens there ({error.strerror or error}). Is the master running?"
    return ""


def _why_invalid(endpoint: str, identity: Identity) -> str:
    """Which certificate, the rig's or the listener's, our clock takes for invalid."""
    now = datetime.now(UTC)
    named = {"the certificate of this rig (ca.pem)": shown(identity.authority.read_bytes())}
    if (there := _shown_there(endpoint)) is not None:
        named[f"the certificate of who listens there ({there.name!r})"] = there
    faults = [fault for whose, one in named.items() if (fault := one.invalid_at(now, whose))]
    unknown = (
        "the certificate of who listens there is not valid now: the clock of this machine says "
        f"{now:%Y-%m-%d %H:%M} UTC"
    )
    return f"{faults[0] if faults else unknown}. Is that the time? If not, {CLOCK_FIX}"


def _why_expired_there(identity: Identity) -> str:
    """Why the listener refused our certificate: invalid now, or a clock is wrong."""
    now, own = datetime.now(UTC), shown(identity.certificate.read_bytes())
    whose = f"the certificate of {identity.name!r}"
    if fault := own.invalid_at(now, whose):
        return f"who listens there refused it, and {fault}. Is that the time? If not, {CLOCK_FIX}"
    return (
        f"who listens there refused {whose} as no longer, or not yet, valid: it is valid from "
        f"{own.since:%Y-%m-%d} to {own.until:%Y-%m-%d}, and the clock of this machine says {now:%Y-%m-%d %H:%M} UTC. "
        f"Is the clock of the machine there wrong? There, {CLOCK_FIX}"
    )


def _shown_there(endpoint: str) -> Shown | None:
    """The listener's certificate, whatever its validity; None: it cannot be read."""
    try:
        pem = ssl.get_server_certificate((host_of(endpoint), port_of(endpoint)), timeout=_PATIENCE_S)
        return shown(pem.encode("ascii"))
    except (OSError, ValueError):
        return None


def log_why_alone(
    peers: Callable[[], int], reason: Callable[[], str], where: str, closing: threading.Event
) -> threading.Thread:
    """Log, on a thread, why no peer is connected, after 2 s and at each new reason.

    Args:
        peers: How many are connected.
        reason: Why nobody is, for a person; may take a second.
        where: Whom the text is about.
        closing: Ends the thread.
    """

    def monitor() -> None:
        message, since = "", time.monotonic()
        poll_s = 0.25
        while not closing.wait(poll_s):
            now = time.monotonic()
            alone_s = 2.0  # without anybody for so long, a process logs why
            if peers():
                message, since = "", now
            elif now - since > alone_s:
                why, since = reason(), now
                if why and why != message and not closing.is_set():
                    _LOG.warning("bus (%s): %s", where, why)
                message = why

    thread = threading.Thread(target=monitor, name="bus alone", daemon=True)
    thread.start()
    return thread
