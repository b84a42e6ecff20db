"""Results of a master: hand and object poses, their contact, gestures."""

from copy import copy
from enum import IntEnum
from functools import cache
from math import nan
from typing import Annotated, Any, Literal, TypeAlias

import numpy as np
from msgspec import Meta, field
from msgspec.structs import fields, force_setattr

from common.arrays import Bool, Code, Float
from common.messages.parts import (
    FINGER_COUNT,
    JOINT_COUNT,
    MAX_MARKERS,
    Layout,
    Message,
    Metres,
    Name,
    Numbers,
    TimeNs,
    UnitQuaternion,
    refuse_beyond,
    within,
)

GestureKind = Literal["pose", "pinch", "dial", "tap", "point"]
Phase = Literal["begin", "update", "end"]
_NO_LASER = np.full((FINGER_COUNT, 3), np.nan)
_NO_MODE = np.zeros(FINGER_COUNT, dtype=np.uint8)
_NOT_AMBIGUOUS = np.zeros(FINGER_COUNT, dtype=np.bool_)
_NO_ROTATION, _NO_SIGMA, _NO_POINT = np.full(4, np.nan), np.full(2, np.nan), np.full(3, np.nan)
for _nothing in (_NO_LASER, _NO_MODE, _NOT_AMBIGUOUS, _NO_ROTATION, _NO_SIGMA, _NO_POINT):
    _nothing.flags.writeable = False


class Source(IntEnum):
    """Where the pose of one joint comes from."""

    NONE = 0
    MEASURED = 1
    SOLVED = 2
    HELD = 3
    WRIST = 4


class SolverMode(IntEnum):
    """What a wrist device solved a finger from (Digits, UIST 2012: two levels)."""

    NONE = 0
    FK = 1
    IK = 2


class ObjectSource(IntEnum):
    """What the pose of an object comes from."""

    NONE = 0
    MARKERS = 1
    TAGS = 2
    TRACKER = 3
    HELD = 4


class HandPose(Message, frozen=True, eq=False, tag=True):
    """One hand at one time, in the joint order of XR_EXT_hand_tracking (26 joints).

    Attributes:
        hand: Name of the hand profile.
        t_ns: Time at which the pose holds [ns], master's clock.
        position_m: Joint positions (26, 3) [m], rig frame.
        orientation_wxyz: Joint orientations (26, 4), unit quaternions, joint -> rig frame,
            OpenXR axes (-z along the bone to the tip, +y dorsal).
        radius_m: Joint radii (26,) [m].
        valid: (26,) the pose of the joint may be used.
        tracked: (26,) the 95 % regions of the joint and of its finger's PIP are smaller than a stated size, and it
            rests on measurements of its finger that are not older than a stated age (`estimator.tracked_m`,
            `tracked_age_s`). Implies valid.
        cov_m2: Position covariance (26, 3, 3) [m^2], rig frame. NaN: unknown.
        source: (26,) `Source` codes.
        angles_rad: (5, 4) [rad]: abduction, flexion (MCP; thumb CMC), PIP (thumb MCP),
            DIP (thumb IP), zero in the profile's rest pose.
        markers_m: Filtered cap centroids (M, 3) [m], rig frame. NaN: not seen.
        markers_raw_m: The same before the filter.
        markers_cov_m2: Covariances (M, 3, 3) [m^2] of `markers_raw_m`, rig frame. NaN: not seen.
        inside_volume: (26,) the joint lies in the volume that the rig states; all True where it states none. Outside,
            accuracy is not known; that alone does not clear `valid`.
        latency_ns: From the hand-over of the last contributing frame to its slave, to
            the publication of this pose [ns]; 0 in an offline run.
        laser_m: (5, 3) where the laser of a wrist device meets thumb ... little [m], frame of its camera. NaN: not
            seen, or no such device.
        solver_mode: (5,) `SolverMode` codes: what a wrist device solved each finger from.
        ambiguous: (5,) another pose of the finger explains what the wrist device saw as well; this is the one that
            fits the past, or the posture prior.
        palm_world_wxyz: (4,) quaternion, palm axes -> the world of the IMU on a wrist device, whose z axis is
            vertical. NaN: not known, or no such device.
        palm_world_sigma_rad: (2,) its standard deviations: tilt against the vertical per axis, heading about it.
        wrist_angles_rad: (2,) flexion and deviation of the wrist between a device on the forearm and the palm
            (`common.hand.wrist`). NaN: no such device, or nothing measures them.
        wrist_angles_sigma_rad: (2,) their standard deviations.
    """

    hand: Name
    t_ns: TimeNs
    position_m: Metres
    orientation_wxyz: UnitQuaternion
    radius_m: Annotated[Float, within(0.0, 1.0)]
    valid: Bool
    tracked: Bool
    cov_m2: Numbers
    source: Code
    angles_rad: Annotated[Float, within(-10.0, 10.0)]
    markers_m: Metres
    markers_raw_m: Metres
    markers_cov_m2: Numbers
    inside_volume: Bool
    latency_ns: TimeNs = 0
    laser_m: Metres = field(default_factory=lambda: _NO_LASER)
    solver_mode: Code = field(default_factory=lambda: _NO_MODE)
    ambiguous: Bool = field(default_factory=lambda: _NOT_AMBIGUOUS)
    palm_world_wxyz: UnitQuaternion = field(default_factory=lambda: _NO_ROTATION)
    palm_world_sigma_rad: Numbers = field(default_factory=lambda: _NO_SIGMA)
    wrist_angles_rad: Annotated[Float, within(-10.0, 10.0)] = field(default_factory=lambda: _NO_SIGMA)
    wrist_angles_sigma_rad: Numbers = field(default_factory=lambda: _NO_SIGMA)

    def __post_init__(self) -> None:
        m = self.markers_m.size // 3
        if m > MAX_MARKERS:
            raise ValueError(f"{m} markers, at most {MAX_MARKERS}")
        _hand_arrays(m).freeze(self)
        for name, kind, most in (("source", Source, _MOST_SOURCE), ("solver_mode", SolverMode, _MOST_MODE)):
            if (code := max(getattr(self, name).tolist())) > most:
                raise ValueError(f"{name}: {code} is no {kind.__name__} code")

    @classmethod
    def known_good(cls, hand: str, t_ns: int, **arrays: Float | Bool | Code) -> "HandPose":
        """Return a pose from arrays that their creator knows to be valid: unchecked.

        They become read-only, and are the pose's: nobody writes into them later. Those of a wrist device may be
        missing.

        Raises:
            ValueError: An array has another shape or type, or is missing.
        """
        if missing := _NEEDED - arrays.keys():
            raise ValueError(f"missing: {', '.join(sorted(missing))}")
        pose = copy(_NO_HAND)
        force_setattr(pose, "hand", hand)
        force_setattr(pose, "t_ns", t_ns)
        _hand_arrays(len(arrays["markers_m"])).adopt(pose, arrays)
        return pose


