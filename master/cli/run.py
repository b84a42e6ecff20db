"""Options of `phalanx run`, `replay`, `record`, `play`, `export` and `send`."""

from argparse import SUPPRESS, ArgumentParser
from pathlib import Path

from common.command_line import number
from master.commands.options import (
    add_bus,
    add_calibration,
    add_choice,
    add_flag,
    add_hand,
    add_joints,
    add_json,
    add_link,
    add_names,
    add_number,
    add_path,
    add_rigs,
    add_site,
    add_span,
    add_text,
)


def run(command: ArgumentParser) -> None:
    """Track live until Ctrl-C.

    Hands, objects, contact and gestures go to the bus (phalanx/hand/<name>, .../object/...) and, if asked, to files.

    Several rigs of one hand are one hand: cameras that watch its markers and the device on its wrist are solved
    together. Rigs of two hands are two hands, each published under its own name. The files of rigs, cameras, hands,
    objects and gestures are followed: what changes there is used at once.

    With --install it becomes a service of this user, without root: started at login, and again after a fault. All
    options are checked before anything is written. With other options it is installed again, with the same ones nothing
    changes. Keys stay where they are: the unit has the path of their folder alone. `systemctl --user status
    phalanx-master` shows how it is, `journalctl --user -u phalanx-master` what it logged.

    Examples:
      phalanx run --rig desk
      phalanx run --rig desk --rig wrist
      phalanx run --rig desk --rig wrist-left
      phalanx run --rig desk-wand --poses out/poses.npz
      phalanx run --rig desk --record out/wave.mcap
      phalanx run --rig desk --keys DIR --beacon 192.168.1.255:47800 --bind 0.0.0.0:47801 --bus tls/0.0.0.0:47802
      phalanx run --rig desk --rig wrist --install --dry-run
      phalanx run --keys DIR --beacon 192.168.1.255:47800 --bind 0.0.0.0:47801 --bus tls/0.0.0.0:47802 --install
      phalanx run --uninstall
    """
    add_rigs(command)
    add_calibration(command)
    add_hand(command)
    add_link(command)
    add_bus(command)
    add_number(
        command, "--start-timeout-s", "S", "how long the first camera waits for the others", default=5.0
    )
    add_path(
        command,
        "--poses",
        "FILE",
        "write every pose to this .npz; of a second hand beside it, with its name, and in the same folder "
        "object_NAME.npz, contact_HAND_NAME.npz and gestures.jsonl",
    )
    add_path(command, "--summary", "FILE", "write the figures of the run to this .json")
    add_path(
        command,
        "--record",
        "FILE",
        "record all that is taken and solved to this .mcap, from the first message on: `play` solves it again, "
        "bit for bit",
    )
    add_names(
        command,
        "--set",
        "NAME=VALUE",
        "try another number of the estimator, such as estimator.tracked_m=0.015; a wrong name lists all",
        dest="changes",
    )
    service = command.add_mutually_exclusive_group()
    service.add_argument(
        "--install", action="store_true", help="install it with these options as a service of this user"
    )
    service.add_argument("--uninstall", action="store_true", help="stop the service, and remove it")
    add_flag(command, "--dry-run", "of --install and --uninstall: write nothing; print the unit")


def replay(command: ArgumentParser) -> None:
    """Make hands of recorded frames, detections, messages or your own videos.

    Detects markers, or fingers before a wrist device, in every camera's frames, solves the hand of what all of them
    see, scores it where there is a truth. Offline and deterministic: no clock, no network, the same bytes on every run.

    Cameras and wrist device of one hand make one poses.npz together. Of a second hand there is poses-HAND.npz. Beside
    them stand detections_CAMERA.npz, object_NAME.npz and contact_HAND_NAME.npz of tracked objects, and gestures.jsonl,
    a Gesture a line. Of a recording of messages (.mcap) the same is made of the messages; --speed, and to play it to
    the bus: `phalanx play`.

    Examples:
      phalanx replay RECORDING --out out/replay     the same line on recorded frames, the same bytes on every run
      phalanx replay left.mp4 right.mp4 --calibration calib_json --out out/wave      your own videos, one per camera
      phalanx replay takes/7 --times takes/7/times.csv --calibration calib_json --out out/take7
                                                    a folder with a video, or a folder of pictures, for each camera; the
                                                    table: camera,frame,time (frames from 0, seconds)
      phalanx replay --camera left=GOPR0012.MP4 --camera right=GOPR0944.MP4 --calibration calib_json --out out/gopro
      phalanx replay CURL --hand HAND.json --out out/curl       recorded frames of a wrist device
      phalanx replay GRASP --out out/grasp          cameras and wrist device of one hand, solved together
      phalanx replay GRASP --only markers --out out/grasp-markers    without the wrist device, to compare
      phalanx replay CURL --hand HAND.json --solver-mode fk --out out/fk   its fingers from the laser alone, to compare
      phalanx replay RECORDING --detect-only --out found             only detections_CAMERA.npz, for calibrations
      phalanx replay RECORDING --detections found --out out/again    solves what was detected before
      phalanx replay out/wave.mcap --out out/wave                    recorded messages
    """
    _what_is_replayed(command)
    _what_is_detected(command)
    _how_it_is_solved(command)


