"""Command lines of the processes that the set-up starts or asks to be started.

They are cameras, masters and calibrations.
"""

import os
import shlex
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from common.bus.keys import ENVIRONMENT, RIG_KEY, keys_folder, rig_key
from common.calibration import RigCalibration, load
from common.errors import CalibrationError
from master.cli.table import CALIBRATIONS
from master.commands.keys_folder import AUTHORITY_KEY, files_of_device, make
from master.console.setup.fields import Value, arguments_of, fields_of
from master.console.setup.files import KEY_FILE, CameraPlan, Plan, key_of
from master.console.state import ConsoleSettings

# What simulated cameras can look at: scene -> text. "still" is the hand before its motion begins.
VIEWS = {
    "board": "a calibration board",
    "card": "a painted card at known distances, for the depth of a pair",
    "still": "a hand held still",
    "standard": "a hand that moves",
    "lights": "a hand under light that changes",
    "hand-routine": "the routine that measures a hand",
    "object": "a hand and an object",
}
_CLOCK = "--scene-epoch-ns"


@dataclass(frozen=True, slots=True)
class Commands:
    """Command lines for one console and one plan."""

    settings: ConsoleSettings
    plan: Plan

    @property
    def tree(self) -> Path:
        """The calib_json tree as processes are given it."""
        return self.settings.calibration.resolve()

    def environment(self) -> dict[str, str]:
        """Return the environment variables of the processes, with the rig key.

        The rig key may not stand on a command line. Where the key is a keys folder's, the processes inherit where
        that folder is, and each camera has a certificate and a secret in it from here on.

        Raises:
            PhalanxError: There is no key.
        """
        if (keys := keys_folder(os.environ)) is not None and (keys / AUTHORITY_KEY).exists():
            make(keys, [camera.name for camera in self.plan.cameras], datetime.now(UTC))
        key = key_of(self.settings.calibration, self.settings.key)
        if keys is not None and (keys / RIG_KEY).exists() and key == rig_key({}, None, keys).hex():
            return {}
        return {ENVIRONMENT: key}

    def camera(self, camera: CameraPlan, view: str, epoch_ns: int) -> list[str]:
        """The slave of a camera of this machine.

        Args:
            camera: Simulated, or USB.
            view: What simulated cameras look at, a key of `VIEWS` or any scene.
            epoch_ns: When that begins, the same for all, `epoch_of(view)`.
        """
        line = [
            sys.executable,
            "-m",
            "slave",
            "run",
            *self._place(camera),
            *self._driver(camera, view, epoch_ns),
        ]
        here = self.settings.beacon.startswith("127.")
        return [*line, "--beacon-port", self._port, "--bind", "127.0.0.1" if here else "0.0.0.0"]

    def record(self, camera: CameraPlan, view: str, epoch_ns: int, seconds: float, out: Path) -> list[str]:
        """Raw frames of a camera of this machine to a folder."""
        line = [sys.executable, "-m", "slave", "record", *self._place(camera)]
        return [*line, *self._driver(camera, view, epoch_ns), "--seconds", f"{seconds:g}", "-o", str(out)]

    def pi(self, camera: CameraPlan) -> tuple[str, str]:
        """Return the two commands for a camera on a Pi.

        A person runs one here, to bring the files to the Pi, and one there, to start its slave.
        """
        host = camera.device or f"{camera.name}.local"
        there = "calib_json"
        copy = f"rsync -a {shlex.quote(f'{self.tree}/')} {shlex.quote(host)}:{there}/"
        secrets = ["--key-file", f"{there}/{KEY_FILE}"]
        if (keys := keys_folder(os.environ)) is not None:
            own = [f"{keys}/./{file}" for file in files_of_device(camera.name)]
            copy += f" && rsync -aR {shlex.join(own)} {shlex.quote(host)}:keys/"
            secrets = ["--keys", "keys"]
        slave = [
            "phalanx-slave",
            "run",
            "--name",
            camera.name,
            "--rig",
            self.plan.rig,
            "--camera",
            "picamera2",
        ]
        slave += ["--calibration", there, "--beacon-port", self._port, *secrets]
        return copy, shlex.join([*slave, *shlex.split(camera.options)])

    def meet(self) -> list[str]:
        """A master that tracks nothing."""
        return [sys.executable, "-m", "master.console.setup.meet", *self._link()]

    def run(self) -> list[str]:
        """The master that tracks."""
        return [sys.executable, "-m", "master", "run", *self._link()]

    def calibrate(self, command: str, values: Mapping[str, Value], work: Path, *, live: bool) -> list[str]:
        """Return the command line of a calibration that writes below `work`.

        It uses the form's `values` and what the page knows.

        Raises:
            CalibrationError: A field is empty that is needed, or a number is none.
        """
        fields = fields_of(CALIBRATIONS[command])
        names = {field.name for field in fields}
        known: dict[str, Value] = {
            "calibration": str(work / "tree" if command == "cube" else self.tree),
            "rig": self.plan.rig,
            "beacon": self.settings.beacon,
            "bind": self.settings.bind,
            "bus": self.settings.bus,
            "json_file": str(work / "result.json"),
            "picture": str(work / "result.png"),
            "live": live,
            "out": str(out_of(command, work)),
        }
        if command == "verify" and not values.get("source"):
            del known["picture"]  # what is to be expected is a table
        merged = {**values, **{name: value for name, value in known.items() if name in names}}
        return [
            sys.executable,
            "-m",
            "master",
            *CALIBRATIONS[command].name.split(),
            *arguments_of(fields, merged),
        ]

    def _place(self, camera: CameraPlan) -> list[str]:
        return ["--name", camera.name, "--rig", self.plan.rig, "--calibration", str(self.tree)]

    def _driver(self, camera: CameraPlan, view: str, epoch_ns: int) -> list[str]:
        if camera.kind != "simulated":
            device = f":{camera.device}" if camera.device else ""
            return ["--camera", f"v4l2{device}", *shlex.split(camera.options)]
        index = [one.name for one in self.plan.cameras].index(camera.name)
        apart_ms = 5.0  # cameras that nobody synchronises are taken one after the other
        late_ms = (time.monotonic_ns() - epoch_ns) * 1e-6 + apart_ms * index
        world = ["--truth", str(Path(self.plan.truth).resolve()), "--truth-rig", self.plan.world]
        scene = ["--scene", "standard" if view == "still" else view, _CLOCK, str(epoch_ns)]
        return ["--camera", "synthetic", *world, *scene, "--start-offset-ms", f"{late_ms:.3f}"]

    def _link(self) -> list[str]:
        place = ["--rig", self.plan.rig, "--calibration", str(self.tree)]
        ends = ["--beacon", self.settings.beacon, "--bind", self.settings.bind, "--bus", self.settings.bus]
        return [*place, *ends]

    @property
    def _port(self) -> str:
        return self.settings.beacon.rpartition(":")[2]


