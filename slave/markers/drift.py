"""Estimate of the change of the light since calibration.

It is made from the colours of the markers themselves.

Another light multiplies each channel in linear light by one gain that all surfaces share (von Kries). A marker shows,
against its colour at calibration, the product of these gains and of its own shading s, which is the same in all three
channels (a cap turned from the lamp):

    log colour[m, k] - log reference[m, k] = x[k] + s[m] + e[m, k]

x, the log gains, are solved from all markers of a frame together by weighted least squares. A channel weighs by
what it can measure: a marker is nearly black in one or two channels; what is seen there is sheen and flare, which
come and go with the pose (`OUTLIER`). A marker that fits badly (half covered, in a coloured shadow) weighs less the
worse it fits (Cauchy weights, Holland and Welsch 1977). The estimate follows the solution slowly, and never leaves
its bounds.

What a few markers cannot constrain stays near an anchor: the light that many markers last agreed on. Without it, one
marker whose colour differs a little from its reference would, look by look, carry the light away with it.
"""

import math
from dataclasses import dataclass

import numpy as np

from common.arrays import Float

# Of red and blue against green: between any two lights of 3000-6500 K, and a little more.
LIMIT_RED, LIMIT_BLUE = 2.2, 3.6
LIMIT_EXPOSURE = 2.5  # of green
LOG_LIMITS = math.log(LIMIT_BLUE), math.log(LIMIT_EXPOSURE), math.log(LIMIT_RED)
RATE_PER_S = 0.5  # largest rate of each of the three: 3000 -> 6500 K within 10 s is at most 0.25
# How far the light may be from the anchor (sd of each channel, and of all together): what a look constrains well it
# decides, and a lone marker, which constrains two channels at most, moves the third one little.
WEAK, WEAK_TOGETHER = 0.3, 0.6
KNOWN = np.asarray(np.linalg.inv(WEAK**2 * np.eye(3) + WEAK_TOGETHER**2), np.float64)
EYE = np.eye(3)


@dataclass(frozen=True, slots=True, eq=False)
class GainFit:
    """Gains of one look at the markers.

    Attributes:
        log_gains: (3,) natural logarithms, blue, green, red.
        residual: (M,) distance of each marker from them, in standard deviations; NaN: not seen.
    """

    log_gains: Float
    residual: Float


def fit_gains(colour: Float, reference: Float, weight: Float, known: Float) -> GainFit:
    """Gains that best explain the colours of the markers.

    Args:
        colour: (M, 3) linear light of each marker's core, blue first; NaN or 0: not seen.
        reference: (M, 3) the same at calibration, positive.
        weight: (M,) 0..1, how far each observation is trusted.
        known: (3,) log gains known before; where the markers constrain nothing, they stay.
    """
    residual = np.full(len(colour), np.nan)
    seen = np.flatnonzero((np.nan_to_num(colour) > 0.0).all(axis=1) & (np.nan_to_num(weight) > 0.0))
    if not seen.size:
        return GainFit(known, residual)
    now, then = colour[seen], reference[seen]
    shift = np.log(now / then)
    outlier = 0.01  # linear light of sheen and skin on a marker, as it comes and goes
    uneven = 0.06  # relative: other causes, such as a hue that differs between the lit and the shadow side
    variance = uneven**2 + (outlier * np.exp(known) / now) ** 2 + (outlier / then) ** 2
    clipped = 0.9  # linear light; of a brighter mean many pixels are clipped, and it constrains no gain
    variance[now > clipped] += 1.0
    # The inverse of diag(variance) + SHADING^2 for each marker, by Sherman and Morrison.
    sure = 1.0 / variance
    shading = 0.35  # relative: the light on one marker against another's
    shared = sure / np.sqrt(shading**-2 + sure.sum(axis=1, keepdims=True))
    information = sure[:, :, None] * EYE - shared[:, :, None] * shared[:, None, :]
    trust, x = weight[seen], known
    rounds = 3
    for _ in range(rounds):
        away = shift - x
        distance = _distance(away, information)
        # standard deviations (of three channels, whose mean is 1.6) at which a marker has half its weight
        cauchy = 2.5
        heavy = (trust * (1.0 / (1.0 + (distance / cauchy) ** 2)))[:, None, None] * information
        total = heavy.sum(axis=0) + KNOWN
        right_side = (heavy @ shift[:, :, None]).sum(axis=0)[:, 0] + KNOWN @ known
        x = np.asarray(np.linalg.solve(total, right_side), np.float64)
    residual[seen] = _distance(shift - x, information)
    return GainFit(x, residual)


