"""`phalanx-master report`: a simulated run against the truth of its scene."""

from pathlib import Path
from typing import Annotated

import typer

from common.sim.scenes import NAMES
from common.sim.wrist.scene import WRIST_NAMES
from master.options import CALIB_JSON, Calibration, Rigs
from master.outputs.files import path_of_hand
from master.rig import load_setups
from master.summary import read_summary, write_summary
from master.terminal import progress


def report(
    poses: Annotated[Path, typer.Option(help="poses.npz of the run.")],
    scene_epoch_ns: Annotated[
        int, typer.Option(help="Scene time 0 on this machine's monotonic clock, in ns.")
    ],
    out: Annotated[Path, typer.Option(help="Folder for hand.png, run.rrd and summary.json.")],
    rig: Rigs,
    scene: Annotated[str, typer.Option(help=f"Scene: {NAMES}; of a wrist rig: {WRIST_NAMES}.")] = "standard",
    seed: Annotated[int, typer.Option(help="Seed of the scene.")] = 7,
    calibration: Calibration = CALIB_JSON,
    summary: Annotated[Path | None, typer.Option(help="summary.json of the run, to be completed.")] = None,
) -> None:
    """Compare a simulated run with the exact truth of its scene; write figures, a picture and a Rerun file.

    `phalanx demo` calls it at the end. Of a second hand the results are in a folder of its name below OUT.

    Examples:

      phalanx-master report --poses out/demo/poses.npz --scene-epoch-ns 123456789 --out out/demo
    """
    from master.report import Played, report_scene

    setups = load_setups(calibration, rig)
    figures = {} if summary is None else read_summary(summary)
    for number, setup in enumerate(setups):
        hand = setup.hand.profile.name
        file, folder = (path_of_hand(poses, hand), out / hand) if number else (poses, out)
        folder.mkdir(parents=True, exist_ok=True)
        played = Played.of(setup, scene, seed)
        full = report_scene(file, setup, played, scene_epoch_ns, folder, figures, progress)
        write_summary(folder / "summary.json", full)
