"""2 to 16 simulated cameras round a hand before a real master: what each costs, what is lost, how late the poses are.

Cameras send exact projections in sealed datagrams over real UDP; the load of the machine stands beside each figure.
`--page` writes the measurement into docs/scale.html, which computes rooms and buildings from it, and its table into
docs/scale.md.
"""

import argparse
import json
import os
import re
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from math import nan
from pathlib import Path
from statistics import median
from typing import cast

import numpy as np

from bench.report import CALIBRATION, machine
from bench.rigs.local import Rig, losses
from bench.rigs.rooms import DESK, ROOM, detections, room
from common.link.datagram import OVERHEAD
from common.link.handshake import MAX_CAMERAS
from common.messages import HandPose, encode
from common.messages.streams import MASTER
from master.rig.setup import load_setup

_DATA = re.compile(r'(<script type="application/json" id="measured">\n).*?(\n</script>)', re.DOTALL)
_TABLE = re.compile(r"(<!-- measured -->\n).*?(\n<!-- end -->)", re.DOTALL)
_TABLE_HEAD = (
    "| cameras | cores | a camera | poses/s | left out | messages | lost | p50 ms | p99 ms | load |\n"
    "|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|"
)
Found = Mapping[str, Mapping[str, object]]


def into_page(page: Path, found: Found) -> None:
    """Write it into the page, and into the text of the same name beside it; ValueError: one has no place for it."""
    _replace(page, _DATA, json.dumps(found, indent=1))
    text = page.with_suffix(".md")
    if text.exists():
        _replace(text, _TABLE, tables(found))


def tables(found: Found) -> str:
    """The runs as a table for a person, and the line through them."""
    model = found["model"]
    rows = [_table_row(cast(Mapping[str, float], run)) for run in found["runs"].values()]
    lines: list[str] = []
    if "pose_ms" in model:
        lines.append(
            f"A master takes {model['pose_ms']} ms of processor for each pose and {model['message_ms']} ms for each"
            " message of a camera: the straight line through the runs, from which none is off by more than"
            f" {model['off_line_percent']} %."
        )
    return "\n".join([_TABLE_HEAD, *rows, "", " ".join(lines)])


def _table_row(run: Mapping[str, float]) -> str:
    gone = run["lost"] + run["dropped"] + run["blocked"]
    return (
        f"| {run['cameras']} | {run['cores']:.2f} | {run['cores'] / run['cameras']:.3f} | {run['poses_hz']:.1f}"
        f" | {run['shed']} | {run['sent']} | {gone} | {run['latency_p50_ms']:.1f} | {run['latency_p99_ms']:.1f}"
        f" | {run['load']:.0f} |"
    )


def _replace(file: Path, place: re.Pattern[str], new: str) -> None:
    text, places = place.subn(lambda found: found[1] + new + found[2], file.read_text())
    if places != 1:
        raise ValueError(f"{file}: expected one place for what was measured, found {places}")
    file.write_text(text)


CAMERAS, RATE_HZ, SECONDS = (2, 4, 8, 16), 90.0, 8.0


@dataclass(frozen=True, slots=True)
class ScaleRun:
    """What one run of so many cameras came to."""

    cameras: int
    rate_hz: float  # of each camera
    seconds: float  # how long was measured
    sent: int  # messages, by the clock of the cameras
    received: int  # by the clock of the master
    lost: int  # as the master counts them
    dropped: int
    refused: int
    blocked: int
    skipped: int  # the sender was too late
    shed: int  # not solved, for newer ones waited
    poses_hz: float
    latency_p50_ms: float  # from the sending of the last frame of a pose to its publication
    latency_p99_ms: float
    cores: float  # processor time of the master, seconds a second
    pose_bytes: float  # of a pose on the bus, with all of its fields
    load: float  # load average of the machine at the end


