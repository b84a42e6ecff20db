"""Is the hand about a knob? The circle through its tips, and how they are turned against how they were.

The thumb's tip and those of the fingers lie about one circle, in one plane, pads inwards, the thumb across from the
fingers. Nothing here remembers anything.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float
from common.geometry import fit_rigid, matrix_to_rotation_vector
from common.gesture_actions import DialSettings

_INWARDS = -0.3  # cosine between the pad's side and the way to the middle, at least


@dataclass(frozen=True, slots=True, eq=False)
class Tips:
    """Tips of thumb ... little in a frame that stands still in the room: the caps' middles.

    Attributes:
        place_m: (5, 3) [m].
        sigma_m: (5,) [m], how sure each is.
        inwards: (5, 3) unit vectors out of the pads.
        palmar: (3,) unit vector out of the palm.
        across_m: Between the skins of the thumb and the finger next to it [m].
        curl: Of the four fingers together, 0..1.
        known: (5,) whether a tip is known at all.
    """

    place_m: Float
    sigma_m: Float
    inwards: Float
    palmar: Float
    across_m: float
    curl: float
    known: Bool


@dataclass(frozen=True, slots=True, eq=False)
class Circle:
    """The circle of a grip: its middle (3,) [m], axis (3,) from the back of the hand through the palm, radius [m]."""

    centre_m: Float
    axis: Float
    radius_m: float


def grip_of(tips: Tips, settings: DialSettings) -> Circle | None:
    """The circle of the tips that are known, if the hand is about a knob; None: it is not, or nothing tells."""
    fingers = np.flatnonzero(tips.known[1:]) + 1
    if not tips.known[0] or len(fingers) < settings.fingers_least or tips.curl < settings.curl_least:
        return None
    chosen = np.concatenate([[0], fingers])
    circle = circle_through(tips.place_m[chosen], tips.palmar)
    if float(circle.axis @ tips.palmar) < np.cos(settings.aslant_rad) or tips.across_m < settings.across_m:
        return None
    off = tips.place_m[chosen] - circle.centre_m
    along = off @ circle.axis
    flat = off - along[:, None] * circle.axis
    away = np.linalg.norm(flat, axis=1)
    out = flat / np.maximum(away, 1e-6)[:, None]
    apart = np.arccos(np.clip(out[1:] @ out[0], -1.0, 1.0))
    fits = np.hypot(away - circle.radius_m, along) <= settings.round_m
    good = fits[1:] & (apart >= settings.opposed_rad)
    good &= -np.vecdot(out[1:], tips.inwards[fingers]) >= _INWARDS
    if not fits[0] or good.sum() < settings.fingers_least:
        return None
    return circle if settings.radius_low_m <= circle.radius_m <= settings.radius_high_m else None


def circle_through(points_m: Float, palmar: Float) -> Circle:
    """The circle of least algebraic error (Kasa, 1976) in the plane of least squares through points (N, 3), N >= 3,
    palm frame."""
    middle = points_m.mean(axis=0)
    _, _, ways = np.linalg.svd(points_m - middle)
    axis: Float = ways[2] if float(ways[2] @ palmar) > 0.0 else -ways[2]
    flat = (points_m - middle) @ ways[:2].T
    rows = np.column_stack([2.0 * flat, np.ones(len(flat))])
    found: Float = np.asarray(
        np.linalg.lstsq(rows, np.square(flat).sum(axis=1), rcond=None)[0], dtype=np.float64
    )
    radius = float(np.sqrt(max(found[2] + found[:2] @ found[:2], 0.0)))
    return Circle(middle + found[:2] @ ways[:2], axis, radius)


def turned_by(now: Tips, then: Tips) -> Float:
    """Rotation vector (3,) [rad] by which the tips have turned as one since `then`; surer ones count more."""
    sigma = np.hypot(now.sigma_m, then.sigma_m)
    weight = 1.0 / np.square(np.where(np.isfinite(sigma), np.maximum(sigma, 1e-3), 0.1))
    return matrix_to_rotation_vector(fit_rigid(now.place_m, then.place_m, weight)[:3, :3])


def widened_m(tips: Tips, then: Tips) -> float:
    """By how much the grip is wider than `then` [m]: half of what the thumb's tip has gone from those of the fingers.

    NaN: the thumb or the fingers are not known.
    """
    fingers = (tips.known & then.known)[1:]
    if not (tips.known[0] and then.known[0]) or fingers.sum() < 2:
        return float("nan")
    ways = [one.place_m[0] - one.place_m[1:][fingers].mean(axis=0) for one in (tips, then)]
    return 0.5 * float(np.linalg.norm(ways[0]) - np.linalg.norm(ways[1]))


def spread_m(tips: Tips, then: Tips) -> Float:
    """By how much each tip (5,) is farther from the middle of the known ones than `then` [m]; NaN: it is not known."""
    known = tips.known & then.known
    if known.sum() < 3:
        return np.full(5, np.nan)
    off = np.array([one.place_m - one.place_m[known].mean(axis=0) for one in (tips, then)])
    away = np.sqrt(np.vecdot(off, off))
    return np.where(known, away[0] - away[1], np.nan)
