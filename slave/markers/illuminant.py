"""Estimate the light from the markers' colours, or from a whole image.

Another light multiplies each channel in linear light by one gain that all surfaces share (von Kries). Against its
colour at calibration a marker shows these gains x and its own shading s, the same in all channels:

    log colour[m, k] - log reference[m, k] = x[k] + s[m] + e[m, k]

x is solved from all markers of a frame by weighted least squares. A channel weighs by what it can measure: where a
marker is nearly black, sheen and flare are seen (`outlier`); a marker that fits badly weighs less (Cauchy weights,
Holland and Welsch 1977). The estimate follows slowly within bounds. What a few markers cannot constrain stays near an
anchor, the light that many markers last agreed on, since else one marker a little off would carry the light away with
it.

At a start one marker looks like another one at calibration; only under the right light do all fit all references. So
lights on the line of black bodies are tried: by Wien's law a channel at wavelength l gains -c2/l (1/T' - 1/T),
straight in log red/green and blue/green (Finlayson and Hordley 2001, J. Opt. Soc. Am. A 18, 253); the fit then leaves
the line. Where little but skin is seen, a light far warmer than any lamp explains it best: a light beyond the bounds
proves nothing, and one that is not expected needs more markers.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import cast

import cv2
import numpy as np

from common.arrays import Float, Image
from common.geometry.srgb import gain_tables, to_linear
from slave.markers.classify import ColourTable

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
    """Gains of one look at the markers."""

    log_gains: Float  # (3,) natural logarithms, blue, green, red
    residual: Float  # (M,) distance of each marker from them, in standard deviations; NaN: not seen


def fit_gains(colour: Float, reference: Float, weight: Float, known: Float) -> GainFit:
    """Gains that best explain the colours of the markers.

    `colour`: (M, 3) linear light of each core, blue first, NaN or 0: not seen; `reference`: (M, 3) the same at
    calibration; `weight`: (M,) 0..1, trust in each; `known`: (3,) log gains that stay where the markers constrain
    nothing.
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
        deviation = shift - x
        distance = _distance(deviation, information)
        # standard deviations (of three channels, whose mean is 1.6) at which a marker has half its weight
        cauchy = 2.5
        heavy = (trust * (1.0 / (1.0 + (distance / cauchy) ** 2)))[:, None, None] * information
        total = heavy.sum(axis=0) + KNOWN
        right_side = (heavy @ shift[:, :, None]).sum(axis=0)[:, 0] + KNOWN @ known
        x = np.asarray(np.linalg.solve(total, right_side), np.float64)
    residual[seen] = _distance(shift - x, information)
    return GainFit(x, residual)


def _distance(deviation: Float, information: Float) -> Float:
    """Mahalanobis distances (M,) of (M, 3) with the inverse covariances (M, 3, 3)."""
    return np.sqrt((deviation[:, None] @ information @ deviation[:, :, None])[:, 0, 0])


def gain_difference(a: Float, b: Float, dim: float = 0.15) -> float:
    """How different two lights (3,) look, in log gains of red or blue against green.

    `dim`: what brightness counts against hue: the ranges are wide in it.
    """
    blue, green, red = _against_green(a - b)
    return max(abs(blue), abs(red), dim * abs(green))


def undone(image: Image, log_gains: Float) -> Image:
    """A picture (H, W, 3) BGR as it would be under the light of calibration."""
    return np.asarray(cv2.LUT(image, gain_tables(np.exp(-log_gains)).T[None]), np.uint8)


def different(a: Float, b: Float) -> bool:
    """Whether two lights, log gains (3,), are clearly different in hue."""
    return gain_difference(a, b, dim=0.0) > OTHER


def bounded(log_gains: Float) -> Float:
    """Clip log gains (3,): green first, then red and blue against it."""
    return _clipped(log_gains, LOG_LIMITS)


def at_bound(log_gains: Float) -> bool:
    """Whether the light has reached a bound, so that it may be beyond."""
    reached = zip(_against_green(log_gains), LOG_LIMITS, strict=True)
    return any(abs(value) >= 0.98 * limit for value, limit in reached)


def _against_green(log_gains: Float) -> tuple[float, float, float]:
    blue, green, red = log_gains.tolist()
    return blue - green, green, red - green


