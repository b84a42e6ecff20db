"""Hands that others recorded, as the truth, through solver and filter; and held hands.

**Motion**: the joints that the Leap recorded (`leapjs/*.npz`) are the truth. A profile is made from the same joints
(`common.hand.fitting`), its DIP coupled 1 : 1, its limits wide. Caps on the five tips and one on the back, 1 mm of
noise, go through estimator and filter; the one on the back is hidden beyond 75 degrees. Errors are of the 20 recorded
joints.

**Held**: generated hands, 1 mm of noise, 60 frames a second; what is left after the filter, over time.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares  # pyright: ignore[reportUnknownVariableType]

from bench.hands.draws import EDGE_ON, FACING_ROTATION, MARKERS, TOWARDS, PointHand
from bench.report import Row, datasets, skipped
from common.arrays import Float, Int
from common.calibration import Couplings, FilterCalibration, FingerLimits, Limits
from common.geometry.transforms import matrix_to_rotation_vector, rigid
from common.hand.fitting import profile_from_joints
from common.hand.model import CHAINS, FINGERS, HandModel
from common.hand.profiles import generated_profile
from common.recording.recorded_files import read_npz
from common.sim.people import KEYS, RIG_FROM_LEAP, palm_rotation
from master.estimator.epoch import FittedHand
from master.estimator.smoothing import HandOneEuro
from master.fabrik.one_euro import OneEuroParameters

SIGMA_M = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class Recorded:
    """One hand in motion."""

    name: str
    side: str
    t_ns: Int  # (T,) times
    T_rig_palm: Float  # (T, 4, 4); the origin is level with the thumb's root
    fingers_m: Float  # (T, 5, 4, 3) [m] joints of `CHAINS`, palm frame

    def model(self) -> HandModel:
        """Return the recorded hand."""
        couplings = Couplings(dip_per_pip=1.0)
        return HandModel.of(
            profile_from_joints(self.name, self.side, self.fingers_m, wide_limits(), couplings)
        )

    def in_rig(self) -> Float:
        """Return the joints (T, 20, 3) [m], rig frame."""
        R, p = self.T_rig_palm[:, :3, :3], self.T_rig_palm[:, None, :3, 3]
        return self.fingers_m.reshape(-1, 20, 3) @ np.swapaxes(R, 1, 2) + p

    def caps(self, model: HandModel) -> tuple[Float, Float]:
        """Return caps (T, 6, 3) [m] without noise, NaN: turned away, and the direction (3,) to the cameras."""
        R, p = self.T_rig_palm[:, :3, :3], self.T_rig_palm[:, :3, 3]
        back = (R @ model.mount("back").offset_m + p)[:, None]
        points = np.concatenate([self.in_rig()[:, 3::4], back], axis=1)
        towards = R[:, :, 1].mean(axis=0) / np.linalg.norm(R[:, :, 1].mean(axis=0))
        points[R[:, :, 1] @ towards < EDGE_ON, 5] = np.nan
        return points, towards


@dataclass(frozen=True, slots=True, eq=False)
class Score:
    """Errors of one recording: joints (T, 20) [m] as solved and as filtered, PIP (T, 4) [deg] as filtered."""

    solved_m: Float
    shown_m: Float
    pip_deg: Float


def rows() -> Iterator[Row]:
    """Measure both parts."""
    yield from _held_rows()
    if (datasets() / "leapjs").is_dir():
        yield from _motion_rows(datasets() / "leapjs")
    else:
        yield skipped("recorded", datasets() / "leapjs")


def wide_limits() -> Limits:
    """Return limits D (`common.hand.profiles`), wide enough for the hands that the Leap reports."""

    def limits(*spans_deg: tuple[float, float]) -> FingerLimits:
        a, f, p, d = ((float(np.radians(low)), float(np.radians(high))) for low, high in spans_deg)
        return FingerLimits(abduction_rad=a, flexion_rad=f, pip_rad=p, dip_rad=d)

    def finger(abduction: float) -> FingerLimits:
        return limits((-abduction, abduction), (-30.0, 100.0), (-5.0, 120.0), (-5.0, 120.0))

    thumb = limits((-25.0, 50.0), (-35.0, 50.0), (-20.0, 60.0), (-20.0, 85.0))
    three = finger(30.0)
    return Limits(thumb=thumb, index=three, middle=three, ring=three, little=finger(45.0))


def recordings(folder: Path) -> Iterator[Recorded]:
    """Read the hands of all recordings, cut where their bones change."""
    for path in sorted(folder.glob("*.npz")):
        data = read_npz(path, KEYS, f"not a Leap recording with {', '.join(KEYS)}")
        joints, palm, normal, direction = (
            np.asarray(data[key], np.float64) @ RIG_FROM_LEAP.T
            for key in ("hand0_joints", "hand0_palm", "hand0_normal", "hand0_direction")
        )
        known = np.isfinite(joints[:, 1:]).all(axis=(1, 2)) & np.isfinite(palm).all(axis=1)
        t = np.asarray(data["t"], np.float64)[known]
        chains = joints[known, 1:].reshape(-1, 5, 4, 3)
        R = palm_rotation(normal[known], direction[known])
        local = np.einsum("tji,tfkj->tfki", R, chains - palm[known, None, None])
        wrist = np.array([0.0, 0.0, float(np.median(local[:, 0, 0, 2]))])
        poses = np.array([rigid(r, p + r @ wrist) for r, p in zip(R, palm[known], strict=True)])
        size = np.linalg.norm(np.diff(chains, axis=2), axis=3).sum(axis=(1, 2))
        size_m = 1e-4  # bones that differ by more belong to another hand
        changes: list[int] = (np.flatnonzero(np.abs(np.diff(size)) > size_m) + 1).tolist()
        for a, b in zip([0, *changes], [*changes, len(t)], strict=True):
            if t[b - 1] - t[a] >= 0.5:
                when: Int = np.asarray(np.round((t[a:b] - t[a]) * 1e9), np.int64)
                name = path.stem + (f" from {t[a] - t[0]:.0f} s" if a else "")
                yield Recorded(name, str(data["hand0_type"]), when, poses[a:b], local[a:b] - wrist)


def play(recorded: Recorded, model: HandModel, seed: int) -> Score:
    """Solve and filter a recording, and compare."""
    truth = recorded.in_rig()
    points, towards = recorded.caps(model)
    points = points + np.random.default_rng(seed).normal(0.0, SIGMA_M, points.shape)
    solved, shown = track(model, recorded.t_ns, points, towards)
    before, after = (
        np.array([hand.joints.position_m[CHAINS].reshape(20, 3) for hand in hands])
        for hands in (solved, shown)
    )
    pip = np.abs(pip_deg(after) - pip_deg(truth))
    return Score(np.linalg.norm(before - truth, axis=2), np.linalg.norm(after - truth, axis=2), pip)


def floor_m(recorded: Recorded, model: HandModel) -> Float:
    """Return how far the profile's joints are from the recorded ones at best (N, 20) [m]: palm known, angles free."""
    fixed = 40  # frames per recording in which the profile is judged without noise
    fingers = recorded.fingers_m[:: max(1, len(recorded.fingers_m) // fixed)]
    found = model.chains(nearest(model, fingers).reshape(-1, 5, 4)).position_m
    return np.linalg.norm(found - fingers, axis=3).reshape(-1, 20)


def nearest(model: HandModel, fingers_m: Float, tolerance: float = 1e-8) -> Float:
    """Return the angles (N, 20) [rad] of a model that come nearest to joints (N, 5, 4, 3) [m], palm frame."""
    out = [np.zeros(20)]
    for fingers in fingers_m:

        def off(x: Float, fingers: Float = fingers) -> Float:
            return (1e3 * (model.chains(x.reshape(5, 4)).position_m - fingers)).ravel()

        out.append(np.asarray(least_squares(off, out[-1], xtol=tolerance, ftol=tolerance).x, np.float64))
    return np.array(out[1:])


def track(
    model: HandModel, t_ns: Int, points: Float, towards: Float = TOWARDS
) -> tuple[list[FittedHand], list[FittedHand]]:
    """Return solved and filtered hands of caps (T, 6, 3) with 1 mm of noise."""
    solver = PointHand(model, MARKERS)
    smooth = HandOneEuro(model, MARKERS, OneEuroParameters.of(FilterCalibration()))
    solved, shown = list[FittedHand](), list[FittedHand]()
    for t, seen in zip(t_ns.tolist(), points, strict=True):
        cov = np.where(np.isfinite(seen[:, :1, None]), SIGMA_M**2 * np.eye(3), np.nan)
        hand = solver.push(t, seen, cov, towards)
        filtered = smooth.push(t, hand, cov)
        assert hand.solution is not None
        assert filtered.solution is not None
        solved.append(hand.solution)
        shown.append(filtered.solution)
    return solved, shown


def pip_deg(places: Float) -> Float:
    """Return angles (T, 4) [deg] between proximal and middle bones of index ... little of joints (T, 20, 3)."""
    bones = np.diff(places.reshape(-1, 5, 4, 3)[:, 1:], axis=2)
    bones = bones / np.linalg.norm(bones, axis=3, keepdims=True)
    return np.degrees(np.arccos(np.clip((bones[:, :, 0] * bones[:, :, 1]).sum(axis=2), -1.0, 1.0)))


def _motion_rows(folder: Path) -> Iterator[Row]:
    every, floors = list[Score](), list[Float]()
    for recorded in recordings(folder):
        model = recorded.model()
        score = play(recorded, model, seed=len(every))
        floors.append(floor_m(recorded, model))
        every.append(score)
        note = (
            f"goal 5; 95 % {1e3 * np.percentile(score.shown_m, 95):.1f}; before the filter"
            f" {1e3 * score.solved_m.mean():.2f}; PIP {score.pip_deg.mean():.1f} deg"
        )
        yield Row(f"{recorded.name}: joints, mean", 1e3 * float(score.shown_m.mean()), "mm", note)
    shown = 1e3 * np.concatenate([score.shown_m for score in every])
    fingers = shown.reshape(-1, 5, 4).mean(axis=(0, 2))
    each = ", ".join(f"{name} {value:.1f}" for name, value in zip(FINGERS, fingers, strict=True))
    yield Row("all frames: joints, mean", float(shown.mean()), "mm", f"goal 5; {each}")
    yield Row("all frames: PIP, mean", float(np.concatenate([s.pip_deg for s in every]).mean()), "deg")
    floor = 1e3 * np.concatenate(floors)
    yield Row("joint error of the profile alone, mean", float(floor.mean()), "mm", f"worst {floor.max():.2f}")


def held_poses(model: HandModel) -> dict[str, Float]:
    """Return angles (5, 4) [rad] of the poses in which a hand is held."""

    def pose(pip: list[float], mcp: list[float], abduction: list[float], thumb: list[float]) -> Float:
        angles = np.zeros((5, 4))
        angles[0], angles[1:, 0], angles[1:, 1], angles[1:, 2] = thumb, abduction, mcp, pip
        angles[1:, 3] = (model.dip_per_pip or 0.0) * angles[1:, 2]
        return model.clamp(np.radians(angles))

    return {
        "open": pose([4, 4, 4, 4], [3, 3, 3, 3], [8, 0, -6, -10], [10, 5, 5, 5]),
        "relaxed": pose([30, 33, 36, 38], [18, 20, 24, 28], [0, 0, 0, 0], [10, 10, 15, 15]),
        "fist": pose([100, 102, 99, 95], [75, 80, 80, 78], [0, 0, 0, 0], [20, 35, 40, 50]),
        "pinch": pose([55, 30, 25, 20], [45, 20, 15, 10], [0, 0, 0, 0], [30, 30, 20, 30]),
    }


def jitter(hands: list[FittedHand]) -> tuple[float, float, float]:
    """Return standard deviations over time, RMS over joints: positions [mm], angles, orientations [deg]."""
    places = np.array([hand.joints.position_m for hand in hands])
    angles = np.array([hand.angles_rad for hand in hands])
    frames = np.array([hand.joints.rotation for hand in hands])
    rotations = matrix_to_rotation_vector(frames @ np.swapaxes(frames[:1], -1, -2))
    variances = (places.var(axis=0).sum(axis=1), angles.var(axis=0), rotations.var(axis=0).sum(axis=1))
    place, angle, rotation = (float(np.sqrt(variance.mean())) for variance in variances)
    return 1e3 * place, float(np.degrees(angle)), float(np.degrees(rotation))


def _held_rows() -> Iterator[Row]:
    model = HandModel.of(generated_profile("held", "right"))
    period_ns = 16_666_667
    seeds, frames, settled = 5, 300, 60  # of held hands
    T, t_ns = rigid(FACING_ROTATION, np.array([0.03, 0.08, 0.5])), period_ns * np.arange(frames)
    for name, angles in held_poses(model).items():
        caps = model.marker_points(model.forward(T, angles), MARKERS)
        noise = [np.random.default_rng(s).normal(0.0, SIGMA_M, (frames, 6, 3)) for s in range(seeds)]
        runs = [track(model, t_ns, caps + one) for one in noise]
        before, after = (np.array([jitter(run[k][settled:]) for run in runs]) for k in (0, 1))
        parts = (("joints", "mm", 0.5), ("angles", "deg", 1.0), ("orientations", "deg", 1.0))
        for k, (what, unit, goal) in enumerate(parts):
            worst, raw = after[:, k].max(), before[:, k].mean()
            note = f"goal {goal}; worst of {seeds} seeds {worst:.2f}, before the filter {raw:.2f}"
            yield Row(f"held, {name}: jitter of {what}", float(after[:, k].mean()), unit, note)
