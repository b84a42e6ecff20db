"""The process that switches real lights: in step though its slave computes, dark when either ends, started again."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from common.clock import SkewedClock, SystemClock
from common.errors import CameraError, LightsError
from slave.cli.table import PROGRAM
from slave.commands import devices
from slave.commands.devices import Drivers
from slave.lights.strobed import StrobedCamera, StrobeProcess
from slave.sources import Frame, FrameSource
from tests.slave.lights.stage import CAMERA, PERIOD_NS, RIG, ROOT

LIGHTS = "gpio:0:17,27"


@pytest.fixture
def log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """What the lines were set to; the process finds the stand-in of the library first."""
    monkeypatch.setenv("PYTHONPATH", f"{ROOT / 'tests/slave/lights/library'}:{ROOT}")
    monkeypatch.setenv("PHALANX_FAKE_GPIO", str(tmp_path / "lines"))
    return tmp_path / "lines"


def clock(offset_ns: int = 0) -> SkewedClock:
    return SkewedClock(offset_ns, 0.0)


def switched(log: Path) -> list[tuple[int, str]]:
    """When, and which of laser and LEDs were on then."""
    return [(int(line.split()[0]), "".join(line.split()[1:])) for line in log.read_text().splitlines()]


def filmed(strobe: StrobeProcess, own: SkewedClock, until: Callable[[], bool], first: int = 0) -> int:
    """Hand over stamps of a camera that runs at its rate until that holds; true time [ns] of its frame 0."""
    first_ns, k = own.now_ns() - round(first * PERIOD_NS), first
    deadline = time.monotonic() + 60.0
    while not until():
        assert time.monotonic() < deadline, strobe.counts()
        stamp_ns = first_ns + round(k * PERIOD_NS)
        time.sleep(max((stamp_ns - own.now_ns()) * 1e-9, 0.0))
        strobe.push(k, stamp_ns)
        k += 1
    return own.to_true(first_ns)


def covered(log: Path, first_ns: int) -> tuple[int, int]:
    """How many pulses light one exposure wholly and no other, and how many touch one only in part."""
    whole = part = 0
    half_ns = CAMERA.exposure_us * 500.0
    lines = switched(log)
    for (on_ns, which), (off_ns, dark) in pairwise(lines):
        if which == "00":
            continue
        assert dark == "00"  # never both, never from one to the other
        number = round(((on_ns + off_ns) / 2 - first_ns) / PERIOD_NS)
        middle_ns = first_ns + number * PERIOD_NS
        begins, ends = on_ns <= middle_ns - half_ns, off_ns >= middle_ns + half_ns
        alone = off_ns < middle_ns + PERIOD_NS - half_ns and on_ns > middle_ns - PERIOD_NS + half_ns
        touches = on_ns < middle_ns + half_ns and off_ns > middle_ns - half_ns
        whole += begins and ends and alone
        part += touches and not (begins and ends and alone)
    return whole, part


def test_lights_are_in_step_while_the_slave_computes(log: Path) -> None:
    own, over = clock(7_000_000_000), threading.Event()

    def compute() -> None:
        while not over.is_set():
            sum(range(1000))  # holds Python's lock for 5 ms at a time, whoever waits

    strobe = StrobeProcess(LIGHTS, RIG, CAMERA, own)
    worker = threading.Thread(target=compute)
    worker.start()
    try:
        begin = time.monotonic()
        first_ns = filmed(strobe, own, lambda: time.monotonic() > begin + 3.0)
        counts = strobe.counts()
    finally:
        over.set()
        strobe.close()
    strobe.close()
    worker.join()
    whole, part = covered(log, first_ns)
    assert switched(log)[-1][1] == "00"
    assert {which for _, which in switched(log)} == {"00", "10", "01"}
    if counts["lights.not_realtime"]:
        pytest.skip("no real-time priority here: when it wakes up depends on who else computes")
    # 180 exposures in 3 s, nine stamps and the last quarter of a second aside; a virtual machine may stop for a while
    assert whole > 100, counts
    assert part < 0.1 * whole, counts


class Camera(FrameSource):
    """Frames at the camera's rate, stamped when they were exposed."""

    def __init__(self, own: SkewedClock) -> None:
        self.own, self.first_ns, self.number, self.closed = own, own.now_ns(), 0, False

    def read(self) -> Frame | None:
        stamp_ns = self.first_ns + round(self.number * PERIOD_NS)
        time.sleep(max((stamp_ns - self.own.now_ns()) * 1e-9, 0.0))
        self.number += 1
        return Frame(self.number, stamp_ns, self.own.now_ns(), np.zeros((2, 2), np.uint8))

    def close(self) -> None:
        self.closed = True


