"""Simulated marker cameras of one rig in one process: exact projections with noise, over sealed UDP.

`python -m bench.rigs.sender TREE RIG RATE_HZ BEACON_PORT EPOCH_NS [--cameras NAME ...] [--way] [--clock-s OFFSET]
[--wire VERSION]`, the rig key in PHALANX_RIG_KEY. It prints `ready` when it listens, `sending` when all cameras have
the start. `step SECONDS` on standard input steps its clock; the end of it ends the process. It costs little, so that
the master or the link is measured and not a machine too slow to draw.

Cameras that share a processor would share one thread each with Python's lock: one loop sends for all, in the order of
their times. Frames that were not sent in time are gone, as a camera's are that nobody reads.
"""

import argparse
import logging
import os
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec

import common.link.datagram
from bench.rigs.rooms import LOOP_S, detections
from common.bus.keys import rig_key
from common.clock import SkewedClock, SystemClock
from common.messages import WIRE_VERSION, MarkerDetections
from master.rig.setup import load_setup
from slave.uplink import Uplink

WAY_S = 10.0  # of the scene, forth and back with `--way`: nothing ever leaps
LATE_S = {"left": 0.0, "right": 0.005}  # phases of the cameras with `--way`


def scene_s(t_s: float) -> float:
    """Return scene time [s] at a time since the epoch: forth and back for ever."""
    phase = t_s % (2.0 * WAY_S)
    return min(phase, 2.0 * WAY_S - phase)


@dataclass(slots=True)
class Camera:
    """One simulated camera: its link, its frames of a loop of the scene, and the number of the next one."""

    uplink: Uplink
    frames: list[MarkerDetections]
    loop_ns: int
    seq: int = 0

    def due_ns(self, epoch_ns: int) -> int:
        """When the next frame is taken."""
        loop, k = divmod(self.seq, len(self.frames))
        return epoch_ns + loop * self.loop_ns + self.frames[k].t_ns


def send(cameras: Sequence[Camera], clock: SkewedClock, epoch_ns: int, stop: threading.Event) -> None:
    """Send each frame when it is due, until `stop`."""
    true = SystemClock()
    for one in cameras:
        period_ns = one.loop_ns / len(one.frames)
        one.seq = max(0, round((true.now_ns() + 0.05e9 - epoch_ns) / period_ns))
    buffers = 4  # frames that a camera keeps while nobody reads it; older ones are gone
    while not stop.is_set():
        camera = min(cameras, key=lambda one: one.due_ns(epoch_ns))
        due_ns, period_ns = camera.due_ns(epoch_ns), camera.loop_ns / len(camera.frames)
        if (gone := int((true.now_ns() - due_ns) // period_ns) - buffers) > 0:
            camera.seq += gone
            continue
        while (left_ns := due_ns - true.now_ns()) > 0:
            time.sleep(left_ns * 1e-9)
        times = {"t_ns": clock.from_true(due_ns), "ready_t_ns": clock.now_ns()}
        frame, session = camera.frames[camera.seq % len(camera.frames)], camera.uplink.session
        camera.uplink.send(msgspec.structs.replace(frame, session=session, seq=camera.seq, **times))
        camera.seq += 1


def main() -> None:
    """Send until standard input ends."""
    parser = argparse.ArgumentParser(description=__doc__)
    for name, kind in (("tree", Path), ("rig", str), ("rate_hz", float), ("port", int), ("epoch_ns", int)):
        parser.add_argument(name, type=kind)
    parser.add_argument("--cameras", nargs="*", help="these alone")
    parser.add_argument("--way", action="store_true", help="the scene goes forth and back")
    parser.add_argument("--clock-s", type=float, default=0.0, help="offset of its clock")
    parser.add_argument("--wire", type=int, default=WIRE_VERSION, help="its wire version")
    given = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(name)s: %(message)s", stream=sys.stdout)
    setattr(common.link.datagram, "WIRE_VERSION", given.wire)  # noqa: B010  as a program of that version has it
    clock, key = SkewedClock(round(given.clock_s * 1e9), 0.0), rig_key(os.environ, None)
    setup = load_setup(given.tree, given.rig)
    if given.way:
        loop_s = 2.0 * WAY_S
        frames = detections(setup, given.rate_hz, loop_s=loop_s, phases_s=LATE_S, unseen=0.0, scene_s=scene_s)
    else:
        loop_s, frames = LOOP_S, detections(setup, given.rate_hz)
    cameras = [
        Camera(Uplink(name, key, clock, given.port, "127.0.0.1"), frames[name], round(1e9 * loop_s))
        for name in given.cameras or frames
    ]
    stop = threading.Event()

    def run() -> None:
        while not stop.is_set() and not all(one.uplink.started for one in cameras):
            time.sleep(0.05)
        print("sending", flush=True)
        send(cameras, clock, given.epoch_ns, stop)

    thread = threading.Thread(target=run)
    thread.start()
    print("ready", flush=True)
    for line in sys.stdin:
        if line.startswith("step "):
            clock.step(round(float(line.split()[1]) * 1e9))
    stop.set()
    thread.join()
    for one in cameras:
        one.uplink.close()


if __name__ == "__main__":
    main()
