"""Pictures go out while somebody looks, ten a second and small; nobody looking costs nothing; a slow bus waits."""

import threading
from itertools import pairwise
from typing import cast

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.arrays import Image
from common.errors import BusError
from common.messages import (
    MAX_PREVIEW_BYTES,
    MAX_STILL_BYTES,
    Command,
    MarkerDetections,
    Message,
    Preview,
    Still,
)
from slave import preview
from slave.markers.detector import MarkerDetector
from slave.preview import PERIOD_NS, POLL_NS, Gate, Previews, small_jpeg, whole_jpeg
from slave.report import DetectionCounters, Reporter
from slave.sender import MarkerPipeline, run
from slave.sources import Frame
from slave.uplink import Uplink
from tests.memory_bus import LoopbackBus
from tests.network_helpers import ManualClock, until
from tests.slave.painted import NAMES, camera, hand, render
from tests.slave.stand_ins import Listed, Wire

STEP_NS = 16_666_667
IMAGE = np.full((480, 640, 3), 80, np.uint8)


@given(st.lists(st.integers(0, 20 * 10**9), min_size=1), st.lists(st.integers(0, 20 * 10**9)))
def test_never_two_within_a_tenth_of_a_second_and_none_without_a_request(
    frames: list[int], requests: list[int]
) -> None:
    gate = Gate()
    shown: list[int] = []
    events = sorted([(t, 0) for t in requests] + [(t, 1) for t in frames])
    for t_ns, is_frame in events:
        if not is_frame:
            gate.ask(t_ns)
        elif gate.wants(t_ns):
            shown.append(t_ns)
    assert all(later - earlier >= PERIOD_NS for earlier, later in pairwise(shown))
    assert all(any(0 <= t - asked <= POLL_NS for asked in requests) for t in shown)


def test_one_request_is_three_seconds_of_pictures() -> None:
    gate = Gate()
    frames = range(0, 10 * 10**9, STEP_NS)
    assert not any(gate.wants(t) for t in frames)
    gate.ask(10 * 10**9)
    shown = [t for t in range(10 * 10**9, 20 * 10**9, STEP_NS) if gate.wants(t)]
    assert 25 <= len(shown) <= 31
    assert shown[-1] <= 13 * 10**9


def test_when_nobody_looks_nothing_is_encoded(monkeypatch: pytest.MonkeyPatch) -> None:
    encoded: list[Image] = []

    def counted(image: Image) -> bytes:
        encoded.append(image)
        return small_jpeg(image)

    monkeypatch.setattr(preview, "small_jpeg", counted)
    bus, clock = LoopbackBus(), ManualClock(10**9)
    feed = bus.subscribe("preview")
    shown = Previews("left", clock)
    try:
        shown.use(bus)
        for i in range(120):
            shown.offer(Frame(i, i * STEP_NS, i * STEP_NS, IMAGE))
        assert feed.get(0.1) is None
        assert encoded == []
        shown.ask()
        shown.offer(Frame(0, 10**9, 10**9, IMAGE))
        assert isinstance(feed.get(60.0), Preview)  # the very same object does encode once asked
        assert len(encoded) == 1
    finally:
        shown.close()


def test_a_request_over_the_bus_shows_the_newest_frames_until_it_expires() -> None:
    bus, clock, wire = LoopbackBus(), ManualClock(10**9), Wire(MarkerDetections)
    feed = bus.subscribe("preview", "left", depth=100)
    shown = Previews("left", clock)
    reporter = Reporter(
        "left",
        cast(Uplink, wire),
        DetectionCounters(NAMES),
        clock,
        lambda _: bus.join(),
        lambda: None,
        period_s=0.005,
        previews=shown,
    )
    try:
        wire.zenoh_endpoint = "tcp/127.0.0.1:1"
        assert until(lambda: "left" in bus.alive())
        with pytest.raises(BusError, match="there are report, stop, preview"):
            bus.ask(Command("left", "dance"), 1.0)
        bus.ask(Command("left", "preview"), 1.0)
        got: list[Preview] = []
        for i in range(360):  # six seconds at 60 Hz
            clock.t_ns = 10**9 + i * STEP_NS
            before = shown.published
            shown.offer(Frame(i, clock.t_ns, clock.t_ns, IMAGE))
            if i % 7 == 0 and clock.t_ns <= 4 * 10**9:
                assert until(lambda before=before: shown.published == before + 1)
                picture = feed.get(1.0)
                assert isinstance(picture, Preview)
                got.append(picture)
        assert feed.get(0.05) is None
        assert len(got) == shown.published == 26  # every seventh frame: 117 ms apart
        assert got[-1].t_ns <= 4 * 10**9
        image = cv2.imdecode(np.frombuffer(got[0].jpeg, np.uint8), cv2.IMREAD_COLOR)
        assert image is not None
        assert image.shape == (240, 320, 3)
    finally:
        reporter.close()
        shown.close()


class SlowBus(LoopbackBus):
    """Publishing takes until it is released."""

    def __init__(self) -> None:
        super().__init__()
        self.entered = threading.Event()
        self.release = threading.Event()

    def publish(self, stream: str, name: str, message: Message) -> None:
        self.entered.set()
        self.release.wait(20.0)
        super().publish(stream, name, message)


