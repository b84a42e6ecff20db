"""Probability that a detection is a marker, from its appearance.

A field, a window frame or a face holds pixels of every colour. But a marker is of one colour against its
surroundings, near the middle of its range, and compact. A logistic regression weighs that:

    P(marker) = 1 / (1 + exp(-(w0 + w . evidence)))

`python -m bench real_markers --fit` fits its weights to markers (rendered hands, a real ball, markers drawn into
photographs) and to what is found in photographs without markers, half and half: where things in the colours of the
markers are more frequent than markers, less of what is found is right than it reports.
"""

import math
from operator import mul
from typing import NamedTuple

from common.calibration import HsvRange
from slave.markers.centroid import Measured
from slave.markers.classify import HUES

CLEAR_CONTRAST = 6.0  # below it, the colour's mask may be a part of the marker, and its outline is sought


class Evidence(NamedTuple):
    """What speaks for a marker; every entry is free of the camera's resolution."""

    contrast: float  # logarithm of the contrast between marker and surroundings, limited
    unclear: float  # 1: the contrast is below `CLEAR_CONTRAST`
    outlined: float  # then the share of directions in which a round outline was found, else 0
    fullness: float  # area over that of the ellipse of the same moments: less than 1 has gaps or arms
    slender: float  # logarithm of the ratio of the axes of that ellipse
    hue: float  # distance of the hue from the middle of the range in half ranges, squared
    alternative: float  # 1: a second blob of the colour may be the marker
    ragged: float  # 1: hardly a pixel has four neighbours of the colour
    cut: float  # 1: it touches the border of the image


WEIGHTS = Evidence(
    contrast=0.92,
    unclear=-1.15,
    outlined=7.29,
    fullness=8.73,
    slender=-3.23,
    hue=-9.37,
    alternative=-2.44,
    ragged=-2.17,
    cut=-3.00,
)


def evidence_of(
    seen: Measured, gains: tuple[float, float, float], colour: HsvRange, support: float, alternative: bool
) -> Evidence:
    """What speaks for one measurement by the colour's mask.

    `gains`: of the light against calibration, blue, green, red; `support`: of its outline, 0: none was found or
    sought.
    """
    hue = _hue(*(c / gain for c, gain in zip(seen.colour, gains, strict=True)))
    middle, apart = 0.5 * (seen.xx + seen.yy), math.hypot(0.5 * (seen.xx - seen.yy), seen.xy)
    longest, shortest = middle + apart, max(middle - apart, 0.02)
    low, high = colour.hsv_low, colour.hsv_high
    half = 0.5 * ((high[0] - low[0]) % HUES) + 0.5
    away = abs((hue - low[0] - half + 0.5 + HUES / 2) % HUES - HUES / 2) / half
    largest_contrast = 20.0  # no marker is the more certain beyond it
    return Evidence(
        contrast=math.log(min(max(seen.contrast, 1.0), largest_contrast)),
        unclear=float(seen.contrast < CLEAR_CONTRAST),
        outlined=support,
        fullness=min(seen.area / (4.0 * math.pi * math.sqrt(longest * shortest)), 1.0),
        slender=0.5 * math.log(longest / shortest),
        hue=min(away * away, 1.0),
        alternative=float(alternative),
        ragged=float(seen.thin),
        cut=float(seen.cut),
    )


def probability_of(evidence: Evidence) -> float:
    """Probability 0..1 that it is a marker."""
    bias = -4.90
    logit = sum(map(mul, WEIGHTS, evidence), bias)
    return 1.0 / (1.0 + math.exp(-min(max(logit, -30.0), 30.0)))


def clarity_of(seen: Measured, whole: float) -> float:
    """How purely (0.01..1) the core shows the marker; `whole`: its area [px^2]."""
    area, contrast = seen.area, seen.contrast
    clarity = math.sqrt(area / whole) if area < whole else 1.0
    if contrast < CLEAR_CONTRAST:
        clarity *= contrast / CLEAR_CONTRAST
    small = 40.0  # px^2 below which a colour is hardly that of the marker alone
    if area < small:
        clarity *= math.sqrt(area / small)
    if seen.cut:
        clarity *= 0.5
    if seen.thin:
        clarity *= 0.4
    return min(max(clarity, 0.01), 1.0)


def _hue(blue: float, green: float, red: float) -> float:
    """OpenCV's H (0..180) of a colour in linear light."""
    blue, green, red = _srgb(blue), _srgb(green), _srgb(red)
    value = max(blue, green, red)
    span = value - min(blue, green, red)
    if span <= 0.0:
        return 0.0
    if value == red:
        sector = (green - blue) / span
    elif value == green:
        sector = 2.0 + (blue - red) / span
    else:
        sector = 4.0 + (red - green) / span
    return 30.0 * sector % HUES


def _srgb(linear: float) -> float:
    """As `common.geometry.srgb.to_srgb`, of one number."""
    linear = min(max(linear, 0.0), 1.0)
    return 12.92 * linear if linear <= 0.0031308 else 1.055 * linear ** (1 / 2.4) - 0.055
