"""The orientation of an IMU between its samples: the shorter arc, gaps, what is no rotation, and how sure it is."""

from types import SimpleNamespace
from typing import cast

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from common.arrays import Float
from common.calibration import ImuCalibration
from common.errors import CalibrationError
from common.geometry.transforms import (
    axis_rotation,
    matrix_to_quaternion,
    quaternion_to_matrix,
)
from master.estimator.epoch import OrientationMeasurement, SolvedHand
from master.estimator.pipeline import OrientationTrack, slerp
from master.estimator.settings import DEFAULT
from tests.hand_helpers import any_rotation

REACH_NS = round(1e9 * DEFAULT.sample_reach_s)
MS = 1_000_000
MOUNTED, WORLD = (0.5, 0.5, -0.5, 0.5), (0.8, 0.6, 0.0, 0.0)
UP = quaternion_to_matrix(np.array(WORLD))[:, 2]
TILT_RAD, HEADING_RAD = 0.03, 0.2
KNOWN = ImuCalibration(
    q_palm_imu=MOUNTED, q_rig_world=WORLD, orientation_sigma_rad=TILT_RAD, heading_sigma_rad=HEADING_RAD
)
TILT_ONLY = msgspec.structs.replace(KNOWN, heading_sigma_rad=None)
seeds = st.integers(0, 2**32 - 1)


def output(palm: Float) -> Float:
    """What the IMU says of itself (4,) when the palm lies like this (3, 3)."""
    world_imu = quaternion_to_matrix(np.array(WORLD)).T @ palm @ quaternion_to_matrix(np.array(MOUNTED))
    return matrix_to_quaternion(world_imu)


def solved(palm: Float) -> SolvedHand:
    """A hand of which only the palm's orientation (3, 3) is known."""
    T = np.eye(4)
    T[:3, :3] = palm
    return cast(SolvedHand, SimpleNamespace(T_rig_palm=T))


def degrees(a: Float, b: Float) -> float:
    return float(np.degrees(Rotation.from_matrix(a @ b.T).magnitude()))


def at(track: OrientationTrack, t_ns: int, near: SolvedHand | None = None) -> OrientationMeasurement:
    found = track.at(t_ns, near)
    assert found is not None
    return found


def covariance(found: OrientationMeasurement) -> Float:
    """Of the palm's turn (3, 3) [rad^2]."""
    return np.asarray(np.linalg.inv(found.information), np.float64)


def filled(imu: ImuCalibration, count: int = 12, rate_rad_s: float = 2.0) -> OrientationTrack:
    """A palm that turns about the rig's x axis, sampled every 8 ms from 1 s on."""
    track = OrientationTrack(imu)
    for k in range(count):
        track.push(1000 * MS + 8 * k * MS, output(axis_rotation(0, rate_rad_s * 0.008 * k)))
    return track


