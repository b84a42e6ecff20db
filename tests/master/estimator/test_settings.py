"""The estimator's settings: what is out of range, or is none, is refused by name."""

from dataclasses import astuple

import pytest

from common.errors import CalibrationError
from master.estimator.settings import DEFAULT, Settings


@pytest.mark.parametrize("name", Settings.ranges())
def test_every_setting_has_a_range_that_holds_its_own_value_and_refuses_others(name: str) -> None:
    allowed = Settings.ranges()[name]
    assert allowed.low <= getattr(DEFAULT, name) <= allowed.high
    assert allowed.unit
    assert allowed.source
    for value in (allowed.low, allowed.high):
        assert getattr(DEFAULT.changed(name, value), name) == value
    span = allowed.high - allowed.low
    for value in (allowed.low - 1e-3 * span, allowed.high + 1e-3 * span, float("nan"), float("inf")):
        with pytest.raises(CalibrationError, match=f"estimator.{name}: .*out of range"):
            DEFAULT.changed(name, value)


def test_a_setting_that_does_not_exist_is_refused() -> None:
    with pytest.raises(
        CalibrationError, match=r"estimator\.walk: no such setting; there are .*process_noise_rad_s"
    ):
        DEFAULT.changed("walk", 1.0)


def test_kernels_are_given_the_same_numbers() -> None:
    assert [float(getattr(DEFAULT.record(), name)) for name in Settings.ranges()] == list(astuple(DEFAULT))
