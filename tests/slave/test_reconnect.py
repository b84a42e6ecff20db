"""A device that is unplugged and comes back: cameras, IMUs and trackers alike, on a clock of the test."""

import logging
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import pytest

from common.clock import Clock
from common.errors import CameraError, ImuError, PhalanxError, TrackerChoiceError, TrackerError
from common.messages import ImuSample, TrackerPose
from slave import sources
from slave.reconnect import ReconnectingCamera, ReconnectingDriver, ReconnectingTracker
from slave.sources import LOG_EVERY_NS, Frame, Reporting
from tests.slave.stand_ins import camera_file

CALIBRATION = camera_file(width_px=16, height_px=16, frame_rate_hz=50.0, row_time_us=30.0)
PERIOD_NS = 20_000_000
DEVICES = ("camera", "IMU", "tracker")
Item = Frame | ImuSample | TrackerPose
Driver = ReconnectingCamera | ReconnectingDriver[ImuSample] | ReconnectingTracker


@dataclass
class Bench(Clock):
    """Time, and the device that is or is not there. `lives`: items until each driver loses it; empty: for ever."""

    error: type[Exception] = CameraError
    t_ns: int = 0
    plugged: bool = True
    back_at_ns: int | None = None
    opened: int = 0
    closed: int = 0
    waits: list[float] = field(default_factory=list[float])
    lives: list[int] = field(default_factory=list[int])
    lost: list[str] = field(default_factory=list[str])
    told: Callable[[], None] = lambda: None

    def now_ns(self) -> int:
        return self.t_ns

    def wait(self, seconds: float) -> None:
        self.waits.append(seconds)
        self.t_ns += round(seconds * 1e9)
        if self.back_at_ns is not None and self.t_ns >= self.back_at_ns:
            self.plugged = True

    def connection_lost(self, what: str, patience_s: float = 0.0) -> None:
        self.lost.append(what)
        self.told()

    def life(self) -> int:
        if not self.plugged:
            raise self.error("no such device")
        self.opened += 1
        return self.lives.pop(0) if self.lives else 10**6

    def unplug(self, seconds: float) -> None:
        self.plugged, self.back_at_ns = False, self.t_ns + round(seconds * 1e9)


class Stop(threading.Event):
    """The slave's stop event, on the time of the bench."""

    def __init__(self, bench: Bench) -> None:
        super().__init__()
        self._bench = bench

    def wait(self, timeout: float | None = None) -> bool:
        assert timeout is not None
        self._bench.wait(timeout)
        return self.is_set()


class Plain(Reporting):
    """What the drivers below have in common: number, time, and the end of their life."""

    def __init__(self, bench: Bench) -> None:
        self.bench, self._life, self._seq = bench, bench.life(), -1

    def next(self) -> tuple[int, int]:
        if self._seq + 1 == self._life:
            raise self.bench.error("unplugged")
        self.bench.t_ns += PERIOD_NS
        self._seq += 1
        return self._seq, self.bench.t_ns

    def close(self) -> None:
        self.bench.closed += 1

    def counts(self) -> dict[str, int]:
        return {"items": self._seq + 1}

    def metrics(self) -> dict[str, float]:
        return {"warm_c": 30.0}


class CameraDriver(Plain):
    def read(self) -> Frame | None:
        seq, t_ns = self.next()
        return Frame(seq, t_ns, t_ns, np.zeros((2, 2, 3), np.uint8))


class ImuDriver(Plain):
    def read(self) -> ImuSample | None:
        nothing = np.full(3, np.nan)
        return ImuSample("imu", 0, *self.next(), nothing, nothing, nothing, np.full(4, np.nan))


class TrackerDriver(Plain):
    def read(self) -> TrackerPose | None:
        return TrackerPose("wand", 0, *self.next(), np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))


