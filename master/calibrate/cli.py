"""`phalanx-master calibrate`: each command is one function of the module that holds its subject."""

from collections.abc import Callable

import typer

from master.calibrate.cameras.board_command import board
from master.calibrate.cameras.capture_command import capture_views
from master.calibrate.cameras.commands import intrinsics, stereo
from master.calibrate.depth.commands import depth
from master.calibrate.depth.verify_command import verify_command
from master.calibrate.extrinsics.command import extrinsics
from master.calibrate.hand.commands import hand_command
from master.calibrate.object.command import object_command
from master.calibrate.object.cube_command import cube
from master.calibrate.time.commands import time_command
from master.calibrate.tracker.command import tracker
from master.calibrate.wrist.curl_command import curl
from master.calibrate.wrist.flat_command import flat_field
from master.calibrate.wrist.laser_command import laser_plane
from master.calibrate.wrist.palm_command import palm
from master.calibrate.wrist.subject_command import subject

COMMANDS: dict[str, Callable[..., None]] = {
    "board": board,
    "intrinsics": intrinsics,
    "stereo": stereo,
    "capture": capture_views,
    "depth": depth,
    "verify": verify_command,
    "time": time_command,
    "hand": hand_command,
    "laser-plane": laser_plane,
    "flat-field": flat_field,
    "curl": curl,
    "palm": palm,
    "subject": subject,
    "extrinsics": extrinsics,
    "tracker": tracker,
    "cube": cube,
    "object": object_command,
}


def calibrate_app() -> typer.Typer:
    """The commands as one program, to be put under a name."""
    app = typer.Typer(no_args_is_help=True, add_completion=False, callback=_about)
    for name, command in COMMANDS.items():
        app.command(name)(command)
    return app


def _about() -> None:
    """Measure a rig, a hand or an object: each result is a new file with date, residual and source."""
