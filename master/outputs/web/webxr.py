"""Hand as JSON in the joint order of WebXR Hand Input.

The frame of the message is `webxr`: x right, y up, z towards the viewer, so that the hand is before an eye at
the origin that looks along -z, as the reference camera does. It is the rig frame (x right, y down, z away)
turned by pi about x:

    (x, y, z) -> (x, -y, -z)        w + xi + yj + zk -> i (w + xi + yj + zk) = -x + wi - zj + yk

Joint axes need no turn: those of OpenXR (-z along the bone to the tip, +y dorsal) are those of WebXR. Numbers
are rounded to 1 um and 1e-6 of a quaternion: far below the noise, and half the bytes.
"""

from math import isnan
from typing import Literal

import msgspec
import numpy as np
from msgspec import Struct

from common.arrays import Float
from common.hand.model import WEBXR_JOINTS
from common.messages import HandPose, ObjectPose, ObjectSource, Source
from master.outputs.network.conventions import Side, side_of

FORMAT_VERSION = 1
Triple = tuple[float, float, float]
Four = tuple[float, float, float, float]

_SOURCES = tuple(source.name.lower() for source in Source)
_OBJECT_SOURCES = tuple(source.name.lower() for source in ObjectSource)
_POINT_SIGNS = np.array([1.0, -1.0, -1.0])
# x, y, z, w of the message: which of w, x, y, z it is, and with which sign
_QUATERNION_ORDER, _QUATERNION_SIGNS = [0, 3, 2, 1], np.array([1.0, -1.0, 1.0, -1.0])
_ENCODER = msgspec.json.Encoder()  # writes NaN as null


class JointJson(Struct, frozen=True):
    """One joint."""

    name: str  # as in WebXR Hand Input
    position: Triple | None  # [m], frame of the message. None: not known
    # unit quaternion x, y, z, w with w >= 0, joint axes -> frame of the message. None: not known
    orientation: Four | None
    radius: float  # from the joint to the skin [m]; NaN: not known
    valid: bool  # the pose may be used
    tracked: bool  # it is observed now, not inferred; tracked implies valid
    # standard deviation of the position per axis [mm], root mean square of the three. NaN: not known
    sigma_mm: float
    source: str  # none, measured, solved, held or wrist (`common.messages.Source`)


class HandJson(Struct, frozen=True, tag_field="type", tag="hand"):
    """One hand at one time: the JSON object of `webxr_json`, 25 joints."""

    version: int
    frame: Literal["webxr"]
    hand: str
    side: Side | None
    t_ns: int
    latency_ms: float
    joints: list[JointJson]


class ObjectJson(Struct, frozen=True, tag_field="type", tag="object"):
    """One object at one time: the JSON object of `object_json`, like `JointJson`."""

    version: int
    frame: Literal["webxr"]
    object: str
    t_ns: int
    latency_ms: float
    position: Triple | None
    orientation: Four | None
    tracked: bool
    source: str


def webxr_json(pose: HandPose) -> bytes:
    """Encode the pose as JSON (`HandJson`); unknown is null, never NaN."""
    points = _points(pose.position_m[1:])
    rotations = _quaternions(pose.orientation_wxyz[1:])
    sigma_mm: Float = np.sqrt(np.einsum("jii->j", pose.cov_m2[1:]) / 3.0) * 1e3
    columns = zip(
        WEBXR_JOINTS,
        points,
        rotations,
        np.round(pose.radius_m[1:], 6).tolist(),
        pose.valid[1:].tolist(),
        pose.tracked[1:].tolist(),
        np.round(sigma_mm, 3).tolist(),
        [_SOURCES[code] for code in pose.source[1:].tolist()],
        strict=True,
    )
    joints = [JointJson(*column) for column in columns]
    latency_ms = round(pose.latency_ns / 1e6, 3)
    return _ENCODER.encode(
        HandJson(FORMAT_VERSION, "webxr", pose.hand, side_of(pose), pose.t_ns, latency_ms, joints)
    )


def object_json(pose: ObjectPose) -> bytes:
    """Encode the pose of an object as JSON (`ObjectJson`); unknown is null."""
    return _ENCODER.encode(
        ObjectJson(
            version=FORMAT_VERSION,
            frame="webxr",
            object=pose.object,
            t_ns=pose.t_ns,
            latency_ms=round(pose.latency_ns / 1e6, 3),
            position=_points(pose.position_m[None])[0],
            orientation=_quaternions(pose.orientation_wxyz[None])[0],
            tracked=pose.tracked,
            source=_OBJECT_SOURCES[pose.source],
        )
    )


def _points(position_m: Float) -> list[Triple | None]:
    """Points (N, 3) [m] of the rig frame in the frame of the message."""
    # Adding 0 turns -0.0, which JSON would show, into 0.0.
    rows = (np.round(position_m * _POINT_SIGNS, 6) + 0.0).tolist()
    return [tuple(row) if _known(row) else None for row in rows]


def _quaternions(orientation_wxyz: Float) -> list[Four | None]:
    """Turn wxyz (N, 4) of the rig frame into xyzw of the message's frame."""
    rotations = orientation_wxyz[:, _QUATERNION_ORDER] * _QUATERNION_SIGNS
    rotations = np.where(rotations[:, 3:] < 0.0, -rotations, rotations)
    return [tuple(row) if _known(row) else None for row in (np.round(rotations, 6) + 0.0).tolist()]


def _known(row: list[float]) -> bool:
    """Whether no number of the row is NaN."""
    return not isnan(sum(row))
