"""A finger: angles out equal angles in; limits; targets out of reach; in place."""

import math
from functools import cache
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import least_squares

from common.arrays import Float
from common.calibration import Couplings, HandProfile, load
from common.hand.model import FINGERS, TIPS, HandModel
from common.hand.profiles import generated_profile, preset_couplings, preset_limits
from master.fabrik.joints import rotation
from master.fabrik.solver import NOT_SEEN, Finger, FingerSolution, Four

Preset = Literal["K", "D"]
DEGREE = math.pi / 180


@cache
def _model(side: str, preset: Preset) -> HandModel:
    profile = generated_profile("made", side)
    return HandModel.of(
        msgspec.structs.replace(profile, limits_rad=preset_limits(preset), couplings=preset_couplings(preset))
    )


@cache
def _solver(side: str, preset: Preset, finger: int) -> Finger:
    return _prepared(_model(side, preset), finger)


@cache
def _narrowed(share: float, soft: bool) -> HandModel:
    """A left hand whose fingers keep a share of their abduction; DIPs fixed or loose."""
    limits = preset_limits("D")
    fingers = {
        name: msgspec.structs.replace(getattr(limits, name), spread_at_full_flexion=share) for name in FINGERS
    }
    profile = msgspec.structs.replace(
        generated_profile("narrow", "left"),
        limits_rad=msgspec.structs.replace(limits, **fingers),
        couplings=Couplings(dip_spread_rad=0.1 if soft else 0.0),
    )
    return HandModel.of(profile)


@cache
def _prepared(model: HandModel, finger: int) -> Finger:
    return Finger.of(model, finger, model.mounts[FINGERS[finger]].offset_m)


def _legal(model: HandModel, solver: Finger, finger: int, shares: Float) -> Float:
    """Legal, coupled angles (N, 4) from shares (N, 4) of the ranges."""
    low, high = model.limits_rad[finger, :, 0], model.limits_rad[finger, :, 1]
    angles = low + shares * (high - low)
    spread = model.abduction_limits_rad(np.repeat(angles[:, 1:2], 5, axis=1))
    low_a, high_a = spread[0][:, finger], spread[1][:, finger]
    angles[:, 0] = low_a + shares[:, 0] * (high_a - low_a)
    angles[:, 3] = np.clip(solver.ratio * angles[:, 2], low[3], high[3])
    return angles


def _inside(model: HandModel, finger: int, found: FingerSolution) -> bool:
    """Whether a pose is legal to the last bit, by the hand model's own account."""
    hand = np.zeros((5, 4))
    hand[finger] = found[:4]
    return bool(model.within_limits(hand, 0.0)[finger].all())


def _spread(model: HandModel, finger: int, flexion: float) -> tuple[float, float]:
    """Low and high of the abduction at one flexion [rad]."""
    low, high = model.abduction_limits_rad(np.full(5, flexion))
    return float(low[finger]), float(high[finger])


def _points(model: HandModel, finger: int, angles: Float, offset: Float) -> Float:
    """The observed point (N, 3) by the hand model's own kinematics."""
    hand = np.zeros((len(angles), 5, 4))
    hand[:, finger] = angles
    joints = model.forward(np.broadcast_to(np.eye(4), (len(angles), 4, 4)), hand)
    return joints.position_m[:, TIPS[finger]] + joints.rotation[:, TIPS[finger]] @ offset


def _four(row: Float) -> Four:
    a, f, p, d = row.tolist()
    return a, f, p, d


def _target(row: Float) -> tuple[float, float, float]:
    x, y, z = row.tolist()
    return x, y, z


