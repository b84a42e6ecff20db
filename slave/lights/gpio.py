"""Switch laser and LEDs behind two GPIO lines, by libgpiod 2.

`gpio:CHIP:LASER,LED[,SYNC]`: the chip as a path, a name or a number, the lines as numbers of the chip or by name;
`/low` after a line that lights when it is low. Both lines are set by one call of the kernel, so never is one half of
a change seen, and read back. SYNC is an input that the camera sets while it exposes: the kernel stamps its edges
(CLOCK_MONOTONIC) when they happen, however busy the machine is.

A slave that is killed or stopped during a pulse darkens nothing, and the chip's driver may keep a pin's level. So a
second process inherits the request, is sent every pulse, and sets the lines dark when one lasts too long or the first
process is gone (`gpio_watchdog`); none is lit without it. Against a dead kernel, or a kill of both, only wires help:
a pull-down resistor, and a monostable in series (docs/safety.md). What is missing or does not follow raises
`LightsError`.
"""

import errno
import os
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from common.errors import LightsError
from common.recording.frame_recording import Illumination
from slave.lights.gpio_watchdog import DARK, LIT
from slave.lights.interlock import Lights

if TYPE_CHECKING:
    from gpiod import LineRequest

CONSUMER = "phalanx strobe"
WATCHDOG = Path(__file__).with_name("gpio_watchdog.py")
WATCHDOG_S = 5.0  # it has one call to make
INSTALL = (
    "--lights gpio needs the library gpiod 2: pip install 'phalanx-hand[wrist]', or on Raspberry Pi OS"
    " `sudo apt install python3-libgpiod` and a virtual environment made with --system-site-packages"
)
FORM = (
    "write gpio:CHIP:LASER,LED[,SYNC], for example gpio:0:17,27; gpio:0:17,27/low where low lights the LEDs"
)


@dataclass(frozen=True, slots=True)
class Line:
    """One line: its number on the chip or its name, and whether low is on."""

    place: int | str
    active_low: bool

    @classmethod
    def of(cls, text: str) -> "Line":
        """`17`, `GPIO17`, either with `/low`; else `LightsError`."""
        place, slash, level = text.partition("/")
        if not place or (slash and level != "low"):
            raise LightsError(f"--lights gpio: line {text!r}: {FORM}")
        return cls(int(place) if place.isdecimal() else place, bool(slash))


