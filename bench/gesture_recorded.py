"""Study poses of hands that others recorded: static WebXR hands, and events in Leap motion (see `gesture_poses`)."""

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from bench.hand_draws import FACING_ROTATION, MARKERS
from bench.real_motion import SIGMA_M, Recorded, recordings, wide_limits
from bench.recognised_poses import pose_of, recognised_in
from bench.row import Row
from bench.solved_hand import PointHand
from common.arrays import Float
from common.calibration import FilterCalibration
from common.geometry.transforms import matrix_to_quaternion, rigid
from common.hand.fitting import profile_from_rest
from common.hand.model import CHAINS, HandModel
from common.messages import HandPose
from common.recording.npz import read_npz
from common.sim.motion import POSES
from master.estimator.smooth import HandOneEuro
from master.fabrik.one_euro import OneEuroParameters

_ROOT = Path(__file__).parent.parent
_PERIOD_NS = 16_666_667
_FRAMES, _SEEDS = 12, 5
_HIDDEN = np.cos(np.radians(75.0))
MEANT: dict[str, str | None] = {
    "flat": "open_palm",
    "point": "pointing",
    "fist": "small_grasp",
    "horns": None,
    "shaka": None,
}
_STRETCHED_DEG, _BENT_DEG = 50.0, 85.0  # bends of the recorded joints, MCP and PIP together
_PINCHED_M, _GRASPED_M = 0.075, 0.045  # from the thumb's tip joint to that of the index: at most, at least


def static_rows() -> Iterator[Row]:
    """handy_poses, both hands."""
    path = _data() / "handy_poses" / "poses.npz"
    if not path.exists():
        yield Row("handy_poses: skipped", 0.0, "", f"not at {path}: set PHALANX_DATASETS")
        return
    data = read_npz(path)
    names = [name for name in data if np.shape(data[name]) == (2, 25, 4, 4)]
    right, count = 0, 0
    lines: list[Row] = []
    for row, side in enumerate(data["hands"]):
        flat = np.asarray(data["flat"][row], np.float64)
        profile = profile_from_rest(str(side), str(side), flat[:, :3, 3], flat[:, :3, :3], wide_limits())
        model = HandModel.of(profile)
        for name in names:
            joints = np.asarray(data[name][row], np.float64)
            annotations = [_static(model, joints, seed) for seed in range(_SEEDS)]
            if name in MEANT:
                good = sum(one == MEANT[name] for one in annotations)
                right, count = right + good, count + _SEEDS
                if good < _SEEDS:
                    lines.append(Row(f"  {side} {name}", 100.0 * good / _SEEDS, "%", f"told {annotations}"))
            else:
                lines.append(Row(f"  {side} {name}: not judged", 0.0, "", f"told {annotations[0]}"))
    yield Row("handy_poses: holds right", 100.0 * right / count, "%", f"goal 98; of {count}")
    yield from lines


def leap_rows() -> Iterator[Row]:
    """leapjs: events, and those that the recorded joints contradict."""
    folder = _data() / "leapjs"
    if not folder.is_dir():
        yield Row("leapjs: skipped", 0.0, "", f"not at {folder}: set PHALANX_DATASETS")
        return
    wrong, count, seconds = 0, 0, 0.0
    lines: list[Row] = []
    for seed, recorded in enumerate(recordings(folder)):
        recognised = recognised_in(_shown(recorded, recorded.model(), seed), recorded.model())
        begun = [
            k
            for k in range(len(recognised))
            if recognised[k] is not None and (k == 0 or recognised[k] != recognised[k - 1])
        ]
        bad = [k for k in begun if not agrees(str(recognised[k]), recorded.fingers_m[k])]
        wrong, count, seconds = (
            wrong + len(bad),
            count + len(begun),
            seconds + 1e-9 * float(recorded.t_ns[-1]),
        )
        names = ", ".join(str(recognised[k]) for k in begun) or "nothing"
        lines.append(Row(f"  {recorded.name}: events", float(len(begun)), "", names))
    yield Row("leapjs: wrong poses told", float(wrong), "", f"goal 0; of {count} in {seconds:.0f} s")
    yield from lines


