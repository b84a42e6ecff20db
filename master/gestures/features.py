"""Features of a hand: bends, tips, pads, and where the thumb touches.

All of it, and how well it is known, is geometry of the solved joints, not of the profile's angles: those are zero in
the rest pose of a profile, and rest poses differ from hand to hand. A bend is the signed angle between two bones
about the hinge between them, that of the MCP between the palm's plane and the first bone; positive is towards the
palm, for both hands alike.

A painted cap's centroid is measured to a fraction of a millimetre, however the palm lies. The tip's joint is inferred
from it by way of the hand, and is some millimetres off where the palm is known from the tips alone. So caps are
features of their own. Pinches and taps are defined by `ThumbTouch`, skin to skin.
"""

from collections.abc import Callable
from math import acos, atan2, hypot, inf, isfinite, isnan, sqrt
from typing import Any, NamedTuple, cast

import numpy as np

from common.arrays import Bool, Float, Int
from common.hand.model import CHAINS, FINGERS, TIPS, WRIST, HandModel
from common.hand.skin import ROUNDS, foot_of, nearest
from common.kernels import constant, inner, kernel
from common.messages import HandPose
from master.fabrik.linear_algebra import Vector, cross, dot, length, minus, spread

KNOWN_SIGMA_M = 0.015  # a tip that may be farther off is anywhere between straight and half bent
PAD_SHARE = 0.75  # of the last bone, from the joint: where the ball of the pad is thickest
# Sum of a finger's bends [rad], MCP, PIP and DIP, where it is as curled as it goes; of the thumb MCP and IP.
_CURLED_RAD = np.radians([90.0, 230.0, 230.0, 230.0, 230.0])
# Of fingers that nothing is known of [rad]: a thumb at rest, fingers half bent.
_LIKELY_RAD = np.radians([[8.0, 15.0, 15.0, 15.0], *([[0.0, 55.0, 75.0, 50.0]] * 4)])


class HandFeatures(NamedTuple):
    """Features of one hand at one epoch; fingers are thumb ... little.

    Attributes:
        hand: Name of the hand profile.
        t_ns: The epoch [ns], that of the pose.
        known: (5,) the finger's tip is known to `KNOWN_SIGMA_M` or better.
        seen: (5,) a sensor observes the finger now: its tip, or a wrist device its laser line, and not ambiguously.
        sigma_m: (5,) standard deviation [m] of the tip along the axis where it is worst; inf: nothing is known.
        shape_sigma_m: (5,) the same without what the wrist's place has of it, which moves the whole hand.
        bend_rad: (5, 3) bends of MCP, PIP and DIP, zero where the bones lie in the palm's plane in one line;
            of the thumb the first is how far its metacarpal stands out of the palm's plane, then MCP and IP.
        curl: (5,) 0 straight ... 1 curled.
        caps_m: (5, 3) centroids of the tips' painted caps [m], rig frame: measured where seen, else where the
            hand has them; of a finger without a cap its tip.
        tips_m: (5, 3) middle of the tip's round end [m], rig frame.
        pads_m: (5, 3) middle of the pad's skin [m], rig frame.
        radius_m: (5,) of the round end [m].
        joints_m: (26, 3) [m], rig frame.
        joints_cov_m2: (26, 3, 3) [m^2], rig frame; where nothing is known, a metre each way.
        T_rig_palm: (4, 4) palm -> rig frame.
        side_sign: +1 right, -1 left.
        palm_world_wxyz: (4,) as in the pose.
    """

    hand: str
    t_ns: int
    known: Bool
    seen: Bool
    sigma_m: Float
    shape_sigma_m: Float
    bend_rad: Float
    curl: Float
    caps_m: Float
    tips_m: Float
    pads_m: Float
    radius_m: Float
    joints_m: Float
    joints_cov_m2: Float
    T_rig_palm: Float
    side_sign: float
    palm_world_wxyz: Float

    @property
    def palmar(self) -> Float:
        """Unit vector (3,) out of the palm, rig frame."""
        return -self.T_rig_palm[:3, 1]


class _Hand(NamedTuple):
    """A profile for the kernel.

    Attributes:
        wrist_m, wrist_rotation: (3,) [m], (3, 3) the wrist joint at rest, palm frame.
        likely_m, likely_rotation: (26, 3) [m], (26, 3, 3) a hand of which nothing is known, palm frame.
        cap_joint, cap_offset_m: (5,), (5, 3) joint that carries the finger's cap, and where, in its frame [m].
    """

    wrist_m: Float
    wrist_rotation: Float
    likely_m: Float
    likely_rotation: Float
    cap_joint: Int
    cap_offset_m: Float


