"""An IMU on the forearm: what is learnt of heading and bend from palms by markers, and what is left without."""

from collections import Counter
from dataclasses import dataclass, replace
from math import nan, pi, radians
from pathlib import Path

import msgspec
import numpy as np
import pytest

from common.arrays import Float
from common.calibration import ImuCalibration
from common.errors import CalibrationError
from common.geometry.transforms import (
    axis_rotation,
    matrix_to_quaternion,
    matrix_to_rotation_vector,
    quaternion_to_matrix,
    rigid,
    rotation_vector_to_matrix,
)
from common.hand.wrist import forearm_palm
from master.estimator.epoch import Epoch, Fitted, OrientationMeasurement
from master.estimator.estimator import Estimator
from master.estimator.priors import WristModel, loosened
from master.estimator.sensors import HEADING, RATE, WRIST_ANGLES
from master.estimator.wrist_pipeline import Forearm, WristSide
from tests.hand_helpers import any_rotation, small_cov
from tests.master.estimator.fitted import PAIR, found
from tests.master.estimator.test_back_markers import EIGHT as MARKERS
from tests.master.estimator.test_back_markers import MODELS
from tests.wrist_run import wrist_setup

MS, FRAME_MS = 1_000_000, 16
MOUNTED, WORLD = (0.5, 0.5, -0.5, 0.5), (0.8, 0.6, 0.0, 0.0)
RIG_WORLD, PALM_IMU = quaternion_to_matrix(np.array(WORLD)), quaternion_to_matrix(np.array(MOUNTED))
IMU = ImuCalibration(q_palm_imu=MOUNTED, q_rig_world=WORLD, orientation_sigma_rad=radians(1.0))
PLACE = np.array([0.0, 0.08, 0.5])
ANGLES = np.zeros((5, 4))
ANGLES[1:, 1:] = np.radians([20.0, 35.0, 23.0])
RIGHT, COV = MODELS["right"], small_cov(count=8)  # three markers on the back determine the palm
NOWHERE = np.full((8, 3), nan)


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

    def wrist_angles(self, t_ms: int) -> Float:
        return self._waves(t_ms)[3:]

    def forearm(self, t_ms: int) -> Float:
        """(3, 3) in the rig."""
        return self._lies @ rotation_vector_to_matrix(self._waves(t_ms)[:3])

    def palm(self, t_ms: int) -> Float:
        """(3, 3) in the rig."""
        return self.forearm(t_ms) @ forearm_palm(self.wrist_angles(t_ms))

    def output(self, t_ms: int) -> Float:
        """What the IMU says (4,)."""
        world_forearm = axis_rotation(2, -self.heading_rad) @ RIG_WORLD.T @ self.forearm(t_ms)
        return matrix_to_quaternion(world_forearm @ PALM_IMU)


