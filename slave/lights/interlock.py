"""Guard a light driver: no pulse too long, no duty too high, never left on.

Wrapped around every driver, it holds the two limits of the rig file (`max_pulse_us`, `max_duty`) against what is
asked for and what happens, on the clock of this machine. A pulse is refused if it is to be longer than allowed, or if
with it a light would have been on for more than its share of the last second. A watchdog, on a thread of its own,
ends what has lasted as long as it may. What happens when the whole process dies is in each driver's file and in
docs/safety.md. A driver that fails raises `LightsError`.
"""

import atexit
import logging
import threading
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable

from common.calibration.strobe import StrobeCalibration
from common.clock import Clock, SystemClock
from common.errors import LightsError
from common.recording.frame_recording import Illumination

WINDOW_NS = 1_000_000_000  # over which the duty is reckoned; any second, not every second
_SHINING = (Illumination.LASER, Illumination.LED)
_LOG = logging.getLogger(__name__)


class Lights(ABC):
    """Laser and LEDs of a wrist device. Opened dark by its constructor."""

    @abstractmethod
    def switch(self, lit: Illumination) -> None:
        """Switch laser on (`LASER`), LEDs on (`LED`), or both off, and wait for it.

        Nothing is on for `AMBIENT` and `NONE`; laser and LEDs are never on together.

        Raises:
            LightsError: The device is gone, or did not do it. What it does then, nobody knows: `off` is tried next.
        """

    def off(self) -> None:
        """Have nothing on, now. As `switch`."""
        self.switch(Illumination.AMBIENT)

    def exposure_starts(self) -> list[int] | None:
        """Starts of exposures since the last call [ns], by a line; None: there is none."""
        return None

    @abstractmethod
    def close(self) -> None:
        """Leave it dark and give the device back. Safe to call twice."""

    @abstractmethod
    def counts(self) -> dict[str, int]:
        """Event of the device -> how often."""


class Interlock:
    """A light driver within limits.

    `counts`: `pulses` begun; `refused`, too long or too much; `off_by_watchdog`; `failed`, not done as commanded.
    """

    def __init__(
        self, lights: Lights, strobe: StrobeCalibration, clock: Clock | None = None, watch: bool = True
    ) -> None:
        """Take the driver over, dark; start the watchdog: without, call `look`."""
        self._lights = lights
        self._clock: Clock = SystemClock() if clock is None else clock
        self._longest_ns = round(strobe.max_pulse_us * 1e3)
        self._allowed_ns = round(strobe.max_duty * WINDOW_NS)
        self._past: dict[Illumination, deque[tuple[int, int]]] = {lit: deque() for lit in _SHINING}
        self._changed = threading.Condition(threading.RLock())
        self._on: Illumination | None = None
        self._since_ns = self._until_ns = 0
        self._closed = self._failing = False
        self.counts = Counter({"pulses": 0, "refused": 0, "off_by_watchdog": 0, "failed": 0})
        atexit.register(lights.close)  # where an exception ends the process and nobody closes
        self._thread = threading.Thread(target=self._watch, name="light watchdog", daemon=True)
        if watch:
            self._thread.start()

    def begin(self, lit: Illumination, length_ns: int) -> bool:
        """Have a light on for so long [ns]; whoever begins also calls `end`.

        False, and nothing is on, if that is too long, too much, or something is on already or may be.
        """
        with self._changed:
            now_ns = self._clock.now_ns()
            may_ns = self._allowance_ns(lit, now_ns)
            if self._closed or self._failing or self._on is not None or not 0 < length_ns <= may_ns:
                self.counts["refused"] += 1
                return False
            self._on, self._since_ns, self._until_ns = lit, now_ns, now_ns + may_ns
            self._changed.notify_all()
            self._order(lambda: self._lights.switch(lit))
            self.counts["pulses"] += 1
            return True

    def end(self) -> None:
        """Have nothing on.

        Raises:
            LightsError: The driver failed; the watchdog goes on trying.
        """
        with self._changed:
            self._order(self._lights.off)
            if self._on is not None:
                self._past[self._on].append((self._since_ns, self._clock.now_ns()))
            self._on, self._failing = None, False

    def look(self) -> float | None:
        """End a light that has lasted long enough; in how many seconds to look again."""
        with self._changed:
            if not self._failing:
                if self._on is None:
                    return None
                if (left_s := (self._until_ns - self._clock.now_ns()) * 1e-9) > 0.0:
                    return left_s
                self.counts["off_by_watchdog"] += 1
            was_failing = self._failing
            try:
                self.end()
            except LightsError as error:
                if not was_failing:
                    _LOG.error("laser or LEDs cannot be switched off: %s", error)
                return 0.01  # seconds between attempts to darken a driver that fails
            return None

    def close(self) -> None:
        """Go dark, give the driver back, end the watchdog. Safe to call twice."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        if self._thread.ident is not None:  # it was started
            self._thread.join()
        self._lights.close()
        atexit.unregister(self._lights.close)

    def exposure_starts(self) -> list[int] | None:
        """As of the driver."""
        with self._changed:
            return self._lights.exposure_starts()

    def events(self) -> dict[str, int]:
        """Of the guard and of the driver."""
        return {**self.counts, **self._lights.counts()}

    def _order(self, order: Callable[[], None]) -> None:
        """Send an order; whatever it raises is a failure, after which a light may be on."""
        try:
            order()
        except Exception as error:  # also of a library below: no thread that darkens may end by it
            self.counts["failed"] += 1
            self._failing = True
            self._changed.notify_all()
            if isinstance(error, LightsError):
                raise
            raise LightsError(f"{type(error).__name__}: {error}") from error

    def _allowance_ns(self, lit: Illumination, now_ns: int) -> int:
        """How long a light may be on from now [ns]; 0 and below: not at all."""
        if lit not in self._past:
            return 0
        past = self._past[lit]
        while past and past[0][1] <= now_ns - WINDOW_NS:
            past.popleft()
        used_ns = sum(stop - max(start, now_ns - WINDOW_NS) for start, stop in past)
        return min(self._longest_ns, self._allowed_ns - used_ns)

    def _watch(self) -> None:
        while True:
            with self._changed:
                if self._closed:
                    return
                self._changed.wait(self.look())
