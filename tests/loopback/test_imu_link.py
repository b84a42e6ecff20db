"""An IMU on the link: a sender of its own that nobody waits for, and that can speak for nobody else."""

import time
from collections.abc import Iterator
from contextlib import ExitStack

import numpy as np
import pytest

from common.clock import SkewedClock, SystemClock
from common.link.datagram import Refusal
from common.messages import ImuSample, MarkerDetections
from master.run.ingest import Ingest
from master.run.link import MasterLink
from slave.link import SlaveLink
from slave.uplink import Uplink
from tests.loopback.test_handshake import BROADCAST, KEY, MASTER, S, Wires
from tests.network_helpers import PATIENCE_S, clock_known, detections, free_udp_port, seeded, until


def sample(source: str, session: int, seq: int, t_ns: int = 0) -> ImuSample:
    quaternion = np.array([0.5, 0.5, 0.5, 0.5])
    return ImuSample(
        source, session, seq, t_ns, np.zeros(3), np.array([0, 0, 9.81]), np.full(3, np.nan), quaternion
    )


def started(wires: Wires) -> tuple[MasterLink, SlaveLink, SlaveLink]:
    """A master, its one camera and its IMU, both in a session and told to start."""
    master = wires.new_master(cameras=("left",), imus=("palm-imu",))
    left, imu = wires.new_slave("left"), wires.new_slave("palm-imu")
    assert wires.run(3.0, wires.all_started)
    return master, left, imu


def test_its_samples_come_on_the_masters_clock() -> None:
    wires = Wires()
    master = wires.new_master(cameras=("left",), imus=("palm-imu",))
    wires.new_slave("left")
    clock = SkewedClock(7 * S, 40.0, wires.clock)
    imu = wires.new_slave("palm-imu", clock)
    assert wires.run(3.0, wires.all_started)
    wires.run(3.0)
    t_ns = wires.clock.now_ns()
    wires.send(imu, sample("palm-imu", imu.process, 0, clock.now_ns()))
    assert [one.source for one in wires.samples] == ["palm-imu"]
    assert wires.samples[0].t_ns == pytest.approx(t_ns, abs=2_000_000)
    assert master.counts_of("palm-imu").received == 1
    assert not wires.got


def test_nobody_waits_for_it_and_it_may_come_later() -> None:
    wires = Wires()
    master = wires.new_master(cameras=("left",), imus=("palm-imu",))
    left = wires.new_slave("left")
    assert wires.run(1.0, lambda: left.started)  # and not after the timeout of five seconds
    imu = wires.new_slave("palm-imu")
    assert wires.run(1.0, lambda: imu.started)
    assert master.connected() == {"left", "palm-imu"}


def test_it_alone_starts_nothing() -> None:
    wires = Wires()
    master = wires.new_master(cameras=("left",), timeout_s=0.5, imus=("palm-imu",))
    imu = wires.new_slave("palm-imu")
    wires.run(2.0)
    assert imu._session is not None
    assert not master.started


def test_who_speaks_for_another_kind_of_sender_is_refused() -> None:
    wires = Wires()
    master, left, imu = started(wires)
    cases: list[tuple[SlaveLink, ImuSample | MarkerDetections]] = [
        (left, sample("palm-imu", 1, 0)),  # a camera in the name of the IMU
        (left, sample("left", 1, 0)),  # or as if it were one
        (imu, detections("left", 1, 0)),  # an IMU in the name of a camera
        (imu, detections("palm-imu", 1, 0)),
        (imu, sample("other", 1, 0)),
    ]
    for number, (sender, message) in enumerate(cases, 1):
        wires.send(sender, message)
        assert master.refused == {Refusal.IMPOSTOR: number}, message
    assert not wires.samples
    assert not wires.got


def test_late_and_repeated_samples_are_dropped_and_counted() -> None:
    wires = Wires()
    master, _, imu = started(wires)
    wires.send(imu, sample("palm-imu", imu.process, 5))
    again = next(d for d, _, to in reversed(wires.seen) if to == MASTER)
    wires.send(imu, sample("palm-imu", imu.process, 3))
    wires.send(imu, sample("palm-imu", imu.process, 5))
    wires.carry(again, ("10.0.1.9", 5), MASTER, keep=False)
    assert [one.seq for one in wires.samples] == [5]
    assert master.counts_of("palm-imu").late == 2
    assert master.counts_of("palm-imu").duplicate == 1
    assert master.refused == {Refusal.DUPLICATE: 1}


def test_one_name_is_not_for_two() -> None:
    wires = Wires()
    with pytest.raises(ValueError, match="'left' is a camera and an IMU"):
        MasterLink(("left",), KEY, wires.clock, BROADCAST, "", S, seeded(1), ("left",))
    names = tuple(f"c{k}" for k in range(32))
    with pytest.raises(ValueError, match="33 cameras, IMUs and trackers"):
        MasterLink(names, KEY, wires.clock, BROADCAST, "", S, seeded(1), ("imu",))


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


def test_samples_come_over_real_sockets(stack: ExitStack) -> None:
    port, clock = free_udp_port(), SystemClock()
    ingest = Ingest(
        ("left",), KEY, clock, ("127.255.255.255", port), ("127.0.0.1", 0), "", imus=("palm-imu",)
    )
    stack.callback(ingest.close)
    skewed = SkewedClock(3 * S, 20.0)
    senders = {"left": Uplink("left", KEY, clock, port, "127.0.0.1")}
    senders["palm-imu"] = Uplink("palm-imu", KEY, skewed, port, "127.0.0.1")
    for sender in senders.values():
        stack.callback(sender.close)
        assert sender.wait_for_start(PATIENCE_S)
    assert clock_known(ingest, "palm-imu")
    sent: dict[int, int] = {}
    for seq in range(40):
        sent[seq] = clock.now_ns()
        senders["palm-imu"].send(sample("palm-imu", senders["palm-imu"].session, seq, skewed.now_ns()))
        senders["left"].send(detections("left", senders["left"].session, seq, clock.now_ns()))
        time.sleep(0.005)
    assert until(lambda: ingest.counts["palm-imu.received"] == ingest.counts["left.received"] == 40)
    assert until(lambda: ingest.connected == {"left", "palm-imu"})
    got: list[ImuSample] = []
    frames = 0
    while (message := ingest.get(0.0)) is not None:
        if isinstance(message, ImuSample):
            got.append(message)
        else:
            frames += 1
    assert len(got) + frames == 80 - ingest.counts["queue.dropped"]
    assert max(abs(one.t_ns - sent[one.seq]) for one in got) < 20_000_000  # clocks are 3 s apart
    assert ingest.lost == 0
