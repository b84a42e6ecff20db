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

from bench.report import machine
from bench.rigs.local import Rig, cpu_s, losses
from bench.rigs.rooms import slower
from bench.rigs.soak_verdict import Finding, Minute, SoakHistory, judge
from common.calibration.files import replacing
from common.messages import HandPose, Health
from common.messages.streams import MASTER
from master.run.process import stop_on_signals

RIGS = ("desk", "wrist")
DEVICES = {"left": "desk", "right": "desk", "wrist": "wrist", "imu": "wrist"}  # -> rig
SCENE = "both-poses"  # closed: it can go on for ever; slow enough for three frames of a triple at a low rate
DRIFT_PPM = {"left": 20.0, "right": -35.0, "wrist": 50.0, "imu": 8.0}
OUT = Path("out/soak")


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
        self._since_s, self._cpu_s = 0.0, self._spent_s()

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
        now_s, spent_s = self.now_s, self._spent_s()
        took = now_s - self._since_s
        p50, p99 = np.percentile(latency_ms, [50, 99]) if latency_ms else (np.nan, np.nan)
        metrics = health[MASTER].metrics if MASTER in health else {}
        cores = {name: (spent_s[name] - self._cpu_s[name]) / took for name in spent_s}
        figures = (len(latency_ms) / took, float(p50), float(p99), os.getloadavg()[0], cores, losses(health))
        end = ".clock_offset_us"
        clocks = {name.removesuffix(end): us for name, us in metrics.items() if name.endswith(end)}
        minute = Minute(now_s, *figures, clocks)
        self.course.minutes.append(minute)
        self.course.counts = {name: dict(one.counts) for name, one in health.items()}
        self._since_s, self._cpu_s = now_s, spent_s
        return minute

    def _keep(self, message: object) -> None:
        with self._lock:
            if isinstance(message, HandPose):
                self._latency_ms.append(message.latency_ns * 1e-6)
            elif isinstance(message, Health):
                self._health[message.source] = message

    def _spent_s(self) -> dict[str, float]:
        return {name: cpu_s(one.pid) for name, one in self.processes.items()}


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


def _save(options: argparse.Namespace, course: SoakHistory, findings: Sequence[Finding] = ()) -> None:
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
    print(f"\n{title}")
    for one in findings:
        mark = {True: "ok", False: "NOT OK", None: "too short"}[one.ok]
        print(f"  {one.what:24s} {one.value:44s} {one.limit:16s} {mark}")
    print(f"wrote {OUT / 'soak.json'}")
    return 1 if any(one.ok is False for one in findings) else 0
