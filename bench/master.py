"""The master's work per pose above the bus, and many cameras over real sealed UDP."""

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from bench.row import Row, median_us
from common.bus.keys import new_key
from common.calibration import HandProfile, load
from common.clock import SystemClock
from common.messages import MarkerDetections, decode, encode
from common.sim.scene import Scene
from master.rig.files import load_setup
from master.rig.pipeline import build_pipeline
from master.rig.setup import RigSetup
from master.run.ingest import Ingest
from master.run.stages import StageTimes

_CALIBRATION = Path(__file__).parent.parent / "calib_json"
_CAMERAS, _RATE_HZ, _SECONDS = 16, 90, 5
_FRAMES = 600


def rows() -> list[Row]:
    """Codec, pose, and sixteen cameras."""
    setup = load_setup(_CALIBRATION, "desk")
    messages = _messages(setup)
    wire = encode(messages[0])
    coding, spread = median_us(lambda: decode(wire), 2000)
    copying, _ = median_us(lambda: bytes(bytearray(wire)), 2000)
    stages = StageTimes(time.thread_time_ns)
    pipeline = build_pipeline(setup, stages)
    pushes: list[float] = []
    poses = 0
    for message in messages:
        start = time.thread_time_ns()
        poses += len(pipeline.push(message))
        pushes.append((time.thread_time_ns() - start) * 1e-3)
    each = sum(pushes) / poses
    stage = {name: total / poses for name, total in stages.total_us().items()}
    return [
        Row(
            "decode one message",
            coding,
            "us",
            f"± {spread:.1f}; copying its {len(wire)} bytes takes {copying:.2f}",
        ),
        Row("CPU per pose above the bus", each, "us", "goal 1560"),
        Row("  without the whole-hand fit", each - stage["hand"], "us", "goal 60"),
        Row("  slowest 1 % of messages", float(np.percentile(pushes, 99)), "us", "from"),
        *(Row(f"  stage {name}", value, "us", "CPU per pose") for name, value in stage.items()),
        *_many(),
    ]


def _messages(setup: RigSetup) -> list[MarkerDetections]:
    """Exact projections of the standard scene's caps, two cameras 5 ms apart, 60 Hz."""
    profile = load(_CALIBRATION / "hands" / f"{setup.rig.hand}.json", HandProfile)
    scene = Scene.standard(setup.rig, setup.cameras, profile)
    rng = np.random.default_rng(7)
    out: list[MarkerDetections] = []
    full = np.full(len(setup.rig.markers), 150.0)
    sigma, nowhere = np.full(len(full), 0.1), np.full((len(full), 2), np.nan)
    for seq in range(_FRAMES):
        for index, (name, model) in enumerate(setup.models.items()):
            t_s = seq / 60.0 + 0.005 * index
            uv = model.project(scene.truth(t_s).markers_m) + rng.normal(size=(len(full), 2)) * 0.08
            t_ns = round(t_s * 1e9)
            quality = np.ones(len(full))
            out.append(MarkerDetections(name, 1, seq, t_ns, t_ns, uv, full, quality, sigma, nowhere))
    return sorted(out, key=lambda message: message.t_ns)


def _many() -> list[Row]:
    """Sixteen slaves at 90 Hz: what the master received, and the share of a core it took."""
    key = new_key()
    port = 47000 + os.getpid() % 500
    names = tuple(f"camera{k}" for k in range(_CAMERAS))
    arguments = [str(value) for value in (_CAMERAS, _RATE_HZ, _SECONDS, port)]
    ingest = Ingest(names, bytes.fromhex(key), SystemClock(), ("127.255.255.255", port), ("127.0.0.1", 0), "")
    sender = subprocess.Popen([sys.executable, "-m", "bench.senders", *arguments, key])
    received, first_ns, cpu_ns = 0, 0, 0
    try:
        while sender.poll() is None or received == 0:
            while ingest.get(0.2) is not None:
                if received == 0:
                    first_ns, cpu_ns = time.monotonic_ns(), time.process_time_ns()
                received += 1
            if sender.poll() not in (None, 0):
                break
        share = (time.process_time_ns() - cpu_ns) / max(time.monotonic_ns() - first_ns, 1)
        lost = ingest.lost + ingest.counts["queue.dropped"]
    finally:
        ingest.close()
        sender.wait()
    sent = _CAMERAS * _RATE_HZ * _SECONDS
    return [
        Row(f"{_CAMERAS} cameras at {_RATE_HZ} Hz: messages lost", float(lost), "", f"of {sent}; goal 0"),
        Row("  received", float(received), "", ""),
        Row("  share of one core", 100 * share, "%", "unseal, decode, clock, queue"),
    ]
