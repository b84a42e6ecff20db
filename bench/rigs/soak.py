"""An hour of a whole rig on this machine: does memory grow, does latency, was anything lost?

Two marker cameras, a wrist camera, an IMU and the master as real processes over real UDP, at a rate that a small
machine keeps up with: drawn frames are detected, sealed and sent, clocks differ and drift, the wrist device strobes,
the bus is encrypted by keys of this run. Ctrl-C ends it early: the verdict is then that of the time it ran.
"""

import argparse
import json
import os
import threading
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from bench.report import COLOURS, figure, machine
from bench.rigs import soak_verdict as verdict
from bench.rigs.local import Rig, cpu_s, losses
from bench.rigs.rooms import slower
from bench.rigs.soak_verdict import Mapping, Minute, SoakHistory, grown, judge, mapped, warm_up_s
from common.calibration.files import replacing
from common.messages import HandPose, Health
from common.messages.streams import MASTER
from master.run.process import stop_on_signals

RIGS = ("desk", "wrist")
DEVICES = {"left": "desk", "right": "desk", "wrist": "wrist", "imu": "wrist"}  # -> rig
SCENE = "both-poses"  # closed: it can go on for ever; slow enough for three frames of a triple at a low rate
DRIFT_PPM = {"left": 20.0, "right": -35.0, "wrist": 50.0, "imu": 8.0}
_GREY, OUT = "#777777", Path("out/soak")


class SoakRig(Rig):
    """All processes of a soak, and what was measured of them since it began."""

    def __init__(self, folder: Path, marker_hz: float, wrist_hz: float) -> None:
        """Start all of it; time 0 is when the master's bus is there."""
        super().__init__(folder, tuple(DEVICES))
        tree = slower(folder, {"left": marker_hz, "right": marker_hz, "wrist": wrist_hz})
        try:
            self.start_master(tree, RIGS)
            lead_s = 6.0  # until the hand begins to move
            epoch_ns = time.monotonic_ns() + round(1e9 * lead_s)
            for name, rig in DEVICES.items():
                kind = "--imu" if name == "imu" else "--camera"
                place = ["--name", name, "--rig", rig, "--calibration", str(tree), "--bind", "127.0.0.1"]
                place += ["--beacon-port", str(self.beacon_port), "--clock-ppm", str(DRIFT_PPM[name])]
                scene = ["--scene", SCENE, "--scene-epoch-ns", str(epoch_ns)]
                self.start(name, "slave", "run", kind, "synthetic", *place, *scene)
            self.join()
            self._latency_ms, self._health = list[float](), dict[str, Health]()
            self._lock = threading.Lock()
            depth = 4096
            self.read("hand", self._keep, depth=depth)
            self.read("health", self._keep, depth=depth)
        except BaseException:
            self.close()
            raise
        self.course = SoakHistory(footprints={name: [] for name in self.processes})
        self._start_s = time.monotonic()
        self._since_s, self._cpu_s, self._mapped = 0.0, self._spent_s(), self._maps()

    @property
    def now_s(self) -> float:
        """Since the start."""
        return time.monotonic() - self._start_s

    def gone(self) -> list[str]:
        """Return the processes that ended by themselves."""
        return [name for name in self.processes if not self.alive(name)]

    def measure(self) -> None:
        """Read the memory of all processes; OSError: one of them has ended."""
        self.course.times_s.append(self.now_s)
        for name in self.processes:
            self.course.footprints[name].append(self.footprint(name))

    def end_minute(self) -> Minute:
        """Sum up what came since the last call; OSError: a process has ended."""
        with self._lock:
            latency_ms, health = self._latency_ms, dict(self._health)
            self._latency_ms = []
        now_s, spent_s, maps = self.now_s, self._spent_s(), self._maps()
        took = now_s - self._since_s
        p50, p99 = np.percentile(latency_ms, [50, 99]) if latency_ms else (np.nan, np.nan)
        metrics = health[MASTER].metrics if MASTER in health else {}
        cores = {name: (spent_s[name] - self._cpu_s[name]) / took for name in spent_s}
        figures = (len(latency_ms) / took, float(p50), float(p99), os.getloadavg()[0], cores, losses(health))
        end = ".clock_offset_us"
        clocks = {name.removesuffix(end): us for name, us in metrics.items() if name.endswith(end)}
        more = {name: grown(self._mapped[name], now) for name, now in maps.items()}
        minute = Minute(now_s, *figures, clocks, {name: mb for name, mb in more.items() if mb})
        self.course.minutes.append(minute)
        self.course.counts = {name: dict(one.counts) for name, one in health.items()}
        self._since_s, self._cpu_s, self._mapped = now_s, spent_s, maps
        return minute

    def _keep(self, message: object) -> None:
        with self._lock:
            if isinstance(message, HandPose):
                self._latency_ms.append(message.latency_ns * 1e-6)
            elif isinstance(message, Health):
                self._health[message.source] = message

    def _spent_s(self) -> dict[str, float]:
        return {name: cpu_s(one.pid) for name, one in self.processes.items()}

    def _maps(self) -> dict[str, list[Mapping]]:
        return {name: mapped(one.pid) for name, one in self.processes.items()}


