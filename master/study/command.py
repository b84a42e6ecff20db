"""`phalanx-master evaluate study`: the paper's study repeated with simulated people, or of given recordings."""

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from common.calibration import CameraCalibration, HandProfile, RigCalibration, load
from common.errors import CalibrationError
from master.options import CALIB_JSON, Calibration
from master.study.line import SolverMode
from master.study.one import CAUSES, Condition, Task
from master.study.one import Resume as From
from master.study.paper import BLOCKS, PARTICIPANTS
from master.study.participant import Known

Recordings = Annotated[
    list[Path] | None,
    typer.Argument(
        help="Recordings of wrist devices instead of simulated people: each one participant, with truth.npz and"
        " trials.csv (or the key label in truth.npz).",
        show_default=False,
    ),
]
Out = Annotated[Path, typer.Option(help="Folder for study.json, study.md, study.png and all files.")]
Participants = Annotated[int, typer.Option(min=1, max=99, help="Simulated people.")]
Blocks = Annotated[int, typer.Option(min=1, max=50, help="How often each makes the six poses.")]
Seed = Annotated[int, typer.Option(min=0, help="Same seed, same people, same poses.")]
KnownOf = Annotated[
    Known,
    typer.Option(
        help="Of the participants: bones and mounting as our own calibration finds them (calibrated), exactly (all), or"
        " the rig's usual hand and its file's mounting (nothing)."
    ),
]
Causes = Annotated[
    bool,
    typer.Option(
        help="Judge all trials also with everything known, with nothing known, and with exact laser points and tips:"
        " where does the error come from?"
    ),
]
ModeOf = Annotated[
    SolverMode | None,
    typer.Option(
        help="Fingers from the laser alone, from laser and fingertip, or from what there is; default: the rig's."
    ),
]
Rig = Annotated[str, typer.Option(help="Wrist rig: a file of CALIBRATION/rigs, without .json.")]
Hand = Annotated[
    Path | None,
    typer.Option(help="Of recordings: the hand file; default: what their rig names, in CALIBRATION/hands."),
]
Jobs = Annotated[
    int, typer.Option(min=0, max=64, help="Participants at a time; 0: as many as there are cores.")
]
Step = Annotated[int, typer.Option(min=1, max=8, help="Rendering: px between the rays that shade skin.")]
Guided = Annotated[int, typer.Option(min=16, max=480, help="Triples of the guided motion before the trials.")]
Resume = Annotated[
    From | None,
    typer.Option(
        help="Take from --out what an earlier study of the same settings left: frames (of --keep; detect, calibrate and"
        " solve anew), or detections (solve anew).",
        show_default=False,
    ),
]
Keep = Annotated[bool, typer.Option(help="Keep all frames to look at: 140 MB for each participant.")]


def evaluate_app() -> typer.Typer:
    """The commands as one program, to be put under a name."""
    app = typer.Typer(no_args_is_help=True, add_completion=False, callback=_about)
    app.command("study")(study)
    return app


def study(
    recordings: Recordings = None,
    out: Out = Path("out/study"),
    participants: Participants = PARTICIPANTS,
    blocks: Blocks = BLOCKS,
    seed: Seed = 1,
    known: KnownOf = "calibrated",
    causes: Causes = False,
    solver_mode: ModeOf = None,
    rig: Rig = "wrist",
    hand: Hand = None,
    calibration: Calibration = CALIB_JSON,
    jobs: Jobs = 0,
    step: Step = 2,
    guided: Guided = 96,
    resume: Resume = None,
    keep: Keep = False,
) -> None:
    """Repeat the paper's study: people of different hands, six poses, several blocks, errors and repeatability.

    Each simulated person does the guided motion of the calibration, then the poses in random order. Everything goes
    through the real line: rendered frames, `phalanx-slave detect`, calibration, this master. The study is open loop;
    the paper's was closed loop.

    Of recordings the same tables are made from their truth: truth.npz with angles, and trials.csv with the columns
    block,pose,from_ns,to_ns (docs/study.md).

    Examples:

      phalanx-master evaluate study --out out/study

      phalanx-master evaluate study --causes --out out/study                   where errors come from

      phalanx-master evaluate study --solver-mode fk --resume detections --out out/study     solve again

      phalanx-master evaluate study --participants 2 --blocks 2 --known all --out out/small

      phalanx-master evaluate study recordings/anna recordings/ben --hand me.json --out out/people
    """
    from master.study.run import Study, finish, recorded, simulate

    if recordings:
        result = recorded(
            recordings, lambda name: _hand(hand, calibration, name), solver_mode, out, _progress()
        )
    else:
        if hand is not None:
            raise CalibrationError("--hand: is for recordings; simulated people have hands of their own")
        judged: Condition = (known, "detected")
        conditions = tuple(dict.fromkeys((judged, *CAUSES))) if causes else (judged,)
        device = _device(rig, calibration)
        task = Task(*device, seed, blocks, conditions, solver_mode, step, guided, out, resume, keep)
        workers = jobs or min(os.cpu_count() or 1, participants)
        people = f"{participants} participants x {blocks} blocks x 6 poses"
        typer.echo(f"study: {people}, {workers} at a time, into {out}", err=True)
        result = simulate(Study(task, participants, workers, judged), _progress())
    for line in finish(result, out):
        typer.echo(line)
    typer.echo(f"\nwrote {out / 'study.json'}, {out / 'study.md'}, {out / 'study.png'}")


def _hand(file: Path | None, calibration: Path, name: str) -> tuple[Path, HandProfile]:
    """File and content of the hand of a recording."""
    found = file or calibration / "hands" / f"{name}.json"
    if not found.exists():
        raise CalibrationError(f"{found}: no such hand profile: give --hand FILE")
    return found, load(found, HandProfile)


def _device(name: str, calibration: Path) -> tuple[RigCalibration, CameraCalibration, HandProfile]:
    """Rig, camera and usual hand."""
    rig = load(calibration / "rigs" / f"{name}.json", RigCalibration)
    if rig.kind != "wrist":
        raise CalibrationError(f"--rig {name}: kind is {rig.kind!r}; the study is of a wrist device")
    if rig.T_camera_palm is None:
        raise CalibrationError(f"--rig {name}: T_camera_palm is missing: people wear the device about there")
    camera = load(calibration / "cameras" / f"{rig.cameras[0]}.json", CameraCalibration)
    return rig, camera, load(calibration / "hands" / f"{rig.hand}.json", HandProfile)


def _progress() -> Callable[[int, int, str], None]:
    """Says who is done and about how long the rest takes, from now on."""
    begun = time.monotonic()

    def show(done: int, total: int, what: str) -> None:
        spent = time.monotonic() - begun
        left = f", about {_spell(spent * (total - done) / done)} left" if done < total else ""
        typer.echo(f"study: {what} done, {done} of {total} after {_spell(spent)}{left}", err=True)

    return show


def _spell(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 90.0 else f"{seconds / 60.0:.1f} min"


def _about() -> None:
    """Judge the whole line against truth."""
