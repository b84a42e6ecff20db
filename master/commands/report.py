"""`python -m master.commands.report` compares a simulated run with the truth.

What `phalanx demo` calls at its end.
"""

import logging
import sys
from argparse import ArgumentParser
from collections.abc import Sequence
from pathlib import Path

from common.command_line import echo
from common.errors import PhalanxError
from master.commands.options import add_calibration, add_rigs, rigs_of
from master.commands.summary import progress, read_summary, summary_lines, write_summary
from master.outputs.poses import path_of_hand
from master.rig.setup import load_setups


def report(words: Sequence[str]) -> None:
    """Write figures, a picture and a Rerun file, of a second hand in its folder.

    Raises:
        PhalanxError: A file is missing or broken, or there is no such scene.
    """
    from master.evaluation.report import Played, report_scene

    options = _parser().parse_args(words)
    out: Path = options.out
    setups = load_setups(options.calibration, rigs_of(options))
    figures = {} if options.summary is None else read_summary(options.summary)
    for number, setup in enumerate(setups):
        hand = setup.hand.profile.name
        file, folder = (path_of_hand(options.poses, hand), out / hand) if number else (options.poses, out)
        folder.mkdir(parents=True, exist_ok=True)
        others = [one for one in setups if one is not setup and one.rows and setup.rows]
        played = Played.of(setup, options.scene, options.seed, others)
        full = report_scene(file, setup, played, options.scene_epoch_ns, folder, figures, progress)
        write_summary(folder / "summary.json", full)
    echo()
    for line in summary_lines(read_summary(out / "summary.json")):
        echo(f"  {line}")


def _parser() -> ArgumentParser:
    parser = ArgumentParser("master.commands.report", description="Compare a simulated run with its truth.")
    parser.add_argument("--poses", type=Path, required=True, metavar="FILE", help="poses.npz of the run")
    parser.add_argument(
        "--scene-epoch-ns",
        type=int,
        required=True,
        metavar="NS",
        help="scene time 0 on this machine's monotonic clock",
    )
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="for hand.png, run.rrd and summary.json"
    )
    add_rigs(parser)
    parser.add_argument("--scene", default="standard", metavar="NAME", help="scene, as of `phalanx demo`")
    parser.add_argument("--seed", type=int, default=7, metavar="N", help="seed of the scene")
    add_calibration(parser)
    parser.add_argument(
        "--summary", type=Path, metavar="FILE", help="summary.json of the run, to be completed"
    )
    return parser


def main() -> None:
    """Run it; an error is a line."""
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s: %(message)s")
    logging.getLogger("matplotlib").setLevel(logging.WARNING)  # it logs its font cache on the first run
    try:
        report(sys.argv[1:])
    except PhalanxError as error:
        raise SystemExit(f"phalanx: {error}") from error


if __name__ == "__main__":
    main()