@dataclass
class WristCase:
    """A hand before marker cameras, with an IMU on its forearm; the wrist device beside it sees nothing."""

    side: WristSide
    estimator: Estimator

    @classmethod
    def of(cls, root: Path, imu: ImuCalibration = IMU, *, continuous: bool = True) -> "WristCase":
        wrist_case = wrist_setup(root).wrist
        assert wrist_case is not None
        setup, counts = replace(wrist_case, model=RIGHT, imu=imu), Counter[str]()
        side = WristSide(setup, counts, continuous=continuous)
        model = WristModel.of(setup, loose=True)
        estimator = Estimator(PAIR, loosened(RIGHT), MARKERS, MARKERS, continuous=continuous, wrist=model)
        return cls(side, estimator)

    @property
    def counts(self) -> Counter[str]:
        return self.side.counts

    @property
    def forearm(self) -> Forearm:
        assert self.side.forearm is not None
        return self.side.forearm

    @property
    def wrist_angles(self) -> Float:
        return self.estimator.extras[WRIST_ANGLES : WRIST_ANGLES + 2].copy()

    @property
    def wrist_sigma_deg(self) -> Float:
        return np.degrees(np.sqrt(np.diag(self.estimator.extras_cov)[WRIST_ANGLES : WRIST_ANGLES + 2]))

    @property
    def heading_rad(self) -> float:
        return float(self.estimator.extras[HEADING])

    @property
    def heading_sigma_deg(self) -> float:
        return float(np.degrees(np.sqrt(self.estimator.extras_cov[HEADING, HEADING])))

    def heading_off_deg(self, arm: Arm) -> float:
        return float(np.degrees(abs(np.angle(np.exp(1j * (self.heading_rad - arm.heading_rad))))))

    def orientation(self, t_ms: int) -> OrientationMeasurement | None:
        return self.side.orientation_at(t_ms * MS, self.estimator)

    def epoch(self, arm: Arm, t_ms: int, *, seen: bool = True, shift_ms: int = 0) -> Fitted:
        """Fit the hand of one time, whose markers are seen or not."""
        t_ns, T = (t_ms + shift_ms) * MS, rigid(arm.palm(t_ms), PLACE)
        points = RIGHT.marker_points(RIGHT.forward(T, ANGLES), MARKERS) if seen else NOWHERE
        orientation = self.side.orientation_at(t_ns, self.estimator)
        hand = self.estimator.push(Epoch(t_ns, points, T[:3, 1], cov_m2=COV, orientation=orientation))
        self.side.solved(t_ns, hand, self.estimator, oriented=orientation is not None)
        return hand

    def played(
        self, arm: Arm, times_ms: range, *, seen: bool = True, shift_ms: int = 0, drift: float = nan
    ) -> None:
        """Samples every 8 ms, epochs every 16, two samples late; stamped `shift_ms` later."""
        for t_ms in times_ms[::8]:
            self.forearm.push((t_ms + shift_ms) * MS, arm.output(t_ms), drift)
            if t_ms % FRAME_MS == 0 and t_ms - 16 >= times_ms.start:
                self.epoch(arm, t_ms - 16, seen=seen, shift_ms=shift_ms)


def degrees(a: Float, b: Float) -> float:
    return float(np.degrees(np.linalg.norm(matrix_to_rotation_vector(a @ b.T))))


def test_heading_and_bend_are_learnt_from_palms(root: Path) -> None:
    for seed in range(2):
        arm, wrist_case = Arm(2.0 - seed, seed), WristCase.of(root)
        wrist_case.played(arm, range(0, 8_000))
        assert wrist_case.counts["forearm.begun"] == 1
        assert wrist_case.counts["forearm.outlier"] == 0
        assert wrist_case.heading_off_deg(arm) < 2.0
        assert wrist_case.heading_off_deg(arm) < 3.0 * wrist_case.heading_sigma_deg
        assert np.degrees(np.abs(wrist_case.wrist_angles - arm.wrist_angles(7_968))).max() < 2.5
        assert wrist_case.wrist_sigma_deg.max() < 5.0


def test_one_palm_determines_the_sum_of_heading_and_a_wrist_angle_about_the_vertical_and_neither_alone(
    root: Path,
) -> None:
    """Deviation, about the palm's y, is upright."""
    wrist_case, lies = WristCase.of(root), RIG_WORLD @ axis_rotation(0, radians(90.0))
    T = rigid(lies, PLACE)
    points = RIGHT.marker_points(RIGHT.forward(T, ANGLES), MARKERS)
    for t_ns in (0, 1_000 * MS):
        wrist_case.forearm.push(t_ns, matrix_to_quaternion(RIG_WORLD.T @ lies @ PALM_IMU))
        orientation = wrist_case.side.orientation_at(t_ns, wrist_case.estimator)
        hand = wrist_case.estimator.push(Epoch(t_ns, points, T[:3, 1], cov_m2=COV, orientation=orientation))
        wrist_case.side.solved(t_ns, hand, wrist_case.estimator, oriented=orientation is not None)
    assert np.degrees(np.abs(wrist_case.wrist_angles)).max() < 1.0
    assert wrist_case.wrist_sigma_deg[1] == pytest.approx(11.0, abs=2.0)  # as before
    assert wrist_case.wrist_sigma_deg[0] < 4.0
    assert wrist_case.heading_sigma_deg > 9.0


