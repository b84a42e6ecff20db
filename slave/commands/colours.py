"""`phalanx-slave colours`: the colours of the markers of a camera, from a recording."""

import argparse
from collections.abc import Callable
from pathlib import Path

PURPOSE = "colours of the markers"
EXAMPLES = """\
  phalanx-slave colours recordings/paints --camera left -o calib_json/cameras/left.json
        HSV ranges from one click per marker, or, without clicks, from a few seconds of the moving hand;
        prints what collides with what
  phalanx-slave colours recordings/paints --camera right --like calib_json/cameras/left.json -o right.json
        the same, the names taken from a camera file that has them
"""


def add_options(command: argparse.ArgumentParser) -> None:
    """The options of `colours`."""
    command.add_argument(
        "recording",
        type=Path,
        metavar="RECORDING",
        help="folder; with clicks in recording.json, or a few seconds of the moving, open hand",
    )
    command.add_argument("--camera", required=True, metavar="NAME")
    command.add_argument(
        "--auto",
        action="store_true",
        help="from all frames though there are clicks, which then only name paints",
    )
    command.add_argument(
        "--like",
        type=Path,
        metavar="CAMERA.json",
        help="from all frames; names by the hues of this camera file",
    )
    command.add_argument(
        "--hand",
        type=Path,
        metavar="HAND.json",
        help="from all frames; names by the shape of this hand, which checks those of --like "
        "(default: calib_json/hands/, the rig's hand)",
    )
    command.add_argument(
        "-o", "--output", type=Path, required=True, metavar="FILE", help="camera file to write"
    )


def run(options: argparse.Namespace, say: Callable[[str], None], aside: Callable[[str], None]) -> int:
    """Find them, write the camera file, and say what collides with what.

    Raises:
        PhalanxError: The recording or a file is missing or broken, or the colours cannot be told apart.
    """
    from slave.markers.colours import report
    from slave.offline import calibrate_colours

    table = calibrate_colours(
        options.recording,
        options.camera,
        options.output,
        auto=options.auto,
        like=options.like,
        hand=options.hand,
        say=aside,
    )
    say(report(table))
    return 0
