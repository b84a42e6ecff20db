"""What other sensors leave open: a process stepped exactly, and no more learnt of it than is new."""

from math import exp

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.arrays import Float
from common.records import boxed, record
from master.estimator.problem import EpochPrior
from master.estimator.sensors import EXTRAS, HEADING, LED_SCALE, RATE, TILT, WRIST_ANGLES
from master.estimator.settings import DEFAULT
from master.estimator.state import ExtrasScratch, stationary_of, unknown_hand
from tests.master.estimator.kernels import keep_extras_at, predict_extras_at

N = 20  # free angles, as before a wrist device: the kernels are there
TILT_RAD = 0.02
SETTINGS = DEFAULT.record()
seeds = st.integers(0, 2**32 - 1)


class Extras:
    """Extras of a hand, and their prior."""

    def __init__(self, *, loose: bool = True) -> None:
        self.state = unknown_hand(n=N, K=EXTRAS, N=6 + N + EXTRAS)
        self.state.stationary[:] = stationary_of(DEFAULT, loose=loose, tilt_rad=TILT_RAD)
        self.state.z_cov[:] = np.diag(self.state.stationary)
        self.epoch_prior = record(EpochPrior, n=N, K=EXTRAS)
        self.scratch = record(ExtrasScratch, K=EXTRAS)

    @property
    def mean(self) -> Float:
        return self.state.z.copy()

    @property
    def cov(self) -> Float:
        return self.state.z_cov.copy()

    def set(self, mean: Float, cov: Float) -> "Extras":
        self.state.z[:], self.state.z_cov[:] = mean, cov
        return self

    def after(self, dt_s: float, process_noise_rad2: float = 0.0) -> "Extras":
        """Step them, in place."""
        boxes = boxed(SETTINGS), boxed(self.state)
        predict_extras_at(*boxes, dt_s, process_noise_rad2, boxed(self.epoch_prior), boxed(self.scratch))
        return self

    def measure(self, dt_s: float, information: Float, measured: Float, scale: float = 1.0) -> "Extras":
        """An epoch that measures them with so much information (K, K), in place."""
        whole = np.asarray(np.linalg.inv(self.epoch_prior.z_info + information), np.float64)
        mean = whole @ (self.epoch_prior.z_info @ self.epoch_prior.z + information @ measured)
        cov = np.eye(6 + N + EXTRAS)
        cov[-EXTRAS:, -EXTRAS:] = scale * whole
        boxes = boxed(SETTINGS), boxed(self.state)
        keep_extras_at(*boxes, dt_s, boxed(self.epoch_prior), mean, cov, scale, boxed(self.scratch))
        return self


def drawn(seed: int) -> tuple[Float, Float]:
    """A mean and a covariance, none wider than usual."""
    rng = np.random.default_rng(seed)
    stationary = np.sqrt(Extras().state.stationary)
    root = rng.normal(size=(EXTRAS, EXTRAS)) * 0.2
    return stationary * rng.normal(size=EXTRAS), stationary[:, None] * (
        root @ root.T + 1e-4 * np.eye(EXTRAS)
    ) * stationary


@given(st.floats(1e-3, 3.0))
@settings(max_examples=30)
def test_a_bend_moves_as_its_closed_form(dt_s: float) -> None:
    """Matern 3/2: mean and variance of bend and rate that were known exactly (Hartikainen, Saerkkae 2010)."""
    mean = np.zeros(EXTRAS)
    mean[[WRIST_ANGLES, RATE]] = 0.3, -0.8
    found = Extras().set(mean, 1e-18 * np.eye(EXTRAS)).after(dt_s)
    paced, sigma2 = DEFAULT.wrist_rate_1_s * dt_s, DEFAULT.flexion_rad**2
    decay = exp(-paced)
    wrist_angles = decay * ((1.0 + paced) * 0.3 - 0.8 * dt_s)
    rate = decay * (-(DEFAULT.wrist_rate_1_s**2) * dt_s * 0.3 - 0.8 * (1.0 - paced))
    np.testing.assert_allclose(found.mean[[WRIST_ANGLES, RATE]], [wrist_angles, rate], rtol=1e-9, atol=1e-12)
    variance = sigma2 * (1.0 - decay**2 * ((1.0 + paced) ** 2 + paced**2))
    of_rate = DEFAULT.wrist_rate_1_s**2 * sigma2 * (1.0 - decay**2 * ((1.0 - paced) ** 2 + paced**2))
    both = 2.0 * sigma2 * DEFAULT.wrist_rate_1_s * paced**2 * decay**2
    expected = [[variance, both], [both, of_rate]]
    np.testing.assert_allclose(
        found.cov[np.ix_([WRIST_ANGLES, RATE], [WRIST_ANGLES, RATE])], expected, rtol=1e-6, atol=1e-12
    )
    np.testing.assert_allclose(found.mean[[WRIST_ANGLES + 1, RATE + 1]], 0.0, atol=1e-12)


