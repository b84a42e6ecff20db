"""Options of `phalanx calibrate`; those of wrist and object: beside it."""

from argparse import ArgumentParser
from pathlib import Path

from common.command_line import number, whole
from master.commands.options import (
    add_bus,
    add_calibration,
    add_choice,
    add_flag,
    add_joints,
    add_json,
    add_keys,
    add_link,
    add_names,
    add_number,
    add_out,
    add_path,
    add_picture,
    add_recording_rig,
    add_results,
    add_rig,
    add_text,
)


def add_board(command: ArgumentParser, size: str | None = None, square_mm: float | None = None) -> None:
    """The board; without a usual size and square they have to be given."""
    shape = "inner corners of a checkerboard, squares of a ChArUco board (--marker-mm), circles (--circle-mm)"
    add_text(command, "--board", "COLUMNSxROWS", shape, required=size is None, default=size)
    side, given = "side of a square, measured on the print", square_mm is not None
    add_number(command, "--square-mm", "MM", side, required=not given, default=square_mm)
    add_markers_of_board(command)


def add_markers_of_board(command: ArgumentParser) -> None:
    """The markers of a ChArUco board, or the circles of a grid."""
    add_number(command, "--marker-mm", "MM", "side of a marker: the board is a ChArUco board")
    add_number(
        command, "--circle-mm", "MM", "diameter of a circle: a grid of circles, a square is their distance"
    )
    add_dictionary(command)


def add_dictionary(command: ArgumentParser) -> None:
    """The family of these markers."""
    add_text(command, "--dictionary", "NAME", "family of its markers", default="4X4_50")


def add_board_pictures(command: ArgumentParser) -> None:
    """The pictures of a board, the board, and which cameras."""
    add_path(command, "source", "SOURCE", "folder of CAMERA*.png, CAMERA.mp4 or CAMERA/, or a recording")
    add_board(command)
    add_names(command, "--camera", "NAME", "a camera; once for each (default: all that have images)")


def add_board_shape(command: ArgumentParser) -> None:
    """What is known of the board's own shape."""
    add_flag(
        command,
        "--flat-board",
        "the board is exact and flat (glass, screen): do not estimate its shape (default: as views held "
        "out show)",
    )
    add_flag(command, "--bent-board", "estimate the board's own shape (default: as views held out show)")


def add_sweep(command: ArgumentParser) -> None:
    """A target at known distances, and the pair of cameras that saw it."""
    add_path(command, "source", "SOURCE", "folder of a recording, or a .csv; none with --live", nargs="?")
    add_path(command, "--detections", "DIR", "folder with detections_<camera>.npz of the recording")
    add_text(command, "--marker", "NAME", "marker whose paint the target has; default: the only one seen")
    add_text(
        command, "--distances", "METRES", "FIRST:LAST:STEP in metres, a list, or a .csv; default: truth.npz"
    )
    add_recording_rig(command)
    add_calibration(command, "rigs/ and cameras/")
    add_text(
        command,
        "--target",
        "SHAPE",
        "its shape, WIDTHxHEIGHT or round: the lens shifts its centroid",
        default="75x50",
    )
    add_number(
        command, "--fov-deg", "DEG", "nominal horizontal field of view, for cameras without intrinsics"
    )