class GpioLights(Lights):
    """`Lights` behind two GPIO lines."""

    def __init__(self, place: str, longest_s: float) -> None:
        """Request CHIP:LASER,LED[,SYNC], dark; none is on for over `longest_s` [s]."""
        chip, colon, lines = place.rpartition(":")
        names = lines.split(",")
        if not colon or not chip or len(names) not in (2, 3):
            raise LightsError(f"--lights gpio:{place}: {FORM}")
        chip = f"gpiochip{chip}" if chip.isdecimal() else chip
        self._chip = chip if "/" in chip else f"/dev/{chip}"
        self._laser, self._led, *sync = self._lines = [Line.of(name) for name in names]
        if len({line.place for line in self._lines}) < len(names):
            raise LightsError(f"--lights gpio:{place}: two of them on one line; {FORM}")
        self._sync = sync[0] if sync else None
        self._edges: LineRequest | None = None
        self._longest_s = longest_s
        self._gpiod = _library()
        self._closed = False
        self._watchdog: subprocess.Popen[bytes] | None = None
        self._request: LineRequest | None = self._requested()
        self._reopened = 0

    def switch(self, lit: Illumination) -> None:
        """Set both lines; lines that were lost are requested again first."""
        if self._closed:
            return
        value, request = self._gpiod.line.Value, self._reached()
        lights = {self._laser.place: Illumination.LASER, self._led.place: Illumination.LED}
        wanted = {place: value.ACTIVE if lit is one else value.INACTIVE for place, one in lights.items()}
        if lit in lights.values():
            self._notify_watchdog(LIT)
        try:
            request.set_values(wanted)
            got = request.get_values(list(wanted))
        except OSError as error:
            self._lose()
            raise LightsError(f"{self._chip}: lost: {error.strerror or error}") from error
        if got != list(wanted.values()):
            raise LightsError(
                f"{self._chip}: lines {self._laser.place} and {self._led.place} were set to"
                f" {_levels(wanted.values())} and read {_levels(got)}: something else drives them, or they are shorted"
            )
        if lit not in lights.values():
            self._notify_watchdog(DARK)

    def exposure_starts(self) -> list[int] | None:
        """As the kernel stamped the edges of SYNC [ns]; None: there is no such line."""
        if self._sync is None:
            return None
        found: list[int] = []
        self._reached()
        try:
            while self._edges is not None and self._edges.wait_edge_events(0.0):
                found += [event.timestamp_ns for event in self._edges.read_edge_events()]
        except OSError as error:
            self._lose()
            raise LightsError(f"{self._chip}: lost: {error.strerror or error}") from error
        return found

    def close(self) -> None:
        """Dark, and the lines given back."""
        try:
            if self._request is not None:
                self.off()
        finally:
            self._closed = True
            self._lose()

    def counts(self) -> dict[str, int]:
        """`reopened`: how often the chip was lost and came back."""
        return {"reopened": self._reopened}

    def _notify_watchdog(self, what: bytes) -> None:
        """Before a light goes on, and after it went off."""
        watchdog = self._watchdog
        assert watchdog is not None  # there is one wherever there is a request
        assert watchdog.stdin is not None
        try:
            os.write(watchdog.stdin.fileno(), what)
        except OSError as error:  # it has ended, or is stopped and its pipe is full
            self._lose()
            raise LightsError(
                f"{self._chip}: the process {watchdog.pid} that darkens the lines when this one cannot does not listen"
                f" ({error.strerror}); it is started anew"
            ) from error

    def _lose(self) -> None:
        requests, watchdog = (self._request, self._edges), self._watchdog
        self._request = self._edges = self._watchdog = None
        for request in requests:
            if request is not None:
                request.release()
        if watchdog is not None:
            try:
                watchdog.communicate(timeout=WATCHDOG_S)  # ends its input, and waits: then the lines are free
            except subprocess.TimeoutExpired:
                watchdog.kill()
                watchdog.wait()

    def _reached(self) -> "LineRequest":
        """The lines; those that were lost are requested again."""
        if self._request is None:
            self._request = self._requested()
            self._reopened += 1
        return self._request

    def _requested(self) -> "LineRequest":
        settings, line = self._gpiod.LineSettings, self._gpiod.line
        config = {
            one.place: settings(
                direction=line.Direction.OUTPUT,
                drive=line.Drive.PUSH_PULL,
                active_low=one.active_low,
                output_value=line.Value.INACTIVE,
            )
            for one in (self._laser, self._led)
        }
        try:
            request: LineRequest = self._gpiod.request_lines(self._chip, config=config, consumer=CONSUMER)
        except (OSError, ValueError) as error:
            raise LightsError(self._why(error)) from error
        try:
            self._edges = self._requested_edges()
        except (OSError, ValueError) as error:
            request.release()
            raise LightsError(self._why(error)) from error
        try:
            watchdog = subprocess.Popen(
                [sys.executable, "-I", str(WATCHDOG), str(request.fd), str(self._longest_s)],
                stdin=subprocess.PIPE,
                bufsize=0,
                pass_fds=(request.fd,),
                start_new_session=True,
            )
        except OSError as error:
            self._request = request
            self._lose()
            raise LightsError(f"{self._chip}: no second process can be started: {error.strerror}") from error
        assert watchdog.stdin is not None
        os.set_blocking(watchdog.stdin.fileno(), False)  # nobody waits for it while a light is on
        self._watchdog = watchdog
        return request

    def _requested_edges(self) -> "LineRequest | None":
        """The line that the camera sets, in a request that the watchdog does not have."""
        if self._sync is None:
            return None
        line, kept = self._gpiod.line, 64  # edges that the kernel keeps: half a second
        settings = self._gpiod.LineSettings(
            direction=line.Direction.INPUT,
            edge_detection=line.Edge.RISING,
            active_low=self._sync.active_low,
            event_clock=line.Clock.MONOTONIC,
        )
        config = {self._sync.place: settings}
        edges: LineRequest = self._gpiod.request_lines(
            self._chip, config=config, consumer=CONSUMER, event_buffer_size=kept
        )
        return edges

    def _why(self, error: OSError | ValueError) -> str:
        """What a user can do about a request that failed."""
        lines = ", ".join(str(line.place) for line in self._lines)
        code = error.errno if isinstance(error, OSError) else None
        if code == errno.ENOENT and "line" not in str(error).lower():
            return f"{self._chip}: no such GPIO chip; `gpiodetect` lists them"
        if code in (errno.EACCES, errno.EPERM):
            return (
                f"{self._chip}: not allowed; add the user to the group that owns it (gpio on Raspberry Pi OS)"
            )
        if code == errno.EBUSY:
            return f"{self._chip}: line {lines}: in use by {self._users()}; `gpioinfo` shows by whom"
        if code in (errno.ENODEV, errno.ENOTTY):
            return f"{self._chip}: is no GPIO chip; `gpiodetect` lists them"
        return f"{self._chip}: line {lines}: cannot be requested ({error}); `gpioinfo` lists the lines"

    def _users(self) -> str:
        try:
            with self._gpiod.Chip(self._chip) as chip:
                infos = [chip.get_line_info(one.place) for one in self._lines]
        except OSError:
            return "somebody"
        found = [f"{info.consumer or 'the kernel'} ({info.offset})" for info in infos if info.used]
        return ", ".join(found) or "somebody"


def _levels(values: Iterable[object]) -> str:
    return " ".join(str(getattr(value, "name", value)).lower() for value in values)


def _library() -> ModuleType:
    """The library, in version 2."""
    try:
        import gpiod
    except ImportError as error:
        raise LightsError(INSTALL) from error
    if not hasattr(gpiod, "request_lines"):
        raise LightsError(f"gpiod {gpiod.__version__} is too old; {INSTALL}")
    return gpiod
