"""Options of `phalanx calibrate object`, `cube` and `tracker`."""

from argparse import ArgumentParser
from pathlib import Path

from common.option_types import number, whole
from master.commands.options import (
    add_bus,
    add_calibration,
    add_json,
    add_out,
    add_picture,
    add_recording_rig,
)


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
