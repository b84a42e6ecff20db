"""The slave's side of the datagram link, from the first beacon to data.

`common.link.handshake.RULES` defines what follows from each event; this file classifies datagrams as events.
- While the master of the session is received, beacons of any other life are ignored: an old one replayed cannot end a
  live session, and two masters do not tear a slave apart.
- An offer (one slave nonce) lasts until a welcome that carries it, with the proof that the master has the secret of
  this device; only then the session changes. Who only has the rig key ends none. Unanswered for two seconds it goes on
  with another nonce: the master takes none twice, and may have rejected that one as a duplicate's or a replay.
- A session that the master's beacons do not list for a second is lost to it: send a hello again.
- Whoever is not welcomed though the beacons list its name has a duplicate. It goes on sending hello, and is accepted
  as soon as the other one is silent.
- To a beacon of its rig in another wire version it sends a hello in its own, once a second: the master cannot take
  it, and can identify the sender.
"""

from collections import Counter
from dataclasses import dataclass
from hmac import compare_digest

from common.bus.endpoints import reached_at
from common.clock import Clock
from common.link.datagram import (
    HEADER,
    OVERHEAD,
    Address,
    Header,
    Kind,
    LinkKey,
    Opener,
    Refusal,
    Sealer,
    parse,
)
from common.link.handshake import (
    NONCE_BYTES,
    RULES,
    WELL_NS,
    Beacon,
    EchoAnswer,
    EchoAsk,
    Event,
    Hello,
    Random,
    RigKeys,
    Role,
    Rule,
    SessionKeys,
    Start,
    Started,
    State,
    Unproven,
    Welcome,
    new_process_id,
    read,
    seal,
)
from common.messages import WIRE_VERSION, Message, encode

VANISHED_NS = 2_000_000_000  # a master silent for so long is gone
HELLO_AGAIN_NS = 50_000_000
OFFER_NS = 1_000_000_000  # how long hello is repeated after the last beacon
NONCE_NS = 2_000_000_000  # how long an unanswered offer keeps its nonce
_DUPLICATE_SENDER = "the master has another process that is {!r}: two of one name, end one of them"
_OTHER_VERSION = "the master at {} speaks wire version {}, this slave {}: install one version on both"

_SECRET = (
    "the secret of {0!r} is not the one that the master at {1} has for it: phalanx fleet deploy brings"
    " device-{0}.secret"
)
_NO_SECRET = (
    "the master at {1} asks for the secret of {0!r}, and this device has the rig key alone: phalanx fleet deploy brings"
    " device-{0}.secret; --keys DIR says where it is"
)
_MASTER_HAS_NONE = (
    "the master at {1} has the rig key alone, and {0!r} a secret of its own: start the master with --keys DIR, a folder"
    " that has devices.key (phalanx fleet keys DIR --make)"
)


@dataclass(slots=True)
class _Offer:
    """An attempt to get a session: the nonce, and the beacon that it answers."""

    slave_nonce: bytes
    beacon: Beacon
    beacon_counter: int
    address: Address
    received_ns: int
    next_ns: int
    since_ns: int
    drawn_ns: int  # its nonce


@dataclass(slots=True)
class _Session:
    master_nonce: bytes
    slave_nonce: bytes
    beacon_counter: int  # of the newest beacon: an older one may not list this session
    key_id: int
    address: Address
    zenoh_endpoint: str | None
    sealer: Sealer
    opener: Opener
    since_ns: int
    received_ns: int
    start_t_ns: int | None = None