def _what_is_replayed(command: ArgumentParser) -> None:
    add_path(
        command,
        "paths",
        "RECORDING|VIDEO|FILE.mcap",
        "folder with recording.json; or a video or a folder of pictures for each camera, or a folder of these; or "
        "a recording of messages",
        nargs="*",
    )
    add_names(
        command,
        "--camera",
        "NAME=PATH",
        "whose a video or folder is (default: that of its name, else in the order of the rig)",
    )
    add_names(
        command,
        "--rig",
        "NAME",
        "of videos: rig in DIR/rigs (default: the one with these cameras); of a recording: once for each of its "
        "rigs that is solved (default: all)",
    )
    add_path(command, "--times", "FILE.csv", "of videos: when each frame was taken; camera,frame,time")


def _what_is_detected(command: ArgumentParser) -> None:
    add_path(command, "--out", "DIR", "folder for the results", required=True)
    which = command.add_mutually_exclusive_group()
    which.add_argument(
        "--detections",
        type=Path,
        metavar="DIR",
        help="solve what was detected before: detections_CAMERA.npz, tags_CAMERA.npz in this folder",
    )
    which.add_argument(
        "--detect-only",
        action="store_true",
        help="write detections_CAMERA.npz, and solve nothing: cameras need no geometry",
    )


def _how_it_is_solved(command: ArgumentParser) -> None:
    add_path(
        command,
        "--calibration",
        "DIR",
        "calib_json tree: marker colours, hands, gestures, and objects that the recording does not carry; of "
        "videos also cameras and rig",
    )
    add_path(command, "--hand", "FILE", "hand profile; default: DIR/hands/<rig's hand>.json")
    add_choice(
        command,
        "--only",
        ("markers", "wrist"),
        "of a recording of both: the cameras, or the wrist device alone",
    )
    add_choice(
        command,
        "--solver-mode",
        ("fk", "ik", "auto"),
        "fingers before a wrist device from the laser alone (fk), from laser and fingertip (ik), or from what "
        "there is (auto); default: what its rig says",
    )
    add_choice(
        command,
        "--solver",
        ("estimator", "fabrik"),
        "of markers the hand of disparity, depth law, 1 € filter and FABRIK (fabrik), or the one that is fitted "
        "to all pixels from there (estimator); default: what its rig says",
    )


def record(command: ArgumentParser) -> None:
    """Record what a running master receives and solves, in one MCAP file.

    The file carries the rig's calibration. A process of its own: it waits for the master, goes on when that was started
    again, and never slows the tracking.

    Ctrl-C ends the file. A disk that is full ends it too, with exit code 1; what was written is readable. A replay is
    what was solved live, bit for bit, where the master was started with `run --record FILE`; a recording that began
    later is near to it once filters have settled. Raw frames of one camera: `phalanx-slave record`.

    Examples:
      phalanx record out/wave.mcap --rig desk
      phalanx record out/wave.mcap --rig desk --rig wrist --seconds 60
      phalanx record out/wave.mcap --rig desk --frames 2 --previews --reserve-mb 1000
      phalanx record out/wave.mcap --rig desk --raw
    """
    add_path(command, "file", "FILE.mcap", "the recording")
    add_rigs(command)
    add_calibration(command)
    add_hand(command)
    add_number(command, "--seconds", "S", "length (default: until Ctrl-C)", number(0.0))
    add_bus(command)
    frames = "keep whole frames of each camera, so many a second"
    add_number(command, "--frames", "HZ", frames, number(0.0, 30.0), default=0.0)
    add_flag(command, "--previews", "keep the small pictures of the cameras")
    add_number(command, "--reserve-mb", "MB", "stay free on the disk", number(0.0), default=200.0)
    add_flag(
        command, "--raw", "have every slave with --raw-folder keep its raw frames, in DIR/FILE'S NAME-CAMERA"
    )
    # A name to be announced when ready; then it ends with its standard input, too.
    command.add_argument("--owned", help=SUPPRESS)


