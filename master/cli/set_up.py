"""Options of `phalanx camera` and `phalanx gestures`."""

from argparse import ArgumentParser
from pathlib import Path

from common.option_types import number, whole
from master.commands.options import add_bus, add_calibration


def camera(command: ArgumentParser) -> None:
    """Show how a running camera is set, or set it otherwise.

    At once, read back, compared.

    What the camera does not take is refused by name, and it goes back to what it had.

    Examples:
      phalanx camera left
      phalanx camera left --exposure-us 4000 --gain 2
      phalanx camera left --colour-gains 1.1,1.6 --save
      phalanx camera left --rate-hz 30 --roi-margin 0.08
      phalanx camera left --pick index@310,204 --save
      phalanx camera left --load new/left.json --save
    """
    command.add_argument("name", metavar="NAME", help="name of a camera whose slave is running")
    command.add_argument("--exposure-us", type=number(), metavar="US", help="exposure in microseconds")
    command.add_argument("--gain", type=number(), metavar="N", help="analogue gain")
    command.add_argument("--colour-gains", metavar="RED,BLUE", help="gains of red and blue relative to green")
    command.add_argument("--rate-hz", type=number(), metavar="HZ", help="frames a second")
    command.add_argument(
        "--roi-margin",
        type=number(),
        metavar="N",
        help="how far a marker may be from where it is expected, share of the width",
    )
    command.add_argument(
        "--pick",
        metavar="MARKER@U,V",
        help="colour of a marker from a pixel on its paint, in the newest frame",
    )
    command.add_argument(
        "--load",
        dest="load_file",
        type=Path,
        metavar="FILE",
        help="camera file to use in place of the present content",
    )
    command.add_argument(
        "--save", action="store_true", help="write what is in use to the slave's camera file"
    )
    add_bus(command)


def gestures(command: ArgumentParser) -> None:
    """List the poses that a hand is known by, and what is asked of each.

    Or teach one, forget one, or list which gestures
    a recorded hand makes, from when to when.

    To teach a pose, show it a few times before a running master, or give its time in a recorded run. The hand is
    known by it at once: a running master follows the file. A pose too similar to another is refused, and the
    file stays as it was.

    Examples:
      phalanx gestures
      phalanx gestures --teach thumbs_up
      phalanx gestures --teach vulcan --within open_palm --examples 8
      phalanx gestures --teach horns --poses out/poses.npz --range 1.0-1.8 --range 4.2-5 --range 7.5-8.1
      phalanx gestures --forget horns
      phalanx gestures --poses out/demo/poses.npz                            the gestures of a recorded hand
      phalanx gestures --poses out/poses.npz --settings mine.json --hand me.json --every
    """
    what = command.add_mutually_exclusive_group()
    what.add_argument("--teach", metavar="NAME", help="teach this pose; one of that name is replaced")
    what.add_argument("--forget", metavar="NAME", help="take this pose out of the file")
    command.add_argument(
        "--poses",
        type=Path,
        metavar="FILE",
        help="poses.npz of a run: report its gestures; with --teach, where the examples are, each in a "
        "--range",
    )
    command.add_argument(
        "--every", action="store_true", help="with --poses: every message as a line of JSON, too"
    )
    command.add_argument(
        "--examples",
        type=whole(3, 10),
        default=5,
        metavar="N",
        help="with --teach: how many, before a running master (default: %(default)s)",
    )
    command.add_argument(
        "--range",
        dest="ranges",
        action="append",
        default=[],
        metavar="FROM-TO",
        help="with --teach: seconds after the first pose of --poses; once for each example",
    )
    command.add_argument(
        "--within",
        metavar="NAME",
        help="with --teach: the pose is a special case of this one, and wins where both fit",
    )
    command.add_argument(
        "--settings",
        type=Path,
        metavar="FILE",
        help="gestures file (default: CALIBRATION/gestures/default.json)",
    )
    command.add_argument(
        "--out",
        type=Path,
        metavar="FILE",
        help="with --teach: gestures file to write (default: the one that was read)",
    )
    command.add_argument(
        "--hand",
        type=Path,
        metavar="FILE",
        help="hand profile (default: the one that the poses name, in CALIBRATION/hands)",
    )
    command.add_argument(
        "--hand-name",
        metavar="NAME",
        help="with --teach: of two hands before a running master, the one that shows it",
    )
    add_calibration(command, "gestures/ and hands/")
    add_bus(command)
