"""What is no frame of markers on the link: samples of an IMU, triples of a wrist device, tags, poses of a tracker.

Each comes on the master's clock, is counted by itself, and nobody says what another kind of sender says.
"""

import random
from collections.abc import Callable
from contextlib import ExitStack

import numpy as np
import pytest

from common.clock import SkewedClock, SystemClock
from common.link.datagram import Kind, Refusal, Sealer
from common.link.handshake import RigKeys
from common.messages import ImuSample, MarkerDetections, TagDetections, TrackerPose, WristDetections, encode
from common.messages.streams import sender_of
from master.run.ingest import CAPACITY, Ingest
from master.run.link import MasterLink
from slave.uplink import Uplink
from tests.loopback.test_handshake import BROADCAST, KEY, MASTER, S, Wires
from tests.network_helpers import PATIENCE_S, clock_known, cycle, detections, free_udp_port, seeded, until

SENDERS = ("left", "wrist", "palm-imu", "puck")


def sample(source: str, session: int, seq: int, t_ns: int = 0) -> ImuSample:
    quaternion = np.array([0.5, 0.5, 0.5, 0.5])
    return ImuSample(
        source, session, seq, t_ns, np.zeros(3), np.array([0, 0, 9.81]), np.full(3, np.nan), quaternion
    )


def tags(camera: str, session: int, seq: int, t_ns: int = 0, count: int = 3) -> TagDetections:
    uv = 100.0 + np.arange(8.0 * count).reshape(count, 4, 2)
    ids = np.arange(count, dtype=np.uint16)
    return TagDetections(camera, session, seq, t_ns, t_ns + 1000, ids, uv, np.full(count, 0.1), 500.0)


def tracker(source: str, session: int, seq: int, t_ns: int = 0) -> TrackerPose:
    return TrackerPose(source, session, seq, t_ns, np.array([0.1, 0.2, 1.5]), np.array([1.0, 0.0, 0.0, 0.0]))


Made = MarkerDetections | WristDetections | TagDetections | ImuSample | TrackerPose
MAKERS: dict[str, tuple[str, Callable[[str, int, int, int], Made]]] = {
    "samples": ("palm-imu", sample),
    "triples": ("wrist", cycle),
    "tags": ("left", tags),
    "poses": ("puck", tracker),
}
EACH = pytest.mark.parametrize("kind", MAKERS)


class Everybody:
    """A master, a camera, that of a wrist device, an IMU and a tracker, all in a session and told to start.

    Those that are `skewed` have a clock of their own, and the camera alone is there beside them.
    """

    def __init__(self, seed: int = 1, skewed: str = "") -> None:
        self.wires = Wires(seed=seed)
        self.clock = SkewedClock(7 * S, 40.0, self.wires.clock)
        names = ("left", skewed) if skewed else SENDERS
        cameras = tuple(name for name in ("left", "wrist") if name in names)
        self.master = self.wires.new_master(
            cameras=cameras, imus=("palm-imu",), wrists=("wrist",)[: len(cameras) - 1], trackers=("puck",)
        )
        self.slaves = {
            name: self.wires.new_slave(name, self.clock if name == skewed else None)
            for name in dict.fromkeys(names)
        }
        assert self.wires.run(3.0, self.wires.all_started)
        self.wires.run(3.0 if skewed else 0.1)

    def received(self) -> list[Made]:
        return [*self.wires.got, *self.wires.tags, *self.wires.tracked, *self.wires.samples]

    def send(self, kind: str, seq: int, t_ns: int = 0) -> None:
        name, make = MAKERS[kind]
        self.wires.send(self.slaves[name], make(name, self.slaves[name].process, seq, t_ns))

    def lose(self, message: Made) -> None:
        """Sent, and never heard of again."""
        assert self.slaves[sender_of(message)].seal(message) is not None


# -- all kinds ----------------------------------------------------------------------------------------------------


@EACH
def test_each_comes_on_the_masters_clock_with_the_uncertainty_of_the_conversion(kind: str) -> None:
    rig = Everybody(skewed=MAKERS[kind][0])
    t_ns = rig.wires.clock.now_ns()
    rig.send(kind, 4, rig.clock.now_ns())
    [got] = rig.received()
    assert got.t_ns == pytest.approx(t_ns, abs=2_000_000)
    if isinstance(got, WristDetections | TagDetections):
        estimate = rig.master.clock_of(got.camera)
        assert estimate is not None
        assert got.ready_t_ns - got.t_ns == pytest.approx(1000, abs=2)
        own_ns = 500.0 if isinstance(got, TagDetections) else 0.0
        assert got.t_sigma_ns == pytest.approx(np.hypot(own_ns, estimate.sigma_at(got.t_ns)))
    assert not rig.master.refused


