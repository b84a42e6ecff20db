"""Two cameras that see the standard scene, without drawing it: exact projections with noise, over sealed UDP.

`python -m bench.detections_sender BEACON_PORT SECONDS [RATE_HZ]`, the rig key in PHALANX_RIG_KEY.
It costs a few percent of a core, so that what a master costs can be told from what its cameras would.
"""

import os
import sys
import threading
import time
from pathlib import Path

import msgspec
import numpy as np

from common.bus.keys import rig_key
from common.calibration import HandProfile, load
from common.clock import SystemClock
from common.messages import MarkerDetections
from common.sim.scene import Scene
from master.rig.files import load_setup
from slave.uplink import Uplink

CALIBRATION = Path(__file__).resolve().parents[1] / "calib_json"
RATE_HZ, APART_S, NOISE_PX = 60.0, 0.005, 0.08
_LOOP_S = 20.0  # of the scene, then the same again


def detections_of(rig: str = "desk", rate_hz: float = RATE_HZ) -> dict[str, list[MarkerDetections]]:
    """Of each camera what it tells of `_LOOP_S` of the scene; session, number and times are set when it is sent."""
    setup = load_setup(CALIBRATION, rig)
    profile = load(CALIBRATION / "hands" / f"{setup.rig.hand}.json", HandProfile)
    scene, rng = Scene.standard(setup.rig, setup.cameras, profile), np.random.default_rng(7)
    count = len(setup.rig.markers)
    area, ones, sigma = np.full(count, 150.0), np.ones(count), np.full(count, 0.1)
    nowhere = np.full((count, 2), np.nan)
    out: dict[str, list[MarkerDetections]] = {}
    for index, (name, model) in enumerate(setup.models.items()):
        out[name] = []
        for k in range(round(_LOOP_S * rate_hz)):
            caps = scene.truth(k / rate_hz + APART_S * index).markers_m
            uv = model.project(caps) + rng.normal(size=(count, 2)) * NOISE_PX
            out[name].append(MarkerDetections(name, 0, k, 0, 0, uv, area, ones, sigma, nowhere))
    return out


def send(
    camera: str,
    frames: list[MarkerDetections],
    uplink: Uplink,
    late_s: float,
    stop: threading.Event,
    rate_hz: float = RATE_HZ,
) -> None:
    """Send a frame each period until `stop`; numbers and times are of now."""
    clock = SystemClock()
    while not stop.is_set() and not uplink.wait_for_start(0.2):
        pass
    first_ns, period_ns = clock.now_ns() + round(1e9 * late_s), round(1e9 / rate_hz)
    seq = 0
    while not stop.is_set():
        t_ns = first_ns + seq * period_ns
        time.sleep(max(0.0, (t_ns - clock.now_ns()) * 1e-9))
        frame = frames[seq % len(frames)]
        uplink.send(
            msgspec.structs.replace(
                frame, session=uplink.session, seq=seq, t_ns=t_ns, ready_t_ns=clock.now_ns()
            )
        )
        seq += 1


def main() -> None:
    """Send for so long, or until the process is stopped."""
    port, seconds = int(sys.argv[1]), float(sys.argv[2])
    rate_hz = float(sys.argv[3]) if len(sys.argv) > 3 else RATE_HZ
    key, stop = rig_key(os.environ, None), threading.Event()
    frames = detections_of(rate_hz=rate_hz)
    links = {name: Uplink(name, key, SystemClock(), port, "127.0.0.1") for name in frames}
    threads = [
        threading.Thread(target=send, args=(name, frames[name], link, APART_S * k, stop, rate_hz))
        for k, (name, link) in enumerate(links.items())
    ]
    for thread in threads:
        thread.start()
    stop.wait(seconds)
    stop.set()
    for thread in threads:
        thread.join()
    for link in links.values():
        link.close()


if __name__ == "__main__":
    main()