class SlaveLink:
    """State machine of the link: takes datagrams, and states which to send."""

    def __init__(self, name: str, key: LinkKey | bytes, clock: Clock, random: Random) -> None:
        """Begin a new life of the slave `name`; `ValueError`: key of wrong length."""
        self._name = name
        self._keys = RigKeys(key)
        self._clock = clock
        self._random = random
        self.process = new_process_id(random(8))
        self._sealer = self._keys.sealer(self.process)
        self._session: _Session | None = None
        self._offer: _Offer | None = None
        self._outbox: list[tuple[bytes, Address]] = []
        self._next_strange_ns: int | None = None
        self._wrong: tuple[int, str] | None = None
        self.refused: Counter[Refusal] = Counter()

    @property
    def wrong(self) -> str | None:
        """Why no master accepts this slave, if known: duplicate, wire version, secret."""
        if self._wrong is None:
            return None
        t_ns, why = self._wrong
        return why if 0 <= self._clock.now_ns() - t_ns < 2_500_000_000 else None

    def state(self, t_ns: int) -> State:
        """State of the handshake at `t_ns`, on this slave's clock."""
        if self._session is None:
            return State.IDLE if self._offer is None else State.OFFERED
        return State.LIVE if t_ns - self._session.received_ns < WELL_NS else State.SILENT

    @property
    def started(self) -> bool:
        """Whether the master has sent start and is still there."""
        session = self._session
        if session is None or session.start_t_ns is None:
            return False
        return self._clock.now_ns() - session.received_ns < VANISHED_NS

    @property
    def start_t_ns(self) -> int | None:
        """When to begin [ns], on this slave's clock; None before the start."""
        return None if self._session is None else self._session.start_t_ns

    @property
    def zenoh_endpoint(self) -> str | None:
        """Where the master's bus listens, as this slave reaches it; None without one."""
        return None if self._session is None else self._session.zenoh_endpoint

    def receive_beacon(self, datagram: bytes, address: Address, t_ns: int) -> None:
        """Take a datagram from the beacon's port."""
        self._count(self._on_beacon(datagram, address, t_ns))

    def receive(self, datagram: bytes, address: Address, t_ns: int) -> None:
        """Take a datagram from the port of this slave that arrived at `t_ns`."""
        header = parse(datagram, self._keys.rig_tag)
        if isinstance(header, Refusal):
            self._count(header)
        elif header.kind is Kind.WELCOME:
            self._count(self._on_welcome(header, datagram, address, t_ns))
        elif header.kind is Kind.UNPROVEN:
            self._count(self._on_unproven(header, datagram, address, t_ns))
        elif header.kind in (Kind.START, Kind.ECHO_ASK):
            self._count(self._on_master(header, datagram, t_ns))
        else:
            self._count(Refusal.UNEXPECTED)

    def seal(self, message: Message) -> tuple[bytes, Address] | None:
        """`message` as a datagram, if it fits, and its address; None while not started."""
        session = self._session
        if session is None or not self.started:
            return None
        return session.sealer.seal(Kind.DATA, encode(message)), session.address

    def due(self) -> list[tuple[bytes, Address]]:
        """The datagrams to send now, each with its destination."""
        t_ns = self._clock.now_ns()
        offer = self._offer
        # A clock that was set back is no reason to be silent until it is there again.
        is_due = offer is not None and not 0 < offer.next_ns - t_ns <= HELLO_AGAIN_NS
        if offer is not None and is_due and t_ns - offer.received_ns < OFFER_NS:
            self._send_hello(offer, t_ns)
        outbox, self._outbox = self._outbox, []
        return outbox

    def _count(self, refusal: Refusal | None) -> None:
        if refusal is not None:
            self.refused[refusal] += 1

    def _on_beacon(self, datagram: bytes, address: Address, t_ns: int) -> Refusal | None:
        header = parse(datagram, self._keys.rig_tag)
        if isinstance(header, Refusal):
            if header is Refusal.VERSION:
                self._answer_other_version(datagram, address, t_ns)
            return header
        if header.kind is not Kind.BEACON:
            return Refusal.UNEXPECTED
        beacon = self._keys.open_as(header, datagram, Beacon)
        if isinstance(beacon, Refusal):
            return beacon
        event = self._beacon_event(beacon, header.counter, t_ns)
        if self._session is not None and event in (Event.BEACON_LISTED, Event.BEACON_UNLISTED):
            self._session.beacon_counter = header.counter
        rule = self._rule(event, t_ns)
        if rule.reply is not Kind.HELLO:
            return rule.refusal
        self._answer(beacon, header.counter, address, t_ns)
        return self._has_duplicate(beacon, t_ns)

    def _rule(self, event: Event, t_ns: int) -> Rule:
        return RULES[Role.SLAVE, self.state(t_ns), event]

    def _beacon_event(self, beacon: Beacon, counter: int, t_ns: int) -> Event:
        session = self._session
        if session is None or beacon.master_nonce != session.master_nonce:
            return Event.BEACON_OTHER
        vanished = t_ns - session.received_ns >= VANISHED_NS  # then no counter is worth being deaf for it
        if counter <= session.beacon_counter and not vanished:
            return Event.BEACON_OLD
        listed = beacon.sessions.get(self._name) == session.key_id
        is_new = t_ns - session.since_ns < 1_000_000_000
        return Event.BEACON_LISTED if listed or is_new else Event.BEACON_UNLISTED

    def _answer(self, beacon: Beacon, counter: int, address: Address, t_ns: int) -> None:
        old, since_ns, nonce, drawn_ns = self._offer, t_ns, b"", t_ns
        if old is not None:
            same_master = old.beacon.master_nonce == beacon.master_nonce
            if same_master and t_ns - old.received_ns < OFFER_NS:
                since_ns = old.since_ns
            if 0 <= t_ns - old.drawn_ns < NONCE_NS:
                nonce, drawn_ns = old.slave_nonce, old.drawn_ns
        nonce = nonce or self._random(NONCE_BYTES)
        self._offer = _Offer(nonce, beacon, counter, address, t_ns, t_ns, since_ns, drawn_ns)
        self._send_hello(self._offer, t_ns)

    def _has_duplicate(self, beacon: Beacon, t_ns: int) -> Refusal | None:
        """Refusal if the master lists another process of this name."""
        listed = beacon.sessions.get(self._name)
        ours = None if self._session is None else self._session.key_id
        # unanswered for a second while the beacons list the name: another process has it
        if self._offer is None or listed in (None, ours) or t_ns - self._offer.since_ns < 1_000_000_000:
            return None
        self._wrong = t_ns, _DUPLICATE_SENDER.format(self._name)
        return Refusal.DUPLICATE_SENDER

    def _answer_other_version(self, datagram: bytes, address: Address, t_ns: int) -> None:
        """Send, seldom, who this is to a master of its rig with another wire version."""
        if len(datagram) < OVERHEAD:
            return
        _, version, kind, _, rig, _, _ = HEADER.unpack_from(datagram)
        if kind != Kind.BEACON or rig != self._keys.rig_tag:
            return
        strange_ns = 1_000_000_000  # between two hellos to a master of another wire version
        if self._next_strange_ns is not None and 0 < self._next_strange_ns - t_ns <= strange_ns:
            return
        self._next_strange_ns = t_ns + strange_ns
        self._wrong = t_ns, _OTHER_VERSION.format(address[0], version, WIRE_VERSION)
        nonces = self._random(NONCE_BYTES), bytes(NONCE_BYTES)
        hello = self._keys.hello(self._name, self.process, *nonces)
        self._outbox.append((seal(self._sealer, hello), address))

    def _send_hello(self, offer: _Offer, t_ns: int) -> None:
        offer.next_ns = t_ns + HELLO_AGAIN_NS
        self._outbox.append((seal(self._sealer, self._hello(offer)), offer.address))

    def _hello(self, offer: _Offer) -> Hello:
        return self._keys.hello(self._name, self.process, offer.slave_nonce, offer.beacon.master_nonce)

    def _on_welcome(self, header: Header, datagram: bytes, address: Address, t_ns: int) -> Refusal | None:
        welcome = self._keys.open_as(header, datagram, Welcome)
        if isinstance(welcome, Refusal):
            return welcome
        offer = self._offer
        event, keys = self._welcome_event(welcome, offer)
        rule = self._rule(event, t_ns)
        if rule.refusal is not None or offer is None or keys is None:
            return rule.refusal
        self._session = _Session(
            welcome.master_nonce,
            welcome.slave_nonce,
            offer.beacon_counter,
            keys.key_id,
            address,
            reached_at(offer.beacon.zenoh_endpoint, offer.address[0]) or None,
            self._keys.session_sealer(keys.to_master, keys.key_id),
            Opener(keys.to_slave),
            since_ns=t_ns,
            received_ns=t_ns,
        )
        self._offer = None
        return None

    def _welcome_event(self, welcome: Welcome, offer: _Offer | None) -> tuple[Event, SessionKeys | None]:
        """What a welcome is, and the keys of its session if it is a proven one."""
        if self._session is not None and welcome.slave_nonce == self._session.slave_nonce:
            return Event.WELCOME_AGAIN, None
        if offer is None or welcome.slave_nonce != offer.slave_nonce:
            return Event.WELCOME_UNASKED, None
        if welcome.master_nonce != offer.beacon.master_nonce:
            return Event.WELCOME_STALE, None  # a beacon of another life came meanwhile, and hello went there
        keys = self._keys.session(self._hello(offer), welcome.session_nonce)
        if not compare_digest(keys.proof, welcome.proof):
            return Event.WELCOME_UNPROVEN, None
        return Event.WELCOME, keys

    def _on_unproven(self, header: Header, datagram: bytes, address: Address, t_ns: int) -> Refusal | None:
        """Keep why there is no welcome; whoever has the rig key can send it."""
        unproven = self._keys.open_as(header, datagram, Unproven)
        if isinstance(unproven, Refusal):
            return unproven
        ours = self._offer is not None and unproven.slave_nonce == self._offer.slave_nonce
        if ours:
            why = _SECRET
            if unproven.has_secrets != self._keys.has_secrets:
                why = _NO_SECRET if unproven.has_secrets else _MASTER_HAS_NONE
            self._wrong = t_ns, why.format(self._name, address[0])
        return self._rule(Event.UNPROVEN if ours else Event.UNPROVEN_UNASKED, t_ns).refusal

    def _on_master(self, header: Header, datagram: bytes, t_ns: int) -> Refusal | None:
        session = self._session
        if session is None or header.key_id != session.key_id:
            return Refusal.STALE
        opened = session.opener.open(header, datagram)
        if isinstance(opened, Refusal):
            return opened
        message = read(header.kind, opened.body)
        session.received_ns = t_ns
        if isinstance(message, EchoAsk):
            answer = EchoAnswer(message.t1_ns, t_ns, self._clock.now_ns())
            self._outbox.append((seal(session.sealer, answer), session.address))
        elif isinstance(message, Start):
            session.start_t_ns = message.start_t_ns
            self._outbox.append((seal(session.sealer, Started(message.start_t_ns)), session.address))
        else:
            return Refusal.UNDECODABLE
        return None
