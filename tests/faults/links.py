"""Faults of links, clocks and processes, brought about on real processes: expected and measured.

Prints the table of docs/faults.md. Goal: steady and right poses again within two seconds of the end of the cause, no
false pose meanwhile, and a count that reports it. Steady is the pace of the rig just before the fault; a fault that was
not as expected while the machine was behind (by how late a sleep of this process ends) is brought about once more.
"""

import argparse
import os
import signal
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np

from bench.rigs.local import UP_S, Rig, RigError, until
from bench.rigs.rooms import DESK, slower, standard_scene
from bench.rigs.sender import WAY_S, scene_s
from common.arrays import Float
from common.errors import BusError
from common.messages import WIRE_VERSION, Checklist, HandPose
from common.messages.streams import MASTER
from tests.faults.relay import Impairment, UdpRelay
from tests.lag import Lag

_GRID_HZ = 200.0
_GAP_S = 0.2


@dataclass(frozen=True, slots=True)
class Judged:
    """One pose."""

    came_s: float  # when, `time.monotonic`
    age_s: float  # how old it was then, by its own time
    worst_mm: float  # error of the worst TRACKED joint; NaN: none is tracked
    beyond: float  # worst error of a valid joint, in its own standard deviations

    @property
    def false(self) -> bool:
        """Whether it is sure of a joint and wrong about it."""
        false_sigmas = 6.0  # of a valid joint, in its own standard deviations
        # Of a TRACKED joint: so far off only where its covariance makes that likely.
        false_mm, likely_sigmas = 60.0, 3.5
        return self.beyond > false_sigmas or (self.worst_mm > false_mm and self.beyond > likely_sigmas)


@dataclass(frozen=True, slots=True)
class Pace:
    """How poses come: so many a second, with gaps no longer than this [s]."""

    rate_hz: float
    gap_s: float = _GAP_S


class Poses:
    """All poses of one hand, judged by the scene of `bench.rigs.sender --way`. Holds them, and a table of the scene."""

    def __init__(self, epoch_ns: int) -> None:
        """Of the scene that began then."""
        self._epoch_ns, self._lock, self._judged = epoch_ns, threading.Lock(), list[Judged]()
        scene, count = standard_scene(), round(WAY_S * _GRID_HZ) + 2
        self._table: Float = np.stack([scene.truth(k / _GRID_HZ).joints.position_m for k in range(count)])

    def take(self, message: object, came_ns: int) -> None:
        """Judge a pose that came at `came_ns`; other messages are ignored."""
        if isinstance(message, HandPose):
            judged = self.judged(message, came_ns)
            with self._lock:
                self._judged.append(judged)

    def since(self, moment_s: float, until_s: float = float("inf")) -> list[Judged]:
        """Return those that came in between, `time.monotonic`."""
        with self._lock:
            return [one for one in self._judged if moment_s <= one.came_s < until_s]

    def judged(self, pose: HandPose, came_ns: int) -> Judged:
        """Compare a pose with the truth."""
        at = scene_s((pose.t_ns - self._epoch_ns) * 1e-9) * _GRID_HZ
        k = int(at)
        truth = self._table[k] + (at - k) * (self._table[k + 1] - self._table[k])
        error = np.linalg.norm(pose.position_m - truth, axis=1)
        sigma = np.sqrt(np.trace(pose.cov_m2, axis1=1, axis2=2))
        beyond = float(np.max(error / sigma, where=pose.valid, initial=0.0))
        worst_mm = 1e3 * float(error[pose.tracked].max()) if pose.tracked.any() else np.nan
        return Judged(came_ns * 1e-9, (came_ns - pose.t_ns) * 1e-9, worst_mm, beyond)


def pace_of(judged: list[Judged], began_s: float, ended_s: float, rate_hz: float) -> Pace:
    """Return the pace from `began_s` to `ended_s`: at most `rate_hz`; gaps half as long again as the longest."""
    came = [began_s, *(one.came_s for one in judged), ended_s]
    longest_s = max(b - a for a, b in pairwise(came))
    return Pace(min(rate_hz, len(judged) / (ended_s - began_s)), max(_GAP_S, 1.5 * longest_s))


