"""A motion that cameras and a tracker both see, from exact truth: noise, strays, gaps, and clocks apart."""

from dataclasses import dataclass, field

import numpy as np

from common.arrays import Float
from common.geometry.transforms import (
    matrix_to_quaternion,
    matrix_to_rotation_vector,
    rigid,
    rotation_vector_to_matrix,
)
from common.messages import ObjectPose, ObjectSource, TrackerPose
from master.calibrate.tracker.fit import Placed

ZERO_NS = 7_000_000_000_000
MIDDLE = np.array([0.0, 0.0, 0.5])
CAMERA_SIGMA = np.array(
    [8e-4, 8e-4, 2e-3, *np.radians([0.5, 0.5, 0.3])]
)  # depth is the worst; half of it wanders
TRACKER_SIGMA = np.repeat([4e-4, np.radians(0.05)], 3)


@dataclass(frozen=True)
class Motion:
    """How somebody moved it, and how it was seen.

    Attributes:
        seed: Of all that is drawn.
        seconds: How long.
        rotations: How far it is turned about each of its axes, 1: some 60 degrees to both sides.
        way_m: How far it is carried to each side.
        pace: How fast, 1: to and fro in some two seconds.
        late_s: How much later the tracker's poses hold than they say.
        noise: 1 as cameras and Lighthouse have it.
        strays: Share of camera poses that are anywhere.
        lost_s: For how long of every six seconds the tracker is lost.
    """

    seed: int
    seconds: float = 20.0
    rotations: tuple[float, float, float] = (1.0, 1.0, 1.0)
    way_m: float = 0.12
    pace: float = 1.0
    late_s: float = 0.023
    noise: float = 1.0
    strays: float = 0.05
    lost_s: float = 0.7
    X: Float = field(init=False)
    Y: Float = field(init=False)

    def __post_init__(self) -> None:
        rng = np.random.default_rng([self.seed, 1])
        rotation, other = rotation_vector_to_matrix(2.0 * rng.normal(size=(2, 3)))
        object.__setattr__(self, "X", rigid(rotation, rng.normal(size=3)))
        object.__setattr__(self, "Y", rigid(other, 0.06 * rng.normal(size=3)))

    def truth(self, t_s: Float) -> tuple[Float, Float]:
        """Turns (T, 3, 3) and places (T, 3) of the object in the rig."""
        rng = np.random.default_rng([self.seed, 2])
        rate = self.pace * rng.uniform(0.15, 0.7, (6, 4))
        phase, size = rng.uniform(0.0, 2.0 * np.pi, (6, 4)), rng.uniform(0.3, 1.0, (6, 4))
        size /= size.sum(axis=1, keepdims=True)
        waves = (size * np.sin(2.0 * np.pi * rate * t_s[:, None, None] + phase)).sum(axis=-1)
        mean = rotation_vector_to_matrix(np.array([0.4, -2.1, 0.3]))
        rotated = mean @ rotation_vector_to_matrix(1.6 * np.array(self.rotations) * waves[:, 3:])
        return rotated, MIDDLE + 1.6 * self.way_m * waves[:, :3]

    def objects(self) -> list[ObjectPose]:
        """What cameras made of it, at 60 Hz, with honest covariances."""
        rng = np.random.default_rng([self.seed, 3])
        t_s = np.arange(0.0, self.seconds, 1.0 / 60.0)
        R, p = self.truth(t_s)
        white = rng.normal(size=(len(t_s), 6))
        slow = [
            np.convolve(one, np.ones(15) / np.sqrt(15.0), "same") for one in rng.normal(size=(6, len(t_s)))
        ]
        smooth = np.stack(slow, axis=1)
        off = self.noise * CAMERA_SIGMA * (white + smooth) / np.sqrt(2.0)
        astray = rng.random(len(t_s)) < self.strays
        off[astray] += rng.normal(size=(int(astray.sum()), 6)) * np.repeat([0.05, 1.0], 3)
        R, p = rotation_vector_to_matrix(off[:, 3:]) @ R, p + off[:, :3]
        cov = np.diag((max(self.noise, 1e-3) * CAMERA_SIGMA) ** 2)
        q = matrix_to_quaternion(R)
        return [
            ObjectPose("cube", ZERO_NS + round(1e9 * t), p[k], q[k], cov, 1e-3, ObjectSource.TAGS, True, 2, 2, False)
            for k, t in enumerate(t_s.tolist())
        ]  # fmt: skip

    def tracked(self) -> list[TrackerPose]:
        """What the tracker said, at 100 Hz, of half a second more on both sides; NaN where it was lost."""
        rng = np.random.default_rng([self.seed, 4])
        t_s = np.arange(-0.5, self.seconds + 0.5, 0.01) + 0.0041
        R, p = self.device(*self.truth(t_s))
        off = self.noise * TRACKER_SIGMA * rng.normal(size=(len(t_s), 6))
        q, p = matrix_to_quaternion(rotation_vector_to_matrix(off[:, 3:]) @ R), p + off[:, :3]
        lost = (t_s % 6.0) < self.lost_s
        q[lost], p[lost] = np.nan, np.nan
        return [
            TrackerPose("tracker", 1, k, ZERO_NS + round(1e9 * (t - self.late_s)), p[k], q[k])
            for k, t in enumerate(t_s.tolist())
        ]

    def device(self, R: Float, p: Float) -> tuple[Float, Float]:
        """Where the device is in its system's frame when the object is at (R, p) in the rig: inv(X) A Y."""
        back = np.linalg.inv(self.X)
        rotation = back[:3, :3] @ R @ self.Y[:3, :3]
        return rotation, (R @ self.Y[:3, 3] + p) @ back[:3, :3].T + back[:3, 3]


def errors_of(motion: Motion, placed: Placed, seed: int = 5) -> tuple[float, float]:
    """Root mean square by which the object's pose by the tracker misses the truth: place [mm], turn [deg].

    At poses that the motion never had: up to 12 cm from the middle, turned by up to some 60 degrees any way.
    """
    rng = np.random.default_rng(seed)
    way = rng.normal(size=(200, 3))
    R = rotation_vector_to_matrix(np.array([0.4, -2.1, 0.3])) @ rotation_vector_to_matrix(
        rng.uniform(0.0, 1.0, (200, 1)) * way / np.linalg.norm(way, axis=1, keepdims=True)
    )
    p = MIDDLE + rng.uniform(-0.12, 0.12, (200, 3))
    RB, pB = motion.device(R, p)
    X, Y = placed.T_rig_tracking, placed.T_object_tracker
    rotation = X[:3, :3] @ RB @ Y[:3, :3].T
    place = pB @ X[:3, :3].T + X[:3, 3] - rotation @ Y[:3, 3]
    off = np.linalg.norm(matrix_to_rotation_vector(rotation @ R.swapaxes(1, 2)), axis=1)
    far = np.linalg.norm(place - p, axis=1)
    return 1e3 * float(np.sqrt(np.mean(far**2))), float(np.degrees(np.sqrt(np.mean(off**2))))
