"""An IMU on the forearm: what is learnt of heading and bend from palms that markers tell, and what is left without."""

from collections.abc import Iterator
from math import nan, pi, radians

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.arrays import Float
from common.calibration import ImuCalibration
from common.errors import CalibrationError
from common.geometry import (
    axis_rotation,
    matrix_to_quaternion,
    matrix_to_rotation_vector,
    quaternion_to_matrix,
    rotation_vector_to_matrix,
)
from common.wrist_bend import forearm_palm
from master.fusion.forearm import Forearm
from master.fusion.forearm_state import FRESH, STAYING, ForearmState, SeenForearm
from master.fusion.orientation import Orientation
from master.fusion.told_forearm import ToldForearm
from tests.hand_helpers import any_rotation

MS, FRAME_MS = 1_000_000, 16
MOUNTED, WORLD = (0.5, 0.5, -0.5, 0.5), (0.8, 0.6, 0.0, 0.0)
RIG_WORLD, PALM_IMU = quaternion_to_matrix(np.array(WORLD)), quaternion_to_matrix(np.array(MOUNTED))
IMU = ImuCalibration(q_palm_imu=MOUNTED, q_rig_world=WORLD, orientation_sigma_rad=radians(1.0))
COV = radians(2.0) ** 2 * np.eye(3)
seeds = st.integers(0, 2**32 - 1)


class Arm:
    """An arm that waves, its wrist that bends, and an IMU whose heading is off by `heading_rad`; without an error."""

    def __init__(self, heading_rad: float = 2.0, seed: int = 1) -> None:
        rng = np.random.default_rng(seed)
        self.heading_rad = heading_rad
        self._lies = any_rotation(rng)
        self._rate, self._phase = rng.uniform(1.0, 5.0, 5), rng.uniform(0.0, 2.0 * pi, 5)
        self._size = np.array([0.4, 0.4, 0.4, radians(15.0), radians(12.0)])

    def _waves(self, t_ms: int) -> Float:
        return self._size * np.sin(1e-3 * self._rate * t_ms + self._phase)

    def bend(self, t_ms: int) -> Float:
        return self._waves(t_ms)[3:]

    def forearm(self, t_ms: int) -> Float:
        """(3, 3) in the rig."""
        return self._lies @ rotation_vector_to_matrix(self._waves(t_ms)[:3])

    def palm(self, t_ms: int) -> Float:
        """(3, 3) in the rig."""
        return self.forearm(t_ms) @ forearm_palm(self.bend(t_ms))

    def said(self, t_ms: int) -> Float:
        """What the IMU says (4,)."""
        world_forearm = axis_rotation(2, -self.heading_rad) @ RIG_WORLD.T @ self.forearm(t_ms)
        return matrix_to_quaternion(world_forearm @ PALM_IMU)


def played(
    forearm: Forearm, arm: Arm, times_ms: range, seen: bool = True, shift_ms: int = 0, drift: float = nan
) -> None:
    """Samples every 8 ms, palms every 16, which come two samples late; stamped `shift_ms` later."""
    for t_ms in times_ms[:: 1 if times_ms.step > 1 else 8]:
        forearm.push((t_ms + shift_ms) * MS, arm.said(t_ms), drift)
        if seen and t_ms % FRAME_MS == 0 and t_ms - 16 >= times_ms.start:
            forearm.saw((t_ms - 16 + shift_ms) * MS, ToldForearm.of_palm(arm.palm(t_ms - 16), COV))


def degrees(a: Float, b: Float) -> float:
    return float(np.degrees(np.linalg.norm(matrix_to_rotation_vector(a @ b.T))))


def heading_off_deg(forearm: Forearm, arm: Arm) -> float:
    return float(np.degrees(abs(np.angle(np.exp(1j * (forearm.heading_rad - arm.heading_rad))))))


def at(forearm: Forearm, t_ms: int) -> Orientation:
    found = forearm.palm_at(t_ms * MS)
    assert found is not None
    return found


def sigmas_deg(cov: Float) -> Float:
    return np.degrees(np.sqrt(np.diag(cov)))


