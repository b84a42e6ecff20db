"""Options of `phalanx calibrate`; those of wrist and object: beside it."""

from argparse import ArgumentParser
from pathlib import Path

from common.command_line import number, whole
from master.commands.options import (
    add_bus,
    add_calibration,
    add_joints,
    add_json,
    add_keys,
    add_link,
    add_out,
    add_picture,
    add_recording_rig,
    add_rig,
)


def add_board(command: ArgumentParser, size: str | None = None, square_mm: float | None = None) -> None:
    """The board; without a usual size and square they have to be given."""
    command.add_argument(
        "--board",
        required=size is None,
        default=size,
        metavar="COLUMNSxROWS",
        help="inner corners of a checkerboard, squares of a ChArUco board (--marker-mm)" + _usual(size),
    )
    command.add_argument(
        "--square-mm",
        type=number(),
        required=square_mm is None,
        default=square_mm,
        metavar="MM",
        help="side of a square, measured on the print" + _usual(square_mm),
    )
    add_markers_of_board(command)


def add_markers_of_board(command: ArgumentParser) -> None:
    """The markers of a ChArUco board."""
    command.add_argument(
        "--marker-mm", type=number(), metavar="MM", help="side of a marker: the board is a ChArUco board"
    )
    add_dictionary(command)


def add_dictionary(command: ArgumentParser) -> None:
    """The family of these markers."""
    command.add_argument(
        "--dictionary", default="4X4_50", metavar="NAME", help="family of its markers (default: %(default)s)"
    )


def add_pictures(command: ArgumentParser) -> None:
    """The pictures of a board."""
    command.add_argument(
        "source",
        type=Path,
        metavar="SOURCE",
        help="folder: CAMERA*.png|jpg, or a folder per camera, or a recording",
    )


def add_cameras(command: ArgumentParser) -> None:
    """Which cameras."""
    command.add_argument(
        "--camera",
        action="append",
        default=[],
        metavar="NAME",
        help="a camera; once for each (default: all that have images)",
    )


def add_board_shape(command: ArgumentParser) -> None:
    """What is known of the board's own shape."""
    command.add_argument(
        "--flat-board",
        action="store_true",
        help="the board is exact and flat (glass, screen): do not estimate its shape (default: as views held "
        "out show)",
    )
    command.add_argument(
        "--bent-board",
        action="store_true",
        help="estimate the board's own shape (default: as views held out show)",
    )


def add_sweep(command: ArgumentParser) -> None:
    """A target at known distances, and the pair of cameras that saw it."""
    command.add_argument(
        "source",
        nargs="?",
        type=Path,
        metavar="SOURCE",
        help="folder of a recording, or a .csv; none with --live",
    )
    command.add_argument(
        "--detections", type=Path, metavar="DIR", help="folder with detections_<camera>.npz of the recording"
    )
    command.add_argument(
        "--marker", metavar="NAME", help="marker whose paint the target has; default: the only one seen"
    )
    command.add_argument(
        "--distances",
        metavar="METRES",
        help="FIRST:LAST:STEP in metres, a list, or a .csv; default: truth.npz",
    )
    add_recording_rig(command)
    add_calibration(command, "rigs/ and cameras/")
    command.add_argument(
        "--target",
        default="75x50",
        metavar="SHAPE",
        help="its shape, WIDTHxHEIGHT or round: the lens shifts its centroid (default: %(default)s)",
    )
    command.add_argument(
        "--fov-deg",
        type=number(),
        metavar="DEG",
        help="nominal horizontal field of view, for cameras without intrinsics",
    )


def _usual(value: object) -> str:
    return "" if value is None else f" (default: {value})"


def board(command: ArgumentParser) -> None:
    """Draw a calibration board at true scale.

    Beside it are a ruler of 100 mm and the options to calibrate with it.

    Print at 100 %, measure the ruler, and glue the print on something flat.

    Examples:
      phalanx calibrate board -o board.pdf
      phalanx calibrate board --kind charuco --paper A3 --board 11x7 --square-mm 36 -o board.pdf
    """
    command.add_argument(
        "--out", "-o", type=Path, required=True, metavar="FILE", help="file to write, .pdf or .svg"
    )
    command.add_argument(
        "--kind",
        choices=("checkerboard", "charuco"),
        default="checkerboard",
        help="kind of board (default: %(default)s)",
    )
    command.add_argument(
        "--paper", default="A4", metavar="PAPER", help="a4, A3, A2 or letter (default: %(default)s)"
    )
    command.add_argument(
        "--board",
        dest="size",
        metavar="SIZE",
        help="COLUMNSxROWS: inner corners, of a ChArUco board squares. Default: 9x6, 9x6",
    )
    command.add_argument("--square-mm", type=number(), metavar="MM", help="side of a square. Default: 25, 29")
    command.add_argument(
        "--marker-mm", type=number(), metavar="MM", help="side of a marker. Default: 3/4 square"
    )
    add_dictionary(command)


