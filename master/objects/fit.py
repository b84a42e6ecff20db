"""A fit finds the pose and motion of an object by weighted sums.

Each observation (a bead, a corner of a tag) around an epoch has its own time, that of its row, and a place in
the distorted image. The object's motion about the epoch is a Taylor series of its place and turn to the
fourth order,

    X = R(theta(t)) R0 q + p(t),   p(t) = sum_k p_k t^k / k!,   theta(t) = sum_{k>0} theta_k t^k / k!

whose derivatives are drawn at random with the sizes of what hands do (as `master.fabrik.sync` has it for
single markers; Rasmussen, Williams 2006, 2.7). Minimised is the reprojection error in units of its noise plus
these priors, by Gauss-Newton: one linear problem of 30 unknowns per round, whatever the number of cameras and
features. Cameras need not be in step, and a rolling shutter is no special case. How hard the object is moved
is not known: the last linear problem is solved for each degree of vigour, each counts by its evidence, and
where they disagree the covariance grows.

An error of a feature in a camera is one that stays (light, shape, cover, lens) plus one that is new in each
frame. The first is an unknown of its own, eliminated by its Schur complement, so four observations of one
bead at rest are not taken for four measurements. A feature that misses the pose by more than noise and a bad
calibration is weighed down as a whole, in its camera, by Geman and McClure's law (iteratively reweighted
least squares).
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float, Int
from common.geometry.transforms import matrix_to_rotation_vector, rigid, rotation_vector_to_matrix, skew
from master.estimator.sensors import CameraArrays
from master.fabrik.settings import RAYS


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """The cameras of n observations, and the radii of the balls that they see."""

    R: Float  # (n, 3, 3) of `T_camera_rig`
    t: Float  # (n, 3)
    lens: Float  # (5, n) k1, k2, p1, p2, k3
    focal: Float  # (n, 2) [px]
    centre: Float  # (n, 2) [px]
    radius_2: Float  # (n,) squares of the radii [m^2], 0: a point

    @classmethod
    def of(cls, cameras: CameraArrays, camera: Int, radius_m: Float) -> "Views":
        """Those of observations (n,), of balls of radii (n,) [m]."""
        R, t, _, focal, centre, lens, _ = (array[camera] for array in cameras)
        return cls(R, t, lens.T, focal, centre, radius_m * radius_m)

    def see(self, points: Float) -> tuple[Float, Float, Float]:
        """Project points (n, 3) [m]; of balls about them the middles of their outlines.

        An ellipse, the outline of a ball of radius r at (x, y, z), has its middle at (x, y) z / (z^2 - r^2).
        Returns pixels (n, 2); derivatives (n, 2, 3) [px/m] by the points, rig frame; depth (n,) [m]. NaN:
        behind.
        """
        own = (self.R @ points[..., None])[..., 0] + self.t
        before_m = 1e-3  # a point nearer to the plane of a camera than this is not before it
        z = np.where(own[:, 2] > before_m, own[:, 2], np.nan)
        z = z - self.radius_2 / z
        xy = own[:, :2] / z[:, None]
        k1, k2, p1, p2, k3 = self.lens
        x, y = xy.T
        xx, yy = x * x, y * y
        r2 = xx + yy
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        radial_derivative = 2.0 * k1 + r2 * (4.0 * k2 + r2 * (6.0 * k3))
        two_xy = 2.0 * x * y
        uv = np.empty_like(xy)
        uv[:, 0] = x * radial + p1 * two_xy + p2 * (r2 + 2.0 * xx)
        uv[:, 1] = y * radial + p1 * (r2 + 2.0 * yy) + p2 * two_xy
        # The tangential part turns the derivative by less than 1 % and is neglected in it.
        by_own = np.empty((len(xy), 2, 3))
        scale = self.focal / z[:, None]
        by_own[:, 0, 0] = radial_derivative * xx + radial
        by_own[:, 1, 1] = radial_derivative * yy + radial
        by_own[:, 0, 1] = by_own[:, 1, 0] = 0.5 * radial_derivative * two_xy
        by_own[..., :2] *= scale[..., None]
        by_own[..., 2] = -by_own[..., 0] * x[:, None] - by_own[..., 1] * y[:, None]
        return uv * self.focal + self.centre, by_own @ self.R, z


ORDERS = 5
_FACTORIAL: Float = np.array([1.0, 1.0, 2.0, 6.0, 24.0])
_POWERS = np.arange(ORDERS)


def basis_at(tau_s: Float) -> Float:
    """Return weights (..., ORDERS) of the derivatives at times (...) [s] from 0."""
    return tau_s[..., None] ** _POWERS / _FACTORIAL


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """A pose and its derivatives, those of order 0 being 0."""

    T: Float  # (4, 4) `T_rig_object`
    rates: Float  # (ORDERS, 2, 3) of place [m/s^k] and turn [rad/s^k], rig axes

    @classmethod
    def still(cls, T: Float) -> "Motion":
        """An object at rest."""
        return cls(T, np.zeros((ORDERS, 2, 3)))

    def at(self, t_s: float) -> "Motion":
        """The pose at another time, by the first derivatives; these kept."""
        weights = t_s**_POWERS / _FACTORIAL
        weights[2:] = 0.0
        way = np.einsum("k,kij->ij", weights, self.rates)
        rates = self.rates.copy()
        rates[2:] = 0.0
        return Motion(_stepped(self.T, way), rates)

    def retracted(self, step: Float) -> "Motion":
        """The motion after a step (6 ORDERS,): of each order place, then turn."""
        change = step.reshape(ORDERS, 2, 3)
        rates = self.rates + change
        rates[0] = 0.0
        return Motion(_stepped(self.T, change[0]), rates)


def _stepped(T: Float, step: Float) -> Float:
    """A pose (4, 4) after a step of its place and of its turn (2, 3)."""
    return rigid(rotation_vector_to_matrix(step[1]) @ T[:3, :3], T[:3, 3] + step[0])


@dataclass(frozen=True, slots=True, eq=False)
class Past:
    """Prior from earlier frames at the epoch, with its information (12, 12)."""

    motion: Motion
    precision: Float

    def off(self, motion: Motion) -> Float:
        """(12,) how far another motion is from this: what would have to be added to it."""
        own = self.motion
        return np.concatenate(
            [
                own.T[:3, 3] - motion.T[:3, 3],
                matrix_to_rotation_vector(own.T[:3, :3] @ motion.T[:3, :3].T),
                (own.rates[1] - motion.rates[1]).ravel(),
            ]
        )


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Observations of one object around an epoch, n points."""

    camera: Int  # (n,)
    point: Int  # (n,) which row of `Features.points`
    tau_s: Float  # (n,) when, from the epoch [s]
    uv: Float  # (n, 2) [px], distorted image
    sigma_px: Float  # (n,) standard deviation per axis
    t_sigma_s: Float  # (n,) of the times, the same error for all of a camera
    feature: Int  # (n,) of what each is a part, which is weighed down as a whole in its camera
    now: Bool  # (n,) of the nearest frame of its camera


