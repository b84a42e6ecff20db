"""What became of one fault: brought about, watched, taken away, and judged against what is expected.

A machine that has other things to do is late by itself, with or without a fault. So what is steady is what the rig did
just before the fault; how far the machine is behind is measured meanwhile, by how late a sleep of this process ends;
and where a fault was not as expected while it was behind, it is brought about once more. What remains is allowed that
lag for each of the things that follow one another until all is well, and the table says how far behind the machine
was. What is false is false anywhere.
"""

import threading
import time
from dataclasses import dataclass, field, replace

import numpy as np

from bench.faults_links import Fault
from bench.faults_poses import ReceivedPose
from bench.faults_rig import FaultRig, asked

GOAL_S = 2.0
SANE_SIGMAS = 6.0  # of a valid joint, in its own standard deviations
SANE_MM, LIKELY_SIGMAS = 60.0, 3.5  # of a tracked joint: so far off only where it says that this is likely
AFTER_S = 1.0
STEP_S = 0.02
BEHIND_S = 0.05  # so late a sleep is where a machine has other things to do
FOLLOWING = (
    20  # things that follow one another until all is well: hello, answer, echoes, frames, an instant, a pose
)
TRIES = 2
LEAST_HZ = 6.0  # two cameras and a master that make fewer poses before any fault have no machine to run on


@dataclass(frozen=True, slots=True)
class Run:
    """One run of a fault.

    Attributes:
        lasted_s: From its beginning to the end of its cause [s].
        recovery_s: From the end of its cause to steady, right poses [s]; None: never.
        share: Poses during it, of as many as came before it.
        worst_mm: Worst error of a tracked joint from its beginning to a second after; NaN: none was tracked.
        beyond: Worst error of a joint that is said to be valid, in its own standard deviations.
        false: Poses that are sure and wrong (`false`).
        oldest_s: The oldest pose that came, by its own time.
        counts: What the master counted more than before, of those that tell it.
        listed: Codes of the checklist meanwhile.
        grown_mb: Memory of the master afterwards, against before.
        lag_s: How far the machine was behind at worst [s].
    """

    lasted_s: float
    recovery_s: float | None
    share: float
    worst_mm: float
    beyond: float
    false: int
    oldest_s: float
    counts: dict[str, int] = field(default_factory=dict[str, int])
    listed: frozenset[str] = frozenset()
    grown_mb: float = 0.0
    lag_s: float = 0.0

    @property
    def allowed_s(self) -> float:
        """Within what all has to be well: two seconds, and more where the machine was behind."""
        return GOAL_S + (FOLLOWING * self.lag_s if self.lag_s > BEHIND_S else 0.0)

    @property
    def over(self) -> bool:
        """Whether all was well again in time."""
        return self.recovery_s is not None and self.recovery_s <= self.allowed_s

    def wrong(self, fault: Fault) -> list[str]:
        """In what it is not as expected."""
        out: list[str] = []
        if not self.over:
            out.append("recovery")
        if self.false:
            out.append("false poses")
        if self.share < fault.tracks:
            out.append("rate")
        if fault.counts and not any(self.counts.values()):
            out.append("not counted")
        if not set(fault.listed) <= self.listed:
            out.append("not listed")
        return out


def false(one: ReceivedPose) -> bool:
    """Whether a pose says what is not so: sure of a joint and wrong about it."""
    return one.beyond > SANE_SIGMAS or (one.worst_mm > SANE_MM and one.beyond > LIKELY_SIGMAS)


class Lag:
    """The worst that a sleep of this process was late. Holds a thread."""

    def __init__(self) -> None:
        """Measure from now on."""
        self.worst_s = 0.0
        self._stop = threading.Event()
        threading.Thread(target=self._measure, daemon=True).start()

    def close(self) -> None:
        """Measure no more."""
        self._stop.set()

    def _measure(self) -> None:
        while not self._stop.is_set():
            began = time.monotonic()
            time.sleep(STEP_S)
            self.worst_s = max(self.worst_s, time.monotonic() - began - STEP_S)


class _Listed:
    """All codes that are on the checklist while it looks. Holds them and a thread."""

    def __init__(self, rig: FaultRig) -> None:
        self.codes: set[str] = set()
        self._rig, self._stop = rig, threading.Event()
        self._thread = threading.Thread(target=self._look, daemon=True)
        self._thread.start()

    def close(self) -> frozenset[str]:
        self._stop.set()
        self._thread.join()
        return frozenset(self.codes)

    def _look(self) -> None:
        while not self._stop.wait(0.05):
            self.codes |= {code for code, _ in self._rig.listed()}


def measured(rig: FaultRig, fault: Fault) -> Run:
    """Bring it about; once more where it was not over in time, or not told, and the machine was behind."""
    for _ in range(TRIES - 1):
        run = measure(rig, fault)
        if not run.wrong(fault) or run.false or run.lag_s < BEHIND_S:
            return run
    return measure(rig, fault)


def measure(rig: FaultRig, fault: Fault) -> Run:
    """Bring it about and wait until all is well, as well as the rig was just before."""
    rig.own_pace()
    lag = Lag()
    try:
        run = _measure(rig, fault)
    finally:
        lag.close()
    return replace(run, lag_s=lag.worst_s)


def _measure(rig: FaultRig, fault: Fault) -> Run:
    rig.steady_after(time.monotonic())
    before, memory = asked(rig), rig.anonymous_mb()
    listed, began = _Listed(rig), time.monotonic()
    ended = fault.bring(rig)
    recovery_s = rig.steady_after(ended)
    time.sleep(AFTER_S)
    codes = listed.close()
    received = rig.poses.since(began, ended + max(recovery_s or 0.0, AFTER_S))
    during = [one for one in received if one.came_s < ended]
    after = asked(rig)
    base = {} if fault.restarts else before
    grown_mb = 0.0 if fault.restarts else rig.anonymous_mb() - memory
    seen = [one for one in received if np.isfinite(one.worst_mm)]
    return Run(
        lasted_s=ended - began,
        recovery_s=recovery_s,
        share=len(during) / max(rig.pace.rate_hz * (ended - began), 1.0),
        worst_mm=max((one.worst_mm for one in seen), default=float("nan")),
        beyond=max((one.beyond for one in received), default=0.0),
        false=sum(false(one) for one in received),
        oldest_s=max((one.age_s for one in received), default=0.0),
        counts={name: after.get(name, 0) - base.get(name, 0) for name in fault.counts},
        listed=codes,
        grown_mb=grown_mb,
    )
