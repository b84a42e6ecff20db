"""The benchmark of random hands: its draws are what they should be, its ruler sees planted faults, and it runs."""

from dataclasses import replace

import numpy as np
import pytest

from bench.hands import poses
from bench.hands.draws import (
    BACK,
    FACING_ROTATION,
    MARKERS,
    Draw,
    Noise,
    bench_model,
    draw,
    finger_solvers,
    fixed_palm,
    posed,
    score,
    seen,
    tips_in_palm,
)
from bench.hands.poses import CLOSED, PAPER, SCENARIOS, WHOLE, batch, scenario_rows
from common.arrays import Float

MODEL = bench_model()
TRUTH = draw(MODEL, 11, 400)


def perfect(truth: Draw) -> tuple[Float, Float]:
    return truth.T_rig_palm.copy(), truth.angles_rad.copy()


# -- draws ------------------------------------------------------------------------------------------------------


def test_every_drawn_hand_is_legal_and_fills_its_limits() -> None:
    assert MODEL.within_limits(TRUTH.angles_rad).all()
    low, high = MODEL.limits_rad[..., 0], MODEL.limits_rad[..., 1]
    share = (TRUTH.angles_rad - low)[:, 1:, 1:3] / (high - low)[1:, 1:3]  # MCP flexion and PIP
    np.testing.assert_allclose(share.mean(axis=0), 0.5, atol=0.06)
    np.testing.assert_allclose(share.std(axis=0), 12**-0.5, atol=0.03)


def test_joints_are_independent_but_for_the_dip() -> None:
    free = TRUTH.angles_rad[:, 1:, 1:3].reshape(len(TRUTH.angles_rad), -1)
    correlation = np.corrcoef(free.T) - np.eye(8)
    assert np.abs(correlation).max() < 0.2
    off = np.degrees(TRUTH.angles_rad[:, 1:, 3] - 2 / 3 * TRUTH.angles_rad[:, 1:, 2])
    assert 7.5 < np.abs(off).max() <= 8.0 + 1e-9
    assert abs(off.std() - 16 / 12**0.5) < 0.4


def test_palms_turn_by_up_to_45_degrees_about_each_axis_from_facing_the_cameras() -> None:
    rotation = TRUTH.T_rig_palm[:, :3, :3] @ FACING_ROTATION.T
    # R = Rz Ry Rx: the three angles can be read off.
    x = np.degrees(np.arctan2(rotation[:, 2, 1], rotation[:, 2, 2]))
    y = np.degrees(np.arcsin(-rotation[:, 2, 0]))
    z = np.degrees(np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0]))
    for angle in (x, y, z):
        assert 42.0 < np.abs(angle).max() <= 45.0
    assert (TRUTH.T_rig_palm[:, 2, 1] < 0).mean() > 0.95  # the back still looks to cameras that look along +z


def test_noise_is_what_it_says_and_the_same_seed_gives_the_same() -> None:
    noise = Noise((0.3e-3, 0.3e-3, 4.5e-3), float(np.radians(2.0)))
    points, rotation = seen(TRUTH, noise, 5)
    np.testing.assert_allclose((points - TRUTH.caps_m).std(axis=(0, 1)), noise.place_m, rtol=0.1)
    assert rotation is not None
    cosine = (np.trace(rotation @ TRUTH.T_rig_palm[:, :3, :3].swapaxes(1, 2), axis1=1, axis2=2) - 1) / 2
    # Three normal angles of 2 degrees: the root mean square of the whole is 2 sqrt(3).
    assert abs(np.degrees(np.sqrt(np.square(np.arccos(cosine)).mean())) - 2 * 3**0.5) < 0.2
    again, _ = seen(TRUTH, noise, 5)
    np.testing.assert_array_equal(points, again)
    assert seen(TRUTH, replace(noise, orientation_rad=None), 5)[1] is None


# -- the ruler --------------------------------------------------------------------------------------------------


def test_the_truth_has_no_error() -> None:
    found = score(MODEL, TRUTH, *perfect(TRUTH), TRUTH.caps_m)
    assert found.joints_mm.max() < 1e-9
    assert found.pip_deg.max() < 1e-9
    assert found.missed_percent == 0.0
    assert (found.violations, found.not_finite, found.hands) == (0, 0, 400)