class Sums:
    """Weighted sums of observations; holds which belong together, and variances."""

    def __init__(self, seen: Observations, floor_2: Float, points: int) -> None:
        """Set up for an object of so many points.

        `floor_2` (n,): variance per axis [px^2] that light, lens and calibration leave.
        """
        variance = seen.sigma_px**2
        independent_share, independent_px = 0.7, 0.1  # as in `master.fabrik.sync`
        independent = np.minimum(independent_share * variance, independent_px**2)
        correlated = variance - independent + floor_2
        _, first, group = np.unique(seen.camera * points + seen.point, return_index=True, return_inverse=True)
        # What the surest observation keeps is kept by all; others have more that is new.
        self._correlated = np.full(len(first), np.inf)
        np.minimum.at(self._correlated, group, correlated)
        kept = self._correlated[group]
        self._independent = independent + correlated - kept
        self._total = kept + self._independent
        self._of_group = np.zeros((len(first), len(group)))
        self._of_group[group, np.arange(len(group))] = 1.0
        self._group_size = self._of_group.sum(axis=1)
        _, self._whole = np.unique(
            seen.camera * (int(seen.feature.max()) + 1) + seen.feature, return_inverse=True
        )
        self._whole_size = np.bincount(self._whole)
        # Of numbers that were measured a bead has two, a tag eight, however often it was.
        self._numbers = 2.0 * np.bincount(self._whole[first])

    def weigh(self, miss: Float, lag_2: Float) -> tuple[Float, Float, float]:
        """Return chi square (n,), weight (n,) of each observation, and the cost.

        The chi square is per measured number of the feature that the observation belongs to. The weight
        forgives what a bad calibration leaves (`RaySettings.rig_px`), the cost only what this one is known to
        leave. `miss` (n, 2) [px]; `lag_2` (n,) variance that the uncertainty of their times makes [px^2].
        """
        total = self._total + lag_2
        squared = 0.5 * np.vecdot(miss, miss)
        mean = np.bincount(self._whole, squared / total) / self._whole_size
        forgiven = np.bincount(self._whole, squared / (total + RAYS.rig_px**2)) / self._whole_size
        soft_2 = 9.0  # square of the deviation in sigmas at which a feature counts half ... a quarter
        weight = (1.0 + forgiven / soft_2) ** -2.0
        cost = float((self._numbers * mean / (1.0 + mean / soft_2)).sum())
        return mean[self._whole], weight[self._whole], cost

    def normal(self, rows: Float, weight: Float, lag_2: Float) -> tuple[Float, Float]:
        """Normal matrix (N, N) and gradient (N,), the errors that stay eliminated.

        `rows` (n, 2, N + 1): derivatives of what is seen by the unknowns; last, by what it is missed [px].
        """
        size = rows.shape[2]
        w = weight / (self._independent + lag_2)
        weighted = rows * w[:, None, None]
        both = weighted.reshape(-1, size).T @ rows.reshape(-1, size)
        light = self._of_group @ weight / self._group_size
        down = self._of_group @ w + light / self._correlated
        sums = (self._of_group @ weighted.reshape(len(rows), -1)) / np.sqrt(down)[:, None]
        sums = sums.reshape(-1, size)
        both -= sums.T @ sums
        return both[:-1, :-1], both[:-1, -1]


