import threading
from typing import cast

import numpy as np
import pytest
from msgspec.structs import replace

from common.clock import SystemClock
from common.errors import BusError, CameraError
from common.messages import Command, Health, MarkerDetections
from slave.markers.detector import MarkerDetector
from slave.report import ALONE_AT, DetectionCounters, Reporter
from slave.sender import MarkerPipeline, run, wait_for_start
from slave.sources import Frame
from slave.uplink import Uplink
from tests.memory_bus import LoopbackBus
from tests.slave.painted import CENTRES, NAMES, camera, hand, render
from tests.slave.stand_ins import Listed, Wire

DETECTOR = MarkerDetector(camera(), NAMES)
HAND, EMPTY = render(hand()), render([])


def frame(seq: int, image: np.ndarray) -> Frame:
    return Frame(seq, 16_000_000 * seq, 16_000_000 * seq + 5, image)


def test_the_scatter_of_a_stamp_travels_with_it() -> None:
    wire = Wire(MarkerDetections)
    source = Listed([replace(frame(3, HAND), t_sigma_ns=1.2e6), frame(4, HAND)])
    run(
        source,
        MarkerPipeline("left", wire.session, wire.send, DETECTOR.fresh().push, DetectionCounters(NAMES)),
        threading.Event(),
    )
    assert [m.t_sigma_ns for m in wire.sent] == [1.2e6, 0.0]


def test_every_frame_is_sent_with_its_times_the_empty_ones_too() -> None:
    wire, counters = Wire(MarkerDetections), DetectionCounters(NAMES)
    source = Listed([frame(3, HAND), frame(4, EMPTY), frame(7, HAND)])
    run(
        source,
        MarkerPipeline("left", wire.session, wire.send, DETECTOR.fresh().push, counters),
        threading.Event(),
    )
    assert [(m.camera, m.session, m.seq, m.t_ns, m.ready_t_ns) for m in wire.sent] == [
        ("left", 77, 3, 48_000_000, 48_000_005),
        ("left", 77, 4, 64_000_000, 64_000_005),
        ("left", 77, 7, 112_000_000, 112_000_005),
    ]
    np.testing.assert_allclose(wire.sent[0].uv, CENTRES + np.array([300.0, 200.0]), atol=0.3)
    assert np.isnan(wire.sent[1].uv).all()
    assert (wire.sent[0].sigma_px > 0.0).all()
    assert np.isnan(wire.sent[1].sigma_px).all()
    counts = counters.counts()
    assert (counts["frames"], counts["dropped"], counts["empty"], counts["seen.back"]) == (3, 2, 1, 2)


def test_the_loop_ends_when_stopped_and_passes_a_lost_camera_on() -> None:
    wire, stop = Wire(MarkerDetections), threading.Event()
    stop.set()
    run(
        Listed([frame(0, HAND)]),
        MarkerPipeline("left", wire.session, wire.send, DETECTOR.fresh().push, DetectionCounters(NAMES)),
        stop,
    )
    assert wire.sent == []
    with pytest.raises(CameraError, match="unplugged"):
        run(
            Listed([CameraError("unplugged")]),
            MarkerPipeline("left", wire.session, wire.send, DETECTOR.fresh().push, DetectionCounters(NAMES)),
            threading.Event(),
        )


def test_the_barrier_opens_with_the_start_and_with_stop() -> None:
    stop = threading.Event()
    assert wait_for_start(Wire(MarkerDetections, waits=2).wait_for_start, stop)
    stop.set()
    assert not wait_for_start(Wire(MarkerDetections, waits=2).wait_for_start, stop)


def test_gauges_speak_of_the_time_since_the_last_look() -> None:
    counters = DetectionCounters(NAMES)
    for seq in range(4):
        counters.frame(seq, 2_000_000 + seq, CENTRES)
    first = counters.metrics()
    assert first["rate_hz"] > 0.0
    assert first["detect_us"] == pytest.approx(2000.0, rel=0.01)
    assert first["detect_worst_us"] == pytest.approx(2000.003)
    second = counters.metrics()
    assert second["rate_hz"] == 0.0
    assert second["detect_worst_us"] == 0.0


