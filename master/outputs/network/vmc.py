"""Virtual Motion Capture carries hands as bones of a VRM avatar.

OSC over UDP, protocol.vmc.info, 3.1. Two datagrams a pose, each below the size that a network splits: what is
available, the time and the root; then the bones of the hand. Bones of which nothing is known are left out, so
that the avatar keeps them as they are. Three frames, and one rest pose:

- *avatar*: OpenXR axes, right-handed: x to the avatar's right, y up, z to its back.
- *Unity*: left-handed: x right, y up, z to the front. A place (x, y, z) of the avatar frame is (x, y, -z) there, and a
  turn, seen in that mirror, keeps w and z of its quaternion and flips x and y.
- *joint*: OpenXR: -z along the bone to the tip, y dorsal, so that a flexion by a is a turn by -a about x.
- *T-pose* (VRMC_vrm-1.0, "VRM T-pose", definitions 1.6 to 1.8): hands and fingers lie along x, right hand to +x, left
  hand to -x, palms and finger pads down; thumbs point half way between their fingers and the front, parallel to the
  ground, rolled outward by 90 degrees: their nails face half way between the front and the other hand.

A normalized bone is turned by nothing in the T-pose, whichever way it points. So a joint whose orientation is
R_A_joint in the avatar frame, and B there in the T-pose, turns its bone by G = R_A_joint B^T, and the local
rotation of a bone is L = G_parent^T G. The bones of the fingers hang on the hand: Unity has no metacarpals,
and calls the thumb's metacarpal its proximal bone. For joints of one chain the room cancels out; the hand's
own bone hangs on an arm that nobody tracks and that is taken to be in the T-pose.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float
from common.calibration.output_settings import VmcOutput
from common.geometry.transforms import cross, matrix_to_quaternion, quaternion_to_matrix
from common.hand.model import CHAINS, WRIST
from common.hand.wrist import forearm_palm
from common.messages import HandPose, ResultMessage
from master.outputs.network.conventions import MasterTimes, Side, side_of
from master.outputs.network.osc import Blank, BlankBundle, UdpSender, floats, ints

_SEGMENTS = ("Proximal", "Intermediate", "Distal")
_FINGERS = ("Thumb", "Index", "Middle", "Ring", "Little")
_JOINT_PALM = np.diag([-1.0, 1.0, -1.0])  # palm axes -> axes of the wrist joint in a flat hand

JOINT_OF_BONE = (WRIST, *(int(joint) for chain in CHAINS for joint in chain[:3]))  # (16,)
# rows of the parents of all bones but the first, the hand's
_PARENT_ROWS = np.array([parent for f in range(5) for parent in (0, 1 + 3 * f, 2 + 3 * f)])
_ROWS = np.array(JOINT_OF_BONE)
_CONJUGATE = np.array([1.0, -1.0, -1.0, -1.0])


def _hamilton() -> Float:
    """Linear map (16, 4) from the products a_i b_j to the quaternion a b, wxyz."""
    table = np.zeros((4, 4, 4))
    table[0] = np.eye(4)  # 1 times anything
    table[:, 0] = np.eye(4)
    for i, j, k in ((1, 2, 3), (2, 3, 1), (3, 1, 2)):
        table[i, i, 0] = -1.0
        table[i, j, k], table[j, i, k] = 1.0, -1.0
    return table.reshape(16, 4)


_PRODUCT = _hamilton()


def bone_names(side: Side) -> tuple[str, ...]:
    """Return Unity's `HumanBodyBones` of one hand (16): hand, thumb ... little."""
    top = side.capitalize()
    return (f"{top}Hand", *(f"{top}{finger}{segment}" for finger in _FINGERS for segment in _SEGMENTS))


def t_pose(side: Side) -> Float:
    """Return T-pose orientations (16, 3, 3): joint axes -> avatar axes."""
    out = 1.0 if side == "right" else -1.0
    half = np.sqrt(0.5)
    finger = _axes(np.array([out, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]))
    thumb = _axes(np.array([out * half, 0.0, -half]), np.array([-out * half, 0.0, -half]))
    return np.stack([finger, *[thumb] * 3, *[finger] * 12])


@dataclass(frozen=True, slots=True, eq=False)
class Bones:
    """The bones of one hand, rows as `bone_names`, Unity's axes; NaN: not known."""

    # (16, 3) [m] from the parent bone, in the parent's turned frame; row 0 is NaN, see `hand_bone`
    position_m: Float
    rotation_xyzw: Float  # (16, 4) quaternion against the parent bone


