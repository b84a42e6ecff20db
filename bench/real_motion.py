"""Hands that others recorded, as the truth: Leap motions, a held hand after the filter, static poses of WebXR joints.

**Motion**: the joints that the Leap recorded (`leapjs/*.npz`, model-based: bones are constant, the DIP bends as the
PIP) are the truth themselves. A profile is made from the same joints (`common.hand.fitting`); its DIP is coupled 1 : 1,
its limits are D, widened for fingers bent back up to 30 degrees, thumbs 20, and for 30 degrees of abduction (the little
finger 45). Caps on the five tips and one on the back, 1 mm of noise, go through estimator and filter at the recorded
times. The cameras are where they see the back of the hand in the mean, and the cap there is hidden beyond 75 degrees.
Wrist and metacarpals were not recorded; the error is the mean over the 20 recorded joints. Where a recorded hand
changes its size, the recording is cut and each piece has a profile of its own.

**Held**: generated hands, 1 mm of noise, 60 frames a second; what is left after the filter, over time.

**Poses**: WebXR joints of seven poses (`handy_poses`, both hands), profile from the flat one with the same limits, DIP
coupled as by default, solved afresh. In the fist the thumb's root is 14 mm off its place: no profile follows.
"""

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares  # pyright: ignore[reportUnknownVariableType]

from bench.hand_draws import FACING_ROTATION, MARKERS
from bench.row import Row
from bench.solved_hand import TOWARDS, PointHand
from common.arrays import Float, Int
from common.calibration import Couplings, FilterCalibration, FingerLimits, Limits
from common.geometry.transforms import matrix_to_rotation_vector, rigid
from common.hand.fitting import profile_from_joints, profile_from_rest
from common.hand.model import CHAINS, FINGERS, HandModel
from common.hand.profiles import generated_profile
from common.recording.npz import read_npz
from common.sim.leap import KEYS, RIG_FROM_LEAP, palm_rotation
from master.estimator.epoch import FittedHand
from master.estimator.smooth import HandOneEuro
from master.fabrik.one_euro import OneEuroParameters

SIGMA_M = 1e-3
_ROOT = Path(__file__).parent.parent
_SIZE_M = 1e-4  # bones that differ by more belong to another hand
_SHORTEST_S = 0.5
_HIDDEN = np.cos(np.radians(75.0))
_FIXED = 40  # frames per recording in which the profile is judged without noise
_PERIOD_NS = 16_666_667
FACING = FACING_ROTATION  # fingers up, back to the cameras


@dataclass(frozen=True, slots=True, eq=False)
class Recorded:
    """One hand in motion.

    Attributes:
        name, side: Of the recording.
        t_ns: (T,) times.
        T_rig_palm: (T, 4, 4); the origin is level with the thumb's root.
        fingers_m: (T, 5, 4, 3) [m] joints of `CHAINS`, palm frame.
    """

    name: str
    side: str
    t_ns: Int
    T_rig_palm: Float
    fingers_m: Float

    def model(self) -> HandModel:
        """The recorded hand."""
        limits, couplings = wide_limits(), Couplings(dip_per_pip=1.0)
        return HandModel.of(profile_from_joints(self.name, self.side, self.fingers_m, limits, couplings))

    def in_rig(self) -> Float:
        """The joints (T, 20, 3) [m], rig frame."""
        R, p = self.T_rig_palm[:, :3, :3], self.T_rig_palm[:, None, :3, 3]
        return self.fingers_m.reshape(-1, 20, 3) @ np.swapaxes(R, 1, 2) + p


@dataclass(frozen=True, slots=True, eq=False)
class Score:
    """Errors of one recording: joints (T, 20) [m] as solved and as shown, PIP (T, 4) [deg] as shown."""

    solved_m: Float
    shown_m: Float
    pip_deg: Float


def rows() -> Iterator[Row]:
    """All three parts; a row that says so where the data are absent."""
    data = Path(os.environ.get("PHALANX_DATASETS", _ROOT / "../shared/datasets")).resolve()
    yield from _held_rows()
    if not (data / "leapjs").is_dir() or not (data / "handy_poses").is_dir():
        yield Row("recorded: skipped", 0.0, "", f"no recordings at {data}: set PHALANX_DATASETS")
        return
    yield from _motion_rows(data / "leapjs")
    yield from _pose_rows(data / "handy_poses" / "poses.npz")


def wide_limits() -> Limits:
    """Limits D (`common.calibration.hand_presets`), wide enough for the hands that the Leap reports."""

    def finger(abduction: float) -> FingerLimits:
        return _limits((-abduction, abduction), (-30.0, 100.0), (-5.0, 120.0), (-5.0, 120.0))

    thumb = _limits((-25.0, 50.0), (-35.0, 50.0), (-20.0, 60.0), (-20.0, 85.0))
    return Limits(
        thumb=thumb, index=finger(30.0), middle=finger(30.0), ring=finger(30.0), little=finger(45.0)
    )


