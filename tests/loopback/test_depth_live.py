"""`phalanx calibrate depth --live` as a user runs it: a process with a keyboard, two slaves on the wire."""

import json
import os
import subprocess
import sys
import threading
import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

from common.arrays import Float
from common.bus.keys import new_key
from common.calibration import RigCalibration, load, save
from common.clock import SystemClock
from common.messages import MarkerDetections
from master.fabrik.depth import AffineDisparity
from slave.uplink import Uplink
from tests.hand_helpers import camera_file, rig_file
from tests.network_helpers import PATIENCE_S, free_udp_port

CAMERAS = ("left", "right")
RIG = AffineDisparity(37.3, 2.64)
STEPS = (1.0, 0.8, 0.65, 0.5, 0.4, 0.3, 0.25, 0.2)


class Slaves:
    """Two slaves that send a target at `distance`, 100 frames a second, until they are stopped."""

    def __init__(self, stack: ExitStack, key: bytes, port: int) -> None:
        self.clock = SystemClock()
        self.distance = STEPS[0]
        self.uplinks = [Uplink(name, key, self.clock, port, "127.0.0.1") for name in CAMERAS]
        for uplink in self.uplinks:
            stack.callback(uplink.close)
        self.stop = threading.Event()
        thread = threading.Thread(target=self._send, daemon=True)
        thread.start()
        stack.callback(thread.join)
        stack.callback(self.stop.set)

    def _send(self) -> None:
        rng = np.random.default_rng(8)
        seq = 0
        while not self.stop.is_set():
            half = 0.5 * float(RIG.disparity(np.array(self.distance)))
            for camera, side, uplink in zip(CAMERAS, (half, -half), self.uplinks, strict=True):
                uv = np.array([319.5 + side, 239.5]) + rng.normal(0.0, 0.05, 2)
                uplink.send(frame(camera, uplink.session, seq, self.clock.now_ns(), uv))
            seq += 1
            time.sleep(0.01)


def frame(camera: str, session: int, seq: int, t_ns: int, uv: Float) -> MarkerDetections:
    at, one = np.full((6, 2), np.nan), np.full(6, np.nan)
    at[1], one[1] = uv, 1.0
    return MarkerDetections(
        camera, session, seq, t_ns, t_ns, at, 900 * one, one, 0.05 * one, np.full((6, 2), np.nan)
    )


def test_a_person_measures_a_rig(root: Path, tmp_path: Path) -> None:
    (tmp_path / "rigs").mkdir()
    (tmp_path / "cameras").mkdir()
    save(tmp_path / "rigs" / "bench.json", rig_file())
    for name in CAMERAS:
        save(tmp_path / "cameras" / f"{name}.json", camera_file(name))
    key, port = new_key(), free_udp_port()
    with ExitStack() as stack:
        slaves = Slaves(stack, bytes.fromhex(key), port)
        command = [
            sys.executable, "-m", "master", "calibrate", "depth", "--live", "--rig", "bench", "--marker", "index",
            "--calibration", str(tmp_path), "--out", str(tmp_path), "--json", str(tmp_path / "n.json"),
            "--distances", ",".join(map(str, STEPS)), "--save", str(tmp_path / "kept.csv"),
            "--beacon", f"127.255.255.255:{port}", "--bind", "127.0.0.1:0",
        ]  # fmt: skip
        environment = {**os.environ, "PHALANX_RIG_KEY": key}
        pipe = subprocess.PIPE
        person = stack.enter_context(
            subprocess.Popen(command, cwd=root, env=environment, stdin=pipe, stdout=pipe, text=True)
        )
        stack.callback(person.kill)
        assert person.stdin is not None
        assert person.stdout is not None
        assert "listening on" in person.stdout.readline()
        for distance in STEPS:
            slaves.distance = distance
            person.stdin.write("\n")
            person.stdin.flush()
            output = person.stdout.readline()
            assert f"{distance:.3f} m: disparity" in output
        rest = person.stdout.read()
        assert person.wait(PATIENCE_S) == 0
    assert "wrote" in rest
    rig = load(tmp_path / "rigs" / "bench.json", RigCalibration)
    assert rig.affine_disparity is not None
    assert rig.affine_disparity.a_m_px == pytest.approx(37.3, rel=0.01)
    assert rig.provenance["power_law"].data == ("kept.csv",)
    assert len((tmp_path / "kept.csv").read_text().splitlines()) == 1 + len(STEPS)
    assert json.loads((tmp_path / "n.json").read_text())["best"] == "affine_disparity"
