"""Set-up builds command lines, and forms from their options.

Form fields of a calibration are read from the command's own options: page and command line cannot differ. The
command lines are those of cameras, masters and calibrations that the page starts, or asks a person to start.
"""

import os
import shlex
import sys
import time
from argparse import SUPPRESS, Action, ArgumentParser
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal, cast

from common.bus.keys import ENVIRONMENT, RIG_KEY, keys_folder, rig_key
from common.command_line import Command, Number
from common.errors import CalibrationError
from master.cli.table import CALIBRATIONS
from master.commands.keys import AUTHORITY_KEY, files_of_device, make
from master.console.setup.files import KEY_FILE, CameraPlan, Plan, key_of
from master.console.state import ConsoleSettings

Shape = Literal["text", "number", "whole", "flag", "choice", "list"]
Value = str | float | bool | None
_UNITS = {"_m_s": "m/s", "_mm": "mm", "_px": "px", "_ms": "ms", "_deg": "°"}
_MODULE = [sys.executable, "-m"]


@dataclass(frozen=True, slots=True)
class Field:
    """One option or argument of a command, as an entry of a form.

    Attributes:
        name: Its name among the options that are read.
        flag: On the command line, such as --square-mm; empty for an argument.
        shape: How it is entered.
        default: What it is if nothing is entered; None: left out.
        low, high: Bounds of a number.
    """

    name: str
    flag: str
    help: str
    shape: Shape
    default: Value
    required: bool
    choices: tuple[str, ...] = ()
    low: float | None = None
    high: float | None = None

    @property
    def label(self) -> str:
        """Its name for a person: `square_mm` is "Square (mm)"."""
        for end, unit in _UNITS.items():
            if self.name.endswith(end):
                return f"{self.name.removesuffix(end).replace('_', ' ').capitalize()} ({unit})"
        return self.name.replace("_", " ").capitalize()


def fields_of(command: Command) -> tuple[Field, ...]:
    """All options and arguments of one command, arguments first, each as a field."""
    declared = _Declared()
    command.declare(declared)
    found = [_field(action) for action in declared.actions if action.default is not SUPPRESS]
    return tuple(sorted(found, key=lambda field: field.flag != ""))


def arguments_of(fields: tuple[Field, ...], values: Mapping[str, Value]) -> list[str]:
    """Return the command line for `values` by field name, without defaults.

    Raises:
        CalibrationError: A required field is empty, or a number is none or out of range.
    """
    line: list[str] = []
    for field in fields:
        value = values.get(field.name, field.default)
        text = _text(field, value)
        if text is None:
            if field.required:
                raise CalibrationError(f"{field.label}: is needed: {field.help}")
            continue
        if field.shape == "flag":
            line += [field.flag] if value and value != field.default else []
        elif field.shape == "list":
            for part in text.replace(",", " ").split():
                line += [field.flag, part]
        elif not field.flag:
            line.append(text)
        elif field.required or value != field.default:
            line += [field.flag, text]
    return line


def _text(field: Field, value: Value) -> str | None:
    """The value as it stands on a command line; None: it is left out."""
    if value is None or value == "":
        return None
    if field.shape not in ("number", "whole"):
        return str(value).strip() or None
    try:
        number = float(value)
    except ValueError as error:
        raise CalibrationError(f"{field.label}: {value!r} is no number") from error
    if (field.low is not None and number < field.low) or (field.high is not None and number > field.high):
        raise CalibrationError(f"{field.label}: {number:g} is not in {field.low:g} to {field.high or 1e9:g}")
    if field.shape == "whole" and number != round(number):
        raise CalibrationError(f"{field.label}: {number:g} is no whole number")
    return f"{round(number)}" if field.shape == "whole" else f"{number:.12g}"


class _Declared(ArgumentParser):
    def __init__(self) -> None:
        self.actions: list[Action] = []
        super().__init__(add_help=False)

    def add_argument(self, *names: Any, **how: Any) -> Action:
        """Declare an option or an argument."""
        action = super().add_argument(*names, **how)
        self.actions.append(action)
        return action


def _field(action: Action) -> Field:
    flag = next((one for one in action.option_strings if one.startswith("--")), "")
    default = cast(object, action.default)
    shown = default if default is None or isinstance(default, (bool, int, float, str)) else str(default)
    text = (action.help or "") % {"default": default}
    shape: Shape = "text"
    low = high = None
    if action.nargs == 0:
        shape = "flag"
    elif action.choices is not None:
        shape = "choice"
    elif isinstance(default, list):
        shape, shown = "list", None
    elif isinstance(action.type, Number):
        shape, low, high = ("whole" if action.type.whole else "number"), action.type.low, action.type.high
    choices = tuple(str(one) for one in action.choices or ())
    shown = None if action.required else shown
    return Field(action.dest, flag, text, shape, shown, action.required, choices, low, high)


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