def driver(device: str, bench: Bench, stop: threading.Event | None = None) -> Driver:
    """A reconnecting driver; the longest wait of each is a second here."""
    stop = Stop(bench) if stop is None else stop
    bench.error = {"camera": CameraError, "IMU": ImuError, "tracker": TrackerError}[device]
    rest = bench, stop, bench.connection_lost
    if device == "camera":
        return ReconnectingCamera(lambda _file: CameraDriver(bench), CALIBRATION, *rest, longest_s=1.0)
    if device == "IMU":
        return ReconnectingDriver("IMU", lambda: ImuDriver(bench), *rest, rate_hz=50.0, longest_s=1.0)
    return ReconnectingTracker("wand", lambda: TrackerDriver(bench), *rest, longest_s=1.0)


def measured(source: Driver) -> Iterator[Item]:
    """Items that are measurements: of a tracker that is away poses of NaN come meanwhile."""
    while (item := source.read()) is not None:
        if not isinstance(item, TrackerPose) or np.isfinite(item.position_m).all():
            yield item


def counted(source: Driver, event: str) -> int:
    return {name.removeprefix("camera."): count for name, count in source.counts().items()}[event]


@pytest.mark.parametrize("device", DEVICES)
def test_a_device_that_stays_is_passed_through(device: str) -> None:
    bench = Bench()
    source = driver(device, bench)
    items = measured(source)
    assert [next(items).seq for _ in range(5)] == [0, 1, 2, 3, 4]
    assert (bench.opened, bench.closed, bench.waits) == (1, 0, [])
    assert (counted(source, "lost"), counted(source, "back"), counted(source, "items")) == (0, 0, 5)
    assert source.metrics()["warm_c"] == 30.0


@pytest.mark.parametrize("device", DEVICES)
def test_an_error_at_the_start_is_an_error(device: str) -> None:
    with pytest.raises(PhalanxError, match="no such device"):
        driver(device, Bench(plugged=False))


@pytest.mark.parametrize("device", DEVICES)
def test_numbers_go_on_after_a_loss(device: str, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING)
    bench = Bench(lives=[4])
    source = driver(device, bench)
    items = measured(source)
    before = [next(items) for _ in range(4)]
    bench.unplug(5.0)
    after = [next(items) for _ in range(3)]
    gap = after[0].seq - before[-1].seq
    periods = (after[0].t_ns - before[-1].t_ns) // PERIOD_NS
    assert periods > 250
    if device == "tracker":
        assert 20 <= gap <= 25, "poses of NaN, four a second, are numbered with the others"
    else:
        assert gap == periods, "the absence counts as dropped"
    assert [item.seq for item in after] == [after[0].seq + k for k in range(3)]
    assert (counted(source, "lost"), counted(source, "back"), counted(source, "items")) == (1, 1, 7)
    assert (bench.opened, bench.closed) == (2, 1), "the driver of the lost one was closed"
    assert bench.lost[0] == f"{device} lost: unplugged"
    assert bench.lost[2] == f"{device} away: no such device"
    assert "back after loss number 1" in caplog.text


@pytest.mark.parametrize("device", DEVICES)
def test_the_time_of_an_absence_is_told_while_it_lasts(device: str) -> None:
    bench = Bench(lives=[1])
    source = driver(device, bench)
    name = "camera.away_s" if device == "camera" else "away_s"
    items = measured(source)
    next(items)
    assert source.metrics()[name] == 0.0
    away: list[float] = []
    bench.told = lambda: away.append(source.metrics()[name])
    bench.unplug(3.0)
    next(items)
    assert away[0] == 0.0
    assert 2.0 < away[-1] < 5.0
    assert source.metrics()[name] == 0.0


@pytest.mark.parametrize("device", ["camera", "IMU"])
def test_waits_grow_and_begin_anew_with_an_item(device: str) -> None:
    bench = Bench(lives=[1, 1])
    items = measured(driver(device, bench))
    next(items)
    bench.unplug(20.0)
    next(items)
    assert bench.waits[:5] == [0.2, 0.4, 0.8, 1.0, 1.0]
    assert max(bench.waits) == 1.0
    bench.waits.clear()
    next(items)
    assert bench.waits == [0.2]