@EACH
def test_late_and_repeated_ones_are_dropped_and_counted(kind: str) -> None:
    rig = Everybody()
    rig.send(kind, 5)
    again = next(d for d, _, to in reversed(rig.wires.seen) if to == MASTER)
    rig.send(kind, 3)
    rig.send(kind, 5)
    rig.wires.carry(again, ("10.0.1.9", 5), MASTER, keep=False)
    assert [one.seq for one in rig.received()] == [5]
    name = MAKERS[kind][0]
    counts, of_tags = rig.master.counts_of(name), rig.master.tag_counts_of("left")
    late = counts.late
    if kind == "tags":
        assert of_tags is not None
        assert late == 0, "no frame was"
        late = of_tags.late
    assert (late, counts.duplicate) == (2, 1)
    assert rig.master.refused == {Refusal.DUPLICATE: 1}


def test_who_sends_what_another_kind_of_sender_sends_is_an_impostor() -> None:
    rig, number = Everybody(), 0
    makers = (detections, sample, cycle, tags, tracker)
    own = {("left", detections), ("left", tags), ("wrist", cycle), ("palm-imu", sample), ("puck", tracker)}
    for sender, slave in rig.slaves.items():
        for name in (*SENDERS, "another"):
            for make in makers:
                if name == sender and (sender, make) in own:
                    continue
                rig.wires.send(slave, make(name, 1, 0))
                number += 1
                assert rig.master.refused == {Refusal.IMPOSTOR: number}, (sender, name, make)
    assert rig.received() == []
    for kind in MAKERS:  # and the true ones are heard as before
        rig.send(kind, 0)
    assert len(rig.received()) == len(MAKERS)
    assert rig.master.counts_of("wrist").received == 1


def test_mutated_and_forged_ones_are_counted_and_have_no_effect() -> None:
    rig, chance = Everybody(), random.Random(5)
    master = rig.master
    for forged, kind in enumerate(MAKERS, 1):
        name, make = MAKERS[kind]
        session, body = rig.slaves[name]._session, encode(make(name, rig.slaves[name].process, 1, 0))
        assert session is not None
        forger = Sealer(bytes(32), RigKeys(KEY).rig_tag, session.key_id)  # tag and id are no secrets
        rig.wires.carry(forger.seal(Kind.DATA, body), ("6.6.6.6", 6), MASTER, keep=False)
        assert master.refused[Refusal.FORGED] == forged
        for _ in range(500):  # sealed rightly: whoever has the session may send what he likes
            broken = bytearray(body)
            for _ in range(chance.randint(1, 3)):
                at = chance.randrange(len(broken))
                if chance.random() < 0.5:
                    broken[at] ^= 1 << chance.randrange(8)
                else:
                    del broken[at : at + chance.randint(1, 8)]
            sealed = session.sealer.seal(Kind.DATA, bytes(broken))
            rig.wires.carry(sealed, ("10.0.1.9", 5), MASTER, keep=False)
    assert set(master.refused) <= {
        *(Refusal.UNDECODABLE, Refusal.IMPOSTOR, Refusal.OUT_OF_BOUNDS, Refusal.FOREIGN_SESSION),
        *(Refusal.SEQUENCE, Refusal.READY_TIME, Refusal.FORGED),
    }
    assert sum(master.refused.values()) > 1000
    assert not master.quarantine.faults
    for seen in rig.wires.tags:  # what came through is a message, only with another number in it
        assert np.isfinite(seen.uv).all()
        assert (seen.sigma_px > 0.0).all()


@pytest.mark.parametrize("name", ["palm-imu", "puck"])
def test_nobody_waits_for_what_is_no_camera_and_it_alone_starts_nothing(name: str) -> None:
    wires = Wires()
    master = wires.new_master(cameras=("left",), timeout_s=0.5, imus=("palm-imu",), trackers=("puck",))
    alone = wires.new_slave(name)
    wires.run(2.0)
    assert alone._session is not None
    assert not master.started
    left = wires.new_slave("left")
    assert wires.run(1.0, lambda: left.started and alone.started)
    later = wires.new_slave("puck" if name == "palm-imu" else "palm-imu")
    assert wires.run(1.0, lambda: later.started)
    stranger = wires.new_slave("another-puck")
    wires.run(0.5)
    assert stranger._session is None
    assert master.refused[Refusal.UNKNOWN] > 0