def steady_from(judged: list[Judged], moment_s: float, pace: Pace) -> float | None:
    """Return when, after `moment_s`, poses came steadily and were right for half a second; None: not yet.

    Steady: four fifths of the number of the pace, no gap above its own, no TRACKED joint off by more than 20 mm.
    """
    came = [one for one in judged if one.came_s >= moment_s]
    steady_s, steady_share = 0.5, 0.8
    sane_mm = 20.0  # of a TRACKED joint; the scene's hand is 180 mm long
    for k, first in enumerate(came):
        window = [one for one in came[k:] if one.came_s < first.came_s + steady_s]
        if came[-1].came_s < first.came_s + steady_s:
            return None
        gaps = [b.came_s - a.came_s for a, b in pairwise(window)]
        enough = len(window) >= steady_share * steady_s * pace.rate_hz and max(gaps, default=9.0) < pace.gap_s
        if enough and all(one.worst_mm < sane_mm for one in window):
            return first.came_s
    return None


CAMERAS = ("left", "right")
RATE_HZ = 30.0
LEAST_HZ = 6.0  # with fewer poses before any fault this machine can show nothing
_CLOCK_S = {"left": 3.0, "right": -5.0}
_CUT_S, _STOPPED_S, _CRASHES, _RESTART_S = 5.0, 3.0, 4, 1.0
_BEHIND_S = 0.05  # so late is a sleep where a machine has other work
HEAD = (
    "| fault | expected | back after (median, slowest) | poses during it | worst tracked joint | false | oldest pose"
    " | counted | checklist |\n|---|---|--:|--:|--:|--:|--:|---|---|"
)


