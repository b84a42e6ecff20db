"""Runs commands of `phalanx` in this process: what they print, and how they end; what they refuse is raised."""

import contextlib
import io
from dataclasses import dataclass
from importlib import import_module

from common.command_line import Program, UsageError
from master.cli.table import CALIBRATIONS, program


@dataclass(frozen=True)
class Ended:
    """How a command ended: its exit code, and all that it printed."""

    exit_code: int
    output: str


def invoke(*words: object, of: Program | None = None) -> Ended:
    """Run a command of `phalanx`, or of another program.

    Raises:
        PhalanxError: What the command refuses.
    """
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        try:
            command, options = (of or program()).parse([str(word) for word in words])
            module, _, name = command.work.partition(":")
            code = getattr(import_module(module), name)(options) or 0
        except SystemExit as end:
            code = end.code
        except UsageError as error:
            printed.write(str(error))
            code = 2
    return Ended(int(code or 0), printed.getvalue())


def calibrate(name: str, *words: object) -> str:
    """What the calibration prints whose last word is `name`.

    Raises:
        PhalanxError: What it refuses.
    """
    done = invoke(*CALIBRATIONS[name].name.split(), *words)
    assert done.exit_code == 0, done.output
    return done.output
