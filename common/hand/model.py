"""The hand model computes joints and fingertips from bones and angles.

26 OpenXR joints, from a profile's rest pose. Angles (5, 4) [rad] are zero in it; fingers thumb, index, middle, ring,
little; columns abduction, flexion (MCP; thumb CMC), PIP (thumb MCP), DIP (thumb IP). A flexion by a is a rotation by
-a about the joint's own +x; an abduction is a rotation about the palm's +y, positive towards the thumb:

    fingers   R_MCP = R_y(s a_abd) R_rest R_x(-a_flex)          s = +1 right hand, -1 left hand
    thumb     R_CMC = R_rest R_y(s a_abd) R_x(-a_flex)          in the joint's own frame, no twist

All five fingers are the same chain of four joints (root, two hinges, tip): forward kinematics is four stacked
products. Limits are per angle, but the abduction's narrow with flexion (`common.hand.profiles`).

A fingertip is the outermost point of the skin along the last bone. OpenXR defines the radius of the last joint as the
distance from there to the skin (XR_EXT_hand_tracking), so where the file gives radii the tip is that far beyond it.
Otherwise it is that of a hand of this size, in shares of the distance between the knuckles of index and little finger,
measured like the rest of the skin (`common.hand.skin`) on the generic hand of the WebXR Input Profiles (MIT); the
outermost point of such a fingertip lies a little towards the nail.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from common.arrays import Bool, Float
from common.calibration import Couplings, HandProfile
from common.errors import CalibrationError
from common.geometry.transforms import quaternion_to_matrix
from common.hand.profiles import (
    ABDUCTION,
    FLEXION,
    limit_table,
    preset_couplings,
    preset_limits,
    radius_share,
    spread_left,
    spread_table,
    tolerance_table,
)

FINGERS = ("thumb", "index", "middle", "ring", "little")
WEBXR_JOINTS = (
    "wrist",
    "thumb-metacarpal",
    "thumb-phalanx-proximal",
    "thumb-phalanx-distal",
    "thumb-tip",
    *(
        f"{finger}-finger-{part}"
        for finger in ("index", "middle", "ring", "pinky")
        for part in ("metacarpal", "phalanx-proximal", "phalanx-intermediate", "phalanx-distal", "tip")
    ),
)
JOINTS = ("palm", *WEBXR_JOINTS)
PALM, WRIST = 0, 1
MIDDLE_METACARPAL, MIDDLE_PROXIMAL = 11, 12
METACARPALS = (6, 11, 16, 21)
CHAINS = np.array([[2, 3, 4, 5], [7, 8, 9, 10], [12, 13, 14, 15], [17, 18, 19, 20], [22, 23, 24, 25]])
FINGER_JOINTS = (
    (2, 3, 4, 5),
    (6, 7, 8, 9, 10),
    (11, 12, 13, 14, 15),
    (16, 17, 18, 19, 20),
    (21, 22, 23, 24, 25),
)
PALM_FRAME = "palm_frame"
TIPS = CHAINS[:, 3]
_ROOTS = CHAINS[:, 0].copy()


@dataclass(frozen=True, slots=True, eq=False)
class Chains:
    """The four joints of each finger's chain (`CHAINS`): root, two hinges, tip.

    Attributes:
        position_m: (..., 5, 4, 3) [m], palm frame.
        rotation: (..., 5, 4, 3, 3), joint frame -> palm frame.
    """

    position_m: Float
    rotation: Float


@dataclass(frozen=True, slots=True, eq=False)
class HandJoints:
    """Poses of the joints.

    Attributes:
        position_m: (..., 26, 3) [m], rig frame.
        rotation: (..., 26, 3, 3), joint frame -> rig frame.
        T_rig_palm: (..., 4, 4) palm frame -> rig frame.
    """

    position_m: Float
    rotation: Float
    T_rig_palm: Float


@dataclass(frozen=True, slots=True, eq=False)
class Mount:
    """Mounting of a marker: joint index (None: palm frame), centroid, painted length.

    The centroid (3,) [m] is in the frame of that joint.
    """

    joint: int | None
    offset_m: Float
    painted_m: float

    @property
    def finger(self) -> int | None:
        """Finger (0 thumb ... 4 little) whose chain carries the marker, or None."""
        if self.joint is None:
            return None
        rows = np.flatnonzero((CHAINS == self.joint).any(axis=1))
        return int(rows[0]) if len(rows) else None


@dataclass(frozen=True, slots=True, eq=False)
class HandModel:
    """A hand profile as arrays, checked.

    Attributes:
        rest_position_m: (26, 3) [m], palm frame.
        rest_rotation: (26, 3, 3), joint frame -> palm frame.
        radius_m: (26,) [m].
        limits_rad: (5, 4, 2) low and high of every angle; the abduction's where nothing narrows it.
        tolerance_rad: (5, 4) standard deviation by which the person may differ from them; 0: walls.
        spread_at_full_flexion: (5,) share of the abduction range left at the highest flexion.
        dip_per_pip: Coupling of index ... little, or None where the DIP is free.
        dip_spread_rad: Standard deviation of the DIP about that ratio; 0: it is kept exactly.
        mcp_per_pip: Natural flexion, a prior only, or None where there is none.
        neighbours: Whether fingers side by side tend to bend alike, a prior only.
        posture: Mean (20,) [rad] and covariance (20, 20) [rad^2] of the angles of this person, or None.
        side_sign: +1 right, -1 left.
        bone_m: (5, 3, 3) link k of each finger in the frame of its joint k.
        link_rotation: (5, 3, 3, 3) rest rotation of joint k + 1 in the frame of joint k.
        swing: (3, 5, 4, 3, 3) for each angle a the rotation from the angle before it, its rest turn included, is
            swing[0] + cos a swing[1] + sin a swing[2].
    """

    profile: HandProfile
    rest_position_m: Float
    rest_rotation: Float
    radius_m: Float
    limits_rad: Float
    tolerance_rad: Float
    spread_at_full_flexion: Float
    dip_per_pip: float | None
    dip_spread_rad: float
    mcp_per_pip: float | None
    neighbours: bool
    posture: tuple[Float, Float] | None
    mounts: dict[str, Mount]
    side_sign: float
    bone_m: Float
    link_rotation: Float
    swing: Float

    def __post_init__(self) -> None:
        """Freeze the radii: poses adopt them, kernels take read-only for another type."""
        self.radius_m.setflags(write=False)

    @classmethod
    def of(cls, profile: HandProfile) -> "HandModel":
        """Build and check.

        Raises:
            CalibrationError: A joint or marker is missing or unknown, a bone has no length, limits are crossed, or the
                posture's covariance is none.
        """
        where = f"hand {profile.name!r}"
        position, rotation = _rest(profile, where)
        bone = np.empty((5, 3, 3))
        link_rotation = np.empty((5, 3, 3, 3))
        for f, chain in enumerate(CHAINS):
            for k, (a, b) in enumerate(pairwise(chain)):
                bone[f, k] = rotation[a].T @ (position[b] - position[a])
                link_rotation[f, k] = rotation[a].T @ rotation[b]
        if (np.linalg.norm(bone, axis=-1) < 1e-3).any():
            raise CalibrationError(f"{where}: rest_joints: a finger bone is shorter than 1 mm")
        couplings = couplings_of(profile)
        limits = profile.limits_rad or "K"
        limits = preset_limits(limits) if isinstance(limits, str) else limits
        side_sign = 1.0 if profile.side == "right" else -1.0
        return cls(
            profile=profile,
            rest_position_m=position,
            rest_rotation=rotation,
            radius_m=_radii(profile, where),
            limits_rad=limit_table(limits, where),
            tolerance_rad=tolerance_table(limits),
            spread_at_full_flexion=spread_table(limits, where),
            dip_per_pip=couplings.dip_per_pip,
            dip_spread_rad=couplings.dip_spread_rad,
            mcp_per_pip=couplings.mcp_per_pip,
            neighbours=couplings.neighbours,
            posture=_posture(profile, where),
            mounts=_mounts(profile, where),
            side_sign=side_sign,
            bone_m=bone,
            link_rotation=link_rotation,
            swing=_swing(rotation[CHAINS[:, 0]], link_rotation, side_sign),
        )

    def forward(self, T_rig_palm: Float, angles_rad: Float) -> HandJoints:
        """Joint poses of palm poses (..., 4, 4) and angles (..., 5, 4) [rad]."""
        chains = self.chains(np.asarray(angles_rad, dtype=np.float64))
        return self.joints(np.asarray(T_rig_palm, dtype=np.float64), chains)

    def joints(self, T_rig_palm: Float, chains: Chains) -> HandJoints:
        """All joints of a palm pose (..., 4, 4) whose fingers are bent like `chains`."""
        batch, R_palm = chains.position_m.shape[:-3], T_rig_palm[..., :3, :3]
        position = np.empty((*batch, 26, 3))
        rotation = np.empty((*batch, 26, 3, 3))
        position[...] = self.rest_position_m
        rotation[...] = self.rest_rotation
        position[..., CHAINS, :] = chains.position_m
        rotation[..., CHAINS, :, :] = chains.rotation
        position = position @ np.swapaxes(R_palm, -1, -2) + T_rig_palm[..., None, :3, 3]
        return HandJoints(position, R_palm[..., None, :, :] @ rotation, T_rig_palm)

    def chains(self, angles_rad: Float) -> Chains:
        """The fingers' joints in the palm frame, of angles (..., 5, 4) [rad]."""
        still, with_cosine, with_sine = self.swing
        angle = angles_rad[..., None, None]
        local = still + np.cos(angle) * with_cosine + np.sin(angle) * with_sine  # (..., 5, 4, 3, 3)
        rotation = np.empty(local.shape)
        rotation[..., 0, :, :] = frame = local[..., 0, :, :] @ local[..., 1, :, :]
        rotation[..., 1, :, :] = frame = frame @ local[..., 2, :, :]
        rotation[..., 2, :, :] = frame = frame @ local[..., 3, :, :]
        rotation[..., 3, :, :] = frame @ self.link_rotation[:, 2]
        position = np.empty((*local.shape[:-2], 3))
        position[..., 0, :] = self.rest_position_m[_ROOTS]
        np.matmul(rotation[..., :3, :, :], self.bone_m[..., None], out=position[..., 1:, :, None])
        return Chains(position.cumsum(axis=-2), rotation)

    def marker_points(self, joints: HandJoints, names: tuple[str, ...]) -> Float:
        """Cap centroids (..., M, 3) [m], rig frame; raises as `mount`."""
        points: list[Float] = []
        for name in names:
            mount = self.mount(name)
            if mount.joint is None:
                R, p = joints.T_rig_palm[..., :3, :3], joints.T_rig_palm[..., :3, 3]
            else:
                R, p = joints.rotation[..., mount.joint, :, :], joints.position_m[..., mount.joint, :]
            points.append(p + R @ mount.offset_m)
        return np.stack(points, axis=-2)

    def mount(self, name: str) -> Mount:
        """Where marker `name` sits; CalibrationError if the profile does not know it."""
        if name not in self.mounts:
            known = ", ".join(self.mounts)
            raise CalibrationError(
                f"hand {self.profile.name!r}: no marker {name!r} under 'markers'; it has {known}"
            )
        return self.mounts[name]

    def abduction_limits_rad(self, flexion_rad: Float) -> tuple[Float, Float]:
        """Low and high (..., 5) [rad] of the abduction at flexions; NaN stays NaN."""
        most = self.limits_rad[:, FLEXION, 1]
        flexed = np.minimum(np.maximum(flexion_rad, 0.0), most) / np.where(most > 0.0, most, 1.0)
        left = spread_left(np.maximum(flexed, 0.0), self.spread_at_full_flexion)
        return left * self.limits_rad[:, ABDUCTION, 0], left * self.limits_rad[:, ABDUCTION, 1]

    def limits_at(self, flexion_rad: Float) -> tuple[Float, Float]:
        """Low and high (..., 5, 4) [rad] of every angle at flexions (..., 5) [rad]."""
        shape = (*np.shape(flexion_rad), 4)
        low, high = (np.broadcast_to(self.limits_rad[..., k], shape).copy() for k in (0, 1))
        low[..., ABDUCTION], high[..., ABDUCTION] = self.abduction_limits_rad(flexion_rad)
        return low, high

    def within_limits(self, angles_rad: Float, slack_rad: float = 1e-9) -> Bool:
        """Whether each angle (..., 5, 4) is inside its limits at its finger's flexion."""
        low, high = self.limits_at(angles_rad[..., FLEXION])
        return (angles_rad >= low - slack_rad) & (angles_rad <= high + slack_rad)

    def clamp(self, angles_rad: Float) -> Float:
        """Clamp angles (..., 5, 4) to limits, the abduction's at the clamped flexion."""
        legal = np.minimum(np.maximum(angles_rad, self.limits_rad[..., 0]), self.limits_rad[..., 1])
        low, high = self.abduction_limits_rad(legal[..., FLEXION])
        legal[..., ABDUCTION] = np.minimum(np.maximum(angles_rad[..., ABDUCTION], low), high)
        return legal