_N = 6 * ORDERS
# At rest on a table, held, waved: speeds and accelerations per axis, and of turns.
_SPEED: Float = np.array([[0.005, 0.05], [1.0, 6.0], [1.0, 8.0]])  # [m/s, rad/s]
_ACCELERATION: Float = np.array([[0.1, 1.0], [1.5, 15.0], [15.0, 120.0]])  # [m/s^2, rad/s^2]
_ROUNDS = 4
_LEAST: Float = np.array([1.0] * 3 + [0.1] * 3)  # information on place and turn: no matrix is singular
_EYE = np.eye(3)
_REPORTED = np.eye(_N)[:, :12]  # place, turn and their speeds


@dataclass(frozen=True, slots=True, eq=False)
class Fitted:
    """A fitted pose at an epoch."""

    motion: Motion
    cov: Float  # (12, 12) of place, turn, speed and turning
    cost: float  # robust cost, in units of chi square, priors included
    weight: Float  # (n,) of each observation, 0..1
    chi2: Float  # (n,) of each observation's feature in its camera, per number measured
    residual_m: Float  # (n,) by how much each misses the object [m]
    measured_only: bool = True  # the observations determine the pose, without the prior

    @property
    def used(self) -> Bool:
        """(n,) which observations the pose rests on."""
        gone = 0.05  # weight below which a feature counts as wrong
        return self.weight > gone

    def poorer(self, most_m: float, most_rad: float) -> bool:
        """Whether place or turn is less sure than this in some direction."""
        place, rotation = np.linalg.eigvalsh(np.stack([self.cov[:3, :3], self.cov[3:6, 3:6]]))[:, -1].tolist()
        return not (place < most_m**2 and rotation < most_rad**2)


