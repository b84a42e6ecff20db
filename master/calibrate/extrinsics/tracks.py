"""The measurement model predicts tracks of rig and IMU, and lines of sight.

Cameras, IMU and marker rig have no epochs in common, and the difference of their clocks is unknown. So
markers and orientations are queried at times that shift while the fit goes on: each answer comes with its
derivatives.

Laser points and tips of four fingers are those that the master solves fingers with
(`master.calibrate.laser_intersection`, `common.hand.model`), so that what is fitted is what will be used.
Beside palm pose and angles two numbers of each finger are unknown, which a mounting must not absorb: how
thick its skin is, and where on the pulp its tip is seen.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace

import numpy as np

from common.arrays import Bool, Float, Int
from common.geometry.transforms import quaternion_to_matrix, rotation_vector_to_matrix
from common.hand.model import WRIST, Fingertips, HandModel
from common.hand.skin import PalmarSurface
from common.messages import HandPose, ImuSample
from master.calibrate.laser_intersection import LaserIntersection
from master.calibrate.observations import between, turned
from master.estimator.sensors import PlaneAxes
from master.rig.setup import WristSetup

_EYE = np.eye(3)


@dataclass(frozen=True, slots=True, eq=False)
class Markers:
    """Markers at times (T)."""

    points_m: Float  # (T, M, 3) cap centroids, rig frame; NaN: not seen, or a gap nearby
    speed_m_s: Float  # this and acceleration_m_s2: (T, M, 3) first and second derivative
    acceleration_m_s2: Float
    cov_m2: Float  # (T, M, 3, 3)

    @property
    def seen(self) -> Bool:
        """(T, M)."""
        return np.isfinite(self.points_m[..., 0]) & np.isfinite(self.cov_m2[..., 0, 0])


@dataclass(frozen=True, slots=True, eq=False)
class HandTrack:
    """Track of the hand as the marker rig alone saw it (N epochs)."""

    t_s: Float  # (N,) [s], rising
    points_m: Float  # this and cov_m2: (N, M, 3), (N, M, 3, 3) markers as measured, rig frame
    cov_m2: Float
    T_rig_palm: Float  # (N, 4, 4)
    angles_rad: Float  # (N, 5, 4)

    @classmethod
    def of(cls, poses: Sequence[HandPose], model: HandModel, zero_ns: int) -> "HandTrack":
        """The track of the valid poses of the markers' pipeline; times from `zero_ns`."""
        known = [pose for pose in poses if pose.valid[WRIST] and np.isfinite(pose.angles_rad).all()]
        cov = np.array([pose.markers_cov_m2 for pose in known])
        poor_m = 0.03  # a cap of which so little is seen that its place is off by as much as this
        poor = ~(np.einsum("tmii->tm", cov) < poor_m**2)
        points = np.where(poor[..., None], np.nan, np.array([pose.markers_raw_m for pose in known]))
        T = np.tile(np.eye(4), (len(known), 1, 1))
        integrated = np.array([pose.orientation_wxyz[WRIST] for pose in known]).reshape(-1, 4)
        T[:, :3, :3] = quaternion_to_matrix(integrated) @ model.rest_rotation[WRIST].T
        place = np.array([pose.position_m[WRIST] for pose in known]).reshape(-1, 3)
        T[:, :3, 3] = place - T[:, :3, :3] @ model.rest_position_m[WRIST]
        return cls(
            np.array([1e-9 * (pose.t_ns - zero_ns) for pose in known]),
            points,
            np.where(poor[..., None, None], np.nan, cov),
            T,
            np.array([pose.angles_rad for pose in known]),
        )

    def nearest(self, t_s: Float) -> Int:
        """Indices (T,) of the epochs nearest to times (T,) [s]."""
        after = np.clip(np.searchsorted(self.t_s, t_s), 1, len(self.t_s) - 1)
        return after - (t_s - self.t_s[after - 1] < self.t_s[after] - t_s)

    def markers(self, t_s: Float) -> Markers:
        """The markers at times (T,) [s], by a cubic through what was seen within 80 ms.

        One through four neighbours would pass on their noise to the speed, and both to the clock's error:
        cycles are often taken at the same share of the time between two frames.
        """
        near = self.nearest(t_s)
        support = 10  # frames to either side
        rows = np.clip(near[:, None] + np.arange(-support, support + 1), 0, len(self.t_s) - 1)
        near_s = 0.08  # of an epoch: fingers move smoothly for twice as long
        off = (self.t_s[rows] - t_s[:, None]) / near_s  # (T, K)
        points, cov = self.points_m[rows], self.cov_m2[rows]  # (T, K, M, 3), (T, K, M, 3, 3)
        within = (np.abs(off) < 1.0) & np.diff(rows, axis=1, prepend=-1).astype(np.bool_)
        seen = within[..., None] & np.isfinite(points[..., 0]) & np.isfinite(cov[..., 0, 0])
        variance = np.einsum("tkmii->tkm", np.where(seen[..., None, None], cov, _EYE))
        weight = np.where(seen, 1.0 / variance, 0.0)
        terms, neighbours = 4, 2  # of a cubic; frames to each side that it needs
        power = off[..., None] ** np.arange(terms)
        normal = np.einsum("tkm,tki,tkj->tmij", weight, power, power)
        pull = np.einsum("tkm,tki,tkmd->tmid", weight, power, np.where(seen[..., None], points, 0.0))
        before, after = ((seen & side[..., None]).sum(axis=1) for side in (off <= 0.0, off >= 0.0))
        valid = (before >= neighbours) & (after >= neighbours) & np.isfinite(self.cov_m2[near][..., 0, 0])
        solvable = np.where(valid[..., None, None], normal, np.eye(terms))
        taylor = np.asarray(np.linalg.solve(solvable, pull), np.float64)
        taylor[~valid] = np.nan
        speed, acceleration = taylor[:, :, 1] / near_s, 2.0 * taylor[:, :, 2] / near_s**2
        return Markers(taylor[:, :, 0], speed, acceleration, self.cov_m2[near])


