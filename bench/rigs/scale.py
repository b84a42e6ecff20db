"""2 to 16 simulated cameras before real masters: what each costs, what is lost, how late the poses are.

As one room round a hand, and as a building of desks with a master each. Cameras send exact projections in sealed
datagrams over real UDP; the load of the machine stands beside each figure. `--page` writes the measurement into
docs/scale.html, which computes rooms and buildings from it, and its table into docs/scale.md.
"""

import argparse
import json
import os
import re
import socket
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from math import nan
from pathlib import Path
from statistics import median
from typing import cast

import numpy as np

from bench.report import CALIBRATION, machine
from bench.rigs.local import UP_S, Rig, free_port, join_bus, losses, until
from bench.rigs.rooms import DESK, ROOM, detections, in_order, room, slower
from common.bus.bus import Subscription
from common.bus.keys import access_of
from common.bus.zenoh_bus import ZenohBus
from common.errors import BusError
from common.link.datagram import OVERHEAD
from common.link.handshake import MAX_CAMERAS
from common.messages import Gesture, HandPose, encode
from common.messages.streams import MASTER
from master.rig.setup import load_setup, load_setups
from master.run.app import StageTimes
from master.run.dispatcher import Dispatcher
from master.run.tuning import LivePipeline

SITE = "room-a"
_MESSAGES = 300


def hop_ms(folder: Path) -> tuple[float, float]:
    """Return what each hop adds, median and 99 % [ms], beyond a reader at the master; `folder`: for keys."""
    with ExitStack() as stack:
        rig = Rig(folder / "rig", ["cam00"])
        stack.callback(rig.close)
        near, *routers = [f"tls/127.0.0.1:{free_port(socket.SOCK_STREAM)}" for _ in range(3)]
        master = ZenohBus(near, None, access_of(rig.environment, MASTER))
        stack.callback(master.close)
        rig.start("router", "master", "fleet", "relay", "--listen", routers[0])
        rig.start("far router", "master", "fleet", "relay", "--listen", routers[1], "--connect", routers[0])
        rig.start("relay", "master", "fleet", "relay", "--bus", near, "--router", routers[0], "--site", SITE)
        inboxes: list[Subscription] = []
        for endpoint, site in ((near, None), (routers[1], SITE)):
            bus = join_bus(endpoint, UP_S, rig.environment, site)
            stack.callback(bus.close)
            inboxes.append(bus.subscribe("gesture", depth=4 * _MESSAGES))
        for inbox in inboxes:
            if not until(lambda inbox=inbox: _asked(master, inbox), UP_S):
                raise BusError("nothing comes through the routers")
        ages_ms = [_ages_ms(master, inbox) for inbox in inboxes]
    # The rare long ones at the master are of another moment of the machine: they are no part of what hops add.
    typical = float(np.median(ages_ms[0]))
    p50, p99 = (float(value) for value in np.percentile(ages_ms[1], [50, 99]))
    hops = 3  # relay, router, router
    return (p50 - typical) / hops, (p99 - typical) / hops


def _asked(master: ZenohBus, inbox: Subscription) -> bool:
    master.publish("gesture", "hand", _now())
    return inbox.get(0.05) is not None


def _ages_ms(master: ZenohBus, inbox: Subscription) -> list[float]:
    """Return ages of messages [ms] as a reader who waits for each gets them."""
    while inbox.get(0.3) is not None:
        pass
    ages: list[float] = []
    for _ in range(_MESSAGES):
        master.publish("gesture", "hand", _now())
        message = inbox.get(1.0)
        if isinstance(message, Gesture):
            ages.append((time.monotonic_ns() - message.t_ns) * 1e-6)
        time.sleep(0.01)
    return ages


def _now() -> Gesture:
    nowhere = np.full(3, np.nan)
    t_ns = time.monotonic_ns()
    return Gesture("hand", t_ns, "tap", "star", "end", t_ns, 1.0, np.nan, np.nan, np.nan, nowhere, nowhere)


_DATA = re.compile(r'(<script type="application/json" id="measured">\n).*?(\n</script>)', re.DOTALL)
_TABLE = re.compile(r"(<!-- measured -->\n).*?(\n<!-- end -->)", re.DOTALL)
_TABLE_HEAD = (
    "| | cameras | cores | a camera | without the hand | poses/s | left out | messages | lost | p50 ms | p99 ms"
    " | load |\n"
    "|---|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|"
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
            " message of a camera: the straight line through the runs of a room, from which none is off by more than"
            f" {model['off_line_percent']} %."
        )
    if "hop_p50_ms" in model:
        lines.append(
            f"Each hop of a relay or router adds {model['hop_p50_ms']} ms, 99 % below {model['hop_p99_ms']} ms."
        )
    return "\n".join([_TABLE_HEAD, *rows, "", " ".join(lines)])


