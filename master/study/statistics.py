"""Statistics of the study.

Errors by finger and pose, whether a cell is reached, and how repeatable a finger is.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float, Int
from common.hand.model import FINGERS
from common.sim.motion import POSES
from master.study.trials import Trial

DRAWS = 40  # of block pairs, as in the paper
_FEWEST_TARGETS = 3


@dataclass(frozen=True, slots=True)
class Cell:
    """One finger in one pose.

    Attributes:
        trials: How many there were.
        reached: In how many of them the finger was tracked: a laser point or fingertip measured it.
        laser_seen: In how many the truth states that enough of the laser line was seen on it; tip: that its tip was.
        blind: In how many it was tracked although neither was: whatever measured it was something else. They count in
            the error like all others.
        mean_deg, sd_deg: Of the absolute error of the PIP over the trials that were reached; NaN: not reached, fewer
            than half of them. sd_deg is that of single trials, n - 1.
    """

    finger: str
    pose: str
    trials: int
    reached: int
    laser_seen: int
    tip: int
    unseen: int
    mean_deg: float
    sd_deg: float

    @property
    def is_reached(self) -> bool:
        """Whether the finger was tracked in at least half of the trials."""
        return self.trials > 0 and 2 * self.reached >= self.trials


@dataclass(frozen=True, slots=True)
class Repeated:
    """Repeatability of a finger as ICC(1,1) between two trials.

    It is the mean over the draws, with the number of targets.

    Targets of one or two poses are alike, and what is itself small makes a low coefficient: `cells` gives of how many
    reached cells they are. `truth_icc` is that of the true angles of the same trials: nobody makes a pose twice alike.
    """

    finger: str
    cells: int
    targets: int
    icc: float
    truth_icc: float


def cells_of(trials: list[Trial]) -> list[Cell]:
    """Return the cell of each finger in every pose that has trials.

    The fingers are thumb ... little, the poses those of the study.
    """
    poses = [pose for pose in POSES if any(one.pose == pose for one in trials)]
    return [_cell(trials, finger, pose) for finger in range(len(FINGERS)) for pose in poses]


def repeated(trials: list[Trial], seed: int, draws: int = DRAWS) -> list[Repeated]:
    """Compute the ICC of every finger between two random blocks.

    The blocks are drawn for each participant; targets are participant x pose.

    A target counts where both of its trials were tracked and its cell is reached.
    """
    out: list[Repeated] = []
    reached = {(cell.finger, cell.pose) for cell in cells_of(trials) if cell.is_reached}
    people = sorted({one.participant for one in trials})
    for finger, name in enumerate(FINGERS):
        rng = np.random.default_rng([seed, 63, finger])
        table = {
            (one.participant, one.pose, one.block): (one.pip_deg[finger], one.truth_deg[finger])
            for one in trials
            if one.tracked[finger] and (name, one.pose) in reached
        }
        measured: list[float] = []
        true: list[float] = []
        targets: list[int] = []
        for _ in range(draws):
            pairs = _pairs(table, people, trials, rng)
            targets.append(len(pairs))
            measured.append(icc_1_1(pairs[:, :, 0]))
            true.append(icc_1_1(pairs[:, :, 1]))
        cells = sum(own == name for own, _ in reached)
        out.append(
            Repeated(
                name, cells, round(float(np.mean(targets))), float(np.mean(measured)), float(np.mean(true))
            )
        )
    return out


def icc_1_1(ratings: Float) -> float:
    """Compute the intraclass correlation ICC(1,1) of ratings (targets, k).

    The model is one-way random effects, single rating.

    (BMS - WMS) / (BMS + (k - 1) WMS) with the mean squares between and within targets (Shrout & Fleiss, Psychological
    Bulletin 86, 1979, table 3). Blocks are drawn for each person anew, so that no rating is of the same judge
    throughout: the one-way model. NaN with fewer than three targets, or where all ratings are alike.
    """
    n, k = ratings.shape
    if n < _FEWEST_TARGETS or k < 2:
        return float("nan")
    means = ratings.mean(axis=1)
    between = k * float(((means - ratings.mean()) ** 2).sum()) / (n - 1)
    within = float(((ratings - means[:, None]) ** 2).sum()) / (n * (k - 1))
    whole = between + (k - 1) * within
    return (between - within) / whole if whole > 0.0 else float("nan")


def _cell(trials: list[Trial], finger: int, pose: str) -> Cell:
    own = [one for one in trials if one.pose == pose]
    tracked: Bool = np.array([one.tracked[finger] for one in own], np.bool_)
    error = np.abs([one.pip_deg[finger] - one.truth_deg[finger] for one in own])[tracked]
    count = int(tracked.sum())
    shown = 2 * count >= len(own)
    return Cell(
        finger=FINGERS[finger],
        pose=pose,
        trials=len(own),
        reached=count,
        laser_seen=sum(one.laser_seen[finger] for one in own),
        tip=sum(one.tip_seen[finger] for one in own),
        unseen=sum(
            one.tracked[finger] and not (one.laser_seen[finger] or one.tip_seen[finger]) for one in own
        ),
        mean_deg=float(error.mean()) if shown and count else float("nan"),
        sd_deg=float(error.std(ddof=1)) if shown and count > 1 else float("nan"),
    )


def _pairs(
    table: dict[tuple[str, str, int], tuple[float, float]],
    people: list[str],
    trials: list[Trial],
    rng: np.random.Generator,
) -> Float:
    """Return the angles of both trials of each target.

    Measured and true angles (n, 2, 2); two blocks are drawn for each participant.
    """
    rows: list[list[tuple[float, float]]] = []
    for who in people:
        blocks: Int = np.unique([one.block for one in trials if one.participant == who])
        if len(blocks) < 2:
            continue
        a, b = rng.choice(blocks, 2, replace=False).tolist()
        for pose in POSES:
            if (who, pose, a) in table and (who, pose, b) in table:
                rows.append([table[who, pose, a], table[who, pose, b]])
    return np.array(rows, dtype=np.float64).reshape(-1, 2, 2)