def _round_trip(model: HandModel, solver: Finger, finger: int, shares: Float) -> None:
    offset = model.mounts[FINGERS[finger]].offset_m
    angles = _legal(model, solver, finger, shares)
    points = _points(model, finger, angles, offset)
    found = [solver.closed_form(_target(p)) for p in points]
    back = _points(model, finger, np.array([s[:4] for s in found]), offset)
    miss_mm = np.linalg.norm(back - points, axis=1) * 1e3
    assert miss_mm.max() < 1e-3  # every reachable target is hit
    assert all(s.reached for s in found)
    solved = np.array([s[:4] for s in found])
    assert model.within_limits(np.repeat(solved[:, None], 5, axis=1))[:, finger].all()
    at_once = np.abs(solved - angles).max(axis=1) / DEGREE
    assert np.quantile(at_once, 0.8) < 1e-3  # all but hyperextended thumbs, which another legal pose matches
    # the straight finger and the abduction's pole have two legal answers each: a warm start chooses
    warm_start = np.array(
        [solver.closed_form(_target(p), _four(a + 0.001))[:4] for p, a in zip(points, angles, strict=True)]
    )
    error_deg = np.abs(warm_start - angles).max(axis=1) / DEGREE
    assert np.quantile(error_deg, 0.99) < 1e-3
    assert error_deg.max() < 0.3  # a whisker from the pole itself, where the answer is ill-conditioned


@pytest.mark.parametrize("finger", range(5))
@pytest.mark.parametrize(("side", "preset"), [("right", "K"), ("left", "D")])
def test_angles_come_back(side: str, preset: Preset, finger: int) -> None:
    shares = np.random.default_rng(finger).uniform(0.02, 0.98, (300, 4))
    _round_trip(_model(side, preset), _solver(side, preset, finger), finger, shares)


@pytest.mark.parametrize("name", ["webxr-right", "webxr-left-small"])
def test_angles_come_back_on_measured_hands(datasets: Path, name: str) -> None:
    model = HandModel.of(load(datasets / "hands" / f"{name}.json", HandProfile))
    for finger in range(5):
        solver = Finger.of(model, finger, model.mounts[FINGERS[finger]].offset_m)
        _round_trip(model, solver, finger, np.random.default_rng(9).uniform(0.02, 0.98, (120, 4)))


@given(
    finger=st.integers(0, 4),
    shares=st.tuples(*[st.sampled_from([0.0, 1e-9, 0.3, 0.5, 0.999999, 1.0])] * 4),
    side=st.sampled_from(["right", "left"]),
)
def test_corners_of_the_limits_are_hit(finger: int, shares: tuple[float, ...], side: str) -> None:
    model, solver = _model(side, "D"), _solver(side, "D", finger)
    angles = _legal(model, solver, finger, np.array([shares]))
    point = _points(model, finger, angles, model.mounts[FINGERS[finger]].offset_m)[0]
    found = solver.closed_form(_target(point))
    assert math.dist(solver.forward(found[:4]), point) * 1e3 < 1e-3
    assert _inside(model, finger, found)


def test_reported_residual_is_true() -> None:
    rng = np.random.default_rng(4)
    for finger in range(5):
        model, solver = _model("right", "K"), _solver("right", "K", finger)
        straight = solver.closed_form(solver.forward((0.0, 0.0, 0.4, 0.4 * solver.ratio)))
        assert straight.residual_m < 1e-12  # closed form, no search
        for _ in range(60):
            target = _target(np.array(solver.root) + rng.normal(0.0, 0.06, 3))
            found = solver.closed_form(target)
            miss = math.dist(solver.forward(found[:4]), target)
            assert miss <= found.residual_m + 1e-9
            assert found.reached == (miss < 1e-6)
            assert _inside(model, finger, found)