def measure(folder: Path, cameras: int, rate_hz: float, seconds: float) -> ScaleRun:
    """Run it once in the new `folder`."""
    folder.mkdir(parents=True)
    tree, poses = room(folder, cameras, rate_hz), list[HandPose]()
    rig = Rig(folder / "master")
    try:
        rig.start_master(tree, [ROOM])
        rig.join()
        rig.read("hand", lambda message: poses.append(message) if isinstance(message, HandPose) else None)
        place = [str(tree), ROOM, str(rate_hz), str(rig.beacon_port), str(time.monotonic_ns())]
        rig.start("cameras", "bench.rigs.sender", *place, ready="sending")
        time.sleep(3.0)  # all settles
        before, spent_before_s, began = _sums(rig), rig.footprint().cpu_s, time.monotonic()
        poses.clear()
        time.sleep(seconds)
        took, after, spent_s = time.monotonic() - began, _sums(rig), rig.footprint().cpu_s
        received, load = list(poses), os.getloadavg()[0]
    finally:
        rig.close()
    latencies_ms = [one.latency_ns * 1e-6 for one in received] or [nan]
    p50, p99 = np.percentile(latencies_ms, [50, 99])
    return ScaleRun(
        cameras=cameras,
        rate_hz=rate_hz,
        seconds=took,
        sent=round(rate_hz * cameras * took),
        poses_hz=len(received) / took,
        latency_p50_ms=float(p50),
        latency_p99_ms=float(p99),
        cores=(spent_s - spent_before_s) / took,
        pose_bytes=len(encode(received[0])) if received else nan,
        load=load,
        **{one: after[one] - before[one] for one in after},
    )


def _sums(rig: Rig) -> dict[str, int]:
    """Return counts of the master and its cameras."""
    health = rig.ask()
    counts = losses({MASTER: health})
    for name, end in (("received", ".received"), ("shed", "instants_shed")):
        counts[name] = sum(n for key, n in health.counts.items() if key.endswith(end))
    return counts


def summary(runs: Sequence[ScaleRun]) -> dict[str, dict[str, object]]:
    """Return all that was measured, and the model that the page computes with.

    Processor time of a master is `pose_ms` for each pose and `message_ms` for each message of a camera: the line of
    least squares through the runs.
    """
    model: dict[str, object] = {"max_senders": MAX_CAMERAS, "datagram_bytes": datagram_bytes()}
    if len(runs) > 1:
        a = np.array([[one.poses_hz, one.received / one.seconds] for one in runs])
        cores = np.array([one.cores for one in runs])
        fit, *_ = np.linalg.lstsq(a, cores, rcond=None)
        off = np.abs(a @ fit / cores - 1.0)
        model |= {
            "pose_ms": round(1e3 * float(fit[0]), 3),
            "message_ms": round(1e3 * float(fit[1]), 4),
            "off_line_percent": round(100.0 * float(off.max()), 1),
            "pose_bytes": round(median(one.pose_bytes for one in runs)),
            "latency_p50_ms": {str(one.cameras): round(one.latency_p50_ms, 1) for one in runs},
            "latency_p99_ms": {str(one.cameras): round(one.latency_p99_ms, 1) for one in runs},
        }
    return {"machine": machine(), "model": model, "runs": {str(one.cameras): asdict(one) for one in runs}}


def datagram_bytes() -> int:
    """Return the length of a sealed datagram of six markers, all of them seen."""
    frames = detections(load_setup(CALIBRATION, DESK), 10.0)
    return OVERHEAD + max(len(encode(one)) for one in next(iter(frames.values())))


def main(arguments: Sequence[str]) -> int:
    """Run it; 1 where a message was lost."""
    parser = argparse.ArgumentParser("python -m bench scale", description=__doc__)
    parser.add_argument("--page", type=Path, metavar="FILE", help="write the measurement into this page")
    page = parser.parse_args(arguments).page
    runs = list[ScaleRun]()
    with tempfile.TemporaryDirectory() as name:
        print(_TABLE_HEAD, flush=True)
        for count in CAMERAS:
            runs.append(measure(Path(name) / str(count), count, RATE_HZ, SECONDS))
            print(_table_row(asdict(runs[-1])), flush=True)
    found = summary(runs)
    print(json.dumps(found["model"], indent=1))
    if page is not None:
        into_page(page, found)
    return int(any(one.lost + one.dropped + one.blocked for one in runs))
