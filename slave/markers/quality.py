"""Probability that a detection is a marker, from its appearance.

A field, a window frame or a face holds pixels of every colour. But a marker is of one colour against its
surroundings, near the middle of its range, and compact. A logistic regression weighs that:

    P(marker) = 1 / (1 + exp(-(w0 + w . evidence)))

`python -m bench real_markers --fit` fits its weights to markers (rendered hands, a real ball, markers drawn into
photographs) and to what is found in photographs without markers, half and half: where things in the colours of the
markers are more frequent than markers, less of what is found is right than it reports.
"""

import math
from colorsys import rgb_to_hsv
from operator import mul
from typing import NamedTuple

from common.calibration import HsvRange
from slave.markers.centroid import Measured
from slave.markers.classify import HUES, hue_span

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
    middle, half_difference = 0.5 * (seen.xx + seen.yy), math.hypot(0.5 * (seen.xx - seen.yy), seen.xy)
    longest, shortest = middle + half_difference, max(middle - half_difference, 0.02)
    middle_hue, half = hue_span(colour)
    away = abs((hue - middle_hue + HUES / 2) % HUES - HUES / 2) / (half + 0.5)
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
    small = 40.0  # px^2 below which a colour is hardly that of the marker alone
    clarity = math.sqrt(min(seen.area / whole, 1.0)) * min(seen.contrast / CLEAR_CONTRAST, 1.0)
    clarity *= (
        math.sqrt(min(seen.area / small, 1.0)) * (0.5 if seen.cut else 1.0) * (0.4 if seen.thin else 1.0)
    )
    return min(max(clarity, 0.01), 1.0)


def _hue(blue: float, green: float, red: float) -> float:
    """OpenCV's H (0..180) of a colour in linear light."""
    return HUES * rgb_to_hsv(_srgb(red), _srgb(green), _srgb(blue))[0]


def _srgb(linear: float) -> float:
    """As `common.geometry.srgb.to_srgb`, of one number."""
    linear = min(max(linear, 0.0), 1.0)
    return 12.92 * linear if linear <= 0.0031308 else 1.055 * linear ** (1 / 2.4) - 0.055
