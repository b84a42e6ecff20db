"""The pose of a rigid object at an instant, from what all cameras saw of it around that.

Each observation (a bead, a corner of a tag) has its own time, that of its row, and a place in the distorted image. The
object's motion about the instant is a Taylor series of its place and of its turn, to the fourth order, whose speed,
acceleration, jerk and snap are drawn at random with the sizes of what hands do (as `master.stereo.tracks` has it for
single markers; Rasmussen, Williams 2006, 2.7):

    X = R(theta(t)) R0 q + p(t),   p(t) = sum_k p_k t^k / k!,   theta(t) = sum_{k>0} theta_k t^k / k!

Minimised is the reprojection error in units of its noise plus these priors, by Gauss-Newton from a start. Everything is
one linear problem of 30 unknowns per round, whatever the number of cameras and features: cameras need not be in step,
one that was lost costs what it saw, and a rolling shutter is no special case.

**Noise.** An error of a feature in a camera is one that stays from frame to frame (light, shape, cover, lens) plus one
that is new in each. The first is an unknown of its own, eliminated exactly (Schur complement), so that four sightings
of one bead at rest are not taken for four measurements.

**Vigour.** How hard the object is moved is not known: the last linear problem is solved for each degree of vigour, each
counts by its evidence, and where they disagree the covariance grows.

**Wrong ones.** A feature that misses the pose by more than noise and a bad calibration is weighed down as a whole, in
its camera, by Geman and McClure's law in each round (iteratively reweighted least squares); one thing taken for another
so costs itself.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float, Int
from common.camera_model import CameraModel
from common.geometry import matrix_to_rotation_vector, rigid, rotation_vector_to_matrix, skew
from master.stereo.misfit import RIG_PX

ORDERS = 5
_N = 6 * ORDERS
_FACTORIAL: Float = np.array([1.0, 1.0, 2.0, 6.0, 24.0])
# At rest on a table, held, waved: speeds and accelerations per axis, and of turns.
_SPEED: Float = np.array([[0.005, 0.05], [1.0, 6.0], [1.0, 8.0]])  # [m/s, rad/s]
_ACCELERATION: Float = np.array([[0.1, 1.0], [1.5, 15.0], [15.0, 120.0]])  # [m/s^2, rad/s^2]
_W_PER_S = 18.0  # jerk by acceleration, and snap by jerk: as hands do
_FRESH, _FRESH_PX = 0.7, 0.1  # as in `master.stereo.tracks`
_EVIDENCE = 0.5
_SOFT_2 = 9.0  # square of the deviation in sigmas at which a feature counts half ... a quarter
_ROUNDS = 4
_SETTLED = 1e-5  # [m, rad]
_LEAST: Float = np.array([1.0] * 3 + [0.1] * 3)  # information on place and turn: no matrix is singular
_GONE = 0.05  # weight below which a feature counts as wrong


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """What was seen of one object around an instant, n points.

    Attributes:
        camera: (n,) which camera.
        point: (n,) which row of `Features.points`.
        tau_s: (n,) when, from the instant [s].
        uv: (n, 2) [px], distorted image.
        sigma_px: (n,) standard deviation per axis.
        t_sigma_s: (n,) of the times, the same error for all of a camera.
    """

    camera: Int
    point: Int
    tau_s: Float
    uv: Float
    sigma_px: Float
    t_sigma_s: Float

    def some(self, chosen: Bool) -> "Observations":
        """Those of a mask (n,)."""
        return Observations(
            self.camera[chosen],
            self.point[chosen],
            self.tau_s[chosen],
            self.uv[chosen],
            self.sigma_px[chosen],
            self.t_sigma_s[chosen],
        )


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """A pose and its derivatives.

    Attributes:
        T: (4, 4) `T_rig_object`.
        rates: (ORDERS, 2, 3) derivatives of place [m/s^k] and turn [rad/s^k], rig axes; those of order 0 are 0.
    """

    T: Float
    rates: Float

    @classmethod
    def still(cls, T: Float) -> "Motion":
        """An object at rest."""
        return cls(T, np.zeros((ORDERS, 2, 3)))

    def at(self, t_s: float, orders: int = 2) -> "Motion":
        """The pose at another time, by the first derivatives; these kept."""
        weights = t_s ** np.arange(ORDERS) / _FACTORIAL
        weights[orders:] = 0.0
        way = np.einsum("k,kij->ij", weights, self.rates)
        rates = self.rates.copy()
        rates[orders:] = 0.0
        return Motion(
            rigid(rotation_vector_to_matrix(way[1]) @ self.T[:3, :3], self.T[:3, 3] + way[0]), rates
        )


@dataclass(frozen=True, slots=True, eq=False)
class Past:
    """What earlier frames say of place, turn and speeds at the instant: where, and its information (12, 12)."""

    motion: Motion
    precision: Float


@dataclass(frozen=True, slots=True, eq=False)
class Fitted:
    """A pose at an instant.

    Attributes:
        motion: Pose and derivatives.
        cov: (12, 12) of place, turn, speed and turning.
        cost: Robust misfit, in units of chi square, priors included.
        weight: (n,) of each observation, 0..1.
        misfit: (n,) chi square of each observation's feature in its camera, per number measured.
        residual_m: (n,) by how much each misses the object [m].
        alone: What is seen tells the pose, without what was known before.
    """

    motion: Motion
    cov: Float
    cost: float
    weight: Float
    misfit: Float
    residual_m: Float
    alone: bool = True

    @property
    def used(self) -> Bool:
        """(n,) which observations the pose rests on."""
        return self.weight > _GONE


class Cameras:
    """All cameras of a rig laid out by observation. Holds no state between calls."""

    def __init__(self, cameras: tuple[CameraModel, ...]) -> None:
        """Lay them out."""
        self._R = np.array([c.T_camera_rig[:3, :3] for c in cameras])
        self._t = np.array([c.T_camera_rig[:3, 3] for c in cameras])
        self._lens = np.array([c.distortion for c in cameras])
        self._focal = np.array([c.matrix[[0, 1], [0, 1]] for c in cameras])
        self._centre = np.array([c.matrix[:2, 2] for c in cameras])

    def see(self, camera: Int, points: Float, radius_m: Float) -> tuple[Float, Float, Float]:
        """Where cameras (n,) see points (n, 3) [m], or the middles of balls' outlines about them.

        An ellipse, the outline of a ball of radius r at (x, y, z), has its middle at (x, y) z / (z^2 - r^2).

        Returns:
            Pixels (n, 2); their derivatives (n, 2, 3) [px/m] by the points, rig frame; depth (n,) [m]. NaN: behind.
        """
        R = self._R[camera]
        own = (R @ points[..., None])[..., 0] + self._t[camera]
        z = np.where(own[:, 2] > 1e-3, own[:, 2], np.nan)
        z = z - radius_m * radius_m / z
        xy = own[:, :2] / z[:, None]
        k1, k2, p1, p2, k3 = self._lens[camera].T
        x, y = xy.T
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2.0 * k1 + r2 * (4.0 * k2 + r2 * 6.0 * k3)
        focal = self._focal[camera]
        uv = np.empty_like(xy)
        uv[:, 0] = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
        uv[:, 1] = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
        # The tangential part turns the derivative by less than 1 % and is left out of it.
        lens = (slope[:, None] * xy)[..., None] * xy[:, None]
        lens[:, [0, 1], [0, 1]] += radial[:, None]
        lens *= focal[..., None]
        by_own = np.empty((len(xy), 2, 3))
        by_own[..., :2] = lens / z[:, None, None]
        by_own[..., 2] = -(lens @ xy[..., None])[..., 0] / z[:, None]
        return uv * focal + self._centre[camera], by_own @ R, z


class PoseFit:
    """Fits poses of one object in one rig. Holds no state between calls."""

    def __init__(
        self, cameras: tuple[CameraModel, ...], points: Float, radius_m: Float, floor_px: Float
    ) -> None:
        """Set up.

        Args:
            cameras: Of the rig.
            points: (P, 3) [m] of the object, `radius_m` (P,) of beads, 0: a corner.
            floor_px: (P,) standard deviation of what light, lens and calibration leave, per point and camera.
        """
        self._see, self._points, self._radius = Cameras(cameras), points, radius_m
        self._floor_2 = floor_px * floor_px
        self._focal = np.array([c.matrix[0, 0] for c in cameras])
        self._priors = np.stack([_precision(level) for level in range(len(_SPEED))])

    def __call__(
        self, seen: Observations, start: Motion, past: Past | None = None, *, feature: Int
    ) -> Fitted | None:
        """Fit from a start; None: it leads nowhere (behind a camera, not determined).

        Args:
            seen: Observations.
            start: At the instant.
            past: What else is known; None: nothing.
            feature: (n,) of what each observation is a part: what is weighed down together with it in its camera.
        """
        sums = _Sums(seen, feature, self._floor_2[seen.point], len(self._points))
        basis = seen.tau_s[:, None] ** np.arange(ORDERS) / _FACTORIAL
        motion, problem = start, None
        for _ in range(_ROUNDS):
            problem = self._linear(seen, basis, motion, sums, past)
            if problem is None:
                return None
            step = np.asarray(
                np.linalg.solve(problem.normal + self._priors[-1], problem.gradient), np.float64
            )
            if not np.isfinite(step).all() or np.abs(step[:6]).max() > 1.0:
                return None
            motion = _moved(motion, step)
            if np.abs(step[:6]).max() < _SETTLED:
                break
        problem = self._linear(seen, basis, motion, sums, past)
        return None if problem is None else self._mixed(problem, motion)

    def _linear(
        self, seen: Observations, basis: Float, motion: Motion, sums: "_Sums", past: Past | None
    ) -> "_Problem | None":
        way = np.einsum("nk,kij->nij", basis, motion.rates)
        turn = rotation_vector_to_matrix(way[:, 1])
        arm = (turn @ (self._points[seen.point] @ motion.T[:3, :3].T)[..., None])[..., 0]
        uv, by_point, depth = self._see.see(
            seen.camera, arm + motion.T[:3, 3] + way[:, 0], self._radius[seen.point]
        )
        miss = seen.uv - uv
        if not np.isfinite(miss).all():
            return None
        by_pose = np.concatenate([by_point, -(by_point @ skew(arm))], axis=2)  # (n, 2, 6)
        rows = basis[:, None, :, None] * by_pose[:, :, None, :]
        # A small turn of R0 is turned with it; one of theta turns as the left Jacobian of the rotation vector has it.
        about = skew(way[:, 1])
        rows[:, :, 1:, 3:] = rows[:, :, 1:, 3:] @ (np.eye(3) + 0.5 * about + about @ about / 6.0)[:, None]
        rows[:, :, 0, 3:] = by_pose[..., 3:] @ turn
        rows = rows.reshape(len(uv), 2, _N)
        speed = (by_pose @ motion.rates[1].reshape(6, 1))[..., 0]
        lag_2 = np.vecdot(speed, speed) * seen.t_sigma_s**2 * 0.5
        misfit, weight, cost = sums.weigh(miss, lag_2)
        normal, gradient = sums.normal(rows, miss, weight, lag_2)
        # Priors of the derivatives are about 0, so that what they are at now counts.
        rates = motion.rates.reshape(ORDERS, 6).ravel()
        if past is not None:
            _add_past(normal, gradient, motion, past)
        residual = np.sqrt(np.vecdot(miss, miss)) * depth / self._focal[seen.camera]
        return _Problem(normal, gradient - self._priors[-1] @ rates, cost, rates, weight, misfit, residual)

    def _mixed(self, problem: "_Problem", motion: Motion) -> Fitted | None:
        """The mean over all degrees of vigour, from the problem linearised at their solution for the most."""
        # Unknowns are now the derivatives themselves: their priors are about 0.
        pull = problem.gradient + self._priors[-1] @ problem.rates + problem.normal @ problem.rates
        normal = problem.normal + self._priors
        cov = np.linalg.inv(normal)
        x = (cov @ pull[:, None])[..., 0]
        sign, size = np.linalg.slogdet(normal)
        if not (sign > 0).all() or not np.isfinite(x).all():
            return None
        prior = np.log(np.diagonal(self._priors, axis1=1, axis2=2)).sum(axis=1)
        evidence = _EVIDENCE * (x @ pull - size + prior)  # twice the logarithm
        share = np.exp(0.5 * (evidence - evidence.max()))
        share /= share.sum()
        mean = share @ x
        off = x - mean
        spread = (
            np.einsum("l,lij->ij", share, cov[:, :12, :12]) + (share[:, None] * off[:, :12]).T @ off[:, :12]
        )
        step = mean - problem.rates
        return Fitted(
            _moved(motion, step),
            0.5 * (spread + spread.T),
            problem.cost,
            problem.weight,
            problem.misfit,
            problem.residual_m,
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    """One linearised problem: normal matrix (30, 30) and gradient (30,) and what comes with them."""

    normal: Float
    gradient: Float
    cost: float
    rates: Float
    weight: Float
    misfit: Float
    residual_m: Float


class _Sums:
    """Adds observations up with errors that stay: which belong together, and their variances."""

    def __init__(self, seen: Observations, feature: Int, floor_2: Float, points: int) -> None:
        variance = seen.sigma_px**2
        self._fresh = np.minimum(_FRESH * variance, _FRESH_PX**2)
        stays = variance - self._fresh + floor_2
        key = seen.camera * points + seen.point
        _, self._group = np.unique(key, return_inverse=True)
        count = int(self._group.max()) + 1
        # What the surest sighting keeps is kept by all; others have more that is new.
        self._stays = np.full(count, np.inf)
        np.minimum.at(self._stays, self._group, stays)
        self._fresh = self._fresh + stays - self._stays[self._group]
        whole = seen.camera * (int(feature.max()) + 1) + feature
        _, self._whole = np.unique(whole, return_inverse=True)
        # Of numbers that were measured a bead has two, a tag eight, however often it was.
        self._numbers = 2.0 * np.bincount(self._whole[np.unique(self._group, return_index=True)[1]])

    def weigh(self, miss: Float, lag_2: Float) -> tuple[Float, Float, float]:
        """Chi square per number measured of the feature of each observation (n,), its weight (n,), and the cost.

        The weight forgives what a bad calibration leaves (`RIG_PX`), the cost only what this one is known to leave.
        """
        total = self._stays[self._group] + self._fresh + lag_2
        squared, count = 0.5 * np.vecdot(miss, miss), np.bincount(self._whole)
        mean = np.bincount(self._whole, squared / total) / count
        forgiven = np.bincount(self._whole, squared / (total + RIG_PX**2)) / count
        weight = (1.0 + forgiven / _SOFT_2) ** -2.0
        cost = float((self._numbers * mean / (1.0 + mean / _SOFT_2)).sum())
        return mean[self._whole], weight[self._whole], cost

    def normal(self, rows: Float, miss: Float, weight: Float, lag_2: Float) -> tuple[Float, Float]:
        """Normal matrix (N, N) and gradient (N,), the errors that stay eliminated."""
        w = weight / (self._fresh + lag_2)
        weighted = rows * w[:, None, None]
        flat, pulled = weighted.reshape(-1, rows.shape[2]), miss.ravel()
        normal, gradient = flat.T @ rows.reshape(flat.shape), flat.T @ pulled
        count = len(self._stays)
        sums = np.zeros((count, 2, rows.shape[2] + 1))
        np.add.at(sums, self._group, np.concatenate([weighted, (w[:, None] * miss)[..., None]], axis=2))
        light = np.bincount(self._group, weight) / np.bincount(self._group)
        down = np.bincount(self._group, w) + light / self._stays
        sums = (sums / np.sqrt(down)[:, None, None]).reshape(2 * count, -1)
        taken = sums.T @ sums
        return normal - taken[:-1, :-1], gradient - taken[:-1, -1]


def _add_past(normal: Float, gradient: Float, motion: Motion, past: Past) -> None:
    """Add what earlier frames say to a problem, in place."""
    off = np.concatenate(
        [
            past.motion.T[:3, 3] - motion.T[:3, 3],
            matrix_to_rotation_vector(past.motion.T[:3, :3] @ motion.T[:3, :3].T),
            (past.motion.rates[1] - motion.rates[1]).ravel(),
        ]
    )
    normal[:12, :12] += past.precision
    gradient[:12] += past.precision @ off


def _moved(motion: Motion, step: Float) -> Motion:
    """The motion after a step (30,)."""
    change = step.reshape(ORDERS, 2, 3)
    T = rigid(rotation_vector_to_matrix(change[0, 1]) @ motion.T[:3, :3], motion.T[:3, 3] + change[0, 0])
    rates = motion.rates + change
    rates[0] = 0.0
    return Motion(T, rates)


def _precision(level: int) -> Float:
    """Diagonal prior (30, 30) of the derivatives at one degree of vigour."""
    acceleration = _ACCELERATION[level]
    sizes = np.stack(
        [_SPEED[level], acceleration, acceleration * _W_PER_S, acceleration * _W_PER_S**2]
    )  # (4, 2): of place and turn
    return np.diag(np.concatenate([_LEAST, (1.0 / sizes**2).repeat(3, axis=1).ravel()]))
