"""A weighted least-squares fit refines an initial registration.

**Initial.** Cameras and tracker sit in unknown frames, but the rotation of the object within a fifth of a
second is the same angle in all frames: the lag is where the two courses of that angle differ least. The
closed form is that of robot-world/hand-eye calibration, A Y = X B for all epochs (Shah, "Solving the
robot-world/hand-eye calibration problem using the Kronecker product", J. Mechanisms Robotics 5, 2013): the
rotations of X and Y are the first singular vectors of the sum of R_B (x) R_A, their shifts then a linear
least squares; outliers are outvoted.

**Fit.** Thirteen unknowns, as small changes: rotation a and shift d of the tracking system about the middle c
of what was seen, rotation b and shift e of the device in the object's frame, and the lag. With P, R the
predicted pose:

    P' = P + a x (P - c) + d + R e - v dt        rotation' = a + R b - w dt

Each epoch counts by the covariance that the object's pose has, with the tracker's jitter; all are scaled by
one factor, so that half of the epochs lie within what is predicted. Uncertainty comes from leaving out blocks
of time, since neighbours in time share their errors (jackknife), and where the motion determines nothing of
an unknown, from the normal equations; the larger counts.
"""

from dataclasses import dataclass
from functools import partial

import numpy as np

from common.arrays import Bool, Float, Int
from common.geometry.transforms import (
    invert,
    matrix_to_rotation_vector,
    rigid,
    rotation_vector_to_matrix,
    skew,
)
from master.calibrate.adjust import Normal, minimise, tukey
from master.calibrate.tracker.tracks import PoseTrack, nearest_rotation, shared_epochs

_DRAWN = 6
_NEAR_RAD = np.radians(6.0)


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """A registration: A(t) = X B(t - late) inv(Y)."""

    T_rig_tracking: Float  # this and T_object_tracker: X and Y (4, 4)
    T_object_tracker: Float
    late_s: float  # how much later the tracker's poses hold than their time stamps [s]


def first_places(seen: PoseTrack, tracker: PoseTrack, late_s: float, seed: int = 0) -> Placed | None:
    """A registration that most epochs agree with; None: too few epochs are shared.

    `late_s` is how much later the tracker's poses hold than their stamps [s]; `seed` is of the draws.
    """
    epochs, draws = 240, 120
    rows = shared_epochs(seen, tracker, late_s, epochs)
    if len(rows) < 2 * _DRAWN:
        return None
    RA, pA = seen.R[rows], seen.p_m[rows]
    RB, pB, _ = tracker.at(seen.t_s[rows] - late_s)
    rng = np.random.default_rng(seed)
    best: Bool | None = None
    for _ in range(draws):
        drawn = rng.choice(len(rows), _DRAWN, replace=False)
        agree = _agree(*closed_form(RA[drawn], pA[drawn], RB[drawn], pB[drawn]), RA, pA, RB, pB)
        if best is None or agree.sum() > best.sum():
            best = agree
    if best is None or best.sum() < _DRAWN:
        return None
    for _ in range(3):
        X, Y = closed_form(RA[best], pA[best], RB[best], pB[best])
        agree = _agree(X, Y, RA, pA, RB, pB)
        if agree.sum() < _DRAWN:
            break
        best = agree
    X, Y = closed_form(RA[best], pA[best], RB[best], pB[best])
    return Placed(X, Y, late_s)


def _agree(X: Float, Y: Float, RA: Float, pA: Float, RB: Float, pB: Float) -> Bool:
    rotation, place = predicted(X, Y, RB, pB)
    off = np.linalg.norm(matrix_to_rotation_vector(RA @ rotation.swapaxes(1, 2)), axis=1)
    return (off < _NEAR_RAD) & (np.linalg.norm(pA - place, axis=1) < 0.03)


def predicted(X: Float, Y: Float, RB: Float, pB: Float) -> tuple[Float, Float]:
    """The object (N, 3, 3), (N, 3) in the rig by the device (RB, pB): X B inv(Y)."""
    rotation = X[:3, :3] @ RB @ Y[:3, :3].T
    device = pB @ X[:3, :3].T + X[:3, 3]
    return rotation, device - rotation @ Y[:3, 3]


def closed_form(RA: Float, pA: Float, RB: Float, pB: Float) -> tuple[Float, Float]:
    """X and Y (4, 4) of A Y = X B, least squares, no weights (Shah, 2013).

    A = RA, pA: the object in the rig (N, 3, 3), (N, 3); B = RB, pB: the device in its system's frame.
    """
    total = np.einsum("nij,nkl->ikjl", RB, RA).reshape(9, 9)
    left, _, right = np.linalg.svd(total)
    RX, RY = _rotation(left[:, 0]), _rotation(right[0])
    # The sign of singular vectors means nothing.
    if _rotation_residual(RX, RY, RA, RB) > _rotation_residual(-RX, RY, RA, RB):
        RX = -RX
    RX, RY = (RX, RY) if np.linalg.det(RX) > 0.0 else (-RX, -RY)
    RX, RY = nearest_rotation(RX), nearest_rotation(RY)
    lines = np.concatenate([RA, np.broadcast_to(-np.eye(3), RA.shape)], axis=2).reshape(-1, 6)
    shifts: Float = np.asarray(np.linalg.lstsq(lines, (pB @ RX.T - pA).ravel(), rcond=None)[0], np.float64)
    return rigid(RX, shifts[3:]), rigid(RY, shifts[:3])


