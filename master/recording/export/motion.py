"""A motion moves the skeleton of one hand without gaps, at any frame rate.

The 26 joints are one tree, the basis of BVH and glTF: the wrist is the root, palm, thumb and the metacarpals
hang on it, every further joint on the one before it. Formats of animation know no "not observed": a joint
that a pose does not have (not valid, or NaN) stays as it last was *to its parent*, so that it goes along with
what is seen of the hand; before it was first seen it is as then, one that never was is at rest, and the wrist
stays where it last was.

Between two poses each joint is interpolated in the frame of its parent, its place linearly, its turn along
the shortest arc: bones that are rigid in the poses stay rigid between them, which they would not between
places in the rig frame. Over a gap in time nothing is interpolated: the hand stands still.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import cast

import numpy as np

from common.arrays import Bool, Float, Int
from common.errors import RecordingError
from common.geometry.transforms import matrix_to_quaternion
from common.hand.model import FINGER_JOINTS, PALM, WRIST, HandModel
from master.outputs.poses import Poses

PARENT: dict[int, int] = {PALM: WRIST} | {
    joint: before for chain in FINGER_JOINTS for before, joint in pairwise((WRIST, *chain))
}
ORDER = (WRIST, *PARENT)  # each joint behind its parent
CHILDREN: dict[int, tuple[int, ...]] = {
    joint: tuple(child for child in PARENT if PARENT[child] == joint) for joint in ORDER
}


@dataclass(frozen=True, slots=True, eq=False)
class Skeleton:
    """A hand at rest, in its palm frame."""

    hand: str
    side: str  # right or left
    position_m: Float  # (26, 3) [m]
    orientation_wxyz: Float  # (26, 4) joint -> palm frame
    radius_m: Float  # (26,) [m]

    @classmethod
    def of(cls, model: HandModel) -> "Skeleton":
        """That of a hand profile."""
        return cls(
            hand=model.profile.name,
            side=model.profile.side,
            position_m=model.rest_position_m,
            orientation_wxyz=matrix_to_quaternion(model.rest_rotation),
            radius_m=model.radius_m,
        )

    def local(self) -> tuple[Float, Float]:
        """Each joint in its parent's frame, the wrist in the palm's: (26, 3), (26, 4)."""
        at, q = self.position_m.copy(), self.orientation_wxyz.copy()
        for joint, parent in PARENT.items():
            there = back(self.orientation_wxyz[parent])
            at[joint] = rotate(there, self.position_m[joint] - self.position_m[parent])
            q[joint] = times(there, self.orientation_wxyz[joint])
        return at, q

    def ahead_m(self, joint: int) -> Float:
        """From a joint to the end of its flesh along its -z (3,) [m], palm frame."""
        return self.radius_m[joint] * rotate(self.orientation_wxyz[joint], np.array([0.0, 0.0, -1.0]))


def times(a_wxyz: Float, b_wxyz: Float) -> Float:
    """The rotation b, then a: products (..., 4) of quaternions (..., 4)."""
    aw, ax, ay, az = np.moveaxis(a_wxyz, -1, 0)
    bw, bx, by, bz = np.moveaxis(b_wxyz, -1, 0)
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def back(q_wxyz: Float) -> Float:
    """The rotations the other way round (..., 4), of unit quaternions (..., 4)."""
    return q_wxyz * np.array([1.0, -1.0, -1.0, -1.0])


def rotate(q_wxyz: Float, vector: Float) -> Float:
    """Vectors (..., 3) turned by unit quaternions (..., 4)."""
    w, axis = q_wxyz[..., :1], q_wxyz[..., 1:]
    side = 2.0 * np.cross(axis, vector)
    return vector + w * side + np.cross(axis, side)


# A frame takes 7 kB while it is made, so one late pose must not cost what it likes. There may be a break of ten minutes
# at 60 Hz, and 16 frames for each pose (of poses at 15 Hz, 240 frames/s).
FREE_FRAMES, FRAMES_OF_POSE = 36_000, 16


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Motion of one hand at T epochs, with all joints at every epoch."""

    t_ns: Int  # (T,) [ns], rising
    # (T, 26, 3) [m], rig frame; of `local` in the frame of the joint's parent, the wrist in the rig's
    position_m: Float
    orientation_wxyz: Float  # (T, 26, 4) unit quaternions, joint -> the same frame
    held: Bool  # (T, 26) not observed at that time
    gap_ns: int  # two times that are farther apart have nothing between them

    def __len__(self) -> int:
        return len(self.t_ns)

    @property
    def held_frames(self) -> int:
        """Number of epochs at which some joint is held."""
        return int(self.held.any(axis=1).sum())

    @property
    def rate_hz(self) -> float:
        """Rate where the poses are densest: one late pose makes no file coarser."""
        if len(self) < 2:
            return 60.0
        dense, most_hz = 10.0, 1000.0  # per cent of the steps
        rate = min(1e9 / float(np.percentile(np.diff(self.t_ns), dense)), most_hz)
        return round(rate) if rate > 0.5 and abs(rate / round(rate) - 1.0) < 0.01 else rate


