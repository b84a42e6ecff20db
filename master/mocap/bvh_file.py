"""Reader of BVH files.

A tree of joints with offsets, and the rotations of every frame, become positions of all joints.

    R_joint = R_parent . product of its rotation channels, in their order      p_joint = p_parent + R_parent . offset

(Meredith & Maddock, "Motion capture file formats explained", 2001). Position channels of a joint hold its whole offset,
as Blender and most readers take them. The end of a chain is the point `PARENT_end`; one that lies on its parent is
none. BVH has no unit, and no word for what was not seen.
"""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from common.arrays import Float
from common.errors import RecordingError
from master.mocap.joint_motion import MAX_BYTES, PointTable

_CHANNELS = ("xposition", "yposition", "zposition", "xrotation", "yrotation", "zrotation")


@dataclass(slots=True)
class _Joint:
    name: str
    parent: int
    offset: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    channels: list[int] = field(default_factory=list[int])
    end: bool = False


def read_bvh(path: Path) -> PointTable:
    """Read a file.

    Raises:
        RecordingError: It cannot be read, or is no BVH; with what is wrong.
    """
    try:
        if path.stat().st_size > MAX_BYTES:
            raise RecordingError(f"{path}: larger than 1 GiB: cut it")
        text = path.read_text(encoding="utf-8-sig", errors="replace")
    except OSError as error:
        raise RecordingError(f"{path}: cannot read: {error.strerror}") from error
    head, found, motion = text.partition("MOTION")
    if not found or not head.lstrip().startswith("HIERARCHY"):
        raise RecordingError(f"{path}: no BVH: it has HIERARCHY and MOTION")
    try:
        joints = _hierarchy(head.split())
        step_s, values = _frames(motion.split(), sum(len(joint.channels) for joint in joints))
    except (ValueError, IndexError, OverflowError) as error:
        raise RecordingError(f"{path}: broken BVH: {error}") from error
    position = _positions(joints, values)
    no_bone = 1e-6
    shown = [k for k, joint in enumerate(joints) if not joint.end or max(map(abs, joint.offset)) > no_bone]
    names = tuple(joints[k].name for k in shown)
    ends = frozenset(joint.name for joint in joints if joint.end)
    return PointTable(
        names, step_s * np.arange(len(values), dtype=np.float64), position[:, shown], None, ends
    )


def _hierarchy(words: list[str]) -> list[_Joint]:
    """The joints, each behind its parent."""
    joints: list[_Joint] = []
    open_joints: list[int] = []
    at, coming = 1, False
    while at < len(words):
        word = words[at]
        if word in ("ROOT", "JOINT", "End"):
            parent = open_joints[-1] if open_joints else -1
            end = at + 1
            while words[end] != "{":
                end += 1
            name = " ".join(words[at + 1 : end])
            if word == "End":
                name = f"{joints[parent].name}_end"
            joints.append(_Joint(name, parent, end=word == "End"))
            most_joints = 2000
            if len(joints) > most_joints:
                raise ValueError(f"more than {most_joints} joints")
            coming, at = True, end
        elif word == "{":
            if not coming:
                raise ValueError("a { without a joint")
            open_joints.append(len(joints) - 1)
            coming, at = False, at + 1
        elif word == "}":
            open_joints.pop()
            at += 1
        elif word == "OFFSET":
            joints[open_joints[-1]].offset = [float(value) for value in words[at + 1 : at + 4]]
            at += 4
        elif word == "CHANNELS":
            count = int(words[at + 1])
            named = words[at + 2 : at + 2 + count]
            joints[open_joints[-1]].channels = [_CHANNELS.index(name.lower()) for name in named]
            at += 2 + count
        else:
            raise ValueError(f"{word[:40]!r} in the hierarchy")
    if open_joints or not joints:
        raise ValueError("a hierarchy that is not closed")
    return joints


def _frames(words: list[str], channels: int) -> tuple[float, Float]:
    """Seconds from frame to frame, and the channels (T, C)."""
    if words[0] != "Frames:" or words[2:4] != ["Frame", "Time:"]:
        raise ValueError("MOTION is not followed by Frames: and Frame Time:")
    count, step_s = int(words[1]), float(words[4])
    if not 1e-5 < step_s < 10.0:
        raise ValueError(f"Frame Time: {step_s:g} s")
    values = np.array(words[5:], np.float64)
    if count < 1 or len(values) != count * channels:
        raise ValueError(
            f"{len(values)} numbers, {count} frames of {channels} channels have {count * channels}"
        )
    if not np.isfinite(values).all():
        raise ValueError("a channel that is no number")
    return step_s, values.reshape(count, channels)


def _positions(joints: list[_Joint], values: Float) -> Float:
    """Joints (T, N, 3) of channels (T, C)."""
    count = len(values)
    position, rotation = np.zeros((count, len(joints), 3)), np.zeros((count, len(joints), 3, 3))
    column = 0
    for k, joint in enumerate(joints):
        offset, rotations = np.tile(joint.offset, (count, 1)), np.tile(np.eye(3), (count, 1, 1))
        for channel in joint.channels:
            if channel < 3:
                offset[:, channel] = values[:, column]
            else:
                rotations = rotations @ _about(channel - 3, np.radians(values[:, column]))
            column += 1
        if joint.parent < 0:
            position[:, k], rotation[:, k] = offset, rotations
            continue
        above = rotation[:, joint.parent]
        position[:, k] = position[:, joint.parent] + (above @ offset[:, :, None])[:, :, 0]
        rotation[:, k] = above @ rotations
    return position


def _about(axis: int, angle: Float) -> Float:
    """Rotations (T, 3, 3) by angles (T,) [rad] about coordinate axis 0, 1 or 2."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    out = np.zeros((len(angle), 3, 3))
    out[:, axis, axis] = 1.0
    out[:, i, i] = out[:, j, j] = np.cos(angle)
    out[:, i, j], out[:, j, i] = -np.sin(angle), np.sin(angle)
    return out
