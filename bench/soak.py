"""`python -m bench.soak`: an hour of a whole rig on this machine; does memory grow, does latency, was anything lost?

Two marker cameras, a wrist camera, an IMU and the master as real processes over real UDP, at a rate that a small
machine keeps up with. Ctrl-C ends it early: the verdict is then that of the time it ran.
"""

import argparse
import json
import os
import platform
import sys
import threading
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from bench.local_rig import join_bus
from bench.soak_monitor import Minute, SoakHistory, Watch
from bench.soak_plot import draw
from bench.soak_rig import SoakSettings, running
from bench.soak_verdict import Finding, judge
from common.calibration.replacing import replacing
from master.run.stopping import stop_on_signals

_READY_S = 90.0
_LISTEN_S = 0.5
_MINUTE_S = 60.0
_EXAMPLES = """examples:
  python -m bench.soak                              an hour; results in out/soak
  python -m bench.soak --minutes 5 --out out/short  a rehearsal; too short to judge memory
  python -m bench.soak --marker-hz 60 --wrist-hz 90 the rates of the real cameras: six cores or more
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run it; 0 where all is well, 1 where something grows or was lost."""
    settings = _settings(arguments)
    stop = stop_on_signals()
    history, ended = _run(settings, stop)
    findings = judge(history, ended)
    length_min = history.times_s[-1] / 60.0 if history.times_s else 0.0
    title = (
        f"{length_min:.0f} minutes, marker cameras {settings.marker_hz:g} Hz, wrist {settings.wrist_hz:g} Hz"
    )
    _save(settings, history, findings)
    draw(history, title, settings.out / "soak.png")
    print(f"\n{title}")
    for one in findings:
        mark = {True: "ok", False: "NOT OK", None: "too short"}[one.ok]
        print(f"  {one.what:24s} {one.value:44s} {one.limit:16s} {mark}")
    print(f"wrote {settings.out / 'soak.png'} and {settings.out / 'soak.json'}")
    return 1 if any(one.ok is False for one in findings) else 0


def _settings(arguments: Sequence[str] | None) -> SoakSettings:
    parser = argparse.ArgumentParser(
        prog="python -m bench.soak",
        description=__doc__,
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--minutes", type=float, default=60.0, help="length (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=Path("out/soak"), help="folder (default: %(default)s)")
    parser.add_argument(
        "--marker-hz", type=float, default=10.0, help="of each marker camera (default: %(default)s)"
    )
    parser.add_argument(
        "--wrist-hz", type=float, default=12.0, help="frames; three a triple (default: %(default)s)"
    )
    parser.add_argument(
        "--every-s", type=float, default=5.0, help="memory is read so often (default: %(default)s)"
    )
    parser.add_argument(
        "--nice", type=int, default=0, help="give way to others so far; below 0, as root: go before them"
    )
    given = parser.parse_args(arguments)
    return SoakSettings(given.minutes, given.out, given.marker_hz, given.wrist_hz, given.every_s, given.nice)


def _run(settings: SoakSettings, stop: threading.Event) -> tuple[SoakHistory, list[str]]:
    """Run for the time asked for, or until `stop`; what was watched, and who ended by himself."""
    with running(settings) as rig:
        names = ", ".join(f"{one.name} (pid {one.pid})" for one in rig.processes)
        print(f"started {names}; logs in {settings.out}", flush=True)
        bus = join_bus(rig.bus, _READY_S)
        try:
            watch = Watch(rig, bus)
            next_read_s, next_minute_s = 0.0, _MINUTE_S
            while not stop.wait(_LISTEN_S) and watch.now_s < _MINUTE_S * settings.minutes:
                if gone := [one.name for one in rig.processes if one.ended() is not None]:
                    return watch.history, gone
                watch.listen()
                if watch.now_s >= next_read_s:
                    watch.read()
                    next_read_s += settings.every_s
                if watch.now_s >= next_minute_s:
                    _print_minute(watch.end_minute(), watch.history)
                    _save(settings, watch.history)
                    next_minute_s += _MINUTE_S
            watch.end_minute()
            return watch.history, []
        finally:
            bus.close()


def _print_minute(minute: Minute, history: SoakHistory) -> None:
    """A line for each minute."""
    memory = " ".join(f"{name} {history.series(name, 'rss_mb')[-1]:.1f}" for name in history.footprints)
    counts = (
        ", ".join(f"{name} {number}" for name, number in minute.counts.items() if number) or "nothing lost"
    )
    print(
        f"{minute.t_s / 60.0:5.1f} min  {minute.poses_hz:5.1f} poses/s  p50 {minute.p50_ms:6.1f}"
        f" p99 {minute.p99_ms:6.1f} ms  MB: {memory}  {counts}  load {minute.load:.1f}",
        flush=True,
    )


def _save(settings: SoakSettings, history: SoakHistory, findings: Sequence[Finding] = ()) -> None:
    """All figures so far; whoever kills the soak still has them."""
    known = {
        "machine": platform.machine(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "marker_hz": settings.marker_hz,
        "wrist_hz": settings.wrist_hz,
        "verdict": [asdict(one) for one in findings],
    }
    with replacing(settings.out / "soak.json") as file:
        file.write(json.dumps(known | history.plain()).encode())


if __name__ == "__main__":
    sys.exit(main())
