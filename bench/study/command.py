"""The study of Digits repeated with simulated people: six poses, several blocks, errors and repeatability.

Each participant does the guided motion of the calibration, then the poses in random order, through the real line
(`bench.study.trials`); 12 people, 3 blocks take about an hour on two cores. The study is open loop: nobody sees the
tracked hand and corrects the pose, as the paper's participants did.
"""

import argparse
import json
import os
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from bench.report import rig_files
from bench.study.trials import Task, Trial, performed, trials_of
from common.arrays import Bool, Float, Int
from common.hand.model import FINGERS
from common.sim.motion import POSES

# What the paper reports: every mean of finger and pose, ranges of means over the poses, repeatability of each finger.
_MEAN_LIMIT_DEG, _MEAN_RANGE_DEG = 9.0, {"index": (1.8, 2.9), "little": (3.8, 7.3)}
_PAPER_ICC = {"thumb": 0.74, "index": 0.88, "middle": 0.84, "ring": 0.81, "little": 0.66}
_ICC_GOAL = 0.8  # ours, for every finger
SEED = 1  # of people and poses


@dataclass(frozen=True, slots=True)
class Cell:
    """One finger in one pose."""

    finger: str
    pose: str
    trials: int
    reached: int  # trials in which the finger was tracked
    blind: int  # tracked although neither laser line nor tip was in sight; they count in the error
    mean_deg: float  # of the absolute error of the PIP over trials that were reached; NaN: not reached
    sd_deg: float

    @property
    def is_reached(self) -> bool:
        """Whether the finger was tracked in at least half of the trials."""
        return self.trials > 0 and 2 * self.reached >= self.trials

    def text(self) -> str:
        """Mean ± sd (tracked / trials)."""
        share = f"({self.reached}/{self.trials})"
        return f"{self.mean_deg:.1f} ± {self.sd_deg:.1f} {share}" if self.is_reached else f"*none* {share}"


@dataclass(frozen=True, slots=True)
class Repeated:
    """ICC(1,1) of a finger, mean over the draws; that of the true angles; of how many targets and reached cells."""

    finger: str
    cells: int
    targets: int
    icc: float
    truth_icc: float


def cells_of(trials: Sequence[Trial]) -> list[Cell]:
    """Return fingers thumb ... little, each in every pose that there are trials of."""
    out: list[Cell] = []
    for f, finger in enumerate(FINGERS):
        for pose in (pose for pose in POSES if any(one.pose == pose for one in trials)):
            own = [one for one in trials if one.pose == pose]
            tracked: Bool = np.array([one.tracked[f] for one in own], np.bool_)
            error = np.abs([one.pip_deg[f] - one.truth_deg[f] for one in own])[tracked]
            blind = sum(bool(one.tracked[f] and not one.seen[f]) for one in own)
            shown = 2 * len(error) >= len(own)
            mean = float(error.mean()) if shown and len(error) else float("nan")
            sd = float(error.std(ddof=1)) if shown and len(error) > 1 else float("nan")
            out.append(Cell(finger, pose, len(own), len(error), blind, mean, sd))
    return out


def repeated(trials: Sequence[Trial], seed: int, draws: int = 40) -> list[Repeated]:
    """Return the ICC of every finger between two random blocks of each participant, 40 draws as in the paper.

    Targets are participant x pose; one counts where both of its trials were tracked and its cell is reached.
    """
    out: list[Repeated] = []
    reached = {(cell.finger, cell.pose) for cell in cells_of(trials) if cell.is_reached}
    for f, name in enumerate(FINGERS):
        rng = np.random.default_rng([seed, 63, f])
        table = {
            (one.participant, one.pose, one.block): (float(one.pip_deg[f]), float(one.truth_deg[f]))
            for one in trials
            if one.tracked[f] and (name, one.pose) in reached
        }
        pairs = [_pairs(table, trials, rng) for _ in range(draws)]
        icc = [float(np.mean([icc_1_1(some[:, :, k]) for some in pairs])) for k in (0, 1)]
        cells = sum(own == name for own, _ in reached)
        out.append(Repeated(name, cells, round(float(np.mean([len(some) for some in pairs]))), *icc))
    return out


def _pairs(
    table: dict[tuple[str, str, int], tuple[float, float]], trials: Sequence[Trial], rng: np.random.Generator
) -> Float:
    """Measured and true angles (n, 2, 2) of both trials of each target, for two blocks drawn for each participant."""
    out: list[list[tuple[float, float]]] = []
    for who in sorted({one.participant for one in trials}):
        blocks: Int = np.unique([one.block for one in trials if one.participant == who])
        if len(blocks) < 2:
            continue
        a, b = rng.choice(blocks, 2, replace=False).tolist()
        both = [pose for pose in POSES if (who, pose, a) in table and (who, pose, b) in table]
        out += [[table[who, pose, a], table[who, pose, b]] for pose in both]
    return np.array(out, dtype=np.float64).reshape(-1, 2, 2)


