"""Options of `phalanx-slave colours`."""

import re
from argparse import ArgumentParser, ArgumentTypeError
from pathlib import Path


def colours(command: ArgumentParser) -> None:
    """Find the marker colours of a camera in a recording.

    Writes its camera file, and reports what collides with
    what.

    Examples:
      phalanx-slave colours recordings/paints --camera left -o calib_json/cameras/left.json
            HSV ranges from one click per marker, or, without clicks, from a few seconds of the moving hand;
            prints what collides with what
      phalanx-slave colours left.mp4 --camera left --calibration calib_json -o calib_json/cameras/left.json \\
          --click thumb=312,204 --click index=350,122 --click middle=371,101 --click ring=395,117 \\
          --click little=420,150 --click back=360,260
            the same of a video or a folder of pictures: one pixel (column,row) on each marker in its first picture
      phalanx-slave colours recordings/paints --camera right --like calib_json/cameras/left.json -o right.json
            the same, the names taken from a camera file that has them
    """
    command.add_argument(
        "recording",
        type=Path,
        metavar="RECORDING",
        help="folder; with clicks in recording.json, or a few seconds of the moving, open hand; or a video or a folder "
        "of pictures, with --calibration",
    )
    command.add_argument("--camera", required=True, metavar="NAME")
    command.add_argument(
        "--click",
        action="append",
        type=click,
        default=[],
        metavar="MARKER=U,V",
        help="a pixel on a marker in the first picture, column and row from the top left; once for each marker",
    )
    command.add_argument(
        "--calibration",
        type=Path,
        metavar="DIR",
        help="of a video or pictures: calib_json tree with the camera",
    )
    command.add_argument(
        "--rig",
        metavar="NAME",
        help="of a video or pictures: rig in DIR/rigs (default: the one with the camera)",
    )
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


def click(text: str) -> tuple[str, tuple[float, float]]:
    """A marker and a pixel (u, v) on it.

    Raises:
        ArgumentTypeError: The text is not MARKER=U,V.
    """
    found = re.fullmatch(r"([^=]+)=(\d+(?:\.\d+)?),(\d+(?:\.\d+)?)", text)
    if found is None:
        raise ArgumentTypeError(f"{text!r}: expected MARKER=U,V, such as thumb=312,204")
    return found[1], (float(found[2]), float(found[3]))
