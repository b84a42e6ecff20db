"""Options of `phalanx calibrate` for wrist device, object and tracker."""

from argparse import ArgumentParser

from common.command_line import number
from master.cli.calibrate import add_board, add_markers_of_board
from master.commands.options import (
    add_bus,
    add_calibration,
    add_choice,
    add_flag,
    add_json,
    add_number,
    add_out,
    add_path,
    add_recording_rig,
    add_results,
    add_text,
)


def add_lit_views(command: ArgumentParser) -> None:
    """Strobed views of a board."""
    add_path(
        command,
        "source",
        "SOURCE",
        "a recording, or a folder of VIEW_ambient.png, VIEW_laser.png and, if there are, VIEW_led.png",
    )


def add_detected(command: ArgumentParser, motion: str, cameras: str = "it") -> None:
    """A recorded motion, and what was detected in it."""
    add_path(command, "recording", "RECORDING", f"folder of a recording{motion}")
    text = f"folder with detections_<camera>.npz of {cameras}, from `replay --detect-only`"
    add_path(command, "--detections", "DIR", text, required=True)


def laser_plane(command: ArgumentParser) -> None:
    """Measure the plane of a wrist device's laser.

    From ten views of a board that the laser crosses.

    Hold the board still for each view, at 15 to 35 cm, near and far and tilted every way, so that the line runs over
    it. Views with the line elsewhere are rejected, each with the reason. Nothing is written without --out.

    Examples:
      phalanx calibrate wrist laser-plane RECORDING --board 9x6 --square-mm 15 --rig wrist --out calib_json
      phalanx calibrate wrist laser-plane images --board 9x6 --square-mm 15 --rig wrist --picture plane.png
      phalanx calibrate wrist laser-plane cloud.ply --unit mm --rig wrist --out calib_json
    """
    text = (
        "a recording; a folder of VIEW_laser.png, each with VIEW_ambient.png, with VIEW_board.png (no laser), or "
        "alone, if it shows the board too; or a point cloud in the camera frame, .ply, .csv, .xyz, .txt"
    )
    add_path(command, "source", "SOURCE", text)
    shape = "of pictures: inner corners of a checkerboard, squares of a ChArUco board (--marker-mm), circles"
    add_text(command, "--board", "COLUMNSxROWS", shape)
    add_number(command, "--square-mm", "MM", "of pictures: side of a square, measured on the print")
    add_markers_of_board(command)
    add_choice(command, "--unit", ("m", "mm"), "of a cloud that does not state its own")
    add_recording_rig(command)
    add_calibration(command)
    add_results(command, "the lines and what is left of them")


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
    add_results(command, "the flat field and its residuals")


def curl(command: ArgumentParser) -> None:
    """Measure along which line the laser point of each finger moves.

    From a guided curl of ten seconds.

    With the device on: open the hand flat, close it slowly to a fist, all fingers together, and open it again, twice.
    Fingers that did not move enough are named and keep what the rig had. Nothing is written without --out.

    Examples:
      phalanx replay RECORDING --detect-only --calibration calib_json --out found
      phalanx calibrate wrist curl RECORDING --detections found --rig wrist --out calib_json --picture curl.png
    """
    add_detected(command, ": a hand that curls slowly")
    add_recording_rig(command)
    add_calibration(command)
    add_results(command, "points and lines")


def palm(command: ArgumentParser) -> None:
    """Measure where the palm is before the wrist camera, by a board on it.

    Without a board: `calibrate wrist subject`.

    The board lies flat on palm and straight fingers, print to the camera, columns along the middle finger. Nothing is
    written without --out.

    Examples:
      phalanx calibrate wrist palm RECORDING --board 7x4 --square-mm 10 --wrist-mm 70 --depth-mm 22 --rig wrist
    """
    add_path(
        command,
        "source",
        "SOURCE",
        "a recording of the board on the palm; or images VIEW_ambient.png, VIEW_led.png",
    )
    add_text(
        command, "--board", "BOARD", "COLUMNSxROWS: inner corners, columns across the hand", required=True
    )
    add_number(command, "--square-mm", "MM", "side of a square in mm, measured on the print", required=True)
    add_number(
        command,
        "--wrist-mm",
        "MM",
        "mm along the hand from the wrist crease to the nearest row of inner corners",
        required=True,
    )
    add_number(command, "--depth-mm", "MM", "mm from the axis of the wrist up to the print", required=True)
    add_markers_of_board(command)
    add_number(
        command,
        "--aside-mm",
        "MM",
        "mm from the middle finger's line to the board's middle, to the thumb +",
        default=0.0,
    )
    add_path(command, "--hand", "FILE", "hand file; default: the rig's `hand` in CALIBRATION/hands")
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
    add_detected(command, ": the guided motion")
    add_path(command, "--hand", "FILE", "hand file; default: the rig's `hand` in CALIBRATION/hands")
    add_text(command, "--name", "NAME", "of the new hand file; default: that of the hand file")
    add_recording_rig(command)
    add_calibration(command)
    add_results(command, "what was seen and fitted")


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
    add_detected(command, " of kind `both`: the joint motion", "all its cameras")
    add_path(command, "--hand", "FILE", "hand file; default: the marker rig's `hand` in CALIBRATION/hands")
    add_recording_rig(command)
    add_calibration(command)
    add_results(command, "what was seen and fitted")


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
    add_text(command, "name", "NAME", "the object: a file of CALIBRATION/objects")
    add_path(
        command, "--motion", "FILE", "an .npz of object and tracker poses, as --keep writes (docs/tracker.md)"
    )
    add_flag(command, "--live", "do the motion now, before the running master")
    add_text(command, "--rig", "NAME", "rig whose cameras see the object", default="desk-cube")
    add_calibration(command)
    add_text(command, "--device", "NAME", "name of the device on it; default: `tracker` of the object's file")
    add_number(
        command,
        "--seconds",
        "S",
        "how many seconds a live motion may take at most",
        number(10.0),
        default=90.0,
    )
    add_path(command, "--keep", "FILE", "keep the live motion in this .npz")
    add_results(command, "what was seen and left")
    add_bus(command)


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
    add_text(command, "name", "NAME", "name of the object; its file is objects/NAME.json")
    add_text(
        command,
        "--markers",
        "NAMES",
        "its beads, with commas; default: those of its file, else all free_markers of the rig",
    )
    add_number(
        command,
        "--radius-mm",
        "MM",
        "radius of the beads; default: as its file has it, else 8",
        number(0.5, 50.0),
    )
    add_path(command, "--recording", "DIR", "folder of a raw-frame recording of the object that moves")
    add_path(command, "--detections", "DIR", "folder with detections_<camera>.npz of it")
    add_flag(command, "--live", "do the motion now, before the running master")
    add_recording_rig(command)
    add_calibration(command)
    add_path(
        command,
        "--like",
        "FILE",
        "object file whose frame, shape, tags and tracker are kept; default: its own",
    )
    add_flag(command, "--add-to-rig", "name it under objects of the rig in --out")
    add_number(
        command,
        "--seconds",
        "S",
        "how many seconds a live motion may take at most",
        number(5.0),
        default=60.0,
    )
    add_results(command, "beads and residuals")
    add_bus(command)
