"""A simulated hand moves as people do: guided routine, Leap recordings.

`HandRoutine` follows the guided routine late, at its own tempo, and never holds a joint quite still. The palm rests
on something and faces the cameras, so that the finger tips are seen however the fingers bend.

`LeapMotion` follows the recordings leapjs/*.npz of the data folder. They hold `t` (T,) [s] and, of the first hand,
joints (T, 21, 3) [m] (slot 0 the wrist, unknown; then thumb base, MCP, IP, tip and index ... little MCP, PIP, DIP,
tip), palm centre, palm normal (out of the palm) and direction. Leap axes: x right, y up from the device, z to the
user, so a camera looking down has x = x, y = z, z = -y. Palm pose and joint angles are played by our own hand, within
its limits; bones are ours.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from common.arrays import Float
from common.errors import RecordingError
from common.geometry.transforms import (
    axis_rotation,
    matrix_to_quaternion,
    quaternion_to_matrix,
    rotation_vector_to_matrix,
)
from common.hand.model import CHAINS, HandModel
from common.hand.routine import MOVES, ROUTINE_S, STEPS, posture_at
from common.recording.recorded_files import read_npz
from common.sim.motion import PALM_TO_CAMERAS, DriftingMotion, HandState, angles_of, palm_pose, smooth_step

REACTION_S, TAIL_S = 1.0, 0.8
PERIOD_S = REACTION_S + ROUTINE_S + TAIL_S
LATE_S = (0.05, 0.45)  # by how much a step is begun late, least and most
REST = 0.1  # share of the drift of a hand in the air that is left when the palm rests on something


class HandRoutine(DriftingMotion):
    """One pass through the guided routine.

    `rest` is the share of the drift of a hand held in the air that the palm keeps.
    """

    period_s = PERIOD_S

    def __init__(self, model: HandModel, centre_m: Float, seed: int, rest: float = REST) -> None:
        rng = np.random.default_rng([seed, 5])
        super().__init__(model, centre_m, rng)
        self._rest = rest
        starts = [next(m.start_s for m in MOVES if m.step == k) for k in range(len(STEPS))]
        late = rng.uniform(*LATE_S, len(STEPS))
        self._script_s = np.array([*starts, ROUTINE_S])
        self._done_s = REACTION_S + np.array([*(starts + late), ROUTINE_S + LATE_S[1]])

    def script_s(self, t_s: float) -> float:
        """Where in the routine [s] the hand is at time `t_s` [s]."""
        return float(np.interp(t_s, self._done_s, self._script_s))

    def _moved(self, t: float, wobble: Float, shift: Float, rotation: Float) -> HandState:
        angles = angles_of(self._model, posture_at(self.script_s(t)), wobble)
        tilt_deg = 15.0  # of the fingers towards the cameras
        shown = axis_rotation(0, np.radians(tilt_deg)) @ PALM_TO_CAMERAS
        rotated = rotation_vector_to_matrix(self._rest * rotation) @ shown
        return HandState(palm_pose(self._model, self._centre + self._rest * shift, rotated), angles)


KEYS = ("t", "hand0_joints", "hand0_palm", "hand0_normal", "hand0_direction", "hand0_type")
RIG_FROM_LEAP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
GRID_S = 0.02  # raw samples jitter; this is as fine as a hand moves
REACH_M = np.array([0.13, 0.08, 0.10])


@dataclass(frozen=True, slots=True, eq=False)
class LeapMotion:
    """Recorded motion on an even grid, a loop of cubic Hermite curves (C1).

    Attributes:
        centre_m: (3,) [m] middle of the volume, rig frame.
        position_m: (N, 3) middle of the flat hand [m] around 0, rig axes.
        quaternion: (N, 4) wxyz; angles_rad: (N, 5, 4).
    """

    model: HandModel
    centre_m: Float
    position_m: Float
    quaternion: Float
    angles_rad: Float

    @property
    def period_s(self) -> float:
        """Length of the loop [s]."""
        return len(self.position_m) * GRID_S

    def at(self, t_s: float) -> HandState:
        """The hand at time `t_s` [s]; before 0 the pose of 0."""
        place = (max(t_s, 0.0) % self.period_s) / GRID_S
        angles = self.model.clamp(_hermite(self.angles_rad, place))
        rotation = quaternion_to_matrix(_hermite(self.quaternion, place))
        middle = self.centre_m + _hermite(self.position_m, place)
        return HandState(palm_pose(self.model, middle, rotation), angles)


def load_leap(path: Path, model: HandModel, centre_m: Float) -> LeapMotion:
    """Read one recording as a motion of `model` about `centre_m` (3,) [m].

    A hand of the other side is mirrored.

    Raises:
        RecordingError: The file is missing, or lacks a key or a sample that is needed.
    """
    if not path.exists():
        raise RecordingError(
            f"{path}: no such recording; set PHALANX_DATASETS to the data folder (its leapjs/*.npz are needed)"
        )
    data = read_npz(path, KEYS, f"not a Leap recording with {', '.join(KEYS)}")
    t, joints, palm, normal, direction = (np.asarray(data[key], dtype=np.float64) for key in KEYS[:5])
    known = np.isfinite(joints[:, 1:]).all(axis=(1, 2)) & np.isfinite(palm).all(axis=1)
    if known.sum() < 4:
        raise RecordingError(f"{path}: fewer than four samples with a whole hand")
    t = t[known]
    mirror = np.array([1.0 if str(data["hand0_type"]) == model.profile.side else -1.0, 1.0, 1.0])
    joints, palm, normal, direction = (
        (vectors[known] * mirror) @ RIG_FROM_LEAP.T for vectors in (joints, palm, normal, direction)
    )
    rotation = palm_rotation(normal, direction)
    angles = joint_angles(model, joints, rotation)
    place = REACH_M * np.tanh((palm - np.median(palm, axis=0)) / REACH_M)  # held inside the volume
    even = np.arange(t[0], t[-1], GRID_S)
    quaternion = _continuous(matrix_to_quaternion(rotation))
    place, quaternion, flat = (
        _close(_resample(even, t, values)) for values in (place, quaternion, angles.reshape(-1, 20))
    )
    return LeapMotion(
        model,
        np.asarray(centre_m, dtype=np.float64),
        place,
        quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True),
        flat.reshape(-1, 5, 4),
    )


def palm_rotation(normal: Float, direction: Float) -> Float:
    """Palm frames (y = -normal, z near the direction) of normals, directions (T, 3)."""
    y = -normal / np.linalg.norm(normal, axis=1, keepdims=True)
    z = direction - (direction * y).sum(axis=1, keepdims=True) * y
    z = z / np.linalg.norm(z, axis=1, keepdims=True)
    x: Float = np.asarray(np.cross(y, z), dtype=np.float64)
    return np.stack([x, y, z], axis=2)


def joint_angles(model: HandModel, joints: Float, rotation: Float) -> Float:
    """Joint angles (T, 5, 4) [rad] of joints (T, 21, 3) and palm frames (T, 3, 3).

    A finger's first bone is R_y(s abduction) R_rest R_x(-flexion) (-z): azimuth and elevation in the palm.
    The thumb's bone is read in its own rest frame.
    """
    chain = joints[:, 1:].reshape(-1, 5, 4, 3)
    bone = np.diff(chain, axis=2)
    bone = bone / np.linalg.norm(bone, axis=-1, keepdims=True)
    local = np.einsum("tij,tfki->tfkj", rotation, bone)
    rest = model.rest_rotation[CHAINS[:, 0]]
    angles = np.empty((len(joints), 5, 4))
    ahead = -rest[1:, :, 2]
    x, y, z = np.moveaxis(local[:, 1:, 0], -1, 0)
    spread = np.arctan2(x, z) - np.arctan2(ahead[:, 0], ahead[:, 2])
    level = np.clip(np.hypot(x, z) / 0.6, 0.0, 1.0)  # a finger that points down has no azimuth
    angles[:, 1:, 0] = model.side_sign * spread * level
    angles[:, 1:, 1] = np.arctan2(-y, np.hypot(x, z)) - np.arcsin(-ahead[:, 1])
    thumb = np.einsum("ji,tj->ti", rest[0], local[:, 0, 0])
    angles[:, 0, 0] = -model.side_sign * np.arctan2(thumb[:, 0], -thumb[:, 2])
    angles[:, 0, 1] = np.arctan2(-thumb[:, 1], np.hypot(thumb[:, 0], thumb[:, 2]))
    for k in (1, 2):
        angles[:, :, 1 + k] = np.arccos(
            np.clip((local[:, :, k] * local[:, :, k - 1]).sum(axis=-1), -1.0, 1.0)
        )
    return model.clamp(angles)


def _continuous(quaternion: Float) -> Float:
    """Signs such that no step is longer than a quarter turn of the four-sphere."""
    flips = np.where((quaternion[1:] * quaternion[:-1]).sum(axis=1) < 0.0, -1.0, 1.0)
    return quaternion * np.concatenate([[1.0], np.cumprod(flips)])[:, None]


def _resample(even: Float, t: Float, values: Float) -> Float:
    """Values (N, K) on the even grid, lightly smoothed (1 2 3 2 1)."""
    columns: list[Float] = [np.interp(even, t, column) for column in values.T]
    resampled = np.stack(columns, axis=1)
    padded = np.pad(resampled, ((2, 2), (0, 0)), mode="edge")
    smooth = np.zeros((len(even), values.shape[1]))
    for k, weight in enumerate((1, 2, 3, 2, 1)):
        smooth += weight / 9.0 * padded[k : k + len(even)]
    return smooth


def _close(values: Float) -> Float:
    """The samples with a smooth way from the last back to the first."""
    return_s = 1.0  # from the last pose smoothly back to the first
    steps = round(return_s / GRID_S)
    share = np.array([smooth_step((k + 1) / (steps + 1)) for k in range(steps)])[:, None]
    first = values[0]
    if values.shape[1] == 4 and float(first @ values[-1]) < 0.0:
        first = -first
    return np.concatenate([values, values[-1] + share * (first - values[-1])])


def _hermite(values: Float, place: float) -> Float:
    """Interpolate periodic samples (N, ...) at an index (Catmull & Rom, 1974)."""
    n = len(values)
    k = int(place) % n
    s = place - int(place)
    before, a, b, after = (values[(k + j) % n] for j in (-1, 0, 1, 2))
    return 0.5 * (
        2.0 * a
        + (b - before) * s
        + (2.0 * before - 5.0 * a + 4.0 * b - after) * s**2
        + (3.0 * a - before - 3.0 * b + after) * s**3
    )
