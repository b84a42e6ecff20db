"""The main job as its user starts it: two slaves, real UDP, one master, killed and restarted on the way."""

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import TypeAlias

import numpy as np
import pytest

from common.arrays import Bool
from common.sim.scenes import scene_by_name
from master.outputs.poses import Poses
from master.rig.setup import load_setup
from tests.network_helpers import until
from tests.sockets import Listener, listeners, rows, undocumented

ROOT = Path(__file__).resolve().parents[2]
LEAST_HZ = (
    8.0  # of poses so far apart only what is measured can be judged: what filter and model make of it lags
)
ENOUGH = 20  # poses, however long a machine takes to draw what they are made of


Demo: TypeAlias = Callable[..., subprocess.Popen[str]]


@pytest.fixture(name="demo_of")
def _demos() -> Iterator[Demo]:
    """Starts demos; a test that fails on the way leaves none behind to slow down the next."""
    started: list[subprocess.Popen[str]] = []

    def start(out: Path, seconds: float, *more: str) -> subprocess.Popen[str]:
        started.append(_demo(out, seconds, *more))
        return started[-1]

    yield start
    for demo in started:
        for _ in range(2):
            demo.send_signal(signal.SIGTERM)  # nothing where it has ended
            time.sleep(0.2 if demo.poll() is None else 0.0)
        demo.wait(60)
        if demo.stdout is not None:
            demo.stdout.close()


