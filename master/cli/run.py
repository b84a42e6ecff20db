"""Options of `phalanx run` and `phalanx replay`."""

from argparse import ArgumentParser
from pathlib import Path

from common.option_types import number
from master.commands.options import add_bus, add_calibration, add_hand, add_link, add_rigs


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
