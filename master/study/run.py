"""Runner of a whole study, followed by its tables and picture.

It processes all participants, several at a time, or the trials of given recordings.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

from common.calibration import HandProfile
from common.errors import RecordingError
from common.recording.frame_recording import open_recording
from master.study.line import SolverMode, detect, solved
from master.study.one import Condition, Outcome, Task, name_of, run_participant
from master.study.plot import draw_study
from master.study.report import Result, lines_of, write_study
from master.study.trials import Trial, trials_of

DETECTED = "recorded, detected"


@dataclass(frozen=True, slots=True, eq=False)
class Study:
    """A simulated study: task, participants, parallel jobs and judged condition.

    It holds the task of each participant, how many participants there are, how many run at a time, and which
    condition is judged.
    """

    task: Task
    participants: int
    jobs: int
    judged: Condition


def simulate(study: Study, progress: Callable[[int, int, str], None]) -> Result:
    """Let all participants do everything.

    Args:
        study: What to do.
        progress: Called with how many of how many participants are done, and which was last.

    Raises:
        PhalanxError: Files cannot be written, or a process ended with an error.
    """
    numbers = range(1, study.participants + 1)
    outcomes: dict[int, Outcome] = {}
    if study.jobs == 1:
        for number in numbers:
            outcomes[number] = run_participant(study.task, number)
            progress(len(outcomes), study.participants, outcomes[number].participant)
    else:
        # Fresh interpreters: what OpenCV and BLAS hold in threads does not survive a fork.
        with ProcessPoolExecutor(study.jobs, get_context("spawn")) as pool:
            jobs = {pool.submit(run_participant, study.task, number): number for number in numbers}
            try:
                for job in as_completed(jobs):
                    outcomes[jobs[job]] = job.result()
                    progress(len(outcomes), study.participants, outcomes[jobs[job]].participant)
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise
    ordered = [outcomes[number] for number in numbers]
    task = study.task
    return Result(
        title="Study of the wrist device, simulated",
        settings={
            "seed": task.seed,
            "participants": study.participants,
            "blocks": task.blocks,
            "rig": task.rig.name,
            "solver_mode": task.solver_mode or task.rig.solver_mode,
            "step": task.step,
            "guided": task.guided,
        },
        judged=name_of(study.judged),
        trials={
            name: [trial for one in ordered for trial in one.trials[name]]
            for name in map(name_of, task.conditions)
        },
        calibrated={one.participant: one.calibrated for one in ordered if one.calibrated is not None},
        seed=task.seed,
    )


def recorded(
    folders: Sequence[Path],
    hand: Callable[[str], tuple[Path, HandProfile]],
    solver_mode: SolverMode | None,
    out: Path,
    progress: Callable[[int, int, str], None],
) -> Result:
    """Detect and solve given recordings, and evaluate them as a study.

    Each recording is of one participant.

    Args:
        folders: Recordings of wrist devices, with truth and the poses' names (`trials_of`).
        hand: Gives file and content of the hand that a rig names.
        solver_mode: Of the master; None: by the recording's rig.
        out: Folder for detections and poses.
        progress: As of `simulate`.

    Raises:
        PhalanxError: A recording is broken or lacks something; the text states what. Two have the same name.
    """
    trials: list[Trial] = []
    names = [folder.resolve().name for folder in folders]
    for name in names:
        if names.count(name) > 1:
            raise RecordingError(f"{name}: two recordings of this name; each must be of another participant")
    for done, (folder, name) in enumerate(zip(folders, names, strict=True)):
        recording = open_recording(folder)
        rig = recording.manifest.wrist_rig()
        file, profile = hand(rig.hand)
        there = out / name
        if not (folder / "truth.npz").exists():
            raise RecordingError(
                f"{folder}/truth.npz: missing: a study needs the true angles of every triple"
            )
        detect(folder, rig.cameras[0], file, there)
        poses = solved(folder, profile, there, solver_mode)
        trials += trials_of(recording, rig.cameras[0], name, poses)
        progress(done + 1, len(folders), name)
    return Result(
        title="Study of recordings",
        settings={"recordings": [str(folder) for folder in folders], "solver_mode": solver_mode},
        judged=DETECTED,
        trials={DETECTED: trials},
        calibrated={},
        seed=0,
    )


def finish(result: Result, out: Path) -> list[str]:
    """Write study.json, study.md and study.png; return the lines of the tables.

    Raises:
        RecordingError: They cannot be written.
    """
    lines = lines_of(result)
    write_study(out, result, lines)
    draw_study(out / "study.png", result)
    return lines