def _demo(out: Path, seconds: float, *more: str) -> subprocess.Popen[str]:
    command = [
        sys.executable,
        "-m",
        "master",
        "demo",
        "--headless",
        "--seconds",
        str(seconds),
        "--out",
        str(out),
        *more,
    ]
    return subprocess.Popen(
        [*command, "--json", str(out / "copy.json")],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def _lines(demo: subprocess.Popen[str]) -> Iterator[str]:
    assert demo.stdout is not None
    for line in demo.stdout:
        yield line.rstrip("\n")


def _pids(line: str) -> dict[str, int]:
    return {name: int(pid) for name, pid in re.findall(r"(\w+) \(pid (\d+)\)", line)}


def _epoch_ns(pid: int) -> int:
    """Scene time 0 on this machine's monotonic clock, from how a slave was started."""
    words = Path(f"/proc/{pid}/cmdline").read_bytes().decode().split("\0")
    return int(words[words.index("--scene-epoch-ns") + 1])


def _joint_mm(poses: Poses, scene: str, rig: str, epoch_ns: int) -> float:
    """Mean distance [mm] of all joints but the palm from the truth of a scene of the default seed."""
    setup = load_setup(ROOT / "calib_json", rig)
    played = scene_by_name(scene, setup.rig, setup.cameras, setup.hand.profile, 7)
    truth = np.stack([played.truth((t - epoch_ns) * 1e-9).joints.position_m for t in poses.t_ns.tolist()])
    return float(1e3 * np.linalg.norm(poses.position_m - truth, axis=2)[:, 1:].mean())


def _lost_while_seen(poses: Poses) -> Bool:
    """Poses (T,) after the first valid one that are not valid, though a marker was measured 0.4 s before or later.

    A hand is held for 0.5 s: whatever it does is wrong here, and no machine is too busy to do it right.
    """
    seen = np.isfinite(poses.markers_raw_m.min(axis=2)).sum(axis=1) > 0
    last_ns = np.maximum.accumulate(np.where(seen, poses.t_ns, 0))
    valid = poses.valid.all(axis=1)
    return ~valid & np.logical_or.accumulate(valid) & (poses.t_ns - last_ns < 400_000_000)


def _gone(pids: dict[str, int]) -> bool:
    return not any(Path(f"/proc/{pid}").exists() for pid in pids.values())


def test_demo_tracks_scores_and_leaves_its_results(demo_of: Demo, tmp_path: Path) -> None:
    demo = demo_of(tmp_path, 6.0)
    lines = list(_lines(demo))
    assert demo.wait(60) == 0, "\n".join(lines)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary == json.loads((tmp_path / "copy.json").read_text())
    # No bar of speed here: machines that run tests are busy. Markers are right at any rate; a hand of 1 m/s that
    # is drawn ten times a second leaps by its own size between two frames, and its joints are only near then.
    assert summary["poses"] > ENOUGH
    drawn = summary["poses_per_s"] > 30.0
    if summary["poses_per_s"] > LEAST_HZ:
        assert summary["joint_mm_visible"] < (6.0 if drawn else 20.0)
        assert summary["pip_deg_visible"] < (7.5 if drawn else 15.0)
        assert summary["marker_mm"] < 4.0
    assert summary["marker_raw_mm"] < 4.0
    for key in ("latency_p50_ms", "latency_p99_ms", "lost", "joint_mm", "pip_deg", "poses_per_s"):
        assert np.isfinite(summary[key]), key
    assert summary["camera_hz"] == pytest.approx({"left": 60.0, "right": 60.0}, rel=2e-3)
    assert set(summary["received_hz"]) == {"left", "right"}
    assert set(summary["stage_us"]) == {"frame_sync", "triangulate", "filter", "fabrik", "hand", "gestures"}
    for name in ("hand.png", "run.rrd", "poses.npz", "left.log", "right.log", "master.log"):
        assert (tmp_path / name).stat().st_size > 0, name
    poses = Poses.load(tmp_path / "poses.npz")
    assert (np.diff(poses.t_ns) > 0).all()
    assert poses.valid[len(poses) // 2 :].all()
    assert _gone(_pids(lines[0]))


class HeldUp:
    """How long the processes of a demo could have run and others had the core. Holds a thread that looks."""

    def __init__(self, demo: subprocess.Popen[str]) -> None:
        self._demo, self._waited_ns = demo, dict[int, int]()
        self._rows: list[tuple[int, int]] = [(0, 0)]
        threading.Thread(target=self._look, daemon=True).start()

    def between(self, began_ns: int, ended_ns: int) -> int:
        """All of them together [ns], between two moments of the monotonic clock."""
        at_ns, waited_ns = np.array(self._rows).T
        began, ended = np.interp([began_ns, ended_ns], at_ns, waited_ns)
        return int(ended - began)

    def _look(self) -> None:
        pid = self._demo.pid
        while self._demo.poll() is None:
            with suppress(OSError):  # one has just ended
                children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
                for one in (pid, *map(int, children)):
                    self._waited_ns[one] = int(Path(f"/proc/{one}/schedstat").read_text().split()[1])
            self._rows.append((time.monotonic_ns(), sum(self._waited_ns.values())))
            time.sleep(0.02)


def _running(demo: subprocess.Popen[str], pids: dict[str, int], again: str) -> dict[str, int]:
    """The processes once one of them was started again."""
    children = Path(f"/proc/{demo.pid}/task/{demo.pid}/children").read_text().split()
    (new,) = {int(pid) for pid in children} - set(pids.values())
    return pids | {again: new}


def _scene_s(line: str) -> int:
    """How long the scene has run, where a line of progress says so; else 0."""
    found = re.search(r"(\d+) of \d+ s ", line)
    return int(found[1]) if found else 0


def _count_poses(out: Path) -> int:
    """How many poses the master has told so far, by its lines of every second."""
    return sum(map(int, re.findall(r"rate (\d+) poses/s", (out / "master.log").read_text())))


def test_killed_processes_of_a_fused_rig_are_back_and_ctrl_c_still_ends_and_sums_up(
    demo_of: Demo, tmp_path: Path
) -> None:
    """Cameras, wrist device and IMU of one hand: the master is killed first, then the device, then a camera."""
    demo = demo_of(tmp_path, 180.0, "--scene", "grasp")
    held_up = HeldUp(demo)
    received: list[str] = []
    killed_ns: dict[str, int] = {}
    pids: dict[str, int] = {}
    listening: set[Listener] = set()
    waiting = {"master": "listening on", "wrist": "ready, waiting", "right": "ready, waiting"}
    back, before, back_s = "", 0, 0.0  # who is back, how many poses were told before, and when it was

    def kill() -> None:
        victim = next(iter(waiting))
        killed_ns[victim] = time.monotonic_ns()
        os.kill(pids[victim], signal.SIGKILL)

    for line in _lines(demo):
        received.append(line)
        pids = pids or _pids(line)
        if _scene_s(line) >= 2 and not killed_ns and _count_poses(tmp_path) > ENOUGH:
            listening = listeners(demo.pid)
            kill()  # the master first: rows that it had not yet written are lost with it
        for victim, ready in list(waiting.items()):
            if f"{victim} ended with code -9: started again" in line:
                pids = _running(demo, pids, victim)
                log = tmp_path / f"{victim}.log"
                assert until(lambda log=log, ready=ready: log.read_text().count(ready) == 2)
                back, before, back_s = victim, _count_poses(tmp_path), time.monotonic()
        if back and _count_poses(tmp_path) > before + ENOUGH and time.monotonic() - back_s > 3.0:
            del waiting[back]
            back = ""
            if waiting:
                kill()
            else:
                demo.send_signal(signal.SIGINT)
    assert demo.wait(60) == 0, "\n".join(received)
    assert {"master run", "slave run"} <= {one.program for one in listening}
    assert undocumented(listening, rows()) == [], "what listens is in docs/security.md"
    assert all(one.here for one in listening), "a demo is nobody else's business"
    assert list(_pids(received[0])) == ["left", "right", "wrist", "imu", "master"]
    assert _gone(pids)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["restarts"] == dict.fromkeys(killed_ns, 1)
    assert summary["counts"]["wrist.received"] > 0
    assert summary["counts"]["imu.received"] > 50
    assert summary["counts"]["orientation.used"] > 10
    for key in ("joint_mm", "joint_mm_visible", "pip_deg", "marker_mm"):
        assert np.isfinite(summary[key]), key
    assert summary["laser_mm"] < 1.0
    assert summary["laser_right"] > 0.9
    assert "joint error, visible fingers" in "\n".join(received)
    for name in ("hand.png", "run.rrd", "poses.npz"):
        assert (tmp_path / name).stat().st_size > 0, name
    for name in pids:
        log_text = (tmp_path / f"{name}.log").read_text()
        assert "Traceback" not in log_text
        assert "FATAL" not in log_text
    poses = Poses.load(tmp_path / "poses.npz")
    assert poses.marker_count == 8
    assert (np.diff(poses.t_ns) > 0).all()
    assert (poses.t_ns > killed_ns["wrist"]).sum() > 5, "the hand is tracked by what is left"
    measured = np.isfinite(poses.markers_raw_m.min(axis=2)).sum(axis=1) > 0  # two cameras contributed again
    for victim in ("master", "right"):
        killed = killed_ns[victim]
        after = poses.t_ns[(poses.t_ns > killed + 300_000_000) & measured]
        assert len(after) > 0  # it goes on; how fast is up to the machine
        # Two seconds are the promise, and a loaded machine gets one more. What they waited for a core is not their own.
        first = int(after[0])
        assert (first - killed - held_up.between(killed, first)) * 1e-9 < 3.0


def _ready_again_ns(log: Path) -> int:
    """When a process that was started again was ready, on this machine's monotonic clock."""
    output = [line for line in log.read_text().splitlines() if "ready, waiting" in line]
    return int(float(output[1].split()[0]) * 1e9)


def test_two_pairs_track_together_and_one_goes_on_while_the_other_is_gone(
    demo_of: Demo, tmp_path: Path
) -> None:
    demo = demo_of(tmp_path, 180.0, "--rig", "desk4", "--scene", "poses")
    received: list[str] = []
    killed_ns = epoch_ns = before = 0
    ended = False
    pids: dict[str, int] = {}
    gone = ("left2", "right2")
    logs = [tmp_path / f"{name}.log" for name in gone]
    for line in _lines(demo):
        received.append(line)
        pids = pids or _pids(line)
        if _scene_s(line) >= 3 and not killed_ns and _count_poses(tmp_path) > ENOUGH:
            epoch_ns = _epoch_ns(pids["left"])
            killed_ns, before = time.monotonic_ns(), _count_poses(tmp_path)
            for name in gone:
                os.kill(pids[name], signal.SIGKILL)
        back = killed_ns and all(log.read_text().count("ready, waiting") == 2 for log in logs)
        if back and not ended and _count_poses(tmp_path) > before + ENOUGH:
            ended = True
            demo.send_signal(signal.SIGINT)
    assert demo.wait(90) == 0, "\n".join(received)
    assert killed_ns, "\n".join(received)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["restarts"] == {"left2": 1, "right2": 1}
    # From the stamps, so it does not matter how many frames a busy machine had no time for.
    rates = {"left": 60.0, "right": 60.0, "left2": 30.0, "right2": 30.0}
    assert summary["camera_hz"] == pytest.approx(rates, rel=2e-3)
    assert summary["marker_raw_mm"] < 4.0
    if summary["poses_per_s"] > LEAST_HZ:
        assert summary["marker_mm"] < 4.0
    poses = Poses.load(tmp_path / "poses.npz")
    assert not _lost_while_seen(poses).any()
    # How long a pair is gone, and fingers unseen, depends on how busy the machine is: all joints only until then.
    together = poses.rows(0, int(np.searchsorted(poses.t_ns, killed_ns)))
    assert together.valid[-1].all()
    if len(together) > 60:  # of fewer, drawn by a busy machine, nothing can be said
        settled = together.rows(len(together) // 4, len(together))
        drawn = len(settled) > 40.0 * 1e-9 * (settled.t_ns[-1] - settled.t_ns[0])
        assert _joint_mm(settled, "poses", "desk4", epoch_ns) < (4.0 if drawn else 8.0)
    # Until one is back, whatever is measured is measured by the other pair.
    alone = (poses.t_ns > killed_ns) & (poses.t_ns < min(_ready_again_ns(log) for log in logs))
    measured = np.isfinite(poses.markers_raw_m.min(axis=2)).sum(axis=1) > 0
    assert (alone & measured).any()
    assert poses.valid[alone & measured].all()
    assert poses.valid[-1].all()
    assert _gone(pids)


def test_a_second_ctrl_c_ends_at_once_and_leaves_nobody_behind(demo_of: Demo, tmp_path: Path) -> None:
    demo = demo_of(tmp_path, 60.0)
    received: list[str] = []
    for line in _lines(demo):
        received.append(line)
        if _scene_s(line) >= 1:
            break
    pids = _pids(received[0])
    demo.send_signal(signal.SIGINT)
    # It was heard, and everybody is being ended: two at the same moment would be one.
    assert until(lambda: (tmp_path / "live.json").exists() or not Path(f"/proc/{pids['master']}").exists())
    demo.send_signal(signal.SIGINT)
    received += _lines(demo)
    assert demo.wait(60) == 130, "\n".join(received)
    assert _gone(pids)
