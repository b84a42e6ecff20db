"""Two GPIO lines: libgpiod is replaced at its seam, `request_lines` and `Chip`; gpio-sim where the kernel has it."""

import errno
import inspect
import os
import re
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gpiod
import pytest

from common.errors import LightsError
from slave.__main__ import main
from slave.lights import gpio
from slave.lights.gpio import CONSUMER, WATCHDOG, GpioLights
from slave.lights.gpio_watchdog import DARK, LIT, SET_VALUES
from tests.slave.lights.stage import AMBIENT, LASER, LED, ROOT

VALUE = gpiod.line.Value
LONGEST_S = 0.005
CONFIGFS = Path("/sys/kernel/config/gpio-sim")


class FakeGpio:
    """The kernel's side of one chip, /dev/gpiochip0: electrical levels of 32 lines, and who holds them.

    Signatures and errors follow libgpiod 2.3 (gpiod/__init__.py, chip.py, line_request.py).
    """

    def __init__(self) -> None:
        self.level = dict.fromkeys(range(32), 0)
        self.names = {"LASER": 17, "LEDS": 27}
        self.users: dict[int, str] = {}
        self.fails: int | None = None  # errno of the next request
        self.gone = False
        self.stuck: set[int] = set()
        self.requests: list[FakeRequest] = []
        self.edges: list[int] = []  # times of what happened on the input line

    def request_lines(
        self, path: str, config: Mapping[Any, Any], consumer: str | None = None, **_: Any
    ) -> "FakeRequest":
        if path != "/dev/gpiochip0":
            raise FileNotFoundError(errno.ENOENT, "No such file or directory")
        if self.gone:
            raise OSError(errno.ENODEV, "No such device")
        if self.fails is not None:
            raise OSError(self.fails, os.strerror(self.fails))
        lines = {place: self.offset(place) for place in config}
        if all(settings.direction is gpiod.line.Direction.INPUT for settings in config.values()):
            return FakeEdges(self, lines, config)  # type: ignore[return-value]
        if any(offset in self.users for offset in lines.values()):
            raise OSError(errno.EBUSY, "Device or resource busy")
        self.users |= dict.fromkeys(lines.values(), consumer or "")
        request = FakeRequest(self, lines, config)
        self.requests.append(request)
        return request

    def offset(self, place: int | str) -> int:
        if isinstance(place, str):
            if place not in self.names:
                raise OSError(errno.ENOENT, f"Unknown line: {place}")
            return self.names[place]
        if place not in self.level:
            raise ValueError("line offset of out range")
        return place


class FakeRequest:
    """Lines as outputs; a value is logical, the level behind it electrical."""

    def __init__(self, kernel: FakeGpio, lines: dict[Any, int], config: Mapping[Any, Any]) -> None:
        self.kernel, self.lines, self.config = kernel, lines, dict(config)
        self.released = False
        self.lit: set[int] = set()
        self.fd = os.open(os.devnull, os.O_RDONLY)
        self.set_values({place: settings.output_value for place, settings in config.items()})

    def set_values(self, values: Mapping[Any, Any]) -> None:
        self._alive()
        for place, value in values.items():
            offset = self.lines[place]
            self.lit |= {offset} if value else set()
            if offset not in self.kernel.stuck:
                self.kernel.level[offset] = int(bool(value)) ^ self.config[place].active_low

    def get_values(self, places: list[Any]) -> list[Any]:
        self._alive()
        levels = [self.kernel.level[self.lines[p]] ^ self.config[p].active_low for p in places]
        return [VALUE.ACTIVE if level else VALUE.INACTIVE for level in levels]

    def release(self) -> None:
        if not self.released:
            os.close(self.fd)
        self.released = True
        for offset in self.lines.values():
            self.kernel.users.pop(offset, None)

    def _alive(self) -> None:
        assert not self.released
        if self.kernel.gone:
            raise OSError(errno.ENODEV, "No such device")


class FakeEdges:
    """One line as an input; the kernel keeps what happens on it, with its time."""

    def __init__(self, kernel: FakeGpio, lines: dict[Any, int], config: Mapping[Any, Any]) -> None:
        (self.offset,), (self.settings,) = lines.values(), config.values()
        self.kernel, self.released = kernel, False
        self.kernel.users[self.offset] = CONSUMER

    def wait_edge_events(self, timeout: float | None = None) -> bool:
        assert not self.released
        assert timeout == 0.0  # nobody waits for it
        if self.kernel.gone:
            raise OSError(errno.ENODEV, "No such device")
        return bool(self.kernel.edges)

    def read_edge_events(self) -> list[SimpleNamespace]:
        found, self.kernel.edges = self.kernel.edges[:16], self.kernel.edges[16:]  # as many as a call returns
        return [SimpleNamespace(timestamp_ns=t_ns) for t_ns in found]

    def release(self) -> None:
        self.released = True
        self.kernel.users.pop(self.offset, None)


