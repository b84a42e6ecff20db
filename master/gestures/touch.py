"""Position of the thumb relative to the fingers, skin to skin.

It includes which sides face each other; pinches and taps are defined by it.
"""

from collections.abc import Callable
from math import acos, hypot, sqrt
from typing import NamedTuple, cast

import numpy as np

from common.arrays import Float
from common.hand.capsule_gaps import ROUNDS, foot_of, nearest
from common.hand.model import CHAINS
from common.kernels import constant, inner, kernel
from master.estimator.matrices import spread
from master.fabrik.rotations import Vector, cross, dot, length, minus
from master.gestures.features import PAD_SHARE, HandFeatures

_THUMB, _SIDE = constant(0), constant(2)
_Foot = tuple[float, float, float, float, float, float]
_foot_of = cast(Callable[[float, float, float, float, float, float, float], _Foot], inner(foot_of))
_nearest = cast(Callable[[_Foot, float], float], inner(nearest))


class ThumbTouch(NamedTuple):
    """The thumb's last segment against index ... little.

    Attributes:
        gap_m: (4,) to the last segment of each finger, skin to skin [m], negative: pressed.
        middle_m: (4, 3) half way between them [m], rig frame.
        apart_rad: (4,) by how much the pads of both are turned from facing each other, the worse of the two.
        apart_sigma_rad: (4,) how sure that is.
        key_gap_m: (4, 3) from the thumb's last segment to each segment of each finger, from the knuckle on [m].
        key_palmar: (4, 3) cosine between the way to the thumb there and the palmar side of the segment.
        key_sigma_m: (4, 3) standard deviation [m] of those gaps: of both places along the way between them.
    """

    gap_m: Float
    middle_m: Float
    apart_rad: Float
    apart_sigma_rad: Float
    key_gap_m: Float
    key_palmar: Float
    key_sigma_m: Float

    @property
    def sigma_m(self) -> Float:
        """Standard deviation (4,) [m] of `gap_m`."""
        return self.key_sigma_m[:, 2]


def thumb_touch(features: HandFeatures, radius_m: Float) -> ThumbTouch:
    """The gaps of a hand whose joints have the radii (26,) [m]."""
    out = ThumbTouch(
        gap_m=np.empty(4),
        middle_m=np.empty((4, 3)),
        apart_rad=np.empty(4),
        apart_sigma_rad=np.empty(4),
        key_gap_m=np.empty((4, 3)),
        key_palmar=np.empty((4, 3)),
        key_sigma_m=np.empty((4, 3)),
    )
    _write(features.joints_m, features.joints_cov_m2, features.pads_m, radius_m, out)
    return out


@kernel
def _write(joints: Float, cov: Float, pads: Float, radius: Float, out: ThumbTouch) -> None:
    """Write a touch; arguments as of `HandFeatures`."""
    thumb, tip = CHAINS[0, 2], CHAINS[0, 3]
    thumb_side = _palmar(_THUMB, _SIDE, joints, pads)
    thumb_sigma_rad = _direction_sigma_rad(_THUMB, joints, cov)
    for k in range(4):
        for s in range(3):
            a, b = CHAINS[k + 1, s], CHAINS[k + 1, s + 1]
            on_a, on_b = _shares(joints, radius, thumb, tip, a, b)
            start, end = _on(joints, thumb, tip, on_a), _on(joints, a, b, on_b)
            off = minus(end, start)
            apart_m = length(off)
            over = max(apart_m, 1e-9)
            way = off[0] / over, off[1] / over, off[2] / over
            radius_a = radius[thumb] + on_a * (radius[tip] - radius[thumb])
            out.key_gap_m[k, s] = apart_m - radius_a - (radius[a] + on_b * (radius[b] - radius[a]))
            side = _palmar(k + 1, s, joints, pads)
            out.key_palmar[k, s] = -dot(way, side)
            out.key_sigma_m[k, s] = _sigma_m(cov, thumb, tip, on_a, a, b, on_b, way)
            if s == 2:
                out.gap_m[k] = out.key_gap_m[k, s]
                for i in range(3):
                    out.middle_m[k, i] = start[i] + (radius_a + 0.5 * out.gap_m[k]) * way[i]
                face = min(dot(way, thumb_side), -dot(way, side))
                out.apart_rad[k] = acos(min(max(face, -1.0), 1.0))
        out.apart_sigma_rad[k] = hypot(thumb_sigma_rad, _direction_sigma_rad(k + 1, joints, cov))


