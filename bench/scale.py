"""`python -m bench.scale`: 2, 4, 8, 16 simulated cameras before real masters: what each costs, what is lost, how late
the poses are; as one room round a hand, and as a building of desks with a master each.

Cameras are told, not drawn, so that this machine is the masters' alone; datagrams are sealed and go over real UDP. What
others do on the machine shows in latencies: each figure has the load beside it. `--page` writes what was measured into
docs/scale.html, which computes rooms and buildings from it.
"""

import argparse
import json
import os
import platform
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from statistics import median

import numpy as np

from bench.scale_hop import hop_ms
from bench.scale_page import into_page
from bench.scale_rig import CALIBRATION, DESK, ROOM, detections_of
from bench.scale_run import ScaleRun, measure
from bench.scale_solve import solve_us
from common.link.datagram import OVERHEAD
from common.link.session import MAX_CAMERAS
from common.messages import encode
from master.rig.files import load_setup

BUILDING = "building"
PER_HAND = (
    "hand",
    "filter",
    "fabrik",
    "gestures",
)  # stages whose cost has nothing to do with the number of cameras
_EXAMPLES = """examples:
  python -m bench.scale                                  everything once, about three minutes
  python -m bench.scale --repeat 3 --page docs/scale.html the medians of three runs, into the page
  python -m bench.scale --cameras 16 --only room         the one question that matters most
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run it; 1 where a message was lost."""
    options = _options(arguments)
    if options.nice:
        _go_before(options.nice)
    layouts = [one for one in (ROOM, BUILDING) if options.only in (None, one)]
    runs: list[ScaleRun] = []
    print(
        f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}; {options.seconds:g} s each"
    )
    stages = {count: solve_us(count, options.hz) for count in options.cameras} if ROOM in layouts else {}
    for layout in layouts:
        rate_hz = options.hz if layout == ROOM else options.building_hz
        print(f"\n{layout}, {rate_hz:g} Hz\n{_HEAD}", flush=True)
        for count in options.cameras:
            runs.append(_median(layout, count, rate_hz, options.seconds, options.repeat))
            print(_row(runs[-1], stages.get(count, {})), flush=True)
    for count, us in stages.items():
        print(
            f"  {count:2d} cameras, us of processor a pose: "
            + ", ".join(f"{k} {v:.0f}" for k, v in us.items())
        )
    found = summary(runs, stages)
    with tempfile.TemporaryDirectory() as name:
        hops = hop_ms(Path(name))
    found["model"] |= {"hop_p50_ms": round(hops[0], 2), "hop_p99_ms": round(hops[1], 2)}
    print("\n" + "\n".join(f"{name}: {value}" for name, value in found["model"].items()))
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "scale.json").write_text(json.dumps(found, indent=1) + "\n")
    if options.page is not None:
        into_page(options.page, found)
    return 1 if any(one.lost + one.dropped + one.blocked for one in runs) else 0


def summary(runs: Sequence[ScaleRun], stages: dict[int, dict[str, float]]) -> dict[str, dict[str, object]]:
    """All that was measured, and the model that the page computes with.

    Processor time of a master is `pose_ms` for each pose and `message_ms` for each message of a camera: the line of
    least squares through the runs of a room.
    """
    rooms = [one for one in runs if one.layout == ROOM]
    model: dict[str, object] = {"max_senders": MAX_CAMERAS, "datagram_bytes": datagram_bytes()}
    if len(rooms) > 1:
        a = np.array([[one.poses_hz, one.received / one.seconds] for one in rooms])
        cores = np.array([one.cores for one in rooms])
        fit, *_ = np.linalg.lstsq(a, cores, rcond=None)
        off = np.abs(a @ fit / cores - 1.0)
        model |= {
            "pose_ms": round(1e3 * float(fit[0]), 3),
            "message_ms": round(1e3 * float(fit[1]), 4),
            "off_line_percent": round(100.0 * float(off.max()), 1),
            "pose_bytes": round(median(one.pose_bytes for one in rooms)),
            "latency_p50_ms": {str(one.cameras): round(one.latency_p50_ms, 1) for one in rooms},
            "latency_p99_ms": {str(one.cameras): round(one.latency_p99_ms, 1) for one in rooms},
        }
    machine = {"machine": platform.machine(), "cores": os.cpu_count(), "python": platform.python_version()}
    return {
        "machine": dict(machine),
        "model": model,
        "runs": {f"{one.layout} {one.cameras}": _json_of(one, stages) for one in runs},
        "stages_us": {str(count): dict(us) for count, us in stages.items()},
    }