def _clipped(log_gains: Float, limits: Sequence[float]) -> Float:
    """Log gains (3,) within limits of green, and of blue and red against it."""
    values = zip(_against_green(log_gains), limits, strict=True)
    blue, green, red = (min(max(value, -limit), limit) for value, limit in values)
    return np.array([green + blue, green, green + red])


class ColourDrift:
    """Tracker of the light of one camera.

    `log_gains`: (3,) of the light against calibration, blue, green, red.
    """

    def __init__(self, reference: Float) -> None:
        """Begin at calibration; `reference`: (M, 3) linear light, positive or ValueError."""
        if reference.ndim != 2 or reference.shape[1] != 3 or not (reference > 0.0).all():
            raise ValueError(f"reference must be (M, 3) positive, got {reference.shape}")
        self._reference = reference
        self.log_gains = self._anchor = np.zeros(3)
        self._t_ns: int | None = None

    def restart(self, log_gains: Float) -> None:
        """Go on from a light that is known otherwise."""
        self.log_gains = self._anchor = bounded(log_gains)

    def shift(self, change: Float) -> None:
        """Add a change of the light (3,), in log gains, measured on what stands still."""
        self.log_gains, self._anchor = bounded(self.log_gains + change), bounded(self._anchor + change)

    def push(self, colour: Float, clarity: Float, t_ns: int) -> GainFit | None:
        """Learn from the markers of one frame; None where the last look is too recent.

        `colour`: (M, 3) linear light of each core, blue first, NaN: not seen; `clarity`: (M,) 0..1.
        """
        every_ns = 100_000_000  # colours are looked at so often; light has no need of more
        if self._t_ns is not None and 0 <= t_ns - self._t_ns < every_ns:
            return None
        gap_ns = 500_000_000  # a step in time is taken as no longer than this
        dt_s = 0.0 if self._t_ns is None else min(max(t_ns - self._t_ns, 0), gap_ns) * 1e-9
        self._t_ns = t_ns
        fit = fit_gains(colour, self._reference, np.nan_to_num(clarity), self._anchor)
        time_s = 1.0  # time constant of following
        step = -math.expm1(-dt_s / time_s) * (fit.log_gains - self.log_gains)
        self.log_gains = bounded(self.log_gains + _clipped(step, [RATE_PER_S * dt_s] * 3))
        anchor_s, many = 5.0, 4  # time constant of the anchor, and how many markers move it
        if np.count_nonzero(np.isfinite(fit.residual)) >= many:
            self._anchor = self._anchor - math.expm1(-dt_s / anchor_s) * (self.log_gains - self._anchor)
        return fit