def _swing(root: Float, link_rotation: Float, side_sign: float) -> Float:
    """`HandModel.swing` of root rotations (5, 3, 3) and rest turns (5, 3, 3, 3)."""
    abduct, flexion = _about(1, side_sign), _about(0, -1.0)  # a flexion turns by -a about +x
    out = np.empty((3, 5, 4, 3, 3))
    out[:, 0, 0], out[:, 1:, 0] = root[0] @ abduct, abduct[:, None] @ root[1:]
    out[:, :, 1] = flexion[:, None]
    out[:, :, 2:] = link_rotation[:, :2] @ flexion[:, None, None]
    return out


def _about(axis: int, sign: float) -> Float:
    """Rotation by sign * a about axis 0 or 1 as terms (3, 3, 3) of 1, cos a, sin a."""
    parts = np.zeros((3, 3, 3))
    i, j = (axis + 1) % 3, (axis + 2) % 3
    parts[0, axis, axis] = parts[1, i, i] = parts[1, j, j] = 1.0
    parts[2, i, j], parts[2, j, i] = -sign, sign
    return parts


def _rest(profile: HandProfile, where: str) -> tuple[Float, Float]:
    joints = profile.rest_joints
    for name in WEBXR_JOINTS:
        if name not in joints:
            raise CalibrationError(f"{where}: rest_joints: {name!r} is missing")
    unknown = joints.keys() - set(WEBXR_JOINTS)
    if unknown:
        raise CalibrationError(f"{where}: rest_joints: unknown joint {min(unknown)!r}")
    position = np.array([joints[name].position_m for name in WEBXR_JOINTS])
    quaternion = np.array([joints[name].orientation_wxyz for name in WEBXR_JOINTS])
    rotation = quaternion_to_matrix(quaternion)
    middle = WEBXR_JOINTS.index("middle-finger-metacarpal")
    palm = position[[middle, middle + 1]].mean(axis=0)
    return np.vstack([palm, position]), np.concatenate([rotation[:1], rotation])