def draw(course: SoakHistory, title: str, file: Path) -> None:
    """Draw memory, latency, poses and clocks over the minutes."""
    made = figure(11.0, 5.8)
    axes = made.subplots(2, 2, sharex=True)
    for panel, at in zip((_growth, _latency, _poses, _clocks), axes.flat, strict=True):
        panel(at, course)
    warm = warm_up_s(course.times_s[-1]) / 60.0 if course.times_s else 0.0
    for panel in axes.flat:
        panel.axvspan(0.0, warm, color="#000000", alpha=0.05, linewidth=0)
        panel.grid(alpha=0.25)
        panel.margins(x=0.01)
        if panel.get_legend_handles_labels()[0]:
            panel.legend(fontsize=8, ncols=3)
    for panel in axes[1]:
        panel.set_xlabel("minutes (grey: warm-up, not judged)")
    made.suptitle(title, fontsize=11)
    made.savefig(file)


def _growth(axes: Axes, course: SoakHistory) -> None:
    times = np.array(course.times_s)
    late = times >= (warm_up_s(times[-1]) if len(times) else 0.0)
    for colour, name in zip(COLOURS, course.footprints, strict=False):
        values = np.array(course.series(name, "rss_mb"))
        if late.any():
            label = f"{name} {verdict.memory_slope(course, name).per_h:+.2f} MB/h"
            since = values - np.median(values[late][:12])
            axes.plot(times / 60.0, since, color=colour, label=label, linewidth=1.2)
        for step in verdict.steps_of(course.times_s, values) or []:
            axes.axvline(step.minute, color=colour, linewidth=1.0, linestyle="--")
            axes.text(step.minute, 2.6, f" +{step.mb:.0f} MB", color=colour, fontsize=8)
    axes.axhline(1.0, color=_GREY, linewidth=0.8, linestyle=":")
    axes.set_ylim(-3.0, 3.0)
    axes.set_ylabel("resident memory since\nthe warm-up [MB]")


def _latency(axes: Axes, course: SoakHistory) -> None:
    minutes = [one.t_s / 60.0 for one in course.minutes]
    for colour, name in zip(COLOURS, ("p50", "p99"), strict=False):
        axes.plot(minutes, [getattr(one, f"{name}_ms") for one in course.minutes], color=colour, label=name)
    axes.set_yscale("log")
    axes.set_ylabel("latency of poses [ms]")
    beside = axes.twinx()
    beside.plot(minutes, [one.load for one in course.minutes], color=_GREY, linewidth=0.9, linestyle=":")
    beside.set_ylim(bottom=0.0)
    beside.set_ylabel("load of the machine (dotted)", color=_GREY, fontsize=8)


def _poses(axes: Axes, course: SoakHistory) -> None:
    minutes = [one.t_s / 60.0 for one in course.minutes]
    axes.plot(minutes, [one.poses_hz for one in course.minutes], color=COLOURS[0], label="poses [1/s]")
    axes.set_ylim(bottom=0.0)
    axes.set_ylabel("poses a second")
    beside = axes.twinx()
    for colour, name in zip(COLOURS[1:], ("lost", "dropped", "skipped"), strict=False):
        totals = [one.counts.get(name, 0) for one in course.minutes]
        label = f"{name}: {totals[-1] if totals else 0}"
        beside.plot(minutes, totals, color=colour, linewidth=1.2, label=label)
    beside.set_ylabel("since the start", fontsize=8)
    beside.legend(fontsize=8, loc="lower right")


