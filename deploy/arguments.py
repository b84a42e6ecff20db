"""Command line of `phalanx` as text: commands, options, help. Each command's help shows its own examples."""

import argparse
from pathlib import Path

from deploy.host_options import AddParser, add_commands

_EXAMPLES = {
    "demo": """examples:
  phalanx demo                                  two simulated cameras and the master, in the Rerun viewer
  phalanx demo --console --seconds 600          the console in a browser instead: watch, tune and record the demo
  phalanx demo --headless --seconds 60          without a screen: a picture, an .rrd and the figures
  phalanx demo --wrist                          a simulated wrist device in their place: laser, LEDs, one camera, an IMU
  phalanx demo --scene grasp                    both at once, while a hand closes round a bar: cameras lose its fingers
  phalanx demo --scene grasp --rig desk-back3   the same without the wrist device, to compare
  phalanx demo --scene object                   a wand of painted beads travels before the cameras
  phalanx demo --scene grasp --rig desk-cube    the bar has a cube of tags: where it is, and which fingers touch it
  phalanx demo --scene gestures --seconds 80 --bus tcp/127.0.0.1:47802
                                                pinches, dials, taps and pointing, against what the hand really said
""",
    "replay": """examples:
  phalanx replay RECORDING --out out/replay     the same line on recorded frames, the same bytes on every run
  phalanx replay left.mp4 right.mp4 --calibration calib_json --out out/wave      your own videos, one per camera
  phalanx replay takes/7 --times takes/7/times.csv --calibration calib_json --out out/take7
                                                a folder with a video, or a folder of pictures, for each camera; the
                                                table: camera,frame,time (frames from 0, seconds)
  phalanx replay --camera left=GOPR0012.MP4 --camera right=GOPR0944.MP4 --calibration calib_json --out out/gopro
  phalanx replay CURL --hand HAND.json --out out/curl       recorded frames of a wrist device
  phalanx replay GRASP --out out/grasp          cameras and wrist device of one hand, solved together
  phalanx replay GRASP --only markers --out out/grasp-markers    without what the wrist device tells, to compare
  phalanx replay CURL --hand HAND.json --solver-mode fk --out out/fk   its fingers from the laser alone, to compare
""",
}