def _radii(profile: HandProfile, where: str) -> Float:
    joints = profile.rest_joints
    unknown = (profile.radius_m or {}).keys() - set(JOINTS)
    if unknown:
        raise CalibrationError(f"{where}: radius_m: unknown joint {min(unknown)!r}")
    a, b = (
        np.array(joints[f"middle-finger-phalanx-{part}"].position_m) for part in ("proximal", "intermediate")
    )
    length, given = float(np.linalg.norm(b - a)), profile.radius_m or {}
    return np.array([given.get(name, length * radius_share(name)) for name in JOINTS])


def _posture(profile: HandProfile, where: str) -> tuple[Float, Float] | None:
    if profile.posture is None:
        return None
    mean, cov = np.array(profile.posture.mean_rad), np.array(profile.posture.cov_rad2)
    if not np.allclose(cov, cov.T, atol=1e-9) or np.linalg.eigvalsh(cov)[0] <= 0.0:
        raise CalibrationError(f"{where}: posture.cov_rad2: a covariance is symmetric and positive definite")
    return mean, cov


def couplings_of(profile: HandProfile) -> Couplings:
    """The couplings of a profile, spelled out; CalibrationError if contradictory."""
    couplings = profile.couplings or "K"
    couplings = preset_couplings(couplings) if isinstance(couplings, str) else couplings
    if couplings.dip_per_pip is None and couplings.dip_spread_rad > 0.0:
        raise CalibrationError(
            f"hand {profile.name!r}: couplings.dip_spread_rad: there is no ratio to deviate from while"
            " dip_per_pip is null; give dip_per_pip a ratio, or leave dip_spread_rad out"
        )
    return couplings


