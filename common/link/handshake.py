"""The states of a session, for both ends of the link: one transition table.

Each end classifies what arrives as an `Event`, and `RULES` defines what follows:
the next state, the datagram to send back, or the reason to refuse. What is in
no row cannot occur. An end obeys reply and refusal. Its state it derives from
the sessions that it holds and from time, so `next`, and the rows of `SEALED`,
`EXPIRED` and `SILENCE`, are what the tests hold it to.
`docs/wire.md` shows `state_pages()`, written by `make schema`.

A slave or master that holds a live session may negotiate another one meanwhile;
the live session stays until the other one is confirmed, so that neither a late
nor a replayed datagram ends it.
"""

from enum import StrEnum
from typing import NamedTuple

from common.link.datagram import Kind, Refusal

WELL_NS = 500_000_000  # a peer that was received this recently keeps its session


class Role(StrEnum):
    """Which end of the link."""

    SLAVE = "slave"
    MASTER = "master"


class State(StrEnum):
    """How far a session is, as one end knows it."""

    IDLE = "idle"  # no session, none under negotiation
    OFFERED = "offered"  # slave: hello sent, no welcome yet
    PENDING = "pending"  # master: welcome sent, nothing sealed with its keys yet
    LIVE = "live"  # both ends have the keys; the peer was received within `WELL_NS`
    SILENT = "silent"  # live, but the peer was not received for longer than that


class Event(StrEnum):
    """What happens to a session: a datagram of a certain content, or time."""

    BEACON_OTHER = "beacon of a master without a session here"
    BEACON_LISTED = "beacon of our master that lists our session"
    BEACON_UNLISTED = "beacon of our master that does not list our session"
    BEACON_OLD = "beacon of our master, not newer than the last"
    WELCOME = "proven welcome to our hello"
    WELCOME_AGAIN = "welcome of the present session again"
    WELCOME_UNASKED = "welcome to a hello that is not ours"
    WELCOME_STALE = "welcome to a beacon that another one replaced"
    WELCOME_UNPROVEN = "welcome without the proof of our secret"
    UNPROVEN = "unproven, for our hello"
    UNPROVEN_UNASKED = "unproven, for a hello that is not ours"
    HELLO = "new proven hello"
    HELLO_AGAIN = "hello of the live or pending session again"
    HELLO_USED = "hello of an earlier session"
    HELLO_OTHER_MASTER = "hello to another life of the master"
    HELLO_OTHER_PROCESS = "proven hello of a process other than the session's"
    HELLO_UNPROVEN = "hello without the proof of its secret"
    SEALED = "datagram sealed with the session's keys"
    EXPIRED = "no confirmation within 1 s of the welcome"
    SILENCE = "nothing sealed received for 0.5 s"


class Rule(NamedTuple):
    """What follows from an event: next state, and the reply or the refusal, if any."""

    next: State
    reply: Kind | None = None
    refusal: Refusal | None = None


Key = tuple[Role, State, Event]
_ALIVE = (State.LIVE, State.SILENT)


def _slave() -> dict[Key, Rule]:
    rules: dict[tuple[State, Event], Rule] = {
        (State.IDLE, Event.BEACON_OTHER): Rule(State.OFFERED, Kind.HELLO),
        (State.OFFERED, Event.BEACON_OTHER): Rule(State.OFFERED, Kind.HELLO),
        (State.LIVE, Event.BEACON_OTHER): Rule(State.LIVE, refusal=Refusal.OTHER_MASTER),
        (State.SILENT, Event.BEACON_OTHER): Rule(State.SILENT, Kind.HELLO),
        (State.OFFERED, Event.WELCOME): Rule(State.LIVE),
        (State.LIVE, Event.SILENCE): Rule(State.SILENT),
    }
    for state in _ALIVE:
        rules |= {
            (state, Event.BEACON_LISTED): Rule(state),
            (state, Event.BEACON_UNLISTED): Rule(state, Kind.HELLO),
            (state, Event.BEACON_OLD): Rule(state, refusal=Refusal.REPLAYED),
            (state, Event.WELCOME): Rule(State.LIVE),
            (state, Event.WELCOME_AGAIN): Rule(state, refusal=Refusal.DUPLICATE),
            (state, Event.SEALED): Rule(State.LIVE),
        }
    for state in (State.OFFERED, *_ALIVE):
        rules |= {
            (state, Event.WELCOME_STALE): Rule(state, refusal=Refusal.STALE),
            (state, Event.WELCOME_UNPROVEN): Rule(state, refusal=Refusal.SECRET),
            (state, Event.UNPROVEN): Rule(state, refusal=Refusal.SECRET),
        }
    for state in (State.IDLE, State.OFFERED, *_ALIVE):
        rules |= {
            (state, Event.WELCOME_UNASKED): Rule(state, refusal=Refusal.REPLAYED),
            (state, Event.UNPROVEN_UNASKED): Rule(state, refusal=Refusal.REPLAYED),
        }
    return {(Role.SLAVE, *key): rule for key, rule in rules.items()}


