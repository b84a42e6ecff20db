"""What gestures are read from: how far each finger is bent, where its tip and pad are, and how sure that is.

All of it is geometry of the solved joints, not of the profile's angles: those are zero in the rest pose of a profile,
and rest poses differ from hand to hand. A bend is the signed angle between two bones about the hinge between them,
that of the MCP between the palm's plane and the first bone; positive is towards the palm, for both hands alike.
"""

from dataclasses import dataclass
from math import isfinite

import numpy as np

from common.arrays import Bool, Float
from common.geometry import cross, quaternion_to_matrix, rigid
from common.hand_model import CHAINS, MIDDLE_PROXIMAL, TIPS, WRIST, HandModel
from common.messages import HandPose

KNOWN_SIGMA_M = 0.015  # a tip that may be farther off is anywhere between straight and half bent
# Sum of a finger's bends [rad], MCP, PIP and DIP, where it is as curled as it goes; of the thumb MCP and IP.
_CURLED_RAD = np.radians([90.0, 230.0, 230.0, 230.0, 230.0])
# Of fingers that nothing is known of [rad]: a thumb at rest, fingers half bent.
LIKELY_RAD = np.radians([[8.0, 15.0, 15.0, 15.0], *([[0.0, 55.0, 75.0, 50.0]] * 4)])
_TIPS_AND_WRIST = np.append(TIPS, WRIST)
_PAD_SHARE = 0.75  # of the last bone, from the joint: where the ball of the pad is thickest


@dataclass(frozen=True, slots=True, eq=False)
class HandFeatures:
    """One hand at one instant; fingers thumb ... little.

    Attributes:
        hand: Name of the hand profile.
        t_ns: The instant [ns], that of the pose.
        known: (5,) the finger's tip is known to `KNOWN_SIGMA_M` or better.
        seen: (5,) a sensor observes the finger's tip now.
        sigma_m: (5,) standard deviation [m] of the tip along the axis where it is worst; inf: nothing is known.
        shape_sigma_m: (5,) the same without what the wrist's place has of it, which moves the whole hand.
        angles_rad: (5, 4) of the pose, zero in the profile's rest pose.
        bend_rad: (5, 3) bends of MCP, PIP and DIP, zero where the bones lie in the palm's plane in one line; of the
            thumb the first is how far its metacarpal stands out of the palm's plane, then MCP and IP.
        curl: (5,) 0 straight ... 1 curled.
        tips_m: (5, 3) middle of the tip's round end [m], rig frame.
        pads_m: (5, 3) middle of the pad's skin [m], rig frame.
        radius_m: (5,) of the round end [m].
        joints_m: (26, 3) [m], rig frame.
        rotation: (26, 3, 3) joint frame -> rig frame.
        joints_cov_m2: (26, 3, 3) [m^2], rig frame; where nothing is known, a metre each way.
        T_rig_palm: (4, 4) palm -> rig frame.
        dorsal, palmar, forward: (3,) unit vectors, rig frame: out of the back of the hand, out of the palm, along the
            palm to the fingers.
        size_m: From the wrist to the middle knuckle [m].
        side_sign: +1 right, -1 left.
        palm_world_wxyz: (4,) as in the pose.
    """

    hand: str
    t_ns: int
    known: Bool
    seen: Bool
    sigma_m: Float
    shape_sigma_m: Float
    angles_rad: Float
    bend_rad: Float
    curl: Float
    tips_m: Float
    pads_m: Float
    radius_m: Float
    joints_m: Float
    rotation: Float
    joints_cov_m2: Float
    T_rig_palm: Float
    dorsal: Float
    palmar: Float
    forward: Float
    size_m: float
    side_sign: float
    palm_world_wxyz: Float


