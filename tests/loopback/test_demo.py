"""The main job as its user starts it: two slaves, real UDP, one master, killed and restarted on the way."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from common.arrays import Bool
from common.sim.scenes import scene_by_name
from master.outputs.files import load_poses
from master.outputs.poses import Poses
from master.rig import load_setup

ROOT = Path(__file__).resolve().parents[2]


def _demo(out: Path, seconds: float, *more: str) -> subprocess.Popen[str]:
    command = [
        sys.executable,
        "-m",
        "deploy",
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


def test_demo_tracks_scores_and_leaves_its_results(tmp_path: Path) -> None:
    demo = _demo(tmp_path, 6.0)
    lines = list(_lines(demo))
    assert demo.wait(60) == 0, "\n".join(lines)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary == json.loads((tmp_path / "copy.json").read_text())
    # No bar of speed here: machines that run tests are busy. Markers are right at any rate; a hand of 1 m/s that
    # is drawn ten times a second leaps by its own size between two frames, and its joints are only near then.
    assert summary["poses"] > 60
    drawn = summary["poses_per_s"] > 30.0
    assert summary["joint_mm_visible"] < (6.0 if drawn else 20.0)
    assert summary["pip_deg_visible"] < (7.5 if drawn else 15.0)
    assert summary["marker_mm"] < 4.0
    for key in ("latency_p50_ms", "latency_p99_ms", "lost", "joint_mm", "pip_deg", "poses_per_s"):
        assert np.isfinite(summary[key]), key
    assert summary["camera_hz"] == pytest.approx({"left": 60.0, "right": 60.0}, rel=2e-3)
    assert set(summary["received_hz"]) == {"left", "right"}
    assert set(summary["stage_us"]) == {"pairing", "triangulate", "filter", "hand", "gestures"}
    for name in ("hand.png", "run.rrd", "poses.npz", "left.log", "right.log", "master.log"):
        assert (tmp_path / name).stat().st_size > 0, name
    poses = load_poses(tmp_path / "poses.npz")
    assert (np.diff(poses.t_ns) > 0).all()
    assert poses.valid[len(poses) // 2 :].all()
    assert _gone(_pids(lines[0]))


def _new_child(demo: subprocess.Popen[str], old: dict[str, int]) -> int:
    """The process that was started since the first ones."""
    children = Path(f"/proc/{demo.pid}/task/{demo.pid}/children").read_text().split()
    (new,) = {int(pid) for pid in children} - set(old.values())
    return new


def _held_up_ns(pid: int) -> int:
    """How long [ns] a process could have run and another one had the core."""
    return int(Path(f"/proc/{pid}/schedstat").read_text().split()[1])


def _wait_until_back(demo: subprocess.Popen[str], log: Path, ready: str, pid: int) -> int:
    """Until a process that was started again says so; how long [ns] it could have run and another had the core."""
    held_up_ns = 0
    while log.read_text().count(ready) < 2 and demo.poll() is None:
        held_up_ns = _held_up_ns(pid)
        time.sleep(0.02)
    return held_up_ns


def test_a_killed_process_is_back_within_two_seconds_and_ctrl_c_still_ends_and_sums_up(
    tmp_path: Path,
) -> None:
    demo = _demo(tmp_path, 60.0)
    heard: list[str] = []
    killed_ns: dict[str, int] = {}
    held_up_ns: dict[str, int] = {}
    pids: dict[str, int] = {}

    def kill(victim: str) -> None:
        killed_ns[victim] = time.monotonic_ns()
        os.kill(pids[victim], signal.SIGKILL)

    for line in _lines(demo):
        heard.append(line)
        pids = pids or _pids(line)
        if "2 of 60 s" in line and not killed_ns:
            kill("master")  # first: rows that it had not yet written are lost with it
        for victim, ready in (("right", "right: ready"), ("master", "listening on")):
            if f"{victim} ended with code -9: started again" in line:
                new = _new_child(demo, pids)
                held_up_ns[victim] = _wait_until_back(demo, tmp_path / f"{victim}.log", ready, new)
                pids[victim] = new
                time.sleep(3.0)
                if victim == "master":
                    kill("right")
                else:
                    demo.send_signal(signal.SIGINT)
    assert demo.wait(60) == 0, "\n".join(heard)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["restarts"] == {"right": 1, "master": 1}
    assert summary["poses"] > 10
    assert _gone(pids)
    for name in ("left", "right", "master"):
        log = (tmp_path / f"{name}.log").read_text()
        assert "Traceback" not in log
        assert "FATAL" not in log
    poses = load_poses(tmp_path / "poses.npz")
    measured = np.isfinite(poses.markers_raw_m.min(axis=2)).sum(axis=1) > 0  # two cameras contributed again
    after = {
        victim: poses.t_ns[(poses.t_ns > killed + 300_000_000) & measured]
        for victim, killed in killed_ns.items()
    }
    for victim, killed in killed_ns.items():
        assert len(after[victim]) > 5  # it goes on; how fast is up to the machine
        # Two seconds are the promise, and a loaded machine gets one more. What it waited for a core is not its own.
        assert (after[victim][0] - killed - held_up_ns[victim]) * 1e-9 < 3.0


def test_two_pairs_track_together_and_one_goes_on_while_the_other_is_gone(tmp_path: Path) -> None:
    demo = _demo(tmp_path, 8.0, "--rig", "desk4", "--scene", "poses")
    heard: list[str] = []
    killed_ns = epoch_ns = tracking = 0
    pids: dict[str, int] = {}
    for line in _lines(demo):
        heard.append(line)
        pids = pids or _pids(line)
        if rate := re.search(r" of 8 s +(\d+) poses/s", line):
            tracking += (
                int(rate[1]) >= 5
            )  # for so many seconds; four renderers on a busy machine draw few frames
        if tracking >= 3 and not killed_ns:
            epoch_ns = _epoch_ns(pids["left"])
            killed_ns = time.monotonic_ns()
            for name in ("left2", "right2"):
                os.kill(pids[name], signal.SIGKILL)
    assert demo.wait(90) == 0, "\n".join(heard)
    assert killed_ns, "\n".join(heard)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["restarts"] == {"left2": 1, "right2": 1}
    # From the stamps, so it does not matter how many frames a busy machine had no time for.
    rates = {"left": 60.0, "right": 60.0, "left2": 30.0, "right2": 30.0}
    assert summary["camera_hz"] == pytest.approx(rates, rel=2e-3)
    assert summary["marker_mm"] < 4.0
    poses = load_poses(tmp_path / "poses.npz")
    assert not _lost_while_seen(poses).any()
    # How long a pair is gone, and fingers unseen, depends on how busy the machine is: all joints only until then.
    together = poses.rows(0, int(np.searchsorted(poses.t_ns, killed_ns)))
    assert together.valid[-1].all()
    if len(together) > 60:  # of fewer, drawn by a busy machine, nothing can be said
        assert _joint_mm(together.rows(len(together) // 4, len(together)), "poses", "desk4", epoch_ns) < 4.0
    # A process needs longer than this to be back: whatever is measured is measured by the other pair.
    alone = (poses.t_ns > killed_ns) & (poses.t_ns < killed_ns + 500_000_000)
    measured = np.isfinite(poses.markers_raw_m.min(axis=2)).sum(axis=1) > 0
    assert (alone & measured).any()
    assert poses.valid[alone & measured].all()
    assert poses.valid[-1].all()
    assert _gone(pids)


def test_a_second_ctrl_c_ends_at_once_and_leaves_nobody_behind(tmp_path: Path) -> None:
    demo = _demo(tmp_path, 60.0)
    heard: list[str] = []
    for line in _lines(demo):
        heard.append(line)
        if "1 of 60 s" in line:
            demo.send_signal(signal.SIGINT)
            time.sleep(0.1)
            demo.send_signal(signal.SIGINT)
    assert demo.wait(10) == 130, "\n".join(heard)
    assert _gone(_pids(heard[0]))