def _table_row(run: Mapping[str, float]) -> str:
    gone = run["lost"] + run["dropped"] + run["blocked"]
    return (
        f"| {run['layout']}, {run['rate_hz']:g} Hz | {run['cameras']} | {run['cores']:.2f} |"
        f" {run['cores'] / run['cameras']:.3f} | {run['without_hand']:.3f} | {run['poses_hz']:.1f}"
        f" | {run['shed']} |"
        f" {run['sent']} | {gone} | {run['latency_p50_ms']:.1f} | {run['latency_p99_ms']:.1f} | {run['load']:.0f} |"
    )


def _replace(file: Path, place: re.Pattern[str], new: str) -> None:
    text, places = place.subn(lambda found: found[1] + new + found[2], file.read_text())
    if places != 1:
        raise ValueError(f"{file}: expected one place for what was measured, found {places}")
    file.write_text(text)


BUILDING = "building"
CAMERAS, SECONDS = (2, 4, 8, 16), 8.0
RATES_HZ = {ROOM: 90.0, BUILDING: 15.0}  # of a building less, whose masters share this machine
# Stages whose cost does not depend on the number of cameras.
PER_HAND = ("hand", "filter", "fabrik", "gestures")


@dataclass(frozen=True, slots=True)
class ScaleRun:
    """What one run of so many cameras came to."""

    layout: str  # `room`, one master of all cameras, or `building`, a master for each two
    cameras: int
    masters: int
    rate_hz: float  # of each camera
    seconds: float  # how long was measured
    sent: int  # messages, by the clock of the cameras
    received: int  # by the clock of the master
    lost: int  # as the masters count them
    dropped: int
    refused: int
    blocked: int
    skipped: int  # the sender was too late
    shed: int  # not solved, for newer ones waited
    poses_hz: float  # of one master
    latency_p50_ms: float  # from the sending of the last frame of a pose to its publication
    latency_p99_ms: float
    cores: float  # processor time of all masters together, seconds a second
    pose_bytes: float  # of a pose on the bus, with all of its fields
    load: float  # load average of the machine at the end


@dataclass(slots=True)
class _Received:
    """Poses of one master."""

    latency_ms: list[float] = field(default_factory=list[float])
    pose_bytes: int = 0

    def keep(self, message: object) -> None:
        if isinstance(message, HandPose):
            self.latency_ms.append(message.latency_ns * 1e-6)
            self.pose_bytes = self.pose_bytes or len(encode(message))


def measure(folder: Path, layout: str, cameras: int, rate_hz: float, seconds: float) -> ScaleRun:
    """Run it once in the new `folder`: `room`, or `building` of an even number of cameras."""
    masters = 1 if layout == ROOM else cameras // 2
    folder.mkdir(parents=True)
    name = ROOM if layout == ROOM else DESK
    if layout == ROOM:
        tree = room(folder, cameras, rate_hz)
    else:
        names = load_setup(CALIBRATION, DESK).camera_names
        tree = slower(folder, dict.fromkeys(names, rate_hz), row_time_us=0.0)
    with ExitStack() as stack:
        rigs, received = list[Rig](), list[_Received]()
        for k in range(masters):
            rig = Rig(folder / f"master{k}")
            stack.callback(rig.close)
            rig.start_master(tree, [name])
            rig.join()
            rigs.append(rig)
            received.append(_Received())
            rig.read("hand", received[-1].keep)
        epoch_ns = time.monotonic_ns()
        for rig in rigs:
            place = [str(tree), name, str(rate_hz), str(rig.beacon_port), str(epoch_ns)]
            rig.start("cameras", "bench.rigs.sender", *place, ready="sending")
        time.sleep(3.0)  # all settles
        before, spent_before_s, began = _sums(rigs), _spent_s(rigs), time.monotonic()
        for one in received:
            one.latency_ms.clear()
        time.sleep(seconds)
        took, after, spent_s = time.monotonic() - began, _sums(rigs), _spent_s(rigs)
        latencies_ms, load = [list(one.latency_ms) for one in received], os.getloadavg()[0]
    latencies = [np.percentile(one, [50, 99]) for one in latencies_ms if one] or [np.array([nan, nan])]
    p50, p99 = np.median(latencies, axis=0)
    return ScaleRun(
        layout=layout,
        cameras=cameras,
        masters=masters,
        rate_hz=rate_hz,
        seconds=took,
        sent=round(rate_hz * cameras * took),
        poses_hz=median(len(one) for one in latencies_ms) / took,
        latency_p50_ms=float(p50),
        latency_p99_ms=float(p99),
        cores=(spent_s - spent_before_s) / took,
        pose_bytes=median(one.pose_bytes for one in received),
        load=load,
        **{one: after[one] - before[one] for one in after},
    )