@pytest.mark.parametrize("finger", [1, 4])
def test_a_finger_out_of_plane_near_the_pole_is_hit(datasets: Path, finger: int) -> None:
    # at the abduction's pole an error of the PIP would grow without bound
    model = HandModel.of(load(datasets / "hands" / "webxr-right.json", HandProfile))
    solver, rng = _prepared(model, finger), np.random.default_rng(11)
    near_pole = 0
    for _ in range(400):
        a, f, pip = rng.uniform([-8, 40, 20], [8, 80, 60]) * DEGREE
        target = solver.forward((a, f, pip, solver.ratio * pip))
        local = np.subtract(target, solver.root)
        hinge = np.array(rotation(solver.chain.links[0].joint.limits, (float(a), float(f))))[:, 0]
        ahead = np.cross(hinge, (0.0, 1.0, 0.0))
        near_pole += bool(abs(ahead @ local) < 0.02 * np.linalg.norm(local))
        found = solver.closed_form(target)
        assert found.reached
        assert math.dist(solver.forward(found[:4]), target) <= found.residual_m + 1e-9 < 1e-6
    assert near_pole > 5


def test_the_flat_index_by_hand() -> None:
    # zero angles are the rest pose of the profile: no kinematics of ours needed
    model, solver = _model("right", "K"), _solver("right", "K", 1)
    tip = model.rest_position_m[TIPS[1]]
    found = Finger.of(model, 1, np.zeros(3)).closed_form(_target(tip))
    assert np.array(found[:4]) / DEGREE == pytest.approx(np.zeros(4), abs=0.05)
    assert solver.ratio == pytest.approx(2 / 3)
    assert solver.chain.lengths[0] == pytest.approx(
        np.linalg.norm(np.subtract(*model.rest_position_m[[8, 7]]))
    )


def test_out_of_reach_is_stretched_towards_the_target_and_flagged() -> None:
    for finger in range(5):
        solver = _solver("right", "K", finger)
        straight = np.array(solver.forward((0.0, 0.3, 0.0, 0.0))) - solver.root
        far = _target(np.array(solver.root) + 3.0 * straight)
        found = solver.closed_form(far)
        assert not found.reached
        tip = np.array(solver.forward(found[:4])) - solver.root
        cosine = tip @ straight / np.linalg.norm(tip) / np.linalg.norm(straight)
        assert math.degrees(math.acos(min(cosine, 1.0))) < 0.1
        assert found.residual_m == pytest.approx(3 * np.linalg.norm(straight) - np.linalg.norm(tip), abs=1e-5)


@pytest.mark.parametrize("finger", [1, 2])
def test_cut_by_a_limit_is_the_bounded_least_squares_pose(finger: int) -> None:
    solver = _solver("right", "K", finger)
    rng = np.random.default_rng(finger)
    low, high = solver.chain.spans.T
    left_in_a_fist = float(_model("right", "K").spread_at_full_flexion[finger])

    def angles(q: Float) -> Four:
        narrowed = 1.0 - (1.0 - left_in_a_fist) * (q[1] / high[1]) ** 2
        return float(q[0] * narrowed), float(q[1]), float(q[2]), float(solver.ratio * q[2])

    for _ in range(12):
        a, f, pip = rng.uniform([25, 10, 10], [35, 60, 80]) * DEGREE
        target = np.array(solver.forward((a, f, pip, solver.ratio * pip)))
        found = solver.closed_form(_target(target))
        assert not found.reached

        def left(q: Float, target: Float = target) -> Float:
            return np.array(solver.forward(angles(q))) - target

        best = least_squares(
            left,
            np.clip([0.01, f, pip], low[:3], high[:3]),
            bounds=(low[:3] - 1e-9, high[:3] + 1e-9),
            xtol=1e-12,
        )
        oracle = np.linalg.norm(left(best.x))
        assert (found.residual_m - oracle) * 1e3 < 1e-3


@given(
    st.integers(0, 4),
    st.tuples(*[st.one_of(st.floats(-1.0, 1.0), st.sampled_from([math.nan, math.inf, 0.0]))] * 3),
)
def test_any_target_gives_a_legal_pose_or_nan(finger: int, target: tuple[float, float, float]) -> None:
    solver = _solver("right", "D", finger)
    found = solver.closed_form(target)
    if all(math.isfinite(v) for v in target):
        assert _inside(_model("right", "D"), finger, found)
        assert math.isfinite(found.residual_m)
    else:
        assert found is NOT_SEEN
        assert np.isnan(found[:5]).all()