def epoch_of(view: str) -> int:
    """Return when the scene of a view begins, on this machine's monotonic clock [ns].

    A hand that is held still never begins.
    """
    never_s = 36_000.0  # a hand that begins to move so much later is held still
    soon_s = 3.0  # until slaves have joined
    later_s = never_s if view == "still" else soon_s
    return time.monotonic_ns() + round(1e9 * later_s)


def out_of(command: str, work: Path) -> Path:
    """Return where a command writes its output.

    The output is a page to print, pictures, or a tree of calibration files.
    """
    return {
        "board": work / "board.pdf",
        "cube": work / "box.pdf",
        "capture": work / "views",
    }.get(command, work / "tree")


def world_of_project() -> Path:
    """Return the calib_json tree used as the simulated world.

    It is the one that comes with the source, or that of the working directory.

    Raises:
        CalibrationError: Neither is there.
    """
    for tree in (Path(__file__).resolve().parents[3] / "calib_json", Path("calib_json")):
        path = tree / "rigs" / "desk.json"
        if path.exists():
            load(path, RigCalibration)
            here = Path.cwd()
            return tree.relative_to(here) if tree.is_relative_to(here) else tree
    raise CalibrationError(
        "no simulated world: the project's own calib_json is neither beside the source nor in the working folder;"
        " give the folder of a complete calib_json tree"
    )
