"""Initial estimate of the light of an image from all its colours at once.

Nothing else is known of the image.

Under a light much warmer or cooler than that of calibration every hue has moved, and one marker looks like another one
at calibration. What none of them can imitate is the whole set: only under the right light do all markers seen
fit all references. So lights are tried: for each, its picture is undone to the light of calibration, blobs are
found as ever, and the better their colours fit the references together, the more the light explains.

The lights tried lie on the line of black bodies. In the logarithms of red/green and blue/green it is straight: by
Wien's law a channel at wavelength l gains -c2/l (1/T' - 1/T) (Finlayson and Hordley 2001, J. Opt. Soc. Am. A 18, 253).
The fit to the blobs then leaves the line as far as they ask for it.

Where little but skin is seen, a light far warmer than any lamp explains it best: skin is the colour of a thumb there,
its shadow that of a finger. So a light beyond what is followed proves nothing, and one that nobody expects needs
more markers than the one that is expected.
"""

from dataclasses import dataclass, replace
from typing import cast

import cv2
import numpy as np

from common.arrays import Float, Image
from common.geometry.srgb import gain_tables, to_linear
from slave.markers.classify import ColourTable
from slave.markers.drift import bounded, fit_gains

WAVELENGTHS_NM = np.array([460.0, 540.0, 605.0])  # middles of blue, green and red of common sensors
STRIDE = 2  # pixels of every second row and column are plenty
FITS = (
    3.0  # standard deviations (of three channels, whose mean is 1.6) at which a blob proves nothing any more
)
PROOF = 2  # markers that must fit: one colour fits some light always
AHEAD = 0.7  # markers by which the best light must lead every light that is clearly another
OTHER = 0.2  # log gains of red or blue against green by which two lights are clearly different
LINEAR = to_linear(np.arange(256) / 255.0).astype(np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """What speaks for one light.

    Attributes:
        log_gains: (3,) of the light, blue, green, red, after the fit to its blobs.
        score: Markers that fit, each 0..1.
        matched: How many of them.
        residual: (M,) of each marker in standard deviations; NaN: none found.
        proven: At least `PROOF` markers fit, `PROOF_ELSEWHERE` where it is clearly not the expected light, and no
            clearly different light comes near.
        excluded: `PROOF` markers fit a light that leaves the expected one far behind.
        beyond: The fit would leave the bounds of red or blue against green.
    """

    log_gains: Float
    score: float
    matched: int
    residual: Float
    proven: bool = False
    excluded: bool = False
    beyond: bool = False


def initial_white_balance(image: Image, table: ColourTable, reference: Float, expected: Float) -> Evidence:
    """The light that explains most of a picture, and whether the picture proves it.

    Args:
        image: (H, W, 3) BGR.
        table: Colour table of the calibration.
        reference: (M, 3) linear light of each marker's core at calibration, blue first.
        expected: (3,) log gains of the light that is expected, blue, green, red; 0 at a start.
    """

    def score_of(item: Evidence) -> float:
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
    """Return the distance of red against green from the line of black bodies.

    Given blue against green.
    """
    blue, green, red = log_gains
    line = lights()[-1]
    return float(abs((red - green) - line[2] / line[0] * (blue - green)))


def evidence(half: Image, table: ColourTable, reference: Float, log_gains: Float) -> Evidence:
    """Return the evidence of an image for a light.

    Args:
        half: (h, w, 3) BGR, every second pixel of every second row, C-contiguous.
        table: Colour table of the calibration.
        reference: (M, 3) linear light of each marker's core at calibration, blue first.
        log_gains: (3,) of the light, blue, green, red.
    """
    undone = np.asarray(cv2.LUT(half, gain_tables(np.exp(-log_gains)).T[None]), np.uint8)
    codes = table.codes(undone)
    colour = np.full(reference.shape, np.nan)
    for m, bit in enumerate(table.bits):
        if seen := _colours(half, ((codes & bit) != 0).astype(np.uint8)):
            expected = np.log(reference[m]) + log_gains
            colour[m] = min(seen, key=lambda c: float(np.ptp(np.log(c) - expected)))
    weight = np.ones(len(reference))
    fit = fit_gains(colour, reference, weight, log_gains)
    close = np.nan_to_num(1.0 - (fit.residual / FITS) ** 2, nan=0.0)
    score = float(np.maximum(close, 0.0).sum())
    light = bounded(fit.log_gains)
    rounded = 1e-9  # log gains
    beyond = _separated_hues(light, fit.log_gains) > rounded
    return Evidence(light, score, int((close > 0.0).sum()), fit.residual, beyond=beyond)


def different(a: Float, b: Float) -> bool:
    """Whether two lights, log gains (3,), are clearly different in hue."""
    return _separated_hues(a, b) > OTHER


def _separated_hues(a: Float, b: Float) -> float:
    """Log gain of red or blue against green, whichever differs more."""
    blue, green, red = (a - b).tolist()
    return max(abs(blue - green), abs(red - green))


def _colours(half: Image, mask: Image) -> list[Float]:
    """Return the mean linear light (3,) of the largest blobs of a mask.

    Over the inner pixels of each blob; at most `BLOBS_EACH` blobs.
    """
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