def test_nothing_is_said_of_the_palm_before_a_heading_is_known(root: Path) -> None:
    arm, wrist_case = Arm(), WristCase.of(root)
    wrist_case.played(arm, range(0, 100), seen=False)
    assert wrist_case.orientation(50) is None
    assert 10.0 < wrist_case.wrist_sigma_deg.min() < wrist_case.wrist_sigma_deg.max() < 15.0
    for t_ms in (96, 112):  # the first palm gives the heading of a straight wrist, the next how it is bent
        wrist_case.epoch(arm, t_ms)
    orientation = wrist_case.orientation(112)
    assert orientation is not None
    assert degrees(orientation.rotation @ forearm_palm(wrist_case.wrist_angles), arm.palm(112)) < 5.0


def test_a_heading_that_the_file_knows_is_there_at_once(root: Path) -> None:
    arm = Arm(heading_rad=0.05)
    wrist_case = WristCase.of(root, msgspec.structs.replace(IMU, heading_sigma_rad=0.1))
    assert wrist_case.heading_sigma_deg == pytest.approx(np.degrees(0.1))
    wrist_case.forearm.push(48 * MS, arm.output(48))
    orientation = wrist_case.orientation(48)
    assert orientation is not None
    assert degrees(orientation.rotation, arm.forearm(48)) < 4.0


def test_an_unobserved_palm_rotates_with_the_forearm_and_its_covariance_grows(root: Path) -> None:
    arm, wrist_case = Arm(), WristCase.of(root)
    wrist_case.played(arm, range(0, 6_000))
    spread: list[float] = []
    off_deg = 0.0
    for t_ms in range(6_000, 9_000, FRAME_MS):
        wrist_case.forearm.push(t_ms * MS, arm.output(t_ms))
        hand = found(wrist_case.epoch(arm, t_ms, seen=False).solution)
        off_deg = degrees(hand.T_rig_palm[:3, :3], arm.palm(t_ms))
        if t_ms < 6_100:
            assert off_deg < 8.0
        spread.append(float(hand.cov_m2[1].trace()))
    assert (np.diff(spread[::20]) > 0.0).all()
    # It is turned by as much as forearm and wrist may have; where it is nobody says.
    assert off_deg < 50.0


def test_without_markers_the_wrist_angles_lose_certainty_and_the_heading_stays(root: Path) -> None:
    arm, wrist_case = Arm(), WristCase.of(root)
    wrist_case.played(arm, range(0, 8_000))
    learnt = wrist_case.heading_rad
    sigma, bends = [wrist_case.wrist_sigma_deg], [wrist_case.wrist_angles]
    for begin, end in ((8_000, 8_192), (8_192, 8_496), (8_496, 9_008), (9_008, 14_000)):
        wrist_case.played(arm, range(begin, end), seen=False)
        sigma.append(wrist_case.wrist_sigma_deg)
        bends.append(wrist_case.wrist_angles)
    assert (np.diff(np.array(sigma), axis=0) > 0.0).all()
    assert sigma[-1][0] < 14.2  # of any wrist
    assert sigma[-1][1] < 11.5
    wrist_mean_rad = wrist_case.estimator.state.wrist_mean_rad
    assert np.abs(bends[-1] - wrist_mean_rad).max() < 0.2 * np.abs(bends[0] - wrist_mean_rad).max()
    assert wrist_case.heading_rad == pytest.approx(learnt, abs=radians(2.0))
    assert wrist_case.heading_sigma_deg < 10.0


