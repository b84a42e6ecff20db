"""The laws of disparity from sweeps: the published constants, exact recovery, weights, and points that are wrong."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.arrays import Float
from common.errors import FitError
from master.calibrate.depth.fit import (
    FITS,
    fit_affine_disparity,
    fit_depth,
    fit_power_law,
    leave_one_out,
    outliers,
    relative_error,
)
from master.calibrate.depth.sweep import Sweep
from master.fabrik.depth import AffineDisparity, PowerLaw

PUBLISHED_M = np.arange(1.0, 0.19, -0.1)
PUBLISHED_PX = np.array([39.93, 44.21, 49.54, 56.36, 65.41, 78.01, 96.79, 127.80, 189.09])
SWEEP_M = np.linspace(0.2, 1.0, 17)
RIG = AffineDisparity(37.3, 2.64)  # f B of the published optics, and 0.3 deg of yaw


def test_the_published_table_gives_the_published_constants() -> None:
    law, sd = fit_power_law(PUBLISHED_PX, PUBLISHED_M)
    residual = relative_error(law, PUBLISHED_PX, PUBLISHED_M)
    assert law.k_m == pytest.approx(45.433, rel=5e-4)
    assert law.z == pytest.approx(-1.035, abs=2e-4)
    assert np.abs(residual).max() < 2e-4
    assert 0.0 < sd[0] < 0.01
    assert 0.0 < sd[1] < 1e-4


def test_a_yawed_pair_has_nearly_the_published_constants() -> None:
    law, _ = fit_power_law(RIG.disparity(SWEEP_M), SWEEP_M)
    residual = relative_error(law, RIG.disparity(SWEEP_M), SWEEP_M)
    assert law.k_m == pytest.approx(45.433, rel=0.01)
    assert law.z == pytest.approx(-1.035, rel=0.01)
    assert 0.001 < np.abs(residual).mean() < 0.01  # a power law is not the law of two cameras


@given(st.floats(20.0, 60.0), st.floats(-1.2, -0.9))
def test_an_exact_power_law_is_found_again(k: float, z: float) -> None:
    law, _ = fit_power_law(PowerLaw(k, z).disparity(SWEEP_M), SWEEP_M)
    residual = relative_error(law, PowerLaw(k, z).disparity(SWEEP_M), SWEEP_M)
    assert (law.k_m, law.z) == pytest.approx((k, z), rel=1e-9)
    assert np.abs(residual).max() < 1e-9


@given(st.floats(10.0, 100.0), st.floats(-8.0, 8.0))
def test_an_exact_affine_law_is_found_again(a: float, x0: float) -> None:
    law, _ = fit_affine_disparity(AffineDisparity(a, x0).disparity(SWEEP_M), SWEEP_M)
    residual = relative_error(law, AffineDisparity(a, x0).disparity(SWEEP_M), SWEEP_M)
    assert (law.a_m_px, law.x0_px) == pytest.approx((a, x0), rel=1e-9, abs=1e-9)
    assert np.abs(residual).max() < 1e-9


def test_standard_deviations_are_those_of_repeated_sweeps() -> None:
    rng, found, stated = np.random.default_rng(8), [], []
    for _ in range(200):
        law, sd = fit_affine_disparity(RIG.disparity(SWEEP_M + rng.normal(0.0, 1e-3, 17) * SWEEP_M), SWEEP_M)
        found.append((law.a_m_px, law.x0_px))
        stated.append(sd)
    assert np.std(found, axis=0) == pytest.approx(np.sqrt(np.mean(np.square(stated), axis=0)), rel=0.15)


def test_places_of_one_disparity_determine_no_law() -> None:
    with pytest.raises(FitError, match="all places have the same disparity"):
        fit_power_law(np.full(3, 50.0), np.array([0.5, 0.6, 0.7]))


def in_disparity(disparity: Float, distance: Float) -> AffineDisparity:
    rows = np.stack([1.0 / distance, np.ones_like(distance)], axis=1)
    a, x0 = np.linalg.lstsq(rows, disparity, rcond=None)[0]
    return AffineDisparity(float(a), float(x0))


def test_relative_weights_beat_weights_in_disparity_where_the_ruler_errs_by_a_millimetre() -> None:
    rng = np.random.default_rng(4)
    relative, disparity = [], []
    for _ in range(300):
        x = RIG.disparity(SWEEP_M + rng.normal(0.0, 1e-3, 17)) + rng.normal(0.0, 0.1, 17)
        law, _ = fit_affine_disparity(x, SWEEP_M)
        for errors, fitted in ((relative, law), (disparity, in_disparity(x, SWEEP_M))):
            errors.append(np.abs(relative_error(fitted, RIG.disparity(SWEEP_M), SWEEP_M)).mean())
    assert np.mean(relative) < 0.8 * np.mean(disparity)
    assert np.mean(relative) < 0.001


def test_leaving_one_out_judges_a_point_by_the_others_alone() -> None:
    x = RIG.disparity(SWEEP_M)
    assert np.abs(leave_one_out(FITS["affine_disparity"], x, SWEEP_M)).max() < 1e-9
    x[5] *= 1.04
    error = leave_one_out(FITS["affine_disparity"], x, SWEEP_M)
    # The others are exact, so the whole 4 % of disparity less offset is this point's own error.
    assert error[5] == pytest.approx(RIG.depth(x[5:6])[0] / SWEEP_M[5] - 1.0, rel=1e-6)
    assert abs(error[5]) > 5 * np.abs(np.delete(error, 5)).max()


@pytest.mark.parametrize("wrong", [[3], [0], [16], [2, 9, 15]])
def test_wrong_points_are_reported_and_no_others(wrong: list[int]) -> None:
    rng = np.random.default_rng(11)
    x = RIG.disparity(SWEEP_M) + rng.normal(0.0, 0.08, 17)
    x[wrong] *= 1.03
    assert np.flatnonzero(outliers(x, SWEEP_M)).tolist() == wrong


def test_no_good_point_is_called_wrong() -> None:
    called = 0
    for seed in range(200):
        rng = np.random.default_rng(seed)
        x = RIG.disparity(SWEEP_M + rng.normal(0.0, 5e-4, 17)) + rng.normal(0.0, 0.08, 17)
        called += int(outliers(x, SWEEP_M).any())
    assert called <= 4  # 2 %


def test_many_distances_are_judged_too() -> None:
    distance = np.linspace(0.2, 1.0, 400)
    x = RIG.disparity(distance)
    x[[7, 300]] *= 1.05
    assert np.flatnonzero(outliers(x, distance)).tolist() == [7, 300]


def test_the_report_keeps_wrong_points_out_of_the_fit_and_knows_the_better_law() -> None:
    x = RIG.disparity(SWEEP_M)
    x[4] *= 1.05
    sweep = Sweep.of_disparity(SWEEP_M, x, [f"line {i}" for i in range(17)])
    report = fit_depth(sweep, {"ideal": AffineDisparity(37.3, 0.0)})
    assert np.flatnonzero(~report.used).tolist() == [4]
    assert report.affine_disparity.a_m_px == pytest.approx(37.3, rel=1e-9)
    assert report.best == "affine_disparity"
    assert report.mean_max("ideal")[0] > 0.02 > 0.01 > report.mean_max("power_law")[0]
    of_power = Sweep.of_disparity(SWEEP_M, PowerLaw(45.433, -1.035).disparity(SWEEP_M), sweep.place)
    assert fit_depth(of_power, {}).best == "power_law"