class FeatureExtractor:
    """From poses of one hand to its features."""

    def __init__(self, model: HandModel) -> None:
        likely = model.forward(np.eye(4), _LIKELY_RAD)
        joint, offset = TIPS.copy(), np.zeros((5, 3))
        for finger, name in enumerate(FINGERS):
            mount = model.mounts.get(name)
            if mount is not None and mount.joint is not None:
                joint[finger], offset[finger] = mount.joint, mount.offset_m
        self._side_sign = model.side_sign
        self._hand = _Hand(
            wrist_m=model.rest_position_m[WRIST].copy(),
            wrist_rotation=model.rest_rotation[WRIST].copy(),
            likely_m=likely.position_m,
            likely_rotation=likely.rotation,
            cap_joint=joint,
            cap_offset_m=offset,
        )

    def of(self, pose: HandPose) -> HandFeatures | None:
        """Features of a pose; None where it has no hand.

        A finger of which the pose has nothing is not known, its variance is infinite, and it stands where
        fingers that hide are likely to be.
        """
        if not pose.valid[WRIST]:
            return None
        wrist: list[float] = pose.position_m[WRIST].tolist() + pose.orientation_wxyz[WRIST].tolist()
        if not isfinite(sum(wrist)):
            return None
        out = HandFeatures(
            hand=pose.hand,
            t_ns=pose.t_ns,
            known=np.empty(5, np.bool_),
            seen=pose.tracked[TIPS] | ((pose.solver_mode > 0) & ~pose.ambiguous),
            sigma_m=np.empty(5),
            shape_sigma_m=np.empty(5),
            bend_rad=np.empty((5, 3)),
            curl=np.empty(5),
            caps_m=np.empty((5, 3)),
            tips_m=np.empty((5, 3)),
            pads_m=np.empty((5, 3)),
            radius_m=np.empty(5),
            joints_m=np.empty((26, 3)),
            joints_cov_m2=np.empty((26, 3, 3)),
            T_rig_palm=np.empty((4, 4)),
            side_sign=self._side_sign,
            palm_world_wxyz=pose.palm_world_wxyz,
        )
        _measure(
            _plain(pose.position_m),
            _plain(pose.orientation_wxyz),
            _plain(pose.radius_m),
            _plain(pose.cov_m2),
            _plain(pose.valid),
            _plain(pose.markers_m),
            self._hand,
            out.known,
            out.sigma_m,
            out.shape_sigma_m,
            out.bend_rad,
            out.curl,
            out.caps_m,
            out.tips_m,
            out.pads_m,
            out.radius_m,
            out.joints_m,
            out.joints_cov_m2,
            out.T_rig_palm,
        )
        return out


def _plain(array: Any) -> Any:
    """The array contiguous and read-only, as kernels are compiled for."""
    if array.flags.c_contiguous:
        return array
    out = np.ascontiguousarray(array)
    out.flags.writeable = False
    return out


@kernel
def _measure(
    position: Float,
    wxyz: Float,
    radius: Float,
    cov: Float,
    valid: Bool,
    markers: Float,
    hand: _Hand,
    known: Bool,
    sigma: Float,
    shape_sigma: Float,
    bend: Float,
    curl: Float,
    caps: Float,
    tips: Float,
    pads: Float,
    tip_radius: Float,
    joints: Float,
    joints_cov: Float,
    T: Float,
) -> None:
    """Write `HandFeatures` from `known` on, of the arrays of a pose with a hand."""
    rotation, lacking = np.empty((26, 3, 3)), np.empty(26, np.bool_)
    _joints(position, wxyz, hand, joints, rotation, lacking, T)
    finite = np.empty(26, np.bool_)
    for j in range(26):
        total = 0.0
        for a in range(3):
            for b in range(3):
                total += cov[j, a, b]
        finite[j] = isfinite(total)
    wrist = spread(cov[WRIST])[0] if finite[WRIST] else 0.0
    for f in range(5):
        last, tip = CHAINS[f, 2], CHAINS[f, 3]
        _bends(f, joints, rotation, T, bend)
        total = bend[f, 1] + bend[f, 2] + (bend[f, 0] if f > 0 else 0.0)
        curl[f] = min(max(total / _CURLED_RAD[f], 0.0), 1.0)
        there = finite[tip] and valid[tip]
        for k in range(4):
            there = there and not lacking[CHAINS[f, k]]
        sigma[f] = spread(cov[tip])[1] if there else inf
        shape_sigma[f] = sqrt(max(sigma[f] * sigma[f] - wrist * wrist, 0.0))
        known[f] = valid[tip] and sigma[f] <= KNOWN_SIGMA_M
        tip_radius[f] = radius[tip]
        surface = radius[last] + PAD_SHARE * (radius[tip] - radius[last])
        for i in range(3):
            along = joints[last, i] + PAD_SHARE * (joints[tip, i] - joints[last, i])
            tips[f, i], pads[f, i] = joints[tip, i], along - surface * rotation[tip, i, 1]
            cap, joint = 0.0, hand.cap_joint[f]
            for k in range(3):
                cap += rotation[joint, i, k] * hand.cap_offset_m[f, k]
            caps[f, i] = joints[joint, i] + cap
    _take_seen(markers, caps)
    for j in range(26):
        for a in range(3):
            for b in range(3):
                nothing = 1.0 if a == b else 0.0
                joints_cov[j, a, b] = cov[j, a, b] if finite[j] and not lacking[j] else nothing


