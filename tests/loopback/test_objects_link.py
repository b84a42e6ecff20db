"""Tags and trackers on the link: a second kind of message of a camera, and a sender that nobody waits for."""

import random
import time
from collections.abc import Iterator
from contextlib import ExitStack

import numpy as np
import pytest

from common.clock import SkewedClock, SystemClock
from common.link.datagram import Kind, Refusal, Sealer
from common.link.handshake import RigKeys
from common.messages import ImuSample, MarkerDetections, TagDetections, TrackerPose, encode
from master.run.ingest import CAPACITY, Ingest
from master.run.link import MasterLink
from slave.link import SlaveLink
from slave.uplink import Uplink
from tests.loopback.test_handshake import BROADCAST, KEY, MASTER, S, Wires
from tests.loopback.test_imu_link import sample
from tests.network_helpers import PATIENCE_S, cycle, detections, free_udp_port, seeded, until


def tags(camera: str, session: int, seq: int, t_ns: int = 0, count: int = 3) -> TagDetections:
    uv = 100.0 + np.arange(8.0 * count).reshape(count, 4, 2)
    ids = np.arange(count, dtype=np.uint16)
    return TagDetections(camera, session, seq, t_ns, t_ns + 1000, ids, uv, np.full(count, 0.1), 500.0)


def tracker(source: str, session: int, seq: int, t_ns: int = 0) -> TrackerPose:
    return TrackerPose(source, session, seq, t_ns, np.array([0.1, 0.2, 1.5]), np.array([1.0, 0.0, 0.0, 0.0]))


def started(wires: Wires) -> tuple[MasterLink, SlaveLink, SlaveLink, SlaveLink]:
    """A master with a camera, the camera of a wrist device and a tracker, all in a session and told to start."""
    master = wires.new_master(cameras=("left", "wrist"), wrists=("wrist",), trackers=("puck",))
    left, wrist, puck = (wires.new_slave(name) for name in ("left", "wrist", "puck"))
    assert wires.run(3.0, wires.all_started)
    wires.run(0.1)
    return master, left, wrist, puck


def test_tags_and_poses_come_on_the_masters_clock() -> None:
    wires = Wires()
    master = wires.new_master(cameras=("left",), trackers=("puck",))
    clock = SkewedClock(7 * S, 40.0, wires.clock)
    left, puck = wires.new_slave("left", clock), wires.new_slave("puck", clock)
    assert wires.run(3.0, wires.all_started)
    wires.run(3.0)
    t_ns = wires.clock.now_ns()
    wires.send(left, tags("left", left.process, 4, clock.now_ns()))
    wires.send(puck, tracker("puck", puck.process, 9, clock.now_ns()))
    [seen], [tracked] = wires.tags, wires.tracked
    assert seen.t_ns == pytest.approx(t_ns, abs=2_000_000)
    assert tracked.t_ns == pytest.approx(t_ns, abs=2_000_000)
    assert seen.ready_t_ns - seen.t_ns == pytest.approx(1000, abs=2)
    estimate = master.clock_of("left")
    assert estimate is not None
    assert seen.t_sigma_ns == pytest.approx(np.hypot(500.0, estimate.sigma_at(seen.t_ns)))
    np.testing.assert_array_equal(seen.ids, [0, 1, 2])
    assert not master.refused


def test_frames_that_were_not_searched_for_tags_are_neither_lost_nor_skipped() -> None:
    wires = Wires()
    master, left, _, _ = started(wires)
    for seq in range(60):
        wires.send(left, detections("left", left.process, seq))
        if seq % 7 == 3:
            wires.send(left, tags("left", left.process, seq))
    counts, of_tags = master.counts_of("left"), master.tag_counts_of("left")
    assert (counts.received, counts.lost, counts.skipped, counts.late) == (60, 0, 0, 0)
    assert of_tags is not None
    assert (of_tags.received, of_tags.lost, of_tags.late) == (9, 0, 0)
    assert not master.refused


def test_a_lost_tag_is_no_lost_frame_where_the_camera_skipped_one() -> None:
    wires = Wires()
    master, left, _, _ = started(wires)
    for seq in range(100):
        if seq in (20, 60, 61):  # never sent
            continue
        message = detections("left", left.process, seq)
        if seq in (40, 80):  # sent, never come
            assert left.seal(message) is not None
        else:
            wires.send(left, message)
        if seq % 10 == 5:  # all tags are lost
            assert left.seal(tags("left", left.process, seq)) is not None
    counts = master.counts_of("left")
    assert (counts.received, counts.lost, counts.skipped) == (95, 2, 3)