def parser() -> argparse.ArgumentParser:
    """The parser of `phalanx`; the command is in `command`."""
    whole = argparse.ArgumentParser(
        prog="phalanx",
        description="Hand tracking from cameras that anyone can buy.",
        epilog="`phalanx COMMAND --help` shows its examples.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = whole.add_subparsers(dest="command", required=True, metavar="COMMAND")
    _add_demo(commands.add_parser)
    _add_replay(commands.add_parser)
    add_commands(commands.add_parser, _calibration())
    return whole


def _add_demo(add_parser: AddParser) -> None:
    demo = add_parser(
        "demo",
        help="everything on this machine, without hardware",
        description="Starts a slave with a synthetic camera for each camera of the rigs, one for each IMU and tracker, "
        "one master for all of them and the viewer.",
        epilog=_EXAMPLES["demo"],
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    view = demo.add_mutually_exclusive_group()
    view.add_argument(
        "--headless", action="store_true", help="no viewer; hand.png and run.rrd are always written"
    )
    view.add_argument("--web", action="store_true", help="the viewer as a page on 127.0.0.1, not a window")
    view.add_argument(
        "--console",
        action="store_true",
        help="the console in the viewer's place: its address is printed, open it in a browser",
    )
    demo.add_argument(
        "--seconds", type=_positive, default=30.0, metavar="N", help="length (default: %(default)s)"
    )
    demo.add_argument("--json", type=Path, metavar="FILE", help="write the summary to FILE as well")
    demo.add_argument(
        "--out", type=Path, default=Path("out/demo"), metavar="DIR", help="default: %(default)s"
    )
    demo.add_argument(
        "--calibration", type=Path, default=_calibration(), metavar="DIR", help="default: %(default)s"
    )
    _add_scene(demo)


def _add_scene(demo: argparse.ArgumentParser) -> None:
    """What is simulated, and where it can be read."""
    rig = demo.add_mutually_exclusive_group()
    rig.add_argument(
        "--rig",
        dest="rigs",
        action="append",
        metavar="NAME",
        help="once for each that runs; default: desk, for scenes of both kinds desk-back3 (three markers on the back "
        "tell how the palm lies) and wrist-back3 of the same hand, for object desk-wand, for gestures desk4; "
        "desk-fabrik is desk with the card's line alone; desk-cube and desk-tracker track objects, too; "
        "--rig desk --rig wrist has one hand",
    )
    rig.add_argument(
        "--wrist", dest="rigs", action="store_const", const=["wrist"], help="the wrist device: --rig wrist"
    )
    demo.add_argument(
        "--bus",
        metavar="ENDPOINT",
        help="where other programs of this machine can read along, as tcp/127.0.0.1:47802 (default: any free port, "
        "encrypted)",
    )
    demo.add_argument("--seed", type=int, default=7, help="of the scene (default: %(default)s)")
    demo.add_argument(
        "--scene",
        default="standard",
        help="standard, lights (it changes), poses, hand-routine (of calibrate hand), object (that is tracked, on its "
        "way), or leap:FILE.npz; of a wrist device "
        "standard, curl, subject, poses, spread or random; of both kinds of rig at once grasp, gestures, both-poses, "
        "both-curl, both-travel or both-moves; the last two kinds each with @dark, @indoor, @bright or @sun",
    )


def _add_replay(add_parser: AddParser) -> None:
    replay = add_parser(
        "replay",
        help="a recording of raw frames, or your own videos, offline",
        description="Detects markers, or fingers before a wrist device, in every camera's frames, solves the hand of "
        "what all of them tell, scores it where there is a truth.",
        epilog=_EXAMPLES["replay"],
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    replay.add_argument(
        "paths",
        type=Path,
        nargs="*",
        metavar="RECORDING|VIDEO",
        help="folder with recording.json; or a video or a folder of pictures for each camera, or a folder of these",
    )
    replay.add_argument(
        "--camera",
        action="append",
        default=[],
        metavar="NAME=PATH",
        help="whose a video or folder is (default: that of its name, else in the order of the rig)",
    )
    replay.add_argument(
        "--rig", metavar="NAME", help="of videos: rig in DIR/rigs (default: the one with these cameras)"
    )
    replay.add_argument(
        "--times",
        type=Path,
        metavar="FILE.csv",
        help="of videos: when each frame was taken; camera,frame,time",
    )
    replay.add_argument("--out", type=Path, required=True, metavar="DIR")
    replay.add_argument(
        "--calibration",
        type=Path,
        metavar="DIR",
        help="calib_json tree: marker colours, hands; of videos also cameras and rig",
    )
    replay.add_argument(
        "--hand", type=Path, metavar="FILE", help="hand profile; default: DIR/hands/<rig's hand>.json"
    )
    replay.add_argument(
        "--only",
        choices=("markers", "wrist"),
        help="of a recording of both: what the cameras, or what the wrist device tells alone",
    )
    replay.add_argument(
        "--solver-mode",
        choices=("fk", "ik", "auto"),
        help="fingers before a wrist device from the laser alone (fk), from laser and fingertip (ik), or from what "
        "there is (auto); default: what its rig says",
    )
    replay.add_argument(
        "--solver",
        choices=("estimator", "fabrik"),
        help="of markers the hand of disparity, depth law, 1 € filter and FABRIK (fabrik), or the one that is fitted "
        "to all pixels from there (estimator); default: what its rig says",
    )


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError as error:  # argparse would tell the name of the function
        raise argparse.ArgumentTypeError(f"{text}: must be a number") from error
    if not 0.0 < value < 1e6:
        raise argparse.ArgumentTypeError("seconds must be positive")
    return value


def _calibration() -> Path:
    """The calib_json of the working directory, else the one beside the source."""
    here = Path("calib_json")
    return here if here.is_dir() else Path(__file__).resolve().parent.parent / "calib_json"