def _clocks(axes: Axes, course: SoakHistory) -> None:
    """Draw what is left of each clock's offset after the straight line that its quartz is."""
    late = [one for one in course.minutes if one.t_s > warm_up_s(course.minutes[-1].t_s)]
    names = sorted({name for one in late for name in one.clock_offset_us})
    for colour, name in zip(COLOURS, names, strict=False):
        known = [(one.t_s, one.clock_offset_us[name]) for one in late if name in one.clock_offset_us]
        if len(known) > 2:
            times, offsets = np.array(known).T
            ppm = verdict.slope(times, offsets).per_h / 3600.0
            left = offsets - ppm * times
            axes.plot(times / 60.0, left - np.median(left), color=colour, label=f"{name} {ppm:+.2f} ppm")
    axes.set_ylabel("clock, without its\nstraight line [us]")


def _run(options: argparse.Namespace, stop: threading.Event) -> tuple[SoakHistory, list[str]]:
    """Run for the time asked for, or until `stop`; return what was measured, and who ended by himself."""
    rig = SoakRig(OUT, options.marker_hz, options.wrist_hz)
    try:
        names = ", ".join(f"{name} (pid {one.pid})" for name, one in rig.processes.items())
        print(f"started {names}; logs in {OUT}", flush=True)
        listen_s, minute_s = 0.5, 60.0
        next_s, next_minute_s = 0.0, minute_s
        while not stop.wait(listen_s) and rig.now_s < minute_s * options.minutes:
            if gone := rig.gone():
                return rig.course, gone
            if rig.now_s >= next_s:
                rig.measure()
                next_s += 5.0
            if rig.now_s >= next_minute_s:
                _show(rig.end_minute(), rig.course)
                _save(options, rig.course)
                next_minute_s += minute_s
        rig.end_minute()
        return rig.course, []
    finally:
        rig.close()


def _show(minute: Minute, course: SoakHistory) -> None:
    """Print a line for each minute."""
    memory = " ".join(f"{name} {course.series(name, 'rss_mb')[-1]:.1f}" for name in course.footprints)
    counts = ", ".join(f"{name} {number}" for name, number in minute.counts.items() if number)
    print(
        f"{minute.t_s / 60.0:5.1f} min  {minute.poses_hz:5.1f} poses/s  p50 {minute.p50_ms:6.1f}"
        f" p99 {minute.p99_ms:6.1f} ms  MB: {memory}  {counts or 'nothing lost'}  load {minute.load:.1f}",
        flush=True,
    )


def _save(options: argparse.Namespace, course: SoakHistory, findings: Sequence[verdict.Finding] = ()) -> None:
    """Save all figures so far; whoever kills the soak still has them."""
    known = {
        **machine(),
        "marker_hz": options.marker_hz,
        "wrist_hz": options.wrist_hz,
        "verdict": [asdict(one) for one in findings],
    }
    with replacing(OUT / "soak.json") as file:
        file.write(json.dumps(known | course.plain()).encode())


def main(arguments: Sequence[str]) -> int:
    """Run it; 0 where all is well, 1 where something grows or was lost."""
    parser = argparse.ArgumentParser("python -m bench soak", description=__doc__)
    for flag, default, text in (
        ("--minutes", 60.0, "length; five are a rehearsal, too short to judge memory"),
        ("--marker-hz", 10.0, "of each marker camera; 60 are those of real ones, on six cores or more"),
        ("--wrist-hz", 12.0, "frames; three a triple"),
    ):
        parser.add_argument(flag, type=float, default=default, help=f"{text} (default: %(default)s)")
    options = parser.parse_args(arguments)
    course, ended = _run(options, stop_on_signals())
    findings = judge(course, ended)
    length_min = course.times_s[-1] / 60.0 if course.times_s else 0.0
    rates = f"marker cameras {options.marker_hz:g} Hz, wrist {options.wrist_hz:g} Hz"
    title = f"{length_min:.0f} minutes, {rates}"
    _save(options, course, findings)
    draw(course, title, OUT / "soak.png")
    print(f"\n{title}")
    for one in findings:
        mark = {True: "ok", False: "NOT OK", None: "too short"}[one.ok]
        print(f"  {one.what:24s} {one.value:44s} {one.limit:16s} {mark}")
    print(f"wrote {OUT / 'soak.png'} and {OUT / 'soak.json'}")
    return 1 if any(one.ok is False for one in findings) else 0
