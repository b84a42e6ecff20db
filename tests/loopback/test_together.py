"""Cameras and wrist device of one hand as their user starts them: every sensor a process, one master for all."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from master.outputs.poses import Poses
from tests.sockets import Listener, listeners, rows, undocumented

ROOT = Path(__file__).resolve().parents[2]
ENOUGH = 20  # poses, however long a machine takes to draw what they are made of


def count_poses(out: Path) -> int:
    """How many poses the master has told so far, by its lines of every second."""
    return sum(map(int, re.findall(r"rate (\d+) poses/s", (out / "master.log").read_text())))


def test_the_grab_test_runs_scores_and_outlives_its_wrist_device(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "master", "demo", "--scene", "grasp", "--headless", "--seconds", "180"]
    demo = subprocess.Popen(
        [*command, "--out", str(tmp_path)],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    received: list[str] = []
    pids: dict[str, int] = {}
    listening: set[Listener] = set()
    killed_ns = before = 0
    ended = False
    assert demo.stdout is not None
    for line in demo.stdout:
        received.append(line)
        pids = pids or {name: int(pid) for name, pid in re.findall(r"(\w+) \(pid (\d+)\)", line)}
        run_s = int(found[1]) if (found := re.search(r"(\d+) of 180 s ", line)) else 0
        if run_s >= 6 and not killed_ns and count_poses(tmp_path) > ENOUGH:
            listening = listeners(demo.pid)
            killed_ns, before = time.monotonic_ns(), count_poses(tmp_path)
            os.kill(pids["wrist"], signal.SIGKILL)
        if killed_ns and not ended and run_s >= 12 and count_poses(tmp_path) > before + ENOUGH:
            ended = True
            demo.send_signal(signal.SIGINT)
    output = "".join(received)
    assert demo.wait(60) == 0, output
    assert {"master run", "slave run"} <= {one.program for one in listening}
    assert undocumented(listening, rows()) == [], "what listens is in docs/security.md"
    assert all(one.here for one in listening), "a demo is nobody else's business"
    assert list(pids) == ["left", "right", "wrist", "imu", "master"]
    assert not any(Path(f"/proc/{pid}").exists() for pid in pids.values())
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["restarts"] == {"wrist": 1}
    # How many frames a busy machine has time for is its own affair; how fast the cameras run is not. It is told from
    # two messages of one process on, and the wrist device's may send one and be killed.
    rates = {"left": 60.0, "right": 60.0, "wrist": 90.0}
    before = summary["camera_hz"]
    assert {"left", "right"} <= before.keys()
    assert before == pytest.approx({name: rates[name] for name in before}, rel=2e-3)
    counts = summary["counts"]
    assert counts["wrist.received"] > 0
    assert counts["imu.received"] > 50
    for key in ("joint_mm", "joint_mm_visible", "pip_deg", "marker_mm"):
        assert np.isfinite(summary[key]), key
    assert "joint error, visible fingers" in output
    for name in ("hand.png", "run.rrd", "poses.npz", *(f"{name}.log" for name in pids)):
        assert (tmp_path / name).stat().st_size > 0, name
    poses = Poses.load(tmp_path / "poses.npz")
    assert poses.marker_count == 8
    assert (np.diff(poses.t_ns) > 0).all()
    assert (poses.t_ns > killed_ns).sum() > 5, "the hand is tracked by what is left"
