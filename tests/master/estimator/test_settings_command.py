"""Numbers of the estimator from the command line."""

from dataclasses import asdict, replace

import pytest

from common.errors import CalibrationError
from master.estimator.settings import DEFAULT, Settings


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


def test_every_default_is_inside_its_range() -> None:
    ranges = Settings.ranges()
    for name, value in asdict(DEFAULT).items():
        assert ranges[name].low <= value <= ranges[name].high, name
        assert ranges[name].source
        assert ranges[name].unit