@dataclass(frozen=True, slots=True, eq=False)
class ImuOrientations:
    """Orientations of the IMU at times (T), in a world of its own."""

    R_world_imu: Float  # (T, 3, 3); NaN: no sample nearby
    rate_rad_s: Float  # (T, 3) IMU axes
    drift: Float  # (T, 3, 12) error of its rotation since the middle, world axes, by errors of the gyroscope

    @property
    def known(self) -> Bool:
        """(T,)."""
        return np.isfinite(self.R_world_imu[:, 0, 0])


class ImuTrack:
    """Rotation of one IMU (S samples): its rates integrated. Fixed once constructed.

    The orientation that comes with the samples leans by some degrees whenever the arm is accelerated, since
    gravity holds it; for ten seconds rates alone are better, once their errors are known. The two worlds
    agree in the middle. Errors (12,) of a gyroscope are its zero (3) [rad/s] and its gain (3, 3), by row:
    what it reads is too much by zero + gain @ what it reads. `t_s` (S,) are the stamps [s], `gap_s` the
    longest time between two samples.
    """

    def __init__(self, samples: Sequence[ImuSample], zero_ns: int) -> None:
        """Keep the samples with rates and an orientation; times count from `zero_ns`."""
        valid = [one for one in samples if np.isfinite([*one.orientation_wxyz, *one.gyro_rad_s]).all()]
        times = np.array([1e-9 * (one.t_ns - zero_ns) for one in valid])
        rising = np.diff(times, prepend=-np.inf) > 0.0
        self.t_s = times[rising]
        self._rate = np.array([one.gyro_rad_s for one in valid]).reshape(-1, 3)[rising]
        held = np.array([one.orientation_wxyz for one in valid]).reshape(-1, 4)[rising]
        self._held = quaternion_to_matrix(held)
        step = np.diff(self.t_s)[:, None]
        self.gap_s = float(step.max(initial=0.0))
        self._integrated, self._drift = np.empty_like(self._held), np.zeros((len(self.t_s), 3, 12))
        if len(valid):
            self._sum_up()

    def mended(self, errors: Float) -> "ImuTrack":
        """The same without errors (12,) of its gyroscope."""
        out = copy(self)
        out._rate = self._rate - errors[:3] - self._rate @ errors[3:].reshape(3, 3).T
        out._integrated = np.empty_like(self._integrated)
        out._sum_up()
        return out

    def _sum_up(self) -> None:
        """Orientations by rates alone, and their derivatives by errors of the rates.

        A rate is the mean over the time that ends at its stamp.
        """
        step_s = np.diff(self.t_s)[:, None]
        arcs = rotation_vector_to_matrix(step_s * self._rate[1:])
        now = np.eye(3)
        for k, arc in enumerate([np.eye(3), *arcs]):
            self._integrated[k] = now = now @ arc
        middle = len(self.t_s) // 2
        self._integrated = self._held[middle] @ self._integrated[middle].T @ self._integrated
        integrated = 0.5 * (self._integrated[1:] + self._integrated[:-1])
        by_gain = integrated[..., None] * self._rate[1:, None, None]  # axis, row and column of the gain
        mean = step_s[..., None] * np.concatenate([integrated, by_gain.reshape(-1, 3, 9)], axis=-1)
        drift = np.concatenate([np.zeros((1, 3, 12)), np.cumsum(mean, axis=0)])
        self._drift = drift - drift[middle]

    def __len__(self) -> int:
        return len(self.t_s)

    def at(self, t_s: Float) -> ImuOrientations:
        """The IMU at times (T,) [s] of its stamps, by its rates."""
        after, share, known = between(self.t_s, t_s)
        R = turned(self._integrated, after, share)
        drift = (1.0 - share)[..., None] * self._drift[after - 1] + share[..., None] * self._drift[after]
        R[~known] = np.nan
        return ImuOrientations(R, self._rate[after], drift)

    def held_at(self, t_s: Float) -> Float:
        """The samples' own orientations (T, 3, 3), IMU -> z-up world; NaN: none nearby."""
        after, share, known = between(self.t_s, t_s)
        R = turned(self._held, after, share)
        R[~known] = np.nan
        return R