def _rotation(stacked: Float) -> Float:
    """Matrix (3, 3) of stacked columns, scaled to a determinant of 1 or -1."""
    matrix = stacked.reshape(3, 3).T
    size = float(np.cbrt(np.linalg.det(matrix)))
    return matrix / (abs(size) if abs(size) > 1e-9 else 1.0)


def _rotation_residual(RX: Float, RY: Float, RA: Float, RB: Float) -> float:
    return float(((RA @ RY - RX @ RB) ** 2).sum())


TRACKER_RAD = np.radians(0.15)
DEFAULT_SIGMA_RAD = np.radians(1.5)  # of an object's pose without covariance
OUTLIER = 4.1  # sigmas: 0.999 of chi with six degrees of freedom is within 4.7, at the good half's scale
_ROUNDS = 4
_UNKNOWNS = 13
_ANY = np.array([1.0] * 12 + [0.5])  # rad, m, rad, m, s: a step of hardly any bound


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Registration and its residuals (N epochs)."""

    placed: Placed
    middle_m: Float  # (3,) middle of the object's places, rig frame
    t_s: Float  # (N,) epochs [s]
    R: Float  # this and p_m: the object as the tracker predicts it, rig frame
    p_m: Float
    off: Float  # (N, 6) cameras minus that: place [m], rotation [rad], rig axes
    outlier: Bool  # (N,) which epochs no registration explains
    scale: float  # factor of the good half's residuals over what was predicted
    cov: Float  # (13, 13) of the unknowns, by the normal equations
    rejected: Float  # (B, 13) how the unknowns change when a block of time is omitted


@dataclass(frozen=True, slots=True, eq=False)
class _Rows:
    """Linearised equations (N epochs)."""

    R: Float  # this and p_m: the object as predicted
    p_m: Float
    off: Float  # (N, 6) seen minus predicted
    jacobian: Float  # (N, 6, 13) of the prediction


class _Problem:
    """Observations at the epochs that count."""

    def __init__(self, seen: PoseTrack, tracker: PoseTrack, rows: Int) -> None:
        self._tracker = tracker
        self.t_s, self.R, self.p_m = seen.t_s[rows], seen.R[rows], seen.p_m[rows]
        self.middle_m = self.p_m.mean(axis=0)
        default_cov = np.diag(np.repeat([3e-3, DEFAULT_SIGMA_RAD], 3) ** 2)  # of a pose without covariance
        with_cov = np.isfinite(seen.cov[rows].sum(axis=(1, 2)))[:, None, None]
        jitter = np.diag(np.repeat([1e-3, TRACKER_RAD], 3) ** 2)
        cov = np.where(with_cov, seen.cov[rows], default_cov) + jitter
        self.whiten: Float = np.asarray(np.linalg.inv(np.linalg.cholesky(cov)), np.float64)

    def rows(self, placed: Placed) -> _Rows:
        at = self.t_s - placed.late_s
        R, p = self._predicted(placed, at)
        dt_s = 4e-3
        before, after = (self._predicted(placed, at + dt) for dt in (-dt_s, dt_s))
        v = (after[1] - before[1]) / (2.0 * dt_s)
        w = matrix_to_rotation_vector(after[0] @ before[0].swapaxes(1, 2)) / (2.0 * dt_s)
        off = np.concatenate([self.p_m - p, matrix_to_rotation_vector(self.R @ R.swapaxes(1, 2))], axis=1)
        jacobian = _jacobian(R, p - self.middle_m)
        jacobian[:, :3, 12], jacobian[:, 3:, 12] = -v, -w
        return _Rows(R, p, off, jacobian)

    def _predicted(self, placed: Placed, at_s: Float) -> tuple[Float, Float]:
        rotation, place, _ = self._tracker.at(at_s)
        return predicted(placed.T_rig_tracking, placed.T_object_tracker, rotation, place)

    def sizes(self, off: Float) -> Float:
        """Residuals (N,) in sigmas of six dimensions."""
        return np.linalg.norm((self.whiten @ off[..., None])[..., 0], axis=1)

    def equations(self, placed: Placed, scale: float) -> Normal:
        """Normal equations of the registration, with all sigmas scaled."""
        return self.normal(self.rows(placed), scale)

    def normal(self, rows: _Rows, scale: float, share: Float | float = 1.0) -> Normal:
        """The same of linearised equations, of which a share (N,) counts."""
        whiten, normal = self.whiten / scale, Normal(_UNKNOWNS)
        normal.add(
            (whiten @ -rows.off[..., None])[..., 0],
            whiten @ rows.jacobian,
            loss=tukey(2.0 * OUTLIER),
            group=6,
            share=share,
        )
        normal.add_prior(np.zeros(_UNKNOWNS), _ANY)
        return normal

    def retracted(self, placed: Placed, by: Float, _own: Float) -> Placed:
        rotation = rotation_vector_to_matrix(by[:3])
        X = rigid(rotation, self.middle_m - rotation @ self.middle_m + by[3:6]) @ placed.T_rig_tracking
        Z = invert(placed.T_object_tracker) @ rigid(rotation_vector_to_matrix(by[6:9]), by[9:12])
        return Placed(X, invert(Z), placed.late_s + float(by[12]))


def fit_registration(seen: PoseTrack, tracker: PoseTrack, first: Placed) -> Fit:
    """Fit the registration to all epochs known to both cameras and tracker.

    `first` is right to some centimetres, degrees and ten milliseconds.
    """
    most = 900  # epochs
    coarse = _Problem(seen, tracker, shared_epochs(seen, tracker, first.late_s, most))
    better, _ = _refined(coarse, first)
    # Again, because the lag decides which epochs are known.
    problem = _Problem(seen, tracker, shared_epochs(seen, tracker, better.late_s, most))
    placed, scale = _refined(problem, better)
    rows = problem.rows(placed)
    changes: list[Float] = []  # of the unknowns when a block of time is omitted, by one step
    for block in blocks_of(problem.t_s):
        step = problem.normal(rows, scale, np.where(block, 0.0, 1.0)).step(0.0)
        changes.append(np.zeros(_UNKNOWNS) if step is None else step[0])
    return Fit(
        placed, problem.middle_m, problem.t_s, rows.R, rows.p_m, rows.off,
        problem.sizes(rows.off) / scale > OUTLIER, scale, problem.normal(rows, scale).covariance(), np.array(changes),
    )  # fmt: skip


def sigma_at(fit: Fit, R: Float, p_m: Float) -> tuple[float, float]:
    """Uncertainty of an object's pose by the tracker: position [m], rotation [rad].

    At poses (T, 3, 3), (T, 3) of the rig; root mean square over the poses, all axes together.
    """
    jacobian = _jacobian(R, p_m - fit.middle_m)
    formal = np.einsum("tij,jk,tik->ti", jacobian, fit.cov, jacobian)
    both = np.maximum(formal, _jackknife(np.einsum("tij,bj->bti", jacobian, fit.rejected)))
    place, rotation = both[:, :3].sum(axis=1).mean(), both[:, 3:].sum(axis=1).mean()
    return float(np.sqrt(place)), float(np.sqrt(rotation))


def late_sigma_s(fit: Fit) -> float:
    """Standard deviation of the lag [s]."""
    return float(np.sqrt(max(float(_jackknife(fit.rejected[:, 12])), fit.cov[12, 12])))


def _jackknife(values: Float) -> Float:
    """Variance of (B, ...) values, each without another block of time (Efron 1982)."""
    count = len(values)
    return np.asarray((count - 1) / count * ((values - values.mean(axis=0)) ** 2).sum(axis=0), np.float64)


def _jacobian(R: Float, arm_m: Float) -> Float:
    """Derivatives (N, 6, 13) of predicted poses by all unknowns but the lag.

    Of rotations R (N, 3, 3), `arm_m` (N, 3) from the middle.
    """
    jacobian = np.zeros((len(R), 6, _UNKNOWNS))
    jacobian[:, :3, 0:3] = -skew(arm_m)
    jacobian[:, :3, 3:6] = jacobian[:, 3:, 0:3] = np.eye(3)
    jacobian[:, 3:, 6:9] = jacobian[:, :3, 9:12] = R
    return jacobian


def _refined(problem: _Problem, placed: Placed) -> tuple[Placed, float]:
    scale = 1.0
    for _ in range(_ROUNDS):
        half = 5.348  # median of chi square with six degrees of freedom
        median = float(np.median(problem.sizes(problem.rows(placed).off) ** 2))
        scale = max(float(np.sqrt(median / half)), 1e-3)
        placed = minimise(partial(problem.equations, scale=scale), problem.retracted, placed, steps=6).x
    return placed, scale


def blocks_of(t_s: Float) -> list[Bool]:
    """One mask (N,) for each block of time: the epochs in it."""
    share = (t_s - t_s[0]) / (t_s[-1] - t_s[0] + 1e-9)
    blocks = 12
    number = (blocks * share).astype(np.int64)
    return [number == k for k in range(blocks) if (number == k).any()]
