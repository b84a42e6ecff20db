"""Options of `phalanx calibrate wrist`."""

from argparse import ArgumentParser
from pathlib import Path

from common.option_types import number
from master.cli.calibrate import add_board, add_markers_of_board
from master.commands.options import add_calibration, add_json, add_out, add_picture, add_recording_rig


def add_lit_views(command: ArgumentParser) -> None:
    """Strobed views of a board."""
    command.add_argument(
        "source",
        type=Path,
        metavar="SOURCE",
        help="a recording, or a folder of VIEW_ambient.png, VIEW_laser.png and, if there are, VIEW_led.png",
    )


def laser_plane(command: ArgumentParser) -> None:
    """Measure the plane of a wrist device's laser.

    From ten views of a board that the laser crosses.

    Hold the board still for each view, at 15 to 35 cm, near and far and tilted every way, so that the line runs over
    it. Views with the line elsewhere are rejected, each with the reason. Nothing is written without --out.

    Examples:
      phalanx calibrate wrist laser-plane RECORDING --board 9x6 --square-mm 15 --rig wrist --out calib_json
      phalanx calibrate wrist laser-plane images --board 9x6 --square-mm 15 --rig wrist --picture plane.png
    """
    add_lit_views(command)
    add_board(command)
    add_recording_rig(command)
    add_calibration(command)
    add_out(command)
    add_json(command)
    add_picture(command, "the lines and what is left of them")


def flat_field(command: ArgumentParser) -> None:
    """Measure the flat field of a wrist device's LEDs.

    From twenty views of a board on matt paper.

    Its white squares at known places show how bright paper looks in every part of the image. Show the board
    everywhere, in the corners too, its face to the camera, still, in a room that is not too bright. Nothing is written
    without --out.

    Examples:
      phalanx calibrate wrist flat-field RECORDING --board 9x6 --square-mm 15 --rig wrist --out calib_json
      phalanx calibrate wrist flat-field images --board 9x6 --square-mm 15 --rig wrist --picture flat.png
    """
    add_lit_views(command)
    add_board(command)
    add_recording_rig(command)
    add_calibration(command)
    add_out(command)
    add_json(command)
    add_picture(command, "the flat field and its residuals")


def curl(command: ArgumentParser) -> None:
    """Measure along which line the laser point of each finger moves.

    From a guided curl of ten seconds.

    With the device on: open the hand flat, close it slowly to a fist, all fingers together, and open it again, twice.
    Fingers that did not move enough are named and keep what the rig had. Nothing is written without --out.

    Examples:
      phalanx replay RECORDING --detect-only --calibration calib_json --out found
      phalanx calibrate wrist curl RECORDING --detections found --rig wrist --out calib_json --picture curl.png
    """
    command.add_argument(
        "recording", type=Path, metavar="RECORDING", help="folder of a recording: a hand that curls slowly"
    )
    command.add_argument(
        "--detections",
        type=Path,
        required=True,
        metavar="DIR",
        help="folder with detections_<camera>.npz of it, from `replay --detect-only`",
    )
    add_recording_rig(command)
    add_calibration(command)
    add_out(command)
    add_json(command)
    add_picture(command, "points and lines")