def features_of(pose: HandPose, model: HandModel) -> HandFeatures | None:
    """The features of a pose of `model`'s hand; None where the pose has no hand.

    A finger of which the pose has nothing is not known, its doubt is infinite, and it stands where fingers that hide
    are likely to be.
    """
    joints, wxyz = pose.position_m, pose.orientation_wxyz
    there: Float = joints.sum(axis=1) + wxyz.sum(axis=1)
    if not (pose.valid[WRIST] and isfinite(there[WRIST])):
        return None
    rotation, lacking = quaternion_to_matrix(wxyz), np.isnan(there)
    palm = rotation[WRIST] @ model.rest_rotation[WRIST].T
    T_rig_palm = rigid(palm, joints[WRIST] - palm @ model.rest_position_m[WRIST])
    if lacking.any():
        likely = model.forward(T_rig_palm, LIKELY_RAD)
        joints = np.where(lacking[:, None], likely.position_m, joints)
        rotation = np.where(lacking[:, None, None], likely.rotation, rotation)
    bend = _bends(joints[CHAINS], rotation[CHAINS], palm)
    total = bend.sum(axis=1)
    total[0] -= bend[0, 0]
    told: Bool = np.asarray(np.isfinite(pose.cov_m2.sum(axis=(1, 2))), np.bool_)
    sigma, wrist = _sigma_m(pose, told)
    sigma = np.where(lacking[CHAINS].any(axis=1), np.inf, sigma)
    known = pose.valid[TIPS] & (sigma <= KNOWN_SIGMA_M)
    last = CHAINS[:, 2]
    along = joints[last] + _PAD_SHARE * (joints[TIPS] - joints[last])
    radius = pose.radius_m[last] + _PAD_SHARE * (pose.radius_m[TIPS] - pose.radius_m[last])
    return HandFeatures(
        hand=pose.hand,
        t_ns=pose.t_ns,
        known=known,
        seen=pose.tracked[TIPS],
        sigma_m=sigma,
        shape_sigma_m=np.sqrt(np.maximum(sigma**2 - wrist**2, 0.0)),
        angles_rad=pose.angles_rad,
        bend_rad=bend,
        curl=np.minimum(np.maximum(total / _CURLED_RAD, 0.0), 1.0),
        tips_m=joints[TIPS],
        pads_m=along - radius[:, None] * rotation[TIPS][..., 1],
        radius_m=pose.radius_m[TIPS],
        joints_m=joints,
        rotation=rotation,
        joints_cov_m2=_cov_m2(pose, told & ~lacking),
        T_rig_palm=T_rig_palm,
        dorsal=palm[:, 1],
        palmar=-palm[:, 1],
        forward=palm[:, 2],
        size_m=float(np.linalg.norm(joints[MIDDLE_PROXIMAL] - joints[WRIST])),
        side_sign=model.side_sign,
        palm_world_wxyz=pose.palm_world_wxyz,
    )


def _cov_m2(pose: HandPose, known: Bool) -> Float:
    return pose.cov_m2 if known.all() else np.where(known[:, None, None], pose.cov_m2, np.eye(3))


def _sigma_m(pose: HandPose, told: Bool) -> tuple[Float, float]:
    """Standard deviations (5,) [m] of the tips along their worst axis, inf where not known; and that of the wrist along
    its best, 0 where not known. `told` (26,) says which covariances are finite."""
    told = (told & pose.valid)[_TIPS_AND_WRIST]
    cov = np.where(told[:, None, None], pose.cov_m2[_TIPS_AND_WRIST], 0.0)
    spread = np.sqrt(np.maximum(np.linalg.eigvalsh(cov), 0.0))
    return np.where(told[:5], spread[:5, 2], np.inf), float(spread[5, 0])


def _bends(chain: Float, rotation: Float, palm: Float) -> Float:
    """`HandFeatures.bend_rad` of joints (5, 4, 3), their frames (5, 4, 3, 3) and the palm's (3, 3)."""
    bone = chain[:, 1:] - chain[:, :-1]
    out = np.empty((5, 3))
    first = bone[:, 0] @ palm
    out[1:, 0] = np.arctan2(-first[1:, 1], first[1:, 2])
    out[0, 0] = np.arctan2(-first[0, 1], np.hypot(first[0, 0], first[0, 2]))
    before, after, hinge = bone[:, :-1], bone[:, 1:], rotation[:, 1:3, :, 0]
    # A flexion by a turns by -a about the joint's +x.
    out[:, 1:] = np.arctan2(-np.vecdot(cross(before, after), hinge), np.vecdot(before, after))
    return out