@given(seeds)
def test_the_palm_changes_with_the_state_as_its_derivative_says(seed: int) -> None:
    rng = np.random.default_rng(seed)
    state, world_forearm = ForearmState.of(any_rotation(rng), 0.02, 0.3), any_rotation(rng)
    state.mean[:7] = rng.normal(size=7) * [0.0, 0.0, 2.0, 0.2, 0.2, 0.3, 0.3]
    palm, slope = state.palm(world_forearm)
    for k in range(9):
        state.mean[k] += 1e-6
        moved, _ = state.palm(world_forearm)
        state.mean[k] -= 1e-6
        np.testing.assert_allclose(matrix_to_rotation_vector(moved @ palm.T) * 1e6, slope[:, k], atol=1e-4)


@given(st.floats(0.0, 3.0), st.floats(0.0, 3.0), seeds)
def test_two_steps_are_one_and_doubt_ends_at_what_is_usual(
    first_s: float, second_s: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    state = ForearmState.of(np.eye(3), 0.02, 0.3)
    state.mean[:] = rng.normal(size=14)
    state.cov[:] = (root := 0.1 * rng.normal(size=(14, 14))) @ root.T
    twice, once = state.after(first_s, 0.01).after(second_s, 0.02), state.after(first_s + second_s, 0.03)
    np.testing.assert_allclose(twice.mean, once.mean, atol=1e-9)
    np.testing.assert_allclose(twice.cov, once.cov, atol=1e-9)
    back = ForearmState(state.rig_world, state.usual, state.mean, np.diag(state.usual)).after(-first_s, 0.0)
    np.testing.assert_allclose(back.cov, np.diag(state.usual), atol=1e-9)
    apart = np.abs(state.after(500.0, 0.0).cov - np.diag(state.usual))
    apart[2, 2] = 0.0  # the heading
    assert apart.max() < 1e-6


def test_heading_and_bend_are_learnt_from_palms_that_come_late() -> None:
    for seed in range(2):
        arm, forearm = Arm(2.0 - seed, seed), Forearm(IMU)
        played(forearm, arm, range(0, 8_000))
        assert heading_off_deg(forearm, arm) < 2.0
        assert forearm.counts["forearm.begun"] == 1
        assert heading_off_deg(forearm, arm) < 3.0 * np.degrees(forearm.heading_sigma_rad)
        bend, cov = forearm.bend_at(7_976 * MS)
        assert np.degrees(np.abs(bend - arm.bend(7_976))).max() < 2.5
        assert sigmas_deg(cov).max() < 5.0
        assert degrees(at(forearm, 7_984).rotation, arm.palm(7_984)) < 2.0


def test_one_palm_tells_the_sum_of_heading_and_a_bend_whose_axis_is_upright_and_neither_alone() -> None:
    forearm = Forearm(IMU)
    lies = RIG_WORLD @ axis_rotation(0, radians(90.0))  # deviation, about the palm's y, is upright
    forearm.push(0, matrix_to_quaternion(RIG_WORLD.T @ lies @ PALM_IMU))
    forearm.saw(0, ToldForearm.of_palm(lies, radians(1.0) ** 2 * np.eye(3)))
    bend, cov = forearm.bend_at(0)
    assert np.degrees(np.abs(bend)).max() < 0.1
    assert sigmas_deg(cov)[1] == pytest.approx(11.4, abs=0.2)  # as before
    assert sigmas_deg(cov)[0] < 2.0
    assert np.degrees(forearm.heading_sigma_rad) == pytest.approx(11.4, abs=0.3)
    assert sigmas_deg(at(forearm, 0).cov_rad2).max() < 1.5


def test_nothing_is_said_of_the_palm_before_a_heading_is_known() -> None:
    arm, forearm = Arm(), Forearm(IMU)
    played(forearm, arm, range(0, 100), seen=False)
    assert forearm.palm_at(50 * MS) is None
    bend, cov = forearm.bend_at(50 * MS)
    np.testing.assert_array_equal(bend, 0.0)
    assert 10.0 < sigmas_deg(cov).min() < sigmas_deg(cov).max() < 15.0
    forearm.saw(48 * MS, ToldForearm.of_palm(arm.palm(48), COV))
    assert degrees(at(forearm, 48).rotation, arm.palm(48)) < 2.5


def test_a_heading_that_the_file_knows_is_there_at_once() -> None:
    arm = Arm(heading_rad=0.05)
    forearm = Forearm(msgspec.structs.replace(IMU, heading_sigma_rad=0.1))
    played(forearm, arm, range(0, 100), seen=False)
    found = at(forearm, 50)
    assert degrees(found.rotation, arm.palm(50)) < 3.0 * np.degrees(np.sqrt(np.trace(found.cov_rad2)))
    assert np.degrees(forearm.heading_sigma_rad) == pytest.approx(np.degrees(0.1))


def test_without_markers_the_bend_is_believed_less_and_less_and_the_heading_stays() -> None:
    arm, forearm = Arm(), Forearm(IMU)
    played(forearm, arm, range(0, 8_000))
    learnt = forearm.heading_rad
    played(forearm, arm, range(8_000, 14_000), seen=False)
    times = (8_000, 8_200, 8_500, 9_000, 10_000, 13_900)
    sigma = np.array([sigmas_deg(forearm.bend_at(t * MS)[1]) for t in times])
    assert (np.diff(sigma, axis=0) > 0.0).all()
    assert sigma[-1, 0] < 14.2  # of any wrist
    assert sigma[-1, 1] < 11.5
    early, late = (forearm.bend_at(t * MS)[0] for t in (8_200, 13_900))
    assert np.abs(late).max() < np.abs(early).max()
    assert forearm.heading_rad == learnt
    found = at(forearm, 13_900)
    assert 10.0 < np.degrees(np.sqrt(np.trace(found.cov_rad2))) < 20.0
    assert np.linalg.eigvalsh(found.cov_rad2).min() > 0.0


def test_what_is_no_palm_is_left_out_and_counted() -> None:
    arm, forearm = Arm(), Forearm(IMU)
    played(forearm, arm, range(0, 4_000))
    before, seen = at(forearm, 3_984).rotation, forearm.counts["forearm.seen"]
    forearm.saw(3_992 * MS, ToldForearm.of_palm(np.full((3, 3), np.nan), COV))
    forearm.saw(3_992 * MS, ToldForearm.of_palm(arm.palm(3_992), np.full((3, 3), np.nan)))
    forearm.saw(3_900 * MS, ToldForearm.of_palm(arm.palm(3_900), COV))
    forearm.saw(4_900 * MS, ToldForearm.of_palm(arm.palm(4_900), COV))
    forearm.saw(3_992 * MS, ToldForearm.of_palm(arm.palm(3_992) @ axis_rotation(2, 2.5), COV))
    expected = {"missing": 2, "late": 1, "alone": 1, "outlier": 1}
    assert {name: forearm.counts[f"forearm.{name}"] for name in expected} == expected
    assert forearm.counts["forearm.seen"] == seen
    np.testing.assert_array_equal(at(forearm, 3_984).rotation, before)


@pytest.mark.parametrize("jump_deg", [180.0, -100.0, 50.0, -20.0])
def test_a_heading_that_jumps_is_learnt_anew(jump_deg: float) -> None:
    arm, forearm = Arm(), Forearm(IMU)
    played(forearm, arm, range(0, 4_000))
    arm.heading_rad += radians(jump_deg)
    played(forearm, arm, range(4_000, 7_200))
    assert heading_off_deg(forearm, arm) < 3.0 * np.degrees(forearm.heading_sigma_rad) < 15.0
    assert degrees(at(forearm, 7_184).rotation, arm.palm(7_184)) < 3.0
    assert forearm.counts["forearm.begun"] == 2


def test_an_imu_that_begins_anew_has_no_heading_until_a_palm_is_seen() -> None:
    arm, forearm = Arm(), Forearm(IMU)
    played(forearm, arm, range(0, 4_000), drift=0.05)
    assert forearm.palm_at(3_990 * MS) is not None
    arm.heading_rad -= 0.5  # too little to be seen as a jump
    played(forearm, arm, range(6_000, 6_096), seen=False, drift=0.001)
    assert forearm.palm_at(6_090 * MS) is None
    played(forearm, arm, range(6_096, 10_000), drift=0.001)
    assert heading_off_deg(forearm, arm) < 3.0


def test_a_silence_in_which_the_same_imu_went_on_costs_the_heading_what_it_says() -> None:
    arm, forearm = Arm(), Forearm(IMU)
    played(forearm, arm, range(0, 6_000), drift=0.05)
    known = forearm.heading_sigma_rad
    assert forearm.palm_at(6_500 * MS) is None  # no sample near
    played(forearm, arm, range(8_000, 8_100), seen=False, drift=0.25)
    assert forearm.heading_sigma_rad == pytest.approx(np.hypot(known, 0.2), rel=0.03)
    assert degrees(at(forearm, 8_050).rotation, arm.palm(8_050)) < 45.0


@pytest.mark.parametrize("back_ms", [300, 60_000])
def test_a_clock_that_is_set_back_is_followed(back_ms: int) -> None:
    arm, forearm = Arm(), Forearm(IMU)
    played(forearm, arm, range(0, 6_000), shift_ms=100_000)
    played(forearm, arm, range(6_000, 8_000), shift_ms=100_000 - back_ms)
    found = at(forearm, 7_984 + 100_000 - back_ms)
    assert degrees(found.rotation, arm.palm(7_984)) < 3.0
    assert heading_off_deg(forearm, arm) < 3.0
    assert np.degrees(forearm.heading_sigma_rad) < 10.0


def test_nan_samples_change_nothing() -> None:
    arm, forearm = Arm(), Forearm(IMU)
    played(forearm, arm, range(0, 2_000))
    before = at(forearm, 1_984)
    forearm.push(2_000 * MS, np.full(4, np.nan))
    np.testing.assert_array_equal(at(forearm, 1_984).cov_rad2, before.cov_rad2)


def test_in_its_own_world_the_palm_is_bent_as_well() -> None:
    arm, forearm = Arm(), Forearm(IMU)
    played(forearm, arm, range(0, 6_000))
    wxyz, sigma = forearm.world_at(5_984 * MS)
    truth = axis_rotation(2, -arm.heading_rad) @ RIG_WORLD.T @ arm.palm(5_984)
    assert degrees(quaternion_to_matrix(wxyz), truth) < 4.0
    assert 1.0 < np.degrees(sigma[0]) < 8.0
    wxyz, sigma = forearm.world_at(9_000 * MS)
    assert np.isnan([*wxyz, *sigma]).all()


def test_95_percent_regions_hold_the_truth_where_it_moves_as_is_believed() -> None:
    inside: list[bool] = []
    for seed in range(60):
        inside += held(np.random.default_rng(seed))
    assert 0.90 < np.mean(inside) < 0.99


def held(rng: np.random.Generator) -> Iterator[bool]:
    """Draw a state, let it move and be seen, and ask whether the palm is within what is claimed: seen, and 0.5 s on."""
    believed = ForearmState.of(RIG_WORLD, 0.02, 0.3)
    truth = ForearmState(RIG_WORLD, believed.usual, drawn(rng, believed.cov), believed.cov)
    world_forearm, palm = any_rotation(rng), np.eye(3)
    for step_s in (0.017,) * 20 + (0.5,):
        moved, certain = truth.after(step_s, 1e-6), np.zeros((14, 14))
        noise = ForearmState(RIG_WORLD, truth.usual, truth.mean, certain).after(step_s, 1e-6).cov
        truth = ForearmState(RIG_WORLD, truth.usual, moved.mean + drawn(rng, noise), truth.cov)
        believed = believed.after(step_s, 1e-6)
        palm, _ = truth.palm(world_forearm)
        if step_s == 0.5:
            break
        off = np.sqrt(STAYING[:3]) * truth.mean[9:12] + np.sqrt(FRESH) * rng.normal(size=3)
        error = rotation_vector_to_matrix(palm @ off * np.sqrt(COV[0, 0]))
        seen = SeenForearm.of(ToldForearm.of_palm(error @ palm, COV), world_forearm)
        believed = believed.told(seen, seen.against(believed))
    expected, slope = believed.palm(world_forearm)
    off = matrix_to_rotation_vector(palm @ expected.T)
    yield bool(off @ np.linalg.solve(slope @ believed.cov @ slope.T, off) < 7.815)


def drawn(rng: np.random.Generator, cov: Float) -> Float:
    return rng.multivariate_normal(np.zeros(len(cov)), cov, method="eigh")


@pytest.mark.parametrize("key", ["q_palm_imu", "q_rig_world"])
def test_a_mounting_and_a_vertical_are_needed(key: str) -> None:
    with pytest.raises(CalibrationError, match=key):
        Forearm(msgspec.structs.replace(IMU, **{key: None}))
