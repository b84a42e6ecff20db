"""Master and slave open a session by a handshake, one transition table.

docs/wire.md draws it. From the rig key (32 random bytes that every process of a rig shares) HKDF-SHA256 (RFC 5869)
makes
- the rig tag, by which a datagram of another rig is recognised at once,
- one key for every process that sends beacon, hello or welcome, named by its random process id, so
  that two processes never seal under one key with the same nonce.

From the rig key and the secret of one device (`common.link.datagram`), which only that device and the master know,
- the proof in its hello: nobody else of the rig begins a session in its name,
- for every session two keys, one per direction, and the session's id, from random numbers of both sides: what was
  captured in one session opens in no other, whoever restarted, and in no other device,
- the proof in the welcome: nobody else of the rig ends the session that it has.

Each end classifies what arrives as an `Event`, and `RULES` defines the next state, the datagram to send back, or the
reason to refuse. What is in no row cannot occur. An end obeys reply and refusal; its state it derives from its
sessions and from time, so `next`, and the rows of `SEALED`, `EXPIRED` and `SILENCE`, are what the tests hold it to. A
live session stays until another one is confirmed: neither a late nor a replayed datagram ends it.
"""

from collections.abc import Callable, Mapping
from enum import StrEnum
from hmac import compare_digest
from typing import Annotated, NamedTuple, TypeVar

import msgspec
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305
from msgspec import Meta, Struct

from common.link.datagram import KEY_BYTES, Header, Kind, LinkKey, Refusal, Sealer, derive, unseal
from common.messages import Count, Name, TimeNs

NONCE_BYTES = PROOF_BYTES = 16
MAX_CAMERAS = 32
Random = Callable[[int], bytes]  # so many random bytes, as `os.urandom` gives them
Nonce = Annotated[bytes, Meta(min_length=NONCE_BYTES, max_length=NONCE_BYTES)]
Proof = Annotated[bytes, Meta(min_length=PROOF_BYTES, max_length=PROOF_BYTES)]


class Handshake(Struct, frozen=True, forbid_unknown_fields=True):
    """Base of what travels in a datagram besides data; unknown fields are refused."""


HandshakeT = TypeVar("HandshakeT", bound=Handshake)


class Beacon(Handshake, frozen=True):
    """Announcement of the master's presence, broadcast for ever; hello answers it.

    Attributes:
        master_nonce: Drawn when the master started: another one is another life of it.
        zenoh_endpoint: Where the master's bus listens; empty if it has none.
        sessions: Camera -> id of its session, for those that are acknowledged.
    """

    master_nonce: Nonce
    zenoh_endpoint: Annotated[str, Meta(max_length=256, pattern=r"^[!-~]*(?!\n)$")]
    sessions: Annotated[dict[Name, Count], Meta(max_length=MAX_CAMERAS)]


class Hello(Handshake, frozen=True):
    """A slave answers a beacon. `RigKeys.hello` makes it.

    Attributes:
        name: Camera.
        process: Random id of the slave's process, the `session` of its messages.
        slave_nonce: Drawn for this one attempt to get a session.
        master_nonce: That of the beacon: a hello to an earlier master is a replay.
        proof: That the sender has the secret of `name`, and vouches for all the fields above.
    """

    name: Name
    process: Count
    slave_nonce: Nonce
    master_nonce: Nonce
    proof: Proof


class _AnyHello(Struct, frozen=True):
    """What a hello of any wire version has; unknown fields are left."""

    name: Name


class Welcome(Handshake, frozen=True):
    """Master's share of the session's keys, for the hello with this `slave_nonce`.

    `proof`, of `SessionKeys`: that the master has the secret of that name.
    """

    master_nonce: Nonce
    slave_nonce: Nonce
    session_nonce: Nonce
    proof: Proof


class Unproven(Handshake, frozen=True):
    """Refusal of the hello with this `slave_nonce`: the master has another secret.

    `has_secrets`: whether the secrets of the master's devices are more than the rig key. It is not proven itself:
    whoever has the rig key can claim it.
    """

    master_nonce: Nonce
    slave_nonce: Nonce
    has_secrets: bool


class Start(Handshake, frozen=True):
    """Command to begin at `start_t_ns` [ns] of the receiving slave; a past time: now."""

    start_t_ns: TimeNs


class Started(Handshake, frozen=True):
    """The start was understood. Data acknowledges it as well."""

    start_t_ns: TimeNs


class EchoAsk(Handshake, frozen=True):
    """First time stamp of an echo: `t1_ns` on the master's clock."""

    t1_ns: TimeNs


class EchoAnswer(Handshake, frozen=True):
    """`t1_ns` as it came; `t2_ns` received, `t3_ns` answered, on the slave's clock."""

    t1_ns: TimeNs
    t2_ns: TimeNs
    t3_ns: TimeNs