class FaultRig(Rig):
    """Two simulated cameras, a relay, a master, and a program on its bus.

    `pace`: what is steady for this rig: nominal, or its own where a machine has other work (`own_pace`).
    """

    def __init__(self, folder: Path, master_options: Sequence[str] = ()) -> None:
        """Start everything and wait until it tracks; RigError: it does not in time."""
        super().__init__(folder)
        self.tree = slower(folder, dict.fromkeys(CAMERAS, RATE_HZ))
        self.pace, self.epoch_ns, self._options = Pace(RATE_HZ), time.monotonic_ns(), tuple(master_options)
        self.relay, self.poses = UdpRelay(self.beacon_port, seed=11), Poses(self.epoch_ns)
        self.codes = set[str]()
        self.closing.append(self.relay.close)
        try:
            self.begin_master()
            for camera in CAMERAS:
                self.start_camera(camera)
            self.join()
            self.read("hand", lambda pose: self.poses.take(pose, time.monotonic_ns()))
            self.read("checklist", self._list)
            if not until(lambda: len(self.poses.since(0.0)) > RATE_HZ, UP_S):
                raise RigError(f"no poses; logs are in {self.folder}")
            self.steady_after(time.monotonic())  # a machine that has other work may never be
        except BaseException:
            self.close()
            raise

    def begin_master(self) -> None:
        """Start the master behind the relay."""
        self.start_master(self.tree, [DESK], *self._options, beacon="{}:{}".format(*self.relay.beacon))

    def start_camera(self, camera: str, name: str = "", key: str = "", wire: int = WIRE_VERSION) -> None:
        """Start the process of a camera, known as `name`; return when it listens."""
        place = [str(self.tree), DESK, str(RATE_HZ), str(self.beacon_port), str(self.epoch_ns), "--way"]
        own = ["--cameras", camera, "--clock-s", str(_CLOCK_S[camera]), "--wire", str(wire)]
        env = {"PHALANX_RIG_KEY": key or self.key}
        self.start(name or camera, "bench.rigs.sender", *place, *own, ready="ready", **env)

    def tell(self, name: str, line: str) -> None:
        """Write a line to a camera's process."""
        pipe = self.processes[name].stdin
        assert pipe is not None
        pipe.write(line + "\n")
        pipe.flush()

    def steady_after(self, moment_s: float, patience_s: float = 20.0) -> float | None:
        """Return how long after a moment poses came steadily and right again [s]; None: not within the patience."""
        found: list[float] = []

        def steady() -> bool:
            at = steady_from(self.poses.since(moment_s), moment_s, self.pace)
            found.extend([] if at is None else [at - moment_s])
            return bool(found)

        return found[0] if until(steady, patience_s) else None

    def own_pace(self, seconds: float = 1.0) -> Pace:
        """Measure how poses come while nothing is wrong; steadiness is judged by that from now on."""
        began = time.monotonic()
        time.sleep(seconds)
        ended = time.monotonic()
        self.pace = pace_of(self.poses.since(began, ended), began, ended, RATE_HZ)
        return self.pace

    def _list(self, message: object) -> None:
        if isinstance(message, Checklist):
            self.codes |= {item.code for item in message.items}


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault; `bring` brings it about, waits while it lasts, takes it away, returns when its cause had ended."""

    name: str  # for the command line
    what: str
    expected: str
    bring: Callable[[FaultRig], float]
    counts: tuple[str, ...] = ()  # the master's counts of it: at least one rises. None named: nothing need
    listed: tuple[str, ...] = ()  # codes of the checklist meanwhile
    tracks: float = 0.0  # poses go on during it at this share of the nominal rate at least
    restarts: bool = False  # the master is a new process afterwards: its counts begin at 0


def of_links(seconds: float = 4.0) -> list[Fault]:
    """Return all of them; those that only change a number last so long."""
    s = seconds
    step_s = 10.0
    return [
        Fault("loss", "20 % of all datagrams lost", "tracks on; lost ones counted", _way(s, loss=0.2),
              ("left.lost", "right.lost"), ("packet_loss",), tracks=0.7),
        Fault("jitter", "0 to 50 ms late, evenly", "tracks on; a frame overtaken by its next is dropped as late",
              _way(s, jitter_s=0.05), ("left.late", "right.late"), tracks=0.5),
        Fault("reorder", "a tenth held back by 40 ms", "tracks on; late frames counted",
              _way(s, reorder=0.1, held_s=0.04), ("left.reordered", "right.reordered"), tracks=0.7),
        Fault("duplicates", "every third datagram twice", "tracks on; copies refused", _way(s, duplicate=0.34),
              ("refused.duplicate",), tracks=0.7),
        Fault("cut", f"cable out for {_CUT_S:g} s", "no poses, none made up; back with the sessions of before", cut(),
              ("left.lost", "right.lost", "left.skipped", "right.skipped"), ("camera_absent",)),
        Fault("master_restart", "kill -9 of the master, and a new one", "cameras join the new one by themselves",
              _master_again, restarts=True),
        Fault("slave_crashes", f"kill -9 of a slave, {_CRASHES} times, begun again after {_RESTART_S:g} s",
              "each new process replaces the last", _crash_loop, ("left.restarts",), ("camera_absent",)),
        Fault("step_ahead", f"a slave's clock jumps {step_s:g} s ahead", "frames of the future are refused; clock"
              " measured anew", _step(step_s), ("left.clock_steps",)),
        Fault("step_back", f"a slave's clock jumps {step_s:g} s back", "clock measured anew", _step(-step_s),
              ("left.clock_steps",)),
        Fault("slave_stopped", f"SIGSTOP of a slave for {_STOPPED_S:g} s", "one camera alone: tracked for 0.4 s,"
              " then depth is unsure", _stopped("left"), ("left.lost", "left.skipped"), ("camera_absent",)),
        Fault("master_stopped", f"SIGSTOP of the master for {_STOPPED_S:g} s",
              "of what waited the newest second counts", _stopped(MASTER)),
        Fault("wrong_key", "a slave comes back with another rig's key, then with its own", "refused: it"
              " receives a foreign rig; the camera is absent", _other(key="5a" * 32), (), ("camera_absent",)),
        Fault("version", "a slave of another wire version, then ours", "refused; named on both sides",
              _other(wire=WIRE_VERSION - 1), ("refused.version",), ("version_mismatch",)),
        Fault("duplicate", "a second process of a camera's name", "the first keeps its session; both sides report it",
              _duplicate, ("refused.duplicate_sender",), ("duplicate_sender",), tracks=0.7),
    ]  # fmt: skip


def _way(seconds: float, **worse: float) -> Callable[[FaultRig], float]:
    def bring(rig: FaultRig) -> float:
        rig.relay.way = Impairment(**worse)
        time.sleep(seconds)
        rig.relay.way = Impairment()
        return time.monotonic()

    return bring


def cut(seconds: float = _CUT_S) -> Callable[[FaultRig], float]:
    """Pull the cable for so long."""

    def bring(rig: FaultRig) -> float:
        rig.relay.cut = True
        time.sleep(seconds)
        rig.relay.cut = False
        return time.monotonic()

    return bring


def _master_again(rig: FaultRig) -> float:
    """It is away until the new one listens: that takes as long as such a process takes to start."""
    rig.kill(MASTER)
    rig.begin_master()
    return time.monotonic()


def _crash_loop(rig: FaultRig) -> float:
    for _ in range(_CRASHES):
        rig.kill("left")
        time.sleep(_RESTART_S)
        rig.start_camera("left")
    return time.monotonic()


def _step(by_s: float) -> Callable[[FaultRig], float]:
    def bring(rig: FaultRig) -> float:
        rig.tell("left", f"step {by_s}")
        return time.monotonic()

    return bring


def _stopped(name: str) -> Callable[[FaultRig], float]:
    def bring(rig: FaultRig) -> float:
        rig.processes[name].send_signal(signal.SIGSTOP)
        time.sleep(_STOPPED_S)
        rig.processes[name].send_signal(signal.SIGCONT)
        return time.monotonic()

    return bring


def _other(key: str = "", wire: int = WIRE_VERSION) -> Callable[[FaultRig], float]:
    def bring(rig: FaultRig) -> float:
        rig.start_camera("right", key=key, wire=wire)
        time.sleep(2.0)
        rig.start_camera("right")
        return time.monotonic()

    return bring


def _duplicate(rig: FaultRig) -> float:
    rig.start_camera("left", "second left")
    time.sleep(3.0)
    rig.kill("second left")
    return time.monotonic()


@dataclass(frozen=True, slots=True)
class Run:
    """One run of a fault."""

    recovery_s: float | None  # from the end of its cause to steady, right poses [s]; None: never
    share: float  # poses during it, of as many as came before it
    worst_mm: float  # of TRACKED joints, from its beginning to a second after; NaN: none was tracked
    beyond: float  # worst error of a valid joint, in its own standard deviations
    false: int  # poses that are sure and wrong
    oldest_s: float  # age of the oldest pose that came, by its own time
    counts: dict[str, int] = field(default_factory=dict[str, int])  # rise of the master's counts of it
    listed: frozenset[str] = frozenset()  # codes of the checklist meanwhile
    grown_mb: float = 0.0  # memory of the master afterwards, against before
    lag_s: float = 0.0  # worst delay of the machine [s]

    @property
    def allowed_s(self) -> float:
        """Within what all has to be well: two seconds, and more where the machine was behind."""
        following = 20  # steps until all is well: hello, answer, echoes, frames, an epoch, a pose
        return 2.0 + (following * self.lag_s if self.lag_s > _BEHIND_S else 0.0)

    @property
    def over(self) -> bool:
        """Whether all was well again in time."""
        return self.recovery_s is not None and self.recovery_s <= self.allowed_s

    def wrong(self, fault: Fault) -> list[str]:
        """Return in what it is not as expected."""
        checks = {
            "recovery": not self.over,
            "false poses": self.false > 0,
            "rate": self.share < fault.tracks,
            "not counted": bool(fault.counts) and not any(self.counts.values()),
            "not listed": not set(fault.listed) <= self.listed,
        }
        return [name for name, holds in checks.items() if holds]


def measured(rig: FaultRig, fault: Fault) -> Run:
    """Bring it about; once more where it was not as expected, and the machine was behind."""
    run = _measured(rig, fault)
    if not run.wrong(fault) or run.false or run.lag_s < _BEHIND_S:
        return run
    return _measured(rig, fault)


def _measured(rig: FaultRig, fault: Fault) -> Run:
    """Bring it about and wait until all is as well as just before."""
    rig.own_pace()
    lag = Lag()
    rig.steady_after(time.monotonic())
    before, memory = counts_of(rig), rig.footprint().anonymous_mb
    rig.codes.clear()
    began = time.monotonic()
    ended = fault.bring(rig)
    recovery_s = rig.steady_after(ended)
    after_s = 1.0
    time.sleep(after_s)
    lag.close()
    judged = rig.poses.since(began, ended + max(recovery_s or 0.0, after_s))
    during, after = [one for one in judged if one.came_s < ended], counts_of(rig)
    base = {} if fault.restarts else before
    return Run(
        recovery_s=recovery_s,
        share=len(during) / max(rig.pace.rate_hz * (ended - began), 1.0),
        worst_mm=max((one.worst_mm for one in judged if np.isfinite(one.worst_mm)), default=float("nan")),
        beyond=max((one.beyond for one in judged), default=0.0),
        false=sum(one.false for one in judged),
        oldest_s=max((one.age_s for one in judged), default=0.0),
        counts={name: after.get(name, 0) - base.get(name, 0) for name in fault.counts},
        listed=frozenset(rig.codes),
        grown_mb=0.0 if fault.restarts else rig.footprint().anonymous_mb - memory,
        lag_s=lag.worst_s,
    )


def counts_of(rig: Rig) -> dict[str, int]:
    """Return the master's counts, or none while it is away."""
    try:
        return rig.counts()
    except BusError:
        return {}


