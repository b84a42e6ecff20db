"""Access rules of an encrypted bus: which process may send what.

Uses zenoh's access control, by the common names of certificates.

Nothing is allowed that is not named here. What a device sends goes to whoever listens; it receives only what the
master passes on:

| who | may |
|---|---|
| a device | report its health, show pictures, answer commands, all under its own name; no poses, receives nothing |
| an operator (viewer, console, recorder ...) | read everything, command everybody, be a program with its own name |
| the master | everything |

A program of an operator reports its health, that it is alive, and takes commands; it sends no poses, and never acts as
the master or a device.

The same table is in force on both sides: the master applies it to each that connects, and a device takes from its link
nothing but commands to itself, from whoever has a certificate of the name `master`.
"""

from collections.abc import Iterable

from common.bus.certificates import MASTER, OPERATOR
from common.messages.streams import ALIVE_KEY, STREAMS, Path, key_of

_SPEAKING = ("put", "declare_queryable", "liveliness_token", "reply")
_LISTENING = ("declare_subscriber", "liveliness_query", "declare_liveliness_subscriber")
_PUBLISHED_BY_DEVICES = ("health", "preview", "still", "command")  # of the streams of the bus
_ALL = ("put", "delete", "query", "reply", "declare_subscriber", "declare_queryable", "liveliness_token",
        "liveliness_query", "declare_liveliness_subscriber")  # fmt: skip
_EVERYTHING = ["phalanx/**"]
Rule = dict[str, object]


def rules_of_master(devices: Iterable[str]) -> dict[str, object]:
    """zenoh's `access_control` for the side that listens.

    Args:
        devices: Names of the devices that may connect; messages of others are dropped.
    """
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
    """Return zenoh's `access_control` for a device.

    From its link the device accepts commands addressed to itself, and the subscriptions of those who ask for its
    data.
    """
    rules = [
        _rule("is told", "ingress", ("query",), [key_of("command", name)]),
        _rule("is asked for", "ingress", ("declare_subscriber", "liveliness_query"), _EVERYTHING),
        _rule("speaks", "egress", _SPEAKING, _of_device(name)),
    ]
    return _access(rules, [MASTER], [_policy(["is told", "is asked for", "speaks"], MASTER)])


def rules_of_router() -> dict[str, object]:
    """Return zenoh's `access_control` for a router.

    Processes that may run or read a rig pass; devices do not.
    """
    rules = [_rule("in", "ingress", _ALL, ["**"]), _rule("out", "egress", _ALL, ["**"])]
    policies = [_policy(["in", "out"], name) for name in (MASTER, OPERATOR)]
    return _access(rules, [MASTER, OPERATOR], policies)


def _of_device(name: str) -> list[str]:
    """Return all keys under which a device publishes.

    The reader of a message compares the name inside it with its key.
    """
    return [*(key_of(stream, name) for stream in _PUBLISHED_BY_DEVICES), ALIVE_KEY.format(name=name)]


def _own(name: str) -> list[str]:
    """All keys that are of `name` alone."""
    streams = [key_of(row, name) for row, stream in STREAMS.items() if stream.path is Path.ZENOH]
    return [*streams, ALIVE_KEY.format(name=name)]


def _rule(name: str, flow: str, messages: Iterable[str], keys: list[str], *, allow: bool = True) -> Rule:
    permission = "allow" if allow else "deny"
    return {
        "id": name,
        "permission": permission,
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
