"""Predict the exposures of a camera, and switch its lights in step.

The strobe is that of Kim et al. 2012: ambient, laser, LED as frame number k modulo 3 is 0, 1, 2. Which frame is
number 0 is agreed with nobody: a frame is classified by its content (`slave.wrist.strobe`).

The stamps of a camera that runs freely lie on a line: mid-exposure = first + number x period. It is fitted to the
last ones by least squares, numbers counted by time alone (so that lost frames do no harm), and read where the next
frames will be. There is no schedule until an exposure is known to a part of the lead, and none beyond `AHEAD` periods
after the last frame: a camera that stalls is not lit.

Where a GPIO line of the camera shows its exposures, their starts as the kernel stamped them take the place of all
stamps of frames; a camera that is silent on it is not lit (`no_sync`).

A light goes on a lead before its exposure and off right after it. Whoever comes too late for the beginning of an
exposure skips that pulse (`skipped`): a frame without its light makes no cycle, a light that smears into the next
frame might become a wrong one. A light that came on only after the exposure had begun goes off at once (`late`).
"""

import logging
from collections import Counter, deque
from dataclasses import dataclass

import numpy as np

from common.clock import Clock
from common.errors import LightsError
from common.recording.frame_recording import Illumination
from slave.lights.interlock import Interlock

CYCLE = (Illumination.AMBIENT, Illumination.LASER, Illumination.LED)
LEAST = 9  # stamps before anything is predicted
AHEAD = 9  # periods after the last stamp: a frame is handed over late, and some may be lost
OFF_LINE = 0.25  # periods; a stamp farther from the line belongs to another one
MARGIN_NS = 200_000  # a light is on from so long before an exposure to so long after it at least


@dataclass(frozen=True, slots=True)
class Pulse:
    """One light for one exposure; times on the clock of the stamps [ns]."""

    number: int  # frame number in the cycle's count
    lit: Illumination
    on_ns: int
    latest_ns: int  # later than this it must not go on any more: the exposure would begin without it
    off_ns: int


@dataclass(frozen=True, slots=True)
class _Line:
    """Stamp of frame k: t_ns + off_ns + (k - number) x period_ns."""

    number: int
    t_ns: int
    off_ns: float
    period_ns: float

    def at(self, number: int) -> float:
        """Stamp of a frame [ns]."""
        return self.t_ns + (self.off_ns + (number - self.number) * self.period_ns)


