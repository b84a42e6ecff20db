"""Options of `phalanx record`, `play`, `export` and `send`."""

from argparse import SUPPRESS, ArgumentParser
from pathlib import Path

from common.option_types import number
from master.commands.options import (
    add_bus,
    add_calibration,
    add_hand,
    add_joints,
    add_json,
    add_rigs,
    add_site,
    add_span,
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
