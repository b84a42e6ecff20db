"""Define the options of the commands that set up: colours and doctor.

Options of `phalanx-slave colours`.

Options of `phalanx-slave doctor`.

What is not passed is read from the files in /etc/phalanx.
"""

import re
from argparse import ArgumentParser, ArgumentTypeError
from pathlib import Path

from common.command_line import positive
from slave.cli.options import BEACON_PORT
from slave.drivers import SWITCHED_LIGHTS


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


def doctor(command: ArgumentParser) -> None:
    """Report what of this device is well and what is not.

    Machine, clock, libraries, keys, devices, camera, service, and
    whether its master is received; each line ok, warn or fail, with what mends it; exit 1 where something fails.

    With --lights it looks at laser and LEDs of a wrist device alone: what the strobe of a rig may do, and what share of
    every limit for eyes and supply that is; and switches them, if asked to.

    Examples:
      sudo phalanx-slave doctor
            on a device with a service
      phalanx-slave doctor --name left --rig desk --camera v4l2 --calibration calib_json --keys keys --master pc.local
            before it is installed; as root it sees the keys, as another user the rest
      phalanx-slave doctor --json
            the same for programs; docs/doctor.md
      phalanx-slave doctor --ports
            where an IMU may be connected: serial ports and I2C buses
      phalanx-slave doctor --rig wrist --lights
            the budget of a rig
      phalanx-slave doctor --rig wrist --lights gpio:0:17,27 --blink 3
            three seconds of laser and LEDs in turn, as before a camera, within the limits; gpio:0:17/low,27 where low
            is on
      phalanx-slave doctor --rig wrist --lights i2c:1:0x63 --off
            dark, whatever was before: for a service that ends the slave by force
    """
    command.add_argument("--name", help="slave to look at (default: all that are installed here)")
    command.add_argument("--rig", metavar="NAME", help="its rig (default: as installed; with --lights wrist)")
    command.add_argument(
        "--camera", metavar="DRIVER", help="its camera, as `run` has it (default: as installed)"
    )
    command.add_argument(
        "--calibration",
        type=Path,
        metavar="DIR",
        help="calib_json (default: as installed; with --lights calib_json)",
    )
    command.add_argument("--keys", type=Path, metavar="DIR", help="keys folder (default: /etc/phalanx/keys)")
    command.add_argument("--master", metavar="HOST", help="the PC whose beacon and clock are expected")
    command.add_argument(
        "--beacon-port", type=int, default=BEACON_PORT, metavar="PORT", help="default: %(default)s"
    )
    command.add_argument("--json", action="store_true", help="for programs")
    command.add_argument("--ports", action="store_true", help="list where an IMU may be connected, and end")
    lights = command.add_argument_group("laser and LEDs of a wrist device").add_argument
    lights(
        "--lights",
        nargs="?",
        const="",
        metavar="DRIVER",
        help=f"the budget of the rig's strobe; with a driver, {SWITCHED_LIGHTS}, they can be switched",
    )
    lights("--blink", type=positive, metavar="S", help="laser and LEDs in turn, for so many seconds")
    lights("--off", action="store_true", help="switch both off")
