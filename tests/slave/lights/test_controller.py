"""The strobe lights every frame by its kind and no other; late wake-ups, stalls, failing drivers leave frames dark."""

import numpy as np
import pytest

from common.recording.frame_recording import Illumination
from slave.lights.controller import AHEAD, CYCLE, FAILED_NS, LEAST, Strobe, StrobeSchedule
from slave.lights.interlock import WINDOW_NS, Interlock
from tests.slave.lights.stage import (
    AMBIENT,
    LASER,
    LED,
    MS,
    PERIOD_NS,
    STROBE,
    Lateness,
    NotedLights,
    SetClock,
    covers,
    exposures,
    overlaps,
    stamp,
)

HANDED_OVER_NS = 15 * MS  # after its stamp a frame arrives


class Stage:
    """Strobe, schedule, guard and driver on a clock of their own, and a camera whose frames arrive late."""

    def __init__(self, takes_ns: int = 0, late: Lateness = lambda: 0) -> None:
        self.clock = SetClock(stamp(0))
        self.lights = NotedLights(self.clock, takes_ns)
        self.interlock = Interlock(self.lights, STROBE, self.clock, watch=False)
        self.strobe = Strobe(StrobeSchedule(90.0, 2000.0, 1000.0), self.interlock, self.clock)
        self.late = late

    def run(
        self, frames: range, jitter_ns: float = 0.0, seed: int = 0, lost: float = 0.0, shown: bool = False
    ) -> None:
        """Let these frames be taken; each is pushed when it arrives, and the strobe stepped when it asked for it.

        `shown`: the camera shows each exposure on a line of its own, which no frame loses.
        """
        rng = np.random.default_rng(seed)
        again = self.strobe.step()
        for k in frames:
            again = self._until(stamp(k) + HANDED_OVER_NS, again)
            if shown:
                self.lights.starts = [*(self.lights.starts or []), exposures(k)[0]]
            if rng.random() >= lost:
                self.strobe.push(k, stamp(k, jitter_ns, rng))
                again = self.strobe.step()
        self._until(stamp(frames[-1]) + HANDED_OVER_NS, again)

    def _until(self, end_ns: int, again: int | None) -> int | None:
        while again is not None and again + (late := self.late()) <= end_ns:
            self.clock.t_ns = max(again + late, self.clock.t_ns)
            again = self.strobe.step()
        self.clock.t_ns = max(end_ns, self.clock.t_ns)
        return again

    def kind(self, number: int) -> Illumination | None:
        """What lit a frame wholly; None: a part of it, or two lights."""
        pulses = [pulse for pulse in self.lights.pulses() if overlaps(pulse, number)]
        if not pulses:
            return AMBIENT
        return pulses[0][0] if len(pulses) == 1 and covers(pulses[0], number) else None


def test_every_frame_is_lit_as_the_cycle_says() -> None:
    stage = Stage()
    stage.run(range(60))
    assert [stage.kind(k) for k in range(20, 58)] == [CYCLE[k % 3] for k in range(20, 58)]
    assert stage.strobe.missed == {"skipped": 0, "late": 0, "no_sync": 0}
    assert stage.interlock.counts["refused"] == 0


@pytest.mark.parametrize("seed", range(3))
def test_jitter_and_lost_frames_change_nothing(seed: int) -> None:
    stage = Stage(takes_ns=300_000)
    stage.run(range(300), jitter_ns=50_000.0, seed=seed, lost=0.2)
    assert [stage.kind(k) for k in range(60, 298)] == [CYCLE[k % 3] for k in range(60, 298)]


def test_exposures_that_the_cameras_line_shows_take_the_place_of_stamps() -> None:
    stamped, shown = Stage(), Stage()
    for stage in (stamped, shown):
        stage.lights.starts = [] if stage is shown else None
        # Stamps scatter by a fifth of a period, frames are lost: nothing can be predicted by them
        stage.run(range(200), jitter_ns=2.2e6, seed=3, lost=0.3, shown=stage is shown)
    illuminations = [shown.kind(k) for k in range(60, 198)]
    assert illuminations in [[CYCLE[(k + first) % 3] for k in range(60, 198)] for first in range(3)]
    assert shown.strobe.missed["no_sync"] == 0
    assert sum(stamped.kind(k) is not AMBIENT for k in range(60, 198)) < 20


