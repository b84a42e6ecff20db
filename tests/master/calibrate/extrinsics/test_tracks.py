"""Markers and orientations between their instants: places, speeds, and rates summed up with an error."""

import numpy as np

from common.geometry.transforms import axis_rotation, matrix_to_quaternion, rotation_vector_to_matrix
from common.messages import ImuSample
from master.calibrate.extrinsics.tracks import HandTrack, ImuTrack

RATE = np.array([0.3, -0.8, 0.5])


def track() -> HandTrack:
    """A marker on a parabola, 60 Hz for a second, unseen for a tenth of it."""
    t = np.arange(60) / 60.0
    points = np.stack([0.2 * t, 0.1 * t**2, 0.5 + 0.0 * t], axis=-1)[:, None]
    points[30:36] = np.nan
    cov = np.tile(1e-6 * np.eye(3), (60, 1, 1, 1))
    return HandTrack(t, points, cov, np.tile(np.eye(4), (60, 1, 1)), np.zeros((60, 5, 4)))


def samples(zero_rad_s: float = 0.0) -> list[ImuSample]:
    """A steady turn about a fixed axis, with an error of the gyroscope about its z axis."""
    nothing = np.full(3, np.nan)
    return [
        ImuSample(
            source="imu",
            session=0,
            seq=k,
            t_ns=round(k * 1e9 / 120.0),
            gyro_rad_s=RATE + np.array([0.0, 0.0, zero_rad_s]),
            accel_m_s2=nothing,
            mag_ut=nothing,
            orientation_wxyz=matrix_to_quaternion(
                axis_rotation(0, 0.4) @ rotation_vector_to_matrix(k / 120.0 * RATE)
            ),
        )
        for k in range(241)
    ]


def test_a_parabola_is_followed_exactly_and_not_over_a_gap() -> None:
    markers = track().markers(np.array([0.2521, 0.55]))
    np.testing.assert_allclose(markers.points_m[0, 0], [0.2 * 0.2521, 0.1 * 0.2521**2, 0.5], atol=1e-12)
    np.testing.assert_allclose(markers.speed_m_s[0, 0], [0.2, 0.2 * 0.2521, 0.0], atol=1e-9)
    np.testing.assert_allclose(markers.acceleration_m_s2[0, 0], [0.0, 0.2, 0.0], atol=1e-7)
    assert markers.seen.tolist() == [[True], [False]]


def test_rates_sum_up_to_the_turn_and_say_what_their_error_does() -> None:
    zero, at = 0.01, np.array([0.3035, 1.0, 1.77])
    exact, off = ImuTrack(samples(), 0).at(at), ImuTrack(samples(zero), 0).at(at)
    true = axis_rotation(0, 0.4) @ rotation_vector_to_matrix(at[:, None] * RATE)
    np.testing.assert_allclose(exact.R_world_imu, true, atol=1e-6)
    np.testing.assert_allclose(exact.rate_rad_s, np.tile(RATE, (3, 1)), atol=1e-12)
    mended = rotation_vector_to_matrix(-(off.drift[..., :3] @ [0.0, 0.0, zero])) @ off.R_world_imu
    np.testing.assert_allclose(mended, true, atol=1e-4)
    assert np.abs(off.R_world_imu - true).max() > 5e-3  # without that it is wrong


def test_beyond_the_samples_nothing_is_known() -> None:
    assert ImuTrack(samples(), 0).at(np.array([-0.01, 0.5, 2.1])).known.tolist() == [False, True, False]