def intrinsics(command: ArgumentParser) -> None:
    """Measure the lens of each camera by itself.

    Focal length, centre and distortion, each with its uncertainty.

    Wrong pictures are rejected automatically, each with the reason. Nothing is written without --out.

    Examples:
      phalanx calibrate cameras intrinsics views --board 9x6 --square-mm 25 --out calib_json
      phalanx calibrate cameras intrinsics views --camera left --board 7x5 --square-mm 30 --marker-mm 22
    """
    add_pictures(command)
    add_board(command)
    add_cameras(command)
    add_board_shape(command)
    add_calibration(command)
    add_out(command)
    add_json(command)
    add_picture(command, "corners and residuals")


def stereo(command: ArgumentParser) -> None:
    """Measure where all cameras of a rig stand, and their lenses, in one bundle.

    Two cameras or more.

    Not every camera needs to see every view, as long as shared views link them all. The rig's frame stays that of its
    file. Nothing is written without --out.

    Examples:
      phalanx calibrate cameras stereo views --board 9x6 --square-mm 25 --rig desk --out calib_json
      phalanx calibrate cameras stereo views --camera left --camera right --board 9x6 --square-mm 25 --keep-intrinsics
    """
    add_pictures(command)
    add_board(command)
    add_cameras(command)
    command.add_argument(
        "--rig",
        default="desk",
        metavar="NAME",
        help="name of the rig's file, without .json (default: %(default)s)",
    )
    command.add_argument(
        "--keep-intrinsics", action="store_true", help="keep the lenses that the camera files have"
    )
    add_board_shape(command)
    add_calibration(command)
    add_out(command)
    add_json(command)
    add_picture(command, "corners and residuals")


def capture(command: ArgumentParser) -> None:
    """Keep a picture whenever the board is held still somewhere new.

    All running slaves of the rig take it at once.

    This is the rig's master while it runs: end `phalanx run` first. Slaves whose cameras have no colours yet
    run with `--colours none`. Ctrl-C ends it early; what was kept stays.

    Examples:
      phalanx calibrate cameras capture --rig desk --board 9x6 --square-mm 25 --out views
      phalanx calibrate cameras stereo views --board 9x6 --square-mm 25 --rig desk --out calib_json      then
    """
    command.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="new or empty folder for the pictures"
    )
    add_board(command, size="9x6", square_mm=25.0)
    command.add_argument(
        "--views", type=whole(5, 200), default=25, metavar="N", help="views to keep (default: %(default)s)"
    )
    add_rig(command)
    add_calibration(command)
    add_link(command)
    add_bus(command)


def depth(command: ArgumentParser) -> None:
    """Fit depth to disparity from a target at known distances.

    The power law D = k x^z, and x = a/D + x0.

    Examples:
      phalanx calibrate depth RECORDING --detections DIR --distances 1.00:0.20:-0.05 --out calib_json
      phalanx calibrate depth sweep.csv                       columns distance_m,disparity_px
      phalanx calibrate depth --live --rig desk --marker index --out calib_json
    """
    add_sweep(command)
    add_out(command)
    command.add_argument(
        "--use",
        choices=("power_law", "affine_disparity", "stereo"),
        help="also make this the rig's depth_model",
    )
    add_json(command)
    add_picture(command, "the errors")
    command.add_argument("--live", action="store_true", help="measure now, with the running slaves")
    command.add_argument(
        "--save",
        dest="save_table",
        type=Path,
        metavar="FILE",
        help="with --live: keep the readings in this .csv",
    )
    command.add_argument(
        "--frames",
        type=whole(8),
        default=30,
        metavar="N",
        help="with --live: frames to average, at least (default: %(default)s)",
    )
    command.add_argument(
        "--seconds",
        type=number(1.0, 60.0),
        default=1.0,
        metavar="S",
        help="with --live: time to average (default: %(default)s)",
    )
    add_link(command)
    add_keys(command)


