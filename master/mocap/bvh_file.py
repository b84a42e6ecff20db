"""Read and write hands as joint rotations of BVH.

Readers of single formats give a `PointTable`, every point of the file in the file's own names and unit; `read_motion`
(master/mocap/read.py) makes a `JointMotion` of it, joints and markers of one hand in metres. A `Track` is points that
two programs both report, resampled.

BVH is a tree of joints with offsets, and the rotations of every frame:

    R_joint = R_parent . product of its rotation channels, in their order      p_joint = p_parent + R_parent .
    offset

(Meredith & Maddock, "Motion capture file formats explained", 2001). Position channels of a joint hold its whole
offset, as Blender and most readers take them. The end of a chain is the point `PARENT_end`; one that lies on its
parent is none. BVH has no unit, and no word for what was not seen.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from common.arrays import Bool, Float, Int
from common.errors import RecordingError
from common.hand.model import JOINTS

Unit = Literal["m", "dm", "cm", "mm", "in"]
Side = Literal["left", "right"]
METRES: dict[Unit, float] = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "in": 0.0254}
MARKERS = ("thumb", "index", "middle", "ring", "little", "back", "back2", "back3")
POINTS = (*JOINTS, *MARKERS)
MAX_BYTES = 1 << 30


@dataclass(frozen=True, slots=True, eq=False)
class PointTable:
    """All points of a file, as they stand in it.

    Attributes:
        names: (N,) as the file spells them.
        t_s: (T,) [s], rising.
        position: (T, N, 3) in `unit`; NaN: not seen.
        unit: Of length; None: the file does not state it.
        ends: Those of `names` that are end sites, the end of a bone and no joint.
    """

    names: tuple[str, ...]
    t_s: Float
    position: Float
    unit: Unit | None
    ends: frozenset[str] = frozenset()


@dataclass(frozen=True, slots=True, eq=False)
class JointMotion:
    """Joints and markers of one hand.

    Attributes:
        t_ns: (T,) [ns], rising, on the clock of the file.
        names: (J,) each a WebXR joint, `palm`, or a marker of ours (`MARKERS`).
        position_m: (T, J, 3) [m], frame of the file; NaN: not seen.
        side: That the names state; None: they do not.
        source: The file.
        remarks: What was assumed, for a person.
    """

    t_ns: Int
    names: tuple[str, ...]
    position_m: Float
    side: Side | None
    source: str
    remarks: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.t_ns)

    def of(self, name: str) -> Float:
        """Positions (T, 3) [m] of a joint or marker; NaN throughout where there is none."""
        if name not in self.names:
            return np.full((len(self), 3), np.nan)
        return self.position_m[:, self.names.index(name)]


def checked_times(t_s: Float, where: str) -> Int:
    """Times [ns] of rows at (T,) [s].

    Raises:
        RecordingError: They are not finite, do not rise, or are none of seconds.
    """
    if not len(t_s):
        raise RecordingError(f"{where}: has no frame")
    max_s = 9e9  # beyond it no integer of nanoseconds has room
    if not np.isfinite(t_s).all() or np.abs(t_s).max() > max_s:
        row = int(np.argmax(~np.isfinite(t_s) | (np.abs(t_s) > max_s)))
        raise RecordingError(f"{where}: time of frame {row + 1} is {t_s[row]}: no seconds")
    t_ns = np.round(t_s * 1e9).astype(np.int64)
    steps = np.diff(t_ns)
    if (steps <= 0).any():
        row = int(np.argmax(steps <= 0))
        raise RecordingError(
            f"{where}: time goes from {t_s[row]:.9g} s at frame {row + 1} to {t_s[row + 1]:.9g} s: it must rise"
        )
    if len(steps) and float(np.median(steps)) > 0.5e9:
        raise RecordingError(
            f"{where}: frames are {np.median(steps) * 1e-9:.3g} s apart: are times not in seconds? name the column"
            " t_ms, t_us or t_ns"
        )
    return t_ns


def known(position_m: Float) -> Bool:
    """Whether points (..., 3) are known, (...)."""
    return np.asarray(np.isfinite(position_m).all(axis=-1), np.bool_)


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """Positions (T, J, 3) [m] of named points at T rising times [ns]; NaN: not known."""

    t_ns: Int
    position_m: Float

    @property
    def gap_ns(self) -> int:
        """Frames farther apart have nothing between them: 1.5 frames, 25 to 100 ms."""
        typical = float(np.median(np.diff(self.t_ns))) if len(self.t_ns) > 1 else 0.0
        most_gap_ns, gap_frames = 100_000_000, 1.5
        return int(min(max(25_000_000, gap_frames * typical), most_gap_ns))

    def at(self, t_ns: Int) -> Float:
        """Interpolate positions (N, J, 3) [m] at times (N,), linearly.

        NaN before the first frame, after the last, in a gap, and where one of the two frames does not know
        the point.
        """
        if len(self.t_ns) < 2:
            return np.full((len(t_ns), *self.position_m.shape[1:]), np.nan)
        after = np.clip(np.searchsorted(self.t_ns, t_ns), 1, len(self.t_ns) - 1)
        before = after - 1
        span = self.t_ns[after] - self.t_ns[before]
        share = (t_ns - self.t_ns[before]) / span
        between = (share >= 0.0) & (share <= 1.0) & (span <= self.gap_ns)
        share = np.where(between, share, np.nan)[:, None, None]
        first, second = self.position_m[before], self.position_m[after]
        # On a frame itself the other one does not matter.
        middle = first + share * (second - first)
        return np.where(share == 0.0, first, np.where(share == 1.0, second, middle))

    def velocity(self, t_ns: Int, half_ns: int) -> Float:
        """Velocities (N, J, 3) [m/s] by the difference over twice `half_ns`."""
        return (self.at(t_ns + half_ns) - self.at(t_ns - half_ns)) / (2e-9 * half_ns)


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
