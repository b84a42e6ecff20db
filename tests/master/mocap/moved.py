"""A hand that never repeats itself, at any instant: the truth of the tests of motion capture."""

from pathlib import Path

import numpy as np

from common.arrays import Float, Int
from common.geometry.transforms import rotation_vector_to_matrix
from common.hand.model import JOINTS, HandJoints, HandModel
from common.hand.profiles import generated_profile
from common.messages import HandPose
from master.mocap.bvh_file import JointMotion, Side, Track
from tests.hand_helpers import palm
from tests.results import pose_of

RIGHT = HandModel.of(generated_profile("moved-right", "right"))
LEFT = HandModel.of(generated_profile("moved-left", "left"))
ROTATION = rotation_vector_to_matrix(np.array([0.9, -1.7, 0.4]))
SHIFT = np.array([1.0, -2.0, 0.3])


def angles_at(t_s: Float, dip_spread_rad: float = 0.0) -> Float:
    """Angles (T, 5, 4) [rad]: DIP = 0.7 PIP but for a slow wave of `dip_spread_rad` rms, MCP about 0.6 PIP."""
    rng = np.random.default_rng(3)
    wave = _waves(rng, t_s, (5, 4), 0.2, 0.9)
    angles = np.zeros((len(t_s), 5, 4))
    angles[..., 0] = 0.12 * wave[..., 0]
    angles[..., 2] = 0.9 + 0.8 * wave[..., 2]
    angles[..., 1] = 0.6 * angles[..., 2] + 0.15 * wave[..., 1]
    angles[..., 3] = 0.7 * angles[..., 2] + np.sqrt(2.0) * dip_spread_rad * np.sin(
        2.0 * np.pi * t_s[:, None] * np.array([0.31, 0.37, 0.41, 0.43, 0.47])
    )
    return angles


def hand_at(t_s: Float, model: HandModel = RIGHT, dip_spread_rad: float = 0.0) -> HandJoints:
    """The whole hand at instants (T,) [s]."""
    wave = _waves(np.random.default_rng(5), t_s, (6,), 0.1, 0.7)
    T = np.tile(np.eye(4), (len(t_s), 1, 1))
    T[:, :3, :3] = rotation_vector_to_matrix(0.8 * wave[:, :3])
    T[:, :3, 3] = [0.0, 0.0, 0.5] + 0.1 * wave[:, 3:]
    return model.forward(T, angles_at(t_s, dip_spread_rad))


def _waves(rng: np.random.Generator, t_s: Float, shape: tuple[int, ...], slow: float, fast: float) -> Float:
    """The mean of three sines each (T, *shape)."""
    hz, phase = rng.uniform(slow, fast, (*shape, 3)), rng.uniform(0.0, 2.0 * np.pi, (*shape, 3))
    t = t_s.reshape(-1, *np.ones(len(shape) + 1, np.int64))
    return np.sin(2.0 * np.pi * hz * t + phase).mean(axis=-1)


def ns(t_s: Float) -> Int:
    return np.round(1e9 * t_s).astype(np.int64)


def motion_of(
    joints_m: Float, t_s: Float, without: tuple[str, ...] = (), side: Side | None = None
) -> JointMotion:
    """Joints (T, 26, 3) as they are read of a file."""
    names = tuple(name for name in JOINTS if name not in without)
    columns = [JOINTS.index(name) for name in names]
    return JointMotion(ns(t_s), names, joints_m[:, columns], side, "moved.bvh")


def track_of(joints_m: Float, t_s: Float) -> Track:
    return Track(ns(t_s), joints_m)


def poses_of(t_s: Float, sigma_m: float, seed: int = 1, model: HandModel = RIGHT) -> list[HandPose]:
    """Poses whose joints err independently by `sigma_m` per axis, and say so."""
    hand, rng = hand_at(t_s, model), np.random.default_rng(seed)
    found = hand.position_m + rng.normal(0.0, sigma_m, hand.position_m.shape)
    markers = model.marker_points(hand, tuple(model.mounts))
    return [
        pose_of(
            model,
            HandJoints(found[k], hand.rotation[k], palm()),
            t_ns=int(ns(t_s)[k]),
            cov_m2=np.tile(sigma_m**2 * np.eye(3), (26, 1, 1)),
            markers_m=markers[k],
        )
        for k in range(len(t_s))
    ]


def write_table(path: Path, t_s: Float, names: tuple[str, ...], position_m: Float) -> Path:
    """A plain table in millimetres, its columns in no order; what is not seen is empty."""
    columns = [(k, axis) for axis in (1, 2, 0) for k in reversed(range(len(names)))]
    header = ["time", *(f"{names[k]}_{'xyz'[axis]}_mm" for k, axis in columns)]
    lines = [",".join(header)]
    for row, t in enumerate(t_s):
        values = [1e3 * position_m[row, k, axis] for k, axis in columns]
        lines.append(",".join([f"{t:.9f}", *("" if np.isnan(value) else f"{value:.6f}" for value in values)]))
    path.write_text("\n".join(lines) + "\n")
    return path
