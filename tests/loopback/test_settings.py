"""Real processes: a slave and a master run; the camera is set otherwise by command and by its file. Nobody restarts."""

import subprocess
import sys
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from shutil import copytree

import msgspec
import pytest

from common.bus.keys import new_key
from common.calibration import CameraCalibration, load, save
from common.errors import BusError
from tests.cli import Ended, invoke
from tests.network_helpers import PATIENCE_S, free_endpoint, free_udp_port, until

ROOT = Path(__file__).resolve().parents[2]
PYTHON = sys.executable


class Rig:
    """One slave with a simulated camera, the master, and somebody on the bus, on files of their own."""

    def __init__(self, folder: Path, running: list[subprocess.Popen[str]]) -> None:
        self.files = folder / "calib"
        copytree(ROOT / "calib_json", self.files)
        self.left = self.files / "cameras/left.json"
        key = folder / "rig.key"
        key.write_text(new_key())
        key.chmod(0o600)
        beacon, self.endpoint = free_udp_port(), free_endpoint()
        shared = ["--rig", "desk", "--calibration", str(self.files), "--key-file", str(key)]
        master = ["master", "run", *shared, "--beacon", f"127.255.255.255:{beacon}", "--bind", "127.0.0.1:0"]
        slave = ["slave", "run", *shared, "--name", "left", "--camera", "synthetic", "--bind", "127.0.0.1"]
        self.logs: dict[str, Path] = {}
        for command in (
            [*master, "--bus", self.endpoint, "--start-timeout-s", "0.1"],
            [*slave, "--beacon-port", str(beacon)],
        ):
            self.logs[command[0]] = folder / f"{command[0]}.log"
            with self.logs[command[0]].open("w") as log:
                running.append(
                    subprocess.Popen(
                        [PYTHON, "-m", *command], cwd=ROOT, stdout=log, stderr=subprocess.STDOUT, text=True
                    )
                )

    def output(self, process: str, text: str) -> bool:
        """Whether the process has said it, after some patience."""
        return until(lambda: text in self.logs[process].read_text())

    def shown(self, *options: str) -> dict[str, tuple[str, ...]]:
        """Setting -> wanted and read back, of a command that must succeed."""
        done = self.camera(*options)
        assert done.exit_code == 0, done.output
        return {line.split()[0]: tuple(line.split()[1:]) for line in done.output.splitlines()}

    def camera(self, *options: str) -> Ended:
        """`phalanx camera …`; once more where a busy master did not answer at once.

        Raises:
            BusError: What it refuses.
        """
        ended: list[Ended] = []

        def answered() -> bool:
            try:
                ended.append(invoke("camera", *options, "--bus", self.endpoint))
            except BusError as error:
                if "cannot open the bus" not in str(error):
                    raise
            return bool(ended)

        assert until(answered), "the bus cannot be opened"
        return ended[-1]


@contextmanager
def rig(folder: Path) -> Generator[Rig, None, None]:
    running: list[subprocess.Popen[str]] = []
    made = Rig(folder, running)
    try:
        yield made
    finally:
        for process in running:
            process.terminate()
        for process in running:
            process.wait(PATIENCE_S)


def test_a_camera_is_set_by_command_and_by_file_while_everything_runs(tmp_path: Path) -> None:
    with rig(tmp_path) as desk:
        assert desk.output("master", "started")
        assert desk.output("slave", "exposure_us 5000"), "frames come"
        assert desk.shown("left")["exposure_us"] == ("5000", "5000")
        shown = desk.shown("left", "--exposure-us", "4000", "--colour-gains", "0.9,1.3", "--save")
        assert (shown["exposure_us"], shown["red_gain"]) == (("4000", "4000"), ("0.9", "0.9"))
        saved = load(desk.left, CameraCalibration)
        assert (saved.exposure_us, saved.colour_gains) == (4000.0, (0.9, 1.3))

        save(desk.left, msgspec.structs.replace(saved, exposure_us=6000.0))
        assert desk.output("slave", "changed, in use now")
        assert desk.shown("left")["exposure_us"] == ("6000", "6000")
        assert desk.output("master", "changed files are in use"), "it reads the camera files, too"
        desk.left.write_text("{")
        assert desk.output("slave", "changed, but not used")
        assert desk.output("master", "changed files are not used")

        with pytest.raises(
            BusError, match="'left' refused 'set': exposure_us: wanted 90000, a frame at 60 Hz"
        ):
            desk.camera("left", "--exposure-us", "90000")
        assert desk.shown("left")["exposure_us"] == ("6000", "6000")
        with pytest.raises(BusError, match="no camera 'cellar' is on the bus; there are: left"):
            desk.camera("cellar")
    for log in desk.logs.values():
        assert "Traceback" not in log.read_text()
