"""The simulated IMU says what a real one on this hand would, and errs as its rig file says."""

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from common.arrays import Float
from common.calibration import ImuCalibration
from common.errors import CalibrationError
from common.geometry import axis_rotation, matrix_to_quaternion, quaternion_to_matrix, rigid
from common.sim.imu import SimulatedImu
from common.sim.motion import HandState

MOUNTED, WORLD = (0.5, 0.5, -0.5, 0.5), (0.8, 0.6, 0.0, 0.0)
IMU = ImuCalibration(q_palm_imu=MOUNTED, q_rig_world=WORLD, heading_sigma_rad=0.05)
UP = quaternion_to_matrix(np.array(WORLD))[:, 2]
RATE_RAD_S = 1.5


class Turning:
    """A hand that turns steadily about the rig's x axis, at one place."""

    period_s = 100.0

    def at(self, t_s: float) -> HandState:
        return HandState(
            rigid(axis_rotation(0, RATE_RAD_S * t_s), np.array([0.1, 0.0, 0.5])), np.zeros((5, 4))
        )


def palm_of(imu: ImuCalibration, seed: int, seq: int = 10) -> Float:
    """Palm orientation (3, 3) that a sample tells, by the definition of the two quaternions of the rig file."""
    sample = SimulatedImu(Turning(), imu, seed).sample(seq, seq / imu.rate_hz, 0)
    rig_imu = quaternion_to_matrix(np.array(WORLD)) @ quaternion_to_matrix(sample.orientation_wxyz)
    return rig_imu @ quaternion_to_matrix(np.array(MOUNTED)).T


def error_of(imu: ImuCalibration, seed: int, seq: int = 10) -> Float:
    """Rotation vector (3,) [rad], rig axes, of what a sample says wrongly."""
    truth = Turning().at(seq / imu.rate_hz).T_rig_palm[:3, :3]
    return np.asarray(Rotation.from_matrix(palm_of(imu, seed, seq) @ truth.T).as_rotvec(), np.float64)


def test_rates_and_forces_are_those_of_the_motion_in_the_sensors_axes() -> None:
    sample = SimulatedImu(Turning(), IMU, 1).sample(12, 0.1, 7)
    palm_imu = quaternion_to_matrix(np.array(MOUNTED))
    assert (sample.source, sample.seq, sample.t_ns) == ("imu", 12, 7)
    np.testing.assert_allclose(palm_imu @ sample.gyro_rad_s, [RATE_RAD_S, 0.0, 0.0], atol=1e-5)
    rig_imu = Turning().at(0.1).T_rig_palm[:3, :3] @ palm_imu
    np.testing.assert_allclose(rig_imu @ sample.accel_m_s2, 9.81 * UP, atol=1e-6)


def test_tilt_and_heading_err_as_the_file_says() -> None:
    errors = np.array([error_of(IMU, seed) for seed in range(400)])
    heading = errors @ UP
    tilt = errors - heading[:, None] * UP
    assert np.sqrt((tilt**2).sum(axis=1).mean() / 2) == pytest.approx(IMU.orientation_sigma_rad, rel=0.1)
    assert heading.std() == pytest.approx(0.05, rel=0.1)


def test_most_of_the_error_stays_for_the_whole_recording() -> None:
    first, later = np.array([[error_of(IMU, seed, seq) for seed in range(100)] for seq in (10, 500)])
    assert np.corrcoef(first.ravel(), later.ravel())[0, 1] > 0.9
    assert not np.allclose(first, later)


def test_an_unknown_heading_is_anywhere_and_a_drifting_one_leaves() -> None:
    unknown = msgspec.structs.replace(IMU, heading_sigma_rad=None)
    assert np.abs([error_of(unknown, seed) @ UP for seed in range(20)]).max() > 2.0
    drifting = msgspec.structs.replace(IMU, heading_drift_rad_s=0.1)
    gone = error_of(drifting, 3, 610) @ UP - error_of(drifting, 3, 10) @ UP
    assert abs(gone) == pytest.approx(0.5, abs=0.06)  # five seconds


def test_the_same_seed_is_the_same_imu_and_samples_keep_their_rate() -> None:
    ones, again = (list(SimulatedImu(Turning(), IMU, 4).around(0.6, 0.9, 10**9)) for _ in range(2))
    np.testing.assert_array_equal([a.orientation_wxyz for a in ones], [b.orientation_wxyz for b in again])
    assert [one.seq for one in ones] == list(range(60, 121))
    assert ones[0].t_ns == 1_500_000_000


def test_one_that_is_not_mounted_cannot_be_simulated() -> None:
    with pytest.raises(CalibrationError, match="q_palm_imu and q_rig_world"):
        SimulatedImu(Turning(), ImuCalibration(), 1)


def test_its_quaternion_is_that_of_its_matrix() -> None:
    exact = msgspec.structs.replace(IMU, orientation_sigma_rad=1e-9, heading_sigma_rad=1e-9)
    truth = Turning().at(10 / IMU.rate_hz).T_rig_palm[:3, :3]
    np.testing.assert_allclose(
        matrix_to_quaternion(palm_of(exact, 1)), matrix_to_quaternion(truth), atol=1e-8
    )