def test_a_slow_bus_never_holds_the_loop_and_the_newest_frame_comes_next() -> None:
    bus, clock = SlowBus(), ManualClock(0)
    feed = bus.subscribe("preview")
    shown = Previews("left", clock)
    picture = render(hand())
    wire, counters = Wire(MarkerDetections), DetectionCounters(NAMES)
    try:
        shown.use(bus)
        shown.ask()
        shown.offer(Frame(0, 0, 0, IMAGE))
        assert bus.entered.wait(60.0)
        # The loop runs to its end while the bus holds the first picture.
        source = Listed([Frame(i, i * 5 * STEP_NS, i * 5 * STEP_NS, picture) for i in range(1, 13)])
        run(
            source,
            MarkerPipeline(
                "left", wire.session, wire.send, MarkerDetector(camera(), NAMES).push, counters, shown.offer
            ),
            threading.Event(),
        )
        assert len(wire.sent) == 12
        assert shown.published == 0
        bus.release.set()
        times = [message.t_ns for message in (feed.get(60.0), feed.get(60.0)) if isinstance(message, Preview)]
        assert times == [0, 12 * 5 * STEP_NS]  # frames 2, 4, ... 12 were wanted and replaced each other
        assert feed.get(0.05) is None
    finally:
        bus.release.set()
        shown.close()


def test_a_bus_that_is_gone_or_closed_is_no_matter() -> None:
    clock = ManualClock(0)
    shown = Previews("left", clock)
    try:
        closed = LoopbackBus()
        closed.close()
        bus = LoopbackBus()
        feed = bus.subscribe("preview")
        shown.ask()
        for i, end in enumerate((None, closed, bus)):
            shown.use(end)
            shown.offer(Frame(i, i * 10**9, i * 10**9, IMAGE))
            if end is not bus:
                assert feed.get(0.05) is None
        picture = feed.get(60.0)
        assert isinstance(picture, Preview)
        assert picture.t_ns == 2 * 10**9
    finally:
        shown.close()


@pytest.mark.parametrize("shape", [(480, 640, 3), (480, 640), (1, 1, 3), (3, 5)])
def test_half_the_size_in_colour_and_grey(shape: tuple[int, ...]) -> None:
    data = small_jpeg(np.full(shape, 120, np.uint8))
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert image is not None
    assert image.shape[:2] == (max(shape[0] // 2, 1), max(shape[1] // 2, 1))
    assert abs(int(image.mean()) - 120) <= 1


def test_a_picture_too_large_for_the_wire_gets_smaller_still() -> None:
    noise = np.random.default_rng(7).integers(0, 256, (3000, 4000), np.uint8)
    assert len(small_jpeg(noise)) <= MAX_PREVIEW_BYTES


def test_a_still_is_the_next_frame_whole_and_only_one() -> None:
    bus, clock = LoopbackBus(), ManualClock()
    shown = Previews("left", clock)
    feed = bus.subscribe("still")
    shown.use(bus)
    rng = np.random.default_rng(3)
    noise = rng.integers(0, 256, (480, 640, 3), np.uint8)
    image = np.asarray(cv2.GaussianBlur(noise, (0, 0), 3.0), np.uint8)
    try:
        shown.offer(Frame(1, 1, 1, IMAGE))
        shown.ask_still()
        for seq in range(2, 6):
            shown.offer(Frame(seq, seq, seq, image))
        message = feed.get(60.0)
        assert isinstance(message, Still)
        assert (message.camera, message.seq, message.t_ns) == ("left", 2, 2)
        back = cv2.imdecode(np.frombuffer(message.jpeg, np.uint8), cv2.IMREAD_COLOR)
        assert back is not None
        assert back.shape == image.shape
        assert np.abs(back.astype(float) - image).mean() < 2.0
        assert feed.get(0.2) is None
    finally:
        shown.close()


def test_a_still_of_any_size_fits_into_a_message() -> None:
    noise = np.random.default_rng(4).integers(0, 256, (1088, 1456, 3), np.uint8)
    for image in (noise, IMAGE):
        data = whole_jpeg(image)
        assert data is not None
        assert len(data) <= MAX_STILL_BYTES
        assert cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) is not None


def test_a_still_too_large_for_a_message_is_reported_and_the_next_one_goes_out(
    caplog: pytest.LogCaptureFixture,
) -> None:
    noise = np.random.default_rng(4).integers(0, 256, (3000, 4000, 3), np.uint8)
    assert whole_jpeg(noise) is None
    bus = LoopbackBus()
    feed = bus.subscribe("still")
    shown = Previews("left", ManualClock(10**9))
    try:
        shown.use(bus)
        shown.ask_still()
        shown.offer(Frame(0, 10**9, 10**9, noise))
        assert until(lambda: "4000 x 3000 px does not fit" in caplog.text)
        shown.ask_still()
        shown.offer(Frame(1, 10**9, 10**9, IMAGE))
        still = feed.get(60.0)
        assert isinstance(still, Still)
        assert still.seq == 1
    finally:
        shown.close()
