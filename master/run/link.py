"""Link of the master: datagrams in, messages on its clock and replies out.

A push machine without a socket. `common.link.handshake.RULES` states what follows from each event; this file
classifies datagrams as events.
- A hello makes a *pending* session; it replaces the live one only when its slave has sealed something with
  the new keys. So a replayed or late hello never ends a live session.
- A hello counts only with the proof that its sender has the secret of its name: a stolen device of the rig
  begins no session in another's name, and takes no room of it.
- A second process under one name is refused while the first one is well (`WELL_NS`): two do not take turns.
  Who was silent for longer is replaced by whoever sends a hello.
- A message is taken in the session of the process that sent the hello, within the bounds of its type, of the
  sender's files and of time (`link_senders`: not ahead, not older than a second, not before the last, as
  after a step of the slave's clock, which the echoes then measure). One that makes something fail costs its
  sender a pause.
- The clock is asked in pending and live sessions alike: the answer is what confirms a session.
- The start is sent when every camera is in a session whose clock is known, or a timeout after the first one;
  then to each sender that joins, again and again until acknowledged. Nobody waits for an IMU or a tracker.
- Each kind of message (markers, tags, strobe cycles, IMU samples, tracker poses) has numbers of its own.
- Everything held is bounded: two sessions and 64 old nonces per sender of the rig.
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, replace
from types import MappingProxyType

from common.clock import Clock
from common.errors import BoundsError, MessageError
from common.link.clock_offset import ClockEstimate
from common.link.datagram import Address, Header, Kind, LinkKey, Opened, Opener, Refusal, parse
from common.link.handshake import (
    MAX_CAMERAS,
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
    Start,
    Started,
    State,
    Unproven,
    Welcome,
    new_process_id,
    read,
    seal,
)
from common.messages import (
    WIRE_VERSION,
    ImuSample,
    MarkerDetections,
    TagDetections,
    TrackerPose,
    WristDetections,
    decode,
)
from common.messages.streams import sender_of
from master.run.link_senders import (
    ASKED,
    MarkerCounts,
    Quarantine,
    RejectedPeer,
    RejectedPeers,
    Sender,
    SenderLimits,
    SensorMessage,
    Session,
    not_admitted,
    on_master_clock,
)
from master.run.sequence import CYCLE_FRAMES, CameraCounts

PENDING_NS = 1_000_000_000  # a hello whose slave never confirms is forgotten
SILENT_NS = 1_000_000_000


def _check_names(
    cameras: tuple[str, ...], imus: tuple[str, ...], wrists: tuple[str, ...], trackers: tuple[str, ...]
) -> None:
    """Refuse senders with one name for two, or too many; ValueError."""
    everybody = {*cameras, *imus, *trackers}
    if not cameras or not len(everybody) <= MAX_CAMERAS:
        raise ValueError(f"{len(everybody)} cameras, IMUs and trackers, expected 1 to {MAX_CAMERAS}")
    for one, ones, other, others in (
        ("a camera", cameras, "an IMU", imus),
        ("a camera", cameras, "a tracker", trackers),
        ("an IMU", imus, "a tracker", trackers),
    ):
        if both := set(ones) & set(others):
            raise ValueError(f"{min(both)!r} is {one} and {other}")
    if strange := set(wrists) - set(cameras):
        raise ValueError(f"{min(strange)!r} of a wrist device is none of the cameras")


class MasterLink:
    """Sessions of the rig's senders, the moment of the start, counts of refusals."""

    def __init__(
        self,
        cameras: tuple[str, ...],
        key: LinkKey | bytes,
        clock: Clock,
        beacon_to: Address,
        zenoh_endpoint: str,
        start_timeout_ns: int,
        random: Random,
        imus: tuple[str, ...] = (),
        wrists: tuple[str, ...] = (),
        trackers: tuple[str, ...] = (),
        limits: Mapping[str, SenderLimits] = MappingProxyType({}),
    ) -> None:
        """Begin a new life of the master, with a nonce from `random`.

        `imus` and `trackers` may take part, and nobody waits for them. `wrists` are those of `cameras` that
        belong to a wrist device: they send strobe cycles, the others markers and tags. `limits` is what the
        files state of each sender; one that is not in it has the bounds of its messages alone.

        Raises:
            ValueError: Key of wrong length, no camera, more than 32 senders, one name for two kinds of
                sender, or a wrist's camera that is none of the cameras.
        """
        _check_names(cameras, imus, wrists, trackers)
        self._keys, self._clock, self._random = RigKeys(key), clock, random
        self._beacon_to, self._zenoh_endpoint = beacon_to, zenoh_endpoint
        self._start_timeout_ns = start_timeout_ns
        self._nonce = random(NONCE_BYTES)
        self._sealer = self._keys.sealer(new_process_id(random(8)))
        kinds: tuple[tuple[tuple[str, ...], dict[type[SensorMessage], int | None]], ...] = (
            (cameras, {MarkerDetections: 1, TagDetections: None}),
            (wrists, {WristDetections: CYCLE_FRAMES}),
            (imus, {ImuSample: 1}),
            (trackers, {TrackerPose: 1}),
        )
        self._senders = {
            name: Sender.of(steps, limits.get(name, SenderLimits()))
            for names, steps in kinds
            for name in names
        }
        self._awaited = tuple(self._senders[name] for name in cameras)
        self._extra = frozenset((*imus, *trackers))
        self._sessions: dict[int, Session] = {}
        self._first_ns: int | None = None
        self._start_ns: int | None = None
        self._next_beacon_ns = clock.now_ns()
        self._outbox: list[tuple[bytes, Address]] = []
        self.refused: Counter[Refusal] = Counter()
        self.unsynchronised = 0
        self.quarantine = Quarantine()
        self.rejected_peers = RejectedPeers(self._keys, self._senders)

    def receive(self, datagram: bytes, address: Address, t_ns: int) -> SensorMessage | None:
        """Take a datagram that arrived from `address` at `t_ns`; return what it brought."""
        header = parse(datagram, self._keys.rig_tag)
        if isinstance(header, Refusal):
            result = header
            if header is Refusal.VERSION:
                self.rejected_peers.other_version(datagram, address[0], t_ns)
        elif header.kind is Kind.HELLO:
            result = self._on_hello(header, datagram, address, t_ns)
        elif header.kind in (Kind.ECHO_ANSWER, Kind.STARTED, Kind.DATA):
            result = self._on_slave(header, datagram, t_ns)
        else:
            result = Refusal.UNEXPECTED
        if isinstance(result, Refusal):
            self.refused[result] += 1
            return None
        return result

    def due(self) -> list[tuple[bytes, Address]]:
        """Return the datagrams to send now, each with its destination."""
        t_ns = self._clock.now_ns()
        if t_ns >= self._next_beacon_ns:
            beacon_ns = 100_000_000
            self._next_beacon_ns = max(self._next_beacon_ns + beacon_ns, t_ns)
            live = {name: sender.live for name, sender in self._senders.items()}
            known = {name: session.key_id for name, session in live.items() if session is not None}
            beacon = Beacon(self._nonce, self._zenoh_endpoint, known)
            self._outbox.append((seal(self._sealer, beacon), self._beacon_to))
        for sender in self._senders.values():
            pending = sender.pending
            if pending is not None and t_ns - pending.since_ns > PENDING_NS:
                # Its nonce stays usable: the slave may be there, only unheard.
                del self._sessions[pending.key_id]
                sender.pending = pending = None
            for session in (sender.live, pending):
                if session is not None:
                    self._ask_clock(session)
        self._open_barrier(t_ns)
        for sender in self._senders.values():
            self._send_start(sender, t_ns)
        outbox, self._outbox = self._outbox, []
        return outbox

    @property
    def started(self) -> bool:
        """Whether the start has been given."""
        return self._start_ns is not None

    def state(self, sender: str, t_ns: int) -> State:
        """Return how far the session of `sender` is at `t_ns`, on this clock."""
        of = self._senders[sender]
        if of.live is None:
            return State.IDLE if of.pending is None else State.PENDING
        return State.LIVE if t_ns - of.live.received_ns < WELL_NS else State.SILENT

    def connected(self) -> frozenset[str]:
        """Return the senders received in a live session within the last second."""
        t_ns = self._clock.now_ns()
        live = ((name, sender.live) for name, sender in self._senders.items())
        return frozenset(
            name for name, link in live if link is not None and t_ns - link.received_ns < SILENT_NS
        )

    def clock_of(self, sender: str) -> ClockEstimate | None:
        """Return how the clock of `sender` runs, or None before its first echo."""
        live = self._senders[sender].live
        return None if live is None else live.clock.estimate()

    def limit(self, limits: Mapping[str, SenderLimits]) -> None:
        """Accept from each sender what its files state now."""
        for name, sender in self._senders.items():
            sender.limit(limits.get(name, SenderLimits()))

    def events_of(self, sender: str) -> dict[str, int]:
        """Return event -> how often since this master began.

        Those of `CameraCounts`; clock_steps, how often its clock has jumped; restarts, how often another process took
        over; refused, datagrams that it sealed; once there were any, tags_received and tags_late.
        """
        of, tags = self._senders[sender], self.tag_counts_of(sender)
        steps = of.steps_before + (0 if of.live is None else of.live.clock.steps)
        events = asdict(self.counts_of(sender))
        events |= {"clock_steps": steps, "restarts": of.restarts, "refused": of.refused}
        if tags is not None and tags.received:
            events |= {"tags_received": tags.received, "tags_late": tags.late}
        return events

    def counts_of(self, sender: str) -> CameraCounts:
        """Return what was counted of `sender` since this master began."""
        kind = self._senders[sender].main
        counts, lost = kind.sequence.counts, kind.losses.lost
        return replace(counts, lost=lost, skipped=counts.lost - lost)

    def tag_counts_of(self, camera: str) -> CameraCounts | None:
        """Return the counts of a camera's tags, none ever missing; None: it sends none."""
        kind = self._senders[camera].kinds.get(TagDetections)
        return None if kind is None else kind.sequence.counts

    def _on_hello(self, header: Header, datagram: bytes, address: Address, t_ns: int) -> Refusal | None:
        hello = self._keys.open_as(header, datagram, Hello)
        if isinstance(hello, Refusal):
            return hello
        sender = self._senders.get(hello.name)
        if sender is None:
            return Refusal.UNKNOWN if hello.master_nonce == self._nonce else Refusal.REPLAYED
        event = self._hello_event(hello, sender)
        rule = RULES[Role.MASTER, self.state(hello.name, t_ns), event]
        if rule.refusal is Refusal.DUPLICATE_SENDER:
            self.rejected_peers.note("duplicate", hello.name, RejectedPeer(address[0], WIRE_VERSION), t_ns)
        if rule.reply is Kind.UNPROVEN:
            self.rejected_peers.note("unproven", hello.name, RejectedPeer(address[0], WIRE_VERSION), t_ns)
            unproven = Unproven(self._nonce, hello.slave_nonce, self._keys.has_secrets)
            self._outbox.append((seal(self._sealer, unproven), address))
        if rule.reply is Kind.WELCOME:
            again = self._of_nonce(sender, hello.slave_nonce)  # its welcome was lost
            session = again or self._begin(hello, sender, address, t_ns)
            welcome = Welcome(self._nonce, hello.slave_nonce, session.session_nonce, session.proof)
            self._outbox.append((seal(self._sealer, welcome), session.address))
        return rule.refusal

    def _hello_event(self, hello: Hello, sender: Sender) -> Event:
        if hello.master_nonce != self._nonce:
            return Event.HELLO_OTHER_MASTER
        if not self._keys.proves(hello):
            return Event.HELLO_UNPROVEN
        if self._of_nonce(sender, hello.slave_nonce) is not None:
            return Event.HELLO_AGAIN
        if hello.slave_nonce in sender.old_nonces:
            return Event.HELLO_USED
        live = sender.live
        return (
            Event.HELLO if live is None or live.hello.process == hello.process else Event.HELLO_OTHER_PROCESS
        )

    @staticmethod
    def _of_nonce(sender: Sender, slave_nonce: bytes) -> Session | None:
        for session in (sender.live, sender.pending):
            if session is not None and session.hello.slave_nonce == slave_nonce:
                return session
        return None

    def _begin(self, hello: Hello, sender: Sender, address: Address, t_ns: int) -> Session:
        if sender.pending is not None:  # a newer attempt of the slave, which has given that one up
            sender.old_nonces.append(sender.pending.hello.slave_nonce)
            del self._sessions[sender.pending.key_id]
        session_nonce = self._random(NONCE_BYTES)
        keys = self._keys.session(hello, session_nonce)
        sealer = self._keys.session_sealer(keys.to_slave, keys.key_id)
        session = Session(
            hello.name, hello, session_nonce, keys.proof, keys.key_id, address, sealer, Opener(keys.to_master),
            since_ns=t_ns, received_ns=t_ns, next_echo_ns=t_ns, next_start_ns=t_ns,
        )  # fmt: skip
        sender.pending = self._sessions[session.key_id] = session
        return session

    def _on_slave(self, header: Header, datagram: bytes, t_ns: int) -> SensorMessage | Refusal | None:
        session = self._sessions.get(header.key_id)
        if session is None:
            return Refusal.STALE
        sender = self._senders[session.name]
        try:
            result = self._opened(session, sender, header, datagram, t_ns)
        except Exception as error:  # noqa: BLE001
            # Whatever a device sends costs this device a pause, and never the thread that receives from all others.
            self.quarantine.fault(session.name, error, t_ns)
            result = Refusal.FAULTY
        sender.refused += isinstance(result, Refusal)
        return result

    def _opened(
        self, session: Session, sender: Sender, header: Header, datagram: bytes, t_ns: int
    ) -> SensorMessage | Refusal | None:
        opened = session.opener.open(header, datagram)
        if isinstance(opened, Refusal):
            if opened is Refusal.DUPLICATE:
                sender.main.sequence.counts.duplicate += 1
            return opened
        session.received_ns = t_ns
        if sender.pending is session:
            self._confirm(sender, session, t_ns)
        if opened.reordered:
            sender.main.sequence.counts.reordered += 1
        if header.kind is Kind.DATA:
            return self._take_data(session, sender, opened, header.counter, t_ns)
        if opened.reordered:
            sender.fill(header.counter)
        message = read(header.kind, opened.body)
        if isinstance(message, EchoAnswer):
            if message.t1_ns not in session.asked:
                return Refusal.UNASKED_ECHO
            del session.asked[message.t1_ns]
            session.clock.push(message.t1_ns, message.t2_ns, message.t3_ns, t_ns)
        elif isinstance(message, Started):
            session.started = True
        else:
            return Refusal.UNDECODABLE
        return None

    def _confirm(self, sender: Sender, session: Session, t_ns: int) -> None:
        if sender.live is not None:
            sender.restarts += sender.live.hello.process != session.hello.process
            sender.steps_before += sender.live.clock.steps
            del self._sessions[sender.live.key_id]
        sender.live, sender.pending = session, None
        for kind in sender.kinds.values():
            kind.begin_session()
        sender.old_nonces.append(session.hello.slave_nonce)
        if self._first_ns is None and session.name not in self._extra:
            self._first_ns = t_ns

    def _take_data(
        self, session: Session, sender: Sender, opened: Opened, counter: int, now_ns: int
    ) -> SensorMessage | Refusal | None:
        if self.quarantine.holds(session.name, now_ns):
            return Refusal.FAULTY
        try:
            message = decode(opened.body)
        except BoundsError:
            return Refusal.OUT_OF_BOUNDS
        except MessageError:
            return Refusal.UNDECODABLE
        if not isinstance(message, SensorMessage):
            return Refusal.UNDECODABLE
        name = sender_of(message)
        kind = sender.kinds.get(type(message))
        if name != session.name or kind is None:
            return Refusal.IMPOSTOR
        if (why := not_admitted(message, session, sender, now_ns)) is not None:
            if why is Refusal.MARKER_COUNT and isinstance(message, MarkerDetections):
                counts = MarkerCounts(len(message.area), sender.limits.markers or 0)
                self.rejected_peers.note("markers", name, counts, now_ns)
            return why
        session.started = True
        if opened.reordered:
            sender.fill(counter, kind)
        if not kind.take(message.session, message.seq, counter, session.opener.missing_between):
            return None
        timed = on_master_clock(message, session.clock.estimate(), kind, now_ns)
        self.unsynchronised += timed is None
        return timed

    def _ask_clock(self, session: Session) -> None:
        t_ns = self._clock.now_ns()  # asked for each: it is the time stamp itself
        if t_ns < session.next_echo_ns:
            return
        fast_ns = 2_000_000_000
        echo_ns = 200_000_000
        if t_ns - session.received_ns > SILENT_NS:
            period = echo_ns
        elif not session.clock.settled or t_ns - session.since_ns < fast_ns:
            echo_fast_ns = 10_000_000  # in the first two seconds, and until the clock is settled
            period = echo_fast_ns
        else:
            echo_early_ns = 50_000_000
            early_ns = 5_000_000_000
            period = echo_early_ns if t_ns - session.since_ns < early_ns else echo_ns
        # On the grid, so that the rate is kept by a thread that wakes late, too.
        session.next_echo_ns = max(session.next_echo_ns + period, t_ns + period // 2)
        session.asked[t_ns] = None
        if len(session.asked) > ASKED:
            del session.asked[next(iter(session.asked))]
        self._outbox.append((seal(session.sealer, EchoAsk(t_ns)), session.address))

    def _open_barrier(self, t_ns: int) -> None:
        if self._start_ns is not None or self._first_ns is None:
            return
        ready = all(sender.live is not None and sender.live.clock.ready for sender in self._awaited)
        if ready or t_ns - self._first_ns > self._start_timeout_ns:
            start_delay_ns = 100_000_000  # room for two repetitions of the start before it is due
            self._start_ns = t_ns + start_delay_ns

    def _send_start(self, sender: Sender, t_ns: int) -> None:
        session = sender.live
        if self._start_ns is None or session is None or session.started or t_ns < session.next_start_ns:
            return
        clock = session.clock.estimate()
        if clock is None or not session.clock.ready:
            return
        start_again_ns = 50_000_000
        session.next_start_ns = t_ns + start_again_ns
        start = Start(clock.to_remote(self._start_ns))
        self._outbox.append((seal(session.sealer, start), session.address))