def agrees(name: str, fingers_m: Float) -> bool:
    """Whether joints (5, 4, 3) [m] in the palm frame may be such a pose, by bends and the gap of thumb and index."""
    bone = np.diff(fingers_m[1:], axis=1)
    bone = bone / np.linalg.norm(bone, axis=2, keepdims=True)
    # Fingers spread to the side are no less stretched: of the first bone only what it leaves the palm's plane by.
    lowered = np.arctan2(-bone[:, 0, 1], bone[:, 0, 2])
    bends = np.degrees(lowered + np.arccos(np.clip((bone[:, 0] * bone[:, 1]).sum(axis=-1), -1.0, 1.0)))
    stretched, bent = bends < _STRETCHED_DEG, bends > _BENT_DEG
    gap = float(np.linalg.norm(fingers_m[0, 3] - fingers_m[1, 3]))
    rules = {
        "open_palm": stretched.all(),
        "counting_two": stretched[:2].all() and bent[2:].all(),
        "pointing": stretched[0] and bent[1:].all(),
        "small_grasp": bent.all(),
        "large_grasp": not stretched.all() and gap > _GRASPED_M,
        "pinch": gap < _PINCHED_M and not stretched[0],
    }
    assert set(rules) == set(POSES)
    return bool(rules[name])


def _static(model: HandModel, joints: Float, seed: int) -> str | None:
    """What is held after some frames of a pose (25, 4, 4) in the frame of its wrist, markers with noise."""
    T = rigid(FACING_ROTATION, np.array([0.0, 0.08, 0.5]))
    places = (joints[:, :3, 3] @ np.diag([-1.0, 1.0, -1.0])) @ T[:3, :3].T + T[:3, 3]
    tips = places[CHAINS[:, 3] - 1]
    caps = np.vstack([tips, T[:3, :3] @ model.mount("back").offset_m + T[:3, 3]])
    points = np.tile(caps, (_FRAMES, 1, 1))
    t_ns = [k * _PERIOD_NS for k in range(_FRAMES)]
    return recognised_in(_solved(model, t_ns, points, -T[:3, 3] / np.linalg.norm(T[:3, 3]), seed), model)[-1]


def _shown(recorded: Recorded, model: HandModel, seed: int) -> list[HandPose]:
    """A recording through estimator and filter; its back is hidden where it is turned away."""
    R, p = recorded.T_rig_palm[:, :3, :3], recorded.T_rig_palm[:, :3, 3]
    back = (R @ model.mount("back").offset_m + p)[:, None]
    points = np.concatenate([recorded.in_rig()[:, 3::4], back], axis=1)
    towards = R[:, :, 1].mean(axis=0) / np.linalg.norm(R[:, :, 1].mean(axis=0))
    points[R[:, :, 1] @ towards < _HIDDEN, 5] = np.nan
    return _solved(model, recorded.t_ns.tolist(), points, towards, seed)


def _solved(model: HandModel, t_ns: list[int], points: Float, towards: Float, seed: int) -> list[HandPose]:
    """Poses of caps (T, 6, 3) [m] with noise added."""
    solver = PointHand(model, MARKERS)
    smooth = HandOneEuro(model, MARKERS, OneEuroParameters.of(FilterCalibration()))
    noisy = points + np.random.default_rng([seed, 17]).normal(0.0, SIGMA_M, points.shape)
    out: list[HandPose] = []
    for t, seen in zip(t_ns, noisy, strict=True):
        cov = np.where(np.isfinite(seen[:, :1, None]), SIGMA_M**2 * np.eye(3), np.nan)
        hand = smooth.push(t, solver.push(t, seen, cov, towards), cov).solution
        assert hand is not None
        orientation = matrix_to_quaternion(hand.joints.rotation)
        out.append(pose_of(model, t, hand.joints.position_m, orientation, hand.angles_rad))
    return out


def _data() -> Path:
    return Path(os.environ.get("PHALANX_DATASETS", _ROOT / "../shared/datasets")).resolve()
