"""A strobe's laser and LEDs keep to the limits of parts and of eye safety.

The key `strobe` of a rig. Laser class 1 by IEC 60825-1 (edition 3, 2014, unless stated otherwise), infrared lamps of
the exempt group by IEC 62471 (edition 1, 2006), for one wavelength between 700 and 1050 nm and sources taken as points
where that is the stricter case. SI units. The limits on pulse and duty are the user's; here they are held against
those of the eye and of the supply. `docs/safety.md` states what that covers, and what not. It is no certificate.
"""

from dataclasses import dataclass
from math import atan, pi
from typing import Annotated

from msgspec import Meta

from common.calibration.files import Part
from common.errors import CalibrationError

LAMP_AT_M = 0.200  # IEC 62471, 6.1: distance at which all lamps but those of general lighting are judged
LONG_S = 10.0  # from here on the laser's limit is one of power (T2 of a point, IEC 60825-1, table 9)
CORNEA_W_M2 = 100.0  # IEC 62471, 4.3.7: cornea and lens, longer than 1000 s
_ALPHA_LONG, _ALPHA_SHORT = 0.011, 0.0017  # rad; IEC 62471, 4.2.2


def laser_c4(wavelength_nm: float) -> float:
    """Correction C4, 700-1050 nm: 10^(0.002 (wavelength - 700)) (60825-1, table 9)."""
    return 10.0 ** (0.002 * (wavelength_nm - 700.0))


def class_1_energy_j(wavelength_nm: float, duration_s: float) -> float:
    """Class 1 energy limit [J] of one pulse of a point source, through the pupil.

    7e-4 t^0.75 C4 (IEC 60825-1, table 3), from 5 us to 10 s; a shorter pulse may have as much as one of 5 us.
    """
    ramp_s = 5e-6  # below, the energy limit no longer falls with the duration (IEC 60825-1, table 3)
    return 7e-4 * min(max(duration_s, ramp_s), LONG_S) ** 0.75 * laser_c4(wavelength_nm)


def class_1_power_w(wavelength_nm: float) -> float:
    """Class 1 power limit [W] of a point source, longer than 10 s, through the pupil.

    3.9e-4 C4 C7 (IEC 60825-1, table 3); C7 is 1 up to 1150 nm (table 9).
    """
    return 3.9e-4 * laser_c4(wavelength_nm)


def train_c5(pulses: float) -> float:
    """Factor on the single-pulse limit for N pulses within 10 s: N^-0.25.

    IEC 60825-1:2007, 8.3 f. Edition 3 lets pulses longer than 5 us of a small source have 1 (4.3 f); the stricter rule
    is kept here.
    """
    return max(pulses, 1.0) ** -0.25


def share_of_fan(fan_rad: float, peak_over_mean: float) -> float:
    """Share of a line laser's power that enters the pupil.

    The pupil covers 7 mm of the line, where it is brightest; across the line all of it enters.

    Args:
        fan_rad: Angle over which the line spreads [rad].
        peak_over_mean: How much brighter its brightest part is than its mean.
    """
    pupil_m = 0.007  # IEC 60825-1, table 10, condition 3: aperture stop for the naked eye
    eye_at_m = 0.100  # the same condition: its distance
    return min(peak_over_mean * 2.0 * atan(0.5 * pupil_m / eye_at_m) / fan_rad, 1.0)


def lamp_irradiance_w_m2(intensity_w_sr: float) -> float:
    """Irradiance [W/m^2] 200 mm before a lamp: I / d^2, I on the axis [W/sr]."""
    return intensity_w_sr / LAMP_AT_M**2


def retina_w_m2_sr(intensity_w_sr: float, emitter_m: float, wavelength_nm: float, pulsed: bool) -> float:
    """Burn-hazard weighted radiance of one emitter [W/(m^2 sr)] at 200 mm.

    R L (IEC 62471, 4.3.5, 4.3.6) with R(wavelength) = 10^((700 - wavelength) / 500) (table 4.2). The radiance is the
    mean over the smallest field that the eye's movements leave: 1.7 mrad for a pulse, 11 mrad for long (4.2.2).

    Args:
        intensity_w_sr: Of one emitter, on its axis [W/sr].
        emitter_m: Diameter of what shines [m].
        wavelength_nm: 700 to 1050 nm.
        pulsed: A pulse shorter than 0.25 s, not the mean over a long time.
    """
    least_m = (_ALPHA_SHORT if pulsed else _ALPHA_LONG) * LAMP_AT_M
    weight = 10.0 ** ((700.0 - wavelength_nm) / 500.0)
    return weight * intensity_w_sr / (0.25 * pi * max(emitter_m, least_m) ** 2)


