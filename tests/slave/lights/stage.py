"""A stage for lights: a clock that is set, a driver that takes notes and can fail, limits, and a camera's stamps."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from common.calibration import CameraCalibration, RigCalibration, load
from common.clock import Clock
from common.errors import LightsError
from common.recording.frame_recording import Illumination
from slave.lights.interlock import Lights

ROOT = Path(__file__).resolve().parents[3]
RIG = load(ROOT / "calib_json/rigs/wrist.json", RigCalibration)
CAMERA = load(ROOT / "calib_json/cameras/wrist.json", CameraCalibration)
assert RIG.strobe is not None
STROBE = RIG.strobe
PERIOD_NS = 1e9 / CAMERA.frame_rate_hz
FIRST_NS = 50_000_000_000
LASER, LED, AMBIENT = Illumination.LASER, Illumination.LED, Illumination.AMBIENT
MS = 1_000_000


class SetClock(Clock):
    """A clock that only the test moves."""

    def __init__(self, t_ns: int = FIRST_NS) -> None:
        self.t_ns = t_ns

    def now_ns(self) -> int:
        return self.t_ns


class StageClock(SetClock):
    """A clock that moves when somebody sleeps, too."""

    def sleep(self, seconds: float) -> None:
        self.t_ns += max(round(seconds * 1e9), 1)


class NotedLights(Lights):
    """`Lights` that note when they were switched; each switching takes `takes_ns`, and fails while `fails`."""

    def __init__(self, clock: SetClock, takes_ns: int = 0) -> None:
        self.clock, self.takes_ns = clock, takes_ns
        self.fails = self.closed = False
        self.switched: list[tuple[int, Illumination]] = []
        self.starts: list[int] | None = None  # that the camera's line showed since it was asked last

    def exposure_starts(self) -> list[int] | None:
        found, self.starts = self.starts, self.starts and []
        return found

    def switch(self, lit: Illumination) -> None:
        if self.fails:
            raise LightsError("unplugged")
        self.clock.t_ns += self.takes_ns
        self.switched.append((self.clock.t_ns, lit))

    def close(self) -> None:
        if not self.closed and not self.fails:
            self.off()
        self.closed = True

    def counts(self) -> dict[str, int]:
        return {}

    @property
    def lit(self) -> Illumination:
        return self.switched[-1][1] if self.switched else AMBIENT

    def pulses(self) -> list[tuple[Illumination, int, int]]:
        """Which light, from when to when [ns]."""
        found: list[tuple[Illumination, int, int]] = []
        for (t_ns, lit), (end_ns, _) in zip(self.switched, self.switched[1:], strict=False):
            if lit is not AMBIENT:
                found.append((lit, t_ns, end_ns))
        return found


def stamp(number: int, jitter_ns: float = 0.0, rng: np.random.Generator | None = None) -> int:
    """Mid-exposure of frame `number` [ns]."""
    off = 0.0 if rng is None else rng.normal(0.0, jitter_ns)
    return FIRST_NS + round(number * PERIOD_NS + off)


def exposures(number: int) -> tuple[int, int]:
    """From when to when frame `number` is exposed [ns]."""
    half = round(CAMERA.exposure_us * 500.0)
    return stamp(number) - half, stamp(number) + half


def overlaps(pulse: tuple[Illumination, int, int], number: int) -> bool:
    """Whether a pulse is on during a part of frame `number`."""
    start, stop = exposures(number)
    return pulse[1] < stop and pulse[2] > start


def covers(pulse: tuple[Illumination, int, int], number: int) -> bool:
    """Whether a pulse is on during all of frame `number`."""
    start, stop = exposures(number)
    return pulse[1] <= start and pulse[2] >= stop


Lateness = Callable[[], int]