class StrobeSchedule:
    """Predicts exposures from the last stamps and the line through them.

    `restarts` counts how often the stamps left the line, or were away too long, and a new one was begun.
    """

    def __init__(
        self, frame_rate_hz: float, exposure_us: float, lead_us: float, offset_us: float = 0.0
    ) -> None:
        """Know of no frame yet; a light goes on `lead_us` before an exposure [us].

        `frame_rate_hz` counts single frames; `exposure_us` includes the reading of all rows of a rolling shutter;
        exposures are `offset_us` later than their stamps.
        """
        self._nominal_ns = 1e9 / frame_rate_hz
        self._lead_ns, self._offset_ns = round(lead_us * 1e3), round(offset_us * 1e3)
        self.expose(exposure_us)
        kept = 45  # stamps: half a second at 90 Hz, over which no oscillator drifts by a microsecond
        self._stamps: deque[tuple[int, int]] = deque(maxlen=kept)
        self._line: _Line | None = None
        self.restarts = 0

    def expose(self, exposure_us: float) -> None:
        """Take another exposure time [us], from the next pulse on."""
        self._half_ns = round(exposure_us * 500.0)

    @property
    def length_ns(self) -> int:
        """Of a pulse as planned [ns]."""
        return self._lead_ns + 2 * self._half_ns + MARGIN_NS

    def push(self, seq: int, t_ns: int) -> bool:
        """Take a mid-exposure [ns]; whether a new line begins, counted from `seq`."""
        if not self._stamps:
            self._stamps.append((seq, t_ns))
            return True
        number, last_ns = self._stamps[-1]
        line = self._line or _Line(number, last_ns, 0.0, self._nominal_ns)
        periods = (t_ns - line.at(number)) / line.period_ns
        step = round(periods)
        # After 90 periods without a frame a new line is begun
        if abs(periods - step) > OFF_LINE or not 0 <= step <= 90:
            self.restarts += 1
            self._stamps.clear()
            self._stamps.append((seq, t_ns))
            self._line = None
            return True
        if step > 0:  # else it is the last one again
            self._stamps.append((number + step, t_ns))
            if self._line is None or (number + step) % len(CYCLE) == 0:  # once a cycle is often enough
                self._line = self._fitted()
        return False

    def stamp_of(self, start_ns: int) -> int:
        """The stamp that a frame would have whose exposure starts then [ns]."""
        return start_ns + self._half_ns - self._offset_ns

    def forget(self) -> None:
        """The camera has stopped: predict nothing until its frames are known anew."""
        self._stamps.clear()
        self._line = None

    def before(self, now_ns: int) -> int:
        """Number of the last frame whose exposure has begun; -1: not known."""
        if self._line is None:
            return -1
        number = self._stamps[-1][0]
        begun_ns = self._line.at(number) + self._offset_ns - self._half_ns
        return number + int((now_ns - begun_ns) // self._line.period_ns)

    def after(self, number: int) -> Pulse | None:
        """First pulse after frame `number`; None: not known, or too far ahead."""
        if self._line is None:
            return None
        for k in range(number + 1, self._stamps[-1][0] + AHEAD + 1):
            lit = CYCLE[k % len(CYCLE)]
            if lit is not Illumination.AMBIENT:
                middle_ns = round(self._line.at(k)) + self._offset_ns
                start_ns, stop_ns = middle_ns - self._half_ns, middle_ns + self._half_ns
                return Pulse(k, lit, start_ns - self._lead_ns, start_ns - MARGIN_NS // 2, stop_ns + MARGIN_NS)
        return None

    def _fitted(self) -> _Line | None:
        """The line through the stamps; None: not known well enough."""
        if len(self._stamps) < LEAST:
            return None
        first_number, first_ns = self._stamps[0]
        k = np.array([number - first_number for number, _ in self._stamps], np.float64)
        t = np.array([t_ns - first_ns for _, t_ns in self._stamps], np.float64)
        middle, mean = k.mean(), t.mean()
        spread = float(((k - middle) ** 2).sum())
        slope = float(((k - middle) * (t - mean)).sum()) / spread
        at_first = float(mean - slope * middle)
        rms = float(np.sqrt(((t - at_first - slope * k) ** 2).sum() / (len(k) - 2)))
        farthest = k[-1] + AHEAD - middle
        sigma = rms * float(np.sqrt(1.0 / len(k) + farthest**2 / spread))
        # Three standard deviations of the prediction must fit into the margin
        if 3.0 * sigma > MARGIN_NS or abs(slope / self._nominal_ns - 1.0) > OFF_LINE / AHEAD:
            return None
        return _Line(first_number, first_ns, at_first, slope)


FAILED_NS = 500_000_000  # after a driver has failed, no light for so long; then it is tried again
_LOG = logging.getLogger(__name__)


class Strobe:
    """Switches the light of each frame, as predicted from the stamps of those before.

    Whoever has it calls `step` when that asks to; all calls come from one thread.
    `missed`: pulses `skipped`, as it was too late for them; `late`, ended at once, as the driver took too long; frames
    for whose exposures the camera's line has shown nothing any more, `no_sync`.
    """

    def __init__(self, schedule: StrobeSchedule, interlock: Interlock, clock: Clock) -> None:
        self._schedule, self._interlock, self._clock = schedule, interlock, clock
        self._on: Pulse | None = None
        self._number = -1
        self._rest_until_ns: int | None = None
        self._logged_ns: int | None = None
        self._silent = 0  # frames since the camera's line last showed an exposure
        self.missed = Counter({"skipped": 0, "late": 0, "no_sync": 0})

    def push(self, seq: int, t_ns: int) -> None:
        """Take a frame's mid-exposure [ns], or what the camera's line showed of others."""
        try:
            starts = self._interlock.exposure_starts()
        except LightsError as error:
            self._log_fault(t_ns, error)
            starts = []
        stamps = [t_ns] if starts is None else [self._schedule.stamp_of(start_ns) for start_ns in starts]
        self._silent = 0 if stamps else self._silent + 1
        self.missed["no_sync"] += self._silent > AHEAD
        for stamp_ns in stamps:
            if self._schedule.push(seq, stamp_ns):
                self._number = -1

    def expose(self, exposure_us: float) -> None:
        """Take another exposure time [us]."""
        self._schedule.expose(exposure_us)

    def stalled(self) -> None:
        """Go dark, and forget the stamps: there are no frames any more."""
        self._schedule.forget()
        self._number = -1
        self._dark()

    def counts(self) -> dict[str, int]:
        """`lights.<event>` -> how often, of lights, strobe and schedule."""
        own = {**self._interlock.events(), **self.missed, "restarts": self._schedule.restarts}
        return {f"lights.{event}": count for event, count in own.items()}

    def close(self) -> None:
        """Go dark, give the lights back. Safe to call twice."""
        self._dark()
        self._interlock.close()

    def step(self) -> int | None:
        """Do what is due; when to come again [ns], None: when there is another frame."""
        now_ns = self._clock.now_ns()
        if self._rest_until_ns is not None and now_ns < self._rest_until_ns:
            return self._rest_until_ns
        try:
            return self._step(now_ns)
        except LightsError as error:
            self._rest_until_ns = now_ns + FAILED_NS
            self._on = None
            self._log_fault(now_ns, error)
            return self._rest_until_ns

    def _dark(self) -> None:
        """End what is on, now: the camera has stopped, or all ends."""
        self._on = None
        try:
            self._interlock.end()
        except LightsError as error:
            self._log_fault(self._clock.now_ns(), error)

    def _step(self, now_ns: int) -> int | None:
        if self._on is not None:
            if now_ns < self._on.off_ns:
                return self._on.off_ns
            self._interlock.end()
            self._on = None
        if self._number < 0:
            self._number = self._schedule.before(now_ns)
        pulse = self._schedule.after(self._number)
        while pulse is not None and now_ns > pulse.latest_ns:
            self.missed["skipped"] += 1
            self._number = pulse.number
            pulse = self._schedule.after(self._number)
        if pulse is None or now_ns < pulse.on_ns:
            return None if pulse is None else pulse.on_ns
        self._number = pulse.number
        if not self._interlock.begin(pulse.lit, pulse.off_ns - now_ns):
            return pulse.off_ns
        if self._clock.now_ns() > pulse.latest_ns:
            self.missed["late"] += 1
            self._interlock.end()
        else:
            self._on = pulse
        return pulse.off_ns

    def _log_fault(self, now_ns: int, error: LightsError) -> None:
        if self._logged_ns is None or now_ns - self._logged_ns >= 10_000_000_000:  # one line in ten seconds
            self._logged_ns = now_ns
            _LOG.warning("lights: %s", error)