@pytest.mark.parametrize("device", ["camera", "IMU"])
def test_a_device_that_opens_but_never_delivers_is_not_opened_in_a_hurry(device: str) -> None:
    bench = Bench(lives=[1] + [0] * 6)
    source = driver(device, bench)
    items = measured(source)
    next(items)
    next(items)
    assert bench.waits == [0.2, 0.4, 0.8, 1.0, 1.0, 1.0, 1.0]
    assert (counted(source, "lost"), counted(source, "back")) == (7, 1)


def test_a_tracker_that_is_away_is_nowhere_four_times_a_second_however_long_the_waits_grow() -> None:
    bench = Bench(lives=[1])
    source = driver("tracker", bench)
    source.read()
    bench.plugged = False
    poses = [source.read() for _ in range(40)]
    nowhere = [one for one in poses if isinstance(one, TrackerPose) and np.isnan(one.position_m).all()]
    assert len(nowhere) == 40
    assert set(bench.waits) == {0.25}
    assert len([what for what in bench.lost if "away" in what]) == 11, "after 0.2, 0.4, 0.8, 1 ... s"
    assert [b.t_ns - a.t_ns for a, b in pairwise(nowhere)] == [250_000_000] * 39


def test_what_no_waiting_mends_goes_on_to_the_user() -> None:
    bench = Bench(lives=[1])
    source = driver("tracker", bench)
    source.read()
    bench.error = TrackerChoiceError
    with pytest.raises(TrackerChoiceError):
        source.read()


@pytest.mark.parametrize("device", ["IMU", "tracker"])
def test_an_item_no_later_than_the_last_is_left_out(device: str) -> None:
    bench = Bench(lives=[3])
    source = driver(device, bench)
    items = measured(source)
    for _ in range(3):
        next(items)
    bench.t_ns -= 10**9  # the device's clock, as the next driver understands it
    assert next(items).t_ns > 3 * PERIOD_NS
    assert counted(source, "late") > 10


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("end", ["stop", "close"])
def test_a_stop_and_a_close_end_the_wait(device: str, end: str) -> None:
    bench = Bench(lives=[1])
    stop = Stop(bench)
    source = driver(device, bench, stop)
    assert source.read() is not None
    bench.plugged = False
    stop.set() if end == "stop" else source.close()
    assert source.read() is None


@pytest.mark.parametrize("device", DEVICES)
def test_a_long_absence_is_logged_now_and_then(device: str, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING, logger=sources.__name__)
    bench = Bench(lives=[1])
    items = measured(driver(device, bench))
    next(items)
    bench.unplug(10e-9 * LOG_EVERY_NS)
    next(items)
    assert 5 <= len(caplog.records) <= 13
    assert len(bench.waits) > 40


@pytest.mark.parametrize("device", DEVICES)
def test_what_is_no_error_of_ours_is_a_loss_too(device: str, caplog: pytest.LogCaptureFixture) -> None:
    bench = Bench(lives=[4])
    source = driver(device, bench)
    bench.error = KeyError
    items = measured(source)
    for _ in range(4):
        next(items)
    bench.unplug(1.0)
    assert next(items).seq > 4
    assert (counted(source, "lost"), counted(source, "back")) == (1, 1)
    assert counted(source, "raised") >= 2, "when it was read, and when it was opened"
    assert f"{device}: lost: KeyError: 'unplugged'" in caplog.text


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("where", ["close", "counts", "metrics"])
def test_a_driver_that_cannot_be_closed_or_asked_ends_nothing(
    device: str, where: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(_driver: Plain) -> None:
        raise KeyError(where)

    monkeypatch.setattr(Plain, where, fail)
    source = driver(device, Bench(lives=[4]))
    items = measured(source)
    assert [next(items).seq for _ in range(6)][:4] == [0, 1, 2, 3]
    assert ("warm_c" in source.metrics()) == (where != "metrics")
    assert counted(source, "lost") == 1
    assert counted(source, "raised") >= 1
    source.close()


@pytest.mark.parametrize("device", DEVICES)
def test_real_waiting_ends_when_the_slave_is_stopped(device: str) -> None:
    bench, stop = Bench(lives=[1]), threading.Event()
    source = driver(device, bench, stop)
    assert source.read() is not None
    bench.plugged = False
    threading.Timer(0.05, stop.set).start()
    while source.read() is not None:
        assert device == "tracker"