class ObjectPose(Message, frozen=True, eq=False, tag=True):
    """One rigid object at one time.

    Attributes:
        object: Name of the object file.
        t_ns: Time at which the pose holds [ns], master's clock.
        position_m: (3,) of the object's own frame [m], rig frame. NaN: never seen yet, or not for long.
        orientation_wxyz: (4,) unit quaternion, object axes -> rig frame. NaN with the position.
        cov: (6, 6) of position [m] and of a small turn about the rig's axes [rad]. NaN: unknown.
        residual_m: Root mean square by which what was measured misses the object in this pose [m]. NaN: not measured.
        source: `ObjectSource` code.
        tracked: The pose is measured now, not held.
        seen: How many of its features (markers, tags) the pose rests on.
        expected: How many would be seen by some camera, as it is turned, with nothing before it.
        occluded: Something hides a part of it: fewer are seen than expected.
        latency_ns: From the hand-over of the last contributing frame to its slave, to the publication of this pose
            [ns]; 0 in an offline run.
    """

    object: Name
    t_ns: TimeNs
    position_m: Metres
    orientation_wxyz: UnitQuaternion
    cov: Numbers
    residual_m: Annotated[float, within(0.0, 1e4)]
    source: Annotated[int, Meta(ge=0, le=int(max(ObjectSource)))]
    tracked: bool
    seen: Annotated[int, Meta(ge=0, le=MAX_MARKERS)]
    expected: Annotated[int, Meta(ge=0, le=MAX_MARKERS)]
    occluded: bool
    latency_ns: TimeNs = 0

    def __post_init__(self) -> None:
        _OBJECT_ARRAYS.freeze(self)
        refuse_beyond(self, "residual_m")


