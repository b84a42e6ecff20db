"""The whole-hand solver on a moving hand: time, accuracy, and what a fixed palm would cost."""

import itertools
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares  # pyright: ignore[reportUnknownVariableType]

from bench.row import Row, median_us
from common.arrays import Float
from common.calibration import HandProfile, load
from common.geometry import rigid, rotation_vector_to_matrix
from common.hand_model import HandModel
from master.ik.hand import HandSolution, HandSolver

_MARKERS = ("thumb", "index", "middle", "ring", "little", "back")
_FRAMES = 240
_SIGMA_M = np.array([0.15e-3, 0.15e-3, 1.0e-3])


def rows() -> list[Row]:
    """Warm solves along a smooth motion at 60 Hz with centroid-like noise."""
    model = HandModel.of(
        load(Path(__file__).parent.parent / "calib_json/hands/default-right.json", HandProfile)
    )
    solver = HandSolver(model, _MARKERS)
    poses, angles, points = _motion(model)
    cov = np.repeat(np.diag(_SIGMA_M**2)[None], len(_MARKERS), axis=0)
    last: HandSolution | None = None
    joint_mm: list[float] = []
    pip_deg: list[float] = []
    for T, truth, seen in zip(poses, angles, points, strict=True):
        last = solver.solve(seen, cov, last, 1 / 60)
        assert last is not None
        error = last.joints.position_m - model.forward(T, truth).position_m
        joint_mm.append(1e3 * float(np.linalg.norm(error, axis=1).mean()))
        pip_deg.append(float(np.degrees(np.abs(last.angles_rad[1:, 2] - truth[1:, 2])).mean()))
    frames = itertools.cycle(points)
    state = [last]

    def warm() -> object:
        state[0] = solver.solve(next(frames), cov, state[0], 1 / 60)
        return state[0]

    one, spread = median_us(warm, 300)
    general, general_spread = median_us(lambda: _general(model, points[0], poses[0]), 5, 1)
    fixed = _fixed_palm_mm(model, poses, angles, points)
    return [
        Row("whole hand, warm", one, "us", f"± {spread:.0f}; goal 1500"),
        Row(
            "general least squares on the same markers (scipy)",
            general,
            "us",
            f"± {general_spread:.0f}; baseline",
        ),
        Row("times faster", general / one, "x", ""),
        Row("joint error, palm turning ± 20 deg", float(np.mean(joint_mm)), "mm", "goal 6"),
        Row("the same with the palm's rotation taken as fixed", fixed, "mm", "baseline (about 15)"),
        Row("PIP error", float(np.mean(pip_deg)), "deg", "goal 7.5"),
    ]


def _motion(model: HandModel) -> tuple[Float, Float, Float]:
    """Palm poses (T, 4, 4), angles (T, 5, 4) and noisy caps (T, M, 3)."""
    rng = np.random.default_rng(7)
    t = np.arange(_FRAMES) / 60.0
    facing = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]])
    turn = np.radians(20.0) * np.stack(
        [np.sin(1.1 * t), np.sin(0.8 * t + 1.0), np.sin(0.9 * t + 2.0)], axis=1
    )
    poses = np.stack(
        [rigid(rotation_vector_to_matrix(v) @ facing, np.array([0.03, 0.08, 0.5])) for v in turn]
    )
    angles = np.zeros((_FRAMES, 5, 4))
    phase = rng.uniform(0, 2 * np.pi, 5)
    bend = 0.5 + 0.4 * np.sin(2.0 * t[:, None] + phase)
    angles[:, :, 2] = bend
    angles[:, 1:, 1] = 0.6 * bend[:, 1:] + 0.1 * np.sin(1.3 * t)[:, None]
    angles[:, 1:, 3] = (model.dip_per_pip or 0.0) * bend[:, 1:]
    angles[:, 0] = np.stack([0.2 + 0 * t, 0.2 + 0.1 * bend[:, 0], 0.3 * bend[:, 0], 0.4 * bend[:, 0]], axis=1)
    joints = model.forward(poses, angles)
    points = model.marker_points(joints, _MARKERS)
    return poses, angles, points + rng.normal(size=points.shape) * _SIGMA_M


def _general(model: HandModel, points: Float, T: Float) -> Float:
    """The same unknowns for a solver that knows nothing of hands: numerical Jacobian, dense trust region."""

    def residual(x: Float) -> Float:
        pose = rigid(rotation_vector_to_matrix(x[:3]) @ T[:3, :3], x[3:6])
        angles = np.zeros((5, 4))
        angles[0], angles[1:, :3] = x[6:10], x[10:].reshape(4, 3)
        angles[1:, 3] = (model.dip_per_pip or 0.0) * angles[1:, 2]
        model_points = model.marker_points(model.forward(pose, angles), _MARKERS)
        return np.concatenate([((model_points - points) / _SIGMA_M).ravel(), x[6:]])

    start = np.concatenate([np.zeros(3), T[:3, 3], np.full(16, 0.2)])
    return np.asarray(least_squares(residual, start).x, np.float64)


def _fixed_palm_mm(model: HandModel, poses: Float, angles: Float, points: Float) -> float:
    """Mean joint error when the palm only follows its marker and the fingers are solved exactly to their caps."""
    from master.ik.finger import FingerSolver

    solvers = [FingerSolver.of(model, f, model.mount(name).offset_m) for f, name in enumerate(_MARKERS[:5])]
    facing = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]])
    back = model.mount("back").offset_m
    errors: list[float] = []
    for T, truth, seen in zip(poses[::4], angles[::4], points[::4], strict=True):
        guess = rigid(facing, seen[5] - facing @ back)
        local = (seen[:5] - guess[:3, 3]) @ facing
        found = np.array([solvers[f].solve((p[0], p[1], p[2]))[:4] for f, p in enumerate(local.tolist())])
        error = model.forward(guess, found).position_m - model.forward(T, truth).position_m
        errors.append(1e3 * float(np.linalg.norm(error, axis=1).mean()))
    return float(np.mean(errors))
