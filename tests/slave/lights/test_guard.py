"""No pulse too long, no duty too high, dark if nobody darkens it; and a guard without these rules fails here."""

import subprocess
import sys
import threading

import msgspec
import pytest

from common.errors import LightsError
from common.recording.frame_recording import Illumination
from slave.lights.interlock import WINDOW_NS, Interlock
from tests.slave.lights.stage import AMBIENT, LASER, LED, MS, ROOT, STROBE, NotedLights, SetClock

LIMITS = msgspec.structs.replace(STROBE, max_pulse_us=5000.0, max_duty=0.1)


def staged(kind: type[Interlock] = Interlock, watch: bool = False) -> tuple[Interlock, NotedLights, SetClock]:
    clock = SetClock()
    lights = NotedLights(clock)
    return kind(lights, LIMITS, clock, watch), lights, clock


def flash(interlock: Interlock, clock: SetClock, times: int, pulse_ns: int) -> None:
    """The LEDs, allowed and ended every time, a millisecond apart."""
    for _ in range(times):
        assert interlock.begin(LED, pulse_ns)
        clock.t_ns += pulse_ns
        interlock.end()
        clock.t_ns += MS


def misuse(kind: type[Interlock]) -> list[str]:
    """What a guard lets happen that it must not; empty: it bites."""
    wrong: list[str] = []
    interlock, lights, clock = staged(kind)
    if interlock.begin(LASER, 5 * MS + 1) or lights.lit is not AMBIENT:
        wrong.append("too long a pulse")
    interlock, lights, clock = staged(kind)
    interlock.begin(LASER, 5 * MS)
    if interlock.begin(LED, MS) or lights.lit is LED:
        wrong.append("both at once")
    interlock, lights, clock = staged(kind)
    on_ns, start_ns = 0, clock.t_ns
    while clock.t_ns < start_ns + WINDOW_NS:
        if interlock.begin(LASER, 4 * MS):
            clock.t_ns += 4 * MS
            on_ns += 4 * MS
            interlock.end()
        clock.t_ns += MS
    if on_ns > 0.1 * WINDOW_NS:
        wrong.append("too much duty")
    interlock, lights, clock = staged(kind)
    interlock.begin(LED, 4 * MS)
    clock.t_ns += 5 * MS
    interlock.look()
    if lights.lit is LED:
        wrong.append("nobody ended it")
    return wrong


class NoLimits(Interlock):
    """A planted violation: everything is allowed."""

    def _allowance_ns(self, lit: Illumination, now_ns: int) -> int:
        return 10 * WINDOW_NS


class NoDuty(Interlock):
    """A planted violation: only the length of a pulse is limited."""

    def _allowance_ns(self, lit: Illumination, now_ns: int) -> int:
        return self._longest_ns


class NoWatchdog(Interlock):
    """A planted violation: nobody looks."""

    def look(self) -> float | None:
        return None


def test_the_guard_lets_nothing_happen_that_it_must_not() -> None:
    assert misuse(Interlock) == []


@pytest.mark.parametrize(
    ("kind", "lets"),
    [
        (NoLimits, ["too long a pulse", "too much duty", "nobody ended it"]),
        (NoDuty, ["too much duty"]),
        (NoWatchdog, ["nobody ended it"]),
    ],
)
def test_a_guard_without_a_rule_is_found_out(kind: type[Interlock], lets: list[str]) -> None:
    assert misuse(kind) == lets


def test_what_is_refused_and_what_the_watchdog_ends_is_counted() -> None:
    interlock, lights, clock = staged()
    assert not interlock.begin(LASER, 6 * MS)
    assert not interlock.begin(LASER, 0)
    assert not interlock.begin(AMBIENT, MS)
    assert interlock.begin(LASER, 4 * MS)
    assert interlock.look() == pytest.approx(0.005)
    clock.t_ns += 5 * MS
    assert interlock.look() is None
    assert lights.pulses() == [(LASER, clock.t_ns - 5 * MS, clock.t_ns)]
    assert interlock.events() == {"pulses": 1, "refused": 3, "off_by_watchdog": 1, "failed": 0}


