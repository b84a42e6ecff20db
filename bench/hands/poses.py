"""Random poses of independent joints, palm turned by up to 45 degrees: the whole-hand fit, and the papers' way.

Three kinds of noise: 1 mm in every direction; the same with the palm's orientation known to 2 degrees about each axis
(a sensor on the back of the hand); that of stereo, 4.5 mm in depth and 0.3 mm across. Every hand is solved anew, and
every solver gets the same caps. `python -m bench hand_poses 10000` takes all poses.
"""

import argparse
import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context

import numpy as np

from bench.hands import draws
from bench.hands.draws import FACING_ROTATION, MARKERS, Fingers, Noise, Score
from bench.report import Row, show
from common.arrays import Float
from common.hand.model import HandModel

POSES, BATCHES = 2000, 10
WHOLE, PAPER, CLOSED = "whole hand", "papers' way", "closed form"


@dataclass(frozen=True, slots=True)
class Scenario:
    """What is measured, and the goals: mean error of the PIP [deg] and of the joints [mm]."""

    noise: Noise
    pip_goal_deg: float
    joints_goal_mm: float


SCENARIOS = {
    "1 mm": Scenario(Noise((1e-3, 1e-3, 1e-3)), 5.5, 3.5),
    "1 mm, orientation 2 deg": Scenario(Noise((1e-3, 1e-3, 1e-3), float(np.radians(2.0))), 4.0, 2.5),
    "depth 4.5 mm": Scenario(Noise((0.3e-3, 0.3e-3, 4.5e-3)), 7.5, 6.0),
}


def rows(poses: int = POSES) -> list[Row]:
    """Return errors of every way in every scenario; `poses` in ten batches of their own seeds, over all cores."""
    first_seed = 1
    jobs = [(name, first_seed + k) for name in SCENARIOS for k in range(BATCHES)]
    # Fresh interpreters: a fork would take along threads of a benchmark that ran before.
    with ProcessPoolExecutor(os.cpu_count(), get_context("spawn")) as workers:
        results = list(workers.map(partial(_batch, count=max(1, poses // BATCHES)), jobs))
    out: list[Row] = []
    for name, scenario in SCENARIOS.items():
        own = [r for (of, _), r in zip(jobs, results, strict=True) if of == name]
        out += scenario_rows(name, scenario, own)
    return out


def _batch(job: tuple[str, int], count: int) -> dict[str, Score]:
    return batch(SCENARIOS[job[0]].noise, job[1], count)


def batch(noise: Noise, seed: int, count: int) -> dict[str, Score]:
    """Solve `count` poses of one seed in every way: name of the way -> its errors."""
    model = draws.bench_model()
    truth = draws.draw(model, seed, count)
    points, rotation = draws.seen(truth, noise, seed)
    # The papers' palm faces the cameras; where an orientation is known, their fingers get it too.
    facing = np.tile(FACING_ROTATION, (count, 1, 1)) if rotation is None else rotation
    palms = np.array([draws.fixed_palm(model, p, R) for p, R in zip(points, facing, strict=True)])
    tips = [draws.tips_in_palm(T, p) for T, p in zip(palms, points, strict=True)]
    fingers = draws.finger_solvers(model)

    def alone(solve: Fingers) -> Score:
        return draws.score(model, truth, palms, np.array([solve(p) for p in tips]), points)

    return {
        WHOLE: draws.score(model, truth, *_whole_hands(model, points, noise, rotation), points),
        PAPER: alone(draws.PaperFingers(fingers).push),
        CLOSED: alone(partial(draws.closed_form, fingers)),
    }


def _whole_hands(
    model: HandModel, points_m: Float, noise: Noise, rotation: Float | None
) -> tuple[Float, Float]:
    """Palms (N, 4, 4) and angles (N, 5, 4) [rad] of the whole-hand fit, each afresh; NaN where it finds none."""
    solver = draws.PointHand(model, MARKERS, continuous=False, faces=False)
    palms, angles = np.full((len(points_m), 4, 4), np.nan), np.full((len(points_m), 5, 4), np.nan)
    for k, p in enumerate(points_m):
        measured = None
        if rotation is not None and noise.orientation_rad is not None:
            measured = rotation[k], noise.orientation_rad**2 * np.eye(3)
        found = solver.push(k, p, noise.cov_m2, rotation=measured).solution
        if found is not None:
            palms[k], angles[k] = found.T_rig_palm, found.angles_rad
    return palms, angles


def scenario_rows(name: str, scenario: Scenario, batches: Sequence[dict[str, Score]]) -> list[Row]:
    """Return the rows of one scenario: means over all poses, with the spread of the batches' means."""
    goals = {WHOLE: (scenario.pip_goal_deg, scenario.joints_goal_mm)}
    out: list[Row] = []
    for way in (WHOLE, PAPER, CLOSED):
        found = [one[way] for one in batches]
        pip, joints = goals.get(way, (None, None))
        bad = sum(s.violations for s in found)
        none = f"no answer for {sum(s.not_finite for s in found)} of {sum(s.hands for s in found)} hands"
        missed = float(np.mean([s.missed_percent for s in found]))
        out += [
            _errors(f"{name}: PIP, {way}", [s.pip_deg for s in found], "deg", pip),
            _errors(f"{name}: joints, {way}", [s.joints_mm for s in found], "mm", joints),
            Row(f"{name}: limit violations, {way}", bad, "angles", f"{none}; {missed:.1f} % of tips missed"),
        ]
    return out


def _errors(name: str, batches: Sequence[Float], unit: str, goal: float | None) -> Row:
    every = np.concatenate([errors.ravel() for errors in batches])
    spread = float(np.std([errors.mean() for errors in batches], ddof=1)) if len(batches) > 1 else 0.0
    note = f"± {spread:.2f}; median {np.median(every):.2f}, p95 {np.percentile(every, 95):.2f}"
    return Row(name, float(every.mean()), unit, note if goal is None else f"{note}; goal {goal}")


def main(arguments: Sequence[str]) -> None:
    """Print the rows for a number of poses."""
    parser = argparse.ArgumentParser(prog="python -m bench hand_poses", description=__doc__)
    parser.add_argument("poses", nargs="?", type=int, default=POSES, help=f"at least 10 (default {POSES})")
    options = parser.parse_args(arguments)
    if options.poses < BATCHES:
        parser.error(f"poses: at least {BATCHES}")
    show(rows(options.poses))
