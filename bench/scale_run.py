"""One run of many simulated cameras before real masters: what they cost, what was lost, how late the poses are."""

import json
import os
import re
import secrets
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from math import nan
from pathlib import Path
from statistics import median
from typing import cast

import numpy as np

from bench.local_rig import free_port, join_bus
from bench.scale_rig import DESK, ROOM, desk, room
from common.bus.bus import Bus, Subscription
from common.messages import Command, HandPose, encode
from common.messages.streams import MASTER

READY_S, SETTLE_S = 90.0, 3.0
_TICKS = os.sysconf("SC_CLK_TCK")
_DEPTH = 1 << 14
_LOST = ("lost", "dropped", "refused", "blocked")


@dataclass(frozen=True, slots=True)
class ScaleRun:
    """What one run of so many cameras came to.

    Attributes:
        layout: `room`, one master of all cameras, or `building`, a master for each two.
        cameras, masters: How many.
        rate_hz: Of each camera.
        seconds: How long was measured.
        sent, received: Messages in that time, by the clock of each end.
        lost, dropped, refused, blocked, skipped: As the masters count them; `skipped`: the sender was too late.
        shed: Instants that were not solved, for newer ones waited.
        poses_hz: Of one master.
        latency_p50_ms, latency_p99_ms: From the sending of the last frame of a pose to its publication.
        cores: Processor time of all masters together, seconds a second.
        threads: The same by thread of a master: `solve`, `ingest`, `bus`, `others`.
        pose_bytes: Of a pose on the bus, with what is told beside it.
        sender_late_p99_ms: By how much the simulated cameras were late themselves.
        load: Load average of the machine at the end.
    """

    layout: str
    cameras: int
    masters: int
    rate_hz: float
    seconds: float
    sent: int
    received: int
    lost: int
    dropped: int
    refused: int
    blocked: int
    skipped: int
    dropped_epochs: int
    poses_hz: float
    latency_p50_ms: float
    latency_p99_ms: float
    cores: float
    threads: dict[str, float]
    pose_bytes: float
    sender_late_p99_ms: float
    load: float


@dataclass(slots=True)
class _Master:
    """A master that runs. Holds its process, its bus, and what was heard there."""

    process: subprocess.Popen[bytes]
    bus: Bus
    hands: Subscription
    group: list[str]
    latency_ms: list[float] = field(default_factory=list[float])
    pose_bytes: int = 0

    def listen(self) -> None:
        """Take the poses that came."""
        while isinstance(pose := self.hands.get(0.0), HandPose):
            self.latency_ms.append(pose.latency_ns * 1e-6)
            self.pose_bytes = self.pose_bytes or len(encode(pose))

    def counts(self) -> dict[str, int]:
        """What it counted since its start."""
        return dict(self.bus.ask(Command(MASTER, "report"), 5.0).counts)


def measure(folder: Path, layout: str, cameras: int, rate_hz: float, seconds: float) -> ScaleRun:
    """Run it once.

    Args:
        folder: For files of this run; a new one.
        layout: `room` or `building`.
        cameras: How many, an even number in a building.
        rate_hz: Of each.
        seconds: How long is measured, after some seconds in which all settles.

    Raises:
        BusError: A master does not come up.
        RuntimeError: The simulated cameras did not start.
    """
    folder.mkdir(parents=True)
    masters = 1 if layout == ROOM else cameras // 2
    tree, rig = (room(folder, cameras, rate_hz), ROOM) if layout == ROOM else (desk(folder, rate_hz), DESK)
    with ExitStack() as stack:
        running = [_start(stack, folder / f"master{k}", tree, rig) for k in range(masters)]
        groups = [word for one in running for word in one.group]
        command = [sys.executable, "-m", "bench.scale_sender", str(rate_hz), *groups]
        sender = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        stack.callback(_end, sender)
        assert sender.stdout is not None
        if sender.stdout.readline().strip() != "sending":
            raise RuntimeError(f"no camera sends; see {folder}/master0.log")
        time.sleep(SETTLE_S)
        before, cpu, began = _sums(running), _threads(running), time.monotonic()
        for one in running:
            one.listen()
            one.latency_ms.clear()
        while time.monotonic() - began < seconds:
            time.sleep(0.2)
            for one in running:
                one.listen()
        took, after, spent = time.monotonic() - began, _sums(running), _threads(running)
        for one in running:
            one.listen()
        load = os.getloadavg()[0]
        sender.terminate()
        said = cast(dict[str, float], json.loads(sender.stdout.readline()))
    threads = {name: (spent[name] - cpu[name]) / took for name in spent}
    latencies = [np.percentile(one.latency_ms, [50, 99]) for one in running if one.latency_ms]
    came = {name: after[name] - before[name] for name in after}
    return ScaleRun(
        layout=layout,
        cameras=cameras,
        masters=masters,
        rate_hz=rate_hz,
        seconds=took,
        sent=round(rate_hz * cameras * took),
        received=came["received"],
        lost=came["lost"],
        dropped=came["dropped"],
        refused=came["refused"],
        blocked=came["blocked"],
        skipped=came["skipped"],
        dropped_epochs=came["shed"],
        poses_hz=median(len(one.latency_ms) for one in running) / took,
        latency_p50_ms=float(np.median([one[0] for one in latencies])) if latencies else nan,
        latency_p99_ms=float(np.median([one[1] for one in latencies])) if latencies else nan,
        cores=sum(threads.values()),
        threads=threads,
        pose_bytes=median(one.pose_bytes for one in running),
        sender_late_p99_ms=said["late_p99_ms"],
        load=load,
    )