_BODIES: Mapping[Kind, type[Handshake]] = {
    Kind.BEACON: Beacon,
    Kind.HELLO: Hello,
    Kind.WELCOME: Welcome,
    Kind.START: Start,
    Kind.STARTED: Started,
    Kind.ECHO_ASK: EchoAsk,
    Kind.ECHO_ANSWER: EchoAnswer,
    Kind.UNPROVEN: Unproven,
}
_DECODERS = {kind: msgspec.msgpack.Decoder(body) for kind, body in _BODIES.items()}
_KINDS: Mapping[type[Handshake], Kind] = {body: kind for kind, body in _BODIES.items()}
_ANY_HELLO = msgspec.msgpack.Decoder(_AnyHello)
_ENCODER = msgspec.msgpack.Encoder()


def seal(sealer: Sealer, message: Handshake) -> bytes:
    """Return the datagram that carries `message`."""
    return sealer.seal(_KINDS[type(message)], _ENCODER.encode(message))


def read(kind: Kind, body: bytes) -> Handshake | None:
    """Return the message of `kind` in `body`, or None if it is none."""
    try:
        return _DECODERS[kind].decode(body)
    except (msgspec.MsgspecError, ValueError, RecursionError, KeyError):
        return None


class SessionKeys(NamedTuple):
    """Keys of one session: 32 bytes a direction, its id, the proof of the welcome."""

    key_id: int
    to_master: bytes
    to_slave: bytes
    proof: bytes


class RigKeys:
    """All keys derived from the rig key and the secrets of devices."""

    def __init__(self, key: LinkKey | bytes) -> None:
        """Derive from the rig key, alone or with secrets, each of 32 bytes."""
        self._key = key if isinstance(key, LinkKey) else LinkKey(key)
        self.has_secrets = self._key.has_secrets
        self.rig_tag = int.from_bytes(derive(self._key.rig, 4, b"", b"phalanx rig tag"), "big")

    def sealer(self, process: int) -> Sealer:
        """Return the sealer for the handshakes of `process`, to be made once in its life."""
        return Sealer(self._process_key(process), self.rig_tag, process)

    def open(self, header: Header, datagram: bytes) -> bytes | None:
        """Return the body of a handshake datagram if its seal fits, else None."""
        return unseal(ChaCha20Poly1305(self._process_key(header.key_id)), header, datagram)

    def open_as(self, header: Header, datagram: bytes, expected: type[HandshakeT]) -> HandshakeT | Refusal:
        """Return the message of a handshake datagram, or why it is refused."""
        body = self.open(header, datagram)
        if body is None:
            return Refusal.FORGED
        message = read(header.kind, body)
        return message if isinstance(message, expected) else Refusal.UNDECODABLE

    def name_in(self, header: Header, datagram: bytes) -> str | None:
        """Sender of a hello of another wire version (headers are alike) if it is sealed."""
        body = self.open(header, datagram)
        try:
            return None if body is None else _ANY_HELLO.decode(body).name
        except (msgspec.MsgspecError, ValueError, RecursionError):
            return None

    def hello(self, name: str, process: int, slave_nonce: bytes, master_nonce: bytes) -> Hello:
        """Return the hello of the device `name`, proven by the secret this side has."""
        info = b"phalanx hello " + process.to_bytes(8, "big") + name.encode()
        proof = derive(self._of_device(name), PROOF_BYTES, master_nonce + slave_nonce, info)
        return Hello(name, process, slave_nonce, master_nonce, proof)

    def proves(self, hello: Hello) -> bool:
        """Return whether the sender of `hello` has the secret of its name."""
        wanted = self.hello(hello.name, hello.process, hello.slave_nonce, hello.master_nonce)
        return compare_digest(hello.proof, wanted.proof)

    def session(self, hello: Hello, session_nonce: bytes) -> SessionKeys:
        """Return the session keys from `hello` and the master's `session_nonce`."""
        nonces = hello.master_nonce + session_nonce + hello.slave_nonce
        size, info = 8 + 2 * KEY_BYTES + PROOF_BYTES, b"phalanx session " + hello.name.encode()
        block = derive(self._of_device(hello.name), size, nonces, info)
        key_id = int.from_bytes(block[:8], "big") >> 1  # 63 bits, as ids in messages have
        return SessionKeys(key_id, block[8:40], block[40:72], block[72:])

    def session_sealer(self, key: bytes, key_id: int) -> Sealer:
        """Return the sealer of one direction of a session, to be made once."""
        return Sealer(key, self.rig_tag, key_id)

    def _process_key(self, process: int) -> bytes:
        return derive(self._key.rig, KEY_BYTES, process.to_bytes(8, "big"), b"phalanx handshake")

    def _of_device(self, name: str) -> bytes:
        return self._key.rig + self._key.secret(name)


def new_process_id(random: bytes) -> int:
    """Return a 63 bit id from 8 random bytes."""
    return int.from_bytes(random[:8], "big") >> 1


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