def test_a_line_that_shows_nothing_is_counted_and_nothing_is_lit() -> None:
    stage = Stage()
    stage.run(range(40), shown=True)
    assert stage.lights.pulses()
    seen = len(stage.lights.pulses())
    stage.run(range(40, 100))  # frames come, and the wire is off
    assert stage.strobe.missed["no_sync"] == 60 - AHEAD
    assert len(stage.lights.pulses()) < seen + AHEAD
    assert stage.lights.lit is AMBIENT
    stage.run(range(100, 140), shown=True)
    assert stage.kind(135) is CYCLE[135 % 3]


@pytest.mark.parametrize("seed", range(3))
def test_who_wakes_up_late_leaves_frames_dark_and_lights_no_other(seed: int) -> None:
    rng = np.random.default_rng(seed)
    stage = Stage(late=lambda: int(rng.exponential(0.8) * MS))
    stage.run(range(300))
    illuminations = [stage.kind(k) for k in range(20, 298)]
    wanted = [CYCLE[k % 3] for k in range(20, 298)]
    assert all(kind in (AMBIENT, right) for kind, right in zip(illuminations, wanted, strict=True))
    dark = sum(kind is not right for kind, right in zip(illuminations, wanted, strict=True))
    assert 10 < dark < 150
    assert (
        abs(stage.strobe.missed["skipped"] - dark) <= 6
    )  # the first frames after the start, and the last ones
    longest = max(stop - start for _, start, stop in stage.lights.pulses())
    assert longest < PERIOD_NS  # even without the watchdog


def test_a_driver_that_takes_too_long_is_darkened_before_the_frame_is_over() -> None:
    stage = Stage(takes_ns=round(1.2 * MS))
    stage.run(range(40))
    assert stage.strobe.missed["late"] > 10
    assert all(stop - start <= 1.3 * MS for _, start, stop in stage.lights.pulses())


def test_a_stall_goes_dark_and_the_return_is_lit_again() -> None:
    stage = Stage()
    stage.run(range(30))
    stage.run(range(45, 46), lost=1.0)  # nothing comes meanwhile
    stage.clock.t_ns = stamp(60)
    last = max(stop for _, _, stop in stage.lights.pulses())
    assert last < stamp(30 + LEAST)
    assert stage.lights.lit is AMBIENT
    stage.run(range(60, 90))
    assert [stage.kind(k) for k in range(64, 88)] == [CYCLE[k % 3] for k in range(64, 88)]
    stage.run(range(400, 430))  # after a stall so long that all is forgotten
    assert [stage.kind(k) for k in range(415, 428)] == [CYCLE[k % 3] for k in range(415, 428)]


def test_a_stall_ends_a_pulse_at_once() -> None:
    stage = Stage()
    stage.run(range(25))
    while stage.lights.lit is AMBIENT:
        again = stage.strobe.step()
        assert again is not None
        stage.clock.t_ns = again
    stage.strobe.stalled()
    assert stage.lights.lit is AMBIENT


def test_a_driver_that_is_unplugged_is_tried_again_and_comes_back() -> None:
    stage = Stage()
    stage.run(range(30))
    stage.lights.fails = True
    stage.run(range(30, 60))
    assert 1 <= stage.interlock.counts["failed"] <= 4  # not at every frame
    stage.lights.fails = False
    stage.interlock.look()
    # A light that could not be darkened counts as on, so its duty is used up for a second.
    rest = round((FAILED_NS + WINDOW_NS) / PERIOD_NS) + 3
    stage.run(range(60, 60 + rest + 30))
    assert stage.kind(60 + rest + 10) is CYCLE[(60 + rest + 10) % 3]


def test_exposures_do_not_touch() -> None:
    assert exposures(1)[1] < exposures(2)[0]
    assert (LASER, LED) == CYCLE[1:]