@inner
def _joints(
    position: Float, wxyz: Float, hand: _Hand, joints: Float, rotation: Float, lacking: Bool, T: Float
) -> None:
    """Write joints, rotations, palm, and joints that lack: these stand as likely."""
    for j in range(26):
        w, x, y, z = wxyz[j, 0], wxyz[j, 1], wxyz[j, 2], wxyz[j, 3]
        lacking[j] = isnan(position[j, 0] + position[j, 1] + position[j, 2] + w + x + y + z)
        n = sqrt(w * w + x * x + y * y + z * z)
        w, x, y, z = w / n, x / n, y / n, z / n
        R = rotation[j]
        R[0, 0], R[0, 1], R[0, 2] = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)
        R[1, 0], R[1, 1], R[1, 2] = 2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)
        R[2, 0], R[2, 1], R[2, 2] = 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)
        for i in range(3):
            joints[j, i] = position[j, i]
    T[3, 0], T[3, 1], T[3, 2], T[3, 3] = 0.0, 0.0, 0.0, 1.0
    for i in range(3):
        T[i, 3] = joints[WRIST, i]
        for k in range(3):
            T[i, k] = 0.0
            for m in range(3):
                T[i, k] += rotation[WRIST, i, m] * hand.wrist_rotation[k, m]
            T[i, 3] -= T[i, k] * hand.wrist_m[k]
    for j in range(26):
        if lacking[j]:
            for i in range(3):
                joints[j, i] = T[i, 3]
                for k in range(3):
                    joints[j, i] += T[i, k] * hand.likely_m[j, k]
                    rotation[j, i, k] = 0.0
                    for m in range(3):
                        rotation[j, i, k] += T[i, m] * hand.likely_rotation[j, m, k]


@inner
def _bends(f: int, joints: Float, rotation: Float, T: Float, bend: Float) -> None:
    """Write `HandFeatures.bend_rad` of finger f."""
    before = 0.0, 0.0, 0.0
    for k in range(3):
        a, b = CHAINS[f, k], CHAINS[f, k + 1]
        after = joints[b, 0] - joints[a, 0], joints[b, 1] - joints[a, 1], joints[b, 2] - joints[a, 2]
        if k == 0:
            across, up, ahead = (
                T[0, 0] * after[0] + T[1, 0] * after[1] + T[2, 0] * after[2],
                T[0, 1] * after[0] + T[1, 1] * after[1] + T[2, 1] * after[2],
                T[0, 2] * after[0] + T[1, 2] * after[1] + T[2, 2] * after[2],
            )
            bend[f, 0] = atan2(-up, ahead if f > 0 else hypot(across, ahead))
        else:
            # A flexion by a turns by -a about the joint's +x.
            hinge = rotation[a, 0, 0], rotation[a, 1, 0], rotation[a, 2, 0]
            bend[f, k] = atan2(-dot(cross(before, after), hinge), dot(before, after))
        before = after


@kernel
def _take_seen(markers: Float, caps: Float) -> None:
    """Put each cap on its marker: the nearest one, if the cap is its nearest as well."""
    own = np.empty(5, np.int64)
    for f in range(5):
        own[f], least = -1, inf
        for m in range(markers.shape[0]):
            distance = length(
                minus(point_at(markers, m), point_at(caps, f))
            )  # NaN where the marker is not seen
            if distance < least:
                own[f], least = m, distance
        for g in range(5):
            own_m = 0.012  # a marker farther from where the hand has the cap is not this finger's
            if least > own_m or length(minus(point_at(markers, own[f]), point_at(caps, g))) < least:
                own[f] = -1
                break
    for f in range(5):
        if own[f] >= 0:
            for i in range(3):
                caps[f, i] = markers[own[f], i]


_THUMB, _SIDE = constant(0), constant(2)
_Foot = tuple[float, float, float, float, float, float]
_foot_of = cast(Callable[[float, float, float, float, float, float, float], _Foot], inner(foot_of))
_nearest = cast(Callable[[_Foot, float], float], inner(nearest))