@given(st.floats(0.0, 3.0), st.floats(0.0, 3.0), seeds)
@settings(max_examples=30)
def test_two_steps_are_one(first_s: float, second_s: float, seed: int) -> None:
    mean, cov = drawn(seed)
    twice = Extras().set(mean, cov).after(first_s, 0.01).after(second_s, 0.02)
    once = Extras().set(mean, cov).after(first_s + second_s, 0.03)
    np.testing.assert_allclose(twice.mean, once.mean, atol=1e-9)
    np.testing.assert_allclose(twice.cov, once.cov, atol=1e-9)


def test_covariance_ends_at_the_stationary_one_and_the_heading_keeps_drifting() -> None:
    mean, cov = drawn(1)
    far = Extras().set(mean, cov)
    for _ in range(100):
        far.after(1e3, 1e-3)
    quick = [*range(WRIST_ANGLES, HEADING)]
    np.testing.assert_allclose(
        far.cov[quick][:, quick], np.diag(far.state.stationary)[quick][:, quick], atol=1e-9
    )
    np.testing.assert_allclose(far.mean[quick], 0.0, atol=1e-9)
    assert far.mean[HEADING] == pytest.approx(mean[HEADING])
    assert far.cov[HEADING, HEADING] == pytest.approx(cov[HEADING, HEADING] + 0.1)
    assert np.abs(far.mean[LED_SCALE]) < 1e-3 * np.abs(mean[LED_SCALE])


def test_what_is_constant_is_so_for_a_session() -> None:
    mean, cov = drawn(2)
    later = Extras().set(mean, cov).after(600.0)
    kept = [*range(5), LED_SCALE]
    np.testing.assert_allclose(later.mean[kept], mean[kept], rtol=0.07)


def test_a_bend_goes_back_to_the_posture_that_is_kept() -> None:
    extras = Extras()
    extras.state.wrist_mean_rad[:] = -0.4, 0.1
    mean = np.zeros(EXTRAS)
    mean[WRIST_ANGLES : WRIST_ANGLES + 2] = 0.2, 0.2
    extras.set(mean, 1e-6 * np.eye(EXTRAS))
    extras.after(0.3 / DEFAULT.wrist_rate_1_s)
    assert -0.4 < extras.mean[WRIST_ANGLES] < 0.2
    extras.after(15.0 / DEFAULT.wrist_rate_1_s)
    np.testing.assert_allclose(extras.mean[WRIST_ANGLES : WRIST_ANGLES + 2], [-0.4, 0.1], atol=1e-3)


def test_a_posture_that_is_kept_is_learnt() -> None:
    extras, information, measured = Extras(), np.zeros((EXTRAS, EXTRAS)), np.zeros(EXTRAS)
    information[WRIST_ANGLES, WRIST_ANGLES], measured[WRIST_ANGLES] = 1e4, -0.5
    for _ in range(60):
        extras.after(1.0).measure(1.0, information, measured)
    assert extras.state.wrist_mean_rad[0] == pytest.approx(-0.5, abs=0.04)
    assert abs(extras.state.wrist_mean_rad[1]) < 1e-9


def test_the_prior_information_is_the_inverse_of_the_covariance() -> None:
    mean, cov = drawn(3)
    extras = Extras().set(mean, cov).after(0.1, 1e-4)
    np.testing.assert_allclose(extras.epoch_prior.z, extras.mean, rtol=1e-12)
    np.testing.assert_allclose(extras.epoch_prior.z_info @ extras.cov, np.eye(EXTRAS), atol=1e-6)


