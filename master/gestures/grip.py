"""Find a grip about a knob: the circle of the tips, and how they turned.

The thumb's tip and those of the fingers lie about one circle, in one plane, pads inwards, the thumb across from the
fingers. Stateless.
"""

from math import acos, atan2, cos, hypot, inf, isfinite, nan, sqrt
from typing import NamedTuple

import numpy as np

from common.arrays import Bool, Float
from common.calibration.gesture_settings import DialSettings
from common.geometry.transforms import quaternion_to_matrix
from common.kernels import constant, inner, kernel
from master.fabrik.linear_algebra import diagonalise, dot
from master.gestures.features import HandFeatures

_EYE = np.eye(3)
_ALL, _FINGERS = constant(0), constant(1)  # the first of all tips, and of those of the fingers


class Tips(NamedTuple):
    """Tips of thumb ... little: the caps' middles in a frame still in the room.

    Attributes:
        place_m, sigma_m: (5, 3), (5,) [m].
        known: (5,) whether a tip is known at all.
        palmar: (3,) unit vector out of the palm.
        T_still_rig: (3, 3) from the rig frame to that frame.
    """

    place_m: Float
    sigma_m: Float
    known: Bool
    palmar: Float
    T_still_rig: Float

    @classmethod
    def of(cls, seen: HandFeatures, sigma_most_m: float, *, wrist_device_only: bool) -> "Tips":
        """Those of a hand; `wrist_device_only`: the rig frame goes with the arm."""
        rotation = _EYE
        if wrist_device_only and not np.isnan(seen.palm_world_wxyz).any():
            rotation = quaternion_to_matrix(seen.palm_world_wxyz) @ seen.T_rig_palm[:3, :3].T
        place = seen.caps_m if rotation is _EYE else seen.caps_m @ rotation.T
        return cls(place, seen.sigma_m, seen.sigma_m <= sigma_most_m, rotation @ seen.palmar, rotation)

    def axis(self) -> Float | None:
        """Axis (3,) of the known tips' circle, out of the palm; None: fewer than three."""
        if self.known.sum() < 3:
            return None
        centre, axis = np.empty(3), np.empty(3)
        _circle(self, centre, axis)
        return axis


def may_grip(seen: HandFeatures, across_m: float, settings: DialSettings) -> bool:
    """Whether a hand may be about a knob, by all but the places of its tips.

    `across_m`: between the skins of the thumb and the finger next to it [m].
    """
    thumb, *fingers = [one <= settings.sigma_most_m for one in seen.sigma_m.tolist()]
    if not thumb or sum(fingers) < settings.fingers_least or across_m < settings.across_m:
        return False
    return sum(seen.curl.tolist()[1:]) / 4.0 >= settings.curl_least


def is_grip(seen: HandFeatures, tips: Tips, settings: DialSettings) -> bool:
    """Whether the tips of a hand that may grip lie about a knob."""
    return _about(
        tips,
        (seen.pads_m - seen.tips_m) @ tips.T_still_rig.T,
        cos(settings.aslant_rad),
        settings.round_m,
        settings.opposed_rad,
        settings.fingers_least,
        settings.radius_low_m,
        settings.radius_high_m,
    )


