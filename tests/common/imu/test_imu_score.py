"""Errors of tilt: headings do not count, what is not known is left out, and a share that holds is 95 %."""

import numpy as np
import pytest

from common.geometry.transforms import axis_rotation, matrix_to_quaternion
from common.imu.fusion import TiltErrors
from tests.hand_helpers import any_rotation


def test_the_angle_between_the_verticals_whatever_the_heading() -> None:
    rng = np.random.default_rng(3)
    truth = np.array([any_rotation(rng) for _ in range(50)])
    heading = np.array([axis_rotation(2, angle) for angle in rng.uniform(-3.0, 3.0, 50)])
    found = axis_rotation(0, np.radians(2.0)) @ heading @ truth
    q = matrix_to_quaternion(found), matrix_to_quaternion(truth)
    errors = TiltErrors.of(*q, np.full(50, np.radians(1.5)))
    np.testing.assert_allclose(np.degrees(errors.error_rad), [[2.0, 0.0]] * 50, atol=1e-9)
    assert errors.rms_deg == pytest.approx(2.0)
    assert errors.stated_deg == pytest.approx(1.5 * np.sqrt(2.0))
    assert errors.within == 1.0  # 2.0 is less than 1.5 times the root of 5.99
    assert errors.where(np.arange(50) < 0).error_rad.shape == (0, 2)


def test_of_errors_as_large_as_stated_95_percent_lie_within_and_unknown_ones_do_not_count() -> None:
    rng = np.random.default_rng(4)
    off = rng.normal(0.0, 0.02, (20_000, 2))
    q = np.column_stack((np.ones(len(off)), 0.5 * off, np.zeros(len(off))))
    q[::4] = np.nan
    errors = TiltErrors.of(q, np.tile([1.0, 0.0, 0.0, 0.0], (len(q), 1)), np.full(len(q), 0.02))
    assert len(errors.sigma_rad) == 15_000
    assert errors.within == pytest.approx(0.95, abs=0.01)
    assert errors.rms_deg == pytest.approx(errors.stated_deg, rel=0.02)