def _mounts(profile: HandProfile, where: str) -> dict[str, Mount]:
    mounts: dict[str, Mount] = {}
    for name, mount in profile.markers.items():
        if mount.joint != PALM_FRAME and mount.joint not in WEBXR_JOINTS:
            raise CalibrationError(f"{where}: markers.{name}.joint: unknown joint {mount.joint!r}")
        joint = None if mount.joint == PALM_FRAME else JOINTS.index(mount.joint)
        mounts[name] = Mount(joint, np.array(mount.offset_m), mount.painted_m)
    return mounts


_BEYOND = np.array([0.166, 0.170, 0.197, 0.180, 0.152])  # thumb ... little


@dataclass(frozen=True, slots=True, eq=False)
class Fingertips:
    """The tips of one hand.

    Attributes:
        beyond_m: (5,) how far the skin reaches beyond the last joint, along the last bone [m].
        dorsal_m: How far its outermost point lies on the back's side of the bone's line [m].
    """

    beyond_m: Float
    dorsal_m: float

    @classmethod
    def of(cls, model: HandModel) -> "Fingertips":
        """Those of a hand file, or else of a hand of its size."""
        if model.profile.radius_m is not None:
            return cls(model.radius_m[TIPS], 0.0)
        knuckles = model.rest_position_m[CHAINS[[1, 4], 0]]
        width = float(np.linalg.norm(knuckles[1] - knuckles[0]))
        dorsal = 0.02  # the outermost point, of all five
        return cls(_BEYOND * width, dorsal * width)

    def points(self, chains: Chains) -> Float:
        """Tips (..., 5, 3) [m], in the frame of the chains."""
        joint = chains.position_m[..., 3, :]
        bone = joint - chains.position_m[..., 2, :]
        along = bone / np.sqrt(np.vecdot(bone, bone))[..., None]
        dorsal = chains.rotation[..., 3, :, 1]
        dorsal = dorsal - np.vecdot(dorsal, along)[..., None] * along
        return joint + self.beyond_m[:, None] * along + self.dorsal_m * dorsal