@given(seeds, st.floats(0.0, 1.0))
def test_slerp_is_that_of_scipy_whatever_the_signs(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    a, b = (Rotation.from_matrix(any_rotation(rng)) for _ in range(2))
    expected = Slerp([0.0, 1.0], Rotation.concatenate([a, b]))(share).as_matrix()
    wxyz = [r.as_quat()[[3, 0, 1, 2]] for r in (a, b)]
    for sign in (1.0, -1.0):
        found = np.array(slerp(tuple(wxyz[0]), tuple(sign * wxyz[1]), share))
        assert np.linalg.norm(found) == pytest.approx(1.0, abs=1e-9)
        np.testing.assert_allclose(quaternion_to_matrix(found), expected, atol=1e-6)


def test_between_two_samples_it_turns_steadily_and_lies_in_the_rig() -> None:
    track = filled(KNOWN)
    for t_ms in (1000, 1003, 1044, 1087):
        truth = axis_rotation(0, 2.0 * (t_ms - 1000) * 1e-3)
        assert degrees(at(track, t_ms * MS).rotation, truth) < 1e-4


def test_opposite_quaternions_are_the_same_turn() -> None:
    track = OrientationTrack(KNOWN)
    for k in range(4):
        track.push(k * 8 * MS, (-1.0) ** k * output(axis_rotation(0, 0.01 * k)))
    assert degrees(at(track, 12 * MS).rotation, axis_rotation(0, 0.015)) < 1e-4


def test_it_is_narrow_across_the_vertical_and_wide_about_it() -> None:
    cov = covariance(at(filled(KNOWN), 1008 * MS))
    across = np.cross(UP, [1.0, 0.0, 0.0])
    across /= np.linalg.norm(across)
    assert np.sqrt(UP @ cov @ UP) == pytest.approx(HEADING_RAD)
    assert np.sqrt(across @ cov @ across) == pytest.approx(TILT_RAD)


def test_a_heading_drifts_until_nothing_is_known_of_it() -> None:
    track = filled(msgspec.structs.replace(KNOWN, heading_drift_rad_s=0.01))
    track.push(21_000 * MS, output(np.eye(3)))
    cov = covariance(at(track, 21_000 * MS))
    assert np.sqrt(UP @ cov @ UP) == pytest.approx(np.hypot(HEADING_RAD, 0.2))
    track.push(601_000 * MS, output(np.eye(3)))
    assert track.at(601_000 * MS, None) is None


@given(st.floats(-np.pi, np.pi), seeds)
def test_an_unknown_heading_is_that_of_the_hand_and_its_tilt_stays(wrong_rad: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = any_rotation(rng)
    rotated = np.asarray(Rotation.from_rotvec(wrong_rad * UP).as_matrix(), np.float64)
    track = OrientationTrack(TILT_ONLY)
    track.push(0, output(rotated @ truth))
    assert track.at(0, None) is None  # nobody says where it points
    assert degrees(at(track, 0, solved(truth)).rotation, truth) < 1e-3
    off = np.asarray(Rotation.from_rotvec(rng.normal(0.0, 0.1, 3)).as_matrix(), np.float64)
    found = at(track, 0, solved(off @ truth))
    np.testing.assert_allclose(UP @ found.rotation, UP @ truth, atol=1e-9)  # tilt is the IMU's
    assert degrees(found.rotation, truth) < 30.0
    assert np.sqrt(UP @ covariance(found) @ UP) > 2.0 * np.pi


def test_uncertainty_grows_away_from_samples() -> None:
    track = filled(KNOWN, 2)
    sure, between, beyond, far = (np.trace(covariance(at(track, t * MS))) for t in (1008, 1004, 1018, 1057))
    assert sure < between < beyond < far
    assert np.sqrt((far - sure) / 3.0) < 3.0 * 0.05  # what a palm turns in that time


def test_in_a_gap_there_is_none() -> None:
    track = filled(KNOWN, 3)
    track.push(2000 * MS, output(np.eye(3)))
    assert track.at(1500 * MS, None) is None
    assert track.at(1016 * MS + REACH_NS, None) is not None
    assert track.at(1016 * MS + REACH_NS + 1, None) is None
    assert track.at(2000 * MS - REACH_NS, None) is not None
    assert track.at(2000 * MS - REACH_NS - 1, None) is None
    assert OrientationTrack(KNOWN).at(0, None) is None
    assert track.counts["orientation.absent"] == 3
    assert track.counts["orientation.used"] == 2


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        (np.full(4, np.nan), "orientation.missing"),
        (np.array([1.0, np.nan, 0.0, 0.0]), "orientation.missing"),
        (np.zeros(4), "orientation.not_unit"),
        (np.array([0.9, 0.0, 0.0, 0.0]), "orientation.not_unit"),
    ],
)
def test_what_is_no_rotation_is_dropped_and_counted(wrong: Float, reason: str) -> None:
    track, clean = filled(KNOWN), filled(KNOWN)
    track.push(1090 * MS, wrong)
    assert track.counts == {reason: 1}
    np.testing.assert_array_equal(at(track, 1092 * MS).rotation, at(clean, 1092 * MS).rotation)


def test_a_quaternion_that_was_rounded_is_taken() -> None:
    track = OrientationTrack(KNOWN)
    track.push(0, 1.005 * output(axis_rotation(1, 0.4)))
    assert degrees(at(track, 0).rotation, axis_rotation(1, 0.4)) < 1e-4


def test_a_late_sample_is_dropped_and_a_clock_set_back_begins_anew() -> None:
    track = filled(KNOWN)
    track.push(1040 * MS, output(axis_rotation(2, 1.0)))
    assert track.counts["orientation.late"] == 1
    track.push(10 * MS, output(axis_rotation(2, 1.0)))
    assert degrees(at(track, 10 * MS).rotation, axis_rotation(2, 1.0)) < 1e-4
    assert track.at(1040 * MS, None) is None


def test_one_sample_of_the_future_does_not_shut_out_those_that_follow() -> None:
    track = filled(msgspec.structs.replace(KNOWN, heading_drift_rad_s=0.01))
    track.push(2**62, output(axis_rotation(2, 1.0)))
    for k in range(2):
        track.push((21_000 + 8 * k) * MS, output(axis_rotation(0, 0.3)))
    found = at(track, 21_004 * MS)
    assert degrees(found.rotation, axis_rotation(0, 0.3)) < 1e-4
    assert np.sqrt(UP @ covariance(found) @ UP) == pytest.approx(np.hypot(HEADING_RAD, 0.2), rel=1e-3)


def test_what_it_holds_is_bounded() -> None:
    track = OrientationTrack(KNOWN)
    for k in range(3000):
        track.push(k * MS, output(np.eye(3)))
    assert len(track._samples) < 1000
    assert track.at(2990 * MS, None) is not None


@pytest.mark.parametrize("key", ["q_palm_imu", "q_rig_world"])
def test_one_that_is_not_placed_is_refused_with_the_key(key: str) -> None:
    with pytest.raises(CalibrationError, match=rf"imu\.{key}: missing"):
        OrientationTrack(msgspec.structs.replace(KNOWN, **{key: None}))