def row(fault: Fault, runs: Sequence[Run]) -> str:
    """Return a line of the table."""
    back = [one.recovery_s for one in runs if one.recovery_s is not None]
    text = f"{statistics.median(back):.2f} s, {max(back):.2f} s" if back else "never"
    if back and len(back) < len(runs):
        text += f" ({len(runs) - len(back)} never)"
    if (behind_s := max(one.lag_s for one in runs)) > _BEHIND_S:
        text += f" (machine up to {behind_s:.2f} s behind)"
    counts = {name: statistics.median(one.counts.get(name, 0) for one in runs) for name in fault.counts}
    counted = ", ".join(f"`{name}` {number:.0f}" for name, number in counts.items() if number) or "–"
    listed = ", ".join(f"`{code}`" for code in sorted({code for one in runs for code in one.listed})) or "–"
    worst = max((one.worst_mm for one in runs if np.isfinite(one.worst_mm)), default=None)
    joint = "none tracked" if worst is None else f"{worst:.0f} mm"
    wrong = sorted({one for run in runs for one in run.wrong(fault)})
    return (
        f"| {fault.what} | {fault.expected} | {text} | {100.0 * statistics.median(one.share for one in runs):.0f} %"
        f" | {joint}, {max(one.beyond for one in runs):.1f} σ | {sum(one.false for one in runs)}"
        f" | {max(one.oldest_s for one in runs):.2f} s | {counted} | {listed} |"
        + (f" **{', '.join(wrong)}**" if wrong else "")
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Bring all about, print the table; 1 if one is not as expected, 2 if this machine can show nothing."""
    parser = argparse.ArgumentParser("make faults", description=__doc__)
    parser.add_argument("--runs", type=int, default=3, metavar="N", help="of each fault (default: 3)")
    options = parser.parse_args(arguments)
    wrong = False
    with tempfile.TemporaryDirectory(prefix="phalanx-faults-") as folder:
        rig = FaultRig(Path(folder) / "rig")
        try:
            rate_hz = rig.own_pace(3.0).rate_hz
            load = f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"
            print(f"{load}; {rate_hz:.0f} poses/s\n\n{HEAD}", flush=True)
            if rate_hz < LEAST_HZ:
                print(f"fewer than {LEAST_HZ:g} poses a second: this machine has too much other work")
                return 2
            for fault in of_links():
                runs = [measured(rig, fault) for _ in range(options.runs)]
                wrong |= any(run.wrong(fault) for run in runs)
                print(row(fault, runs), flush=True)
        finally:
            rig.close()
    return int(wrong)


if __name__ == "__main__":
    sys.exit(main())