def board(command: ArgumentParser) -> None:
    """Draw a calibration board, or the net of a box of tags, at true scale.

    Print at 100 % and measure the ruler of 100 mm. Glue a board on something flat; the page shows the options to
    calibrate with it. Glue the net round a box of that size: CALIBRATION/objects/NAME.json describes the box, and the
    rig names it under `objects`.

    Examples:
      phalanx calibrate board -o board.pdf
      phalanx calibrate board --paper A3 --board 11x7 --square-mm 36 -o board.pdf
      phalanx calibrate board --kind checkerboard -o board.pdf
      phalanx calibrate board --kind box --name mug --side-mm 50 --edge-mm 38 -o mug.pdf
    """
    command.add_argument(
        "--out", "-o", type=Path, required=True, metavar="FILE", help="file to write, .pdf or .svg"
    )
    add_choice(command, "--kind", ("charuco", "checkerboard", "box"), "what is printed", default="charuco")
    add_text(command, "--paper", "PAPER", "of a board: A4, A3, A2 or letter. Default: A4")
    add_text(
        command,
        "--board",
        "SIZE",
        "COLUMNSxROWS: squares, of a checkerboard its inner corners. Default: 9x6",
        dest="size",
    )
    add_number(command, "--square-mm", "MM", "side of a square. Default: 29, of a checkerboard 25")
    add_number(command, "--marker-mm", "MM", "side of a marker. Default: 3/4 square")
    add_dictionary(command)
    add_text(command, "--name", "NAME", "of a box: name of the object", default="box")
    april, aruco = ("16h5", "25h9", "36h11"), ("aruco_4x4_50", "aruco_5x5_100", "aruco_6x6_250")
    families = (*(f"apriltag_{bits}" for bits in april), *aruco)
    add_choice(command, "--family", families, "of a box: family of its tags", default="aruco_5x5_100")
    add_number(command, "--first", "N", "of a box: number of its first tag", whole(), default=0)
    add_number(command, "--side-mm", "MM", "of a box: its side", default=40.0)
    edge = "of a box: edge of the black squares, as measured on the print"
    add_number(command, "--edge-mm", "MM", edge, default=30.0)
    add_calibration(command, "objects/, for the file of a box")


def intrinsics(command: ArgumentParser) -> None:
    """Measure the lens of each camera by itself.

    Focal length, centre and distortion, each with its uncertainty.

    Wrong pictures are rejected automatically, each with the reason. Nothing is written without --out.

    Examples:
      phalanx calibrate cameras intrinsics views --board 9x6 --square-mm 25 --out calib_json
      phalanx calibrate cameras intrinsics views --camera left --board 7x5 --square-mm 30 --marker-mm 22
    """
    add_board_pictures(command)
    add_board_shape(command)
    add_calibration(command)
    add_results(command, "corners and residuals")


def stereo(command: ArgumentParser) -> None:
    """Measure where two or more cameras stand, and their lenses, in one bundle.

    Not every camera needs to see every view, as long as shared views link them all. The rig's frame stays that of its
    file. Nothing is written without --out.

    Examples:
      phalanx calibrate cameras stereo views --board 9x6 --square-mm 25 --rig desk --out calib_json
      phalanx calibrate cameras stereo videos --board 9x6 --square-mm 29 --marker-mm 21.75 --picture views.png
      phalanx calibrate cameras stereo views --camera left --camera right --board 9x6 --square-mm 25 --keep-intrinsics
    """
    add_board_pictures(command)
    add_text(command, "--rig", "NAME", "name of the rig's file, without .json", default="desk")
    add_flag(command, "--keep-intrinsics", "keep the lenses that the camera files have")
    add_board_shape(command)
    add_calibration(command)
    add_results(command, "corners and residuals")


def capture(command: ArgumentParser) -> None:
    """Keep a picture whenever the board is held still somewhere new.

    All running slaves of the rig take it at once.

    This is the rig's master while it runs: end `phalanx run` first. Slaves whose cameras have no colours yet
    run with `--colours none`. Ctrl-C ends it early; what was kept stays.

    Examples:
      phalanx calibrate cameras capture --rig desk --board 9x6 --square-mm 25 --out views
      phalanx calibrate cameras stereo views --board 9x6 --square-mm 25 --rig desk --out calib_json      then
    """
    add_path(command, "--out", "DIR", "new or empty folder for the pictures", required=True)
    add_board(command, size="9x6", square_mm=25.0)
    add_number(command, "--views", "N", "views to keep", whole(5, 200), default=25)
    add_rig(command)
    add_calibration(command)
    add_link(command)
    add_bus(command)