@pytest.fixture
def kernel(monkeypatch: pytest.MonkeyPatch) -> FakeGpio:
    fake = FakeGpio()

    class Chip:
        def __init__(self, path: str) -> None:
            assert path == "/dev/gpiochip0"

        def __enter__(self) -> "Chip":
            return self

        def __exit__(self, *_: object) -> None:
            return None

        def get_line_info(self, place: int | str) -> SimpleNamespace:
            offset = fake.offset(place)
            return SimpleNamespace(
                offset=offset, used=offset in fake.users, consumer=fake.users.get(offset, "")
            )

    monkeypatch.setattr(gpiod, "request_lines", fake.request_lines)
    monkeypatch.setattr(gpiod, "Chip", Chip)
    return fake


def test_the_stand_in_takes_what_the_library_takes() -> None:
    real = inspect.signature(gpiod.request_lines).parameters
    assert set(inspect.signature(FakeGpio.request_lines).parameters) - {"self", "_"} <= set(real)
    methods = vars(gpiod.LineRequest)
    assert {"set_values", "get_values", "release"} <= set(methods)
    assert {"wait_edge_events", "read_edge_events"} <= set(methods)
    settings = inspect.signature(gpiod.LineSettings).parameters
    assert {"edge_detection", "event_clock", "active_low"} <= set(settings)
    assert "event_buffer_size" in real
    assert hasattr(gpiod.EdgeEvent, "timestamp_ns") or "timestamp_ns" in gpiod.EdgeEvent.__dataclass_fields__


@pytest.mark.parametrize("chip", ["0", "gpiochip0", "/dev/gpiochip0"])
@pytest.mark.parametrize(
    ("lines", "low"),
    [("17,27", (0, 0)), ("LASER,LEDS", (0, 0)), ("17,27/low", (0, 1)), ("17/low,27", (1, 0))],
)
def test_one_light_at_a_time_and_dark_at_both_ends(
    kernel: FakeGpio, chip: str, lines: str, low: tuple[int, int]
) -> None:
    lights = GpioLights(f"{chip}:{lines}", LONGEST_S)

    def lit() -> tuple[bool, bool]:
        return bool(kernel.level[17] ^ low[0]), bool(kernel.level[27] ^ low[1])

    assert lit() == (False, False)
    assert set(kernel.users.values()) == {CONSUMER}
    for kind, seen in (
        (LASER, (True, False)),
        (LED, (False, True)),
        (AMBIENT, (False, False)),
        (LED, (False, True)),
    ):
        lights.switch(kind)
        assert lit() == seen
    watchdog = lights._watchdog
    assert watchdog is not None
    assert watchdog.poll() is None
    lights.close()
    lights.close()
    assert watchdog.returncode == 1  # the stand-in's lines are no lines of a kernel
    assert lit() == (False, False)
    assert kernel.users == {}
    lights.switch(LASER)
    assert lit() == (False, False)


@pytest.mark.parametrize("low", [False, True])
def test_the_kernels_stamps_of_the_cameras_line_are_read(kernel: FakeGpio, low: bool) -> None:
    assert GpioLights("0:5,6", LONGEST_S).exposure_starts() is None
    lights = GpioLights(f"0:17,27,22{'/low' if low else ''}", LONGEST_S)
    assert lights.exposure_starts() == []
    kernel.edges = list(range(1000, 1040))
    assert lights.exposure_starts() == list(range(1000, 1040))
    assert lights.exposure_starts() == []
    edges = lights._edges
    assert isinstance(edges, FakeEdges)
    assert (edges.settings.edge_detection, edges.settings.event_clock, edges.settings.active_low) == (
        gpiod.line.Edge.RISING,
        gpiod.line.Clock.MONOTONIC,
        low,
    )
    kernel.gone = True
    for _ in range(2):
        with pytest.raises(LightsError, match="/dev/gpiochip0"):
            lights.exposure_starts()
    kernel.gone, kernel.edges = (
        False,
        [5],
    )  # nothing is lit without stamps: the line itself is what comes back first
    assert lights.exposure_starts() == [5]
    assert lights.counts() == {"reopened": 1}
    lights.close()
    assert edges.released
    assert set(kernel.users) == {5, 6}


