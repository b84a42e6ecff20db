"""The camera of a wrist device on the link: it sends triples and nothing else, and no other camera sends any."""

import random
from collections.abc import Iterator
from contextlib import ExitStack

import pytest

from common.clock import SkewedClock, SystemClock
from common.link.datagram import Refusal
from common.messages import Detections, ImuSample, WristDetections
from master.run.ingest import Ingest
from master.run.link import MasterLink
from slave.link import SlaveLink
from slave.uplink import Uplink
from tests.loopback.test_handshake import BROADCAST, KEY, S, Wires
from tests.loopback.test_imu_link import sample
from tests.network_helpers import PATIENCE_S, cycle, detections, free_udp_port, seeded, until


def started(wires: Wires, clock: SkewedClock | None = None) -> tuple[MasterLink, SlaveLink, SlaveLink]:
    """A master, a camera of a marker rig and that of a wrist device, both in a session and told to start."""
    master = wires.new_master(cameras=("left", "wrist"), wrists=("wrist",))
    left, wrist = wires.new_slave("left"), wires.new_slave("wrist", clock)
    assert wires.run(3.0, wires.all_started)
    wires.run(0.1)
    return master, left, wrist


def test_its_triples_come_on_the_masters_clock_with_the_uncertainty_of_the_conversion() -> None:
    wires = Wires()
    clock = SkewedClock(7 * S, 40.0, wires.clock)
    master, _, wrist = started(wires, clock)
    wires.run(3.0)
    t_ns = wires.clock.now_ns()
    wires.send(wrist, cycle("wrist", wrist.process, 1, clock.now_ns()))
    [got] = wires.got
    assert isinstance(got, WristDetections)
    assert got.t_ns == pytest.approx(t_ns, abs=2_000_000)
    assert got.ready_t_ns - got.t_ns == pytest.approx(1000, abs=2)
    estimate = master.clock_of("wrist")
    assert estimate is not None
    assert got.t_sigma_ns == pytest.approx(estimate.sigma_at(got.t_ns))
    assert not master.refused


def test_who_sends_what_another_kind_of_camera_sends_is_an_impostor() -> None:
    wires = Wires()
    master, left, wrist = started(wires)
    cases: list[tuple[SlaveLink, Detections | ImuSample]] = [
        (wrist, detections("wrist", 1, 0)),  # markers of a camera that has none
        (wrist, cycle("left", 1, 0)),
        (wrist, sample("wrist", 1, 0)),
        (left, cycle("left", 1, 0)),  # a triple of a camera without strobes
        (left, cycle("wrist", 1, 0)),
        (left, detections("wrist", 1, 0)),
    ]
    for number, (sender, message) in enumerate(cases, 1):
        wires.send(sender, message)
        assert master.refused == {Refusal.IMPOSTOR: number}, message
    assert not wires.got
    wires.send(left, detections("left", left.process, 0))  # and the true ones are heard as before
    wires.send(wrist, cycle("wrist", wrist.process, 1))
    assert [message.camera for message in wires.got] == ["left", "wrist"]
    assert master.counts_of("wrist").received == 1


def test_nothing_is_lost_where_nothing_was_though_numbers_rise_by_three() -> None:
    wires = Wires()
    master, _, wrist = started(wires)
    for k in range(50):
        wires.send(wrist, cycle("wrist", wrist.process, 3 * k + 1 + (k % 4 == 2)))
        wires.step()
    counts = master.counts_of("wrist")
    assert (counts.received, counts.lost, counts.skipped, counts.late) == (50, 0, 0, 0)


def test_triples_lost_on_the_way_and_never_sent_are_distinguished() -> None:
    wires = Wires()
    master, _, wrist = started(wires)
    for k in range(60):
        if k in (7, 8, 30):  # a frame was missing, or there was no time
            continue
        message = cycle("wrist", wrist.process, 3 * k + 1)
        if k in (20, 41, 42, 43):
            assert wrist.seal(message) is not None  # sent, and never heard of again
        else:
            wires.send(wrist, message)
    counts = master.counts_of("wrist")
    assert (counts.received, counts.lost, counts.skipped) == (53, 4, 3)


@pytest.mark.parametrize("seed", range(3))
def test_any_loss_is_accounted_for_in_cycles(seed: int) -> None:
    wires, chance = Wires(seed=seed), random.Random(seed)
    master, _, wrist = started(wires)
    kept: list[int] = []
    for k in range(200):
        message = cycle("wrist", wrist.process, 3 * k + 1)
        if chance.random() < 0.2:
            assert wrist.seal(message) is not None
        else:
            wires.send(wrist, message)
            kept.append(k)
    counts = master.counts_of("wrist")
    span = kept[-1] - kept[0] + 1
    assert counts.received == len(kept)
    assert counts.skipped == 0
    assert counts.received + counts.lost == span


def test_a_wrists_camera_is_one_of_the_cameras() -> None:
    wires = Wires()
    with pytest.raises(ValueError, match="'wrist' of a wrist device is none of the cameras"):
        MasterLink(("left",), KEY, wires.clock, BROADCAST, "", S, seeded(1), (), ("wrist",))


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


def test_cycles_come_over_real_sockets_and_none_is_lost(stack: ExitStack) -> None:
    port, clock = free_udp_port(), SystemClock()
    ingest = Ingest(
        ("wrist",), KEY, clock, ("127.255.255.255", port), ("127.0.0.1", 0), "", wrists=("wrist",)
    )
    stack.callback(ingest.close)
    wrist = Uplink("wrist", KEY, clock, port, "127.0.0.1")
    stack.callback(wrist.close)
    assert wrist.wait_for_start(PATIENCE_S)
    for k in range(30):
        wrist.send(cycle("wrist", wrist.session, 3 * k + 1, clock.now_ns()))
        assert until(lambda k=k: ingest.counts_of("wrist").received == k + 1)
    taken = [ingest.get(PATIENCE_S) for _ in range(30)]
    assert [one.seq for one in taken if isinstance(one, WristDetections)] == [3 * k + 1 for k in range(30)]
    assert ingest.lost == ingest.skipped == 0
