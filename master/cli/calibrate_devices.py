"""Options of `phalanx calibrate` for wrist device, object and tracker.

Options of `phalanx calibrate wrist`.

Options of `phalanx calibrate object`, `cube` and `tracker`.
"""

from argparse import ArgumentParser
from pathlib import Path

from common.command_line import number, whole
from master.cli.calibrate import add_board, add_markers_of_board
from master.commands.options import (
    add_bus,
    add_calibration,
    add_json,
    add_out,
    add_picture,
    add_recording_rig,
)


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


def tracker(command: ArgumentParser) -> None:
    """Find where a tracking system lies in the rig and its device on an object.

    For example a Vive tracker under Lighthouse.

    The device is fixed to an object that the cameras see by markers or tags. Turn it about all its axes, a quarter turn
    and back, and carry it to all sides for twenty seconds. Which way the system's own axes point does not matter. The
    lag between the clocks is found as well. Nothing is written without --out.

    Examples:
      phalanx calibrate tracker cube --live --rig desk-cube --keep motion.npz --out calib_json
      phalanx calibrate tracker cube --motion motion.npz --rig desk-cube --picture tracker.png
    """
    command.add_argument("name", metavar="NAME", help="the object: a file of CALIBRATION/objects")
    command.add_argument(
        "--motion",
        type=Path,
        metavar="FILE",
        help="an .npz of object and tracker poses, as --keep writes (docs/tracker.md)",
    )
    command.add_argument("--live", action="store_true", help="do the motion now, before the running master")
    command.add_argument(
        "--rig",
        default="desk-cube",
        metavar="NAME",
        help="rig whose cameras see the object (default: %(default)s)",
    )
    add_calibration(command)
    command.add_argument(
        "--device", metavar="NAME", help="name of the device on it; default: `tracker` of the object's file"
    )
    command.add_argument(
        "--seconds",
        type=number(10.0),
        default=90.0,
        metavar="S",
        help="how many seconds a live motion may take at most (default: %(default)s)",
    )
    command.add_argument("--keep", type=Path, metavar="FILE", help="keep the live motion in this .npz")
    add_out(command)
    add_json(command)
    add_picture(command, "what was seen and left")
    add_bus(command)


def cube(command: ArgumentParser) -> None:
    """Draw the net of a box of tags at true scale and write objects/<name>.json.

    Print at 100 %, measure the ruler, glue it round a box of that size. Name the object under `objects` of the rig.

    Examples:
      phalanx calibrate cube -o box.pdf
      phalanx calibrate cube --name mug --side-mm 50 --edge-mm 38 -o mug.pdf
    """
    command.add_argument(
        "--out", "-o", type=Path, required=True, metavar="FILE", help="page to write, .pdf or .svg"
    )
    command.add_argument(
        "--name", default="box", metavar="NAME", help="name of the object (default: %(default)s)"
    )
    add_calibration(command, "objects/")
    command.add_argument(
        "--family",
        choices=(
            "apriltag_16h5",
            "apriltag_25h9",
            "apriltag_36h11",
            "aruco_4x4_50",
            "aruco_5x5_100",
            "aruco_6x6_250",
        ),
        default="aruco_5x5_100",
        help="family of the tags (default: %(default)s)",
    )
    command.add_argument(
        "--first", type=whole(), default=0, metavar="N", help="number of the first tag (default: %(default)s)"
    )
    command.add_argument(
        "--side-mm", type=number(), default=40.0, metavar="MM", help="side of the box (default: %(default)s)"
    )
    command.add_argument(
        "--edge-mm",
        type=number(),
        default=30.0,
        metavar="MM",
        help="edge of the black squares, as measured on the print (default: %(default)s)",
    )


def object_options(command: ArgumentParser) -> None:
    """Measure where the beads of a rigid object sit.

    From fifteen seconds of its being turned before the cameras.

    The rig lists the beads in markers and in free_markers, the camera files have their colours; the object's file is
    not needed. Its frame is that of --like, or of its own file where there is one; else: origin in the middle of the
    beads, x from the first to the second, y to the side of the one farthest from that line. Nothing is written without
    --out.

    Examples:
      phalanx calibrate object wand --live --rig desk-wand --markers wand1,wand2,wand3 --radius-mm 9 --out TREE
      phalanx calibrate object wand --recording REC --detections DIR --picture wand.png --out TREE --add-to-rig
    """
    command.add_argument("name", metavar="NAME", help="name of the object; its file is objects/NAME.json")
    command.add_argument(
        "--markers",
        metavar="NAMES",
        help="its beads, with commas; default: those of its file, else all free_markers of the rig",
    )
    command.add_argument(
        "--radius-mm",
        type=number(0.5, 50.0),
        metavar="MM",
        help="radius of the beads; default: as its file has it, else 8",
    )
    command.add_argument(
        "--recording",
        type=Path,
        metavar="DIR",
        help="folder of a raw-frame recording of the object that moves",
    )
    command.add_argument(
        "--detections", type=Path, metavar="DIR", help="folder with detections_<camera>.npz of it"
    )
    command.add_argument("--live", action="store_true", help="do the motion now, before the running master")
    add_recording_rig(command)
    add_calibration(command)
    command.add_argument(
        "--like",
        type=Path,
        metavar="FILE",
        help="object file whose frame, shape, tags and tracker are kept; default: its own",
    )
    command.add_argument(
        "--add-to-rig", action="store_true", help="name it under objects of the rig in --out"
    )
    command.add_argument(
        "--seconds",
        type=number(5.0),
        default=60.0,
        metavar="S",
        help="how many seconds a live motion may take at most (default: %(default)s)",
    )
    add_out(command)
    add_json(command)
    add_picture(command, "beads and residuals")
    add_bus(command)
