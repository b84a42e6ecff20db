"""Say why an encrypted bus does not come about: zenoh keeps silent about a certificate that was refused."""

import logging
import socket
import ssl
import threading
import time
from collections.abc import Callable

from common.endpoints import host_of, port_of
from common.keys import Identity

_PATIENCE_S = 0.5
_ALONE_S = 2.0  # without anybody for so long, a process says why
_LOOK_S = 0.25
_LOG = logging.getLogger(__name__)


def why_refused(endpoint: str, identity: Identity) -> str:
    """Try a handshake by hand and tell what went wrong, for a person; empty: nothing did.

    Takes up to a second. An answer that comes after the handshake is read, too: with TLS 1.3 the side that listens
    refuses a certificate only then.

    Args:
        endpoint: As `tls/192.168.1.2:47802`; of `quic/` nothing can be said.
        identity: Own certificate.
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
        return ""  # accepted: whoever refuses says so at once
    except ssl.SSLCertVerificationError as error:
        return (
            f"who listens there has no certificate of this rig's master ({error.verify_message}): another rig's, or"
            " somebody who plays the master"
        )
    except ssl.SSLError as error:
        said = (error.reason or str(error)).lower().replace("_", " ")
        return (
            f"who listens there refused the certificate of {identity.name!r}, or speaks no TLS ({said}): keys of"
            " another rig?"
        )
    except OSError as error:
        return f"nobody listens there ({error.strerror or error}). Is the master running?"
    return ""


def say_why_alone(
    peers: Callable[[], int], reason: Callable[[], str], where: str, closing: threading.Event
) -> threading.Thread:
    """Log, on a thread, why nobody is connected when it is so for two seconds, and again when the reason is another.

    Args:
        peers: How many are connected.
        reason: Why nobody is, for a person; may take a second.
        where: Whom the text is about.
        closing: Ends the thread.
    """

    def watch() -> None:
        said, since = "", time.monotonic()
        while not closing.wait(_LOOK_S):
            now = time.monotonic()
            if peers():
                said, since = "", now
            elif now - since > _ALONE_S:
                why, since = reason(), now
                if why and why != said and not closing.is_set():
                    _LOG.warning("bus (%s): %s", where, why)
                said = why

    thread = threading.Thread(target=watch, name="bus alone", daemon=True)
    thread.start()
    return thread