@pytest.mark.parametrize("seed", range(3))
def test_any_order_and_loss_of_both_kinds_is_accounted_for(seed: int) -> None:
    wires, chance = Wires(seed=seed), random.Random(seed)
    master, left, _, _ = started(wires)
    address = next(address for address, slave in wires.slaves.items() if slave is left)
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
        wires.carry(datagram, address, MASTER, keep=False)
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


def test_late_and_repeated_ones_are_dropped_and_counted() -> None:
    wires = Wires()
    master, left, _, puck = started(wires)
    for slave, make, got in ((left, tags, wires.tags), (puck, tracker, wires.tracked)):
        name = "left" if slave is left else "puck"
        wires.send(slave, make(name, slave.process, 5))
        again = next(d for d, _, to in reversed(wires.seen) if to == MASTER)
        wires.send(slave, make(name, slave.process, 3))
        wires.send(slave, make(name, slave.process, 5))
        wires.carry(again, ("10.0.1.9", 5), MASTER, keep=False)
        assert [one.seq for one in got] == [5]
        assert master.counts_of(name).duplicate == 1
    of_tags = master.tag_counts_of("left")
    assert of_tags is not None
    assert of_tags.late == master.counts_of("puck").late == 2
    assert master.counts_of("left").late == 0
    assert master.refused == {Refusal.DUPLICATE: 2}


def test_who_sends_what_another_kind_of_sender_sends_is_an_impostor() -> None:
    wires = Wires()
    master, left, wrist, puck = started(wires)
    cases: list[tuple[SlaveLink, MarkerDetections | TagDetections | TrackerPose | ImuSample]] = [
        (left, tags("right", 1, 0)),  # in the name of another camera
        (left, tracker("left", 1, 0)),
        (left, tracker("puck", 1, 0)),
        (wrist, tags("wrist", 1, 0)),  # the camera of a wrist device sees no tags
        (puck, tags("left", 1, 0)),
        (puck, tags("puck", 1, 0)),
        (puck, detections("puck", 1, 0)),
        (puck, sample("puck", 1, 0)),
        (puck, tracker("another", 1, 0)),
    ]
    for number, (sender, message) in enumerate(cases, 1):
        wires.send(sender, message)
        assert master.refused == {Refusal.IMPOSTOR: number}, message
    assert [*wires.got, *wires.tags, *wires.tracked, *wires.samples] == []
    wires.send(left, tags("left", left.process, 0))
    wires.send(wrist, cycle("wrist", wrist.process, 1))
    wires.send(puck, tracker("puck", puck.process, 0))
    assert len(wires.got) == len(wires.tags) == len(wires.tracked) == 1, "the true ones are heard as before"


def test_forged_ones_are_refused() -> None:
    wires = Wires()
    master, left, _, puck = started(wires)
    for slave, message in ((left, tags("left", 1, 9)), (puck, tracker("puck", 1, 9))):
        session = slave._session
        assert session is not None
        forger = Sealer(bytes(32), RigKeys(KEY).rig_tag, session.key_id)  # tag and id are no secrets
        wires.carry(forger.seal(Kind.DATA, encode(message)), ("6.6.6.6", 6), MASTER, keep=False)
    assert master.refused == {Refusal.FORGED: 2}
    assert not wires.tags
    assert not wires.tracked


def test_more_tags_than_a_frame_may_have_are_refused_whoever_seals_them() -> None:
    wires = Wires()
    master, left, _, _ = started(wires)
    session = left._session
    assert session is not None
    whole = encode(wires.stamped(left, tags("left", left.process, 0, count=16)))
    wires.carry(session.sealer.seal(Kind.DATA, whole), ("10.0.1.1", 5), MASTER, keep=False)
    assert len(wires.tags) == 1
    one = encode(tags("left", left.process, 1, count=1))
    for count in (17, 40):  # by hand: the type itself refuses to be made
        ids, uv, sigma = np.arange(count, dtype="<u2"), np.ones(8 * count), np.ones(count)
        source = tags("left", left.process, 1, count=1)
        broken = one
        for old, new in (
            (source.ids.tobytes(), ids.tobytes()),
            (source.uv.tobytes(), uv.tobytes()),
            (source.sigma_px.tobytes(), sigma.tobytes()),
        ):
            broken = broken.replace(_bin(old), _bin(new))
        wires.carry(session.sealer.seal(Kind.DATA, broken), ("10.0.1.1", 5), MASTER, keep=False)
    assert master.refused == {Refusal.UNDECODABLE: 2}
    long = session.sealer.seal(Kind.DATA, bytes(4052))
    wires.carry(long + bytes(100), ("10.0.1.1", 5), MASTER, keep=False)
    assert master.refused[Refusal.OVERSIZED] == 1