def test_a_chip_that_is_unplugged_comes_back(kernel: FakeGpio) -> None:
    lights = GpioLights("0:17,27", LONGEST_S)
    lights.switch(LASER)
    kernel.gone = True
    for _ in range(2):
        with pytest.raises(LightsError, match="/dev/gpiochip0"):
            lights.switch(LED)
    assert kernel.requests[0].released
    kernel.gone = False
    lights.switch(LED)
    assert (kernel.level[17], kernel.level[27]) == (0, 1)
    assert lights.counts() == {"reopened": 1}


def test_without_its_heir_nothing_is_lit_until_there_is_another(
    kernel: FakeGpio, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gpio, "WATCHDOG_S", 0.1)
    lights = GpioLights("0:17,27", LONGEST_S)

    def killed(watchdog: subprocess.Popen[bytes]) -> None:
        watchdog.kill()
        watchdog.wait()

    def stopped(watchdog: subprocess.Popen[bytes]) -> None:
        watchdog.send_signal(signal.SIGSTOP)
        assert watchdog.stdin is not None
        os.write(watchdog.stdin.fileno(), DARK * (1 << 20))  # as many as fit
        with pytest.raises(BlockingIOError):
            os.write(watchdog.stdin.fileno(), DARK)

    for deaf in (killed, stopped):
        first = lights._watchdog
        assert first is not None
        deaf(first)
        with pytest.raises(LightsError, match="does not listen"):
            lights.switch(LASER)
        assert (kernel.level[17], kernel.level[27]) == (0, 0)
        assert first.returncode == -signal.SIGKILL
        lights.switch(LASER)
        assert kernel.level[17] == 1
        assert lights._watchdog is not first
        lights.off()
    lights.close()
    assert not any(17 in request.lit for request in kernel.requests[:1])


