"""Two hands painted alike, rendered, detected and solved: they cross at 10 cm, hide each other, leave and come back."""

import json
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest

from common.arrays import Bool, Float
from common.calibration import CameraCalibration, HandProfile, RigCalibration, load
from common.sim.motion import HandMotion, HandState
from common.sim.record import record_scene
from common.sim.scene import Scene
from common.sim.scenes import scene_by_name
from tests.replay.replayed import Replay, replay

CALIBRATION = Path(__file__).parents[2] / "calib_json"
HANDS = MappingProxyType(
    {"default-right": ("poses.npz", ""), "default-left": ("poses-default-left.npz", "_default-left")}
)


def scene_of(seed: int) -> Scene:
    rig = load(CALIBRATION / "rigs" / "desk-both.json", RigCalibration)
    cameras = {
        name: load(CALIBRATION / "cameras" / f"{name}.json", CameraCalibration) for name in rig.cameras
    }
    first, second = (load(CALIBRATION / "hands" / f"{name}.json", HandProfile) for name in HANDS)
    return scene_by_name("hands", rig, cameras, first, seed, None, (second,))


def played(folder: Path, scene: Scene, start_s: float, seconds: float) -> Replay:
    record_scene(folder / "recording", scene, seconds, start_s)
    (folder / "out").mkdir()
    return replay(folder / "recording", folder / "out", "--calibration", CALIBRATION)


def error_mm(run: Replay, hand: str, truth: Float) -> Float:
    """Mean joint error of each row of the truth; NaN: no pose of it is valid."""
    with np.load(run.out / HANDS[hand][0]) as poses:
        t_s, valid, joints = (
            poses["t_ns"] * 1e-9 - 1.0,
            poses["valid"].all(axis=1),
            poses["position_m"][:, 1:],
        )
    rows = np.abs(t_s[:, None] - run.truth()["t_ref"]).argmin(axis=1)
    out = np.full(len(truth), np.nan)
    out[rows[valid]] = 1e3 * np.linalg.norm(joints[valid] - truth[rows[valid]], axis=2).mean(axis=1)
    return out


def swaps(run: Replay) -> int:
    """Poses that are nearer to the other hand's truth than to their own."""
    truth, count = run.truth(), 0
    keys = [f"joints{suffix}" for _, suffix in HANDS.values()]
    for hand, own, other in zip(HANDS, keys, keys[::-1], strict=True):
        count += int((error_mm(run, hand, truth[own]) > error_mm(run, hand, truth[other])).sum())
    return count


def hidden_by_other(run: Replay, alone: Replay, suffix: str) -> Bool:
    """In which rows the other hand hides a part of more than two markers, or did a tenth of a second ago."""
    less = np.nan_to_num(alone.truth()["frac"]) - np.nan_to_num(run.truth()[f"frac{suffix}"])
    hidden = (less > 0.1).any(axis=1).sum(axis=1) > 2
    return np.asarray([hidden[max(k - 6, 0) : k + 1].any() for k in range(len(hidden))])


@pytest.fixture(scope="module")
def crossing(tmp_path_factory: pytest.TempPathFactory) -> tuple[Replay, dict[str, Replay]]:
    """They start together, cross in depth and lie side by side; and each of them alone in the same motion."""
    scene = scene_of(7)
    folder = tmp_path_factory.mktemp("crossing")
    hands = (scene, *scene.others)
    alone = {one.rig.hand: replace(one, others=(), watched=None) for one in hands}
    runs = {name: played(folder / name, one, 0.5, 5.3) for name, one in alone.items()}
    return played(folder / "both", scene, 0.5, 5.3), runs


def test_hands_that_cross_at_ten_centimetres_never_swap(crossing: tuple[Replay, dict[str, Replay]]) -> None:
    both, _ = crossing
    T = both.truth()
    apart = np.linalg.norm(T["joints"][:, 9] - T["joints_default-left"][:, 9], axis=1)
    assert apart.min() < 0.12, "they pass each other closely, or nothing is tested"
    sides = T["joints"][:, 9, 0] - T["joints_default-left"][:, 9, 0]
    assert sides[0] > 0.1, "the right hand is on the right"
    assert sides[-1] < -0.05, "and crosses"
    assert swaps(both) == 0


def test_each_hand_is_as_good_as_alone(crossing: tuple[Replay, dict[str, Replay]]) -> None:
    both, alone = crossing
    for hand, (_, suffix) in HANDS.items():
        joints = both.truth()[f"joints{suffix}"]
        with np.load(alone[hand].out / "poses.npz") as poses:
            t_s, valid = poses["t_ns"] * 1e-9 - 1.0, poses["valid"].all(axis=1)
            rows = np.abs(t_s[:, None] - both.truth()["t_ref"]).argmin(axis=1)
            single = np.full(len(joints), np.nan)
            off = np.linalg.norm(poses["position_m"][:, 1:] - joints[rows], axis=2).mean(axis=1)
            single[rows[valid]] = 1e3 * off[valid]
        found = error_mm(both, hand, joints)
        shown = np.isfinite(single) & ~hidden_by_other(both, alone[hand], suffix)
        shown[:48] = False  # 0.8 s: alone it begins a frame earlier, with all its markers
        assert np.isfinite(found[shown]).mean() > 0.98, f"{hand} is published"
        assert np.nanmean(found[shown]) <= 1.2 * single[shown].mean(), hand


def test_both_are_published_with_a_summary_of_their_own(crossing: tuple[Replay, dict[str, Replay]]) -> None:
    both, _ = crossing
    for name in ("summary.json", "summary-default-left.json"):
        summary = json.loads((both.out / name).read_text())
        assert summary["poses_valid"] > 0.95 * summary["poses"]
        assert summary["joint_mm"] < 10.0


def test_a_hidden_hand_and_one_that_comes_back_on_the_other_side_are_themselves(tmp_path: Path) -> None:
    run = played(tmp_path, scene_of(7), 10.6, 6.0)
    truth = run.truth()
    seen = (np.nan_to_num(truth["frac_default-left"]) > 0.3).sum(axis=2).min(axis=1)
    assert (seen <= 2).sum() > 18, "0.3 s and more behind the other, or away"
    assert swaps(run) == 0
    left = error_mm(run, "default-left", truth["joints_default-left"])
    assert np.isnan(left[(truth["t_ref"] > 14.5) & (truth["t_ref"] < 15.0)]).all(), (
        "one that is away is not published"
    )
    assert np.nanmean(left[-20:]) < 10.0, "it is there again"
    right = error_mm(run, "default-right", truth["joints"])
    assert np.nanmax(right[10:]) < 30.0, "and stole nothing from the hand that stayed"


class Away:
    """A motion that is nowhere in view."""

    def __init__(self, motion: HandMotion) -> None:
        self._motion, self.period_s = motion, motion.period_s

    def at(self, t_s: float) -> HandState:
        state = self._motion.at(t_s)
        pose = state.T_rig_palm.copy()
        pose[1, 3] += 2.0
        return replace(state, T_rig_palm=pose)


@pytest.mark.parametrize("shown", HANDS)
def test_a_hand_that_shows_alone_is_not_the_other(tmp_path: Path, shown: str) -> None:
    right = scene_of(3)
    (left,) = right.others
    if shown == "default-right":
        left = replace(left, motion=Away(left.motion))
    else:
        right = replace(right, motion=Away(right.motion))
    run = played(tmp_path, replace(right, others=(left,)), 0.0, 0.4)
    for hand, (name, _) in HANDS.items():
        with np.load(run.out / name) as poses:
            assert poses["valid"].any() == (hand == shown), hand
