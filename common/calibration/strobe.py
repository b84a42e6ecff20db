"""Laser and LEDs of a wrist device and their limits: the key `strobe` of a rig.

The limits on pulse and duty are the user's; here they are held against those of the eye
(`common.calibration.eye_safety`) and of
the supply. `docs/safety.md` states what that covers, and what not. It is no certificate.
"""

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from common.calibration import eye_safety
from common.calibration.parts import Part
from common.errors import CalibrationError

Power = Annotated[float, Meta(ge=1e-6, le=1000.0)]  # [W], [W/sr] the limits for eyes lie far below
Current = Annotated[float, Meta(ge=1e-6, le=100.0)]  # [A]
Emitter = Annotated[float, Meta(ge=1e-5, le=0.1)]  # [m] from a bare die to a lamp
NearInfrared = Annotated[float, Meta(ge=700.0, le=1050.0)]


class LaserLight(Part, frozen=True):
    """The line laser; the angle over which it spreads is `laser.fan_rad` of the rig.

    Attributes:
        power_w: Optical power of the whole line while it is on [W].
        wavelength_nm: Wavelength [nm].
        peak_over_mean: How much brighter the brightest part of the line is than its mean; 1.6 for a Gaussian one
            whose fan ends at 1/e^2.
        electrical_w: What it draws from the supply while it is on [W].
        current_a: Its current, where a driver chip sets that [A].
    """

    power_w: Power
    wavelength_nm: NearInfrared
    electrical_w: Power
    peak_over_mean: Annotated[float, Meta(ge=1.0, le=100.0)] = 1.6
    current_a: Current | None = None


class LedLight(Part, frozen=True):
    """The LEDs beside the lens, all alike and on together.

    Attributes:
        count: How many.
        intensity_w_sr: Radiant intensity of one, on its axis, while it is on [W/sr].
        emitter_m: Diameter of what shines of one, its diffuser where there is one [m].
        wavelength_nm: Wavelength [nm].
        electrical_w: What all of them draw while they are on [W].
        current_a: As of the laser, of all of them.
    """

    count: Annotated[int, Meta(ge=1, le=64)]
    intensity_w_sr: Power
    emitter_m: Emitter
    wavelength_nm: NearInfrared
    electrical_w: Power
    current_a: Current | None = None


class StrobeCalibration(Part, frozen=True):
    """Laser, LEDs, and how they may be switched.

    Attributes:
        max_pulse_us: No light is ever on for longer [us].
        max_duty: Nor for a larger share of any second; of each light.
        lead_us: How much before an exposure a light goes on; what is late by more than that is rejected [us].
        others_w: What the device draws besides: camera, IMU [W].
        max_electrical_w: What all of it may draw in the mean [W]; 0.4 in Kim et al. 2012.
    """

    laser: LaserLight
    led: LedLight
    max_pulse_us: Annotated[float, Meta(ge=1.0, le=250_000.0)]
    max_duty: Annotated[float, Meta(ge=1e-6, le=1.0)]
    others_w: Annotated[float, Meta(ge=0.0, le=1000.0)]
    lead_us: Annotated[float, Meta(ge=300.0, le=10_000.0)] = 1000.0
    max_electrical_w: Power = 0.4


@dataclass(frozen=True, slots=True)
class Limit:
    """One limit and how much of it is used.

    Attributes:
        name: What is limited.
        key: The keys of the rig file that decide it.
        value, bound: In `unit`.
        source: Where the bound is from.
        fault: It reports a fault, after which a light stays on; nothing is refused for it.
    """

    name: str
    key: str
    value: float
    bound: float
    unit: str
    source: str
    fault: bool = False

    @property
    def share(self) -> float:
        """Of the bound."""
        return self.value / self.bound


def limits_of(strobe: StrobeCalibration, fan_rad: float) -> tuple[Limit, ...]:
    """Return every limit at the longest pulse and highest duty that the file allows.

    The line spreads by `fan_rad`.
    """
    pulse_s, duty = strobe.max_pulse_us * 1e-6, strobe.max_duty
    laser = _laser(strobe.laser, fan_rad, pulse_s, duty)
    return (*laser, *_leds(strobe.led, pulse_s, duty), _electrical(strobe))


