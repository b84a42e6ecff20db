"""The estimator's settings: what is out of range, or is none, is refused by name."""

from dataclasses import astuple, replace

import pytest

from common.errors import CalibrationError
from master.estimator.settings import DEFAULT, Settings


def test_every_setting_has_a_range_that_holds_its_own_value_and_refuses_others() -> None:
    for name, allowed in Settings.ranges().items():
        assert allowed.low <= getattr(DEFAULT, name) <= allowed.high, name
        assert allowed.unit, name
        assert allowed.source, name
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


# -- from the command line -------------------------------------------------------------------------------------


def test_changes_are_taken_in_their_order() -> None:
    settings = Settings.of(
        ["estimator.tracked_m=0.012", "estimator.process_noise_rad_s=6", "estimator.process_noise_rad_s=7"]
    )
    assert (settings.tracked_m, settings.process_noise_rad_s) == (0.012, 7.0)
    assert (
        replace(settings, tracked_m=DEFAULT.tracked_m, process_noise_rad_s=DEFAULT.process_noise_rad_s)
        == DEFAULT
    )


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ("estimator.tracked_m=9", "0.002 to 0.1 m"),
        ("estimator.tracked_m=nan", "out of range"),
        ("estimator.track=1", "no such setting"),
        ("estimator.tracked_m=wide", "no number"),
        ("tracked_m=0.01", "estimator.NAME=VALUE"),
        ("estimator.tracked_m", "estimator.NAME=VALUE"),
    ],
)
def test_what_is_wrong_is_refused_with_the_fix(change: str, named: str) -> None:
    with pytest.raises(CalibrationError, match=named):
        Settings.of([change])