@pytest.mark.parametrize("jump_deg", [180.0, -100.0, 50.0])
def test_a_heading_that_jumps_is_learnt_anew(root: Path, jump_deg: float) -> None:
    arm, wrist_case = Arm(), WristCase.of(root)
    wrist_case.played(arm, range(0, 4_000))
    arm.heading_rad += radians(jump_deg)
    wrist_case.played(arm, range(4_000, 7_200))
    assert wrist_case.counts["forearm.outlier"] > 5
    assert wrist_case.counts["forearm.begun"] == 2
    assert wrist_case.heading_off_deg(arm) < 3.0 * wrist_case.heading_sigma_deg < 20.0


def test_a_small_jump_is_followed(root: Path) -> None:
    arm, wrist_case = Arm(), WristCase.of(root)
    wrist_case.played(arm, range(0, 4_000))
    arm.heading_rad += radians(-20.0)
    off: list[float] = []
    for begin in range(4_000, 12_000, 1_600):
        wrist_case.played(arm, range(begin, begin + 1_600))
        off.append(wrist_case.heading_off_deg(arm))
    assert off[2] < 10.0
    assert off[-1] < 8.0


def test_a_palm_that_contradicts_is_the_markers_alone(root: Path) -> None:
    arm, wrist_case = Arm(), WristCase.of(root)
    wrist_case.played(arm, range(0, 4_000))
    arm.heading_rad += 2.5
    wrist_case.forearm.push(4_000 * MS, arm.output(4_000))
    before, cov = wrist_case.estimator.extras.copy(), wrist_case.estimator.extras_cov.copy()
    hand = wrist_case.epoch(arm, 4_000)
    assert hand.rotation_rejected
    assert degrees(found(hand.solution).T_rig_palm[:3, :3], arm.palm(4_000)) < 3.0
    assert wrist_case.counts["forearm.outlier"] == 1
    assert np.abs(wrist_case.estimator.extras - before)[HEADING] < radians(1.0)
    assert wrist_case.estimator.extras_cov[HEADING, HEADING] >= 0.99 * cov[HEADING, HEADING]


def test_an_imu_that_begins_anew_has_no_heading_until_a_palm_is_seen(root: Path) -> None:
    arm, wrist_case = Arm(), WristCase.of(root)
    wrist_case.played(arm, range(0, 4_000), drift=0.05)
    assert wrist_case.orientation(3_990) is not None
    arm.heading_rad -= 0.5  # too little to be seen as a jump
    wrist_case.played(arm, range(6_000, 6_096), seen=False, drift=0.001)
    assert wrist_case.orientation(6_090) is None
    wrist_case.played(arm, range(6_096, 10_000), drift=0.001)
    assert wrist_case.heading_off_deg(arm) < 3.0


def test_a_silence_in_which_the_same_imu_went_on_costs_the_heading_what_it_says(root: Path) -> None:
    arm, wrist_case = Arm(), WristCase.of(root)
    wrist_case.played(arm, range(0, 6_000), drift=0.05)
    known = radians(wrist_case.heading_sigma_deg)
    assert wrist_case.orientation(6_500) is None  # no sample near
    wrist_case.played(arm, range(8_000, 8_100), seen=False, drift=0.25)
    assert radians(wrist_case.heading_sigma_deg) == pytest.approx(np.hypot(known, 0.2), rel=0.03)


@pytest.mark.parametrize("back_ms", [300, 60_000])
def test_a_clock_that_is_set_back_is_followed(root: Path, back_ms: int) -> None:
    arm, wrist_case = Arm(), WristCase.of(root)
    wrist_case.played(arm, range(0, 6_000), shift_ms=100_000)
    wrist_case.played(arm, range(6_000, 8_000), shift_ms=100_000 - back_ms)
    assert wrist_case.heading_off_deg(arm) < 3.0
    assert wrist_case.heading_sigma_deg < 10.0
    assert np.degrees(np.abs(wrist_case.wrist_angles - arm.wrist_angles(7_968))).max() < 4.0