@given(
    finger=st.integers(0, 4),
    share=st.floats(0.0, 1.0),
    beyond=st.floats(0.0, 1.5),
    angles=st.tuples(st.floats(0.0, 1.0), st.floats(0.0, 1.0)),
    soft=st.booleans(),
)
def test_a_spread_fist_is_never_the_answer(
    finger: int, share: float, beyond: float, angles: tuple[float, float], soft: bool
) -> None:
    # whatever is left of the abduction, and wherever the point would be if it could go on
    model = _narrowed(round(share, 1), soft)
    solver = _prepared(model, finger)
    low, high = solver.chain.spans.T
    f, pip = (float(low[k] + q * (high[k] - low[k])) for k, q in zip((1, 2), angles, strict=True))
    edge = _spread(model, finger, f)[1]
    found = solver.closed_form(solver.forward((beyond * edge, f, pip, solver.ratio * pip)))
    assert _inside(model, finger, found)
    if beyond <= 1.0:
        assert found.reached


def test_target_at_the_root_is_flagged() -> None:
    for finger in range(5):
        solver = _solver("right", "K", finger)
        found = solver.closed_form(solver.root)
        assert not found.reached
        assert found.residual_m > 0.005


def test_left_is_the_mirror_of_right() -> None:
    for finger in range(5):
        right, left = _solver("right", "K", finger), _solver("left", "K", finger)
        x, y, z = right.forward((0.0 if finger == 2 else 0.1, 0.5, 0.6, right.ratio * 0.6))
        assert np.array(left.closed_form((-x, y, z))[:4]) == pytest.approx(
            np.array(right.closed_form((x, y, z))[:4]), abs=1e-5
        )


def test_one_millimetre_is_about_one_and_a_half_degrees_of_pip() -> None:
    # 1 mm of tip noise is about 1.4 deg of PIP
    solver, rng = _solver("right", "K", 1), np.random.default_rng(0)
    true = (0.05, 0.6, 0.9, solver.ratio * 0.9)
    tip = np.array(solver.forward(true))
    errors = [solver.closed_form(_target(tip + rng.normal(0, 0.001, 3))).pip_rad - 0.9 for _ in range(400)]
    assert 0.8 < np.std(errors) / DEGREE < 2.2


def test_free_pairs_are_found_where_the_coupling_is_off() -> None:
    profile = msgspec.structs.replace(
        generated_profile("free", "right"), couplings=Couplings(dip_per_pip=None)
    )
    model, rng = HandModel.of(profile), np.random.default_rng(6)
    for finger in (0, 1, 4):
        solver = Finger.of(model, finger, np.zeros(3))
        low, high = solver.chain.spans.T
        for _ in range(60):
            _, f, pip, dip = _four(rng.uniform(low, high))
            target = solver.forward((float(rng.uniform(*_spread(model, finger, f))), f, pip, dip))
            found = solver.closed_form(target)
            assert math.dist(solver.forward(found[:4]), target) * 1e3 < 1e-3
            assert _inside(model, finger, found)


@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize(("side", "preset"), [("right", "K"), ("left", "D")])
def test_fabrik_in_place_hits_two_thousand_reachable_targets(side: str, preset: Preset, known: bool) -> None:
    model, rng = _model(side, preset), np.random.default_rng(12)
    missed = violated = 0
    for finger in range(5):
        fabrik = _solver(side, preset, finger)
        truth = _legal(model, fabrik, finger, rng.random((400, 4)))
        points = _points(model, finger, truth, model.mounts[FINGERS[finger]].offset_m)
        found = truth + rng.normal(0.0, 0.1, truth.shape) if known else np.full_like(truth, np.nan)
        results = [fabrik.solve(point, row) for point, row in zip(points, found, strict=True)]
        back = _points(model, finger, found, model.mounts[FINGERS[finger]].offset_m)
        miss_m = np.linalg.norm(back - points, axis=1)
        assert [r.residual_m for r in results] == pytest.approx(miss_m, abs=1e-12)
        missed += int((miss_m > 1e-4).sum()) + sum(not r.reached for r in results)
        hands = np.zeros((len(found), 5, 4))
        hands[:, finger] = found
        violated += int((~model.within_limits(hands, 0.0)[:, finger]).sum())
    assert (missed, violated) == (0, 0)