class Contact(Message, frozen=True, eq=False, tag=True):
    """How near a hand is to an object, and where it touches it.

    Attributes:
        hand: Name of the hand profile.
        object: Name of the object file.
        t_ns: Time [ns], that of the hand's pose, master's clock.
        distance_m: (5,) from the skin of the last segment of thumb ... little to the surface of the object [m],
            negative inside. NaN: finger or object is not known.
        sigma_m: (5,) standard deviations of these.
        point_m: (5, 3) the point of the object's surface that is nearest to each [m], rig frame.
        touching: (5,) the finger touches: with hysteresis, so that it does not flicker.
        palm_distance_m: From the palm's skin to the surface [m].
        held: The hand has a grip of it: the thumb or the palm, and a finger against them.
    """

    hand: Name
    object: Name
    t_ns: TimeNs
    distance_m: Metres
    sigma_m: Numbers
    point_m: Metres
    touching: Bool
    palm_distance_m: Annotated[float, within(-1e4, 1e4)]
    held: bool

    def __post_init__(self) -> None:
        _CONTACT_ARRAYS.freeze(self)
        refuse_beyond(self, "palm_distance_m")


class Gesture(Message, frozen=True, eq=False, tag=True):
    """Gesture of a hand; if it lasts, it begins, repeats with every pose, and ends.

    Attributes:
        hand: Name of the hand profile.
        t_ns: Time [ns], that of the hand's pose, master's clock.
        kind: `pose` (the hand is held in a shape), `pinch` (thumb and a finger), `dial` (a grip that turns), `tap`
            (the thumb on a part of a finger; begins and ends in one message of phase `end`), `point` (a ray).
        name: Which one: the pose (open_palm, counting_two, pointing, small_grasp, large_grasp, pinch, or one that was
            made a template); of a pinch the finger; of a tap the key (0 ... 9, star, hash); else the kind again.
        phase: begin, update, end.
        began_t_ns: When it began [ns], same clock as `t_ns`.
        confidence: 0..1.
        distance_m: Of a pinch: between the skin of thumb and finger [m].
        strength: Of a pinch: 0 (open) .. 1 (closed).
        angle_rad: Of a dial: by how much it was turned since it began, clockwise as the user sees the back of the
            hand.
        origin_m: (3,) of a pointing ray [m], rig frame; of a pinch the middle between the two; of a dial its centre.
        direction: (3,) unit vector of a pointing ray, rig frame; of a dial its axis.
    """

    hand: Name
    t_ns: TimeNs
    kind: GestureKind
    name: Name
    phase: Phase
    began_t_ns: TimeNs
    confidence: Annotated[float, Meta(ge=0.0, le=1.0)]
    distance_m: Annotated[float, within(-1e4, 1e4)] = nan
    strength: Annotated[float, within(0.0, 1.0)] = nan
    angle_rad: Annotated[float, within(-1e4, 1e4)] = nan
    origin_m: Metres = field(default_factory=lambda: _NO_POINT)
    direction: UnitQuaternion = field(default_factory=lambda: _NO_POINT)

    def __post_init__(self) -> None:
        _GESTURE_ARRAYS.freeze(self)
        for name in ("distance_m", "strength", "angle_rad"):
            refuse_beyond(self, name)


ResultMessage: TypeAlias = HandPose | ObjectPose | Contact | Gesture  # what a master makes of it


@cache
def _hand_arrays(m: int) -> Layout:
    j = JOINT_COUNT
    return Layout(
        HandPose,
        position_m=(j, 3),
        orientation_wxyz=(j, 4),
        radius_m=(j,),
        valid=(j,),
        tracked=(j,),
        cov_m2=(j, 3, 3),
        source=(j,),
        angles_rad=(FINGER_COUNT, 4),
        markers_m=(m, 3),
        markers_raw_m=(m, 3),
        markers_cov_m2=(m, 3, 3),
        inside_volume=(j,),
        laser_m=(FINGER_COUNT, 3),
        solver_mode=(FINGER_COUNT,),
        ambiguous=(FINGER_COUNT,),
        palm_world_wxyz=(4,),
        palm_world_sigma_rad=(2,),
        wrist_angles_rad=(2,),
        wrist_angles_sigma_rad=(2,),
    )


_OBJECT_ARRAYS = Layout(ObjectPose, position_m=(3,), orientation_wxyz=(4,), cov=(6, 6))
_CONTACT_ARRAYS = Layout(
    Contact,
    distance_m=(FINGER_COUNT,),
    sigma_m=(FINGER_COUNT,),
    point_m=(FINGER_COUNT, 3),
    touching=(FINGER_COUNT,),
)
_GESTURE_ARRAYS = Layout(Gesture, origin_m=(3,), direction=(3,))
_MOST_SOURCE, _MOST_MODE = int(max(Source)), int(max(SolverMode))
_NEEDED = frozenset(field.name for field in fields(HandPose) if field.required) - {"hand", "t_ns"}
_nothing_needed: dict[str, Any] = {
    name: np.zeros(shape, of) for name, of, shape in _hand_arrays(0).arrays if name in _NEEDED
}
_NO_HAND = HandPose(hand="none", t_ns=0, **_nothing_needed)