def _master() -> dict[Key, Rule]:
    rules: dict[tuple[State, Event], Rule] = {
        (State.IDLE, Event.HELLO): Rule(State.PENDING, Kind.WELCOME),
        (State.PENDING, Event.SEALED): Rule(State.LIVE),
        (State.PENDING, Event.EXPIRED): Rule(State.IDLE),
        (State.LIVE, Event.HELLO_OTHER_PROCESS): Rule(State.LIVE, refusal=Refusal.DUPLICATE_SENDER),
        (State.SILENT, Event.HELLO_OTHER_PROCESS): Rule(State.SILENT, Kind.WELCOME),
        (State.LIVE, Event.SILENCE): Rule(State.SILENT),
    }
    for state in _ALIVE:
        rules |= {
            (state, Event.SEALED): Rule(State.LIVE),
            (state, Event.EXPIRED): Rule(state),  # that of a session negotiated beside the live one
        }
    for state in (State.PENDING, *_ALIVE):
        rules |= {
            (state, Event.HELLO): Rule(state, Kind.WELCOME),
            (state, Event.HELLO_AGAIN): Rule(state, Kind.WELCOME),
        }
    for state in (State.IDLE, State.PENDING, *_ALIVE):
        rules |= {
            (state, Event.HELLO_USED): Rule(state, refusal=Refusal.REPLAYED),
            (state, Event.HELLO_OTHER_MASTER): Rule(state, refusal=Refusal.REPLAYED),
            (state, Event.HELLO_UNPROVEN): Rule(state, Kind.UNPROVEN, Refusal.SECRET),
        }
    return {(Role.MASTER, *key): rule for key, rule in rules.items()}


RULES: dict[Key, Rule] = _slave() | _master()


def state_pages() -> str:
    """Return the diagram of both roles, and all of their rules, as Markdown."""
    return "\n".join(f"{_diagram(role)}\n{_table(role)}" for role in Role)


def _diagram(role: Role) -> str:
    lines = ["```mermaid", "stateDiagram-v2", f"    [*] --> {State.IDLE}"]
    for (of, state, event), rule in RULES.items():
        if of is role and rule.next is not state:
            reply = "" if rule.reply is None else f" / {rule.reply.name}"
            lines.append(f"    {state} --> {rule.next}: {event}{reply}")
    return "\n".join([*lines, "```", ""])


def _table(role: Role) -> str:
    states = [state for state in State if any(key[:2] == (role, state) for key in RULES)]
    lines = [f"| {role}: event | " + " | ".join(states) + " |", "|---|" + "---|" * len(states)]
    for event in Event:
        rules = [RULES.get((role, state, event)) for state in states]
        if any(rules):
            cells = [_cell(state, rule) for state, rule in zip(states, rules, strict=True)]
            lines.append(f"| {event} | " + " | ".join(cells) + " |")
    return "\n".join([*lines, ""])


def _cell(state: State, rule: Rule | None) -> str:
    if rule is None:
        return "–"
    parts = [f"→ {rule.next}"] if rule.next is not state else []
    if rule.reply is not None:
        parts.append(f"send {rule.reply.name}")
    if rule.refusal is not None:
        parts.append(f"refuse `{rule.refusal}`")
    return ", ".join(parts) or "stays"
