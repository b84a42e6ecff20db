"""`phalanx-master solve`: recorded detections to hands, the same bytes on every run."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from common.frame_recording import open_recording
from master.options import Hand
from master.rig import setups_with_hands
from master.solve import rigs_to_solve, solve_hands
from master.terminal import print_line, progress

SolverMode = Literal["fk", "ik", "auto"]
Solver = Literal["estimator", "fabrik"]
Kind = Literal["markers", "wrist"]


def solve(
    recording: Annotated[Path, typer.Argument(help="Folder of a raw-frame recording.")],
    detections: Annotated[Path, typer.Option(help="Folder with detections_<camera>.npz, tags_<camera>.npz.")],
    out: Annotated[
        Path, typer.Option(help="Folder for poses.npz, summary.json, and what else there is: see below.")
    ],
    calibration: Annotated[
        Path | None,
        typer.Option(help="Folder with hands/, gestures/, and objects/ that the recording does not carry."),
    ] = None,
    hand: Hand = None,
    rig_names: Annotated[
        list[str] | None,
        typer.Option("--rig", help="Rig of the recording; once for each that is to be solved; default: all."),
    ] = None,
    only: Annotated[
        Kind | None,
        typer.Option(
            help="Of a recording of both kinds: what the cameras, or what the wrist device tells alone."
        ),
    ] = None,
    solver_mode: Annotated[
        SolverMode | None,
        typer.Option(
            help="Of a wrist device: fingers from the laser alone (fk), from laser and fingertip (ik), or from what "
            "there is (auto); default: what the rig says."
        ),
    ] = None,
    solver: Annotated[
        Solver | None,
        typer.Option(
            help="Of a rig of markers: the hand of disparity, depth law, 1 € filter and FABRIK (fabrik), or the one "
            "that is fitted to all pixels from there (estimator); default: what the rig says."
        ),
    ] = None,
) -> None:
    """Solve recorded detections offline and deterministically: no clock, no network.

    Cameras and wrist device of one hand make one poses.npz together. Of a second hand there is poses-HAND.npz. Beside
    them stand object_NAME.npz and contact_HAND_NAME.npz of tracked objects, and gestures.jsonl, a Gesture a line.

    Examples:

      phalanx-master solve RECORDING --detections DIR --out DIR

      phalanx-master solve GRASP --detections DIR --out DIR/markers --only markers

      phalanx-master solve CURL --detections DIR --out DIR --hand HAND.json --solver-mode fk
    """
    opened = open_recording(recording)
    rigs = rigs_to_solve(opened.manifest, rig_names or [], only, solver_mode, solver)
    setups = setups_with_hands(rigs, opened.manifest.cameras, calibration, hand, opened.manifest.objects)
    out.mkdir(parents=True, exist_ok=True)
    solve_hands(opened, setups, detections, out, lambda done, total: progress("solving", done, total))
    print_line(f"wrote {out / 'poses.npz'} and {out / 'summary.json'}")
