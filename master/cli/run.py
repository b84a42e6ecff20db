"""Options of `phalanx run`, `replay`, `record`, `play`, `export` and `send`.

Options of `phalanx run` and `phalanx replay`.

Options of `phalanx record`, `play`, `export` and `send`.
"""

from argparse import SUPPRESS, ArgumentParser
from pathlib import Path

from common.command_line import number
from master.commands.options import (
    add_bus,
    add_calibration,
    add_hand,
    add_joints,
    add_json,
    add_link,
    add_rigs,
    add_site,
    add_span,
)


def run(command: ArgumentParser) -> None:
    """Track live until Ctrl-C.

    Hands, objects, contact and gestures go to the bus (phalanx/hand/<name>, .../object/...)
    and, if asked, to files.

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
    command.add_argument(
        "--start-timeout-s",
        type=number(),
        default=5.0,
        metavar="S",
        help="how long the first camera waits for the others (default: %(default)s)",
    )
    command.add_argument(
        "--poses",
        type=Path,
        metavar="FILE",
        help="write every pose to this .npz; of a second hand beside it, with its name, and in the same folder "
        "object_NAME.npz, contact_HAND_NAME.npz and gestures.jsonl",
    )
    command.add_argument(
        "--summary", type=Path, metavar="FILE", help="write the figures of the run to this .json"
    )
    command.add_argument(
        "--record",
        type=Path,
        metavar="FILE",
        help="record all that is taken and solved to this .mcap, from the first message on: `play` solves it again, "
        "bit for bit",
    )
    command.add_argument(
        "--set",
        dest="changes",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="try another number of the estimator, such as estimator.tracked_m=0.015; a wrong name lists all",
    )
    service = command.add_mutually_exclusive_group()
    service.add_argument(
        "--install", action="store_true", help="install it with these options as a service of this user"
    )
    service.add_argument("--uninstall", action="store_true", help="stop the service, and remove it")
    command.add_argument(
        "--dry-run", action="store_true", help="of --install and --uninstall: write nothing; print the unit"
    )


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
    command.add_argument(
        "paths",
        type=Path,
        nargs="*",
        metavar="RECORDING|VIDEO|FILE.mcap",
        help="folder with recording.json; or a video or a folder of pictures for each camera, or a folder of these; or "
        "a recording of messages",
    )
    command.add_argument(
        "--camera",
        action="append",
        default=[],
        metavar="NAME=PATH",
        help="whose a video or folder is (default: that of its name, else in the order of the rig)",
    )
    command.add_argument(
        "--rig",
        action="append",
        default=[],
        metavar="NAME",
        help="of videos: rig in DIR/rigs (default: the one with these cameras); of a recording: once for each of its "
        "rigs that is solved (default: all)",
    )
    command.add_argument(
        "--times",
        type=Path,
        metavar="FILE.csv",
        help="of videos: when each frame was taken; camera,frame,time",
    )
    command.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the results")
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
    command.add_argument(
        "--calibration",
        type=Path,
        metavar="DIR",
        help="calib_json tree: marker colours, hands, gestures, and objects that the recording does not carry; of "
        "videos also cameras and rig",
    )
    command.add_argument(
        "--hand", type=Path, metavar="FILE", help="hand profile; default: DIR/hands/<rig's hand>.json"
    )
    command.add_argument(
        "--only",
        choices=("markers", "wrist"),
        help="of a recording of both: the cameras, or the wrist device alone",
    )
    command.add_argument(
        "--solver-mode",
        choices=("fk", "ik", "auto"),
        help="fingers before a wrist device from the laser alone (fk), from laser and fingertip (ik), or from what "
        "there is (auto); default: what its rig says",
    )
    command.add_argument(
        "--solver",
        choices=("estimator", "fabrik"),
        help="of markers the hand of disparity, depth law, 1 € filter and FABRIK (fabrik), or the one that is fitted "
        "to all pixels from there (estimator); default: what its rig says",
    )


def record(command: ArgumentParser) -> None:
    """Record what a running master receives and solves, in one MCAP file.

    The file carries the rig's calibration. A process of its own:
    it waits for the master, goes on when that was started again, and never slows the tracking.

    Ctrl-C ends the file. A disk that is full ends it too, with exit code 1; what was written is readable. A replay is
    what was solved live, bit for bit, where the master was started with `run --record FILE`; a recording that began
    later is near to it once filters have settled. Raw frames of one camera: `phalanx-slave record`.

    Examples:
      phalanx record out/wave.mcap --rig desk
      phalanx record out/wave.mcap --rig desk --rig wrist --seconds 60
      phalanx record out/wave.mcap --rig desk --frames 2 --previews --reserve-mb 1000
      phalanx record out/wave.mcap --rig desk --raw
    """
    command.add_argument("file", type=Path, metavar="FILE.mcap", help="the recording")
    add_rigs(command)
    add_calibration(command)
    add_hand(command)
    command.add_argument("--seconds", type=number(0.0), metavar="S", help="length (default: until Ctrl-C)")
    add_bus(command)
    command.add_argument(
        "--frames",
        type=number(0.0, 30.0),
        default=0.0,
        metavar="HZ",
        help="keep whole frames of each camera, so many a second (default: %(default)g)",
    )
    command.add_argument("--previews", action="store_true", help="keep the small pictures of the cameras")
    command.add_argument(
        "--reserve-mb",
        type=number(0.0),
        default=200.0,
        metavar="MB",
        help="stay free on the disk (default: %(default)g)",
    )
    command.add_argument(
        "--raw",
        action="store_true",
        help="have every slave with --raw-folder keep its raw frames, in DIR/FILE'S NAME-CAMERA",
    )
    # A name to be announced when ready; then it ends with its standard input, too.
    command.add_argument("--owned", help=SUPPRESS)


def play(command: ArgumentParser) -> None:
    """Play a recording as if its master were live.

    What the master received is solved again, with the files that it carries, and goes to the bus as
    from a live master. At the end stands a SHA-256 of all poses: it is the same at any speed.

    While it plays, the bus answers the commands pause, resume, seek and speed. After a jump, and with --from, the two
    seconds before are solved silently, so that filters have settled; what follows is near to that of a whole pass,
    not equal to it.

    Examples:
      phalanx play out/wave.mcap
      phalanx play out/wave.mcap --speed max --no-bus --out out/wave
      phalanx play out/wave.mcap --speed 0.5 --from 10 --to 20 --loop
    """
    command.add_argument("file", type=Path, metavar="FILE.mcap", help="the recording")
    command.add_argument(
        "--speed",
        default="1",
        metavar="FACTOR",
        help="1: as it was; 0.5: half as fast; max: as fast as it goes (default: %(default)s)",
    )
    add_span(command, "", "--to")
    add_bus(command)
    command.add_argument("--no-bus", action="store_true", help="publish nothing; with --out, or for the sums")
    command.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="folder for poses.npz and what else there is, as of `run --poses`",
    )
    command.add_argument("--loop", action="store_true", help="begin again at the end, until Ctrl-C")
    command.add_argument(
        "--solved", action="store_true", help="publish what was solved live, instead of solving it again"
    )


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
    command.add_argument(
        "source", type=Path, metavar="SOURCE", help="poses.npz of a run or a replay, or an .mcap recording"
    )
    command.add_argument(
        "--to",
        choices=("csv", "parquet", "bvh", "gltf", "rrd"),
        help="csv, parquet: tables. bvh: motion capture. gltf: an animated, skinned hand. rrd: for Rerun",
    )
    command.add_argument(
        "--compare",
        type=Path,
        metavar="FILE",
        help="instead of --to: errors of the poses against motion capture of that hand, .csv, .tsv, .bvh, "
        ".c3d",
    )
    command.add_argument(
        "--out",
        "-o",
        type=Path,
        metavar="PATH",
        help="file of the first hand, or folder. What else there is stands beside it, with a name behind its own: of "
        "another hand, object_NAME, contact_HAND_NAME, gestures (default: beside SOURCE)",
    )
    command.add_argument(
        "--only", action="append", default=[], metavar="NAME", help="this hand; once for each (default: all)"
    )
    command.add_argument(
        "--hand",
        action="append",
        default=[],
        type=Path,
        metavar="FILE",
        help="hand profile, for bvh, gltf, rrd (default: that of an .mcap, else of CALIBRATION/hands)",
    )
    add_calibration(command)
    command.add_argument(
        "--rig",
        action="append",
        default=[],
        metavar="NAME",
        help="of an rrd: rig of CALIBRATION/rigs; an .mcap knows its own; once for each. Of --compare: whose markers "
        "the poses have",
    )
    command.add_argument(
        "--rate",
        type=number(0.1, 1000.0),
        metavar="HZ",
        help="frames a second of bvh and gltf (default: that of the poses); of a --compare table without "
        "times",
    )
    add_span(command, " of SOURCE", "--until")
    command.add_argument(
        "--unit",
        choices=("m", "cm", "mm"),
        help="of length in a bvh, default cm (all others have metres); in --compare FILE, default as FILE says",
    )
    command.add_argument(
        "--up",
        choices=("y", "rig"),
        help="of bvh and gltf. y (default): y up in the reference camera's picture, z out of it. rig: its own, y down, "
        "z into the scene",
    )
    add_joints(command)
    command.add_argument(
        "--side", choices=("left", "right"), help="of --compare: which hand of a file with both"
    )
    command.add_argument(
        "--aligned",
        action="store_true",
        help="FILE of --compare has the rig's frame, and the poses' clock or seconds from the beginning of SOURCE "
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
    command.add_argument(
        "--outputs",
        default="default",
        metavar="NAME",
        help="a file of CALIBRATION/outputs, without .json (default: %(default)s)",
    )
    command.add_argument("--only", metavar="NAMES", help="send to these, by commas, whatever the file has on")
    add_calibration(command, "outputs/")
    add_bus(command)
    add_site(command)