def test_health_is_published_and_commands_are_answered_once_the_bus_is_known() -> None:
    hub, wire, counters, stop = (
        LoopbackBus(),
        Wire(MarkerDetections),
        DetectionCounters(NAMES),
        threading.Event(),
    )
    counters.frame(0, 1_000_000, CENTRES)
    asked: list[str] = []

    def connect(endpoint: str) -> LoopbackBus:
        asked.append(endpoint)
        return hub.join()

    listener = hub.subscribe("health")
    reporter = Reporter("left", cast(Uplink, wire), counters, SystemClock(), connect, stop.set, period_s=0.01)
    try:
        assert listener.get(0.05) is None  # no endpoint, no bus
        wire.zenoh_endpoint = "tcp/127.0.0.1:1"
        health = listener.get(60.0)
        assert isinstance(health, Health)
        assert (health.source, health.session) == ("left", 77)
        assert (health.counts["frames"], health.counts["sent"]) == (1, 3)
        assert "left" in hub.alive()
        assert hub.ask(Command("left", "report"), 5.0).counts["frames"] == 1
        with pytest.raises(BusError, match="there are report, stop"):
            hub.ask(Command("left", "dance"), 5.0)
        assert not stop.is_set()
        hub.ask(Command("left", "stop"), 5.0)
        assert stop.is_set()
        wire.zenoh_endpoint = "tcp/127.0.0.1:2"  # another master took over
        while len(asked) < 2:
            assert listener.get(60.0) is not None
    finally:
        reporter.close()
    assert asked == ["tcp/127.0.0.1:1", "tcp/127.0.0.1:2"]
    assert "left" not in hub.alive()


def test_a_bus_that_cannot_be_opened_is_tried_again_and_never_ends_the_slave() -> None:
    hub, wire = LoopbackBus(), Wire(MarkerDetections, "tcp/127.0.0.1:1")
    tries: list[str] = []

    def connect(endpoint: str) -> LoopbackBus:
        tries.append(endpoint)
        if len(tries) < 3:
            raise BusError("refused")
        return hub.join()

    listener = hub.subscribe("health")
    reporter = Reporter(
        "left",
        cast(Uplink, wire),
        DetectionCounters(NAMES),
        SystemClock(),
        connect,
        lambda: None,
        period_s=0.01,
    )
    try:
        assert isinstance(listener.get(60.0), Health)
        assert len(tries) == 3
    finally:
        reporter.close()


@pytest.mark.parametrize(
    ("counts", "output"),
    [
        ({"sent": 0}, "no master received yet"),
        ({"refused.foreign": 5}, "of another rig key"),
        ({"refused.version": 5}, "of another version"),
        ({"refused.secret": 5}, "not with the secret of this device"),
        ({"refused.duplicate_sender": 5}, "somebody of this name"),
    ],
)
def test_a_slave_without_a_master_says_what_it_hears(
    counts: dict[str, int], output: str, caplog: pytest.LogCaptureFixture
) -> None:
    wire = Wire(MarkerDetections)
    wire.counts = counts
    looked = threading.Event()
    reporter = Reporter(
        "left",
        cast(Uplink, wire),
        Seen(looked),
        SystemClock(),
        lambda _: LoopbackBus(),
        lambda: None,
        period_s=0.01,
    )
    try:
        assert looked.wait(60.0)
    finally:
        reporter.close()
    assert output in caplog.text


class Seen(DetectionCounters):
    """Figures that tell when they have been read often enough for the slave to have spoken."""

    def __init__(self, looked: threading.Event) -> None:
        super().__init__(NAMES)
        self._looked, self._left = looked, ALONE_AT + 2

    def metrics(self) -> dict[str, float]:
        self._left -= 1
        if self._left == 0:
            self._looked.set()
        return super().metrics()
