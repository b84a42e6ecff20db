"""Find which fingers touch an object, and carry an unseen one with the hand.

The skin of a finger is capsules from joint to joint with the radii of the profile
(`common.geometry.tapered_capsules`). The distance that is published is that of the last segment; a finger
*touches* with any of its three, since whoever grasps a bar often holds it with the middle ones. The object's
poses around the hand's epoch are brought to it: between two of them by interpolation, behind the last by its
motion, a tenth of a second at most. The uncertainty of a distance is along the normal of the surface: the
joints, the object's place, its turn by the lever from its origin, and flesh that gives way. A finger touches
from a distance `NEAR_M` on that noise alone does not explain, and lets go beyond `FAR_M` (and as much): so it
does not flicker.

An object is *held* by the thumb or the palm and a finger against them; or, since a hand hides what it does
with what it holds, where it moves with the palm (`Carried`): over some tenths of a second an object's motion
predicts where the palm gets to if it is fixed to it; if that is a way long enough to be no noise, and the
palm, which is near, went it, then the object is carried. It stays so at rest, until the palm has moved about
the object, or fingers are seen to be away from it. A hand that pushes an object along with the palm looks the
same.
"""

from collections import deque
from collections.abc import Sequence

import numpy as np

from common.arrays import Bool, Float, Int
from common.calibration.object_profile import ObjectProfile
from common.geometry.tapered_capsules import Capsules
from common.geometry.transforms import (
    cross,
    invert,
    matrix_to_rotation_vector,
    quaternion_to_matrix,
    rigid,
    rotation_vector_to_matrix,
    transform,
)
from common.hand.model import CHAINS, METACARPALS, HandModel
from common.messages import Contact, HandPose, ObjectPose
from master.objects.surface import Nearest, Surface

SPAN_S = 0.35  # over which motions are compared


class Carried:
    """Push machine: whether a hand carries an object, by how both moved of late."""

    def __init__(self) -> None:
        # Time [ns], object `T_rig_object` (4, 4), palm (3,) [m] of late.
        self._moments: deque[tuple[int, Float, Float]] = deque()
        self._at_m: Float | None = None

    def push(self, t_ns: int, T_rig_object: Float, palm_m: Float, distance_m: float, away: bool) -> bool:
        """Whether the object is carried, at rising times.

        `palm_m` (3,), rig frame; NaN: not known. `distance_m` between palm and object; `away`: fingers are
        seen not to touch it.
        """
        if np.isnan(palm_m).any() or np.isnan(distance_m):
            return self._at_m is not None and not away
        gap_s = 0.1
        if self._moments and t_ns - self._moments[-1][0] > gap_s * 1e9:
            self._moments.clear()
        self._moments.append((t_ns, T_rig_object, palm_m))
        while t_ns - self._moments[0][0] > SPAN_S * 1e9:
            self._moments.popleft()
        at_m = transform(invert(T_rig_object), palm_m)
        near_m = 0.05  # between palm and object, at most
        if away or distance_m > near_m:
            self._at_m = None
            self._moments.clear()
        elif self._goes_along():
            self._at_m = at_m
        elif self._at_m is not None:
            off = at_m - self._at_m
            left_m = 0.03  # by which the palm moves about the object before it has left it
            slow = 0.02  # share by which what is remembered of the palm's place follows it, in each pose
            self._at_m = None if float(off @ off) > left_m**2 else self._at_m + slow * off
        return self._at_m is not None

    def forget(self) -> None:
        """The object is lost: nobody knows."""
        self._at_m = None
        self._moments.clear()

    def _goes_along(self) -> bool:
        (first_ns, T_first, palm_first), (last_ns, T_last, palm_last) = self._moments[0], self._moments[-1]
        if last_ns - first_ns < 0.5 * SPAN_S * 1e9:
            return False
        to = transform(T_last @ invert(T_first), palm_first)
        way = float(np.linalg.norm(to - palm_first))
        way_m = 0.015  # of the palm, at least: by that much it would move with the object
        alike = 0.5  # by which share of that way the palm may miss
        return way > way_m and float(np.linalg.norm(palm_last - to)) < alike * way