def _limits(
    abduction: tuple[float, float],
    flexion: tuple[float, float],
    pip: tuple[float, float],
    dip: tuple[float, float],
) -> FingerLimits:
    spans = [
        (float(np.radians(low)), float(np.radians(high))) for low, high in (abduction, flexion, pip, dip)
    ]
    return FingerLimits(abduction_rad=spans[0], flexion_rad=spans[1], pip_rad=spans[2], dip_rad=spans[3])


def recordings(folder: Path) -> Iterator[Recorded]:
    """The hands of all recordings, cut where their bones change."""
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
        changes: list[int] = (np.flatnonzero(np.abs(np.diff(size)) > _SIZE_M) + 1).tolist()
        for a, b in zip([0, *changes], [*changes, len(t)], strict=True):
            if t[b - 1] - t[a] >= _SHORTEST_S:
                when: Int = np.asarray(np.round((t[a:b] - t[a]) * 1e9), np.int64)
                part = f" from {t[a] - t[0]:.0f} s" if a else ""
                yield Recorded(
                    path.stem + part, str(data["hand0_type"]), when, poses[a:b], local[a:b] - wrist
                )


def play(recorded: Recorded, model: HandModel, seed: int) -> Score:
    """The recording through estimator and filter."""
    truth = recorded.in_rig()
    back = model.mount("back").offset_m
    points = np.concatenate(
        [truth[:, 3::4], (recorded.T_rig_palm[:, :3, :3] @ back + recorded.T_rig_palm[:, :3, 3])[:, None]],
        axis=1,
    )
    points = points + np.random.default_rng(seed).normal(0.0, SIGMA_M, points.shape)
    dorsal = recorded.T_rig_palm[:, :3, 1]
    towards = dorsal.mean(axis=0) / np.linalg.norm(dorsal.mean(axis=0))
    points[dorsal @ towards < _HIDDEN, 5] = np.nan
    solved, shown = _track(model, recorded.t_ns, points, towards)

    def places(hands: list[FittedHand]) -> Float:
        return np.array([hand.joints.position_m[CHAINS].reshape(20, 3) for hand in hands])

    pip = pip_deg(places(shown)) - pip_deg(truth)
    return Score(
        np.linalg.norm(places(solved) - truth, axis=2),
        np.linalg.norm(places(shown) - truth, axis=2),
        np.abs(pip),
    )