def test_duty_is_free_again_when_its_second_is_over() -> None:
    interlock, _, clock = staged()
    flash(interlock, clock, 20, 5 * MS)
    assert not interlock.begin(LED, MS)
    assert interlock.begin(LASER, MS)  # each light has its own
    interlock.end()
    clock.t_ns += WINDOW_NS - 110 * MS
    assert interlock.begin(LED, 5 * MS)


def test_a_pulse_that_is_not_ended_uses_up_no_more_than_its_duty() -> None:
    interlock, lights, clock = staged()
    flash(interlock, clock, 24, 4 * MS)
    assert interlock.begin(LED, 3 * MS)  # 4 ms are left
    assert interlock.look() == pytest.approx(0.004)
    clock.t_ns += 4 * MS
    interlock.look()
    assert lights.lit is AMBIENT


def test_a_driver_that_fails_is_darkened_as_soon_as_it_answers() -> None:
    interlock, lights, clock = staged()
    lights.fails = True
    with pytest.raises(LightsError, match="unplugged"):
        interlock.begin(LASER, MS)
    again_s = interlock.look()
    assert again_s is not None
    assert again_s < 0.1
    lights.fails = False
    assert interlock.look() is None
    assert lights.switched == [(clock.t_ns, AMBIENT)]
    assert interlock.begin(LASER, MS)
    lights.fails = True
    with pytest.raises(LightsError):
        interlock.end()
    assert interlock.look() is not None
    lights.fails = False
    assert interlock.look() is None
    assert lights.lit is AMBIENT
    assert interlock.counts["off_by_watchdog"] == 0  # the driver failed, nobody overslept


@pytest.mark.parametrize("raised", [LightsError("unplugged"), RuntimeError("released"), ValueError("closed")])
def test_nothing_that_a_driver_raises_ends_the_watchdog(raised: Exception) -> None:
    dark = threading.Event()

    class Raising(NotedLights):
        left = 3

        def off(self) -> None:
            self.left -= 1
            if self.left > 0:
                raise raised
            super().off()
            dark.set()

    lights = Raising(SetClock())
    interlock = Interlock(lights, LIMITS)
    assert interlock.begin(LASER, MS)
    with pytest.raises(LightsError, match=str(raised)):
        interlock.end()
    assert not interlock.begin(LED, MS)  # it may be lit still
    assert dark.wait(30.0)
    interlock.close()
    assert lights.lit is AMBIENT
    assert interlock.counts["failed"] == 2


def test_the_watchdog_ends_a_pulse_by_itself() -> None:
    dark = threading.Event()

    class SignallingLights(NotedLights):
        def off(self) -> None:
            super().off()
            dark.set()

    lights = SignallingLights(SetClock())
    interlock = Interlock(lights, LIMITS)  # on the clock of this machine
    assert interlock.begin(LASER, MS)
    assert dark.wait(30.0)
    interlock.close()
    assert interlock.counts["off_by_watchdog"] == 1
    assert lights.closed
    assert not interlock.begin(LASER, MS)


DYING = """
from tests.slave.lights.stage import LASER, STROBE, NotedLights, SetClock
from slave.lights.interlock import Interlock

class Spoken(NotedLights):
    def switch(self, lit):
        super().switch(lit)
        print(lit, flush=True)

guard = Interlock(Spoken(SetClock()), STROBE, SetClock())
guard.begin(LASER, 1_000_000)
raise RuntimeError("nobody closes the guard")
"""


def test_a_process_that_ends_by_an_exception_ends_dark() -> None:
    done = subprocess.run(
        [sys.executable, "-c", DYING], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert "RuntimeError: nobody closes the guard" in done.stderr
    assert done.stdout.split() == ["laser", "ambient"]
