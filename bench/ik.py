"""One finger at a time, the palm known: our solvers and others on the same targets, every one of them reachable.

Targets are the caps of hands whose angles are independent and uniform within the limits, the DIP coupled exactly.
The papers' way and mink begin at their last pose, which is another random one, scipy amid the limits.
"""

import time
from collections.abc import Sequence
from functools import partial

import numpy as np

from bench import peers_mink, peers_scipy
from bench.hand_draws import MARKERS, Draw, bench_model, draw, posed
from bench.hand_score import Score, score
from bench.peers_paper import Angles, Fingers, PaperFingers, closed_form, finger_solvers, tips_in_palm
from bench.row import Row, median_us
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import axis_rotation, rigid
from common.hand.model import HandModel
from master.estimator.cameras import CameraArrays
from master.fabrik.fabrik import Fabrik
from master.fabrik.finger import Finger, FingerSolver
from master.fabrik.intersection import triangulate
from master.fabrik.rotations import Vector

HANDS = 2000
_SEED = 2
_PARTS = 10

CLOSED, WARM_STARTED, PAPER = "closed form", "FABRIK, seeded", "papers' way"
FROM_REST, RESTARTED = "FABRIK, from rest", "FABRIK, from rest, restarts"
_SLOW = {PAPER: 10, FROM_REST: 10, RESTARTED: 20, "scipy": 40, "mink": 10}  # one hand in so many
_STRICT_MM = {CLOSED: 1e-3, WARM_STARTED: 0.1}  # by how much these two may miss


def rows(hands: int = HANDS) -> list[Row]:
    """Time per hand of five fingers, targets missed, limits passed, error of the PIP, for each way."""
    model = bench_model()
    truth = draw(model, _SEED, hands, coupling_off_rad=0.0)
    out: list[Row] = []
    us: dict[str, float] = {}
    for name, way in ways(model).items():
        found, us[name], spread = timed(model, way, truth.every(_SLOW.get(name, 1)))
        out += way_rows(name, found, us[name], spread)
        if name in _STRICT_MM:
            out.append(_strict_row(name, found, _STRICT_MM[name]))
    if not peers_mink.installed():
        out.append(Row("mink: skipped", 0.0, "", peers_mink.INSTALL))
    natural, one, spread = timed(model, ways(model)[CLOSED], _natural_thumb(model, truth))
    return [
        *out,
        Row(f"{CLOSED}, thumb's IP in its ratio: hand", one, "us", f"± {spread:.3g}; goal 10"),
        _strict_row(f"{CLOSED}, thumb's IP in its ratio", natural, _STRICT_MM[CLOSED]),
        Row(f"{CLOSED}, times faster than scipy", us["scipy"] / us[CLOSED], "x", ""),
        _triangulation_row(),
    ]


def way_rows(name: str, found: Score, us: float, spread_us: float) -> list[Row]:
    """Time, and what was missed."""
    pip = f"PIP {found.pip_rms_deg:.2g} deg RMS, limits passed by {found.worst_deg:.1g} deg"
    return [
        Row(f"{name}: hand of five fingers", us, "us", f"± {spread_us:.3g}; {pip}"),
        Row(f"{name}: missed by > 1 mm", found.missed_percent, "%", f"of {found.miss_mm.size}"),
    ]


def _natural_thumb(model: HandModel, truth: Draw) -> Draw:
    """The same hands with a thumb that the closed form needs no search for."""
    angles = truth.angles_rad.copy()
    angles[:, 0, 3] = finger_solvers(model)[0].ratio * angles[:, 0, 2]
    return posed(model, truth.T_rig_palm, model.clamp(angles))


def ways(model: HandModel) -> dict[str, Fingers]:
    """Every solver that is there, by name; each begins afresh."""
    fingers = finger_solvers(model)
    out: dict[str, Fingers] = {
        CLOSED: partial(closed_form, fingers),
        WARM_STARTED: _warm_started(model),
        RESTARTED: _from_rest(fingers, 3),
        FROM_REST: _from_rest(fingers, 0),
        PAPER: PaperFingers(fingers).push,
        "scipy": lambda tips: [
            peers_scipy.finger(solver, tip) for solver, tip in zip(fingers, tips, strict=True)
        ],
    }
    if peers_mink.installed():
        mink = peers_mink.MinkHand(model)
        out["mink"] = lambda tips: mink.push(np.array(tips))[1].tolist()
    return out


def _warm_started(model: HandModel) -> Fingers:
    fingers = [Finger.of(model, f, model.mount(name).offset_m) for f, name in enumerate(MARKERS[:5])]

    def way(tips: Sequence[Vector]) -> Angles:
        angles = np.full((5, 4), np.nan)
        for finger, tip, row in zip(fingers, tips, angles, strict=True):
            finger.solve(np.array(tip), row)
        return angles.tolist()

    return way


def _from_rest(fingers: Sequence[FingerSolver], restarts: int) -> Fingers:
    prepared = [Fabrik.of(solver.chain, restarts=restarts) for solver in fingers]

    def way(tips: Sequence[Vector]) -> Angles:
        found = [
            f.solve(tip, None, solver.root) for f, solver, tip in zip(prepared, fingers, tips, strict=True)
        ]
        return [[q for joint in one.angles for q in joint] for one in found]

    return way


def timed(model: HandModel, way: Fingers, truth: Draw) -> tuple[Score, float, float]:
    """Errors of a way, its median processor time per hand, and half the distance of the quartiles of ten parts [us]."""
    targets = [tips_in_palm(T, caps) for T, caps in zip(truth.T_rig_palm, truth.caps_m, strict=True)]
    found: list[Angles] = []
    times: list[float] = []
    size = max(1, len(targets) // _PARTS)
    for k in range(0, len(targets), size):
        part = targets[k : k + size]
        start = time.thread_time()
        found += [way(tips) for tips in part]
        times.append(1e6 * (time.thread_time() - start) / len(part))
    low, middle, high = np.percentile(times, (25, 50, 75)).tolist()
    return score(model, truth, truth.T_rig_palm, np.array(found), truth.caps_m), middle, (high - low) / 2


def _strict_row(name: str, found: Score, bound_mm: float) -> Row:
    missed = float((~(found.miss_mm <= bound_mm)).sum())
    note = f"of {found.miss_mm.size}, goal 0; limit violations {found.violations}, goal 0"
    return Row(f"{name}: missed by > {1e3 * bound_mm:g} um", missed, "targets", note)


def _triangulation_row() -> Row:
    matrix = np.array([[503.0, 0.0, 319.5], [0.0, 503.0, 239.5], [0.0, 0.0, 1.0]])
    lens = np.array([0.105, -0.21, 0.0006, -0.0009, 0.05])
    poses = [rigid(axis_rotation(1, -0.4 * x), np.array([x, 0.0, 0.0])) for x in (0.0, 0.075)]
    cameras = [CameraModel(matrix, lens, pose, 640, 480, 0.0) for pose in poses]
    arrays = CameraArrays.of(cameras)
    points = np.random.default_rng(4).uniform([-0.15, -0.15, 0.45], [0.15, 0.15, 0.8], (6, 3))
    uv = np.stack([camera.project(points) for camera in cameras])
    one, spread = median_us(lambda: triangulate(arrays, uv))
    return Row("triangulation with covariance, 6 markers, 2 cameras", one, "us", f"± {spread:.3g}; goal 150")