def icc_1_1(ratings: Float) -> float:
    """Return the intraclass correlation ICC(1,1) of ratings (targets, k): one-way random effects, single rating.

    (BMS - WMS) / (BMS + (k - 1) WMS) with the mean squares between and within targets (Shrout & Fleiss, Psychological
    Bulletin 86, 1979, table 3). Blocks are drawn for each person anew, so no rating is of the same judge throughout.
    NaN with fewer than three targets, or where all ratings are alike.
    """
    n, k = ratings.shape
    if n < 3 or k < 2:
        return float("nan")
    means = ratings.mean(axis=1)
    between = k * float(((means - ratings.mean()) ** 2).sum()) / (n - 1)
    within = float(((ratings - means[:, None]) ** 2).sum()) / (n * (k - 1))
    whole = between + (k - 1) * within
    return (between - within) / whole if whole > 0.0 else float("nan")


def simulate(task: Task, participants: int, jobs: int) -> list[Trial]:
    """Let all participants do everything, `jobs` at a time; print who is done."""
    trials: list[Trial] = []
    # Fresh interpreters: threads of OpenCV and BLAS do not survive a fork.
    with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
        for number, found in enumerate(pool.map(partial(_one, task), range(1, participants + 1)), 1):
            print(f"participant {number} of {participants} done", flush=True)
            trials += found
    return trials


def _one(task: Task, number: int) -> list[Trial]:
    with tempfile.TemporaryDirectory(prefix="phalanx-study-") as folder:
        return trials_of(performed(task, number, Path(folder)))


def lines_of(trials: Sequence[Trial], seed: int) -> Iterator[str]:
    """Write the tables as Markdown."""
    cells, again = cells_of(trials), repeated(trials, seed)
    poses = list(dict.fromkeys(cell.pose for cell in cells))
    yield f"{len({one.participant for one in trials})} participants, {len(trials)} trials, open loop"
    yield ""
    heads = [f"{letter} {pose.replace('_', ' ')}" for letter, pose in zip("ABCDEF", poses, strict=False)]
    yield f"| finger | {' | '.join(heads)} | paper |"
    yield "|---|" + "--:|" * (len(poses) + 1)
    for finger in FINGERS:
        low_high = _MEAN_RANGE_DEG.get(finger)
        paper = f"{low_high[0]}–{low_high[1]}" if low_high else f"< {_MEAN_LIMIT_DEG:g}"
        yield f"| {finger} | {' | '.join(c.text() for c in cells if c.finger == finger)} | {paper} |"
    yield ""
    yield "| finger | ICC | in truth | targets | reached cells | paper |"
    yield "|---|--:|--:|--:|--:|--:|"
    for one in again:
        figures = f"{one.icc:.3f} | {one.truth_icc:.3f} | {one.targets} | {one.cells} | {_PAPER_ICC[one.finger]:.2f}"
        yield f"| {one.finger} | {figures} |"
    yield ""
    reached = [cell for cell in cells if cell.is_reached]
    above = [cell for cell in reached if cell.mean_deg >= _MEAN_LIMIT_DEG]
    worst = ", ".join(f"{c.finger} {c.pose} {c.mean_deg:.1f}" for c in above) or "none"
    low = ", ".join(f"{one.finger} {one.icc:.2f}" for one in again if not one.icc >= _ICC_GOAL) or "none"
    yield f"Reached: {len(reached)} of {len(cells)} cells. Not below {_MEAN_LIMIT_DEG:g}°: {worst}."
    yield f"ICC below {_ICC_GOAL}: {low}. Tracked, neither in sight: {sum(cell.blind for cell in cells)} trials."


def main(arguments: Sequence[str]) -> None:
    """Run the study; print its tables."""
    parser = argparse.ArgumentParser("python -m bench study", description=__doc__)
    parser.add_argument("--participants", type=int, default=12)
    parser.add_argument("--blocks", type=int, default=3, help="how often each makes the six poses")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write every trial to FILE")
    options = parser.parse_args(arguments)
    rig, cameras, hand = rig_files("wrist")
    task = Task(rig, cameras[rig.cameras[0]], hand, SEED, options.blocks)
    trials = simulate(task, options.participants, os.cpu_count() or 1)
    print("\n".join(lines_of(trials, SEED)))
    if options.json is not None:
        plain = [{name: np.asarray(getattr(one, name)).tolist() for name in one.__slots__} for one in trials]
        options.json.write_text(json.dumps(plain, indent=1))