def _distance(away: Float, information: Float) -> Float:
    """Mahalanobis distances (M,) of (M, 3) with the inverse covariances (M, 3, 3)."""
    return np.sqrt((away[:, None] @ information @ away[:, :, None])[:, 0, 0])


def bounded(log_gains: Float) -> Float:
    """Clip log gains (3,) to their bounds.

    Green first, then red and blue against it.
    """
    blue, green, red = log_gains.tolist()
    b = min(max(blue - green, -LOG_LIMITS[0]), LOG_LIMITS[0])
    r = min(max(red - green, -LOG_LIMITS[2]), LOG_LIMITS[2])
    green = min(max(green, -LOG_LIMITS[1]), LOG_LIMITS[1])
    return np.array([green + b, green, green + r])


def at_bound(log_gains: Float) -> bool:
    """Whether the light has reached a bound, so that it may be beyond."""
    blue, green, red = log_gains.tolist()
    reached = (abs(blue - green), abs(green), abs(red - green))
    return any(a >= 0.98 * limit for a, limit in zip(reached, LOG_LIMITS, strict=True))


class ColourDrift:
    """Tracker of the light of one camera.

    Holds the log gains, their anchor, and the time of the last look.
    """

    def __init__(self, reference: Float) -> None:
        """Begin at the light of calibration.

        Args:
            reference: (M, 3) linear light of each marker's core at calibration, blue first.

        Raises:
            ValueError: A reference is not three positive numbers.
        """
        if reference.ndim != 2 or reference.shape[1] != 3 or not (reference > 0.0).all():
            raise ValueError(f"reference must be (M, 3) positive, got {reference.shape}")
        self._reference = reference
        self._x = self._anchor = np.zeros(3)
        self._t_ns: int | None = None

    @property
    def log_gains(self) -> Float:
        """Log gains (3,) of the light against calibration, blue, green, red."""
        return self._x

    def restart(self, log_gains: Float) -> None:
        """Go on from a light that is known otherwise."""
        self._x = self._anchor = bounded(log_gains)

    def shift(self, change: Float) -> None:
        """Add a change of the light (3,), in log gains, that was measured elsewhere.

        It was measured on what stands still.
        """
        self._x, self._anchor = bounded(self._x + change), bounded(self._anchor + change)

    def push(self, colour: Float, clarity: Float, t_ns: int) -> GainFit | None:
        """Learn from the markers of one frame; None where the last look is too recent.

        Args:
            colour: (M, 3) linear light of each marker's core, blue first; NaN: not seen.
            clarity: (M,) 0..1; NaN: not seen.
            t_ns: Time of the frame [ns], rising.
        """
        every_ns = 100_000_000  # colours are looked at so often; light has no need of more
        if self._t_ns is not None and 0 <= t_ns - self._t_ns < every_ns:
            return None
        gap_ns = 500_000_000  # a step in time is taken as no longer than this
        dt_s = 0.0 if self._t_ns is None else min(max(t_ns - self._t_ns, 0), gap_ns) * 1e-9
        self._t_ns = t_ns
        fit = fit_gains(colour, self._reference, np.nan_to_num(clarity), self._anchor)
        time_s = 1.0  # time constant of following
        blue, green, red = (-math.expm1(-dt_s / time_s) * (fit.log_gains - self._x)).tolist()
        most = RATE_PER_S * dt_s
        b, g, r = (min(max(step, -most), most) for step in (blue - green, green, red - green))
        self._x = bounded(self._x + np.array([g + b, g, g + r]))
        anchor_s, many = 5.0, 4  # time constant of the anchor, and how many markers move it
        if np.count_nonzero(np.isfinite(fit.residual)) >= many:
            self._anchor = self._anchor - math.expm1(-dt_s / anchor_s) * (self._x - self._anchor)
        return fit
