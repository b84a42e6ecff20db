"""Changing illumination and its effect on the picture.

A lamp of another colour temperature, or another exposure.

The camera's white balance is fixed, set under the light that the colours were calibrated in. Another light multiplies
every channel in linear light (von Kries' law of coefficients, with the channels of linear sRGB as receptors):

    gain = exposure * white(kelvin) / white(calibrated kelvin)

where `white` is the linear sRGB colour of a Planckian radiator of luminance 1, its chromaticity from the cubic splines
of Kang et al. 2002 (J. Korean Phys. Soc. 41, 865), 1667-25000 K. Equal luminance: exposure is the only change of
brightness.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Float
from common.errors import PhalanxError

CALIBRATED_KELVIN = 4300.0  # the middle of 3000-6500 K in reciprocal temperature, in which steps look equal
KELVINS = (1667.0, 25000.0)  # domain of Kang's splines
# XYZ -> linear sRGB (IEC 61966-2-1).
RGB_OF_XYZ = np.array(
    [
        [3.2404542, -1.5371385, -0.4985314],
        [-0.9692660, 1.8760108, 0.0415560],
        [0.0556434, -0.2040259, 1.0572252],
    ]
)


def planckian_xy(kelvin: float) -> tuple[float, float]:
    """CIE 1931 chromaticity x, y of a Planckian radiator, by Kang's splines.

    Raises:
        PhalanxError: Outside 1667-25000 K, where they do not hold.
    """
    if not KELVINS[0] <= kelvin <= KELVINS[1]:
        raise PhalanxError(f"light of {kelvin:g} K: from {KELVINS[0]:g} to {KELVINS[1]:g} K are possible")
    k = 1e3 / kelvin
    if kelvin <= 4000.0:
        x = ((-0.2661239 * k - 0.2343589) * k + 0.8776956) * k + 0.179910
    else:
        x = ((-3.0258469 * k + 2.1070379) * k + 0.2226347) * k + 0.240390
    if kelvin <= 2222.0:
        y = ((-1.1063814 * x - 1.34811020) * x + 2.18555832) * x - 0.20219683
    elif kelvin <= 4000.0:
        y = ((-0.9549476 * x - 1.37418593) * x + 2.09137015) * x - 0.16748867
    else:
        y = ((3.0817580 * x - 5.87338670) * x + 3.75112997) * x - 0.37001483
    return x, y


def white(kelvin: float) -> Float:
    """Return the linear sRGB (3,) of a Planckian radiator of luminance 1.

    Below about 1900 K its blue would be negative: 0.

    Raises:
        PhalanxError: As `planckian_xy`.
    """
    x, y = planckian_xy(kelvin)
    return np.maximum(RGB_OF_XYZ @ np.array([x / y, 1.0, (1.0 - x - y) / y]), 0.0)


@dataclass(frozen=True, slots=True)
class Light:
    """One light: its colour temperature [K], and the brightness of the picture.

    The brightness is relative to calibration.
    """

    kelvin: float = CALIBRATED_KELVIN
    exposure: float = 1.0

    def gains_bgr(self, calibrated_kelvin: float = CALIBRATED_KELVIN) -> Float:
        """Return the factors (3,) of the channels in linear light, blue first.

        Relative to the calibrated light.

        Raises:
            PhalanxError: A temperature outside 1667-25000 K.
        """
        return (self.exposure * white(self.kelvin) / white(calibrated_kelvin))[::-1]


@dataclass(frozen=True, slots=True)
class LightSchedule:
    """Schedule of a scene's light: knots (time [s], kelvin, exposure).

    Straight lines between the knots.

    Two knots at one time are a jump. Before the first knot and after the last nothing changes.

    Attributes:
        knots: In order of time.
        calibrated_kelvin: The light under which the camera's white balance was set.
    """

    knots: tuple[tuple[float, float, float], ...]
    calibrated_kelvin: float = CALIBRATED_KELVIN

    def __post_init__(self) -> None:
        times = [t for t, _, _ in self.knots]
        if not self.knots or times != sorted(times):
            raise PhalanxError(
                f"light course: knots must be in order of time, at least one; got times {times}"
            )
        for _, kelvin, exposure in self.knots:
            planckian_xy(kelvin)
            if not exposure > 0.0:
                raise PhalanxError(f"light course: exposure {exposure:g} must be above 0")
        white_then = white(self.calibrated_kelvin)
        if not (white_then > 0.0).all():
            raise PhalanxError(
                f"light course: calibrated_kelvin {self.calibrated_kelvin:g} has no blue at all"
            )

    def at(self, t_s: float) -> Light:
        """The light at scene time `t_s` [s]; of a jump at that very time, the new light."""
        times, kelvins, exposures = (list(column) for column in zip(*self.knots, strict=True))
        after = int(np.searchsorted(times, t_s, side="right"))
        if after == 0 or after == len(times):
            i = max(after - 1, 0)
            return Light(kelvins[i], exposures[i])
        t0, t1 = times[after - 1], times[after]
        share = (t_s - t0) / (t1 - t0)
        return Light(
            kelvins[after - 1] + share * (kelvins[after] - kelvins[after - 1]),
            exposures[after - 1] + share * (exposures[after] - exposures[after - 1]),
        )

    def gains_bgr(self, t_s: float) -> Float:
        """Factors (3,) of the channels at scene time `t_s` [s], blue first."""
        return self.at(t_s).gains_bgr(self.calibrated_kelvin)


# One minute of a room: dusk under a lamp, then the lamp is dimmed, a cloud, noon; back at the end, so that it repeats.
ROOM = LightSchedule(
    (
        (2.0, CALIBRATED_KELVIN, 1.0),
        (12.0, 3000.0, 1.0),
        (18.0, 3000.0, 0.7),
        (24.0, 3000.0, 1.3),
        (36.0, 6500.0, 1.3),
        (42.0, 6500.0, 0.7),
        (48.0, 6500.0, 1.0),
        (58.0, CALIBRATED_KELVIN, 1.0),
    )
)