def complete(batches: Iterable[Poses], skeleton: Skeleton) -> Motion:
    """All poses of a hand, the later of two at one epoch; RecordingError: none valid."""
    t_ns, position, orientation, usable = _stacked(batches)
    if not usable[:, WRIST].any():
        raise RecordingError(f"hand {skeleton.hand!r}: none of its {len(t_ns)} poses is valid")
    for joint in ORDER:
        good = usable[:, joint]
        if joint == WRIST:
            row = _last(good)
            position[:, joint], orientation[:, joint] = position[row, joint], orientation[row, joint]
            continue
        at, q = _held(joint, usable, position, orientation, skeleton)
        parent = PARENT[joint]
        away = position[:, parent] + rotate(orientation[:, parent], at)
        position[:, joint] = np.where(good[:, None], position[:, joint], away)
        composed = times(orientation[:, parent], q)
        orientation[:, joint] = np.where(good[:, None], orientation[:, joint], composed)
    typical_ns = float(np.median(np.diff(t_ns))) if len(t_ns) > 1 else 0.0
    gap_s = 0.25  # without a pose: longer than that nobody knows how the hand went
    gap_poses = 3.0  # of a source that is as slow as that all the time
    return Motion(t_ns, position, orientation, ~usable, int(max(gap_s * 1e9, gap_poses * typical_ns)))


def _stacked(batches: Iterable[Poses]) -> tuple[Int, Float, Float, Bool]:
    """Times, positions, rotations, usable mask in time order; identity: not usable."""
    parts = [
        (poses.t_ns, poses.position_m, poses.orientation_wxyz, poses.valid) for poses in batches if len(poses)
    ]
    if not parts:
        return np.empty(0, np.int64), np.empty((0, 26, 3)), np.empty((0, 26, 4)), np.empty((0, 26), np.bool_)
    t_ns, position, orientation, valid = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.argsort(t_ns, kind="stable")
    order = order[np.append(np.diff(t_ns[order]) > 0, True)]
    t_ns, position, orientation, valid = (column[order] for column in (t_ns, position, orientation, valid))
    length = np.sqrt(np.vecdot(orientation, orientation))
    unit = 0.5  # a quaternion shorter than that is none
    usable = valid & np.isfinite(position).all(axis=2) & (length > unit)  # NaN is not longer than anything
    position = np.where(usable[..., None], position, 0.0)
    orientation = np.where(usable[..., None], orientation, [1.0, 0.0, 0.0, 0.0])
    return t_ns, position, orientation / np.where(usable, length, 1.0)[..., None], usable


def _last(good: Bool) -> Int:
    """Index (T,) of the last good row so far; before any, of the first good one."""
    rows = np.maximum.accumulate(np.where(good, np.arange(len(good)), -1))
    return np.where(rows < 0, np.argmax(good), rows)


def _held(
    joint: int, usable: Bool, position: Float, orientation: Float, skeleton: Skeleton
) -> tuple[Float, Float]:
    """Last seen pose (T, 3), (T, 4) of a joint to its parent; at rest if never."""
    parent = PARENT[joint]
    both = usable[:, joint] & usable[:, parent]
    if not both.any():
        at, q = (np.tile(rest[joint], (len(usable), 1)) for rest in skeleton.local())
        return at, q
    row = _last(both)
    q = back(orientation[row, parent])
    return rotate(q, position[row, joint] - position[row, parent]), times(q, orientation[row, joint])