@pytest.mark.parametrize(
    ("cameras", "imus", "wrists", "trackers", "expected"),
    [
        (("left",), ("left",), (), (), "'left' is a camera and an IMU"),
        (("left",), (), (), ("left",), "'left' is a camera and a tracker"),
        (("left",), ("puck",), (), ("puck",), "'puck' is an IMU and a tracker"),
        (("left",), (), ("wrist",), (), "'wrist' of a wrist device is none of the cameras"),
        (tuple(f"c{k}" for k in range(32)), ("imu",), (), (), "33 cameras, IMUs and trackers"),
    ],
)
def test_one_name_is_not_for_two(
    cameras: tuple[str, ...],
    imus: tuple[str, ...],
    wrists: tuple[str, ...],
    trackers: tuple[str, ...],
    expected: str,
) -> None:
    with pytest.raises(ValueError, match=expected):
        MasterLink(cameras, KEY, Wires().clock, BROADCAST, "", S, seeded(1), imus, wrists, trackers)


# -- triples, whose numbers rise by three -------------------------------------------------------------------------


def test_nothing_is_lost_where_nothing_was_though_numbers_rise_by_three() -> None:
    rig = Everybody()
    for k in range(50):
        rig.send("triples", 3 * k + 1 + (k % 4 == 2))
        rig.wires.step()
    counts = rig.master.counts_of("wrist")
    assert (counts.received, counts.lost, counts.skipped, counts.late) == (50, 0, 0, 0)


def test_triples_lost_on_the_way_and_never_sent_are_distinguished() -> None:
    rig = Everybody()
    for k in range(60):
        if k in (7, 8, 30):  # a frame was missing, or there was no time
            continue
        if k in (20, 41, 42, 43):
            rig.lose(cycle("wrist", rig.slaves["wrist"].process, 3 * k + 1))
        else:
            rig.send("triples", 3 * k + 1)
    counts = rig.master.counts_of("wrist")
    assert (counts.received, counts.lost, counts.skipped) == (53, 4, 3)


# -- tags, a second kind of message of a camera -------------------------------------------------------------------


def test_frames_that_were_not_searched_for_tags_are_neither_lost_nor_skipped() -> None:
    rig = Everybody()
    for seq in range(60):
        rig.wires.send(rig.slaves["left"], detections("left", rig.slaves["left"].process, seq))
        if seq % 7 == 3:
            rig.send("tags", seq)
    counts, of_tags = rig.master.counts_of("left"), rig.master.tag_counts_of("left")
    assert (counts.received, counts.lost, counts.skipped, counts.late) == (60, 0, 0, 0)
    assert of_tags is not None
    assert (of_tags.received, of_tags.lost, of_tags.late) == (9, 0, 0)
    assert not rig.master.refused


def test_a_lost_tag_is_no_lost_frame_where_the_camera_skipped_one() -> None:
    rig = Everybody()
    process = rig.slaves["left"].process
    for seq in range(100):
        if seq in (20, 60, 61):  # never sent
            continue
        if seq in (40, 80):
            rig.lose(detections("left", process, seq))
        else:
            rig.wires.send(rig.slaves["left"], detections("left", process, seq))
        if seq % 10 == 5:  # all tags are lost
            rig.lose(tags("left", process, seq))
    counts = rig.master.counts_of("left")
    assert (counts.received, counts.lost, counts.skipped) == (95, 2, 3)


@pytest.mark.parametrize("seed", range(3))
def test_any_order_and_loss_of_both_kinds_is_accounted_for(seed: int) -> None:
    rig, chance = Everybody(seed), random.Random(seed)
    left, master = rig.slaves["left"], rig.master
    address = next(address for address, slave in rig.wires.slaves.items() if slave is left)
    frames = set[int]()
    waiting: list[tuple[float, int | None, bytes]] = []
    for seq in range(400):
        if chance.random() < 0.05 and seq > 0:
            continue  # the camera had no time
        for message in (detections("left", left.process, seq), tags("left", left.process, seq)):
            sealed = left.seal(message)
            assert sealed is not None
            late = 3.0 if chance.random() < 0.1 else 0.0  # overtaken by what comes in three frames
            number = seq if isinstance(message, MarkerDetections) else None
            if number == 0 or number == 399:
                late = 0.0
            elif chance.random() < 0.1:
                continue
            waiting.append((seq + late, number, sealed[0]))
    for _, number, datagram in sorted(waiting, key=lambda one: one[0]):
        rig.wires.carry(datagram, address, MASTER, keep=False)
        if number is not None:
            frames.add(number)
    counts, of_tags = master.counts_of("left"), master.tag_counts_of("left")
    assert of_tags is not None
    span = 400 if 399 in frames else max(frames) + 1
    assert counts.received + counts.late == len(frames)
    assert counts.received + counts.late + counts.lost + counts.skipped == span
    # A frame that was never sent counts as lost only where a tag beside it was lost as well.
    never = 0.05 * span
    assert abs(counts.skipped - never) < 4 * never**0.5 + 0.35 * never
    assert of_tags.received + of_tags.late == len(waiting) - len(frames)
    assert of_tags.lost == 0


