"""The link over real UDP: through a bad network, and through deaths of either side."""

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack

import pytest

from common.clock import Clock, SkewedClock, SystemClock
from common.link.clock_offset import ClockEstimate
from common.messages import MarkerDetections
from master.run.ingest import Ingest
from slave.uplink import Uplink
from tests.faults.relay import Impairment, UdpRelay
from tests.network_helpers import PATIENCE_S, detections, free_udp_port, until

KEY = bytes(range(32))
BROADCAST = "127.255.255.255"
# Clocks are 5 s apart; microseconds are asserted in simulated time (test_clock). Where no echo came back sooner than
# this, a time may be off by as much as the master says it may be.
CLOCK_NS = 20_000_000
WITHIN = 3.0  # of what a time is said to be good to; half a round trip is 1.7
QUIET_S = 0.5
BAD = Impairment(loss=0.2, delay_s=0.002, jitter_s=0.004, reorder=0.05, duplicate=0.05)


class Rig:
    """Two slaves with clocks of their own, and a master, all on loopback."""

    def __init__(self, stack: ExitStack) -> None:
        self.stack = stack
        self.port = free_udp_port()
        self.beacon = (BROADCAST, self.port)
        self.clocks: dict[str, Clock] = {
            "left": SystemClock(),
            "right": SkewedClock(5_000_000_000, 50.0),
        }
        self.seq = {"left": 0, "right": 0}

    def through(self, impairment: Impairment, seed: int) -> UdpRelay:
        relay = UdpRelay(self.port, seed, impairment)
        self.stack.callback(relay.close)
        self.beacon = relay.beacon
        return relay

    def master(self) -> Ingest:
        ingest = Ingest(
            ("left", "right"), KEY, SystemClock(), self.beacon, ("127.0.0.1", 0), "tcp/127.0.0.1:1"
        )
        self.stack.callback(ingest.close)
        return ingest

    def slave(self, name: str) -> Uplink:
        uplink = Uplink(name, KEY, self.clocks[name], self.port, "127.0.0.1")
        self.stack.callback(uplink.close)
        self.seq[name] = 0
        return uplink

    def send(self, name: str, uplink: Uplink) -> int:
        """Send one frame taken now; return now on the master's clock."""
        clock = self.clocks[name]
        t_ns = clock.now_ns()
        uplink.send(detections(name, uplink.session, self.seq[name], t_ns))
        self.seq[name] += 1
        return clock.to_true(t_ns) if isinstance(clock, SkewedClock) else t_ns


@pytest.fixture
def rig() -> Iterator[Rig]:
    with ExitStack() as stack:
        yield Rig(stack)


def drain(ingest: Ingest, wait_s: float) -> list[MarkerDetections]:
    messages: list[MarkerDetections] = []
    while (message := ingest.get(wait_s)) is not None:
        assert isinstance(message, MarkerDetections)
        messages.append(message)
    return messages


def stream(
    rig: Rig, slaves: dict[str, Uplink], ingest: Ingest, seconds: float, whole: bool = False
) -> tuple[dict[str, int], list[float]]:
    """Send 100 frames/s from both; return how many came from each, and the errors of their times in CLOCK_NS.

    With `whole` nothing is lost: wait for all; else until nothing has come for some time.
    """
    sent: dict[tuple[str, int, int], int] = {}
    received: list[MarkerDetections] = []
    for _ in range(round(seconds * 100)):
        for name, uplink in slaves.items():
            seq = rig.seq[name]
            sent[(name, uplink.session, seq)] = rig.send(name, uplink)
        time.sleep(0.01)
        received += drain(ingest, 0.0)
    if whole:
        until(lambda: bool(received.extend(drain(ingest, 0.0))) or len(received) >= len(sent))
    received += drain(ingest, QUIET_S)
    errors = [
        abs(message.t_ns - sent[(message.camera, message.session, message.seq)])
        / max(CLOCK_NS, WITHIN * message.t_sigma_ns)
        for message in received
    ]
    return {name: sum(message.camera == name for message in received) for name in slaves}, errors


def all_started(slaves: dict[str, Uplink]) -> Callable[[], bool]:
    return lambda: all(uplink.started for uplink in slaves.values())


def test_a_clean_network_loses_nothing(rig: Rig) -> None:
    slaves = {name: rig.slave(name) for name in ("left", "right")}
    assert not slaves["left"].wait_for_start(0.05)  # no master yet
    ingest = rig.master()
    assert all(uplink.wait_for_start(PATIENCE_S) for uplink in slaves.values())
    assert until(lambda: ingest.connected == {"left", "right"})
    assert slaves["left"].zenoh_endpoint == "tcp/127.0.0.1:1"
    got, errors = stream(rig, slaves, ingest, 0.5, whole=True)
    assert got == {"left": 50, "right": 50}
    assert max(errors) < 1.0
    last, estimate = between_echoes(rig, slaves["right"], ingest)
    assert last.t_sigma_ns == pytest.approx(estimate.sigma_at(last.t_ns), rel=1e-6)  # their stamps are exact
    assert ingest.counts["right.clock_steps"] == 0
    assert ingest.lost == 0
    assert not ingest.refused
    assert slaves["left"].counts["sent"] == 50


def between_echoes(rig: Rig, uplink: Uplink, ingest: Ingest) -> tuple[MarkerDetections, ClockEstimate]:
    """A frame of the right camera, and by what clock its time was moved: none was measured meanwhile."""
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        before = ingest.clock_of("right")
        rig.send("right", uplink)
        message = ingest.get(PATIENCE_S)
        assert isinstance(message, MarkerDetections)
        if before is not None and before == ingest.clock_of("right"):
            return message, before
    raise AssertionError("the clock was measured at every frame")


def test_twenty_percent_loss_jitter_duplicates_and_reordering(rig: Rig) -> None:
    relay = rig.through(BAD, seed=3)
    slaves = {name: rig.slave(name) for name in ("left", "right")}
    ingest = rig.master()
    assert all(uplink.wait_for_start(PATIENCE_S) for uplink in slaves.values())
    got, errors = stream(rig, slaves, ingest, 3.0)
    assert relay.lost > 100
    assert (
        sum(got.values())
        == sum(ingest.counts_of(name).received for name in got) - ingest.counts["queue.dropped"]
    )
    for name, uplink in slaves.items():
        counts = ingest.counts_of(name)
        assert 120 < got[name] < 280  # 80 % of 300 arrive, some of them late
        assert counts.late > 0
        assert counts.duplicate > 0
        assert counts.reordered >= counts.late
        assert counts.lost > 20
        # All that was sent between the first and the last that came is accounted for.
        assert abs(counts.received + counts.lost + counts.late - uplink.counts["sent"]) < 20
    estimate = ingest.clock_of("right")
    assert estimate is not None
    assert max(errors) < 1.0
    assert set(ingest.refused) <= {"duplicate", "replayed", "stale"}