WAVELENGTHS_NM = np.array([460.0, 540.0, 605.0])  # middles of blue, green and red of common sensors
STRIDE = 2  # pixels of every second row and column are plenty
# standard deviations (of three channels, whose mean is 1.6) at which a blob proves nothing any more
FITS = 3.0
PROOF = 2  # markers that must fit: one colour fits some light always
AHEAD = 0.7  # markers by which the best light must lead every light that is clearly another
OTHER = 0.2  # log gains of red or blue against green by which two lights are clearly different
LINEAR = to_linear(np.arange(256) / 255.0).astype(np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class LightEvidence:
    """What speaks for one light."""

    log_gains: Float  # (3,) of the light, blue, green, red, after the fit to its blobs
    score: float  # markers that fit, each 0..1
    matched: int  # how many of them
    proven: bool = False  # enough markers fit, and no clearly different light comes near
    excluded: bool = False  # `PROOF` markers fit a light that leaves the expected one far behind
    beyond: bool = False  # the fit would leave the bounds of red or blue against green


def initial_white_balance(
    image: Image, table: ColourTable, reference: Float, expected: Float
) -> LightEvidence:
    """The light that explains most of a picture, and whether the picture proves it.

    `reference`: (M, 3) linear light of each marker's core at calibration, blue first; `expected`: (3,) log gains of
    the light that is expected, blue, green, red; 0 at a start.
    """

    def score_of(item: LightEvidence) -> float:
        if item.beyond:
            return 0.0
        # markers that the expected light is worth by itself
        return item.score + (0.0 if different(item.log_gains, expected) else 0.3)

    half = np.ascontiguousarray(image[::STRIDE, ::STRIDE])
    tried = [evidence(half, table, reference, gains) for gains in (expected, *lights())]
    best = max(tried, key=score_of)
    for _ in range(2):  # the fit has moved it; what it finds there may be more
        again = evidence(half, table, reference, best.log_gains)
        if score_of(again) < score_of(best):
            break
        best = again
    tint = 0.25  # log gain of red against green by which lamps of rooms may lie off the line of black bodies
    if best.matched < PROOF or off_line(best.log_gains) > tint:
        return best
    other = max((score_of(e) for e in tried if different(e.log_gains, best.log_gains)), default=0.0)
    typical = max((score_of(e) for e in tried if not different(e.log_gains, expected)), default=0.0)
    # of a light that is clearly not the expected one: two colours fit some other light often
    proof_elsewhere = 3
    least = min(proof_elsewhere, len(reference)) if different(best.log_gains, expected) else PROOF
    proven = best.matched >= least and score_of(best) - other >= AHEAD
    return replace(best, proven=proven, excluded=score_of(best) - typical >= AHEAD)


def lights() -> Float:
    """Log gains (L, 3) of the lights that are tried, from the coolest to the warmest."""
    step, reach = 15e-6, 210e-6  # reciprocal kelvin: 3000 to 6500 K is 180e-6
    steps = np.arange(-reach, reach + step / 2, step)
    wien_nm_k = 1.4388e7  # second radiation constant [nm K]
    gains = -wien_nm_k * steps[:, None] / WAVELENGTHS_NM
    return gains - gains[:, 1:2]


def off_line(log_gains: Float) -> float:
    """Return the distance of red/green from the line of black bodies at blue/green."""
    blue, green, red = log_gains
    line = lights()[-1]
    return float(abs((red - green) - line[2] / line[0] * (blue - green)))


def evidence(half: Image, table: ColourTable, reference: Float, log_gains: Float) -> LightEvidence:
    """What every second pixel (h, w, 3), C-contiguous, shows of log gains (3,)."""
    codes = table.codes(undone(half, log_gains))
    colour = np.full(reference.shape, np.nan)
    for m, bit in enumerate(table.bits):
        if bit in table.bits[:m]:
            continue  # of the same paint on another hand: it proves nothing more
        if seen := _colours(half, ((codes & bit) != 0).astype(np.uint8)):
            expected = np.log(reference[m]) + log_gains
            colour[m] = min(seen, key=lambda c: float(np.ptp(np.log(c) - expected)))
    fit = fit_gains(colour, reference, np.ones(len(reference)), log_gains)
    close = np.nan_to_num(1.0 - (fit.residual / FITS) ** 2, nan=0.0)
    score = float(np.maximum(close, 0.0).sum())
    light = bounded(fit.log_gains)
    rounded = 1e-9  # log gains
    beyond = gain_difference(light, fit.log_gains, dim=0.0) > rounded
    return LightEvidence(light, score, int((close > 0.0).sum()), beyond=beyond)


def _colours(half: Image, mask: Image) -> list[Float]:
    """Return the mean linear light (3,) within the largest blobs of a mask."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8, ltype=cv2.CV_16U)
    rows = cast(list[list[int]], stats.tolist())  # left, top, width, height, area
    speck = 6  # of these pixels; smaller blobs prove nothing
    largest = 0.1  # of the image; a larger blob is no marker
    fair = [i for i in range(1, count) if speck <= rows[i][4] <= largest * mask.size]
    if not fair:
        return []
    # Outside the image counts as covered: a marker at the border keeps its inner pixels.
    inner = cv2.erode(mask, np.ones((3, 3), np.uint8))
    found: list[Float] = []
    blobs_each = 3  # of each colour, the largest
    for i in sorted(fair, key=lambda i: -rows[i][4])[:blobs_each]:
        x, y, w, h, _ = rows[i]
        box = slice(y, y + h), slice(x, x + w)
        own = labels[box] == i
        core = own & (inner[box] != 0)
        light = LINEAR[half[box][core if core.any() else own]].mean(axis=0)
        found.append(np.maximum(light, 1e-4).astype(np.float64))
    return found