def _sums(rigs: Sequence[Rig]) -> dict[str, int]:
    """Return counts of all masters and their cameras."""
    out: dict[str, int] = {}
    for health in (rig.ask() for rig in rigs):
        counts = losses({MASTER: health})
        for name, end in (("received", ".received"), ("shed", "instants_shed")):
            counts[name] = sum(n for key, n in health.counts.items() if key.endswith(end))
        out = {name: out.get(name, 0) + number for name, number in counts.items()}
    return out


def _spent_s(rigs: Sequence[Rig]) -> float:
    """Return the processor time of all masters since they began [s]."""
    return sum(rig.footprint().cpu_s for rig in rigs)


def solve_us(cameras: int, rate_hz: float) -> dict[str, float]:
    """Return the processor time of a pose by stage [us], and `all` of it, for a room: no socket, no second thread."""
    with tempfile.TemporaryDirectory() as name:
        setups = load_setups(room(Path(name), cameras, rate_hz), [ROOM])
    messages = in_order(detections(setups[0], rate_hz))
    stages, warmed = StageTimes(time.thread_time_ns), 20
    dispatcher = Dispatcher(setups, [LivePipeline(setup, stages) for setup in setups], stages)
    warm, last = warmed * cameras, (warmed + 200) * cameras
    for message in messages[:warm]:
        list(dispatcher.push(message))
    before, poses = stages.total_us(), dispatcher.counts["poses"]
    begun_ns = time.thread_time_ns()
    for message in messages[warm:last]:
        list(dispatcher.push(message))
    spent_us = (time.thread_time_ns() - begun_ns) * 1e-3
    count = dispatcher.counts["poses"] - poses
    by_stage = {name: (total - before.get(name, 0.0)) / count for name, total in stages.total_us().items()}
    return by_stage | {"all": spent_us / count}


def summary(runs: Sequence[ScaleRun], stages: dict[int, dict[str, float]]) -> dict[str, dict[str, object]]:
    """Return all that was measured, and the model that the page computes with.

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
    all_runs: dict[str, object] = {}
    for one in runs:
        alone = cost_per_camera(one, stages.get(one.cameras, {}))
        all_runs[f"{one.layout} {one.cameras}"] = asdict(one) | {"without_hand": alone}
    return {
        "machine": machine(),
        "model": model,
        "runs": all_runs,
        "stages_us": {str(count): dict(us) for count, us in stages.items()},
    }


def datagram_bytes() -> int:
    """Return the length of a sealed datagram of six markers, all of them seen."""
    frames = detections(load_setup(CALIBRATION, DESK), 10.0)
    return OVERHEAD + max(len(encode(one)) for one in next(iter(frames.values())))


def cost_per_camera(run: ScaleRun, stages: dict[str, float]) -> float:
    """Return the processor time of each camera [cores]: all but the hand's fit, its filter and gestures."""
    hand_us = sum(stages.get(name, 0.0) for name in PER_HAND)
    return (run.cores - run.masters * run.poses_hz * hand_us * 1e-6) / run.cameras


def main(arguments: Sequence[str]) -> int:
    """Run it; 1 where a message was lost."""
    parser = argparse.ArgumentParser("python -m bench scale", description=__doc__)
    parser.add_argument("--page", type=Path, metavar="FILE", help="write the measurement into this page")
    page = parser.parse_args(arguments).page
    runs, stages = list[ScaleRun](), {count: solve_us(count, RATES_HZ[ROOM]) for count in CAMERAS}
    with tempfile.TemporaryDirectory() as name:
        for layout, rate_hz in RATES_HZ.items():
            print(f"\n{layout}, {rate_hz:g} Hz\n{_TABLE_HEAD}", flush=True)
            for count in CAMERAS:
                runs.append(measure(Path(name) / f"{layout}{count}", layout, count, rate_hz, SECONDS))
                alone = cost_per_camera(runs[-1], stages[count])
                print(_table_row(asdict(runs[-1]) | {"without_hand": alone}), flush=True)
        found, hops = summary(runs, stages), hop_ms(Path(name))
    found["model"] |= {"hop_p50_ms": round(hops[0], 2), "hop_p99_ms": round(hops[1], 2)}
    print(json.dumps({name: found[name] for name in ("model", "stages_us")}, indent=1))
    if page is not None:
        into_page(page, found)
    return int(any(one.lost + one.dropped + one.blocked for one in runs))
