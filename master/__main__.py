"""Entry point `phalanx-master`: its commands, and the errors that end them."""

import logging
import sys

try:
    import typer
except ModuleNotFoundError as error:  # a slave's machine has the scripts of both, and the packages of one
    raise SystemExit(
        f"phalanx-master: {error.name} is missing: install the master's packages, pip install '.[master]'"
    ) from error

from common.errors import PhalanxError
from common.supervisor import supervised_threads
from master.calibrate.cli import calibrate_app
from master.camera_command import camera
from master.checklist.command import check
from master.console_command import console
from master.export.command import export
from master.fleet import fleet
from master.gestures.command import gestures_app
from master.hear import hear
from master.key_options import program
from master.keys_command import keys_app
from master.recording.command import info, play, record
from master.report_command import report
from master.router_command import relay, router
from master.run_command import run
from master.send.command import send
from master.solve_command import solve
from master.study.command import evaluate_app
from master.view_command import view


def command_line() -> typer.Typer:
    """All commands of `phalanx-master`."""
    app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)
    app.callback()(phalanx_master)
    first = (run, solve, view, console, report)
    for command in (*first, camera, check, export, fleet, hear, record, play, info, router, relay, send):
        app.command()(command)
    groups = {
        "calibrate": calibrate_app,
        "evaluate": evaluate_app,
        "gestures": gestures_app,
        "keys": keys_app,
    }
    for name, group in groups.items():
        app.add_typer(group(), name=name)
    return app


def phalanx_master() -> None:
    """Turn the detections of several cameras, or of a wrist device, into one hand of 26 joints.

    `phalanx-master COMMAND --help` shows its examples.
    """


def main() -> None:
    """Run one command; the process ends with 0, 1 (something the user can mend), 2 (wrong usage) or 70 (a fault)."""
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s: %(message)s")
    logging.getLogger("matplotlib").setLevel(logging.WARNING)  # it tells of its font cache on the first run
    with supervised_threads():
        try:
            program(command_line())()
        except PhalanxError as error:
            print(f"phalanx-master: {error}", file=sys.stderr)
            sys.exit(1)


if __name__ == "__main__":
    main()