def _bin(raw: bytes) -> bytes:
    """As msgpack writes it."""
    head = b"\xc4" + bytes([len(raw)]) if len(raw) < 256 else b"\xc5" + len(raw).to_bytes(2, "big")
    return head + raw


def test_mutated_ones_are_counted_and_have_no_effect() -> None:
    wires, chance = Wires(), random.Random(5)
    master, left, _, puck = started(wires)
    for slave, message in ((left, tags("left", left.process, 1)), (puck, tracker("puck", puck.process, 1))):
        session, body = slave._session, encode(message)
        assert session is not None
        for _ in range(1500):  # sealed rightly: whoever has the session may send what he likes
            broken = bytearray(body)
            for _ in range(chance.randint(1, 3)):
                at = chance.randrange(len(broken))
                if chance.random() < 0.5:
                    broken[at] ^= 1 << chance.randrange(8)
                else:
                    del broken[at : at + chance.randint(1, 8)]
            wires.carry(session.sealer.seal(Kind.DATA, bytes(broken)), ("10.0.1.9", 5), MASTER, keep=False)
    assert set(master.refused) <= {
        *(Refusal.UNDECODABLE, Refusal.IMPOSTOR, Refusal.OUT_OF_BOUNDS, Refusal.FOREIGN_SESSION),
        *(Refusal.SEQUENCE, Refusal.READY_TIME),
    }
    assert sum(master.refused.values()) > 1500
    assert not master.quarantine.faults
    for seen in wires.tags:  # what came through is a message, only with another number in it
        assert np.isfinite(seen.uv).all()
        assert (seen.sigma_px > 0.0).all()


def test_nobody_waits_for_a_tracker_and_it_alone_starts_nothing() -> None:
    wires = Wires()
    master = wires.new_master(cameras=("left",), timeout_s=0.5, trackers=("puck",))
    puck = wires.new_slave("puck")
    wires.run(2.0)
    assert puck._session is not None
    assert not master.started
    left = wires.new_slave("left")
    assert wires.run(1.0, lambda: left.started and puck.started)
    late = wires.new_slave("another-puck")
    wires.run(0.5)
    assert late._session is None
    assert master.refused[Refusal.UNKNOWN] > 0


def test_one_name_is_not_for_two() -> None:
    wires = Wires()
    for imus, trackers, expected in (
        ((), ("left",), "'left' is a camera and a tracker"),
        (("puck",), ("puck",), "'puck' is an IMU and a tracker"),
    ):
        with pytest.raises(ValueError, match=expected):
            MasterLink(("left",), KEY, wires.clock, BROADCAST, "", S, seeded(1), imus, (), trackers)


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


def test_both_come_over_real_sockets_and_are_counted(stack: ExitStack) -> None:
    port, clock = free_udp_port(), SystemClock()
    ingest = Ingest(
        ("left",), KEY, clock, ("127.255.255.255", port), ("127.0.0.1", 0), "", trackers=("puck",)
    )
    stack.callback(ingest.close)
    ends = {name: Uplink(name, KEY, clock, port, "127.0.0.1") for name in ("left", "puck")}
    for end in ends.values():
        stack.callback(end.close)
        assert end.wait_for_start(PATIENCE_S)
    assert "left.tags_received" not in ingest.counts, "what never came is not told"
    for seq in range(20):
        for name, make in (("left", detections), ("left", tags), ("puck", tracker)):
            ends[name].send(make(name, ends[name].session, seq, clock.now_ns()))
        time.sleep(0.005)
    assert until(lambda: ingest.counts["puck.received"] == ingest.counts["left.received"] == 20)
    assert until(lambda: ingest.counts.get("left.tags_received") == 20)
    assert until(lambda: ingest.connected == {"left", "puck"})
    assert ingest.lost == ingest.skipped == ingest.counts["left.tags_late"] == 0


def test_at_overload_each_kind_of_message_keeps_its_newest(stack: ExitStack) -> None:
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