def floor_m(recorded: Recorded, model: HandModel) -> Float:
    """How far the profile's joints are from the recorded ones at best (N, 20) [m]: palm known, angles free."""
    chosen = recorded.fingers_m[:: max(1, len(recorded.fingers_m) // _FIXED)]
    out: list[Float] = []
    start = np.zeros(20)
    for fingers in chosen:

        def off(x: Float, fingers: Float = fingers) -> Float:
            return (1e3 * (model.chains(x.reshape(5, 4)).position_m - fingers)).ravel()

        start = np.asarray(least_squares(off, start).x, np.float64)
        out.append(1e-3 * np.linalg.norm(off(start).reshape(20, 3), axis=1))
    return np.array(out)


def _track(
    model: HandModel, t_ns: Int, points: Float, towards: Float = TOWARDS
) -> tuple[list[FittedHand], list[FittedHand]]:
    """Solved and shown hands of caps (T, 6, 3) with 1 mm of noise."""
    solver = PointHand(model, MARKERS)
    smooth = HandOneEuro(model, MARKERS, OneEuroParameters.of(FilterCalibration()))
    solved: list[FittedHand] = []
    shown: list[FittedHand] = []
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
    """Angles (T, 4) [deg] between proximal and intermediate bones of index ... little of joints (T, 20, 3)."""
    bones = np.diff(places.reshape(-1, 5, 4, 3)[:, 1:], axis=2)
    bones = bones / np.linalg.norm(bones, axis=3, keepdims=True)
    return np.degrees(np.arccos(np.clip((bones[:, :, 0] * bones[:, :, 1]).sum(axis=2), -1.0, 1.0)))


def _motion_rows(folder: Path) -> Iterator[Row]:
    everything: list[Score] = []
    floors: list[Float] = []
    for recorded in recordings(folder):
        model = recorded.model()
        score = play(recorded, model, seed=len(everything))
        floors.append(floor_m(recorded, model))
        everything.append(score)
        yield Row(
            f"{recorded.name}: joints, mean",
            1e3 * float(score.shown_m.mean()),
            "mm",
            f"goal 5; 95 % {1e3 * np.percentile(score.shown_m, 95):.1f}; before the filter"
            f" {1e3 * score.solved_m.mean():.2f}; PIP {score.pip_deg.mean():.1f} deg",
        )
    shown = 1e3 * np.concatenate([score.shown_m for score in everything])
    fingers = shown.reshape(-1, 5, 4).mean(axis=(0, 2))
    each = ", ".join(f"{name} {value:.1f}" for name, value in zip(FINGERS, fingers, strict=True))
    yield Row("all frames: joints, mean", float(shown.mean()), "mm", f"goal 5; {each}")
    yield Row(
        "all frames: PIP, mean", float(np.concatenate([s.pip_deg for s in everything]).mean()), "deg", ""
    )
    floor = 1e3 * np.concatenate(floors)
    yield Row(
        "what the profile cannot follow, mean",
        float(floor.mean()),
        "mm",
        f"worst {floor.max():.2f}; no noise",
    )


def held_poses(model: HandModel) -> dict[str, Float]:
    """Angles (5, 4) [rad] of the poses in which a hand is held."""

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
    """Standard deviations over time, RMS over joints: places [mm], angles [deg], turns [deg], all axes together."""
    places = np.array([hand.joints.position_m for hand in hands])
    angles = np.array([hand.angles_rad for hand in hands])
    frames = np.array([hand.joints.rotation for hand in hands])
    rotations = matrix_to_rotation_vector(frames @ np.swapaxes(frames[:1], -1, -2))
    variances = (places.var(axis=0).sum(axis=1), angles.var(axis=0), rotations.var(axis=0).sum(axis=1))
    place, angle, rotation = (float(np.sqrt(variance.mean())) for variance in variances)
    return 1e3 * place, float(np.degrees(angle)), float(np.degrees(rotation))


def _held_rows(seeds: int = 5, frames: int = 300, settled: int = 60) -> Iterator[Row]:
    model = HandModel.of(generated_profile("held", "right"))
    T = rigid(FACING, np.array([0.03, 0.08, 0.5]))
    t_ns = _PERIOD_NS * np.arange(frames)
    for name, angles in held_poses(model).items():
        caps = model.marker_points(model.forward(T, angles), MARKERS)
        before: list[tuple[float, float, float]] = []
        after: list[tuple[float, float, float]] = []
        for seed in range(seeds):
            noise = np.random.default_rng(seed).normal(0.0, SIGMA_M, (frames, 6, 3))
            solved, shown = _track(model, t_ns, caps + noise)
            before.append(jitter(solved[settled:]))
            after.append(jitter(shown[settled:]))
        raw, left, worst = np.mean(before, axis=0), np.mean(after, axis=0), np.max(after, axis=0)
        parts = zip(
            ("joints", "angles", "turns of joints"), ("mm", "deg", "deg"), (0.5, 1.0, 1.0), strict=True
        )
        for k, (what, unit, goal) in enumerate(parts):
            note = f"goal {goal}; worst of {seeds} seeds {worst[k]:.2f}, before the filter {raw[k]:.2f}"
            yield Row(f"held, {name}: jitter of {what}", float(left[k]), unit, note)


def _pose_rows(path: Path, seeds: int = 10) -> Iterator[Row]:
    data = read_npz(path)
    names = [name for name in data if np.shape(data[name]) == (2, 25, 4, 4)]
    rng, limits = np.random.default_rng(1), wide_limits()
    for name in ("flat", "fist", *(name for name in names if name not in ("flat", "fist"))):
        clean: list[Float] = []
        noisy: list[Float] = []
        for side, flat, T in zip(
            data["hands"], data["flat"], np.asarray(data[name], np.float64), strict=True
        ):
            flat = np.asarray(flat, np.float64)
            model = HandModel.of(
                profile_from_rest(str(side), str(side), flat[:, :3, 3], flat[:, :3, :3], limits)
            )
            clean.append(_pose_error(model, T, None))
            noisy += [_pose_error(model, T, rng) for _ in range(seeds)]
        exact, mean = np.array(clean), np.array(noisy)
        yield Row(
            f"WebXR {name}: PIP, exact caps",
            float(exact.mean()),
            "deg",
            f"{'goal 6; ' if name in ('flat', 'fist') else ''}worst {exact.max():.1f}"
            f"{' (goal 10)' if name in ('flat', 'fist') else ''}; with 1 mm of noise mean {mean.mean():.1f},"
            f" worst finger {mean.mean(axis=0).max():.1f}",
        )


def _pose_error(model: HandModel, joints: Float, rng: np.random.Generator | None) -> Float:
    """PIP errors (4,) [deg] of a pose (25, 4, 4) in the frame of its wrist."""
    T = rigid(FACING, np.array([0.0, 0.08, 0.5]))
    places = (joints[:, :3, 3] @ np.diag([-1.0, 1.0, -1.0])) @ T[:3, :3].T + T[:3, 3]
    truth = places[CHAINS - 1].reshape(1, 20, 3)
    caps = np.vstack([truth[0, 3::4], T[:3, :3] @ model.mount("back").offset_m + T[:3, 3]])
    if rng is not None:
        caps = caps + rng.normal(0.0, SIGMA_M, caps.shape)
    cov = np.tile(SIGMA_M**2 * np.eye(3), (6, 1, 1))
    hand = PointHand(model, MARKERS, continuous=False).push(0, caps, cov)
    assert hand.solution is not None
    found = hand.solution.joints.position_m[CHAINS].reshape(1, 20, 3)
    return np.abs(pip_deg(found) - pip_deg(truth))[0]
