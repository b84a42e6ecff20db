"""BVH export of a hand.

Blender, Maya, MotionBuilder and most tools of motion capture read BVH. The rest pose is that of the hand
profile, in the palm frame: fingers along +z, the back of the hand up (+y), so every channel is zero at rest.
A joint turns by its three rotation channels, about z, then its own x, then its own y:

    R = R_z R_x R_y        R_joint(rig) = up . product of R from the wrist on . R_joint(at rest)

A joint that stands elsewhere than its bone states by more than 10 um in any frame has three position channels
as well; they hold its whole offset from its parent, in place of OFFSET, as readers take them.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Literal

import numpy as np

from common.arrays import Float
from common.calibration.files import replacing
from common.geometry.transforms import quaternion_to_matrix
from common.hand.model import JOINTS, WRIST
from master.recording.export.motion import (
    CHILDREN,
    ORDER,
    PARENT,
    Motion,
    Skeleton,
    back,
    rotate,
    times,
)

Up = Literal["y", "rig"]
Unit = Literal["m", "cm", "mm"]
PER_METRE: dict[Unit, float] = {"m": 1.0, "cm": 100.0, "mm": 1000.0}

RIGID_M = 1e-5
_ROWS = 256


@dataclass(frozen=True, slots=True)
class Axes:
    """How places are written.

    Attributes:
        up: y: the rig frame turned by half a turn about its x, so that y is up in the picture of the reference camera
            and z comes out of it; rig: the rig frame as it is, y down and z ahead.
    """

    unit: Unit = "cm"
    up: Up = "y"


def upright(motion: Motion, up: Up) -> Motion:
    """A motion in the rig frame, in that of the file."""
    if up == "rig":
        return motion
    half_turn_about_x = np.array([0.0, 1.0, 0.0, 0.0])
    return replace(
        motion,
        position_m=motion.position_m * np.array([1.0, -1.0, -1.0]),
        orientation_wxyz=times(half_turn_about_x, motion.orientation_wxyz),
    )


def write_bvh(
    path: Path,
    motion: Motion,
    skeleton: Skeleton,
    rate_hz: float,
    axes: Axes,
    progress: Callable[[int, int], None] = lambda _done, _total: None,
) -> tuple[int, ...]:
    """Write a motion at a constant rate, rig frame.

    Returns:
        The joints, without the wrist, that have position channels because their bone is not rigid.

    Raises:
        OSError: It cannot be written; nothing half written is left.
    """
    rotated, offset = _channels(upright(motion, axes.up), skeleton)
    rest = _rest_offsets(skeleton)
    free = tuple(
        joint for joint in PARENT if float(np.abs(offset[:, joint] - rest[joint]).max(initial=0.0)) > RIGID_M
    )
    scale = PER_METRE[axes.unit]
    with replacing(path) as file:
        ends = {joint: skeleton.ahead_m(joint) * scale for joint in ORDER if not CHILDREN[joint]}
        head = ["HIERARCHY", *_hierarchy(WRIST, rest * scale, ends, free, 0)]
        head += ["MOTION", f"Frames: {len(motion)}", f"Frame Time: {1.0 / rate_hz:.9f}"]
        file.write(("\n".join(head) + "\n").encode())
        _frames(file, rotated, offset * scale, free, progress)
    return free


def _rest_offsets(skeleton: Skeleton) -> Float:
    """Offset of each joint from its parent at rest (26, 3) [m]; the wrist's is zero."""
    out = np.zeros((26, 3))
    for joint, parent in PARENT.items():
        out[joint] = skeleton.position_m[joint] - skeleton.position_m[parent]
    return out


def _channels(motion: Motion, skeleton: Skeleton) -> tuple[Float, Float]:
    """Rotation from rest (T, 26, 4) and offset (T, 26, 3) [m] of joints to parents."""
    from_rest = times(motion.orientation_wxyz, back(skeleton.orientation_wxyz))
    rotated, offset = from_rest.copy(), motion.position_m.copy()
    for joint, parent in PARENT.items():
        q = back(from_rest[:, parent])
        rotated[:, joint] = times(q, from_rest[:, joint])
        offset[:, joint] = rotate(q, motion.position_m[:, joint] - motion.position_m[:, parent])
    return rotated, offset


def _hierarchy(
    joint: int, rest: Float, ends: dict[int, Float], free: tuple[int, ...], depth: int
) -> list[str]:
    """Lines of a joint and its descendants; `rest`, `ends` in the file's unit."""
    tab, inner = "\t" * depth, "\t" * (depth + 1)
    moves = joint == WRIST or joint in free
    channels = ["Xposition", "Yposition", "Zposition"] if moves else []
    channels += ["Zrotation", "Xrotation", "Yrotation"]
    lines = [f"{tab}{'JOINT' if depth else 'ROOT'} {JOINTS[joint]}", f"{tab}{{"]
    lines += [
        f"{inner}OFFSET {_numbers(rest[joint])}",
        f"{inner}CHANNELS {len(channels)} {' '.join(channels)}",
    ]
    for child in CHILDREN[joint]:
        lines += _hierarchy(child, rest, ends, free, depth + 1)
    if joint in ends:
        lines += [f"{inner}End Site", f"{inner}{{", f"{inner}\tOFFSET {_numbers(ends[joint])}", f"{inner}}}"]
    return [*lines, f"{tab}}}"]


def _numbers(values: Float) -> str:
    return " ".join(f"{value + 0.0:.6f}" for value in values)


def _frames(
    file: IO[bytes],
    rotated: Float,
    offset: Float,
    free: tuple[int, ...],
    progress: Callable[[int, int], None],
) -> None:
    """A line a frame: the channels of the joints in the order of the hierarchy."""
    columns: list[Float] = []
    for joint in ORDER:
        if joint == WRIST or joint in free:
            columns.append(offset[:, joint])
        columns.append(euler_zxy_deg(quaternion_to_matrix(rotated[:, joint])))
    rows = np.concatenate(columns, axis=1) + 0.0  # -0 is written as 0
    for start in range(0, len(rows), _ROWS):
        np.savetxt(file, rows[start : start + _ROWS], fmt="%.6f")
        progress(min(start + _ROWS, len(rows)), len(rows))


def euler_zxy_deg(rotation: Float) -> Float:
    """Euler angles (T, 3) [deg] about z, x, y of rotations R = R_z R_x R_y (T, 3, 3).

    They have no jumps of a whole turn. Where x is turned by a right angle, z and y are one axis, and y is
    taken as zero.
    """
    sine = np.clip(rotation[:, 2, 1], -1.0, 1.0)
    level = 1.0 - np.abs(sine) > 1e-12
    z = np.where(
        level,
        np.arctan2(-rotation[:, 0, 1], rotation[:, 1, 1]),
        np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0]),
    )
    y = np.where(level, np.arctan2(-rotation[:, 2, 0], rotation[:, 2, 2]), 0.0)
    return np.degrees(np.stack([np.unwrap(z), np.arcsin(sine), np.unwrap(y)], axis=1))
