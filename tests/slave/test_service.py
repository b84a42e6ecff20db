"""What a slave tells the service manager: the datagrams of sd_notify, and when the watchdog is fed, and when not."""

import os
import socket
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from common.messages import Message
from slave.markers.detector import Detections
from slave.report import DetectionCounters
from slave.sender import MarkerPipeline, run, wait_for_start
from slave.service import LOST_PATIENCE_S, WAITING, Service
from slave.sources import Frame

PERIOD_US = 4_000_000
QUARTER_NS = 1_000_000_000


@dataclass
class Time:
    now_ns: int = 0

    def __call__(self) -> int:
        return self.now_ns

    def passes(self, seconds: float) -> None:
        self.now_ns += round(seconds * 1e9)


class Manager:
    """The other end: a socket as systemd has it. Takes what has arrived."""

    def __init__(self, address: str) -> None:
        self.address = address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind("\0" + address[1:] if address[0] == "@" else address)
        self._socket.setblocking(False)

    def received(self) -> list[list[str]]:
        found: list[list[str]] = []
        try:
            while True:
                found.append(self._socket.recv(4096).decode().split("\n"))
        except BlockingIOError:
            return found

    def environment(self, watchdog_us: int | None = PERIOD_US) -> dict[str, str]:
        environment = {"NOTIFY_SOCKET": self.address}
        return environment if watchdog_us is None else environment | {"WATCHDOG_USEC": str(watchdog_us)}

    def close(self) -> None:
        self._socket.close()


@pytest.fixture(params=["path", "abstract"])
def manager(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Manager]:
    address = str(tmp_path / "notify") if request.param == "path" else f"@phalanx-test-{os.getpid()}"
    made = Manager(address)
    yield made
    made.close()


def begun(manager: Manager, time: Time, **more: str) -> Service:
    service = Service(manager.environment() | more, time)
    service.ready(lambda: True)
    assert manager.received() == [["READY=1", f"STATUS={WAITING}", "WATCHDOG=1"]]
    return service


def test_a_loop_that_comes_round_feeds_once_in_a_quarter_of_the_period(manager: Manager) -> None:
    time = Time()
    service = begun(manager, time)
    received: list[list[str]] = []
    for _ in range(20 * 90):  # 20 s at 90 Hz
        time.passes(1.0 / 90.0)
        service.working()
        received += manager.received()
    assert 18 <= len(received) <= 20
    assert all("WATCHDOG=1" in one for one in received)
    assert received[-1][0] == "STATUS=90 frames/s"


def test_a_loop_that_hangs_says_nothing_whatever_else_lives(manager: Manager) -> None:
    time = Time()
    begun(manager, time)
    time.passes(100.0)
    assert manager.received() == []


def test_waiting_for_the_master_is_no_hang(manager: Manager) -> None:
    time = Time()
    service = begun(manager, time)
    for _ in range(50):
        time.passes(0.2)
        service.waiting()
    received = manager.received()
    assert 8 <= len(received) <= 10
    assert set(map(tuple, received)) == {(f"STATUS={WAITING}", "WATCHDOG=1")}


def test_a_lost_camera_has_more_time_and_the_first_frame_ends_it(manager: Manager) -> None:
    time = Time()
    service = begun(manager, time)
    service.connection_lost("camera lost: no frame\nfor 2 s")
    patience = f"WATCHDOG_USEC={round(LOST_PATIENCE_S * 1e6)}"
    assert manager.received() == [["STATUS=camera lost: no frame for 2 s", patience, "WATCHDOG=1"]]
    time.passes(80.0)
    service.working()
    assert manager.received() == [["STATUS=frames come", f"WATCHDOG_USEC={PERIOD_US}", "WATCHDOG=1"]]
    time.passes(2.0)
    service.working()
    assert "WATCHDOG_USEC" not in str(manager.received())


def test_before_it_is_ready_a_slow_opening_asks_for_time_to_start(manager: Manager) -> None:
    service = Service(manager.environment(), Time())
    service.connection_lost("opens the camera, in step with others", 150.0)
    status = "STATUS=opens the camera, in step with others: may take 150 s"  # read by slave/install/systemd
    assert manager.received() == [[status, "EXTEND_TIMEOUT_USEC=150000000"]]


