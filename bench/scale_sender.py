"""Many simulated cameras in one process: each sends its detections at its rate, sealed, over UDP, until it is stopped.

`python -m bench.scale_sender RATE_HZ TREE RIG BEACON_PORT KEY_FILE [TREE RIG BEACON_PORT KEY_FILE ...]`: one group of
four for each master. It prints `sending` when all have the start, and at the end what it sent and how late it was.

Cameras that share a processor would otherwise share one thread each with Python's lock: one loop sends for all, in the
order of their phases. What it costs is no part of what is measured; when it is late, it says so.
"""

import json
import signal
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from bench.scale_rig import LOOP_S, detections_of
from common.bus.keys import rig_key
from common.clock import SystemClock
from common.messages import MarkerDetections
from master.rig.files import load_setup
from slave.uplink import Uplink

_START_S = 60.0


@dataclass(frozen=True, slots=True)
class _Camera:
    """One simulated camera: its link, and what it tells of a loop of the scene."""

    uplink: Uplink
    frames: list[MarkerDetections]


def main() -> None:
    """Wait for the start of every master, then send until SIGTERM or SIGINT."""
    rate_hz, groups = float(sys.argv[1]), sys.argv[2:]
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda _number, _frame: stop.set())
    cameras = [one for k in range(0, len(groups), 4) for one in _of(rate_hz, *groups[k : k + 4])]
    for camera in cameras:
        if not camera.uplink.wait_for_start(_START_S):
            raise SystemExit("a master does not start: is it running, with this key and beacon port?")
    print("sending", flush=True)
    sent, late_s = _send(cameras, rate_hz, stop)
    late_ms = [1e3 * float(value) for value in np.percentile(late_s, [50, 99])] if late_s else [0.0, 0.0]
    for camera in cameras:
        camera.uplink.close()
    blocked = sum(one.uplink.counts["would_block"] + one.uplink.counts["send_failed"] for one in cameras)
    unsent = sum(one.uplink.counts["unsent"] for one in cameras)
    print(json.dumps({"sent": sent, "blocked": blocked, "unsent": unsent, "late_p50_ms": late_ms[0],
                      "late_p99_ms": late_ms[1]}), flush=True)  # fmt: skip


def _of(rate_hz: float, tree: str, rig: str, port: str, key_file: str) -> list[_Camera]:
    """The cameras of one master."""
    setup, key = load_setup(Path(tree), rig), rig_key({}, Path(key_file))
    seen = detections_of(setup, rate_hz)
    return [
        _Camera(Uplink(name, key, SystemClock(), int(port), "127.0.0.1"), frames)
        for name, frames in seen.items()
    ]


def _send(cameras: list[_Camera], rate_hz: float, stop: threading.Event) -> tuple[int, list[float]]:
    """Send on the grid of each camera; how many were sent, and by how much each was late [s]."""
    clock, period = SystemClock(), round(LOOP_S * rate_hz)
    order = sorted(range(len(cameras)), key=lambda k: cameras[k].frames[0].t_ns)
    first_ns = clock.now_ns() + 50_000_000
    late_s: list[float] = []
    seq = 0
    while not stop.is_set():
        loop_ns = first_ns + (seq // period) * round(1e9 * LOOP_S)
        for k in order:
            camera = cameras[k]
            frame = camera.frames[seq % period]
            due_ns = loop_ns + frame.t_ns
            while (left_ns := due_ns - clock.now_ns()) > 0:
                time.sleep(left_ns * 1e-9)
            late_s.append(-left_ns * 1e-9)
            camera.uplink.send(
                msgspec.structs.replace(
                    frame, session=camera.uplink.session, seq=seq, t_ns=due_ns, ready_t_ns=clock.now_ns()
                )
            )
        seq += 1
    return len(late_s), late_s


if __name__ == "__main__":
    main()