FINGERS = slice(1, 5)
SEEN = 4  # numbers of a finger: laser point across and along [m], tip [px]
_ROTATION_STEP, _SHIFT_M, _THICK = np.radians(0.2), 2e-4, 0.01  # steps of differences
_STEPS = np.repeat([_ROTATION_STEP, _SHIFT_M, _ROTATION_STEP, _THICK], (3, 3, 4, 1))


class LinesOfSight:
    """Measurement model for one device and one hand."""

    def __init__(self, setup: WristSetup) -> None:
        self._setup, self._surface, self.axes = setup, PalmarSurface.of(setup.model), PlaneAxes.of(setup)
        self._intersection, self._tips = LaserIntersection(setup, rays=16), Fingertips.of(setup.model)

    def __call__(self, R: Float, shift_m: Float, angles: Float, thick: Float, reach_m: Float) -> Float:
        """What is seen (T, 4, SEEN); NaN where the laser misses.

        Args:
            R: (T, 3, 3) palm axes -> camera axes.
            shift_m: (3,) the wrist joint, camera frame.
            angles: (T, 5, 4) [rad].
            thick: (4,) natural logarithms of the factors of thickness.
            reach_m: (4,) how far tips are seen beyond where the hand file has them, along the last bone.
        """
        local = self._local(angles, thick, reach_m)
        return self._seen([self._placed_at(R, shift_m, *local)])[0]

    def derivatives(
        self, R: Float, shift_m: Float, angles: Float, thick: Float, reach_m: Float
    ) -> tuple[Float, Float]:
        """What is seen (T, 4, SEEN), and its derivatives (T, 4, SEEN, 12); 0: not known.

        By rotation (3, camera axes, about the wrist joint) and shift (3) of the palm, the finger's own four
        angles, its thickness and reach.
        """
        surface, radius, _ = local = self._local(angles, thick, reach_m)
        all_of = [self._placed_at(R, shift_m, *local)]
        for k in range(3):
            rotation = rotation_vector_to_matrix(_ROTATION_STEP * np.eye(3)[k])
            all_of.append(self._placed_at(rotation @ R, shift_m, *local))
        for k in range(3):
            all_of.append(self._placed_at(R, shift_m + _SHIFT_M * np.eye(3)[k], *local))
        for k in range(4):
            stepped = self._local(angles + _ROTATION_STEP * np.eye(4)[k], thick, reach_m)
            all_of.append(self._placed_at(R, shift_m, *stepped))
        all_of.append(self._placed_at(R, shift_m, *self._local(angles, thick + _THICK, reach_m)))
        seen = self._seen(all_of)
        out = np.zeros((*seen.shape[1:], len(_STEPS) + 1))
        out[..., :-1] = np.moveaxis(seen[1:] - seen[0], 0, -1) / _STEPS
        beyond = self._local(angles, thick, reach_m + _SHIFT_M)[2]
        farther = self._setup.optics.project(self._placed_at(R, shift_m, surface, radius, beyond)[2])
        out[..., 2:, -1] = (farther - seen[0][..., 2:]) / _SHIFT_M
        return seen[0], np.nan_to_num(out)

    def _local(self, angles: Float, thick: Float, reach_m: Float) -> tuple[Float, Float, Float]:
        """Spheres (T, 4, K, 3), radii (4, K) and tips (T, 4, 3) [m] in the palm frame."""
        chains = self._setup.model.chains(angles)
        factor = np.ones((5, 1))
        factor[FINGERS, 0] = np.exp(thick)
        surface = PalmarSurface(factor * self._surface.palmar_m, factor * self._surface.radius_m)
        beyond = self._tips.beyond_m.copy()
        beyond[FINGERS] += reach_m
        tips = replace(self._tips, beyond_m=beyond).points(chains)[:, FINGERS]
        return surface.spheres(chains)[:, FINGERS], surface.radius_m[FINGERS], tips

    @staticmethod
    def _placed_at(R: Float, shift_m: Float, spheres: Float, radius: Float, tips: Float) -> tuple[Float, ...]:
        """The same in the camera's frame."""
        transposed = np.swapaxes(R, 1, 2)
        return spheres @ transposed[:, None] + shift_m, radius, tips @ transposed + shift_m

    def _seen(self, hands: list[tuple[Float, ...]]) -> Float:
        """(P, T, 4, SEEN) of P hands."""
        radius = np.stack([one[1] for one in hands])[:, None]
        line = self._intersection.line(np.stack([one[0] for one in hands]), radius, np.bool_(False))
        tips = self._setup.optics.project(np.stack([one[2] for one in hands]))
        return np.concatenate([line.point_m, tips], axis=-1)