def _json_of(run: ScaleRun, stages: dict[int, dict[str, float]]) -> dict[str, object]:
    """A run as the pages want it; what a hand costs is taken from solving alone."""
    out: dict[str, object] = asdict(run)
    return out | {"without_hand": cost_per_camera(run, stages.get(run.cameras, {}))}


def datagram_bytes() -> int:
    """Length of a sealed datagram of six markers, all of them seen."""
    frames = detections_of(load_setup(CALIBRATION, DESK), 10.0)
    return OVERHEAD + max(len(encode(one)) for one in next(iter(frames.values())))


def cost_per_camera(run: ScaleRun, stages: dict[str, float]) -> float:
    """Processor time of each camera [cores]: of all that is spent, without the hand's fit, its filter and gestures."""
    hand_us = sum(stages.get(name, 0.0) for name in PER_HAND)
    return (run.cores - run.masters * run.poses_hz * hand_us * 1e-6) / run.cameras


_HEAD = (
    "  cameras  cores  a camera  without hand  poses/s  shed   sent    lost  dropped  skipped   p50 ms   p99 ms"
    "  ingest  load"
)


def _row(run: ScaleRun, stages: dict[str, float]) -> str:
    alone = f"{cost_per_camera(run, stages):12.3f}" if stages else " " * 12
    return (
        f"  {run.cameras:7d} {run.cores:6.2f} {run.cores / run.cameras:9.3f}  {alone} {run.poses_hz:8.1f}"
        f" {run.dropped_epochs:5d}"
        f" {run.sent:6d} {run.lost:7d} {run.dropped:8d} {run.skipped:8d} {run.latency_p50_ms:8.1f}"
        f" {run.latency_p99_ms:8.1f} {run.threads['ingest']:7.2f} {run.load:5.1f}"
    )


def _median(layout: str, cameras: int, rate_hz: float, seconds: float, repeat: int) -> ScaleRun:
    """The run of median cost; of what must not happen the worst of all."""
    with tempfile.TemporaryDirectory() as name:
        found = [measure(Path(name) / str(k), layout, cameras, rate_hz, seconds) for k in range(repeat)]
    middle = sorted(found, key=lambda one: one.cores)[len(found) // 2]
    return _worst(middle, found)


def _worst(run: ScaleRun, of: Sequence[ScaleRun]) -> ScaleRun:
    changed = {
        name: max(getattr(one, name) for one in of) for name in ("lost", "dropped", "blocked", "refused")
    }
    return ScaleRun(**(asdict(run) | changed))


def _go_before(nice: int) -> None:
    """Give way to others, or go before them: this process, and all that it starts."""
    os.setpriority(os.PRIO_PROCESS, 0, nice)
    session = Path("/proc/self/autogroup")
    if session.exists():
        session.write_text(str(nice))


def _options(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m bench.scale",
        description=__doc__,
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    counts = parser.add_argument("--cameras", type=_counts, default=(2, 4, 8, 16), metavar="N,N")
    counts.help = "how many (default: 2,4,8,16)"
    parser.add_argument(
        "--hz", type=float, default=90.0, help="of each camera of a room (default: %(default)s)"
    )
    hz = parser.add_argument("--building-hz", type=float, default=15.0)
    hz.help = "of each camera of a building, whose masters share this machine (default: %(default)s)"
    parser.add_argument("--seconds", type=float, default=8.0, help="of each run (default: %(default)s)")
    parser.add_argument("--repeat", type=int, default=1, help="runs, of which the median counts (default: 1)")
    parser.add_argument("--only", choices=(ROOM, BUILDING), help="default: both")
    parser.add_argument("--out", type=Path, default=Path("out/scale"), help="folder (default: %(default)s)")
    parser.add_argument("--page", type=Path, metavar="FILE", help="write what was measured into this page")
    parser.add_argument(
        "--nice", type=int, default=0, help="give way to others; below 0, as root, go before them"
    )
    return parser.parse_args(arguments)


def _counts(text: str) -> tuple[int, ...]:
    return tuple(int(one) for one in text.split(","))


if __name__ == "__main__":
    sys.exit(main())
