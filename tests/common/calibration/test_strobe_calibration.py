"""The key `strobe`: the shipped rigs are within every limit, and what is not is refused with key, value and bound."""

from pathlib import Path

import msgspec
import pytest

from common.calibration import RigCalibration, load, parse
from common.calibration.strobe import StrobeCalibration, limits_of
from common.errors import CalibrationError

ROOT = Path(__file__).resolve().parents[3]
TEXT = (ROOT / "calib_json/rigs/wrist.json").read_bytes()


def changed(path: str, value: object) -> bytes:
    rig = msgspec.json.decode(TEXT)
    at = rig["strobe"]
    *way, last = path.split(".")
    for key in way:
        at = at[key]
    at[last] = value
    return msgspec.json.encode(rig)


def strobe(text: bytes = TEXT) -> StrobeCalibration:
    found = parse(text, RigCalibration, "wrist.json").strobe
    assert found is not None
    return found


@pytest.mark.parametrize("name", ["wrist", "wrist-left"])
def test_the_shipped_devices_are_within_every_limit_even_when_they_stay_on(name: str) -> None:
    rig = load(ROOT / f"calib_json/rigs/{name}.json", RigCalibration)
    assert rig.strobe is not None
    assert rig.laser is not None
    assert rig.laser.fan_rad is not None
    limits = limits_of(rig.strobe, rig.laser.fan_rad)
    assert {limit.name for limit in limits if limit.fault} >= {"laser, never off", "LEDs, cornea, never off"}
    assert all(0.0 < limit.share <= 1.0 for limit in limits), [x.name for x in limits if x.share > 1.0]


def test_the_laser_of_the_shipped_device_by_hand() -> None:
    # 10 mW over 105 degrees, 4.01 of them in the pupil, the middle 1.6 times as bright: 0.611 mW of 0.778.
    share = {limit.name: limit.share for limit in limits_of(strobe(), 1.832595715)}
    assert share["laser, never off"] == pytest.approx(0.611 / 0.778, rel=2e-3)
    # 5 ms of that are 3.06 uJ; 7e-4 x 0.005^0.75 x 1.995 = 26.3 uJ
    assert share["laser, one pulse"] == pytest.approx(3.06 / 26.3, rel=5e-3)


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        (
            "laser.power_w",
            0.5,
            r"wrist.json: strobe: laser.power_w, max_pulse_us.*: laser, one pulse .*class 1",
        ),
        ("laser.power_w", 0.03, "max_duty: laser, pulse of a train would be 9.164e-06 J, at most 6.67"),
        (
            "led.intensity_w_sr",
            9.0,
            "led.intensity_w_sr, max_duty: LEDs, cornea would be 108 W/m2, at most 100",
        ),
        (
            "others_w",
            0.3,
            "others_w, max_duty: whole device, mean electrical power would be 0.444 W, at most 0.4",
        ),
        ("max_duty", 0.9, "max_duty: whole device"),
        ("max_duty", 1.1, r"max_duty|strobe"),
        ("laser.wavelength_nm", 650.0, r"strobe.laser.wavelength_nm"),
        ("max_pulse_us", 0.0, r"strobe.max_pulse_us"),
        ("pulse", 1.0, "unknown field `pulse`"),
    ],
)
def test_what_is_not_safe_is_refused_with_key_value_and_bound(key: str, value: object, expected: str) -> None:
    with pytest.raises(CalibrationError, match=expected):
        strobe(changed(key, value))


def test_a_strobe_without_the_fan_of_its_laser_is_refused() -> None:
    rig = msgspec.json.decode(TEXT)
    del rig["laser"]["fan_rad"]
    with pytest.raises(CalibrationError, match=r"laser.fan_rad: missing; strobe needs it"):
        parse(msgspec.json.encode(rig), RigCalibration, "wrist.json")
