"""Finger solvers: closed form, FABRIK with and without seed and restarts, least squares from scratch; triangulation."""

import math
import statistics
import time
from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np

from common.camera_model import CameraModel
from common.geometry import axis_rotation, rigid
from common.hand_model import FINGERS, HandModel
from common.hand_profiles import generated_profile
from master.ik.bounded import bounded_least_squares
from master.ik.fabrik import Fabrik, solve_finger
from master.ik.finger import FingerSolver
from master.ik.vectors import Vector
from master.stereo.triangulate import Triangulator

_HANDS = 200
_FABRIK_TARGETS = 10_000
_UNSEEDED_TARGETS = 250
_ROUNDS = 9

Row = tuple[str, float, str, str]
T = TypeVar("T")


def _median_us(run: Callable[[T], object], items: Sequence[T], rounds: int = _ROUNDS) -> float:
    times: list[float] = []
    for _ in range(rounds):
        start = time.perf_counter()
        for item in items:
            run(item)
        times.append((time.perf_counter() - start) / len(items) * 1e6)
    return statistics.median(times)


def _targets(
    solvers: list[FingerSolver], count: int, seed: int, *, natural_thumb: bool
) -> list[tuple[int, Vector]]:
    """Finger and reachable target, from random legal angles; couplings obeyed, the thumb's natural one if asked."""
    rng = np.random.default_rng(seed)
    out: list[tuple[int, Vector]] = []
    for k in range(count):
        solver = solvers[k % 5]
        low, high = np.array(solver.limits).T
        a, f, pip, dip = (low + rng.random(4) * (high - low)).tolist()
        (a, f), (pip,), (dip,) = solver.chain.clamp(((a, f), (pip,), (dip,)))
        if natural_thumb:
            dip = min(max(solver.ratio * pip, float(low[3])), float(high[3]))
        out.append((k % 5, solver.forward((a, f, pip, dip))))
    return out


def _finger_rows(solvers: list[FingerSolver]) -> list[Row]:
    targets = _targets(solvers, 5 * _HANDS, 1, natural_thumb=True)

    def closed(item: tuple[int, Vector]) -> object:
        return solvers[item[0]].solve(item[1])

    def scratch(item: tuple[int, Vector]) -> object:
        solver = solvers[item[0]]
        x, y, z = item[1]
        rx, ry, rz = solver.root
        return bounded_least_squares(solver.chain, (0.0, 0.5, 0.5, 0.3), (x - rx, y - ry, z - rz), 1e-6)

    exact, slow = 5 * _median_us(closed, targets), 5 * _median_us(scratch, targets[:250], 3)
    found = [(solvers[f], solvers[f].solve(target), target) for f, target in targets]
    missed = sum(math.dist(s.forward(angles[:4]), target) > 1e-6 for s, angles, target in found)
    return [
        ("hand of five fingers, damped least squares (baseline)", slow, "µs", ""),
        ("hand of five fingers, closed form, all legal poses", exact, "µs", "<= 10"),
        ("closed form, ratio", slow / exact, "x", ""),
        ("closed form, reachable targets missed by > 1 µm", float(missed), f"of {len(targets)}", "0"),
    ]


def _fabrik_rows(solvers: list[FingerSolver]) -> list[Row]:
    prepared = [Fabrik.of(s.chain) for s in solvers]
    published = [Fabrik.of(s.chain, restarts=0) for s in solvers]
    targets = _targets(solvers, _FABRIK_TARGETS, 2, natural_thumb=False)
    start = time.perf_counter()
    results = [solve_finger(prepared[f], solvers[f], target) for f, target in targets]
    seeded_us = (time.perf_counter() - start) / len(targets) * 1e6
    misses = [math.dist(r.positions[-1], target) for r, (_, target) in zip(results, targets, strict=True)]
    outside = sum(
        not np.allclose(
            np.concatenate(prepared[f].chain.clamp(r.angles)), np.concatenate(r.angles), 0.0, 1e-9
        )
        for r, (f, _) in zip(results, targets, strict=True)
    )
    few = targets[:_UNSEEDED_TARGETS]

    def unseeded(solver: list[Fabrik]) -> tuple[float, float]:
        start = time.perf_counter()
        found = [solver[f].solve(target, None, solvers[f].root).residual_m for f, target in few]
        return (time.perf_counter() - start) / len(few) * 5e6, 100.0 * sum(r > 1e-3 for r in found) / len(few)

    plain_us, plain_missed = unseeded(published)
    healed_us, healed_missed = unseeded(prepared)
    return [
        ("FABRIK, no seed, no restart (baseline): missed by > 1 mm", plain_missed, "%", ""),
        ("FABRIK, no seed, no restart (baseline), hand", plain_us, "µs", ""),
        ("FABRIK, no seed, restarts: missed by > 1 mm", healed_missed, "%", ""),
        ("FABRIK, no seed, restarts, hand", healed_us, "µs", ""),
        ("FABRIK, seeded, hand", 5 * seeded_us, "µs", ""),
        ("FABRIK, seeded: missed by > 0.1 mm", float(sum(not m < 1e-4 for m in misses)), "of 10000", "0"),
        ("FABRIK, seeded: limit violations", float(outside), "of 10000", "0"),
    ]


def _triangulation_row() -> Row:
    matrix = np.array([[503.0, 0.0, 319.5], [0.0, 503.0, 239.5], [0.0, 0.0, 1.0]])
    lens = np.array([0.105, -0.21, 0.0006, -0.0009, 0.05])
    poses = [rigid(axis_rotation(1, -0.4 * x), np.array([x, 0.0, 0.0])) for x in (0.0, 0.075)]
    rig = Triangulator.of([CameraModel(matrix, lens, pose, 640, 480, 0.0) for pose in poses])
    points = np.random.default_rng(4).uniform([-0.15, -0.15, 0.45], [0.15, 0.15, 0.8], (6, 3))
    uv = np.stack([camera.project(points) for camera in rig.cameras])
    return (
        "triangulation with covariance, 6 markers, 2 cameras",
        _median_us(rig.triangulate, [uv] * 100),
        "µs",
        "<= 150",
    )


def rows() -> list[Row]:
    """(name, value, unit, goal) of each measurement."""
    model = HandModel.of(generated_profile("bench", "right"))
    solvers = [FingerSolver.of(model, f, model.mounts[name].offset_m) for f, name in enumerate(FINGERS)]
    return [*_finger_rows(solvers), *_fabrik_rows(solvers), _triangulation_row()]
