"""The shape of a hand is a vector of unknowns with priors.

Of each finger: three bone lengths, position and rest orientation of its root (knuckle; thumb: CMC), and how
its DIP follows its PIP; with them the places of the markers on the back. Directions of bones in their joints,
rest rotations and the caps' offsets from the tip joints stay those of the template. Priors are of hands in
general, and of a user who follows the routine roughly: all wide, so where the markers do not overrule them a
bone is reported as undetermined.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float
from common.geometry.transforms import cross, rotation_vector_to_matrix, skew
from common.hand.model import CHAINS, HandModel
from common.hand.routine import move_at, posture_at

PER_FINGER = 11
LENGTH, ROOT, ROTATION, RATIO, BIAS = slice(0, 3), slice(3, 6), slice(6, 9), 9, 10


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """One hand's shape."""

    length_m: Float  # (5, 3) bones of the chains, proximal to distal
    root_m: Float  # (5, 3) roots of the chains, palm frame
    root_rotation: Float  # (5, 3, 3) rest orientation of the root joints, joint -> palm frame
    dip_ratio: Float  # this and dip_bias_rad: (5,) DIP = ratio PIP + bias (thumb: IP and MCP)
    dip_bias_rad: Float
    back_m: Float  # (B, 3) markers of the back, palm frame

    @classmethod
    def of(cls, model: HandModel, back: tuple[str, ...], dip_ratio: float, thumb_ratio: float) -> "Shape":
        """That of a profile."""
        return cls(
            length_m=np.linalg.norm(model.bone_m, axis=-1),
            root_m=model.rest_position_m[CHAINS[:, 0]],
            root_rotation=model.rest_rotation[CHAINS[:, 0]],
            dip_ratio=np.array([thumb_ratio, *[dip_ratio] * 4]),
            dip_bias_rad=np.zeros(5),
            back_m=np.array([model.mount(name).offset_m for name in back]).reshape(-1, 3),
        )

    @property
    def size(self) -> int:
        """Number of unknowns: 11 of each finger, then 3 of each marker of the back."""
        return 5 * PER_FINGER + self.back_m.size

    def stepped(self, step: Float) -> "Shape":
        """With a step (size,) [m, rad] added; turns are about the palm's axes."""
        own, back = step[: 5 * PER_FINGER].reshape(5, PER_FINGER), step[5 * PER_FINGER :]
        change = np.stack([rotation_vector_to_matrix(vector) for vector in own[:, ROTATION]])
        return Shape(
            length_m=self.length_m + own[:, LENGTH],
            root_m=self.root_m + own[:, ROOT],
            root_rotation=change @ self.root_rotation,
            dip_ratio=self.dip_ratio + own[:, RATIO],
            dip_bias_rad=self.dip_bias_rad + own[:, BIAS],
            back_m=self.back_m + back.reshape(-1, 3),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Caps:
    """Fingertip caps in the palm frame, and their derivatives, for T epochs."""

    place_m: Float  # (T, 5, 3)
    by_angle: Float  # (T, 5, 3, 4) [m/rad] by abduction, flexion, PIP, DIP
    by_shape: Float  # (T, 5, 3, 11) by the numbers of the own finger


def caps_of(model: HandModel, cap_m: Float, shape: Shape, angles_rad: Float) -> Caps:
    """Caps of a shape for angles (T, 5, 4): abduction, flexion, PIP, DIP [rad].

    `model` gives rest rotations, directions of bones and side, `cap_m` (5, 3) the caps' offsets in the tip
    joints [m].
    """
    count = len(angles_rad)
    abduct = _about(1, model.side_sign * angles_rad[..., 0])
    bend = _about(0, -angles_rad[..., 1:])
    before = np.tile(np.eye(3), (count, 5, 1, 1))  # what turns the rest orientation as a whole
    before[:, 1:] = abduct[:, 1:]
    first = before @ shape.root_rotation
    first[:, 0] = first[:, 0] @ abduct[:, 0]
    rotations = [first @ bend[:, :, 0]]
    for k in (1, 2):
        rotations.append(rotations[-1] @ model.link_rotation[:, k - 1] @ bend[:, :, k])
    along = model.bone_m / np.linalg.norm(model.bone_m, axis=-1, keepdims=True)
    ways = [_rotate(rotation, along[:, k]) for k, rotation in enumerate(rotations)]  # (T, 5, 3) unit
    joints = [np.broadcast_to(shape.root_m, (count, 5, 3))]
    for k in range(3):
        joints.append(joints[-1] + shape.length_m[:, k, None] * ways[k])
    tip = joints[3] + _rotate(rotations[2], (model.link_rotation[:, 2] @ cap_m[..., None])[..., 0])
    axis = np.empty((count, 5, 4, 3))
    axis[:, :, 0] = model.side_sign * np.array([0.0, 1.0, 0.0])
    axis[:, 0, 0] = model.side_sign * (first[:, 0] @ np.array([0.0, 1.0, 0.0]))
    for k, rotation in enumerate(rotations):
        axis[:, :, k + 1] = -rotation[..., 0]
    pivot = np.stack([joints[0], joints[0], joints[1], joints[2]], axis=2)
    by_angle = np.swapaxes(cross(axis, tip[:, :, None] - pivot), -1, -2)
    by_shape = np.zeros((count, 5, 3, PER_FINGER))
    by_shape[..., LENGTH] = np.stack(ways, axis=-1)
    by_shape[..., ROOT] = np.eye(3)
    by_shape[..., ROTATION] = -skew(tip - joints[0]) @ before
    return Caps(tip, by_angle, by_shape)


def _rotate(rotation: Float, vector: Float) -> Float:
    return (rotation @ vector[..., None])[..., 0]


def _about(axis: int, angle: Float) -> Float:
    """Rotations (..., 3, 3) about a coordinate axis."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    out = np.zeros((*angle.shape, 3, 3))
    out[..., axis, axis] = 1.0
    out[..., i, i] = out[..., j, j] = np.cos(angle)
    out[..., j, i] = np.sin(angle)
    out[..., i, j] = -out[..., j, i]
    return out


@dataclass(frozen=True, slots=True)
class Priors:
    """Standard deviations."""

    # of one bone about its share of the hand length, as a share of its length. Individuals spread by 5 to 8 %
    # (Buchholz, Armstrong & Goldstein, 1992; Greiner, 1991), and tips show the hand's length to 4 %
    bone: float = 0.09
    root_m: float = 6e-3  # of a knuckle's place, and of the thumb's CMC
    # this and thumb_rad: of a finger's and the thumb's rest orientation, about each axis
    root_rad: float = float(np.radians(5.0))
    thumb_rad: float = float(np.radians(12.0))
    # this and thumb_ratio: mean and sd of DIP per PIP, between Kalbfleisch's 2/3 and Kamper's 0.84, and of
    # the thumb's IP per MCP
    dip_ratio: tuple[float, float] = (0.75, 0.08)
    thumb_ratio: tuple[float, float] = (0.9, 0.3)
    dip_bias_rad: float = float(np.radians(3.0))  # of the DIP of a finger whose PIP is straight
    # this and thumb_dip_rad: by how much the DIP drifts from that, slowly
    dip_rad: float = float(np.radians(5.0))
    thumb_dip_rad: float = float(np.radians(12.0))
    straight_dip_rad: float = float(np.radians(2.0))  # the same of a finger that is held straight
    # mean and sd of the PIP of a finger that is held straight
    straight_rad: tuple[float, float] = (float(np.radians(1.5)), float(np.radians(1.5)))
    # this and moving_level_rad: of an angle about what the routine asks for, while held and while it moves
    level_rad: float = float(np.radians(12.0))
    moving_level_rad: float = float(np.radians(30.0))
    held_rad_s: float = float(np.radians(2.5))  # wandering of a joint that is to be held [rad/sqrt(s)]
    moving_rad_s: float = float(np.radians(400.0))  # of one that is to move
    # this and palm_m_s: of a palm that rests [rad/sqrt(s)], [m/sqrt(s)]
    palm_rad_s: float = float(np.radians(0.3))
    palm_m_s: float = 3e-4
    # this and free_palm_m_s: of one that need not, because three markers on it are seen
    free_palm_rad_s: float = float(np.radians(100.0))
    free_palm_m_s: float = 0.3
    back_m: float = 8e-3  # of the place of a marker on the back
    slow_s: float = 1.0  # time over which deviations live [s]
    # of a cap's place, by what the model leaves out: skin that moves, caps not quite round
    model_m: float = 2e-4


@dataclass(frozen=True, slots=True, eq=False)
class RoutineTargets:
    """What the routine asks for at each knot."""

    posture_rad: Float  # (K, 5, 3)
    moving: Bool  # (K, 5, 3) the angle is to change
    straight: Bool  # (K, 5) the finger is to be straight

    @classmethod
    def of(cls, script_s: Float) -> "RoutineTargets":
        """The targets at routine times (K,) [s].

        What may be moving by then counts as moving, since times are known roughly.
        """
        coarse_s = 0.1
        around = [[move_at(t + d) for d in (-coarse_s, 0.0, coarse_s)] for t in script_s.tolist()]
        return cls(
            np.radians([posture_at(t) for t in script_s.tolist()]),
            np.array([np.any([move.moving for move in moves], axis=0) for moves in around]),
            np.array([np.all([move.straight for move in moves], axis=0) for moves in around]),
        )
