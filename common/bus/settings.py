"""Settings configure zenoh for one process, with the bus's access rules.

Everything that is not safe or fast by default is set here. zenoh's access control goes by the common names of
certificates; nothing is allowed that is not named. The same table is in force on both sides: the master applies it to
each that connects, and a device takes from its link nothing but commands to itself, from whoever has a certificate of
the name `master`.

| who | may |
|---|---|
| a device | report its health, show pictures, answer commands, all under its own name; no poses, receives nothing |
| an operator (viewer, console, recorder ...) | read everything, command everybody, be a program with its own name |
| the master | everything |

A program of an operator reports its health, that it is alive, and takes commands; it sends no poses, and never acts as
the master or a device.
"""

from collections.abc import Iterable, Sequence

from common.bus.endpoints import SCHEMES, encrypted
from common.bus.keys import MASTER, OPERATOR, Identity
from common.messages.streams import ALIVE_KEY, STREAMS, Path, key_of

_SPEAKING = ("put", "declare_queryable", "liveliness_token", "reply")
_LISTENING = ("declare_subscriber", "liveliness_query", "declare_liveliness_subscriber")
_PUBLISHED_BY_DEVICES = ("health", "preview", "still", "command")  # of the streams of the bus
_ALL = ("put", "delete", "query", "reply", "declare_subscriber", "declare_queryable", "liveliness_token",
        "liveliness_query", "declare_liveliness_subscriber")  # fmt: skip
_EVERYTHING = ["phalanx/**"]
Rule = dict[str, object]


def rules_of_master(devices: Iterable[str]) -> dict[str, object]:
    """zenoh's `access_control` for the listener; other devices' messages are dropped."""
    names = sorted(set(devices))
    program = [key_of("health", "*"), key_of("command", "*"), ALIVE_KEY.format(name="*")]
    taken = [key for name in (MASTER, *names) for key in _own(name)]
    rules = [
        _rule("all", "ingress", _ALL, _EVERYTHING),
        _rule("told all", "egress", _ALL, _EVERYTHING),
        _rule("reads", "ingress", _LISTENING, _EVERYTHING),
        _rule("commands", "ingress", ("query",), [key_of("command", "*")]),
        _rule("is a program", "ingress", _SPEAKING, program),
        _rule("is no other", "ingress", _SPEAKING, taken, allow=False),
        _rule("is asked for", "egress", ("declare_subscriber", "liveliness_query"), _EVERYTHING),
    ]
    policies = [
        _policy(["all", "told all"], MASTER),
        _policy(["told all", "reads", "commands", "is a program", "is no other"], OPERATOR),
    ]
    for name in names:
        rules.append(_rule(f"{name} speaks", "ingress", _SPEAKING, _of_device(name)))
        rules.append(_rule(f"{name} is told", "egress", ("query",), [key_of("command", name)]))
        policies.append(_policy([f"{name} speaks", f"{name} is told", "is asked for"], name))
    return _access(rules, [MASTER, OPERATOR, *names], policies)


def rules_of_device(name: str) -> dict[str, object]:
    """zenoh's `access_control` for a device: commands to itself, its subscribers."""
    rules = [
        _rule("is told", "ingress", ("query",), [key_of("command", name)]),
        _rule("is asked for", "ingress", ("declare_subscriber", "liveliness_query"), _EVERYTHING),
        _rule("speaks", "egress", _SPEAKING, _of_device(name)),
    ]
    return _access(rules, [MASTER], [_policy(["is told", "is asked for", "speaks"], MASTER)])


def rules_of_router() -> dict[str, object]:
    """zenoh's `access_control` for a router: masters and operators, no device."""
    rules = [_rule("in", "ingress", _ALL, ["**"]), _rule("out", "egress", _ALL, ["**"])]
    policies = [_policy(["in", "out"], name) for name in (MASTER, OPERATOR)]
    return _access(rules, [MASTER, OPERATOR], policies)


def _of_device(name: str) -> list[str]:
    """Keys under which a device publishes; readers compare names inside messages."""
    return [*(key_of(stream, name) for stream in _PUBLISHED_BY_DEVICES), ALIVE_KEY.format(name=name)]


def _own(name: str) -> list[str]:
    """All keys that are of `name` alone."""
    streams = [key_of(row, name) for row, stream in STREAMS.items() if stream.path is Path.ZENOH]
    return [*streams, ALIVE_KEY.format(name=name)]


def _rule(name: str, flow: str, messages: Iterable[str], keys: list[str], *, allow: bool = True) -> Rule:
    return {
        "id": name,
        "permission": "allow" if allow else "deny",
        "flows": [flow],
        "messages": list(messages),
        "key_exprs": keys,
    }


def _policy(rules: list[str], subject: str) -> Rule:
    return {"rules": rules, "subjects": [subject]}


def _access(rules: list[Rule], names: Iterable[str], policies: list[Rule]) -> dict[str, object]:
    subjects = [{"id": name, "cert_common_names": [name]} for name in names]
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


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
    client_timeout_ms = 500  # a viewer tries an absent master for so long, then reports that it waits
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
    """TLS settings; the listener's certificate is issued for that use, any address."""
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
