"""Pictures for a calibration as a user takes them: real slaves without colours, the bus, a folder at the end."""

import os
import subprocess
import sys
from pathlib import Path

import cv2

from common.bus.keys import new_key
from master.calibrate.cameras.boards import Checkerboard
from master.calibrate.cameras.views import image_sets, look
from tests.network_helpers import PATIENCE_S, free_endpoint, free_udp_port

ROOT = Path(__file__).resolve().parents[2]


def test_slaves_without_colours_give_the_pictures_for_a_calibration(tmp_path: Path) -> None:
    env = os.environ | {"PHALANX_RIG_KEY": new_key()}
    beacon = free_udp_port()
    slave = [sys.executable, "-m", "slave", "run", "--camera", "synthetic", "--scene", "board"]
    slave += ["--colours", "none", "--bind", "127.0.0.1", "--beacon-port", str(beacon)]
    slaves = [
        subprocess.Popen([*slave, "--name", name], cwd=ROOT, env=env, stdout=subprocess.DEVNULL)
        for name in ("left", "right")
    ]
    master = [
        sys.executable,
        "-m",
        "master",
        "calibrate",
        "cameras",
        "capture",
        "--views",
        "5",
        "--out",
        str(tmp_path / "v"),
    ]
    master += ["--beacon", f"127.255.255.255:{beacon}", "--bind", "127.0.0.1:0", "--bus", free_endpoint()]
    try:
        done = subprocess.run(
            master, cwd=ROOT, env=env, capture_output=True, text=True, timeout=300, check=False
        )
    finally:
        for process in slaves:
            process.terminate()
        codes = [process.wait(PATIENCE_S) for process in slaves]
    assert done.returncode == 0, done.stdout + done.stderr
    assert codes == [0, 0]
    assert "view 5 of 5" in done.stdout
    views = look(Checkerboard(9, 6, 0.025), image_sets(tmp_path / "v", ("left", "right")))
    assert len(views.views) == 5
    assert views.sizes_px == {"left": (640, 480), "right": (640, 480)}
    picture = cv2.imread(str(tmp_path / "v" / "left" / "001.jpg"))
    assert picture is not None
    assert picture.std() > 20.0