class PoseFit:
    """Fits poses of one object in one rig. Holds no state between calls."""

    def __init__(self, cameras: CameraArrays, points: Float, radius_m: Float, floor_px: Float) -> None:
        """Set up for points (P, 3) [m], object frame, of radii (P,), 0: a corner.

        `floor_px` (P,): standard deviation of what light, lens and calibration leave, per point and camera.
        """
        self._cameras, self._points, self._radius = cameras, points, radius_m
        self._floor_2 = floor_px * floor_px
        self._priors = np.stack([_precision(level) for level in range(len(_SPEED))])
        # Of each degree of vigour the logarithm of its prior's determinant.
        self._log_prior = np.log(np.diagonal(self._priors, axis1=1, axis2=2)).sum(axis=1)

    def __call__(self, seen: Observations, start: Motion, past: Past | None = None) -> Fitted | None:
        """Fit from a start; None: it leads nowhere (behind a camera, not determined)."""
        task = _Task(
            seen,
            self._points[seen.point],
            basis_at(seen.tau_s),
            Views.of(self._cameras, seen.camera, self._radius[seen.point]),
            Sums(seen, self._floor_2[seen.point], len(self._points)),
            past,
            self._priors[-1],
        )
        motion = start
        for _ in range(_ROUNDS):
            problem = task.linear(motion)
            if problem is None:
                return None
            step = np.asarray(
                np.linalg.solve(problem.normal + self._priors[-1], problem.gradient), np.float64
            )
            most = float(np.abs(step[:6]).max())
            if not np.isfinite(step).all() or most > 1.0:
                return None
            motion = motion.retracted(step)
            settled = 2e-4  # [m, rad]: the next step, which is taken in any case, is some thousandths of that
            if most < settled:
                break
        problem = task.linear(motion)
        return None if problem is None else self._mixed(problem, motion)

    def _mixed(self, problem: "_Problem", motion: Motion) -> Fitted | None:
        """Return the mean over all degrees of vigour, linearised at that of the most."""
        # Unknowns are now the derivatives themselves: their priors are about 0.
        pull = problem.gradient + self._priors[-1] @ problem.rates + problem.normal @ problem.rates
        normal = problem.normal + self._priors
        asked = np.concatenate([_REPORTED, pull[:, None]], axis=1)
        found = np.linalg.solve(normal, np.broadcast_to(asked, (len(normal), *asked.shape)))
        cov, x = found[:, :12, :12], found[:, :, 12]
        sign, size = np.linalg.slogdet(normal)
        if not (sign > 0).all() or not np.isfinite(x).all():
            return None
        evidence = 0.5 * (x @ pull - size + self._log_prior)  # twice the logarithm
        share = np.exp(0.5 * (evidence - evidence.max()))
        share /= share.sum()
        mean = share @ x
        off = x[:, :12] - mean[:12]
        spread = (share @ cov.reshape(-1, 144)).reshape(12, 12) + (share[:, None] * off).T @ off
        return Fitted(
            motion.retracted(mean - problem.rates),
            0.5 * (spread + spread.T),
            problem.cost,
            problem.weight,
            problem.chi2,
            problem.residual_m,
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    """One linearised problem: normal matrix (30, 30), gradient (30,), what follows."""

    normal: Float
    gradient: Float
    cost: float
    rates: Float
    weight: Float
    chi2: Float
    residual_m: Float


@dataclass(frozen=True, slots=True, eq=False)
class _Task:
    """All of a fit that stays the same from round to round."""

    seen: Observations
    points: Float  # (n, 3) [m], object frame
    basis: Float  # (n, ORDERS) weights of the derivatives
    views: Views
    sums: Sums
    past: Past | None
    prior: Float  # (30, 30) information on the derivatives

    def linear(self, motion: Motion) -> _Problem | None:
        """The problem linearised at a motion; None: something is behind its camera."""
        rates = motion.rates.reshape(ORDERS, 6)
        way = self.basis @ rates
        rotation = rotation_vector_to_matrix(way[:, 3:])
        arm = (rotation @ (self.points @ motion.T[:3, :3].T)[..., None])[..., 0]
        uv, by_place, depth = self.views.see(arm + motion.T[:3, 3] + way[:, :3])
        miss = self.seen.uv - uv
        if not np.isfinite(miss).all():
            return None
        by_rotation = -(by_place @ skew(arm))
        speed = by_place @ rates[1, :3] + by_rotation @ rates[1, 3:]
        lag_2 = np.vecdot(speed, speed) * self.seen.t_sigma_s**2 * 0.5
        chi2, weight, cost = self.sums.weigh(miss, lag_2)
        rows = self._rows(by_place, by_rotation, rotation, way[:, 3:], miss)
        normal, gradient = self.sums.normal(rows, weight, lag_2)
        if self.past is not None:
            normal[:12, :12] += self.past.precision
            gradient[:12] += self.past.precision @ self.past.off(motion)
        # Priors of the derivatives are about 0, so that what they are at now counts.
        now = rates.ravel()
        residual = np.sqrt(np.vecdot(miss, miss)) * depth / self.views.focal[:, 0]
        return _Problem(normal, gradient - self.prior @ now, cost, now, weight, chi2, residual)

    def _rows(self, by_place: Float, by_rotation: Float, rotation: Float, theta: Float, miss: Float) -> Float:
        """Return (n, 2, 31) derivatives by position, rotation of each order; residual."""
        rows = np.empty((len(miss), 2, _N + 1))
        rows[..., _N] = miss
        rows[..., :3] = by_place
        # A small turn of R0 is turned with it; one of theta turns as the left Jacobian of the rotation vector has it.
        rows[..., 3:6] = by_rotation @ rotation
        about = skew(theta)
        by_rotation = by_rotation @ (_EYE + 0.5 * about + about @ about / 6.0)
        both = np.concatenate([by_place, by_rotation], axis=2)
        for order in range(1, ORDERS):
            rows[..., 6 * order : 6 * order + 6] = self.basis[:, order, None, None] * both
        return rows


def _precision(level: int) -> Float:
    """Diagonal prior (30, 30) of the derivatives at one degree of vigour."""
    acceleration = _ACCELERATION[level]
    w_per_s = 18.0  # jerk by acceleration, and snap by jerk: as hands do
    # (4, 2): of place and turn
    sizes = np.stack([_SPEED[level], acceleration, acceleration * w_per_s, acceleration * w_per_s**2])
    return np.diag(np.concatenate([_LEAST, (1.0 / sizes**2).repeat(3, axis=1).ravel()]))