@inner
def _at(points: Float, j: int) -> Vector:
    return points[j, 0], points[j, 1], points[j, 2]


@inner
def _on(joints: Float, a: int, b: int, share: float) -> Vector:
    """Return the point [m] at a share of the way from one joint to another."""
    start, way = _at(joints, a), minus(_at(joints, b), _at(joints, a))
    return start[0] + share * way[0], start[1] + share * way[1], start[2] + share * way[2]


@inner
def _shares(joints: Float, radius: Float, a: int, a_end: int, b: int, b_end: int) -> tuple[float, float]:
    """Return where along two segments their skins are nearest.

    As `common.hand.capsule_gaps`.
    """
    u, v = minus(_at(joints, a_end), _at(joints, a)), minus(_at(joints, b_end), _at(joints, b))
    apart = minus(_at(joints, b), _at(joints, a))
    uu, vv, uv, au, bv, square = (
        dot(u, u),
        dot(v, v),
        dot(u, v),
        dot(apart, u),
        dot(apart, v),
        dot(apart, apart),
    )
    on_a = _foot_of(au / uu, uv / uu, square / uu, 2.0 * bv / uu, vv / uu, radius[a_end] - radius[a], uu)
    on_b = _foot_of(-bv / vv, uv / vv, square / vv, -2.0 * au / vv, uu / vv, radius[b_end] - radius[b], vv)
    s, t = 0.5, 0.5
    for _ in range(ROUNDS):
        before = t
        s = _nearest(on_a, t)
        t = _nearest(on_b, s)
        if t == before:
            break
    return s, t


@kernel
def _direction_sigma_rad(f: int, joints: Float, cov: Float) -> float:
    """Return the standard deviation [rad] of the direction of a last bone.

    That of its ends, over its length.
    """
    a, b, ends = CHAINS[f, 2], CHAINS[f, 3], np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            ends[i, j] = cov[a, i, j] + cov[b, i, j]
    return spread(ends)[1] / length(minus(_at(joints, b), _at(joints, a)))


@inner
def _sigma_m(
    cov: Float, thumb: int, tip: int, on_a: float, a: int, b: int, on_b: float, way: Vector
) -> float:
    """Return the standard deviation [m] of a gap.

    Of both skins along the way from one to the other, each as its bone has it there, between what its two joints have.
    What both err alike by, the palm's uncertainty, counts twice: it is small beside the rest where tips are seen.
    """
    total = 0.0
    for i in range(3):
        for j in range(3):
            both = (1.0 - on_a) * cov[thumb, i, j] + on_a * cov[tip, i, j]
            both += (1.0 - on_b) * cov[a, i, j] + on_b * cov[b, i, j]
            total += way[i] * both * way[j]
    return sqrt(max(total, 0.0))


@inner
def _palmar(f: int, s: int, joints: Float, pads: Float) -> Vector:
    """Return the unit vector out of the palmar side of a segment, rig frame.

    It is across the segment, in the plane of its bend.

    The pad gives it for the last one; the others are turned back by the bends between.
    """
    last = minus(_at(joints, CHAINS[f, 3]), _at(joints, CHAINS[f, 2]))
    out = minus(_at(pads, f), _on(joints, CHAINS[f, 2], CHAINS[f, 3], PAD_SHARE))
    if s < 2:
        # The hinge goes across the finger, the same for all its segments but for twist.
        out = cross(cross(last, out), minus(_at(joints, CHAINS[f, s + 1]), _at(joints, CHAINS[f, s])))
    n = length(out)
    return out[0] / n, out[1] / n, out[2] / n