def palm(command: ArgumentParser) -> None:
    """Measure where the palm is before the wrist camera, by a board on it.

    Without a board: `calibrate wrist subject`.

    The board lies flat on palm and straight fingers, print to the camera, columns along the middle finger. Nothing is
    written without --out.

    Examples:
      phalanx calibrate wrist palm RECORDING --board 7x4 --square-mm 10 --wrist-mm 70 --depth-mm 22 --rig wrist
    """
    command.add_argument(
        "source",
        type=Path,
        metavar="SOURCE",
        help="a recording of the board on the palm; or images VIEW_ambient.png, VIEW_led.png",
    )
    command.add_argument(
        "--board", required=True, metavar="BOARD", help="COLUMNSxROWS: inner corners, columns across the hand"
    )
    command.add_argument(
        "--square-mm",
        type=number(),
        required=True,
        metavar="MM",
        help="side of a square in mm, measured on the print",
    )
    command.add_argument(
        "--wrist-mm",
        type=number(),
        required=True,
        metavar="MM",
        help="mm along the hand from the wrist crease to the nearest row of inner corners",
    )
    command.add_argument(
        "--depth-mm",
        type=number(),
        required=True,
        metavar="MM",
        help="mm from the axis of the wrist up to the print",
    )
    add_markers_of_board(command)
    command.add_argument(
        "--aside-mm",
        type=number(),
        default=0.0,
        metavar="MM",
        help="mm from the middle finger's line to the board's middle, to the thumb + (default: %(default)s)",
    )
    command.add_argument(
        "--hand", type=Path, metavar="FILE", help="hand file; default: the rig's `hand` in CALIBRATION/hands"
    )
    add_recording_rig(command)
    add_calibration(command)
    add_out(command)
    add_json(command)


def subject(command: ArgumentParser) -> None:
    """Measure the subject: palm pose, knuckles, thickness and lengths of fingers.

    From sixteen seconds of guided motion.

    With the device on: open the hand flat; bend the straight fingers at their knuckles towards 90 degrees, and back;
    open it flat; close it to a fist, and open it again. Three seconds or more for each bend. It needs the laser plane,
    a pose of the palm that is right to a centimetre and ten degrees (the drawing of the device; a board is better),
    and a hand file of the user's size. Nothing is written without --out.

    Examples:
      phalanx replay RECORDING --detect-only --calibration calib_json --out found
      phalanx calibrate wrist subject RECORDING --detections found --rig wrist --name me --out calib_json
    """
    command.add_argument(
        "recording", type=Path, metavar="RECORDING", help="folder of a recording: the guided motion"
    )
    command.add_argument(
        "--detections",
        type=Path,
        required=True,
        metavar="DIR",
        help="folder with detections_<camera>.npz of it, from `replay --detect-only`",
    )
    command.add_argument(
        "--hand", type=Path, metavar="FILE", help="hand file; default: the rig's `hand` in CALIBRATION/hands"
    )
    command.add_argument(
        "--name", metavar="NAME", help="of the new hand file; default: that of the hand file"
    )
    add_recording_rig(command)
    add_calibration(command)
    add_out(command)
    add_json(command)
    add_picture(command, "what was seen and fitted")


def extrinsics(command: ArgumentParser) -> None:
    """Measure the extrinsics of a wrist device, its IMU, and how late its clocks are.

    With the device on, before the marker cameras, for ten seconds, each to and fro about once a second: bend fingers
    one by one and together, bend the wrist as far one way as the other, and turn the forearm about all its axes. It
    needs the laser plane, a pose of the palm that is right to a centimetre and ten degrees (the drawing of the
    device), and the hand file of that hand. Three markers on the back of the hand (rig desk-back3) constrain it best.
    Nothing is written without --out.

    Examples:
      phalanx replay RECORDING --detect-only --calibration calib_json --out found
      phalanx calibrate wrist extrinsics RECORDING --detections found --out calib_json
    """
    command.add_argument(
        "recording",
        type=Path,
        metavar="RECORDING",
        help="folder of a recording of kind `both`: the joint motion",
    )
    command.add_argument(
        "--detections",
        type=Path,
        required=True,
        metavar="DIR",
        help="folder with detections_<camera>.npz of all its cameras, from `replay --detect-only`",
    )
    command.add_argument(
        "--hand",
        type=Path,
        metavar="FILE",
        help="hand file; default: the marker rig's `hand` in CALIBRATION/hands",
    )
    add_recording_rig(command)
    add_calibration(command)
    add_out(command)
    add_json(command)
    add_picture(command, "what was seen and fitted")
