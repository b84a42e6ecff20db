"""Entry point `phalanx-slave`: runs one command of `slave.commands`, the installer or the doctor."""

import argparse
import logging
import os
import sys
from collections.abc import Callable, Sequence

import cv2

from common.errors import PhalanxError
from common.supervisor import supervised_threads
from slave.arguments import parser
from slave.commands import colours, detect, importing, imu, join, lights, record, run, tracker
from slave.service import Service


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; return the exit code.

    0 done, 1 something the user can mend, 2 wrong usage.

    Raises:
        SystemExit: With code 70, if a thread or the command itself failed.
    """
    options = parser().parse_args(arguments)
    cv2.setNumThreads(1)  # small windows are faster on one thread, and the other cores stay free
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(name)s: %(message)s", stream=sys.stderr)
    with supervised_threads():
        try:
            return COMMANDS[options.command](options)
        except PhalanxError as error:
            _aside(f"phalanx-slave: {error}")
            Service(os.environ).failed(str(error))
            return 1
        except KeyboardInterrupt:  # while detecting offline; a live run ends by its event
            return 130


def _install(options: argparse.Namespace) -> int:
    from slave.install.command import run

    return run(options, _print)


def _doctor(options: argparse.Namespace) -> int:
    from common.machine import program
    from slave.doctor.command import examine
    from slave.doctor.finding import as_json, as_text, exit_code
    from slave.doctor.system import System

    findings = list(examine(options, System.here()))
    _print(as_json(findings, program()) if options.json else as_text(findings))
    return exit_code(findings)


def _print(line: str) -> None:
    print(line, flush=True)


def _aside(line: str) -> None:
    print(line, file=sys.stderr)


COMMANDS: dict[str, Callable[[argparse.Namespace], int]] = {
    "run": lambda options: run.run(options, _print),
    "imu": lambda options: imu.run(options, _print),
    "tracker": lambda options: tracker.run(options, _print),
    "lights": lambda options: lights.run(options, _print),
    "record": lambda options: record.run(options, _print, _aside),
    "join": lambda options: join.run(options, _print, _aside),
    "import": lambda options: importing.run(options, _print),
    "detect": lambda options: detect.run(options, _aside),
    "install": _install,
    "doctor": _doctor,
    "colours": lambda options: colours.run(options, _print, _aside),
}


if __name__ == "__main__":
    sys.exit(main())