def retina_pulse_limit_w_m2_sr(emitter_m: float, duration_s: float) -> float:
    """Limit of the weighted radiance of one pulse [W/(m^2 sr)].

    50000 / (alpha t^0.25) (IEC 62471, 4.3.5).
    """
    return 5e4 / (_alpha(emitter_m, _ALPHA_SHORT) * duration_s**0.25)


def retina_weak_limit_w_m2_sr(emitter_m: float) -> float:
    """Weighted radiance limit of faint light > 10 s: 6000 / alpha (IEC 62471, 4.3.6)."""
    return 6e3 / _alpha(emitter_m, _ALPHA_LONG)


def _alpha(emitter_m: float, least_rad: float) -> float:
    """Angle subtended by an emitter at 200 mm [rad], clipped to the limits' range."""
    alpha_large = 0.1  # rad; IEC 62471, 4.2.2
    return min(max(emitter_m / LAMP_AT_M, least_rad), alpha_large)


Power = Annotated[float, Meta(ge=1e-6, le=1000.0)]  # [W], [W/sr] the limits for eyes lie far below
Current = Annotated[float, Meta(ge=1e-6, le=100.0)]  # [A]
Emitter = Annotated[float, Meta(ge=1e-5, le=0.1)]  # [m] from a bare die to a lamp
NearInfrared = Annotated[float, Meta(ge=700.0, le=1050.0)]


class LaserLight(Part, frozen=True):
    """The line laser; the angle over which it spreads is `laser.fan_rad` of the rig.

    Attributes:
        power_w: Optical power of the whole line while it is on [W].
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
        intensity_w_sr: Radiant intensity of one, on its axis, while it is on [W/sr].
        emitter_m: Diameter of what shines of one, its diffuser where there is one [m].
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
    """Every limit at the longest pulse and highest duty, for the fan of the laser."""
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
    enters_w = laser.power_w * share_of_fan(fan_rad, laser.peak_over_mean)
    single_j = class_1_energy_j(laser.wavelength_nm, pulse_s)
    long_w = class_1_power_w(laser.wavelength_nm)
    trained_j = single_j * train_c5(duty * LONG_S / pulse_s)
    hardware_timeout_s = 0.010  # of the flash driver that `--lights i2c` talks to: a pulse that nobody ends
    cut_j = class_1_energy_j(laser.wavelength_nm, hardware_timeout_s)
    power = "laser.power_w"
    pulse, both = f"{power}, max_pulse_us", f"{power}, max_pulse_us, max_duty"
    energy_j, long = enters_w * pulse_s, "table 3, > 10 s"
    train, cut_by = "table 3 and C5 of IEC 60825-1:2007", "laser, pulse cut by the flash driver"
    return (
        Limit("laser, one pulse", pulse, energy_j, single_j, "J", "IEC 60825-1 table 3, class 1"),
        Limit("laser, pulse of a train", both, energy_j, trained_j, "J", train),
        Limit("laser, mean power", f"{power}, max_duty", enters_w * duty, long_w, "W", long),
        Limit(cut_by, power, enters_w * hardware_timeout_s, cut_j, "J", "table 3, 10 ms", fault=True),
        Limit("laser, never off", power, enters_w, long_w, "W", long, fault=True),
    )


def _leds(led: LedLight, pulse_s: float, duty: float) -> tuple[Limit, ...]:
    on_eye = lamp_irradiance_w_m2(led.intensity_w_sr * led.count)
    one = (led.intensity_w_sr, led.emitter_m, led.wavelength_nm)
    pulse, mean = (retina_w_m2_sr(*one, pulsed=pulsed) for pulsed in (True, False))
    weak = retina_weak_limit_w_m2_sr(led.emitter_m)
    short = retina_pulse_limit_w_m2_sr(led.emitter_m, pulse_s)
    cornea, key = CORNEA_W_M2, "led.intensity_w_sr"
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
