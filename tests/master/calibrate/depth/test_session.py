"""A live sweep without hardware: simulated slaves over real datagrams, a person played by a script."""

import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

from common.arrays import Float
from common.clock import SystemClock
from common.errors import FitError
from common.messages import ImuSample, MarkerDetections
from master.calibrate.depth.session import Meter, guide, read
from master.calibrate.depth.sweep import Sweep, checked, read_table, write_table
from master.calibrate.session import Person, Session, share_of
from master.fabrik.depth import AffineDisparity
from master.run.ingest import Ingest
from slave.uplink import Uplink
from tests.network_helpers import ManualClock, free_udp_port

KEY = bytes(range(32))
CAMERAS = ("left", "right")
RIG = AffineDisparity(37.3, 2.64)
INDEX = 1
STEPS = np.array([1.0, 0.8, 0.6, 0.5, 0.4, 0.3, 0.25, 0.2])


def sees(camera: str, session: int, seq: int, t_ns: int, uv: Float | None) -> MarkerDetections:
    """A frame with the target at `uv` (2,), or without it."""
    nan = np.full((6, 2), np.nan)
    at, area = nan.copy(), nan[:, 0].copy()
    if uv is not None:
        at[INDEX], area[INDEX] = uv, 900.0
    one = area / 900.0
    return MarkerDetections(camera, session, seq, t_ns, t_ns, at, area, one, 0.06 * one, nan)


def target(distance: float, camera: str) -> Float:
    half = 0.5 * float(RIG.disparity(np.array(distance)))
    return np.array([319.5 + (half if camera == "left" else -half), 239.5])


def fed(meter: Meter, uv: dict[str, Float], rate_hz: float = 60.0) -> tuple[Sweep | None, int]:
    """Push frames (T, 2) of each camera in turn; the reading, and the frame it came with."""
    for i in range(len(uv["left"])):
        for camera in CAMERAS:
            at = None if np.isnan(uv[camera][i, 0]) else uv[camera][i]
            reading = meter.push(sees(camera, 1, i, round(i * 1e9 / rate_hz), at))
            if reading is not None:
                return reading, i
    return None, len(uv["left"])


def still(frames: int, noise: float = 0.06, seed: int = 3) -> dict[str, Float]:
    rng = np.random.default_rng(seed)
    return {camera: target(0.5, camera) + rng.normal(0.0, noise, (frames, 2)) for camera in CAMERAS}


def test_a_target_at_rest_is_averaged_over_a_second() -> None:
    meter = Meter(CAMERAS, INDEX, 30, 1.0)
    reading, frame = fed(meter, still(200))
    assert reading is not None
    assert frame == 60
    assert reading.disparity_px[0] == pytest.approx(RIG.disparity(np.array(0.5)), abs=0.05)
    assert reading.sigma_px[0] == pytest.approx(0.06 * 2**0.5, rel=0.4)
    assert meter.rates_hz == pytest.approx([60.0, 60.0], rel=1e-6)


def test_a_slow_camera_gives_enough_frames_too() -> None:
    reading, frame = fed(Meter(CAMERAS, INDEX, 30, 1.0), still(200), rate_hz=10.0)
    assert reading is not None
    assert frame == 29  # three seconds


@pytest.mark.parametrize("way", ["drifts", "shakes"])
def test_a_moving_target_is_refused_until_it_stands(way: str) -> None:
    uv = still(400)
    t = np.arange(150)
    moved = 0.01 * (150 - t) if way == "drifts" else 1.5 * np.sin(2.0 * t)
    for camera in CAMERAS:
        uv[camera][:150, 0] += moved
    meter = Meter(CAMERAS, INDEX, 30, 1.0)
    reading, frame = fed(meter, {camera: uv[camera][:150] for camera in CAMERAS})
    assert reading is None
    assert "moves" in meter.trouble
    reading, frame = fed(Meter(CAMERAS, INDEX, 30, 1.0), uv)
    assert reading is not None
    assert frame > 170
    assert reading.disparity_px[0] == pytest.approx(RIG.disparity(np.array(0.5)), abs=0.05)


def test_a_target_outside_one_image_is_reported_with_the_camera() -> None:
    uv = still(100)
    uv["right"][:] = np.nan
    meter = Meter(CAMERAS, INDEX, 30, 1.0)
    assert fed(meter, uv)[0] is None
    assert "'right' does not see the target" in meter.trouble
    assert meter.progress == 0.0


def test_frames_of_other_cameras_are_not_ours() -> None:
    assert Meter(CAMERAS, INDEX, 8, 1.0).push(sees("top", 1, 0, 0, np.zeros(2))) is None


class Queue:
    """A source that gives what it holds, and lets the clock run meanwhile."""

    def __init__(self, clock: ManualClock, messages: Sequence[MarkerDetections | ImuSample]) -> None:
        self.clock, self.messages = clock, deque(messages)

    def get(self, timeout_s: float) -> MarkerDetections | ImuSample | None:
        if timeout_s == 0.0:
            return None
        self.clock.t_ns += round(timeout_s * 1e9)
        return self.messages.popleft() if self.messages else None


