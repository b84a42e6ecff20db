"""All commands of `phalanx-master`."""

import typer

from master.calibrate.cli import calibrate_app
from master.camera_command import camera
from master.checklist.command import check
from master.console_command import console
from master.export.command import export
from master.fleet import fleet
from master.gestures.command import gestures_app
from master.hear import hear
from master.install_command import OPTIONS_OF_RUN, install
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
    app.command(context_settings=OPTIONS_OF_RUN)(install)
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
    """Turn detections of cameras, or of a wrist device, into a hand of 26 joints.

    `phalanx-master COMMAND --help` shows its examples.
    """