def local(motion: Motion) -> Motion:
    """Each joint in its parent's frame; quaternions have no jumps of sign."""
    position, orientation = motion.position_m.copy(), motion.orientation_wxyz.copy()
    for joint, parent in PARENT.items():
        q = back(motion.orientation_wxyz[:, parent])
        position[:, joint] = rotate(q, motion.position_m[:, joint] - motion.position_m[:, parent])
        orientation[:, joint] = times(q, motion.orientation_wxyz[:, joint])
    flips = np.vecdot(orientation[1:], orientation[:-1]) < 0.0
    sign = np.where(np.cumsum(flips, axis=0) % 2 == 1, -1.0, 1.0)
    orientation[1:] *= sign[..., None]
    return replace(motion, position_m=position, orientation_wxyz=orientation)


def world(motion: Motion) -> Motion:
    """The way back from `local`."""
    position, orientation = motion.position_m.copy(), motion.orientation_wxyz.copy()
    for joint, parent in PARENT.items():
        position[:, joint] = position[:, parent] + rotate(orientation[:, parent], position[:, joint])
        orientation[:, joint] = times(orientation[:, parent], orientation[:, joint])
    return replace(motion, position_m=position, orientation_wxyz=orientation)


def resample(motion: Motion, rate_hz: float) -> Motion:
    """Resample a motion in the rig frame at a constant rate from its first epoch on.

    It ends at most at its last epoch. A frame is held where one of the two poses beside it is, and in a gap.

    Raises:
        RecordingError: That would be more frames than fit in memory.
    """
    count = 1 + int((motion.t_ns[-1] - motion.t_ns[0]) * 1e-9 * rate_hz + 1e-6)
    most_frames = 1_000_000  # 4.6 hours at 60 Hz
    most = min(FREE_FRAMES + FRAMES_OF_POSE * len(motion), most_frames)
    if count > most:
        raise RecordingError(
            f"{count} frames at {rate_hz:g} Hz, at most {most} of {len(motion)} poses: export one part, with --from and"
            " --until, or at a lower --rate"
        )
    t_ns = motion.t_ns[0] + np.round(np.arange(count) * (1e9 / rate_hz)).astype(np.int64)
    passed = cast(Int, np.searchsorted(motion.t_ns, t_ns, side="right"))
    before = np.maximum(passed - 1, 0)
    after: Int = np.minimum(before + 1, len(motion) - 1)
    span = motion.t_ns[after] - motion.t_ns[before]
    share = np.clip((t_ns - motion.t_ns[before]) / np.maximum(span, 1), 0.0, 1.0)
    gap = (span > motion.gap_ns) & (share > 0.0) & (share < 1.0)
    share = np.where(gap, 0.0, share)[:, None]
    own = local(motion)
    first = own.position_m[before]
    position = first + share[..., None] * (own.position_m[after] - first)
    orientation = slerp(own.orientation_wxyz[before], own.orientation_wxyz[after], share)
    held = motion.held[before] | (motion.held[after] & (share > 0.0)) | gap[:, None]
    return world(Motion(t_ns, position, orientation, held, motion.gap_ns))


def slerp(first: Float, second: Float, share: Float) -> Float:
    """Interpolate unit quaternions (..., 4) on the shorter arcs (Shoemake, 1985)."""
    cosine = np.vecdot(first, second)
    second = np.where(cosine[..., None] < 0.0, -second, second)
    angle = np.arccos(np.minimum(np.abs(cosine), 1.0))
    straight = 1e-7
    near = angle < straight
    sine = np.where(near, 1.0, np.sin(angle))
    a = np.where(near, 1.0 - share, np.sin((1.0 - share) * angle) / sine)
    b = np.where(near, share, np.sin(share * angle) / sine)
    out = a[..., None] * first + b[..., None] * second
    return out / np.sqrt(np.vecdot(out, out))[..., None]