def test_nobody_sends_and_the_reason_is_reported() -> None:
    clock = ManualClock()
    with pytest.raises(FitError, match="no frames from left and right"):
        read(Session(Queue(clock, []).get, clock=clock), Meter(CAMERAS, INDEX, 8, 1.0))
    assert clock.t_ns >= 10_000_000_000


def test_samples_of_an_imu_between_the_frames_are_passed_over() -> None:
    clock, uv, zero = ManualClock(), still(100), np.zeros(3)
    messages: list[MarkerDetections | ImuSample] = []
    for i in range(100):
        t_ns = round((1 + i) * 1e8)
        messages.append(ImuSample("palm-imu", 1, i, t_ns, zero, zero, zero, np.eye(4)[0]))
        messages += [sees(camera, 1, i, t_ns, uv[camera][i]) for camera in CAMERAS]
    reading = read(Session(Queue(clock, messages).get, clock=clock), Meter(CAMERAS, INDEX, 30, 1.0))
    assert (reading.frames >= 30).all()


class Desk:
    """Two slaves that send 100 frames a second, of a target wherever it stands; a hand that moves it."""

    def __init__(self, stack: ExitStack) -> None:
        port = free_udp_port()
        self.clock = SystemClock()
        self.ingest = Ingest(CAMERAS, KEY, self.clock, ("127.255.255.255", port), ("127.0.0.1", 0), "")
        stack.callback(self.ingest.close)
        self.uplinks = {name: Uplink(name, KEY, self.clock, port, "127.0.0.1") for name in CAMERAS}
        for uplink in self.uplinks.values():
            stack.callback(uplink.close)
        self.at: dict[str, Float | None] = {camera: target(1.0, camera) for camera in CAMERAS}
        self.stop = threading.Event()
        thread = threading.Thread(target=self._send, daemon=True)
        thread.start()
        stack.callback(thread.join)
        stack.callback(self.stop.set)

    def _send(self) -> None:
        rng = np.random.default_rng(5)
        for uplink in self.uplinks.values():
            uplink.wait_for_start(60.0)
        seq = 0
        while not self.stop.is_set():
            for name, uplink in self.uplinks.items():
                at = self.at[name]
                noisy = None if at is None else at + rng.normal(0.0, 0.05, 2)
                uplink.send(sees(name, uplink.session, seq, self.clock.now_ns(), noisy))
            seq += 1
            time.sleep(0.01)

    def put(self, distance: float) -> None:
        self.at = {camera: target(distance, camera) for camera in CAMERAS}


@pytest.fixture
def desk() -> Iterator[Desk]:
    with ExitStack() as stack:
        yield Desk(stack)


def test_a_whole_session_over_the_wire(desk: Desk, tmp_path: Path) -> None:
    lines: list[str] = []
    asked: list[str] = []
    truth = deque(STEPS.tolist())

    def ask(prompt: str) -> str | None:
        asked.append(prompt)
        if len(asked) == 2:
            return "about here"  # not understood, asked again
        if len(asked) == 4:
            desk.put(0.55)  # not at 0.6 m, and says so
            truth.popleft()
            return "0.55"
        if not truth:
            return None
        desk.put(truth.popleft())
        return ""

    def keep(sweep: Sweep) -> None:
        write_table(tmp_path / "kept.csv", sweep)

    session = Session(desk.ingest.get, Person(lines.append, ask), desk.clock)
    sweep = guide(session, lambda: Meter(CAMERAS, INDEX, 10, 0.2), STEPS.tolist(), keep)
    assert share_of(lines[-1:]) == 1.0
    assert share_of(lines[:1]) == 1 / 8
    assert sweep.distance_m.tolist() == [1.0, 0.8, 0.55, 0.5, 0.4, 0.3, 0.25, 0.2]
    assert sweep.disparity_px == pytest.approx(RIG.disparity(sweep.distance_m), abs=0.1)
    assert (sweep.frames >= 10).all()
    assert "neither a distance" in lines[1]
    assert "cameras: left" in lines[0]
    assert "Hz" in lines[0]
    assert checked(sweep, CAMERAS).size == 8
    assert read_table(tmp_path / "kept.csv").disparity_px == pytest.approx(sweep.disparity_px, abs=1e-3)


def test_skipping_and_ending(desk: Desk) -> None:
    answers = deque(["s", "", "q"])
    person = Person(lambda line: None, lambda prompt: answers.popleft() if answers else None)
    session = Session(desk.ingest.get, person, desk.clock)

    def led(distances: list[float]) -> Sweep:
        return guide(session, lambda: Meter(CAMERAS, INDEX, 10, 0.2), distances, lambda sweep: None)

    assert led([0.7, 1.0, 0.5, 0.4]).distance_m.tolist() == [1.0]
    assert led([1.0]).size == 0
