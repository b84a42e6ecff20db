"""Tests of what one epoch measures of a hand: a held pose is no second witness, and errors are as large as claimed."""

import numpy as np
import pytest

from common.arrays import Float
from common.hand.model import TIPS
from master.estimator.epoch import FittedHand
from master.estimator.settings import DEFAULT
from tests.hand_helpers import RIGHT, palm, small_cov
from tests.master.estimator.fitted import estimator, fit, found, places, push

NATURAL = np.radians([[8.0, 8.0, 10.0, 15.0]] + [[0.0, 15.0, 25.0, 50.0 / 3]] * 4)
# two fingers straight, two bent, all spread: against the posture prior
UNNATURAL = np.radians(
    [
        [20.0, 20.0, 0.0, 40.0],
        [-18.0, 0.0, 0.0, 0.0],
        [15.0, 60.0, 20.0, 40.0 / 3],
        [-15.0, 0.0, 0.0, 0.0],
        [18.0, 70.0, 20.0, 40.0 / 3],
    ]
)


def solved(angles: Float, gone: int | None = None) -> FittedHand:
    points = places(palm(), angles)
    if gone is not None:
        points[gone] = np.nan
    return found(fit(points, small_cov()))


def tilt_deg(hand: FittedHand) -> Float:
    return np.degrees(np.sqrt(np.trace(hand.tilt_cov_rad2, axis1=1, axis2=2)))


@pytest.mark.parametrize("dt_s", [0.002, 0.011, 0.1])
def test_a_pose_that_is_held_makes_its_directions_no_surer(dt_s: float) -> None:
    machine, first = estimator(), solved(NATURAL)
    hand = first
    for k in range(21):
        hand = found(push(machine, round(k * dt_s * 1e9), places(palm(), NATURAL)).solution)
    np.testing.assert_allclose(tilt_deg(hand), tilt_deg(first), rtol=0.15)


def test_a_hand_against_the_posture_prior_is_less_sure_than_a_relaxed_one() -> None:
    relaxed, unnatural = tilt_deg(solved(NATURAL)), tilt_deg(solved(UNNATURAL))
    assert (relaxed < 17.0).all()
    assert np.median(unnatural / relaxed) > 1.5


def test_priors_that_contradict_each_other_are_no_information_about_the_epoch() -> None:
    """A finger out of sight is assumed curled, and its neighbours alike: counted as misfit, that gives 3 and more."""
    all_seen, ratio = tilt_deg(solved(NATURAL)), list[Float]()
    for gone in range(5):
        others = np.arange(5) != gone
        ratio.append((tilt_deg(solved(NATURAL, gone=gone)) / all_seen)[others])
    assert 1.0 < np.mean(ratio) < 2.4


def test_directions_err_as_much_as_is_claimed() -> None:
    """Over hands drawn from the posture prior itself, squared errors over variances average to about 1."""
    rng = np.random.default_rng(5)
    s, ratio = DEFAULT, list[Float]()
    thumb = (
        s.thumb_abduction_mean_rad,
        s.thumb_flexion_mean_rad,
        s.thumb_mcp_mean_rad,
        s.thumb_ip_mean_rad,
    )
    low, high = RIGHT.limits_rad[..., 0], RIGHT.limits_rad[..., 1]
    for _ in range(80):
        angles = np.empty((5, 4))
        angles[0] = rng.normal(thumb, s.thumb_rad)
        pip = (
            s.pip_mean_rad + rng.normal(0.0, 0.5 * s.pip_rad) + rng.normal(0.0, 0.5 * s.neighbour_pip_rad, 4)
        )
        angles[1:, 2] = np.clip(pip, low[1:, 2], high[1:, 2])
        angles[1:, 0] = rng.normal(0.0, s.abduction_rad, 4)
        angles[1:, 1] = (RIGHT.mcp_per_pip or 0.0) * angles[1:, 2] + rng.normal(0.0, s.natural_flexion_rad, 4)
        angles[1:, 3] = (RIGHT.dip_per_pip or 0.0) * angles[1:, 2]
        angles = np.clip(angles, low, high)
        T = palm(np.degrees(rng.normal(0.0, s.back_normal_rad / np.sqrt(2.0), 3)))
        truth = RIGHT.forward(T, angles)
        points = places(T, angles) + rng.multivariate_normal(np.zeros(3), small_cov()[0], 6)
        hand = found(fit(points, small_cov()))
        off = hand.joints.rotation[TIPS][:, :, 2] - truth.rotation[TIPS][:, :, 2]
        ratio.append((off**2).sum(axis=1) / np.trace(hand.tilt_cov_rad2, axis1=1, axis2=2))
    assert 0.6 < np.mean(ratio) < 1.6