FAR_M = 5.0e-3
_BONES: Int = np.concatenate(
    [
        np.stack([CHAINS[:, :-1], CHAINS[:, 1:]], axis=-1).reshape(-1, 2),
        np.array([[joint, joint + 1] for joint in METACARPALS]),
    ]
)
_SEGMENTS = 15
_PALM = 0


class ContactMonitor:
    """Push machine: contacts of a hand; holds objects, last poses and what touched."""

    def __init__(self, model: HandModel, objects: Sequence[ObjectProfile]) -> None:
        """Take the hand and the objects near it; those without a shape have no contact."""
        self._hand = model.profile.name
        self._surfaces = {profile.name: Surface(profile.shape) for profile in objects if profile.shape}
        poses = 6
        self._poses: dict[str, deque[ObjectPose]] = {name: deque(maxlen=poses) for name in self._surfaces}
        self._touching: dict[str, Bool] = {name: np.zeros(6, np.bool_) for name in self._surfaces}
        self._carried = {name: Carried() for name in self._surfaces}

    def push_object(self, pose: ObjectPose) -> None:
        """Take a pose of an object; one not watched, or not after its last, is ignored."""
        poses = self._poses.get(pose.object)
        if poses is None or (poses and pose.t_ns <= poses[-1].t_ns):
            return
        if np.isnan(pose.position_m).any():
            poses.clear()
        else:
            poses.append(pose)

    def push(self, pose: HandPose) -> list[Contact]:
        """How near the hand is to each object that has a surface, in their order."""
        if pose.hand != self._hand:
            return []
        return [self._contact(pose, name, surface) for name, surface in self._surfaces.items()]

    def _contact(self, pose: HandPose, name: str, surface: Surface) -> Contact:
        placed = _at(self._poses[name], pose.t_ns)
        if placed is None:
            self._touching[name] = np.zeros(6, np.bool_)
            self._carried[name].forget()
            return _unknown(pose, name)
        T, cov = placed
        found, sigma = _gaps(pose, surface, T, cov)
        # Fingers (5, 3) and the palm's four bones as a sixth of its own.
        distance = found.distance_m
        segments = distance[:_SEGMENTS].reshape(5, 3)
        palm = int(np.argmin(np.nan_to_num(distance[_SEGMENTS:], nan=np.inf))) + _SEGMENTS
        nearest: Int = np.argmin(np.nan_to_num(segments, nan=np.inf), axis=1) + 3 * np.arange(5)
        bones = np.append(nearest, palm)
        touching = _touches(distance[bones], sigma[bones], self._touching[name])
        self._touching[name] = touching
        last = 3 * np.arange(5) + 2
        centre = np.where(pose.valid[_PALM], pose.position_m[_PALM], np.nan)
        free = _is_far(distance[bones[:5]], sigma[bones[:5]])
        carried = self._carried[name].push(pose.t_ns, T, centre, float(distance[palm]), free)
        return Contact(
            hand=pose.hand,
            object=name,
            t_ns=pose.t_ns,
            distance_m=distance[last],
            sigma_m=sigma[last],
            point_m=transform(T, found.point_m[last]),
            touching=touching[:5],
            palm_distance_m=float(distance[palm]),
            held=carried or bool((touching[0] or touching[5]) and touching[1:5].any()),
        )


def _is_far(distance: Float, sigma: Float) -> bool:
    """Whether fingers (5,) surely hold nothing (a thumb alone does not); NaN: open."""
    free = 2.5  # standard deviations of a distance beyond which a finger surely does not touch
    return bool((np.nan_to_num(distance - free * sigma, nan=-np.inf)[1:] > FAR_M).all())


def _touches(distance: Float, sigma: Float, before: Bool) -> Bool:
    """Return (N,) what touches, by distances, sigmas (N,) [m], and what did before."""
    sure_m = 0.02  # a distance less sure than this is no evidence of touch
    sure = sigma < sure_m
    near_m = 2.5e-3
    sigma_share = 0.5  # of a standard deviation by which touching may begin early
    begins = distance < near_m + sigma_share * np.minimum(sigma, FAR_M)
    stay_near = before & (distance < FAR_M + sigma_share * np.minimum(sigma, FAR_M))
    return sure & (begins | stay_near)