def check_strobe(strobe: StrobeCalibration | None, fan_rad: float | None, where: str) -> None:
    """Refuse a strobe that may do what is not safe.

    Raises:
        CalibrationError: With `where`, the keys, their values' effect and its bound; or the laser's fan is not known.
    """
    if strobe is None:
        return
    if fan_rad is None:
        raise CalibrationError(
            f"{where}: laser.fan_rad: missing; strobe needs it to determine how much of the line enters an eye"
        )
    for limit in limits_of(strobe, fan_rad):
        if limit.share > 1.0 and not limit.fault:
            raise CalibrationError(
                f"{where}: strobe: {limit.key}: {limit.name} would be {limit.value:.4g} {limit.unit}, at most"
                f" {limit.bound:.4g} is allowed ({limit.source}); docs/safety.md"
            )


def _laser(laser: LaserLight, fan_rad: float, pulse_s: float, duty: float) -> tuple[Limit, ...]:
    enters_w = laser.power_w * eye_safety.share_of_fan(fan_rad, laser.peak_over_mean)
    single_j = eye_safety.class_1_energy_j(laser.wavelength_nm, pulse_s)
    long_w = eye_safety.class_1_power_w(laser.wavelength_nm)
    trained_j = single_j * eye_safety.train_c5(duty * eye_safety.LONG_S / pulse_s)
    hardware_timeout_s = 0.010  # of the flash driver that `--lights i2c` talks to: a pulse that nobody ends
    cut_j = eye_safety.class_1_energy_j(laser.wavelength_nm, hardware_timeout_s)
    pulse, both = "laser.power_w, max_pulse_us", "laser.power_w, max_pulse_us, max_duty"
    energy_j = enters_w * pulse_s
    return (
        Limit("laser, one pulse", pulse, energy_j, single_j, "J", "IEC 60825-1 table 3, class 1"),
        Limit(
            "laser, pulse of a train", both, energy_j, trained_j, "J", "table 3 and C5 of IEC 60825-1:2007"
        ),
        Limit(
            "laser, mean power", "laser.power_w, max_duty", enters_w * duty, long_w, "W", "table 3, > 10 s"
        ),
        Limit(
            "laser, pulse cut by the flash driver",
            "laser.power_w",
            enters_w * hardware_timeout_s,
            cut_j,
            "J",
            "table 3, 10 ms",
            fault=True,
        ),
        Limit("laser, never off", "laser.power_w", enters_w, long_w, "W", "table 3, > 10 s", fault=True),
    )


def _leds(led: LedLight, pulse_s: float, duty: float) -> tuple[Limit, ...]:
    on_eye = eye_safety.lamp_irradiance_w_m2(led.intensity_w_sr * led.count)
    one = (led.intensity_w_sr, led.emitter_m, led.wavelength_nm)
    pulse, mean = (eye_safety.retina_w_m2_sr(*one, pulsed=pulsed) for pulsed in (True, False))
    weak = eye_safety.retina_weak_limit_w_m2_sr(led.emitter_m)
    short = eye_safety.retina_pulse_limit_w_m2_sr(led.emitter_m, pulse_s)
    cornea, key = eye_safety.CORNEA_W_M2, "led.intensity_w_sr"
    return (
        Limit("LEDs, cornea", f"{key}, max_duty", on_eye * duty, cornea, "W/m2", "IEC 62471, 4.3.7"),
        Limit("LEDs, retina, mean", f"{key}, max_duty", mean * duty, weak, "W/m2/sr", "IEC 62471, 4.3.6"),
        Limit("LEDs, retina, one pulse", f"{key}, max_pulse_us", pulse, short, "W/m2/sr", "IEC 62471, 4.3.5"),
        Limit("LEDs, cornea, never off", key, on_eye, cornea, "W/m2", "IEC 62471, 4.3.7", fault=True),
        Limit("LEDs, retina, never off", key, mean, weak, "W/m2/sr", "IEC 62471, 4.3.6", fault=True),
    )


def _electrical(strobe: StrobeCalibration) -> Limit:
    mean_w = strobe.others_w + (strobe.laser.electrical_w + strobe.led.electrical_w) * strobe.max_duty
    return Limit(
        "whole device, mean electrical power",
        "laser.electrical_w, led.electrical_w, others_w, max_duty",
        mean_w,
        strobe.max_electrical_w,
        "W",
        "max_electrical_w",
    )
