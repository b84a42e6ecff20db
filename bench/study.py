"""`python -m bench study`: the paper's study repeated with simulated people, or of given recordings."""

import os
import time
from argparse import ArgumentParser, Namespace, RawDescriptionHelpFormatter
from collections.abc import Callable, Sequence
from pathlib import Path

from common.calibration import CameraCalibration, HandProfile, RigCalibration, load
from common.errors import CalibrationError, PhalanxError
from common.option_types import whole
from common.terminal import echo
from master.commands.options import add_calibration
from master.study.one import CAUSES, Condition, Task
from master.study.paper import BLOCKS, PARTICIPANTS
from master.study.run import Study, finish, recorded, simulate

_ABOUT = """\
Repeat the paper's study: people of different hands, six poses, several blocks, errors and repeatability.

Each simulated person does the guided motion of the calibration, then the poses in random order. Everything goes
through the real line: rendered frames, the slave's detection, calibration, this master. The study is open loop;
the paper's was closed loop.

Of recordings the same tables are made from their truth: truth.npz with angles, and trials.csv with the columns
block,pose,from_ns,to_ns (docs/study.md)."""
_EXAMPLES = """\
examples:
  python -m bench study --out out/study
  python -m bench study --causes --out out/study                   where errors come from
  python -m bench study --solver-mode fk --resume detections --out out/study     solve again
  python -m bench study --participants 2 --blocks 2 --known all --out out/small
  python -m bench study recordings/anna recordings/ben --hand me.json --out out/people"""


def main(words: Sequence[str]) -> int:
    """Run the study; the exit code."""
    try:
        study(parser().parse_args(words))
    except PhalanxError as error:
        echo(f"study: {error}", error=True)
        return 1
    return 0


def parser() -> ArgumentParser:
    """The parser of its options."""
    study = ArgumentParser(
        "python -m bench study",
        description=_ABOUT,
        epilog=_EXAMPLES,
        formatter_class=RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    add = study.add_argument
    add(
        "recordings",
        nargs="*",
        type=Path,
        metavar="RECORDINGS",
        help="recordings of wrist devices instead of simulated people: each one participant, with truth.npz "
        "and trials.csv (or the key label in truth.npz)",
    )
    add(
        "--out",
        type=Path,
        default=Path("out/study"),
        metavar="DIR",
        help="folder for study.json, study.md, study.png and all files (default: %(default)s)",
    )
    add(
        "--participants",
        type=whole(1, 99),
        default=PARTICIPANTS,
        metavar="N",
        help="simulated people (default: %(default)s)",
    )
    add(
        "--blocks",
        type=whole(1, 50),
        default=BLOCKS,
        metavar="N",
        help="how often each makes the six poses (default: %(default)s)",
    )
    add(
        "--seed",
        type=whole(0),
        default=1,
        metavar="N",
        help="same seed, same people, same poses (default: %(default)s)",
    )
    add(
        "--known",
        choices=("all", "calibrated", "nothing"),
        default="calibrated",
        help="of the participants: bones and mounting as our own calibration finds them (calibrated), "
        "exactly (all), or the rig's usual hand and its file's mounting (nothing) (default: "
        "%(default)s)",
    )
    add(
        "--causes",
        action="store_true",
        help="judge all trials also with everything known, with nothing known, and with exact laser points "
        "and tips: where does the error come from?",
    )
    add(
        "--solver-mode",
        choices=("fk", "ik", "auto"),
        help="fingers from the laser alone, from laser and fingertip, or from what there is; default: the "
        "rig's",
    )
    add(
        "--rig",
        default="wrist",
        metavar="RIG",
        help="wrist rig: a file of CALIBRATION/rigs, without .json (default: %(default)s)",
    )
    add(
        "--hand",
        type=Path,
        metavar="FILE",
        help="of recordings: the hand file; default: what their rig names, in CALIBRATION/hands",
    )
    add_calibration(study)
    add(
        "--jobs",
        type=whole(0, 64),
        default=0,
        metavar="N",
        help="participants at a time; 0: as many as there are cores (default: %(default)s)",
    )
    add(
        "--step",
        type=whole(1, 8),
        default=2,
        metavar="N",
        help="rendering: px between the rays that shade skin (default: %(default)s)",
    )
    add(
        "--guided",
        type=whole(16, 480),
        default=96,
        metavar="N",
        help="triples of the guided motion before the trials (default: %(default)s)",
    )
    add(
        "--resume",
        choices=("frames", "detections"),
        help="take from --out what an earlier study of the same settings left: frames (of --keep; detect, "
        "calibrate and solve anew), or detections (solve anew)",
    )
    add("--keep", action="store_true", help="keep all frames to look at: 140 MB for each participant")
    return study


def study(options: Namespace) -> None:
    """Simulate it, or judge recordings.

    Raises:
        PhalanxError: A file is missing or broken, or an option has no meaning.
    """
    if options.recordings:
        result = recorded(
            options.recordings,
            lambda name: _hand(options.hand, options.calibration, name),
            options.solver_mode,
            options.out,
            _progress(),
        )
    else:
        if options.hand is not None:
            raise CalibrationError("--hand: is for recordings; simulated people have hands of their own")
        judged: Condition = (options.known, "detected")
        conditions = tuple(dict.fromkeys((judged, *CAUSES))) if options.causes else (judged,)
        device = _device(options.rig, options.calibration)
        task = Task(
            *device,
            options.seed,
            options.blocks,
            conditions,
            options.solver_mode,
            options.step,
            options.guided,
            options.out,
            options.resume,
            options.keep,
        )
        workers = options.jobs or min(os.cpu_count() or 1, options.participants)
        people = f"{options.participants} participants x {options.blocks} blocks x 6 poses"
        echo(f"study: {people}, {workers} at a time, into {options.out}", error=True)
        result = simulate(Study(task, options.participants, workers, judged), _progress())
    for line in finish(result, options.out):
        echo(line)
    echo(f"\nwrote {options.out / 'study.json'}, {options.out / 'study.md'}, {options.out / 'study.png'}")


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

    def tell(done: int, total: int, what: str) -> None:
        spent = time.monotonic() - begun
        left = f", about {_spell(spent * (total - done) / done)} left" if done < total else ""
        echo(f"study: {what} done, {done} of {total} after {_spell(spent)}{left}", error=True)

    return tell


def _spell(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 90.0 else f"{seconds / 60.0:.1f} min"
