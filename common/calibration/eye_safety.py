"""Eye safety limits of light: laser class 1 and infrared lamps.

Laser class 1 by IEC 60825-1, infrared lamps of the exempt group by IEC 62471.

Only what a wrist device needs: one wavelength between 700 and 1050 nm, and sources taken as points where that is the
stricter case. IEC 60825-1 is edition 3 (2014) unless stated otherwise, IEC 62471 is edition 1 (2006). All in SI units.
"""

from math import atan, pi

LAMP_AT_M = 0.200  # IEC 62471, 6.1: distance at which all lamps but those of general lighting are judged
LONG_S = 10.0  # from here on the laser's limit is one of power (T2 of a point, IEC 60825-1, table 9)
CORNEA_W_M2 = 100.0  # IEC 62471, 4.3.7: cornea and lens, longer than 1000 s
_ALPHA_LONG, _ALPHA_SHORT = 0.011, 0.0017  # rad; IEC 62471, 4.2.2


def laser_c4(wavelength_nm: float) -> float:
    """Return correction C4 of the retinal limits, 700 to 1050 nm.

    10^(0.002 (wavelength - 700)) (IEC 60825-1, table 9).
    """
    return 10.0 ** (0.002 * (wavelength_nm - 700.0))


def class_1_energy_j(wavelength_nm: float, duration_s: float) -> float:
    """Return the class 1 energy limit [J] of one pulse of a point source.

    Through the pupil: 7e-4 t^0.75 C4 (IEC 60825-1, table 3).

    From 5 us to 10 s; a shorter pulse may have as much as one of 5 us.
    """
    ramp_s = 5e-6  # below, the energy limit no longer falls with the duration (IEC 60825-1, table 3)
    return 7e-4 * min(max(duration_s, ramp_s), LONG_S) ** 0.75 * laser_c4(wavelength_nm)


def class_1_power_w(wavelength_nm: float) -> float:
    """Return the class 1 power limit [W] of a point source, longer than 10 s.

    Through the pupil: 3.9e-4 C4 C7.

    IEC 60825-1, table 3; C7 is 1 up to 1150 nm (table 9).
    """
    return 3.9e-4 * laser_c4(wavelength_nm)


def train_c5(pulses: float) -> float:
    """Return the factor on the single-pulse limit for a train of pulses.

    For N pulses within 10 s: N^-0.25 (IEC 60825-1:2007, 8.3 f).

    Edition 3 lets pulses longer than 5 us of a small source have 1 (4.3 f); the stricter rule is kept here.
    """
    return max(pulses, 1.0) ** -0.25


def share_of_fan(fan_rad: float, peak_over_mean: float) -> float:
    """Return the share of a line laser's power that enters the pupil.

    The pupil covers 7 mm of the line, where it is brightest.

    Across the line all of it enters.

    Args:
        fan_rad: Angle over which the line spreads [rad].
        peak_over_mean: How much brighter its brightest part is than its mean.
    """
    pupil_m = 0.007  # IEC 60825-1, table 10, condition 3: aperture stop for the naked eye
    eye_at_m = 0.100  # the same condition: its distance
    return min(peak_over_mean * 2.0 * atan(0.5 * pupil_m / eye_at_m) / fan_rad, 1.0)


def lamp_irradiance_w_m2(intensity_w_sr: float) -> float:
    """Return the irradiance [W/m^2] of an eye 200 mm in front of a lamp.

    From its radiant intensity on the axis [W/sr]: I / d^2.
    """
    return intensity_w_sr / LAMP_AT_M**2


def retina_w_m2_sr(intensity_w_sr: float, emitter_m: float, wavelength_nm: float, pulsed: bool) -> float:
    """Return the burn-hazard weighted radiance of one emitter [W/(m^2 sr)].

    At 200 mm: R L (IEC 62471, 4.3.5, 4.3.6).

    R(wavelength) = 10^((700 - wavelength) / 500) (table 4.2). The radiance is the mean over the smallest field that
    the eye's movements leave: 1.7 mrad for a pulse, 11 mrad for long (4.2.2).

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
    """Return the limit of the weighted radiance of one pulse [W/(m^2 sr)].

    50000 / (alpha t^0.25) (IEC 62471, 4.3.5).
    """
    return 5e4 / (_alpha(emitter_m, _ALPHA_SHORT) * duration_s**0.25)


def retina_weak_limit_w_m2_sr(emitter_m: float) -> float:
    """Return the weighted radiance limit of a weak visual stimulus, beyond 10 s.

    For light that is hardly seen: 6000 / alpha (IEC 62471, 4.3.6).
    """
    return 6e3 / _alpha(emitter_m, _ALPHA_LONG)


def _alpha(emitter_m: float, least_rad: float) -> float:
    """Return the angle subtended by an emitter at 200 mm [rad].

    Clipped to the range for which the limits are defined.
    """
    alpha_large = 0.1  # rad; IEC 62471, 4.2.2
    return min(max(emitter_m / LAMP_AT_M, least_rad), alpha_large)