def depth(command: ArgumentParser) -> None:
    """Fit depth to disparity from a target at known distances; or verify a rig's.

    The laws are D = k x^z and x = a/D + x0. With --verify nothing is fitted: the error of each depth model of the rig
    is measured at these distances, beside what noise and time let expect. Without a recording or a table, --verify
    prints only what to expect, and the error off the axis.

    Examples:
      phalanx calibrate depth RECORDING --detections DIR --distances 1.00:0.20:-0.05 --out calib_json
      phalanx calibrate depth sweep.csv                       columns distance_m,disparity_px
      phalanx calibrate depth --live --rig desk --marker index --out calib_json
      phalanx calibrate depth RECORDING --detections DIR --distances 1.00:0.20:-0.05 --rig desk --verify
      phalanx calibrate depth --rig desk --verify             what to expect, without a measurement
    """
    add_sweep(command)
    add_out(command)
    add_choice(
        command, "--use", ("power_law", "affine_disparity", "stereo"), "also make this the rig's depth_model"
    )
    add_json(command)
    add_picture(command, "the errors")
    add_flag(command, "--live", "measure now, with the running slaves")
    add_path(command, "--save", "FILE", "with --live: keep the readings in this .csv", dest="save_table")
    add_number(command, "--frames", "N", "with --live: frames to average, at least", whole(8), default=30)
    add_number(command, "--seconds", "S", "with --live: time to average", number(1.0, 60.0), default=1.0)
    add_flag(command, "--verify", "fit nothing: report how right the depth of the rig is")
    sigma = "with --verify: noise of a centroid, one camera, per axis, in px"
    speed = "with --verify: sideways speed for the budget, in m/s"
    apart = "with --verify: uncorrected time between the two exposures, in ms"
    add_number(command, "--sigma-px", "N", sigma, default=0.1)
    add_number(command, "--speed-m-s", "N", speed, default=1.0)
    add_number(command, "--skew-ms", "N", apart, default=0.5)
    angles = "with --verify: angles to the side, in degrees, for the off-axis table"
    add_text(command, "--angles", "ANGLES", angles, default="-20:20:10")
    add_link(command)
    add_keys(command)


def time(command: ArgumentParser) -> None:
    """Measure how much later a camera's frames are than their time stamps.

    From a hand that moves.

    Offsets are against the first camera of the rig. The master adds them to the times of every frame.

    Examples:
      phalanx calibrate cameras time RECORDING --detections DIR
      phalanx calibrate cameras time RECORDING --detections DIR --rig desk --out calib_json
    """
    add_path(command, "recording", "RECORDING", "folder of a raw-frame recording: a hand that moves")
    add_path(command, "--detections", "DIR", "folder with detections_<camera>.npz of it", required=True)
    add_recording_rig(command)
    add_calibration(command, "rigs/ and cameras/, for --rig")
    add_results(command, "the offsets")


def hand(command: ArgumentParser) -> None:
    """Make a hand file: by length, a guided routine of 20 s, or motion capture.

    Examples:
      phalanx calibrate hand --length-mm 190 --side right --name me --out calib_json      a quick start
      phalanx calibrate hand --steps                                                      what to do for:
      phalanx calibrate hand --poses poses.npz --side right --name me --out calib_json
      phalanx calibrate hand --live --side right --name me --out calib_json               step by step
      phalanx calibrate hand --from me.bvh --side right --name me --out calib_json        joints of others
    """
    add_path(command, "--poses", "FILE", "poses.npz of the routine, from `replay` or a running master")
    add_text(command, "--name", "NAME", "name of the new hand file, without .json", default="me")
    add_choice(
        command,
        "--side",
        ("left", "right"),
        "which hand; default: right, with --from: from names or geometry",
    )
    add_number(
        command,
        "--length-mm",
        "MM",
        "millimetres from the wrist crease to the end of the middle finger; alone: a quick start",
    )
    add_path(command, "--hand", "FILE", "hand file to begin with: proportions, marker places", dest="base")
    add_text(command, "--rig", "NAME", "rig whose markers the poses have", default="desk")
    add_calibration(command)
    add_number(
        command,
        "--dip-per-pip",
        "N",
        "how far the last joint bends per middle joint, where it was measured",
        number(0.0, 2.0),
    )
    add_path(command, "--out", "DIR", "tree to write hands/NAME.json into")
    add_json(command)
    add_picture(command, "lengths and residuals")
    add_flag(command, "--three-back", "with three markers on the back; only with --length-mm alone")
    add_flag(command, "--steps", "only print the steps of the routine")
    add_flag(command, "--live", "do the routine now, before the running master")
    add_bus(command)
    add_path(
        command,
        "--from",
        "FILE",
        "motion capture of the hand's joints: .csv, .tsv, .bvh, .c3d",
        dest="source",
    )
    add_joints(command)
    add_choice(
        command,
        "--unit",
        ("m", "cm", "mm"),
        "of length in --from; default: as the file says, else by the size of the hand",
    )
    add_number(command, "--rate", "HZ", "of a --from table without times")
