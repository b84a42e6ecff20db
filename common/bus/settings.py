"""zenoh's configuration for one process.

Everything that is not safe or fast by default is set here. Pure.
"""

from collections.abc import Iterable, Sequence

from common.bus.access import rules_of_device, rules_of_master, rules_of_router
from common.bus.certificates import MASTER, OPERATOR
from common.bus.endpoints import SCHEMES, encrypted
from common.bus.keys import Identity

RETRY = {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 2}
# Batches that may wait for the link before a message is dropped. With zenoh's own 2, a busy machine that gives the link
# no time for a millisecond loses messages; 16 is its most.
LINK_QUEUE = {"data": 16, "data_low": 16}


def settings(
    listen: str | None,
    connect: Sequence[str],
    mode: str,
    identity: Identity | None,
    devices: Iterable[str] = (),
    namespace: str | None = None,
) -> dict[str, object]:
    """zenoh's configuration.

    Args:
        listen: Endpoint, or None.
        connect: Endpoints.
        mode: `peer`: passes messages between its clients and its peers, never from one peer to another; `client`: one
            connection, and all that is beyond it; `router`: passes everything on.
        identity: Own certificate; None: no endpoint is encrypted.
        devices: Who may connect to a listening peer beside those of the identity.
        namespace: Put before every key that is sent and taken from every key that comes; None: nothing.
    """
    lease_ms = 1000  # so soon a pulled cable is noticed
    max_message_bytes = 1 << 20
    link: dict[str, object] = {
        "protocols": list(SCHEMES),
        "tx": {"lease": lease_ms, "queue": {"size": LINK_QUEUE}},
        "rx": {"max_message_size": max_message_bytes},
    }
    # a viewer tries a master that is not there for so long, then reports that it waits
    client_timeout_ms = 500
    made: dict[str, object] = {
        "mode": mode,
        "listen": {"endpoints": [listen] if listen else [], "exit_on_failure": True},
        "connect": {
            "endpoints": list(connect),
            # A client that has not found its peer is no session at all: zenoh gives up after this, or never returns.
            # For a peer 0 would try once and give up for ever; `open` returns after 0.5 s in any case.
            "timeout_ms": client_timeout_ms if mode == "client" else -1,
            "exit_on_failure": False,
            "retry": RETRY,
        },
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        # Without shared memory: in a service's sandbox it cannot be made, and then zenoh opens nothing at all.
        "transport": {"link": link, "shared_memory": {"enabled": False}},
    }
    if namespace is not None:
        made["namespace"] = namespace
    if identity is not None:
        link["tls"] = _tls(identity)
        rules = _rules(listen, mode, identity, devices)
        if rules is not None:
            made["access_control"] = rules
    return made


def _tls(identity: Identity) -> dict[str, object]:
    """Return the TLS settings; both sides present a certificate.

    The listener needs a certificate issued for that use, so its address need not be the name in it.
    """
    pair = str(identity.certificate), str(identity.key)
    return {
        "root_ca_certificate": str(identity.authority),
        "enable_mtls": True,
        "verify_name_on_connect": False,
        "listen_certificate": pair[0],
        "listen_private_key": pair[1],
        "connect_certificate": pair[0],
        "connect_private_key": pair[1],
    }


def _rules(
    listen: str | None, mode: str, identity: Identity, devices: Iterable[str]
) -> dict[str, object] | None:
    if mode == "router":
        return rules_of_router()
    if listen is not None and encrypted(listen):
        return rules_of_master({*identity.devices, *devices})
    # An operator is connected to nobody but a master, which may send it everything.
    return None if identity.name in (MASTER, OPERATOR) else rules_of_device(identity.name)