@kernel
def _about(
    tips: Tips,
    pads: Float,
    aslant: float,
    round_m: float,
    opposed: float,
    least: int,
    low: float,
    high: float,
) -> bool:
    """Whether tips are about a knob; pads (5, 3) are from the tip's middle."""
    place, known, palmar = tips.place_m, tips.known, tips.palmar
    centre, axis = np.empty(3), np.empty(3)
    radius = _circle(tips, centre, axis)
    if axis[0] * palmar[0] + axis[1] * palmar[1] + axis[2] * palmar[2] < aslant or not low <= radius <= high:
        return False
    good, a = 0, (axis[0], axis[1], axis[2])
    thumb = 0.0, 0.0, 0.0
    for f in range(5):
        if not known[f]:
            continue
        off = place[f, 0] - centre[0], place[f, 1] - centre[1], place[f, 2] - centre[2]
        along = dot(off, a)
        flat = off[0] - along * a[0], off[1] - along * a[1], off[2] - along * a[2]
        distance = sqrt(dot(flat, flat))
        over = max(distance, 1e-6)
        out = flat[0] / over, flat[1] / over, flat[2] / over
        fits = hypot(distance - radius, along) <= round_m
        if f == 0:
            if not fits:
                return False
            thumb = out
            continue
        pad = pads[f, 0], pads[f, 1], pads[f, 2]
        angle_rad = acos(min(max(dot(out, thumb), -1.0), 1.0))
        # cosine between the pad's side and the way to the middle, at least
        inwards = -dot(out, pad) / sqrt(dot(pad, pad)) >= (-0.3)
        good += 1 if fits and inwards and angle_rad >= opposed else 0
    return good >= least


@kernel
def _circle(tips: Tips, centre: Float, axis: Float) -> float:
    """Radius of the circle of the known tips; write its centre, its palmar axis.

    The circle of least algebraic error (Kasa, 1976) in the plane of least squares. Along the principal axes
    of the places about their mean, its normal equations fall apart.
    """
    place, known, palmar = tips.place_m, tips.known, tips.palmar
    count = 0
    for i in range(3):
        centre[i], count = 0.0, 0
        for f in range(5):
            if known[f]:
                centre[i] += place[f, i]
                count += 1
        centre[i] /= count
    scatter, ways = np.zeros((3, 3)), np.empty((3, 3))
    for f in range(5):
        for i in range(3):
            for k in range(3):
                scatter[i, k] += (place[f, i] - centre[i]) * (place[f, k] - centre[k]) if known[f] else 0.0
    diagonalise(scatter, ways)
    least = 0
    for k in range(1, 3):
        least = k if scatter[k, k] < scatter[least, least] else least
    side = ways[0, least] * palmar[0] + ways[1, least] * palmar[1] + ways[2, least] * palmar[2]
    squares, shift = 0.0, np.zeros(3)
    for f in range(5):
        if not known[f]:
            continue
        square = 0.0
        for k in range(3):
            if k != least:
                on = _along(place, f, centre, ways, k)
                square += on * on
        squares += square / count
        for k in range(3):
            shift[k] += 0.5 * square * _along(place, f, centre, ways, k)
    for k in range(3):
        flat_m2 = 1e-20  # places that lie in one line, or in one point, by their scatter
        shift[k] = shift[k] / scatter[k, k] if k != least and scatter[k, k] > flat_m2 else 0.0
        squares += shift[k] * shift[k]
    for i in range(3):
        axis[i] = ways[i, least] if side > 0.0 else -ways[i, least]
        for k in range(3):
            centre[i] += shift[k] * ways[i, k]
    return sqrt(squares)


@inner
def _along(place: Float, f: int, centre: Float, ways: Float, k: int) -> float:
    """How far a place is from the centre along way k."""
    total = 0.0
    for i in range(3):
        total += (place[f, i] - centre[i]) * ways[i, k]
    return total


