"""Limits for eyes: against numbers that the standards' users know by heart, and laws."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.calibration import strobe


def test_the_milliwatt_of_class_2_is_a_quarter_second_of_the_pulse_formula() -> None:
    # The 1 mW limit of visible lasers is the class 1 limit of 0.25 s, the blink (IEC 60825-1, table 5).
    assert strobe.class_1_energy_j(700.0, 0.25) / 0.25 == pytest.approx(1e-3, rel=0.02)


def test_class_1_at_850_nm_is_0_78_milliwatt() -> None:
    # As every data sheet of an 850 nm VCSEL module says.
    assert strobe.class_1_power_w(850.0) == pytest.approx(0.78e-3, rel=0.01)
    assert strobe.laser_c4(1050.0) == pytest.approx(5.0, rel=0.01)  # table 9: 5 from 1050 nm on


def test_power_and_energy_limits_meet_at_ten_seconds() -> None:
    long_w = strobe.class_1_power_w(850.0)
    assert strobe.class_1_energy_j(850.0, 10.0) / 10.0 == pytest.approx(long_w, rel=0.02)


def test_a_lamp_as_in_the_makers_application_note() -> None:
    # OSRAM AN090: 20 IREDs of 160 mW/sr at 200 mm, and 545.5 mW/(mm^2 sr) for a small source seen for long.
    assert strobe.lamp_irradiance_w_m2(20 * 0.160) == pytest.approx(80.0)
    assert strobe.retina_weak_limit_w_m2_sr(0.001) == pytest.approx(545.5e3, rel=1e-3)


def test_the_pupil_takes_seven_of_a_hundred_millimetres() -> None:
    fan_rad = 1.8326  # 105 degrees
    assert strobe.share_of_fan(fan_rad, 1.0) == pytest.approx(4.01 / 105.0, rel=1e-3)
    assert strobe.share_of_fan(0.01, 1.0) == 1.0


@given(st.floats(1e-7, 9.0), st.floats(1.01, 3.0), st.floats(700.0, 1050.0))
def test_a_longer_pulse_may_have_more_energy_and_less_power(
    duration_s: float, times: float, nm: float
) -> None:
    short, long = (strobe.class_1_energy_j(nm, t) for t in (duration_s, duration_s * times))
    assert long >= short
    assert long / (duration_s * times) <= short / duration_s * (1.0 + 1e-9)


@given(st.floats(1.0, 1e6))
def test_more_pulses_leave_less_for_each_and_never_more_than_one(pulses: float) -> None:
    assert strobe.train_c5(2.0 * pulses) < strobe.train_c5(pulses) <= 1.0
    assert strobe.train_c5(0.0) == 1.0


@given(st.floats(1e-4, 0.1), st.floats(700.0, 1050.0))
def test_a_larger_emitter_of_one_intensity_is_less_bright(emitter_m: float, nm: float) -> None:
    for pulsed in (True, False):
        small, large = (strobe.retina_w_m2_sr(0.03, m, nm, pulsed=pulsed) for m in (emitter_m, 2 * emitter_m))
        assert large <= small
