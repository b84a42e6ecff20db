"""Every row of the handshake's transition table, on the real ends of the link: one test per row."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import pytest
from msgspec.structs import replace

from common.link.datagram import Address, Kind, Refusal, Sealer, parse
from common.link.handshake import (
    RULES,
    Beacon,
    EchoAnswer,
    EchoAsk,
    Event,
    Handshake,
    Hello,
    Key,
    RigKeys,
    Role,
    Rule,
    SessionKeys,
    State,
    Unproven,
    Welcome,
    seal,
    state_pages,
)
from master.run.link import MasterLink
from slave.link import SlaveLink
from tests.network_helpers import ManualClock, seeded

KEY = bytes(range(32))
MASTER: Address = ("10.0.0.1", 47801)
SLAVE: Address = ("10.0.1.1", 5)
OTHER_PROCESS = 99
S = 1_000_000_000


def kinds(datagrams: list[tuple[bytes, Address]], keys: RigKeys) -> list[Kind]:
    headers = [parse(datagram, keys.rig_tag) for datagram, _ in datagrams]
    return [header.kind for header in headers if not isinstance(header, str)]


def rows(role: Role) -> list[Key]:
    return [key for key in RULES if key[0] is role]


def name(key: Key) -> str:
    return f"{key[1]}: {key[2]}"


@dataclass
class SlaveEnd:
    """A slave's link, and a master made of nothing but its datagrams."""

    clock: ManualClock = field(default_factory=lambda: ManualClock(1000 * S))
    nonce: bytes = b"m" * 16
    session_nonce: bytes = b"s" * 16

    def __post_init__(self) -> None:
        self.keys = RigKeys(KEY)
        self.link = SlaveLink("left", KEY, self.clock, seeded(1))
        self.sealer = self.keys.sealer(7)
        self.to_slave: Sealer | None = None
        self.key_id = 0
        self.sent: list[tuple[bytes, Address]] = []
        self.hellos: list[Hello] = []

    def beacon(
        self, nonce: bytes | None = None, listed: bool = False, datagram: bytes | None = None
    ) -> bytes:
        sessions = {"left": self.key_id} if listed else {}
        datagram = datagram or seal(self.sealer, Beacon(nonce or self.nonce, "", sessions))
        self.link.receive_beacon(datagram, MASTER, self.clock.now_ns())
        self.collect()
        return datagram

    def collect(self) -> None:
        for datagram, to in self.link.due():
            self.sent.append((datagram, to))
            header = parse(datagram, self.keys.rig_tag)
            if not isinstance(header, str) and header.kind is Kind.HELLO:
                hello = self.keys.open_as(header, datagram, Hello)
                assert isinstance(hello, Hello)
                self.hellos.append(hello)

    def send(self, message: Handshake, sealer: Sealer | None = None) -> None:
        self.link.receive(seal(sealer or self.sealer, message), MASTER, self.clock.now_ns())
        self.collect()

    def welcome_of(self, hello: Hello) -> tuple[Welcome, SessionKeys]:
        keys = self.keys.session(hello, self.session_nonce)
        return Welcome(hello.master_nonce, hello.slave_nonce, self.session_nonce, keys.proof), keys

    def welcome(self) -> Welcome:
        welcome, keys = self.welcome_of(self.hellos[-1])
        self.send(welcome)
        self.to_slave = self.keys.session_sealer(keys.to_slave, keys.key_id)
        self.key_id = keys.key_id
        return welcome

    def ask(self) -> None:
        assert self.to_slave is not None
        self.send(EchoAsk(self.clock.now_ns()), self.to_slave)

    def bring_to(self, state: State, offer: bool) -> None:
        if state is not State.IDLE:
            self.beacon()
        if state in (State.LIVE, State.SILENT):
            self.last = self.welcome()
            if offer:  # not listed for longer than a second: hello for another session beside this one
                self.clock.t_ns += 1_100_000_000
                self.beacon()
                self.ask()
            if state is State.SILENT:
                self.clock.t_ns += 600_000_000
        assert self.link.state(self.clock.now_ns()) is state

    def cause(self, event: Event) -> None:
        match event:
            case Event.BEACON_OTHER:
                self.beacon(b"o" * 16)
            case Event.BEACON_LISTED:
                self.beacon(listed=True)
            case Event.BEACON_UNLISTED:
                self.beacon()
            case Event.BEACON_OLD:
                self.beacon(datagram=self.beacon(listed=True))
            case Event.WELCOME:
                self.welcome()
            case Event.WELCOME_AGAIN:
                self.send(self.last)
            case Event.WELCOME_UNASKED:
                self.send(Welcome(self.nonce, b"x" * 16, self.session_nonce, b"p" * 16))
            case Event.WELCOME_STALE:
                welcome, _ = self.welcome_of(self.hellos[-1])
                self.send(replace(welcome, master_nonce=b"o" * 16))
            case Event.WELCOME_UNPROVEN:
                welcome, _ = self.welcome_of(self.hellos[-1])
                self.send(replace(welcome, proof=b"p" * 16))
            case Event.UNPROVEN:
                self.send(Unproven(self.nonce, self.hellos[-1].slave_nonce, True))
            case Event.UNPROVEN_UNASKED:
                self.send(Unproven(self.nonce, b"x" * 16, True))
            case Event.SEALED:
                self.ask()
            case Event.SILENCE:
                self.clock.t_ns += 600_000_000
            case _:
                raise AssertionError(f"no slave is told of {event}")


