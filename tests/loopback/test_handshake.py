"""Both sides of the link against each other and against an attacker, with simulated time and wires.

No socket and no thread: what one side says is handed to the other by a `Wires`, which can lose,
keep and replay it. So every rule of docs/wire.md is a plain call, and a loss pattern is a seed.
"""

import random
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeAlias, TypeVar

import msgspec
import pytest

from common.clock import SkewedClock
from common.link.datagram import Address, Header, Kind, LinkKey, Refusal, Sealer, parse
from common.link.handshake import Hello, RigKeys, seal
from common.messages import (
    Command,
    Detections,
    ImuSample,
    TagDetections,
    TrackerPose,
    encode,
    restamped,
)
from master.run.link import MasterLink
from slave.link import SlaveLink
from tests.network_helpers import ManualClock, detections, seeded

KEY = bytes(range(32))
S = 1_000_000_000
STEP_NS = 5_000_000
HOP_NS = 300_000
Sent: TypeAlias = Detections | TagDetections | ImuSample | TrackerPose | Command
SentT = TypeVar("SentT", bound=Sent)
MASTER = ("10.0.0.1", 47801)
BROADCAST = ("10.0.0.255", 47800)


@dataclass
class Wires:
    """A master, slaves, simulated time, and everything that ever travelled."""

    loss: float = 0.0
    seed: int = 1
    clock: ManualClock = field(default_factory=lambda: ManualClock(1000 * S))
    master: MasterLink | None = None
    slaves: dict[Address, SlaveLink] = field(default_factory=dict[Address, SlaveLink])
    seen: list[tuple[bytes, Address, Address]] = field(default_factory=list[tuple[bytes, Address, Address]])
    got: list[Detections] = field(default_factory=list[Detections])
    samples: list[ImuSample] = field(default_factory=list[ImuSample])
    tags: list[TagDetections] = field(default_factory=list[TagDetections])
    tracked: list[TrackerPose] = field(default_factory=list[TrackerPose])
    lives: int = 0

    def __post_init__(self) -> None:
        self.random = random.Random(self.seed)

    def new_master(
        self,
        cameras: tuple[str, ...] = ("left", "right"),
        timeout_s: float = 5.0,
        imus: tuple[str, ...] = (),
        wrists: tuple[str, ...] = (),
        trackers: tuple[str, ...] = (),
        key: LinkKey | bytes = KEY,
    ) -> MasterLink:
        self.lives += 1
        source, timeout_ns = seeded(1000 * self.seed + self.lives), round(timeout_s * S)
        self.master = MasterLink(
            cameras, key, self.clock, BROADCAST, "tcp/10.0.0.1:47802", timeout_ns, source, imus, wrists, trackers
        )  # fmt: skip
        return self.master

    def new_slave(
        self, name: str, skewed: SkewedClock | None = None, key: LinkKey | bytes = KEY
    ) -> SlaveLink:
        self.lives += 1
        clock = self.clock if skewed is None else skewed
        slave = SlaveLink(name, key, clock, seeded(1000 * self.seed + self.lives))
        self.slaves[(f"10.0.1.{self.lives}", 5)] = slave
        return slave

    def remove(self, slave: SlaveLink) -> None:
        self.slaves = {address: other for address, other in self.slaves.items() if other is not slave}

    def carry(self, datagram: bytes, source: Address, to: Address, keep: bool = True) -> None:
        if keep:
            self.seen.append((datagram, source, to))
            if self.random.random() < self.loss:
                return
        self.clock.t_ns += HOP_NS
        t_ns = self.clock.now_ns()
        if to == BROADCAST:
            for slave in self.slaves.values():
                slave.receive_beacon(datagram, source, slave._clock.now_ns())
        elif to == MASTER and self.master is not None:
            message = self.master.receive(datagram, source, t_ns)
            if isinstance(message, ImuSample):
                self.samples.append(message)
            elif isinstance(message, TagDetections):
                self.tags.append(message)
            elif isinstance(message, TrackerPose):
                self.tracked.append(message)
            elif message is not None:
                self.got.append(message)
        elif to in self.slaves:
            slave = self.slaves[to]
            slave.receive(datagram, source, slave._clock.now_ns())

    def step(self) -> None:
        if self.master is not None:
            for datagram, to in self.master.due():
                self.carry(datagram, MASTER, to)
        for address, slave in list(self.slaves.items()):
            for datagram, to in slave.due():
                self.carry(datagram, address, to)
        self.clock.t_ns += STEP_NS

    def run(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Let time pass until `until` holds; whether it did."""
        end = self.clock.t_ns + round(seconds * S)
        while self.clock.t_ns < end:
            self.step()
            if until():
                return True
        return False

    def all_started(self) -> bool:
        return all(slave.started for slave in self.slaves.values())

    def stamped(self, slave: SlaveLink, message: SentT) -> SentT:
        """The message as of now, if it says no time: the later its number, the later."""
        if isinstance(message, Command) or message.t_ns != 0:
            return message
        t_ns = slave._clock.now_ns() + 1000 * (message.seq % 1000)
        if isinstance(message, ImuSample | TrackerPose):
            return restamped(message, t_ns=t_ns)
        return restamped(message, t_ns=t_ns, ready_t_ns=t_ns + 1000)

    def send(self, slave: SlaveLink, message: Sent) -> bytes | None:
        sealed = slave.seal(self.stamped(slave, message))
        if sealed is None:
            return None
        address = next(address for address, other in self.slaves.items() if other is slave)
        self.carry(sealed[0], address, sealed[1])
        return sealed[0]


def started_pair(wires: Wires) -> tuple[MasterLink, SlaveLink, SlaveLink]:
    master = wires.new_master()
    left, right = wires.new_slave("left"), wires.new_slave("right")
    assert wires.run(3.0, wires.all_started)
    wires.run(0.1)
    return master, left, right


def test_two_slaves_are_welcomed_started_and_heard() -> None:
    wires = Wires()
    remote = SkewedClock(500 * S, 50.0, wires.clock)
    master = wires.new_master()
    left, right = wires.new_slave("left"), wires.new_slave("right", remote)
    assert not left.started
    assert wires.send(left, detections("left", 1, 0)) is None
    began = wires.clock.t_ns
    assert wires.run(3.0, wires.all_started)
    assert wires.clock.t_ns - began < S // 2
    assert left.start_t_ns is not None
    assert right.start_t_ns is not None
    # One instant, told to each on its own clock (these wires carry one datagram after the other: HOP_NS).
    assert abs(remote.to_true(right.start_t_ns) - left.start_t_ns) < 2 * HOP_NS
    assert left.zenoh_endpoint == "tcp/10.0.0.1:47802"
    t_ns = wires.clock.now_ns()
    wires.send(right, detections("right", right.process, 0, remote.from_true(t_ns)))
    assert abs(wires.got[-1].t_ns - t_ns) < 2 * HOP_NS
    assert abs(wires.got[-1].ready_t_ns - t_ns - 1000) < 2 * HOP_NS
    wires.run(1.0)
    assert master.connected() == {"left", "right"}
    assert not master.refused
    assert not left.refused
    wires.remove(left)
    wires.run(1.5)
    assert master.connected() == {"right"}


def test_the_start_waits_for_the_last_camera_or_for_its_timeout() -> None:
    wires = Wires()
    wires.new_master(timeout_s=2.0)
    left = wires.new_slave("left")
    assert not wires.run(1.9, lambda: left.started)
    assert wires.run(0.6, lambda: left.started)
    late = wires.new_slave("right")
    assert wires.run(0.5, lambda: late.started)  # joins at once, its start is in the past
    assert late.start_t_ns is not None
    assert late.start_t_ns < wires.clock.t_ns


@pytest.mark.parametrize("seed", range(6))
def test_any_loss_pattern_of_20_percent_still_starts(seed: int) -> None:
    wires = Wires(loss=0.2, seed=seed)
    master = wires.new_master()
    wires.new_slave("left")
    wires.new_slave("right", SkewedClock(-900 * S, 100.0, wires.clock))
    assert wires.run(2.5, wires.all_started)
    # Either side restarts, and is back within a second.
    wires.remove(next(iter(wires.slaves.values())))
    wires.new_slave("left")
    assert wires.run(1.5, wires.all_started)
    wires.new_master()
    assert wires.run(2.5, lambda: not wires.all_started())
    assert wires.run(2.5, wires.all_started)
    assert set(master.refused) <= {
        Refusal.STALE,
        Refusal.DUPLICATE_SENDER,
    }  # the restarted slave, while the old one seems well


def test_a_restarted_slave_replaces_its_session_and_the_old_capture_is_stale() -> None:
    wires = Wires()
    master, left, _ = started_pair(wires)
    old = wires.send(left, detections("left", left.process, 0))
    assert old is not None
    wires.remove(left)
    new = wires.new_slave("left")
    assert wires.run(1.0, lambda: new.started)
    count = len(wires.got)
    for address in ((10, 1), (99, 9)):
        wires.carry(old, (f"10.0.1.{address[0]}", address[1]), MASTER, keep=False)
    assert len(wires.got) == count
    assert master.refused[Refusal.STALE] >= 2
    wires.send(new, detections("left", new.process, 0))
    assert len(wires.got) == count + 1
    assert len(master._sessions) == 2


def test_a_capture_of_everything_is_useless_against_a_restarted_master() -> None:
    wires = Wires()
    _, left, _ = started_pair(wires)
    for seq in range(5):
        wires.send(left, detections("left", left.process, seq))
    capture = [(datagram, source) for datagram, source, to in wires.seen if to == MASTER]
    wires.slaves.clear()
    master = wires.new_master()
    count = len(wires.got)
    for datagram, source in capture:
        wires.carry(datagram, source, MASTER, keep=False)
        wires.step()
    assert len(wires.got) == count
    assert not master._sessions
    assert set(master.refused) == {Refusal.REPLAYED, Refusal.STALE}  # hellos, and all the rest


def test_a_capture_of_everything_is_useless_against_a_restarted_slave() -> None:
    wires = Wires()
    _, left, _ = started_pair(wires)
    capture = [(datagram, source, to) for datagram, source, to in wires.seen if source == MASTER]
    wires.remove(left)
    wires.master = None
    new = wires.new_slave("left")
    address = next(address for address, slave in wires.slaves.items() if slave is new)
    for datagram, source, to in capture:
        wires.carry(datagram, source, to if to == BROADCAST else address, keep=False)
        wires.step()
    assert not new.started
    assert new._session is None
    assert set(new.refused) == {Refusal.REPLAYED, Refusal.STALE}


def test_a_replayed_hello_does_not_end_the_live_session() -> None:
    wires = Wires()
    master, left, _ = started_pair(wires)
    wires.remove(left)
    again = wires.new_slave("left")
    wires.run(1.0, lambda: again.started)
    live = dict(master._sessions)
    hellos = [d for d, _, to in wires.seen if to == MASTER and _kind(d) is Kind.HELLO]
    assert len(hellos) >= 3
    for datagram in hellos * 10:
        wires.carry(datagram, ("6.6.6.6", 6), MASTER, keep=False)
    wires.run(0.5)
    assert master._sessions == live
    assert master.refused[Refusal.REPLAYED] >= 10  # the first life of "left"; live ones are answered again
    assert again.started
    assert not [to for _, _, to in wires.seen if to == ("6.6.6.6", 6)]  # and nothing goes to the attacker
    wires.send(again, detections("left", again.process, 0))
    assert wires.got[-1].camera == "left"


def test_a_hello_that_was_kept_back_cannot_end_the_session_of_the_restarted_slave() -> None:
    """The attacker swallows a hello, lets the slave restart, and plays the hello then: it is fresh."""
    wires = Wires()
    master, left, _ = started_pair(wires)
    beacon = next(d for d, _, to in reversed(wires.seen) if to == BROADCAST)
    swallowed = wires.new_slave("left")
    swallowed.receive_beacon(beacon, MASTER, wires.clock.now_ns())
    hello = swallowed.due()[0][0]
    wires.remove(swallowed)
    live = master._senders["left"].live
    wires.carry(hello, ("6.6.6.6", 6), MASTER, keep=False)
    assert master._senders["left"].pending is None
    assert master.refused[Refusal.DUPLICATE_SENDER] == 1
    wires.run(1.5)
    assert master._senders["left"].live is live
    assert master._senders["left"].pending is None
    assert len(master._sessions) == 2
    assert left.started


def test_replayed_beacons_neither_end_nor_renew_a_session() -> None:
    wires = Wires()
    _, old_left, old_right = started_pair(wires)
    wires.new_master()
    assert wires.run(3.0, lambda: not wires.all_started())
    assert wires.run(3.0, wires.all_started)
    wires.run(2.0)
    sessions = [slave._session for slave in (old_left, old_right)]
    beacons = [d for d, _, to in wires.seen if to == BROADCAST]
    for datagram in beacons:
        wires.carry(datagram, ("6.6.6.6", 6), BROADCAST, keep=False)
        wires.step()
    assert [slave._session for slave in (old_left, old_right)] == sessions
    assert old_left.refused[Refusal.OTHER_MASTER] > 0  # those of the first life
    assert old_left.refused[Refusal.REPLAYED] > 0  # those of this one
    assert wires.all_started()


def test_a_second_master_does_not_tear_the_slaves_apart() -> None:
    wires = Wires()
    _, left, right = started_pair(wires)
    alternative = MasterLink(("left", "right"), KEY, wires.clock, BROADCAST, "", S, seeded(99))
    sessions = (left._session, right._session)
    for _ in range(100):
        for datagram, to in alternative.due():
            wires.carry(datagram, ("10.0.0.2", 1), to, keep=False)
        wires.step()
    assert (left._session, right._session) == sessions
    assert left.refused[Refusal.OTHER_MASTER] > 0


def test_a_master_that_vanishes_is_noticed_and_its_return_too() -> None:
    wires = Wires()
    master, left, _ = started_pair(wires)
    wires.master = None
    wires.run(1.9)
    assert left.started
    wires.run(0.3)
    assert not left.started
    assert wires.send(left, detections("left", left.process, 0)) is None
    wires.master = master  # the cable is back: the same life, the same session
    assert wires.run(0.5, wires.all_started)


def test_a_session_that_the_master_lost_is_made_again() -> None:
    wires = Wires()
    master, left, _ = started_pair(wires)
    session = left._session
    live = master._senders["left"].live
    assert live is not None
    del master._sessions[live.key_id]
    master._senders["left"].live = None
    assert wires.run(2.0, lambda: left._session is not session and left.started)


def test_who_speaks_for_another_camera_is_refused() -> None:
    wires = Wires()
    master, left, right = started_pair(wires)
    wires.send(left, detections("right", right.process, 0))
    assert not wires.got
    assert master.refused == {Refusal.IMPOSTOR: 1}
    wires.send(left, Command("left", "report"))
    assert master.refused[Refusal.UNDECODABLE] == 1


def test_a_camera_that_the_rig_does_not_have_gets_no_session() -> None:
    wires = Wires()
    master = wires.new_master()
    unknown_peer = wires.new_slave("third")
    wires.run(1.0)
    assert unknown_peer._session is None
    assert master.refused[Refusal.UNKNOWN] > 0
    assert not master._sessions


def test_without_the_rig_key_nothing_is_said_and_nothing_heard() -> None:
    wires = Wires()
    master = wires.new_master()
    unknown_peer = wires.new_slave("left", key=bytes(32))
    wires.run(1.0)
    assert set(unknown_peer.refused) == {Refusal.FOREIGN}
    assert all(to == BROADCAST for _, _, to in wires.seen)
    tag = RigKeys(KEY).rig_tag  # the tag is no secret: forge with it
    nonce = bytes(16)
    hello = seal(Sealer(bytes(32), tag, 5), Hello("left", 5, nonce, nonce, nonce))
    wires.carry(hello, ("6.6.6.6", 6), MASTER)
    assert master.refused == {Refusal.FORGED: 1}


def test_duplicates_and_late_frames_are_dropped_and_counted() -> None:
    wires = Wires()
    master, left, _ = started_pair(wires)
    address = next(address for address, slave in wires.slaves.items() if slave is left)
    frames = [wires.stamped(left, detections("left", left.process, seq)) for seq in range(6)]
    sealed = [left.seal(frame) for frame in frames]
    datagrams = [item[0] for item in sealed if item is not None]
    for i in (0, 1, 1, 4, 3, 0, 5):  # 2 is lost, 3 late, 1 and 0 come twice
        wires.carry(datagrams[i], address, MASTER)
    assert [message.seq for message in wires.got] == [0, 1, 4, 5]
    counts = master.counts_of("left")
    assert (counts.received, counts.lost, counts.late, counts.duplicate, counts.reordered) == (4, 1, 1, 2, 1)
    assert master.refused == {Refusal.DUPLICATE: 2}


def test_lost_on_the_way_and_never_sent_are_distinguished() -> None:
    wires = Wires()
    master, left, _ = started_pair(wires)
    process = left.process
    wires.send(left, detections("left", process, 0))
    wires.send(left, detections("left", process, 5))  # 1 to 4 never sent: no time for them
    assert left.seal(detections("left", process, 6)) is not None  # sealed, and lost on the way
    wires.send(left, detections("left", process, 7))
    counts = master.counts_of("left")
    assert (counts.received, counts.lost, counts.skipped) == (3, 1, 4)
    wires.remove(left)  # a new session forgets neither
    left = wires.new_slave("left")
    assert wires.run(1.0, lambda: left.started)
    wires.send(left, detections("left", left.process, 0))
    wires.send(left, detections("left", left.process, 2))
    counts = master.counts_of("left")
    assert (counts.received, counts.lost, counts.skipped) == (5, 1, 5)


def test_echo_and_start_out_of_order_are_fine() -> None:
    wires = Wires()
    _, left, _ = started_pair(wires)
    held: list[tuple[bytes, Address, Address]] = []
    master = wires.master
    assert master is not None
    address = next(address for address, slave in wires.slaves.items() if slave is left)
    for _ in range(6):
        wires.clock.t_ns += S // 2
        held += [(d, MASTER, to) for d, to in master.due() if to == address]
    assert len(held) >= 5
    for item in reversed(held):
        wires.carry(*item)
    answers = left.due()
    assert len(answers) == len(held)
    for datagram, to in reversed(answers):
        wires.carry(datagram, address, to)
    assert master.counts_of("left").reordered == len(held) - 1
    assert not master.refused
    assert not left.refused


def test_a_flood_of_hellos_grows_nothing() -> None:
    wires = Wires()
    master, _, _ = started_pair(wires)
    keys = RigKeys(KEY)
    sealer = keys.sealer(5)
    for i in range(2000):
        hello = keys.hello(("left", "right")[i % 2], 5, i.to_bytes(16, "big"), master._nonce)
        master.receive(seal(sealer, hello), ("6.6.6.6", 6), wires.clock.now_ns())
        master._outbox.clear()
    assert len(master._sessions) <= 4
    assert all(len(camera.old_nonces) <= 64 for camera in master._senders.values())
    assert wires.run(1.5, lambda: len(master._sessions) == 2)
    assert wires.all_started()


def test_data_that_is_not_a_message_is_refused() -> None:
    wires = Wires()
    master, left, _ = started_pair(wires)
    session = left._session
    assert session is not None
    whole = encode(detections("left", left.process, 0))
    for body in (b"", whole[:-1], whole + b"\0", b"\x91" * 3000, encode(Command("left", "x"))):
        wires.carry(session.sealer.seal(Kind.DATA, body), ("10.0.1.2", 5), MASTER)
    assert master.refused == {Refusal.UNDECODABLE: 5}
    wires.carry(session.sealer.seal(Kind.ECHO_ASK, b""), ("10.0.1.2", 5), MASTER)
    wires.carry(session.sealer.seal(Kind.ECHO_ANSWER, b"\x80"), ("10.0.1.2", 5), MASTER)
    assert master.refused == {Refusal.UNDECODABLE: 6, Refusal.UNEXPECTED: 1}


@pytest.mark.parametrize("cameras", [(), tuple(f"c{i}" for i in range(33))])
def test_a_rig_has_one_to_32_cameras(cameras: tuple[str, ...]) -> None:
    with pytest.raises(ValueError, match="expected 1 to 32"):
        Wires().new_master(cameras)


def _kind(datagram: bytes) -> Kind:
    header = parse(datagram, RigKeys(KEY).rig_tag)
    assert isinstance(header, Header)
    return header.kind


@pytest.mark.parametrize(
    ("ahead_ms", "taken"), [(-900, True), (0, True), (20, True), (45, True), (200, False), (990, False)]
)
def test_no_frame_is_of_the_future_however_the_slave_answers_echoes(ahead_ms: int, taken: bool) -> None:
    """Late answers make its clock look uncertain; that allows no times that are yet to come."""
    wires = Wires()
    master, slave = wires.new_master(("left",)), wires.new_slave("left")
    assert wires.run(4.0, wires.all_started)
    wires.run(1.0)
    stamp_ns = wires.clock.t_ns + ahead_ms * 1_000_000
    wires.send(
        slave,
        msgspec.structs.replace(detections("left", slave.process, 1), t_ns=stamp_ns, ready_t_ns=stamp_ns),
    )
    assert len(wires.got) == taken
    assert master.unsynchronised == (not taken)
    for frame in wires.got:
        assert frame.t_ns <= wires.clock.t_ns
        assert frame.t_ns == pytest.approx(min(stamp_ns, wires.clock.t_ns), abs=1_000_000)
        assert frame.t_sigma_ns >= 0.9e6 * max(ahead_ms, 0) - 1e6