def test_no_second_process_no_light(kernel: FakeGpio, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    with pytest.raises(LightsError, match="no second process can be started: No such file"):
        GpioLights("0:17,27", LONGEST_S)
    assert kernel.requests[0].released


def test_a_line_that_does_not_follow_is_said(kernel: FakeGpio) -> None:
    lights = GpioLights("0:17,27", LONGEST_S)
    kernel.stuck = {17}
    with pytest.raises(LightsError, match="17 and 27 were set to active inactive and read inactive inactive"):
        lights.switch(LASER)


@pytest.mark.parametrize(
    ("place", "fails", "expected"),
    [
        ("7:17,27", None, "/dev/gpiochip7: no such GPIO chip; `gpiodetect`"),
        ("0:17,27", errno.EACCES, "not allowed; add the user to the group"),
        ("0:17,27", errno.ENOTTY, "is no GPIO chip"),
        ("0:17,99", None, "line 17, 99: cannot be requested"),
        ("0:17,NONE", None, "Unknown line: NONE"),
        ("0:17", None, "write gpio:CHIP:LASER,LED"),
        ("17,27", None, "write gpio:CHIP:LASER,LED"),
        ("0:17,27/up", None, "line '27/up'"),
        ("0:17,17/low", None, "two of them on one line"),
        ("0:17,27,27", None, "two of them on one line"),
        ("0:17,27,99", None, "line 17, 27, 99: cannot be requested"),
        ("0:17,27,22,23", None, "write gpio:CHIP:LASER,LED"),
        ("0:,27", None, "line ''"),
    ],
)
def test_what_cannot_be_opened_says_why(
    kernel: FakeGpio, place: str, fails: int | None, expected: str
) -> None:
    kernel.fails = fails
    with pytest.raises(LightsError, match=expected):
        GpioLights(place, LONGEST_S)


def test_the_command_blinks_within_the_limits_and_ends_dark(
    kernel: FakeGpio, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["doctor", "--calibration", str(ROOT / "calib_json"), "--lights", "gpio:0:17,27"]
    kernel.level[17] = 1
    assert main([*command, "--off"]) == 0
    assert (kernel.level[17], kernel.level[27]) == (0, 0)
    assert capsys.readouterr().out == "dark\n"
    assert main([*command, "--blink", "0.2"]) == 0
    output = capsys.readouterr().out
    pulses = re.search(r"^pulses (\d+), refused", output, re.MULTILINE)
    assert pulses is not None
    assert 1 <= int(pulses[1]) <= 14  # 18 frames, 12 of them lit; fewer on a busy machine
    assert (kernel.level[17], kernel.level[27]) == (0, 0)
    assert {line for request in kernel.requests for line in request.lit} == {17, 27}


def test_a_busy_line_names_its_user(kernel: FakeGpio) -> None:
    kernel.users[27] = "w1-gpio"
    with pytest.raises(LightsError, match=r"in use by w1-gpio \(27\)"):
        GpioLights("0:17,27", LONGEST_S)


def test_without_the_library_it_is_said_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gpiod", None)
    with pytest.raises(LightsError, match=r"phalanx-hand\[wrist\].*python3-libgpiod"):
        GpioLights("0:17,27", LONGEST_S)
    monkeypatch.setitem(sys.modules, "gpiod", SimpleNamespace(__version__="1.6.3"))
    with pytest.raises(LightsError, match=r"gpiod 1.6.3 is too old"):
        GpioLights("0:17,27", LONGEST_S)


# A slave with an heir, whose call of the kernel is printed.
SLAVE = """
import subprocess, sys, time
run = "import fcntl, runpy, sys; fcntl.ioctl = lambda *call: print(*call, flush=True); "
run += f"sys.argv = [{sys.argv[1]!r}, '9', '0.02']; runpy.run_path(sys.argv[0], run_name='__main__')"
heir = subprocess.Popen([sys.executable, "-I", "-c", run], stdin=subprocess.PIPE, start_new_session=True)
print(heir.pid, flush=True)
time.sleep(600)
"""


def test_the_heir_of_a_killed_slave_darkens_both_lines() -> None:
    slave = subprocess.Popen([sys.executable, "-c", SLAVE, str(WATCHDOG)], stdout=subprocess.PIPE, text=True)
    assert slave.stdout is not None
    watchdog = int(slave.stdout.readline())
    assert ignores_stops(watchdog)
    os.kill(watchdog, signal.SIGTERM)  # a service's stop reaches both: the slave is to end first
    os.kill(watchdog, signal.SIGABRT)  # as does that of its watchdog
    slave.kill()
    output = slave.stdout.read()  # ends when the heir has ended, too
    slave.wait()
    slave.stdout.close()
    assert output == f"9 {0xC010B40F} {struct.pack('=QQ', 0, 3)!r}\n"


# The heir by itself, its call of the kernel printed.
WATCHED = "import fcntl, runpy, sys; fcntl.ioctl = lambda *call: print(*call, flush=True); "


def test_the_heir_of_a_stopped_slave_darkens_what_is_on_for_too_long() -> None:
    run = (
        WATCHED
        + f"sys.argv = [{str(WATCHDOG)!r}, '9', '0.02']; runpy.run_path(sys.argv[0], run_name='__main__')"
    )
    dark = f"9 {SET_VALUES} {struct.pack('=QQ', 0, 3)!r}\n".encode()
    with subprocess.Popen(
        [sys.executable, "-I", "-c", run], stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0
    ) as watchdog:
        assert watchdog.stdin is not None
        assert watchdog.stdout is not None
        watchdog.stdin.write(LIT + DARK)  # over before it was looked at
        watchdog.stdin.write(LIT)
        for _ in range(2):  # and whoever goes on only now, and lights, is darkened again
            assert watchdog.stdout.read(len(dark)) == dark
        watchdog.stdin.write(DARK)
        watchdog.stdin.close()
        assert set(watchdog.stdout.read().splitlines(keepends=True)) == {dark}


def ignores_stops(pid: int) -> bool:
    """Whether a process ignores SIGTERM; waits until it does."""
    for _ in range(1200):
        ignored = re.search(r"SigIgn:\s*([0-9a-f]+)", Path(f"/proc/{pid}/status").read_text())
        if ignored is not None and int(ignored[1], 16) >> (signal.SIGTERM - 1) & 1:
            return True
        time.sleep(0.05)
    return False


def test_the_call_of_the_heir_is_that_of_the_kernels_header() -> None:
    # _IOWR(type, number, size) of asm-generic/ioctl.h: direction 3, size of struct gpio_v2_line_values, 0xB4, 0x0F.
    assert SET_VALUES == 3 << 30 | struct.calcsize("=QQ") << 16 | 0xB4 << 8 | 0x0F


@pytest.mark.skipif(
    not os.access(CONFIGFS, os.W_OK), reason="this kernel has no gpio-sim, or only root may use it"
)
def test_the_kernels_own_simulated_lines_follow() -> None:
    device = CONFIGFS / f"phalanx{os.getpid()}"
    bank = device / "bank0"
    bank.mkdir(parents=True)
    try:
        (bank / "num_lines").write_text("8")
        (device / "live").write_text("1")
        chip = (bank / "chip_name").read_text().strip()
        levels = Path("/sys/devices/platform") / (device / "dev_name").read_text().strip() / chip
        lights = GpioLights(f"{chip}:2,5/low", LONGEST_S)
        for kind, seen in ((AMBIENT, "01"), (LASER, "11"), (LED, "00")):
            lights.switch(kind)
            assert "".join((levels / f"sim_gpio{line}/value").read_text().strip() for line in (2, 5)) == seen
        lights.close()
    finally:
        (device / "live").write_text("0")
        bank.rmdir()
        device.rmdir()