def test_more_tags_than_a_frame_may_have_are_refused_whoever_seals_them() -> None:
    rig = Everybody()
    left, refused = rig.slaves["left"], rig.master.refused
    session = left._session
    assert session is not None

    def carry(body: bytes, more: bytes = b"") -> None:
        rig.wires.carry(session.sealer.seal(Kind.DATA, body) + more, ("10.0.1.1", 5), MASTER, keep=False)

    carry(encode(rig.wires.stamped(left, tags("left", left.process, 0, count=16))))
    assert len(rig.wires.tags) == 1
    source = tags("left", left.process, 1, count=1)
    for count in (17, 40):  # by hand: the type itself refuses to be made
        broken = encode(source)
        for old, new in (
            (source.ids, np.arange(count, dtype="<u2")),
            (source.uv, np.ones(8 * count)),
            (source.sigma_px, np.ones(count)),
        ):
            broken = broken.replace(_bin(old.tobytes()), _bin(new.tobytes()))
        carry(broken)
    assert refused == {Refusal.UNDECODABLE: 2}
    carry(bytes(4052), bytes(100))
    assert refused[Refusal.OVERSIZED] == 1


def _bin(raw: bytes) -> bytes:
    """As msgpack writes it."""
    head = b"\xc4" + bytes([len(raw)]) if len(raw) < 256 else b"\xc5" + len(raw).to_bytes(2, "big")
    return head + raw


# -- real sockets -------------------------------------------------------------------------------------------------


def test_all_come_over_real_sockets_and_are_counted() -> None:
    port, clock, skewed, count = free_udp_port(), SystemClock(), SkewedClock(3 * S, 20.0), 30
    with ExitStack() as stack:
        ingest = Ingest(
            ("left", "wrist"), KEY, clock, ("127.255.255.255", port), ("127.0.0.1", 0), "",
            imus=("palm-imu",), wrists=("wrist",), trackers=("puck",),
        )  # fmt: skip
        stack.callback(ingest.close)
        clocks = {name: skewed if name == "palm-imu" else clock for name in SENDERS}
        ends = {name: Uplink(name, KEY, clocks[name], port, "127.0.0.1") for name in SENDERS}
        for end in ends.values():
            stack.callback(end.close)
        assert all(end.wait_for_start(PATIENCE_S) for end in ends.values())
        assert "left.tags_received" not in ingest.counts, "what never came is not told"
        assert clock_known(ingest, "palm-imu")
        sent: dict[int, int] = {}
        got: list[Made] = []
        for k in range(count):
            sent[k] = clock.now_ns()
            for name, make in (("left", detections), *MAKERS.values()):
                seq = 3 * k + 1 if name == "wrist" else k
                ends[name].send(make(name, ends[name].session, seq, clocks[name].now_ns()))
            names = [f"{name}.received" for name in SENDERS] + ["left.tags_received"]
            assert until(lambda k=k, names=names: all(ingest.counts.get(one) == k + 1 for one in names))
            while (message := ingest.get(0.0)) is not None:
                got.append(message)
        assert until(lambda: ingest.connected == set(SENDERS))
        assert ingest.lost == ingest.skipped == ingest.counts["left.tags_late"] == 0
    assert len(got) == 5 * count
    assert [one.seq for one in got if isinstance(one, WristDetections)] == [3 * k + 1 for k in range(count)]
    off_ns = [one.t_ns - sent[one.seq] for one in got if isinstance(one, ImuSample)]
    assert max(map(abs, off_ns)) < 20_000_000  # clocks are 3 s apart


def test_at_overload_each_kind_of_message_keeps_its_newest() -> None:
    with ExitStack() as stack:
        ingest = Ingest(
            ("left",), KEY, SystemClock(), ("127.255.255.255", 9), ("127.0.0.1", 0), "", trackers=("puck",)
        )
        stack.callback(ingest.close)
        count = CAPACITY["tracker"] + 5
        for seq in range(count):
            for message in (detections("left", 1, seq), tags("left", 1, seq), tracker("puck", 1, seq)):
                ingest.queue.put([message])
        taken = [ingest.get(0.0) for _ in range(sum(CAPACITY[kind] for kind in ("frame", "tags", "tracker")))]
        for kind, room in ((MarkerDetections, "frame"), (TagDetections, "tags"), (TrackerPose, "tracker")):
            newest = list(range(count - CAPACITY[room], count))
            assert [one.seq for one in taken if isinstance(one, kind)] == newest, kind
        assert ingest.get(0.0) is None
        assert ingest.counts["queue.dropped"] == 3 * count - len(taken)