def test_a_free_thumb_stays_near_the_angles_it_had() -> None:
    model, rng, fabrik = _model("right", "D"), np.random.default_rng(13), _solver("right", "D", 0)
    truth = _legal(model, fabrik, 0, rng.uniform(0.2, 0.8, (200, 4)))
    low, high = model.limits_rad[0, 3].tolist()
    truth[:, 3] = rng.uniform(low, high, 200)  # in no ratio to the MCP
    steps: list[float] = []
    for angles in truth:
        point = np.array(fabrik.forward(_four(angles)))
        out = angles + rng.normal(0.0, 0.02, 4)
        assert fabrik.solve(point, out).reached
        steps.append(float(np.abs(out - angles).max()))
    assert np.quantile(steps, 0.9) < 0.1
    closed = [fabrik.closed_form(fabrik.forward(_four(q))).dip_rad for q in truth]
    assert np.median(np.abs(closed - truth[:, 3])) > 0.2  # by its ratio it would be far from there


@pytest.mark.parametrize("finger", range(5))
def test_fabrik_in_place_is_no_worse_than_its_seed_out_of_reach(finger: int) -> None:
    fabrik, rng = _solver("right", "K", finger), np.random.default_rng(finger)
    unreached = 0
    for _ in range(40):
        target, angles = np.array(fabrik.root) + rng.normal(0.0, 0.15, 3), np.full(4, np.nan)
        result, seed = fabrik.solve(target, angles), fabrik.closed_form(_target(target))
        unreached += not result.reached
        assert result.residual_m <= seed.residual_m + 1e-12
        assert math.dist(fabrik.forward(_four(angles)), target) == pytest.approx(result.residual_m)
        assert _inside(_model("right", "K"), finger, FingerSolution(*_four(angles), 0.0, False))
    assert unreached > 20


def test_fabrik_in_place_leaves_the_angles_of_a_finger_that_is_not_seen() -> None:
    angles = np.array([0.1, 0.2, 0.3, 0.2])
    for nowhere in (math.nan, math.inf):
        result = _solver("right", "K", 1).solve(np.array([0.0, nowhere, 0.1]), angles)
        assert math.isnan(result.residual_m)
        assert (result.iterations, result.reached) == (0, False)
        assert angles.tolist() == [0.1, 0.2, 0.3, 0.2]


def test_angles_that_are_known_in_part_are_not_known() -> None:
    for finger in range(5):
        fabrik, whole = _solver("right", "K", finger), np.full(4, np.nan)
        target = np.array(fabrik.forward((0.0, 0.6, 0.5, 0.5 * fabrik.ratio)))
        assert fabrik.solve(target, whole).reached
        for k in range(4):
            angles = np.array([0.1, 0.2, 0.3, 0.2])
            angles[k] = math.nan
            assert fabrik.solve(target, angles).reached
            assert angles.tolist() == whole.tolist()


def test_a_target_beyond_all_numbers_is_not_seen() -> None:
    solver = _solver("right", "K", 1)
    assert solver.closed_form((1e200, 0.0, 0.0)) is NOT_SEEN
    assert not solver.closed_form((1e150, 0.0, 0.0)).reached
    assert _inside(_model("right", "K"), 1, solver.closed_form((1e150, 0.0, 0.0)))


def test_a_finger_refuses_settings_that_find_nothing() -> None:
    for tolerance_m, iterations in ((0.0, 10), (1e-5, 0)):
        with pytest.raises(ValueError, match="positive"):
            Finger.of(_model("right", "K"), 1, np.zeros(3), tolerance_m, iterations)