def test_one_angle_out_of_its_limits_is_counted() -> None:
    T, angles = perfect(TRUTH)
    angles[7, 2, 2] = MODEL.limits_rad[2, 2, 1] + np.radians(3.0)
    found = score(MODEL, TRUTH, T, angles, TRUTH.caps_m)
    assert found.violations == 1
    assert found.worst_deg == pytest.approx(3.0)


def test_a_spread_fist_is_a_violation_though_each_angle_is_in_its_range() -> None:
    angles = np.zeros((1, 5, 4))
    angles[0, 1, :2] = MODEL.limits_rad[1, :2, 1]
    fist = posed(MODEL, TRUTH.T_rig_palm[:1], angles)
    assert score(MODEL, fist, fist.T_rig_palm, angles, fist.caps_m).violations == 1


def test_a_hand_that_is_not_found_is_counted_and_spoils_no_other() -> None:
    T, angles = perfect(TRUTH)
    angles[3, 1, 2], T[5] = np.nan, np.nan
    found = score(MODEL, TRUTH, T, angles, TRUTH.caps_m)
    assert (found.not_finite, found.hands, len(found.joints_mm)) == (2, 400, 398)
    assert found.joints_mm.max() < 1e-9


def test_a_palm_off_the_truth_moves_every_joint_and_misses_every_tip() -> None:
    T, angles = perfect(TRUTH)
    T[:, 0, 3] += 2e-3
    found = score(MODEL, TRUTH, T, angles, TRUTH.caps_m)
    np.testing.assert_allclose(found.joints_mm, 2.0)
    np.testing.assert_allclose(found.miss_mm, 2.0)
    assert found.missed_percent == 100.0
    assert found.pip_deg.max() < 1e-9


# -- the papers' palm, and the whole ----------------------------------------------------------------------------


def test_the_fixed_palm_is_right_for_a_hand_that_faces_the_cameras() -> None:
    T = np.tile(np.eye(4), (3, 1, 1))
    T[:, :3, :3], T[:, :3, 3] = FACING_ROTATION, [0.03, 0.08, 0.6]
    angles = TRUTH.angles_rad[:3].copy()
    angles[:, 1:, 3] = 2 / 3 * angles[:, 1:, 2]
    facing = posed(MODEL, T, angles)
    np.testing.assert_allclose(fixed_palm(MODEL, facing.caps_m[0]), T[0], atol=1e-12)
    tips = tips_in_palm(T[0], facing.caps_m[0])
    for solver, tip in zip(finger_solvers(MODEL), tips, strict=True):
        assert solver.closed_form(tip).reached
    back = MODEL.mount(MARKERS[BACK]).offset_m
    np.testing.assert_allclose(facing.caps_m[0, BACK], T[0, :3, 3] + FACING_ROTATION @ back)


@pytest.mark.parametrize("name", SCENARIOS)
def test_a_few_poses_run_in_every_way(name: str) -> None:
    found = batch(SCENARIOS[name].noise, 3, 6)
    assert set(found) == {WHOLE, PAPER, CLOSED}
    for way in found.values():
        assert (way.hands, way.not_finite, way.violations) == (6, 0, 0)
    assert found[WHOLE].joints_mm.mean() < found[CLOSED].joints_mm.mean()
    lines = scenario_rows(name, SCENARIOS[name], [found, found])
    assert len(lines) == 9
    assert all(np.isfinite(row.value) for row in lines)


def test_rows_report_violations_and_hands_that_were_not_found() -> None:
    T, angles = perfect(TRUTH)
    angles[0, 1, 2], angles[1, 0, 0] = 3.0, np.nan
    bad = score(MODEL, TRUTH, T, angles, TRUTH.caps_m)
    lines = scenario_rows("planted", SCENARIOS["1 mm"], [dict.fromkeys((WHOLE, PAPER, CLOSED), bad)])
    line = next(row for row in lines if "violations" in row.name)
    assert line.value == 1.0
    assert "no answer for 1 of 400 hands" in line.note


def test_the_number_of_poses_is_checked(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        poses.main(["3"])
    assert "at least 10" in capsys.readouterr().err
