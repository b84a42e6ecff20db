"""Angles of recorded joints are those they were made with, and a posture prior is that of the motion."""

import msgspec
import numpy as np
import pytest
from scipy.signal import lfilter

from common.arrays import Float
from common.calibration import Couplings
from common.errors import CalibrationError
from common.hand.fitting import fit_posture, joint_angles, profile_from_joints, reached_limits
from common.hand.model import HandModel
from common.hand.profiles import generated_profile, preset_limits
from master.estimator.parameters import HandParameters
from master.estimator.priors import posture_prior_of

MODELS = [HandModel.of(generated_profile("made", side)) for side in ("right", "left")]


def wandering(count: int, seed: int = 3) -> Float:
    """Angles (T, 5, 4) [rad] of a hand whose DIPs go their own way, 60 a second, each settled after half a second."""
    rng = np.random.default_rng(seed)
    begin, steps = rng.normal(size=(1, 5, 4)), rng.normal(size=(count, 5, 4))
    state, _ = lfilter([np.sqrt(1.0 - 0.97**2)], [1.0, -0.97], steps, axis=0, zi=0.97 * begin)
    angles = np.radians([0.0, 25.0, 45.0, 30.0] + np.asarray(state) * [4.0, 12.0, 15.0, 10.0])
    angles[:, 0] -= np.radians([0.0, 20.0, 30.0, 10.0])
    return angles


@pytest.mark.parametrize("model", MODELS, ids=["right", "left"])
def test_angles_come_back_from_joints(model: HandModel) -> None:
    low, high = model.limits_rad[..., 0], model.limits_rad[..., 1]
    angles = np.random.default_rng(1).uniform(0.9 * low, 0.7 * high, (200, 5, 4))
    np.testing.assert_allclose(joint_angles(model, model.chains(angles).position_m), angles, atol=1e-5)


def test_a_finger_that_bends_by_more_than_a_right_angle_is_not_turned_about() -> None:
    model = MODELS[0]
    angles = np.zeros((1, 5, 4))
    angles[0, 1:, 1], angles[0, 1:, 2], angles[0, 1:, 0] = np.radians(105.0), 0.5, 0.1
    found = joint_angles(model, model.chains(angles).position_m)
    np.testing.assert_allclose(found[0, 1:, 1], np.radians(105.0), atol=1e-5)
    np.testing.assert_allclose(found[0, 1:, 2], 0.5, atol=1e-5)


def test_a_long_motion_has_its_own_posture_and_a_short_one_that_of_others() -> None:
    posture = fit_posture(wandering(60_000))
    mean = np.reshape(posture.mean_rad, (5, 4))
    sigma = np.sqrt(np.diagonal(posture.cov_rad2)).reshape(5, 4)
    np.testing.assert_allclose(np.degrees(mean[1:]), [[0.0, 25.0, 45.0, 30.0]] * 4, atol=1.5)
    np.testing.assert_allclose(np.degrees(sigma[1:]), [[4.0, 12.0, 15.0, 10.0]] * 4, rtol=0.15)
    # Half a second is worth three independent frames, and the prior one: a quarter of the width is that of any hand.
    few = wandering(30)
    short = np.sqrt(np.diagonal(fit_posture(few).cov_rad2)).reshape(5, 4)
    assert (np.degrees(short[1:, 2]) > 17.0).all()
    assert (short[1:, 2] > 1.2 * few[:, 1:, 2].std(axis=0)).all()
    with pytest.raises(CalibrationError, match="20 are needed"):
        fit_posture(wandering(19))


def test_fingers_that_move_together_are_coupled_by_the_prior() -> None:
    angles = wandering(60_000)
    angles[:, 3] = 0.7 * angles[:, 2] + 0.3 * angles[:, 3]  # the ring finger mostly as the middle finger
    cov = np.array(fit_posture(angles).cov_rad2)
    correlation = cov / np.sqrt(np.outer(np.diagonal(cov), np.diagonal(cov)))
    assert correlation[10, 14] == pytest.approx(0.7 / np.hypot(0.7, 0.3), abs=0.05)  # their PIPs
    assert abs(correlation[6, 10]) < 0.15  # index and middle finger go their own ways


def test_a_profile_from_motion_has_its_posture_as_prior() -> None:
    model = MODELS[0]
    angles = wandering(3000)
    profile = profile_from_joints("moved", "right", model.chains(angles).position_m)
    found = HandModel.of(profile)
    parameters = HandParameters.of(found)
    posture_prior = posture_prior_of(found, parameters)
    prior_mean_rad = np.linalg.solve(posture_prior.normal[0], posture_prior.pull[0]).reshape(5, 4)
    np.testing.assert_allclose(np.degrees(prior_mean_rad[1:, 1:]), [[25.0, 45.0, 30.0]] * 4, atol=6.0)
    # A hand that defies it is believed three times as widely, about the same mean.
    np.testing.assert_allclose(
        np.linalg.inv(posture_prior.normal[1]), 9.0 * np.linalg.inv(posture_prior.normal[0]), rtol=1e-9
    )


def test_couplings_that_are_given_leave_no_posture() -> None:
    chains = MODELS[0].chains(wandering(600)).position_m
    profile = profile_from_joints("moved", "right", chains, couplings=Couplings(dip_per_pip=1.0))
    assert profile.posture is None
    assert profile.couplings == Couplings(dip_per_pip=1.0)


def test_limits_move_out_to_where_a_motion_went() -> None:
    angles = wandering(6000)
    angles[:, 4, 1] -= np.radians(40.0)  # a little finger that is bent back
    limits = reached_limits(preset_limits("K"), angles)
    assert limits.little.flexion_rad[0] == pytest.approx(np.percentile(angles[:, 4, 1], 1.0), abs=1e-4)
    assert limits.index.pip_rad == pytest.approx(preset_limits("K").index.pip_rad, abs=1e-4)
    assert limits.index.tolerance_rad == preset_limits("K").index.tolerance_rad


def test_a_dip_that_a_tracker_made_of_the_pip_leaves_a_covariance() -> None:
    angles = wandering(120_000)
    angles[:, 1:, 3] = angles[:, 1:, 2]
    smallest = np.linalg.eigvalsh(np.array(fit_posture(angles).cov_rad2))[0]
    assert np.degrees(np.sqrt(smallest)) == pytest.approx(0.5, abs=0.05)


def test_a_covariance_that_is_none_is_refused() -> None:
    profile = profile_from_joints("moved", "right", MODELS[0].chains(wandering(600)).position_m)
    assert profile.posture is not None
    first, *rest = profile.posture.cov_rad2
    broken = msgspec.structs.replace(profile.posture, cov_rad2=((-first[0], *first[1:]), *rest))
    with pytest.raises(CalibrationError, match=r"hand 'moved': posture.cov_rad2: .* positive definite"):
        HandModel.of(msgspec.structs.replace(profile, posture=broken))
