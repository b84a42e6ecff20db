"""The demo as a benchmark: rate, loss, latency and accuracy over real processes, against an idle relay.

The relay is the same run with a master that solves nothing (`bench.idle_master`): slaves that render, detect and send,
the link, the queue and the bus. It runs before and after, so that both saw the same machine.
"""

import tempfile
import threading
import time
from pathlib import Path

from bench.row import Row
from deploy.demo import DemoSettings, demo_keys, play, run_demo
from master.commands.summary import read_summary

_CALIBRATION = Path(__file__).parent.parent / "calib_json"
_SECONDS, _RELAY_SECONDS = 30.0, 15.0


def rows() -> list[Row]:
    """Thirty seconds of the standard scene between two runs of the idle relay."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        before = _relay(folder / "before")
        summary = run_demo(_settings(folder / "demo", _SECONDS, "master"), threading.Event(), _quiet)
        after = _relay(folder / "after")
    p50, p99 = (0.5 * (one + other) for one, other in zip(before, after, strict=True))
    out = [
        Row("idle relay, median", p50, "ms", f"baseline, before {before[0]:.1f}, after {after[0]:.1f}"),
        Row("idle relay, 99 %", p99, "ms", f"baseline, before {before[1]:.1f}, after {after[1]:.1f}"),
    ]
    for key, label, unit, goal in _FIGURES:
        if isinstance(value := summary.get(key), int | float):
            out.append(Row(label, float(value), unit, goal))
            if key == "latency_p99_ms":
                out.append(Row("  above the relay's", float(value) - p99, "ms", "goal 3"))
    return out


_FIGURES = (
    ("poses_per_s", "poses", "/s", "goal 55"),
    ("lost", "datagrams lost", "", "goal 0"),
    ("skipped", "frames skipped by slaves", "", "0 where the machine keeps up"),
    ("latency_p50_ms", "latency, median", "ms", "goal: sum of the parts + 1 ms"),
    ("latency_p99_ms", "latency, 99 %", "ms", "goal: 99 % of the relay + 3 ms"),
    ("joint_mm_visible", "joints of visible fingers, mean", "mm", "goal 6"),
    ("pip_deg_visible", "PIP of visible fingers, mean", "deg", "goal 7.5"),
    ("joint_mm", "all joints, mean", "mm", "goal 10"),
    ("marker_raw_mm", "caps, median, before the filter", "mm", ""),
)


def _relay(out: Path) -> tuple[float, float]:
    """Median and 99 % of the relay's latency [ms]."""
    settings = _settings(out, _RELAY_SECONDS, "bench.idle_master")
    with demo_keys(settings) as keys:
        play(settings, keys, time.monotonic_ns() + 4_000_000_000, threading.Event(), _quiet)
    found = read_summary(out / "live.json")
    p50, p99 = (found[f"latency_{name}_ms"] for name in ("p50", "p99"))
    assert isinstance(p50, float)
    assert isinstance(p99, float)
    return p50, p99


def _settings(out: Path, seconds: float, master: str) -> DemoSettings:
    return DemoSettings(seconds, True, out, _CALIBRATION, ("desk",), 7, master=master)


def _quiet(_line: str) -> None:
    return
