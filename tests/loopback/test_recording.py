"""A recorded live run, as its user starts it: what is played again is what was told, bit for bit."""

import json
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import cast

from common.bus.keys import new_key
from common.messages import ResultMessage
from common.recording.messages import open_messages
from master.recording.files import recorded_setups
from master.recording.player import Player, ResultDigest
from tests.network_helpers import PATIENCE_S, free_endpoint, free_udp_port, until

ROOT = Path(__file__).resolve().parents[2]
POSES = 60


def count_poses(text: str) -> int:
    return sum(int(number) for number in re.findall(r"rate (\d+) poses/s", text))


def recorded_run(folder: Path, file: Path) -> str:
    """Two simulated cameras and a master that records; what the master said."""
    key = folder / "rig.key"
    key.write_text(new_key())
    key.chmod(0o600)
    beacon, epoch_ns = str(free_udp_port()), str(time.monotonic_ns() + 5_000_000_000)
    shared = ["--rig", "desk", "--calibration", str(ROOT / "calib_json"), "--key-file", str(key)]
    master = ["master", "run", *shared, "--beacon", f"127.255.255.255:{beacon}", "--bind", "127.0.0.1:0"]
    slave = ["slave", "run", *shared, "--camera", "synthetic", "--bind", "127.0.0.1", "--beacon-port", beacon]
    log = folder / "master.log"
    running: list[subprocess.Popen[bytes]] = []
    with log.open("wb") as out:
        try:
            for command in (
                [
                    *master,
                    "--bus",
                    free_endpoint(),
                    "--record",
                    str(file),
                    "--summary",
                    str(folder / "live.json"),
                ],
                [*slave, "--name", "left", "--scene-epoch-ns", epoch_ns],
                [*slave, "--name", "right", "--scene-epoch-ns", epoch_ns, "--scan", "windows"],
            ):
                python = [sys.executable, "-m", *command]
                running.append(subprocess.Popen(python, cwd=ROOT, stdout=out, stderr=subprocess.STDOUT))
            assert until(lambda: "tracking" in log.read_text(), 150.0), log.read_text()
            # As many poses as 6 s have on a slow machine: how long that takes is its own affair.
            assert until(lambda: count_poses(log.read_text()) >= POSES, 90.0), log.read_text()
            running[0].send_signal(signal.SIGINT)
            assert running[0].wait(PATIENCE_S) == 0, log.read_text()
        finally:
            for process in running:
                process.terminate()
            for process in running:
                process.wait(PATIENCE_S)
    return log.read_text()


def test_a_replay_equals_what_was_published_live(tmp_path: Path) -> None:
    file = tmp_path / "wave.mcap"
    output = recorded_run(tmp_path, file)
    assert "recorder: recorded" in output
    recording = open_messages(file)
    assert not recording.cut
    poses = json.loads((tmp_path / "live.json").read_text())["poses"]
    assert recording.counts["hand"] == poses >= POSES, "nothing that was told is missing"
    live = ResultDigest(cast(ResultMessage, one.message) for one in recording.read(["hand", "gesture"]))
    played = Player(recording, recorded_setups(recording), []).run()
    assert played.whole
    assert played.digest.counts == live.counts
    assert played.digest.hex() == live.hex()
    assert played.digest.hex("gestures") == live.hex("gestures")