def play(command: ArgumentParser) -> None:
    """Play a recording as if its master were live.

    What the master received is solved again, with the files that it carries, and goes to the bus as from a live
    master. At the end stands a SHA-256 of all poses: it is the same at any speed.

    While it plays, the bus answers the commands pause, resume, seek and speed. After a jump, and with --from, the two
    seconds before are solved silently, so that filters have settled; what follows is near to that of a whole pass,
    not equal to it.

    Examples:
      phalanx play out/wave.mcap
      phalanx play out/wave.mcap --speed max --no-bus --out out/wave
      phalanx play out/wave.mcap --speed 0.5 --from 10 --to 20 --loop
    """
    add_path(command, "file", "FILE.mcap", "the recording")
    add_text(
        command, "--speed", "FACTOR", "1: as it was; 0.5: half as fast; max: as fast as it goes", default="1"
    )
    add_span(command, "", "--to")
    add_bus(command)
    add_flag(command, "--no-bus", "publish nothing; with --out, or for the sums")
    add_path(command, "--out", "DIR", "folder for poses.npz and what else there is, as of `run --poses`")
    add_flag(command, "--loop", "begin again at the end, until Ctrl-C")
    add_flag(command, "--solved", "publish what was solved live, instead of solving it again")


def export(command: ArgumentParser) -> None:
    """Write recorded hands for other tools.

    Tables, motion capture, an animated model, Rerun.

    Positions read back are those of the poses to 0.1 mm in every format. In tables what was not observed is empty; in a
    motion it stands still, and how often is reported. docs/export.md has columns, axes, and how to open the files in
    Blender, Unity and pandas.

    Examples:
      phalanx export out/demo/poses.npz --to csv
      phalanx export out/wave.mcap --to parquet -o tables
      phalanx export out/demo/poses.npz --to bvh -o wave.bvh --rate 30 --from 2 --until 8
      phalanx export out/demo/poses.npz --to gltf -o wave.glb --hand calib_json/hands/default-right.json
      phalanx export out/demo/poses.npz --to rrd --rig desk
      phalanx export out/me/poses.npz --compare motive.csv --side right --json errors.json
      phalanx export out/demo/poses.npz --compare truth.csv --aligned
    """
    _source_and_target(command)
    _hands_and_rigs(command)
    _motion_and_comparison(command)


def _source_and_target(command: ArgumentParser) -> None:
    add_path(command, "source", "SOURCE", "poses.npz of a run or a replay, or an .mcap recording")
    add_choice(
        command,
        "--to",
        ("csv", "parquet", "bvh", "gltf", "rrd"),
        "csv, parquet: tables. bvh: motion capture. gltf: an animated, skinned hand. rrd: for Rerun",
    )
    add_path(
        command,
        "--compare",
        "FILE",
        "instead of --to: errors of the poses against motion capture of that hand, .csv, .tsv, .bvh, .c3d",
    )
    command.add_argument(
        "--out",
        "-o",
        type=Path,
        metavar="PATH",
        help="file of the first hand, or folder. What else there is stands beside it, with a name behind its own: of "
        "another hand, object_NAME, contact_HAND_NAME, gestures (default: beside SOURCE)",
    )


def _hands_and_rigs(command: ArgumentParser) -> None:
    add_names(command, "--only", "NAME", "this hand; once for each (default: all)")
    add_path(
        command,
        "--hand",
        "FILE",
        "hand profile, for bvh, gltf, rrd (default: that of an .mcap, else of CALIBRATION/hands)",
        action="append",
        default=[],
    )
    add_calibration(command)
    add_names(
        command,
        "--rig",
        "NAME",
        "of an rrd: rig of CALIBRATION/rigs; an .mcap knows its own; once for each. Of --compare: whose markers "
        "the poses have",
    )


def _motion_and_comparison(command: ArgumentParser) -> None:
    add_number(
        command,
        "--rate",
        "HZ",
        "frames a second of bvh and gltf (default: that of the poses); of a --compare table without times",
        number(0.1, 1000.0),
    )
    add_span(command, " of SOURCE", "--until")
    add_choice(
        command,
        "--unit",
        ("m", "cm", "mm"),
        "of length in a bvh, default cm (all others have metres); in --compare FILE, default as FILE says",
    )
    add_choice(
        command,
        "--up",
        ("y", "rig"),
        "of bvh and gltf. y (default): y up in the reference camera's picture, z out of it. rig: its own, y down, "
        "z into the scene",
    )
    add_joints(command)
    add_choice(command, "--side", ("left", "right"), "of --compare: which hand of a file with both")
    add_flag(
        command,
        "--aligned",
        "FILE of --compare has the rig's frame, and the poses' clock or seconds from the beginning of SOURCE "
        "(default: both are fitted)",
    )
    add_json(command)


def send(command: ArgumentParser) -> None:
    """Send hands, objects, contact and gestures to other programs.

    By OSC, VMC, ROS 2, LSL or WebSocket.

    A process of its own, which may come and go; it waits for the master. The file is followed while it runs.

    Examples:
      phalanx send
      phalanx send --only osc,vmc
      phalanx send --outputs stage --keys DIR --bus tls/192.168.1.2:47802
    """
    add_text(command, "--outputs", "NAME", "a file of CALIBRATION/outputs, without .json", default="default")
    add_text(command, "--only", "NAMES", "send to these, by commas, whatever the file has on")
    add_calibration(command, "outputs/")
    add_bus(command)
    add_site(command)
