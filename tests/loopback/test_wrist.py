"""A wrist device in real processes: its slave over sealed UDP and zenoh."""

import os
import subprocess
import sys
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from shutil import copytree

import cv2
import msgspec
import numpy as np

from common.bus.bus import Bus
from common.bus.keys import new_key
from common.bus.zenoh_bus import ZenohBus
from common.calibration import RigCalibration, load, save
from common.clock import SystemClock
from common.messages import Command, Health, Preview, WristDetections
from master.run.ingest import Ingest
from tests.network_helpers import PATIENCE_S, free_endpoint, free_udp_port, until

ROOT = Path(__file__).resolve().parents[2]


class Device:
    """The slave of a simulated wrist device as a process, and a master's ends of its link and bus."""

    def __init__(self, files: Path, ingest: Ingest, bus: Bus, log: Path) -> None:
        self.files, self.ingest, self.bus, self.log = files, ingest, bus, log

    def cycles(self, count: int) -> list[WristDetections]:
        """The next so many."""
        found: list[WristDetections] = []
        assert until(lambda: len(found) >= count or self._take(found)), self.log.read_text()
        return found

    def _take(self, found: list[WristDetections]) -> bool:
        message = self.ingest.get(0.1)
        if message is not None:
            assert isinstance(message, WristDetections)
            found.append(message)
        return False

    def ask(self, verb: str, body: str = "") -> Health:
        return self.bus.ask(Command("wrist", verb, body), PATIENCE_S)

    def picture(self) -> Preview:
        """One of the pictures that it shows for some seconds after it was asked for them."""
        pictures = self.bus.subscribe("preview")
        found: list[Preview] = []

        def comes() -> bool:
            self.ask("preview")
            if isinstance(message := pictures.get(2.0), Preview):
                found.append(message)
            return bool(found)

        assert until(comes), self.log.read_text()
        return found[0]


@contextmanager
def device(folder: Path) -> Generator[Device, None, None]:
    files = folder / "calib"
    copytree(ROOT / "calib_json", files)
    key, port, endpoint = new_key(), free_udp_port(), free_endpoint()
    command = [sys.executable, "-m", "slave", "run", "--name", "wrist", "--rig", "wrist", "--scene", "curl"]
    command += ["--calibration", str(files), "--camera", "synthetic", "--bind", "127.0.0.1"]
    clock, log = SystemClock(), folder / "slave.log"
    bus = ZenohBus(endpoint, None)
    beacon = ("127.255.255.255", port)
    ingest = Ingest(
        ("wrist",), bytes.fromhex(key), clock, beacon, ("127.0.0.1", 0), endpoint, wrists=("wrist",)
    )
    with log.open("w") as out:
        process = subprocess.Popen(
            [*command, "--beacon-port", str(port)],
            cwd=ROOT,
            env=os.environ | {"PHALANX_RIG_KEY": key},
            stdout=out,
            stderr=subprocess.STDOUT,
        )
    try:
        yield Device(files, ingest, bus, log)
    finally:
        process.terminate()
        code = process.wait(PATIENCE_S)
        ingest.close()
        bus.close()
    assert code == 0, log.read_text()
    assert "Traceback" not in log.read_text()


def test_a_slave_sends_cycles_reports_them_and_follows_its_files(tmp_path: Path) -> None:
    with device(tmp_path) as wrist:
        sent = wrist.cycles(5)
        assert all(message.seq % 3 == 1 for message in sent)
        assert (np.diff([message.seq for message in sent]) > 0).all()
        assert (
            np.isfinite([message.laser_uv for message in sent]).all(axis=2).mean() > 0.5
        )  # at any time of a curl
        assert all(message.t_ns < message.ready_t_ns for message in sent)

        assert until(lambda: "wrist" in wrist.bus.alive())
        assert until(
            lambda: wrist.ask("report").counts["frames"] >= 15
        )  # counted a moment after they are sent
        counts, later = wrist.ask("report").counts, wrist.ask("report").counts
        assert counts["strobe.cycles"] >= 5
        assert later["frames"] + 1 >= 3 * counts["strobe.cycles"]  # a triple is counted before its last frame
        assert sum(count for name, count in counts.items() if name.startswith("seen.laser.")) >= 12
        assert {f"seen.tip.{finger}" for finger in ("thumb", "little")} <= counts.keys()

        picture = wrist.picture()
        shown = cv2.imdecode(np.frombuffer(picture.jpeg, np.uint8), cv2.IMREAD_UNCHANGED)
        assert shown is not None
        assert shown.shape == (200, 320)
        assert shown[60:180, 80:240].mean() > 30.0  # by the LEDs

        assert wrist.ask("set", '{"exposure_us": 1500}').metrics["exposure_us"] == 1500.0
        path = wrist.files / "rigs/wrist.json"
        rig = load(path, RigCalibration)
        assert rig.T_camera_palm is not None
        palm = np.array(rig.T_camera_palm)
        palm[0, 3] += 0.002
        moved = tuple(tuple(row) for row in palm.tolist())
        save(path, msgspec.structs.replace(rig, T_camera_palm=moved))
        assert until(lambda: wrist.ask("report").counts["reload.applied"] == 1)
        save(path, msgspec.structs.replace(rig, laser_plane=None))
        assert until(lambda: wrist.ask("report").counts["reload.refused"] == 1)
        assert until(lambda: "laser_plane" in wrist.log.read_text())  # counted, then said
        while wrist.ingest.get(0.0) is not None:
            pass
        wrist.cycles(2)  # it goes on
