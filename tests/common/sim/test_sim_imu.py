"""The simulated IMU says what a part on this hand would, raw; the filter makes of it what the rig file promises."""

import msgspec
import numpy as np
import pytest

from common.arrays import Float
from common.calibration import ImuCalibration
from common.errors import CalibrationError
from common.geometry.transforms import axis_rotation, cross, quaternion_to_matrix, rigid
from common.imu.fusion import OrientationFilter
from common.sim.motion import HandState
from common.sim.sensors import SimulatedImu

MOUNTED, WORLD = (0.5, 0.5, -0.5, 0.5), (0.8, 0.6, 0.0, 0.0)
IMU = ImuCalibration(q_palm_imu=MOUNTED, q_rig_world=WORLD)
PALM_IMU = quaternion_to_matrix(np.array(MOUNTED))
UP = quaternion_to_matrix(np.array(WORLD))[:, 2]
RATE_RAD_S = 1.5


class Rotating:
    """A hand that turns steadily about the rig's x axis, at one place."""

    period_s = 100.0

    def at(self, t_s: float) -> HandState:
        return HandState(
            rigid(axis_rotation(0, RATE_RAD_S * t_s), np.array([0.1, 0.0, 0.5])), np.zeros((5, 4))
        )


class Swaying:
    """A hand that turns to and fro about all axes and moves with 1 m/s^2, as one that gestures."""

    period_s = 100.0

    def at(self, t_s: float) -> HandState:
        rotation = [axis_rotation(k, 0.5 * np.sin((2.0 + k) * t_s + k)) for k in range(3)]
        place = 0.05 * np.array([np.sin(6.0 * t_s), np.cos(5.0 * t_s), np.sin(4.0 * t_s)])
        return HandState(rigid(rotation[0] @ rotation[1] @ rotation[2], place), np.zeros((5, 4)))


def test_rates_and_forces_are_those_of_the_motion_in_the_sensors_axes_but_for_the_parts_errors() -> None:
    exact = msgspec.structs.replace(IMU, orientation_sigma_rad=1e-9)
    rig_imu = Rotating().at(0.1).T_rig_palm[:3, :3] @ PALM_IMU
    for seed in range(20):
        imu = SimulatedImu(Rotating(), exact, seed)
        sample = imu.sample(12, 0.1, 7)
        assert (sample.source, sample.seq, sample.t_ns) == ("imu", 12, 7)
        rate = PALM_IMU @ (sample.gyro_rad_s - imu.bias_rad_s(0.1))
        np.testing.assert_allclose(rate, [RATE_RAD_S, 0.0, 0.0], atol=4.0 * 0.01 * RATE_RAD_S)  # 1 %
        np.testing.assert_allclose(rig_imu @ sample.accel_m_s2, 9.81 * UP, atol=0.03)
        assert np.isnan(sample.orientation_wxyz).all()


def test_bias_and_noise_are_those_of_the_data_sheet() -> None:
    bias = np.array([SimulatedImu(Rotating(), IMU, seed).bias_rad_s(0.0) for seed in range(300)])
    assert np.degrees(bias.std()) == pytest.approx(1.0, rel=0.1)
    imu = SimulatedImu(Rotating(), IMU, 5)
    samples = [
        imu.sample(seq, 0.1, 0) for seq in range(400)
    ]  # one instant again and again: only noise differs
    noise = np.array([one.gyro_rad_s for one in samples]).std(axis=0)
    np.testing.assert_allclose(np.degrees(noise), 3.8e-3 * np.sqrt(60.0), rtol=0.15)
    noise = np.array([one.accel_m_s2 for one in samples]).std(axis=0)
    np.testing.assert_allclose(noise, 70e-6 * 9.81 * np.sqrt(60.0), rtol=0.15)
    start, later = imu.bias_rad_s(0.0), imu.bias_rad_s(60.0)
    assert 0.0 < np.degrees(np.abs(later - start).max()) < 0.07


def tilt_error(seed: int) -> Float:
    """Rotation (3,) [rad] about level axes by which the filter's vertical is off after four seconds."""
    imu, fusion = SimulatedImu(Swaying(), IMU, seed), OrientationFilter(IMU.rate_hz)
    sample = [fusion.push(one) for one in imu.around(2.0, 4.0)][-1]
    truth = Swaying().at(sample.seq / IMU.rate_hz).T_rig_palm[:3, :3] @ PALM_IMU
    return cross(truth @ quaternion_to_matrix(sample.orientation_wxyz)[2], UP)


def test_the_filter_finds_the_tilt_as_well_as_the_file_says() -> None:
    off = np.array([tilt_error(seed) for seed in range(12)])
    rms = np.sqrt((off**2).sum(axis=1).mean() / 2.0)
    assert rms == pytest.approx(IMU.orientation_sigma_rad, rel=0.3)


def test_the_same_seed_is_the_same_imu_and_samples_keep_their_rate_and_come_early_enough_to_settle() -> None:
    ones, again = (list(SimulatedImu(Rotating(), IMU, 4).around(2.5, 2.9, 10**9)) for _ in range(2))
    for name in ("gyro_rad_s", "accel_m_s2"):
        np.testing.assert_array_equal([getattr(a, name) for a in ones], [getattr(b, name) for b in again])
    assert [one.seq for one in ones] == list(range(60, 361))
    assert ones[0].t_ns == 1_500_000_000
    assert next(iter(SimulatedImu(Rotating(), IMU, 4).around(0.3, 0.4))).seq == 0


def test_one_that_is_not_mounted_cannot_be_simulated() -> None:
    with pytest.raises(CalibrationError, match="q_palm_imu and q_rig_world"):
        SimulatedImu(Rotating(), ImuCalibration(), 1)