def check(rule: Rule, state: State, refused: Mapping[Refusal, int], sent: list[Kind]) -> None:
    assert state is rule.next
    assert refused == ({} if rule.refusal is None else {rule.refusal: 1})
    assert set(sent) & {Kind.HELLO, Kind.WELCOME, Kind.UNPROVEN} == ({rule.reply} - {None})


@pytest.mark.parametrize("key", rows(Role.SLAVE), ids=name)
def test_a_slave_follows_its_row(key: Key) -> None:
    _, state, event = key
    end = SlaveEnd()
    on_offer = event.name.startswith(("WELCOME", "UNPROVEN", "BEACON_UNLISTED"))
    end.bring_to(state, offer=on_offer)
    end.collect()  # a repeated hello is no reply to what follows
    if event is Event.WELCOME and state in (State.LIVE, State.SILENT):
        end.session_nonce = b"t" * 16
    end.sent.clear()
    end.link.refused.clear()
    end.cause(event)
    check(RULES[key], end.link.state(end.clock.now_ns()), dict(end.link.refused), kinds(end.sent, end.keys))


@dataclass
class MasterEnd:
    """A master's link, and a slave made of nothing but its datagrams."""

    clock: ManualClock = field(default_factory=lambda: ManualClock(1000 * S))

    def __post_init__(self) -> None:
        self.keys = RigKeys(KEY)
        self.link = MasterLink(("left",), KEY, self.clock, ("10.0.0.255", 47800), "", 5 * S, seeded(1))
        self.sealer = self.keys.sealer(7)
        self.sent: list[tuple[bytes, Address]] = []
        self.welcomes: list[Welcome] = []
        self.used: Hello | None = None
        self.drawn = 0
        self.collect()
        header = parse(self.sent[0][0], self.keys.rig_tag)
        assert not isinstance(header, str)
        beacon = self.keys.open_as(header, self.sent[0][0], Beacon)
        assert isinstance(beacon, Beacon)
        self.nonce = beacon.master_nonce

    def collect(self) -> None:
        for datagram, to in self.link.due():
            self.sent.append((datagram, to))
            header = parse(datagram, self.keys.rig_tag)
            if not isinstance(header, str) and header.kind is Kind.WELCOME:
                welcome = self.keys.open_as(header, datagram, Welcome)
                assert isinstance(welcome, Welcome)
                self.welcomes.append(welcome)

    def hello(self, process: int = 7, master_nonce: bytes | None = None) -> Hello:
        self.drawn += 1
        nonce = self.drawn.to_bytes(16, "big")
        hello = self.keys.hello("left", process, nonce, master_nonce or self.nonce)
        self.send(hello)
        return hello

    def send(self, message: Handshake, sealer: Sealer | None = None) -> None:
        self.link.receive(seal(sealer or self.sealer, message), SLAVE, self.clock.now_ns())
        self.collect()

    def answer(self) -> None:
        """Answer the last echo of the session whose keys this slave has."""
        session = next(one for one in self.link._sessions.values() if one.hello == self.last)
        t_ns = next(reversed(session.asked))
        self.send(EchoAnswer(t_ns, t_ns, t_ns), self.to_master)

    def bring_to(self, state: State, pending: bool) -> None:
        if state is not State.IDLE:
            self.last = self.hello()
            keys = self.keys.session(self.last, self.welcomes[-1].session_nonce)
            self.to_master = self.keys.session_sealer(keys.to_master, keys.key_id)
        if state in (State.LIVE, State.SILENT):
            self.answer()
            if pending:
                self.hello()
            if state is State.SILENT:
                self.clock.t_ns += 600_000_000
                self.collect()
        assert self.link.state("left", self.clock.now_ns()) is state

    def cause(self, event: Event, state: State) -> None:
        match event:
            case Event.HELLO:
                self.hello()
            case Event.HELLO_AGAIN:
                self.send(self.last)
            case Event.HELLO_USED:
                assert self.used is not None
                self.send(self.used)
            case Event.HELLO_OTHER_MASTER:
                self.hello(master_nonce=b"o" * 16)
            case Event.HELLO_OTHER_PROCESS:
                self.hello(process=OTHER_PROCESS)
            case Event.HELLO_UNPROVEN:
                self.send(Hello("left", 7, b"u" * 16, self.nonce, b"p" * 16))
            case Event.SEALED:
                self.clock.t_ns += 10_000_000
                self.collect()
                self.answer()
            case Event.EXPIRED | Event.SILENCE:
                keep_alive = event is Event.EXPIRED and state is State.LIVE
                for _ in range(11):  # a pending session lasts one second
                    self.clock.t_ns += 100_000_000
                    self.collect()
                    if keep_alive:
                        self.answer()
            case _:
                raise AssertionError(f"no master is told of {event}")