# Where a command writes a page to print, or pictures; all others write a tree of files.
_OUT = {"board": "board.pdf", "capture": "views"}


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
        """Return the environment of the processes, with the rig key.

        The key may not stand on a command line. Where it is a keys folder's, the processes inherit where that
        folder is, and each camera has a certificate and a secret in it from here on.

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
        """The slave of a camera of this machine, simulated or USB.

        Simulated ones look at `view`, a key of `VIEWS` or any scene, which begins at `epoch_ns`,
        `epoch_of(view)` for all.
        """
        bind = "127.0.0.1" if self.settings.beacon.startswith("127.") else "0.0.0.0"
        return [*self._slave("run", camera, view, epoch_ns), "--beacon-port", self._port, "--bind", bind]

    def record(self, camera: CameraPlan, view: str, epoch_ns: int, seconds: float, out: Path) -> list[str]:
        """Raw frames of a camera of this machine to a folder."""
        line = self._slave("record", camera, view, epoch_ns)
        return [*line, "--seconds", f"{seconds:g}", "-o", str(out)]

    def pi(self, camera: CameraPlan) -> tuple[str, str]:
        """Return the commands for a camera on a Pi: here to copy files, there to start."""
        host = camera.device or f"{camera.name}.local"
        there = "calib_json"
        copy = f"rsync -a {shlex.quote(f'{self.tree}/')} {shlex.quote(host)}:{there}/"
        secrets = ["--key-file", f"{there}/{KEY_FILE}"]
        if (keys := keys_folder(os.environ)) is not None:
            own = [f"{keys}/./{file}" for file in files_of_device(camera.name)]
            copy += f" && rsync -aR {shlex.join(own)} {shlex.quote(host)}:keys/"
            secrets = ["--keys", "keys"]
        slave = ["phalanx-slave", "run", "--name", camera.name, "--rig", self.plan.rig]
        slave += ["--camera", "picamera2", "--calibration", there, "--beacon-port", self._port, *secrets]
        return copy, shlex.join([*slave, *shlex.split(camera.options)])

    def meet(self) -> list[str]:
        """A master that tracks nothing."""
        return [*_MODULE, "master.console.setup.meet", *self._link()]

    def run(self) -> list[str]:
        """The master that tracks."""
        return [*_MODULE, "master", "run", *self._link()]

    def calibrate(self, command: str, values: Mapping[str, Value], work: Path, *, live: bool) -> list[str]:
        """Return the command line of a calibration that writes below `work`.

        The last word of its name is `command`. It uses the form's `values` and what the page knows.

        Raises:
            CalibrationError: A field is empty that is needed, or a number is none.
        """
        fields = fields_of(CALIBRATIONS[command])
        names = {field.name for field in fields}
        known: dict[str, Value] = {
            "calibration": str(work / "tree" if command == "board" else self.tree),
            "rig": self.plan.rig,
            "beacon": self.settings.beacon,
            "bind": self.settings.bind,
            "bus": self.settings.bus,
            "json_file": str(work / "result.json"),
            "picture": str(work / "result.png"),
            "live": live,
            "out": str(work / _OUT.get(command, "tree")),
        }
        if values.get("verify"):
            del known["out"]  # nothing is fitted
            if not values.get("source"):
                del known["picture"]  # what is to be expected is a table
        merged = {**values, **{name: value for name, value in known.items() if name in names}}
        words = CALIBRATIONS[command].name.split()
        return [*_MODULE, "master", *words, *arguments_of(fields, merged)]

    def _slave(self, verb: str, camera: CameraPlan, view: str, epoch_ns: int) -> list[str]:
        place = ["--name", camera.name, "--rig", self.plan.rig, "--calibration", str(self.tree)]
        line = [*_MODULE, "slave", verb, *place]
        if camera.kind != "simulated":
            device = f":{camera.device}" if camera.device else ""
            return [*line, "--camera", f"v4l2{device}", *shlex.split(camera.options)]
        index = [one.name for one in self.plan.cameras].index(camera.name)
        offset_ms = 5.0  # cameras that nobody synchronises are taken one after the other
        late_ms = (time.monotonic_ns() - epoch_ns) * 1e-6 + offset_ms * index
        world = ["--truth", str(Path(self.plan.truth).resolve()), "--truth-rig", self.plan.world]
        scene = ["--scene", "standard" if view == "still" else view, "--scene-epoch-ns", str(epoch_ns)]
        return [*line, "--camera", "synthetic", *world, *scene, "--start-offset-ms", f"{late_ms:.3f}"]

    def _link(self) -> list[str]:
        place = ["--rig", self.plan.rig, "--calibration", str(self.tree)]
        ends = ["--beacon", self.settings.beacon, "--bind", self.settings.bind, "--bus", self.settings.bus]
        return [*place, *ends]

    @property
    def _port(self) -> str:
        return self.settings.beacon.rpartition(":")[2]


def epoch_of(view: str) -> int:
    """Return when a view's scene begins [ns, monotonic]; a still hand never does."""
    never_s = 36_000.0  # a hand that begins to move so much later is held still
    soon_s = 3.0  # until slaves have joined
    later_s = never_s if view == "still" else soon_s
    return time.monotonic_ns() + round(1e9 * later_s)