def _start(stack: ExitStack, place: Path, tree: Path, rig: str) -> _Master:
    """Start a master with a key and ports of its own."""
    key = place.with_suffix(".key")
    key.write_text(secrets.token_hex(32))
    key.chmod(0o600)
    beacon, data = free_port(socket.SOCK_DGRAM), free_port(socket.SOCK_DGRAM)
    bus_end = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    ends = ["--beacon", f"127.255.255.255:{beacon}", "--bind", f"127.0.0.1:{data}", "--bus", bus_end]
    command = [sys.executable, "-m", "master", "run", "--rig", rig, "--calibration", str(tree), *ends]
    with place.with_suffix(".log").open("w") as log:
        process = subprocess.Popen([*command, "--key-file", str(key)], stdout=log, stderr=log)
    stack.callback(_end, process)
    bus = join_bus(bus_end, READY_S)
    stack.callback(bus.close)
    hands = bus.subscribe("hand", depth=_DEPTH)
    return _Master(process, bus, hands, [str(tree), rig, str(beacon), str(key)])


def _sums(masters: Sequence[_Master]) -> dict[str, int]:
    """Counts of all masters and their cameras."""
    out: dict[str, int] = dict.fromkeys((*_LOST, "received", "skipped", "shed"), 0)
    for counts in (one.counts() for one in masters):
        for name in ("lost", "skipped", "received"):
            out[name] += sum(n for key, n in counts.items() if key.endswith(f".{name}"))
        out["dropped"] += counts.get("queue.dropped", 0)
        out["refused"] += sum(n for key, n in counts.items() if key.startswith("refused."))
        out["blocked"] += counts.get("would_block", 0) + counts.get("send_failed", 0)
        out["shed"] += sum(n for key, n in counts.items() if key.endswith("instants_shed"))
    return out


def _threads(masters: Sequence[_Master]) -> dict[str, float]:
    """Processor time of all masters by thread since they began [s].

    Python's threads have the name of the process, those of the bus names of their own. Of the former the main one
    solves and publishes; the busiest other one is that of ingest.
    """
    out: dict[str, float] = dict.fromkeys(("solve", "ingest", "bus", "others"), 0.0)
    for one in masters:
        pid = one.process.pid
        own: list[float] = []
        for task in Path(f"/proc/{pid}/task").iterdir():
            name, _, rest = (task / "stat").read_text().partition("(")[2].rpartition(")")
            fields = rest.split()
            spent = (int(fields[11]) + int(fields[12])) / _TICKS
            if task.name == str(pid):
                out["solve"] += spent
            elif re.match(r"python|phalanx", name):
                own.append(spent)
            else:
                out["bus"] += spent
        own.sort()
        out["ingest"] += own[-1] if own else 0.0
        out["others"] += sum(own[:-1])
    return out


def _end(process: subprocess.Popen[bytes] | subprocess.Popen[str]) -> None:
    process.terminate()
    try:
        process.wait(10.0)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