@kernel
def rotation_between(now: Tips, then: Tips) -> Float:
    """Rotation vector (3,) [rad] of all tips since `then` (Horn, 1987)."""
    place, before = now.place_m, then.place_m
    weight, total = np.empty(5), 0.0
    middle, middle_before = np.zeros(3), np.zeros(3)
    for f in range(5):
        sigma_m = hypot(now.sigma_m[f], then.sigma_m[f])
        sigma_m = max(sigma_m, 1e-3) if isfinite(sigma_m) else 0.1
        weight[f] = 1.0 / (sigma_m * sigma_m)
        total += weight[f]
        for i in range(3):
            middle[i] += weight[f] * place[f, i]
            middle_before[i] += weight[f] * before[f, i]
    S = np.zeros((3, 3))
    for f in range(5):
        for i in range(3):
            off = (before[f, i] - middle_before[i] / total) * weight[f]
            for k in range(3):
                S[i, k] += off * (place[f, k] - middle[k] / total)
    form, q = np.zeros((4, 4)), np.empty((4, 4))
    form[0, 0] = S[0, 0] + S[1, 1] + S[2, 2]
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        form[i + 1, 0] = S[j, k] - S[k, j]
        form[i + 1, i + 1] = S[i, i] - S[j, j] - S[k, k]
        form[max(j, k) + 1, min(j, k) + 1] = S[j, k] + S[k, j]
    diagonalise(form, q)
    best = 0
    for k in range(1, 4):
        best = k if form[k, k] > form[best, best] else best
    x, y, z, w = q[1, best], q[2, best], q[3, best], q[0, best]
    sine = sqrt(x * x + y * y + z * z)
    scale = 2.0 * atan2(sine, abs(w)) / sine if sine > 1e-9 else 2.0
    scale = -scale if w < 0.0 else scale
    out = np.empty(3)
    out[0], out[1], out[2] = scale * x, scale * y, scale * z
    return out


@kernel
def axis_of(prior: Float, weight: float, rotation: Float) -> Float:
    """Axis (3,) of most weight of a unit vector and a turn (3,), summed as tensors."""
    both, ways = np.empty((3, 3)), np.empty((3, 3))
    for i in range(3):
        for k in range(3):
            both[i, k] = weight * prior[i] * prior[k] + rotation[i] * rotation[k]
    diagonalise(both, ways)
    best = 0
    for k in range(1, 3):
        best = k if both[k, k] > both[best, best] else best
    side = ways[0, best] * prior[0] + ways[1, best] * prior[1] + ways[2, best] * prior[2]
    out = np.empty(3)
    for i in range(3):
        out[i] = ways[i, best] if side > 0.0 else -ways[i, best]
    return out


@inner
def _middles(tips: Tips, then: Tips, first: int, middle: Float, before: Float) -> int:
    """Write the sums (3,) of places known now and then; return their number."""
    count = 0
    for f in range(first, 5):
        if tips.known[f] and then.known[f]:
            count += 1
            for i in range(3):
                middle[i] += tips.place_m[f, i]
                before[i] += then.place_m[f, i]
    return count


@kernel
def widened_m(tips: Tips, then: Tips) -> float:
    """By how much the grip is wider than `then` [m]; NaN: thumb or fingers not known.

    Half of what the thumb's tip has gone from those of the fingers.
    """
    middle, before = np.zeros(3), np.zeros(3)
    count = _middles(tips, then, _FINGERS, middle, before)
    if count < 2 or not (tips.known[0] and then.known[0]):
        return nan
    wide, wide_before = 0.0, 0.0
    for i in range(3):
        wide += (tips.place_m[0, i] - middle[i] / count) ** 2
        wide_before += (then.place_m[0, i] - before[i] / count) ** 2
    return 0.5 * (sqrt(wide) - sqrt(wide_before))


@kernel
def spread_m(tips: Tips, then: Tips) -> float:
    """Greatest change [m] since `then` of a known tip's distance from their middle.

    inf: fewer than three are known.
    """
    middle, before = np.zeros(3), np.zeros(3)
    count = _middles(tips, then, _ALL, middle, before)
    if count < 3:
        return inf
    most = 0.0
    for f in range(5):
        if tips.known[f] and then.known[f]:
            distance, distance_before = 0.0, 0.0
            for i in range(3):
                distance += (tips.place_m[f, i] - middle[i] / count) ** 2
                distance_before += (then.place_m[f, i] - before[i] / count) ** 2
            most = max(most, abs(sqrt(distance) - sqrt(distance_before)))
    return most


def rehearse(seen: HandFeatures) -> None:
    """Call the kernels once, so that none is compiled while a hand is about a knob."""
    tips = Tips.of(seen, inf, wrist_device_only=False)
    is_grip(seen, tips, DialSettings())
    axis_of(tips.palmar, 1.0, rotation_between(tips, tips))
    spread_m(tips, tips)
    widened_m(tips, tips)
    tips.axis()