def test_it_says_that_nobody_takes_what_it_sends_and_how_it_ended(manager: Manager) -> None:
    time = Time()
    service = Service(manager.environment(None), time, noun="samples")  # a unit without a watchdog
    service.ready(lambda: False)
    for _ in range(601):
        time.passes(0.01)
        service.working()
    service.stopping()
    service.failed("no such IMU")
    ready, status, stopping, failed = manager.received()
    assert ready == ["READY=1", f"STATUS={WAITING}"]
    assert status == ["STATUS=100 samples/s, but the master is away"]
    assert stopping[0] == "STOPPING=1"
    assert failed == ["STATUS=failed: no such IMU"]


def test_the_watchdog_of_another_process_is_not_fed(manager: Manager) -> None:
    service = Service(manager.environment() | {"WATCHDOG_PID": str(os.getpid() + 1)}, Time())
    service.ready(lambda: True)
    assert manager.received() == [["READY=1", f"STATUS={WAITING}"]]


@pytest.mark.parametrize("environment", [{}, {"NOTIFY_SOCKET": ""}, {"NOTIFY_SOCKET": "vsock:2:1"}])
def test_on_a_terminal_nothing_is_reported(environment: dict[str, str]) -> None:
    time = Time()
    service = Service(environment | {"WATCHDOG_USEC": "1000"}, time)
    service.ready(lambda: True)
    for _ in range(10):
        time.passes(60.0)
        service.working()
        service.waiting()
        service.connection_lost("camera lost")
    service.stopping()


def test_a_manager_that_is_gone_stops_no_slave(tmp_path: Path) -> None:
    time = Time()
    service = Service({"NOTIFY_SOCKET": str(tmp_path / "nobody"), "WATCHDOG_USEC": "4000000"}, time)
    service.ready(lambda: True)
    time.passes(2.0)
    service.working()


class Frames:
    """A camera of a few frames, after which it does something else."""

    def __init__(self, count: int, then: Callable[[], Frame | None]) -> None:
        self._left, self._then = count, then

    def read(self) -> Frame | None:
        if self._left == 0:
            return self._then()
        self._left -= 1
        return Frame(self._left, 0, 0, np.zeros((4, 4, 3), np.uint8))

    def close(self) -> None: ...


class Nowhere:
    session = 7

    def send(self, message: Message) -> None: ...


class Null:
    """Finds nothing, and hangs after so many frames, until it is let go."""

    def __init__(self, hang_after: int, released: threading.Event) -> None:
        self._left, self._released = hang_after, released
        self.hangs = threading.Event()

    def push(self, image: np.ndarray, t_ns: int) -> Detections:
        if self._left == 0:
            self.hangs.set()
            self._released.wait(30.0)
        self._left -= 1
        nothing = np.full(1, np.nan)
        return Detections(
            *[
                np.full((1, 2), np.nan),
                *[nothing] * 3,
                np.full((1, 2), np.nan),
                nothing,
                np.full((1, 3), np.nan),
            ]
        )


def test_a_detection_that_hangs_feeds_nothing(manager: Manager) -> None:
    time, stop, released = Time(), threading.Event(), threading.Event()
    service = begun(manager, time)
    detector = Null(5, released)

    def alive() -> None:
        time.passes(1.5)
        service.working()

    wire, counters = Nowhere(), DetectionCounters(("index",))
    pipeline = MarkerPipeline("left", wire.session, wire.send, detector.push, counters)
    loop = threading.Thread(target=run, args=(Frames(10, lambda: None), pipeline, stop, alive))
    loop.start()
    try:
        assert detector.hangs.wait(30.0)
        assert len(manager.received()) == 5  # each of the frames before
        time.passes(60.0)
        assert manager.received() == []
    finally:
        stop.set()
        released.set()
        loop.join(30.0)
    assert not loop.is_alive()


class Never:
    """A master that does not come."""

    def __init__(self, stop: threading.Event, polls: int) -> None:
        self._stop, self._left = stop, polls

    def wait_for_start(self, timeout_s: float) -> bool:
        self._left -= 1
        if self._left == 0:
            self._stop.set()
        return False


def test_the_wait_for_the_master_comes_round(manager: Manager) -> None:
    time, stop = Time(), threading.Event()
    service = begun(manager, time)

    def alive() -> None:
        time.passes(0.2)
        service.waiting()

    assert not wait_for_start(Never(stop, 50).wait_for_start, stop, alive)
    assert len(manager.received()) >= 8