class BoneMap:
    """Map from poses of one side to bones: products with constant quaternions only."""

    def __init__(self, side: Side, R_avatar_rig: Float) -> None:
        """For one side; `R_avatar_rig` (3, 3): rig axes -> avatar axes."""
        self._rest = t_pose(side)
        self._R_avatar_rig = R_avatar_rig
        # matrices that multiply a quaternion from the left, and from the right
        q, rests = matrix_to_quaternion(R_avatar_rig), matrix_to_quaternion(self._rest.swapaxes(1, 2))
        before = np.stack([product(q, one) for one in np.eye(4)], axis=-1)
        after = [np.stack([product(one, rest) for one in np.eye(4)], axis=-1) for rest in rests]
        self._to_bone = np.stack([before @ one for one in after])  # (16, 4, 4): orientation wxyz -> G

    def bones(self, pose: HandPose) -> Bones:
        """Return all bones of a pose; the hand's is turned as the palm in the room."""
        joint = np.where(pose.valid[_ROWS, None], pose.orientation_wxyz[_ROWS], np.nan)
        bone = (self._to_bone @ joint[..., None])[..., 0]  # G, (16, 4) wxyz
        parent = bone[_PARENT_ROWS] * _CONJUGATE
        local = bone.copy()
        local[1:] = (parent[:, :, None] * bone[1:, None, :]).reshape(-1, 16) @ _PRODUCT
        local *= np.where(local[:, :1] < 0.0, -1.0, 1.0)
        place = pose.position_m[_ROWS] @ self._R_avatar_rig.T
        position = np.full((len(_ROWS), 3), np.nan)
        link, axis = place[1:] - place[_PARENT_ROWS], parent[:, 1:]
        twice = 2.0 * cross(axis, link)
        position[1:] = (link + parent[:, :1] * twice + cross(axis, twice)) * [1.0, 1.0, -1.0]
        return Bones(position, mirrored_xyzw(local))

    def flexed(self, R_forearm_palm: Float) -> Float:
        """Return xyzw (4,) of the hand's bone for a wrist at `R_forearm_palm` (3, 3)."""
        C = self._rest[0] @ _JOINT_PALM  # palm axes of the T-pose -> avatar
        return mirrored_xyzw(matrix_to_quaternion(C @ R_forearm_palm @ C.T))


def mirrored_xyzw(q_wxyz: Float) -> Float:
    """Quaternions (..., 4) wxyz of the avatar frame as Unity's, xyzw."""
    return q_wxyz[..., [1, 2, 3, 0]] * [-1.0, -1.0, 1.0, 1.0]


def product(a_wxyz: Float, b_wxyz: Float) -> Float:
    """Hamilton's product a b (4,) of two quaternions (4,)."""
    return np.outer(a_wxyz, b_wxyz).ravel() @ _PRODUCT


def _axes(along: Float, dorsal: Float) -> Float:
    """Joint axes (3, 3) of a bone that points `along` and whose back faces `dorsal`."""
    return np.stack([np.cross(dorsal, -along), dorsal, -along], axis=-1)


OK, TIME, ROOT, BONE = "/VMC/Ext/OK", "/VMC/Ext/T", "/VMC/Ext/Root/Pos", "/VMC/Ext/Bone/Pos"
_LOADED = ints([1, 3, 0])  # a model is loaded, it is calibrated, normal mode
_ORIGIN = floats([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
_STILL = np.array([0.0, 0.0, 0.0, 1.0])


class VmcSink:
    """A `Sink` that sends every pose as bones; it ignores other messages."""

    def __init__(self, settings: VmcOutput, times: MasterTimes) -> None:
        """Open the socket; PhalanxError: the host is unknown."""
        self._settings, self._times = settings, times
        rotation = quaternion_to_matrix(np.array(settings.q_avatar_rig))
        sides: tuple[Side, ...] = ("left", "right")
        self._maps = {side: BoneMap(side, rotation) for side in sides}
        self._bones = {
            side: BlankBundle([Blank(BONE, (name,), "f" * 7) for name in bone_names(side)]) for side in sides
        }
        self._state = BlankBundle(
            [Blank(OK, (), "iii"), Blank(TIME, (), "f"), Blank(ROOT, ("root",), "f" * 7)]
        )
        self._began_ns: int | None = None
        self._udp = UdpSender(settings.host, settings.port, "vmc")

    def write(self, message: ResultMessage) -> None:
        """Send one pose; PhalanxError: this machine cannot send there."""
        if not isinstance(message, HandPose):
            return
        side = side_of(message)
        if side is None:
            return  # nothing of it is known
        if self._began_ns is None:
            self._began_ns = message.t_ns
        wall_ns = self._times.wall_ns(message.t_ns)
        since = floats([1e-9 * (message.t_ns - self._began_ns)])
        self._udp.send(self._state.filled(wall_ns, np.concatenate([_LOADED, since, _ORIGIN])))
        place, quaternion = self._rows(message, side)
        rows: Float = np.concatenate([place, quaternion], axis=1)
        known: Bool = np.asarray(np.isfinite(rows).all(axis=1))
        self._udp.send(self._bones[side].filled(wall_ns, floats(rows).ravel(), known))

    def close(self) -> None:
        """Give the socket back."""
        self._udp.close()

    def _rows(self, pose: HandPose, side: Side) -> tuple[Float, Float]:
        """Positions (16, 3) [m] and xyzw (16, 4), the hand's as the settings state."""
        bones = self._maps[side].bones(pose)
        place, quaternion = bones.position_m, bones.rotation_xyzw
        place[0] = (self._settings.forearm_m if side == "right" else -self._settings.forearm_m, 0.0, 0.0)
        if self._settings.hand == "rest":
            quaternion[0] = _STILL
        elif self._settings.hand == "wrist":
            quaternion[0] = self._maps[side].flexed(forearm_palm(pose.wrist_angles_rad))
        return place, quaternion
