"""Pose of a rigid object at an epoch, from the observations of all cameras.

The observations are those around the epoch.

Each observation (a bead, a corner of a tag) has its own time, that of its row, and a place in the distorted image. The
object's motion about the epoch is a Taylor series of its place and of its turn (`master.objects.motion`), to the
fourth order, whose speed, acceleration, jerk and snap are drawn at random with the sizes of what hands do (as
`master.fabrik.propagate` has it for single markers; Rasmussen, Williams 2006, 2.7).

Minimised is the reprojection error in units of its noise plus these priors, by Gauss-Newton from a start. Everything is
one linear problem of 30 unknowns per round, whatever the number of cameras and features: cameras need not be in step,
one that was lost costs what it saw, and a rolling shutter is no special case.

**Vigour.** How hard the object is moved is not known: the last linear problem is solved for each degree of vigour, each
counts by its evidence, and where they disagree the covariance grows.

Noise, and what is taken for a feature and is none: `master.objects.sums`.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float, Int
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import rotation_vector_to_matrix, skew
from master.objects.cameras import Cameras, Views
from master.objects.motion import ORDERS, Motion, Past, basis_at
from master.objects.sums import Observations, Sums

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
    """A fitted pose at an epoch.

    Attributes:
        motion: Pose and derivatives.
        cov: (12, 12) of place, turn, speed and turning.
        cost: Robust cost, in units of chi square, priors included.
        weight: (n,) of each observation, 0..1.
        misfit: (n,) chi square of each observation's feature in its camera, per number measured.
        residual_m: (n,) by how much each misses the object [m].
        alone: The observations determine the pose, without the prior.
    """

    motion: Motion
    cov: Float
    cost: float
    weight: Float
    chi2: Float
    residual_m: Float
    measured_only: bool = True

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

    def __init__(
        self, cameras: tuple[CameraModel, ...], points: Float, radius_m: Float, floor_px: Float
    ) -> None:
        """Set up.

        Args:
            cameras: Of the rig.
            points: (P, 3) [m] of the object, `radius_m` (P,) of beads, 0: a corner.
            floor_px: (P,) standard deviation of what light, lens and calibration leave, per point and camera.
        """
        self._cameras, self._points, self._radius = Cameras(cameras), points, radius_m
        self._floor_2 = floor_px * floor_px
        self._priors = np.stack([_precision(level) for level in range(len(_SPEED))])
        # Of each degree of vigour the logarithm of its prior's determinant.
        self._log_prior = np.log(np.diagonal(self._priors, axis1=1, axis2=2)).sum(axis=1)

    def __call__(
        self, seen: Observations, start: Motion, past: Past | None = None, *, feature: Int
    ) -> Fitted | None:
        """Fit from a start; None: it leads nowhere (behind a camera, not determined).

        Args:
            seen: Observations.
            start: At the epoch.
            past: What else is known; None: nothing.
            feature: (n,) of what each observation is a part: what is weighed down together with it in its camera.
        """
        task = _Task(
            seen,
            self._points[seen.point],
            basis_at(seen.tau_s),
            self._cameras.of(seen.camera, self._radius[seen.point]),
            Sums(seen, feature, self._floor_2[seen.point], len(self._points)),
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
        """Return the mean over all degrees of vigour.

        It is from the problem linearised at their solution for the most vigour.
        """
        # Unknowns are now the derivatives themselves: their priors are about 0.
        pull = problem.gradient + self._priors[-1] @ problem.rates + problem.normal @ problem.rates
        normal = problem.normal + self._priors
        asked = np.concatenate([_REPORTED, pull[:, None]], axis=1)
        found = np.linalg.solve(normal, np.broadcast_to(asked, (len(normal), *asked.shape)))
        cov, x = found[:, :12, :12], found[:, :, 12]
        sign, size = np.linalg.slogdet(normal)
        if not (sign > 0).all() or not np.isfinite(x).all():
            return None
        # evidence
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
    """One linearised problem.

    Normal matrix (30, 30) and gradient (30,) and what comes with them.
    """

    normal: Float
    gradient: Float
    cost: float
    rates: Float
    weight: Float
    chi2: Float
    residual_m: Float


@dataclass(frozen=True, slots=True, eq=False)
class _Task:
    """All of a fit that stays the same from round to round.

    Attributes:
        seen: Observations, n.
        points: (n, 3) [m], object frame.
        basis: (n, ORDERS) weights of the derivatives.
        views: Their cameras.
        sums: What adds them up.
        past: What else is known.
        prior: (30, 30) information on the derivatives.
    """

    seen: Observations
    points: Float
    basis: Float
    views: Views
    sums: Sums
    past: Past | None
    prior: Float

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
        """Return (n, 2, 31) derivatives by all unknowns, and the residual.

        The unknowns are position and rotation of each order; then comes the residual.
        """
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
    sizes = np.stack(
        [_SPEED[level], acceleration, acceleration * w_per_s, acceleration * w_per_s**2]
    )  # (4, 2): of place and turn
    return np.diag(np.concatenate([_LEAST, (1.0 / sizes**2).repeat(3, axis=1).ravel()]))