def verify(command: ArgumentParser) -> None:
    """Report how accurate a rig is.

    Error of each depth model at known distances, and the budget of what to expect.

    Without a recording or a table only the budget and the off-axis errors of the rig are printed.

    Examples:
      phalanx calibrate verify RECORDING --detections DIR --distances 1.00:0.20:-0.05 --rig desk
      phalanx calibrate verify --rig desk
    """
    add_sweep(command)
    command.add_argument(
        "--sigma-px",
        type=number(),
        default=0.1,
        metavar="N",
        help="noise of a centroid, one camera, per axis, in px (default: %(default)s)",
    )
    command.add_argument(
        "--speed-m-s",
        type=number(),
        default=1.0,
        metavar="N",
        help="sideways speed for the budget, in m/s (default: %(default)s)",
    )
    command.add_argument(
        "--skew-ms",
        type=number(),
        default=0.5,
        metavar="N",
        help="uncorrected time between the two exposures, in ms (default: %(default)s)",
    )
    command.add_argument(
        "--angles",
        default="-20:20:10",
        metavar="ANGLES",
        help="angles to the side, in degrees, for the off-axis table (default: %(default)s)",
    )
    add_json(command)
    add_picture(command, "the errors")


def time(command: ArgumentParser) -> None:
    """Measure how much later a camera's frames are than their time stamps.

    From a hand that moves.

    Offsets are against the first camera of the rig. The master adds them to the times of every frame.

    Examples:
      phalanx calibrate time RECORDING --detections DIR
      phalanx calibrate time RECORDING --detections DIR --rig desk --out calib_json
    """
    command.add_argument(
        "recording", type=Path, metavar="RECORDING", help="folder of a raw-frame recording: a hand that moves"
    )
    command.add_argument(
        "--detections",
        type=Path,
        required=True,
        metavar="DIR",
        help="folder with detections_<camera>.npz of it",
    )
    add_recording_rig(command)
    add_calibration(command, "rigs/ and cameras/, for --rig")
    add_out(command)
    add_json(command)


def hand(command: ArgumentParser) -> None:
    """Make a hand file: by length, a guided routine of 20 s, or motion capture.

    Examples:
      phalanx calibrate hand --length-mm 190 --side right --name me --out calib_json      a quick start
      phalanx calibrate hand --steps                                                      what to do for:
      phalanx calibrate hand --poses poses.npz --side right --name me --out calib_json
      phalanx calibrate hand --live --side right --name me --out calib_json               step by step
      phalanx calibrate hand --from me.bvh --side right --name me --out calib_json        joints of others
    """
    command.add_argument(
        "--poses",
        type=Path,
        metavar="FILE",
        help="poses.npz of the routine, from `replay` or a running master",
    )
    command.add_argument(
        "--name",
        default="me",
        metavar="NAME",
        help="name of the new hand file, without .json (default: %(default)s)",
    )
    command.add_argument(
        "--side",
        choices=("left", "right"),
        help="which hand; default: right, with --from: from names or geometry",
    )
    command.add_argument(
        "--length-mm",
        type=number(),
        metavar="MM",
        help="millimetres from the wrist crease to the end of the middle finger; alone: a quick start",
    )
    command.add_argument(
        "--hand",
        dest="base",
        type=Path,
        metavar="FILE",
        help="hand file to begin with: proportions, marker places",
    )
    command.add_argument(
        "--rig",
        default="desk",
        metavar="NAME",
        help="rig whose markers the poses have (default: %(default)s)",
    )
    add_calibration(command)
    command.add_argument(
        "--dip-per-pip",
        type=number(0.0, 2.0),
        metavar="N",
        help="how far the last joint bends per middle joint, where it was measured",
    )
    command.add_argument("--out", type=Path, metavar="DIR", help="tree to write hands/NAME.json into")
    add_json(command)
    add_picture(command, "lengths and residuals")
    command.add_argument(
        "--three-back",
        action="store_true",
        help="with three markers on the back; only with --length-mm alone",
    )
    command.add_argument("--steps", action="store_true", help="only print the steps of the routine")
    command.add_argument("--live", action="store_true", help="do the routine now, before the running master")
    add_bus(command)
    command.add_argument(
        "--from",
        dest="source",
        type=Path,
        metavar="FILE",
        help="motion capture of the hand's joints: .csv, .tsv, .bvh, .c3d",
    )
    add_joints(command)
    command.add_argument(
        "--unit",
        choices=("m", "cm", "mm"),
        help="of length in --from; default: as the file says, else by the size of the hand",
    )
    command.add_argument("--rate", type=number(), metavar="HZ", help="of a --from table without times")
