"""One camera as a process of its own that can be put wrong: exact projections of the standard scene, over sealed UDP.

`python -m bench.faults_sender CAMERA BEACON_PORT EPOCH_NS RATE_HZ [--clock-s OFFSET] [--wire VERSION]`, the rig key in
PHALANX_RIG_KEY. It reads lines from its standard input: `step SECONDS` steps its clock; the end of it ends the process.
It says `ready` when it listens. The link is that of a slave (`slave.uplink`), else as `bench.detections_sender`: it
costs little, so that a fault of the link is measured and not a machine too slow to draw.
"""

import argparse
import logging
import os
import sys
import threading
import time

import msgspec
import numpy as np

import common.link.datagram
from bench.detections_sender import CALIBRATION, NOISE_PX
from common.bus.keys import rig_key
from common.calibration import HandProfile, load
from common.clock import SkewedClock, SystemClock
from common.messages import WIRE_VERSION, MarkerDetections
from common.sim.scene import Scene
from master.rig.files import load_setup
from master.rig.setup import RigSetup
from slave.uplink import Uplink

WAY_S = 10.0  # of the scene, forth and back: nothing ever leaps
BUFFERS = 4  # frames that a camera keeps while nobody reads it; older ones are gone


def standard_scene(setup: RigSetup) -> Scene:
    """The scene that every sender and every judge sees."""
    profile = load(CALIBRATION / "hands" / f"{setup.rig.hand}.json", HandProfile)
    return Scene.standard(setup.rig, setup.cameras, profile)


def scene_s(t_ns: int, epoch_ns: int) -> float:
    """Scene time [s] at a moment of the machine's clock: forth and back for ever."""
    phase = ((t_ns - epoch_ns) * 1e-9) % (2.0 * WAY_S)
    return min(phase, 2.0 * WAY_S - phase)


def frames_of(camera: str, rate_hz: float, late_ns: int) -> list[MarkerDetections]:
    """What it tells of one way forth and back; session, number and times are set when it is sent."""
    setup = load_setup(CALIBRATION, "desk")
    scene, model, rng = standard_scene(setup), setup.models[camera], np.random.default_rng(7)
    count = len(setup.rig.markers)
    area, ones, sigma = np.full(count, 150.0), np.ones(count), np.full(count, 0.1)
    nowhere = np.full((count, 2), np.nan)
    out: list[MarkerDetections] = []
    for k in range(round(2.0 * WAY_S * rate_hz)):
        caps = scene.truth(scene_s(round(k * 1e9 / rate_hz) + late_ns, 0)).markers_m
        uv = model.project(caps) + rng.normal(size=(count, 2)) * NOISE_PX
        out.append(MarkerDetections(camera, 0, k, 0, 0, uv, area, ones, sigma, nowhere))
    return out


def send(
    frames: list[MarkerDetections],
    uplink: Uplink,
    clock: SkewedClock,
    epoch_ns: int,
    rate_hz: float,
    late_ns: int,
    stop: threading.Event,
) -> None:
    """Send each frame when it is there, until `stop`. Frames that were not read in time are gone, as a camera's are."""
    true, period_ns = SystemClock(), 1e9 / rate_hz
    seq = round((true.now_ns() - epoch_ns) / period_ns) + 1
    while not stop.is_set():
        now_ns = true.now_ns()
        seq = max(seq, int((now_ns - epoch_ns - late_ns) // period_ns) - BUFFERS)
        t_ns = epoch_ns + late_ns + round(seq * period_ns)
        if t_ns > now_ns:
            time.sleep((t_ns - now_ns) * 1e-9)
        frame = frames[seq % len(frames)]
        uplink.send(
            msgspec.structs.replace(
                frame, session=uplink.session, seq=seq, t_ns=clock.from_true(t_ns), ready_t_ns=clock.now_ns()
            )
        )
        seq += 1


def main() -> None:
    """Send until standard input ends."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("camera")
    parser.add_argument("port", type=int)
    parser.add_argument("epoch_ns", type=int)
    parser.add_argument("rate_hz", type=float)
    parser.add_argument("--late-ms", type=float, default=0.0, help="how much later than the epoch it begins")
    parser.add_argument("--clock-s", type=float, default=0.0, help="how far its clock is ahead")
    parser.add_argument("--wire", type=int, default=WIRE_VERSION, help="the wire version that it speaks")
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(name)s: %(message)s", stream=sys.stdout)
    setattr(common.link.datagram, "WIRE_VERSION", options.wire)  # noqa: B010  as a program of that version has it
    clock, late_ns = SkewedClock(round(options.clock_s * 1e9), 0.0), round(options.late_ms * 1e6)
    frames = frames_of(options.camera, options.rate_hz, late_ns)
    uplink = Uplink(options.camera, rig_key(os.environ, None), clock, options.port, "127.0.0.1")
    stop = threading.Event()
    place = (options.epoch_ns, options.rate_hz, late_ns, stop)
    thread = threading.Thread(target=send, args=(frames, uplink, clock, *place))
    thread.start()
    print("ready", flush=True)
    for line in sys.stdin:
        if line.startswith("step "):
            clock.step(round(float(line.split()[1]) * 1e9))
    stop.set()
    thread.join()
    uplink.close()


if __name__ == "__main__":
    main()