def _gaps(pose: HandPose, surface: Surface, T_rig_object: Float, cov_object: Float) -> tuple[Nearest, Float]:
    """Return distances of all bones (19,), object frame, and sigmas; NaN: not valid."""
    points = transform(invert(T_rig_object), np.nan_to_num(pose.position_m))
    start, stop = _BONES.T
    capsules = Capsules(points[start], points[stop], pose.radius_m[start], pose.radius_m[stop])
    found = surface.nearest_to_capsules(capsules)
    usable = (pose.valid & np.isfinite(pose.position_m).all(axis=1))[_BONES].all(axis=1)
    middle = capsules.start_m + found.along[:, None] * (capsules.stop_m - capsules.start_m)
    out = middle - found.point_m
    length = np.linalg.norm(out, axis=1)
    R = T_rig_object[:3, :3]
    normal = (out / np.maximum(length, 1e-9)[:, None]) @ R.T
    lever = found.point_m @ R.T
    along = found.along[:, None, None]
    # Neighbouring joints err alike, so variances mix by shares and not by their squares.
    cov = (1.0 - along) * pose.cov_m2[start] + along * pose.cov_m2[stop]
    hand = np.einsum("ni,nij,nj->n", normal, cov, normal)
    pull = np.concatenate([normal, cross(lever, normal)], axis=1)
    own = np.einsum("ni,ij,nj->n", pull, cov_object, pull)
    surface_sigma_m = 1.0e-3  # standard deviation of the skin about the profile's radii
    sigma = np.sqrt(hand + own + surface_sigma_m**2)
    nan = np.where(usable, 0.0, np.nan)
    return Nearest(found.distance_m + nan, found.point_m + nan[:, None], found.along), sigma + nan


def _at(poses: Sequence[ObjectPose], t_ns: int) -> tuple[Float, Float] | None:
    """Return pose (4, 4) and covariance (6, 6) of an object at a time, or None."""
    led_s = 0.1  # by which an object's pose is led on, at most
    if not poses or t_ns - poses[-1].t_ns > led_s * 1e9 or poses[0].t_ns - t_ns > led_s * 1e9:
        return None
    if len(poses) == 1:
        one = poses[0]
        dt = (t_ns - one.t_ns) * 1e-9
        return _pose_of(one), one.cov + _led(dt)
    after = next((k for k, one in enumerate(poses) if one.t_ns >= t_ns), len(poses) - 1)
    a, b = poses[max(after, 1) - 1], poses[max(after, 1)]
    share = (t_ns - a.t_ns) / (b.t_ns - a.t_ns)
    T_a, T_b = _pose_of(a), _pose_of(b)
    rotation = matrix_to_rotation_vector(T_b[:3, :3] @ T_a[:3, :3].T)
    R = rotation_vector_to_matrix(share * rotation) @ T_a[:3, :3]
    T = rigid(R, T_a[:3, 3] + share * (T_b[:3, 3] - T_a[:3, 3]))
    near = b if share > 0.5 else a
    beyond_s = max(t_ns - b.t_ns, a.t_ns - t_ns, 0) * 1e-9
    return T, near.cov + _led(beyond_s)


def _led(dt_s: float) -> Float:
    """Covariance (6, 6) of what an object may do beyond its motion in so long a time."""
    way = 0.5 * dt_s * dt_s
    led_m_s2, led_rad_s2 = 5.0, 50.0  # what a hand does to what it holds while nobody sees it
    return np.diag([(led_m_s2 * way) ** 2] * 3 + [(led_rad_s2 * way) ** 2] * 3)


def _pose_of(pose: ObjectPose) -> Float:
    return rigid(quaternion_to_matrix(pose.orientation_wxyz), pose.position_m)


def _unknown(pose: HandPose, name: str) -> Contact:
    nothing, nowhere, touching = np.full(5, np.nan), np.full((5, 3), np.nan), np.zeros(5, np.bool_)
    return Contact(pose.hand, name, pose.t_ns, nothing, nothing, nowhere, touching, np.nan, held=False)