@pytest.mark.parametrize("scale", [1.0, 3.0])
def test_an_epoch_long_after_the_last_counts_as_a_whole_and_one_at_once_not_at_all(scale: float) -> None:
    rng, (mean, cov) = np.random.default_rng(4), drawn(4)
    root = rng.normal(size=(EXTRAS, EXTRAS)) / np.sqrt(np.diag(cov))
    information, measured = root.T @ root, rng.normal(size=EXTRAS) * np.sqrt(np.diag(cov))
    long, again = (Extras().set(mean, cov).after(1e-3) for _ in range(2))
    kalman = np.linalg.inv(long.epoch_prior.z_info + information)
    expected = kalman @ (long.epoch_prior.z_info @ long.epoch_prior.z + information @ measured)
    long.measure(1e6, information, measured, scale)
    np.testing.assert_allclose(long.mean, expected, atol=0.01 * np.sqrt(np.diag(cov)).max())
    np.testing.assert_allclose(np.diag(long.cov), np.diag(kalman), rtol=0.01)
    before = again.cov
    alone = np.zeros((EXTRAS, EXTRAS))
    alone[LED_SCALE, LED_SCALE] = 1.0 / cov[LED_SCALE, LED_SCALE]
    again.measure(0.0, alone, measured, scale)
    np.testing.assert_allclose(again.cov, before, rtol=1e-6, atol=1e-12)


def test_what_is_constant_is_learnt_by_the_second_and_not_by_the_frame() -> None:
    """A second of epochs at 30 and at 120 Hz measures as much of it."""
    left: list[float] = []
    for rate_hz in (30, 120):
        extras, information = Extras(), np.zeros((EXTRAS, EXTRAS))
        information[0, 0] = information[1, 1] = 1.0 / np.radians(4.0) ** 2
        for _ in range(rate_hz):
            extras.after(1.0 / rate_hz).measure(1.0 / rate_hz, information, np.zeros(EXTRAS))
        left.append(float(np.sqrt(extras.cov[1, 1])))
    assert left[0] == pytest.approx(left[1], rel=0.02)
    seconds = 1.0 / DEFAULT.errs_s  # errors of that time are one
    assert left[0] == pytest.approx(DEFAULT.hinge_rad / np.sqrt(1.0 + seconds), rel=0.05)


@given(seeds)
@settings(max_examples=60)
def test_it_stays_a_covariance_whatever_comes(seed: int) -> None:
    rng = np.random.default_rng(seed)
    extras = Extras(loose=bool(rng.integers(2)))
    for _ in range(25):
        dt_s = float(rng.choice([0.0, 1e-4, 0.033, 1.0, 50.0]))
        extras.after(dt_s, float(rng.choice([0.0, 1e-6, 0.5])))
        root = rng.normal(size=(3, EXTRAS)) * 10.0 ** rng.uniform(-2.0, 3.0)
        extras.measure(dt_s, root.T @ root, rng.normal(size=EXTRAS), float(rng.uniform(1.0, 5.0)))
        cov, size = extras.cov, np.sqrt(np.diag(extras.cov))
        assert np.isfinite(extras.mean).all()
        assert (size > 0.0).all()
        assert np.linalg.eigvalsh(cov / np.outer(size, size)).min() > -1e-7
        assert (
            size[[*range(HEADING), LED_SCALE]]
            < 1.01 * np.sqrt(extras.state.stationary[[*range(HEADING), LED_SCALE]])
        ).all()


def test_a_palm_that_was_calibrated_does_not_bend_and_a_tilt_is_at_least_of_a_milliradian() -> None:
    strapped, loose = (stationary_of(DEFAULT, loose=loose, tilt_rad=0.0) for loose in (False, True))
    np.testing.assert_allclose(
        np.sqrt(strapped[WRIST_ANGLES : WRIST_ANGLES + 2]), DEFAULT.calibrated_palm_rad
    )
    np.testing.assert_allclose(
        np.sqrt(loose[WRIST_ANGLES : WRIST_ANGLES + 2]), [DEFAULT.flexion_rad, DEFAULT.deviation_rad]
    )
    np.testing.assert_allclose(np.sqrt(loose[TILT : TILT + 2]), 1e-3)