def test_samples_that_are_missing_or_nan_change_nothing(root: Path) -> None:
    arm, wrist_case = Arm(), WristCase.of(root)
    wrist_case.played(arm, range(0, 2_000))
    before = wrist_case.orientation(1_984)
    wrist_case.forearm.push(2_000 * MS, np.full(4, nan))
    after = wrist_case.orientation(1_984)
    assert before is not None
    assert after is not None
    np.testing.assert_array_equal(after.rotation, before.rotation)
    assert wrist_case.counts["orientation.missing"] == 1
    hand = wrist_case.epoch(arm, 2_400)  # no sample is near: markers alone determine the palm
    assert wrist_case.counts["orientation.absent"] > 0
    assert degrees(found(hand.solution).T_rig_palm[:3, :3], arm.palm(2_400)) < 3.0
    learnt = wrist_case.heading_off_deg(arm)
    assert learnt < 3.0


def test_in_its_own_world_the_palm_is_bent_as_well(root: Path) -> None:
    arm, wrist_case = Arm(), WristCase.of(root)
    wrist_case.played(arm, range(0, 6_000))
    cov = wrist_case.estimator.extras_cov[WRIST_ANGLES : WRIST_ANGLES + 2, WRIST_ANGLES : WRIST_ANGLES + 2]
    wxyz, sigma = wrist_case.forearm.world_at(5_968 * MS, wrist_case.wrist_angles, cov)
    truth = axis_rotation(2, -arm.heading_rad) @ RIG_WORLD.T @ arm.palm(5_968)
    assert degrees(quaternion_to_matrix(wxyz), truth) < 4.0
    assert 1.0 < np.degrees(sigma[0]) < 8.0
    wxyz, sigma = wrist_case.forearm.world_at(9_000 * MS, wrist_case.wrist_angles, cov)
    assert np.isnan([*wxyz, *sigma]).all()


def test_the_bend_is_within_what_is_claimed(root: Path) -> None:
    """Of waving wrists: in 95 % regions at most times; what is assumed of any wrist is wide."""
    inside: list[bool] = []
    for seed in range(6):
        arm, wrist_case = Arm(1.0, seed + 20), WristCase.of(root)
        wrist_case.played(arm, range(0, 3_000))
        for begin in range(3_000, 6_000, 208):
            wrist_case.played(arm, range(begin, begin + 208))
            off = wrist_case.wrist_angles - arm.wrist_angles(begin + 176)
            cov = wrist_case.estimator.extras_cov[
                WRIST_ANGLES : WRIST_ANGLES + 2, WRIST_ANGLES : WRIST_ANGLES + 2
            ]
            inside.append(bool(off @ np.linalg.solve(cov, off) < 5.991))
    assert np.mean(inside) > 0.90


def test_of_unrelated_epochs_the_bend_is_not_carried_on(root: Path) -> None:
    arm, wrist_case = Arm(), WristCase.of(root, continuous=False)
    wrist_case.played(arm, range(0, 3_000))
    assert wrist_case.counts["forearm.begun"] == 1
    assert np.abs(wrist_case.estimator.extras[RATE : RATE + 2]).max() < 3.0
    assert wrist_case.heading_off_deg(arm) < 5.0


def test_a_mounting_is_needed_and_without_a_vertical_it_is_not_placed() -> None:
    with pytest.raises(CalibrationError, match="q_palm_imu"):
        Forearm(msgspec.structs.replace(IMU, q_palm_imu=None))
    bare = Forearm(msgspec.structs.replace(IMU, q_rig_world=None))
    assert not bare.placed
    bare.push(0, np.array([1.0, 0.0, 0.0, 0.0]))
    assert bare.orientation_at(0, np.zeros(13), np.eye(13)) is None
    assert bare.heading_of(0, np.eye(3), np.zeros(13)) is None