def test_the_camera_that_the_slave_opens_is_lit(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own, options = (
        clock(),
        PROGRAM.parse(["run", "--rig", "wrist", "--camera", "v4l2", "--lights", LIGHTS])[1],
    )
    device = Camera(own)

    def opened(*_: object, **__: object) -> FrameSource:
        return device

    monkeypatch.setattr(devices, "open_camera", opened)
    camera = Drivers(options, RIG, own, SystemClock()).camera(CAMERA)
    assert isinstance(camera, StrobedCamera)
    deadline = time.monotonic() + 60.0
    while camera.counts()["lights.pulses"] < 4 and time.monotonic() < deadline:
        assert camera.read() is not None
    camera.close()
    assert device.closed
    assert {which for _, which in switched(log)} == {"00", "10", "01"}
    assert switched(log)[-1][1] == "00"
    monkeypatch.setattr(devices, "open_camera", _unplugged)
    with pytest.raises(CameraError, match="unplugged"):
        Drivers(options, RIG, own, SystemClock()).camera(CAMERA)
    assert switched(log)[-1][1] == "00"


def _unplugged(*_: object, **__: object) -> FrameSource:
    raise CameraError("unplugged")


def test_what_cannot_be_opened_is_said_at_the_start(log: Path) -> None:
    with pytest.raises(LightsError, match="/dev/gpiochip7: no such GPIO chip"):
        StrobeProcess("gpio:7:17,27", RIG, CAMERA, clock())
    assert not log.exists()


def test_one_that_is_killed_is_started_again_and_counted(log: Path) -> None:
    own = clock()
    strobe = StrobeProcess(LIGHTS, RIG, CAMERA, own)
    filmed(strobe, own, lambda: strobe.counts().get("lights.pulses", 0) > 1)
    before = strobe.counts()["lights.pulses"]
    assert strobe._process is not None
    os.kill(strobe._process.pid, signal.SIGKILL)
    filmed(strobe, own, lambda: strobe.counts()["lights.restarted"] == 1)
    own.step(6_000_000_000)  # nothing is started anew before
    filmed(strobe, own, lambda: strobe.counts()["lights.pulses"] > before + 1)
    strobe.stalled()
    strobe.close()
    assert switched(log)[-1][1] == "00"


def test_a_stop_of_the_service_reaches_the_slave_first(log: Path) -> None:
    strobe = StrobeProcess(LIGHTS, RIG, CAMERA, clock())
    assert strobe._process is not None
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGABRT, signal.SIGHUP):
        os.kill(strobe._process.pid, number)
    time.sleep(0.2)
    assert strobe._process.poll() is None
    strobe.close()
    assert switched(log)[-1][1] == "00"


def test_lights_that_cannot_be_darkened_at_the_end_are_said(
    log: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    strobe = StrobeProcess(LIGHTS, RIG, CAMERA, clock())
    log.with_name("fails").touch()
    strobe.close()
    assert "lights: /dev/gpiochip0: lost: No such device" in capfd.readouterr().err


SLAVE = """
import sys, time
from common.clock import SkewedClock
from slave.lights.strobed import StrobeProcess
from tests.slave.lights.stage import CAMERA, PERIOD_NS, RIG
clock = SkewedClock(0, 0.0)
strobe = StrobeProcess("gpio:0:17,27", RIG, CAMERA, clock)
print(strobe._process.pid, flush=True)
first_ns, k = clock.now_ns(), 0
while True:
    time.sleep(max((first_ns + k * PERIOD_NS - clock.now_ns()) * 1e-9, 0.0))
    strobe.push(k, first_ns + round(k * PERIOD_NS))
    k += 1
"""


def test_when_its_slave_is_killed_it_goes_dark_and_ends(log: Path) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", SLAVE], stdout=subprocess.PIPE, text=True, cwd=ROOT
    ) as slave:
        assert slave.stdout is not None
        pid = int(slave.stdout.readline())
        deadline = time.monotonic() + 60.0
        while not log.exists() or switched(log)[-1][1] == "00":  # until a light is on
            assert time.monotonic() < deadline
            time.sleep(0.0005)
        slave.kill()
    while Path(f"/proc/{pid}/stat").exists() and ") Z " not in Path(f"/proc/{pid}/stat").read_text():
        assert time.monotonic() < deadline
        time.sleep(0.01)
    assert switched(log)[-1][1] == "00"
