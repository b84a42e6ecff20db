"""Random poses of independent joints, palm turned by up to 45 degrees: the whole-hand fit afresh, and the papers' way.

Three sorts of noise: 1 mm in every direction; the same with the palm's orientation known to 2 degrees about each axis
(a sensor on the back of the hand); what stereo does, 4.5 mm in depth and 0.3 mm across. Nothing is known of an earlier
pose. Every way of solving gets the same caps. `python -m bench.hand_poses 10000` takes all poses.
"""

import argparse
import os
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context

import numpy as np

from bench.hand_draws import FACING_ROTATION, MARKERS, Noise, bench_model, draw, seen
from bench.hand_score import Score, score
from bench.peers_paper import Fingers, PaperFingers, closed_form, finger_solvers, fixed_palm, tips_in_palm
from bench.row import Row
from bench.solved_hand import PointHand
from common.arrays import Float
from common.hand.model import HandModel

POSES = 2000
BATCHES = 10
FIRST_SEED = 1


@dataclass(frozen=True, slots=True)
class Scenario:
    """What is seen, and the goals: mean error of the PIP [deg] and of the joints [mm]."""

    noise: Noise
    pip_goal_deg: float
    joints_goal_mm: float


SCENARIOS = {
    "1 mm": Scenario(Noise((1e-3, 1e-3, 1e-3)), 5.5, 3.5),
    "1 mm, orientation 2 deg": Scenario(Noise((1e-3, 1e-3, 1e-3), float(np.radians(2.0))), 4.0, 2.5),
    "depth 4.5 mm": Scenario(Noise((0.3e-3, 0.3e-3, 4.5e-3)), 7.5, 6.0),
}
WHOLE, PAPER, CLOSED = "whole hand", "papers' way", "closed form"


def rows(poses: int = POSES) -> list[Row]:
    """Errors of every way in every scenario; `poses` in ten batches of their own seeds, over all cores."""
    jobs = [(name, FIRST_SEED + k) for name in SCENARIOS for k in range(BATCHES)]
    count = max(1, poses // BATCHES)
    # Fresh interpreters: a fork would take along threads of a benchmark section that ran before.
    with ProcessPoolExecutor(os.cpu_count(), get_context("spawn")) as workers:
        results = list(workers.map(partial(_batch, count=count), jobs))
    out: list[Row] = []
    for name, scenario in SCENARIOS.items():
        batches = [found for (of, _), found in zip(jobs, results, strict=True) if of == name]
        out += scenario_rows(name, scenario, batches)
    return out


def _batch(job: tuple[str, int], count: int) -> dict[str, Score]:
    return batch(SCENARIOS[job[0]].noise, job[1], count)


def batch(noise: Noise, seed: int, count: int) -> dict[str, Score]:
    """Solve `count` poses of one seed in every way: name of the way -> its errors."""
    model = bench_model()
    truth = draw(model, seed, count)
    points, rotation = seen(truth, noise, seed)
    # The papers' palm faces the cameras; where an orientation is known, their fingers get it too.
    facing = np.tile(FACING_ROTATION, (count, 1, 1)) if rotation is None else rotation
    palms = np.array([fixed_palm(model, p, R) for p, R in zip(points, facing, strict=True)])
    tips = [tips_in_palm(T, p) for T, p in zip(palms, points, strict=True)]
    fingers = finger_solvers(model)

    def alone(solve: Fingers) -> Score:
        return score(model, truth, palms, np.array([solve(p) for p in tips]), points)

    return {
        WHOLE: score(model, truth, *whole_hands(model, points, noise, rotation), points),
        PAPER: alone(PaperFingers(fingers).push),
        CLOSED: alone(partial(closed_form, fingers)),
    }


def whole_hands(
    model: HandModel, points_m: Float, noise: Noise, rotation: Float | None
) -> tuple[Float, Float]:
    """Palms (N, 4, 4) and angles (N, 5, 4) [rad] of the whole-hand fit, each afresh; NaN where it finds none.

    Args:
        model: The hand.
        points_m: Caps (N, M, 3) [m].
        noise: What the solver is told of them.
        rotation: Palm orientations (N, 3, 3), or None.
    """
    solver = PointHand(model, MARKERS, continuous=False, faces=False)
    palms, angles = np.full((len(points_m), 4, 4), np.nan), np.full((len(points_m), 5, 4), np.nan)
    for k, p in enumerate(points_m):
        orientation = None
        if rotation is not None and noise.orientation_rad is not None:
            orientation = rotation[k], noise.orientation_rad**2 * np.eye(3)
        found = solver.push(k, p, noise.cov_m2, orientation=orientation).solution
        if found is not None:
            palms[k], angles[k] = found.T_rig_palm, found.angles_rad
    return palms, angles


def scenario_rows(name: str, scenario: Scenario, batches: Sequence[dict[str, Score]]) -> list[Row]:
    """The rows of one scenario: means over all poses, with the spread of the batches' means."""
    ours = [found[WHOLE] for found in batches]
    out = [
        _error_row(f"{name}: PIP, whole hand", [s.pip_deg for s in ours], "deg", scenario.pip_goal_deg),
        _error_row(f"{name}: joints, whole hand", [s.joints_mm for s in ours], "mm", scenario.joints_goal_mm),
        Row(
            f"{name}: limit violations, whole hand",
            float(sum(s.violations for s in ours)),
            "angles",
            f"goal 0; no answer for {sum(s.not_finite for s in ours)} of {sum(s.hands for s in ours)} hands, goal 0",
        ),
    ]
    for way in (PAPER, CLOSED):
        theirs = [found[way] for found in batches]
        missed = float(np.mean([s.missed_percent for s in theirs]))
        palm = "palm by its sensor" if scenario.noise.orientation_rad is not None else "fixed palm"
        out += [
            _error_row(f"{name}: PIP, {way}", [s.pip_deg for s in theirs], "deg"),
            _error_row(f"{name}: joints, {way}", [s.joints_mm for s in theirs], "mm"),
            Row(f"{name}: tips missed by > 1 mm, {way}", missed, "%", palm),
        ]
    return out


def _error_row(name: str, batches: Sequence[Float], unit: str, goal: float | None = None) -> Row:
    every = np.concatenate([errors.ravel() for errors in batches])
    spread = float(np.std([errors.mean() for errors in batches], ddof=1)) if len(batches) > 1 else 0.0
    note = f"± {spread:.2f}; median {np.median(every):.2f}, p95 {np.percentile(every, 95):.2f}"
    return Row(name, float(every.mean()), unit, note if goal is None else f"{note}; goal {goal}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the rows for a number of poses."""
    parser = argparse.ArgumentParser(prog="python -m bench.hand_poses", description=__doc__)
    parser.add_argument("poses", nargs="?", type=int, default=POSES, help=f"at least 10 (default {POSES})")
    options = parser.parse_args(arguments)
    if options.poses < BATCHES:
        parser.error(f"poses: at least {BATCHES}")
    for row in rows(options.poses):
        print(f"  {row.name:58s} {row.value:10.4g} {row.unit:8s} {row.note}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