@pytest.mark.parametrize("key", rows(Role.MASTER), ids=name)
def test_a_master_follows_its_row(key: Key) -> None:
    _, state, event = key
    end = MasterEnd()
    if event is Event.HELLO_USED:  # a pending hello that another one replaced; the rest of it expires
        end.used = end.hello()
        end.hello()
        end.clock.t_ns += 1_100_000_000
        end.collect()
    end.bring_to(state, pending=event is Event.EXPIRED)
    end.sent.clear()
    end.link.refused.clear()
    end.cause(event, state)
    check(
        RULES[key],
        end.link.state("left", end.clock.now_ns()),
        dict(end.link.refused),
        kinds(end.sent, end.keys),
    )


def test_every_state_and_event_of_a_role_is_reached_by_some_row() -> None:
    assert {state for _, state, _ in RULES} | {rule.next for rule in RULES.values()} == set(State)
    assert {event for _, _, event in RULES} == set(Event)


def test_the_check_fails_on_a_wrong_row() -> None:
    with pytest.raises(AssertionError):
        check(Rule(State.LIVE), State.SILENT, {}, [])
    with pytest.raises(AssertionError):
        check(Rule(State.LIVE, Kind.HELLO), State.LIVE, {}, [])


def test_the_table_of_the_page_has_a_line_per_event() -> None:
    table = state_pages()
    assert all(f"| {event} |" in table for event in Event)