class ThumbTouch(NamedTuple):
    """The thumb's last segment against index ... little.

    Attributes:
        gap_m: (4,) to the last segment of each finger, skin to skin [m], negative: pressed.
        middle_m: (4, 3) half way between them [m], rig frame.
        opening_rad: (4,) by how much the pads of both are turned from facing each other, the worse of the two.
        opening_sigma_rad: (4,) how sure that is.
        key_gap_m: (4, 3) from the thumb's last segment to each segment of each finger, from the knuckle on [m].
        key_palmar: (4, 3) cosine between the way to the thumb there and the palmar side of the segment.
        key_sigma_m: (4, 3) standard deviation [m] of those gaps: of both places along the way between them.
    """

    gap_m: Float
    middle_m: Float
    opening_rad: Float
    opening_sigma_rad: Float
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
        opening_rad=np.empty(4),
        opening_sigma_rad=np.empty(4),
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
            distance_m = length(off)
            over = max(distance_m, 1e-9)
            way = off[0] / over, off[1] / over, off[2] / over
            radius_a = radius[thumb] + on_a * (radius[tip] - radius[thumb])
            out.key_gap_m[k, s] = distance_m - radius_a - (radius[a] + on_b * (radius[b] - radius[a]))
            side = _palmar(k + 1, s, joints, pads)
            out.key_palmar[k, s] = -dot(way, side)
            out.key_sigma_m[k, s] = _sigma_m(cov, thumb, tip, on_a, a, b, on_b, way)
            if s == 2:
                out.gap_m[k] = out.key_gap_m[k, s]
                for i in range(3):
                    out.middle_m[k, i] = start[i] + (radius_a + 0.5 * out.gap_m[k]) * way[i]
                face = min(dot(way, thumb_side), -dot(way, side))
                out.opening_rad[k] = acos(min(max(face, -1.0), 1.0))
        out.opening_sigma_rad[k] = hypot(thumb_sigma_rad, _direction_sigma_rad(k + 1, joints, cov))


@inner
def point_at(points: Float, j: int) -> Vector:
    """Row j of points (N, 3)."""
    return points[j, 0], points[j, 1], points[j, 2]


@inner
def _on(joints: Float, a: int, b: int, share: float) -> Vector:
    """Return the point [m] at a share of the way from one joint to another."""
    start, way = point_at(joints, a), minus(point_at(joints, b), point_at(joints, a))
    return start[0] + share * way[0], start[1] + share * way[1], start[2] + share * way[2]


@inner
def _shares(joints: Float, radius: Float, a: int, a_end: int, b: int, b_end: int) -> tuple[float, float]:
    """Where along two segments their skins are nearest, as `common.hand.skin`."""
    u, v = (
        minus(point_at(joints, a_end), point_at(joints, a)),
        minus(point_at(joints, b_end), point_at(joints, b)),
    )
    offset = minus(point_at(joints, b), point_at(joints, a))
    uu, vv, uv, au, bv, square = (
        dot(u, u),
        dot(v, v),
        dot(u, v),
        dot(offset, u),
        dot(offset, v),
        dot(offset, offset),
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
    """Standard deviation [rad] of a last bone's direction: its ends' over its length."""
    a, b, ends = CHAINS[f, 2], CHAINS[f, 3], np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            ends[i, j] = cov[a, i, j] + cov[b, i, j]
    return spread(ends)[1] / length(minus(point_at(joints, b), point_at(joints, a)))


@inner
def _sigma_m(
    cov: Float, thumb: int, tip: int, on_a: float, a: int, b: int, on_b: float, way: Vector
) -> float:
    """Standard deviation [m] of a gap, along the way from skin to skin.

    Each skin is as sure as its bone there, between its two joints. What both err alike by, the palm's
    uncertainty, counts twice: it is small beside the rest where tips are seen.
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
    """Unit vector out of a segment's palmar side, in its bend's plane, rig frame.

    The pad gives it for the last one; the others are turned back by the bends between.
    """
    last = minus(point_at(joints, CHAINS[f, 3]), point_at(joints, CHAINS[f, 2]))
    out = minus(point_at(pads, f), _on(joints, CHAINS[f, 2], CHAINS[f, 3], PAD_SHARE))
    if s < 2:
        # The hinge goes across the finger, the same for all its segments but for twist.
        out = cross(
            cross(last, out), minus(point_at(joints, CHAINS[f, s + 1]), point_at(joints, CHAINS[f, s]))
        )
    n = length(out)
    return out[0] / n, out[1] / n, out[2] / n
