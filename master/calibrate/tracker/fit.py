"""Most probable registration, by weighted least squares.

Over all shared epochs, outliers down-weighted.

Thirteen unknowns, as small changes of what is there: a turn a and shift d of the tracking system about the middle c of
what was seen, a turn b and shift e of the device in the object's frame, and the lag. With P, R the predicted pose:

    P' = P + a x (P - c) + d + R e - v dt        turn' = a + R b - w dt

Each epoch counts by the covariance that the object's pose has, with what a tracker's jitter is; all of these are
scaled by one factor, so that half of the epochs lie within what is predicted. How sure the result is comes from the
leaving out of blocks of time, since neighbours in time share their errors (jackknife), and where the motion determines
nothing of an unknown, from the normal equations; the larger counts.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float, Int
from common.geometry.transforms import (
    invert,
    matrix_to_rotation_vector,
    rigid,
    rotation_vector_to_matrix,
    skew,
)
from master.calibrate.tracker.start import Placed, predicted
from master.calibrate.tracker.tracks import PoseTrack, shared_epochs

TRACKER_RAD = np.radians(0.15)
DEFAULT_SIGMA_RAD = np.radians(1.5)  # of an object's pose without covariance
OUTLIER = (
    4.1  # times sigma: 0.999 of chi with six degrees of freedom is within 4.7, at the scale of the good half
)
_ROUNDS = 4
_UNKNOWNS = 13
_PRIOR = (
    np.array([1.0] * 3 + [1.0] * 3 + [1.0] * 3 + [1.0] * 3 + [0.5]) ** -2
)  # rad, m, rad, m, s: hardly any


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Registration and its residuals (N epochs).

    Attributes:
        placed: The registration.
        middle_m: (3,) middle of the object's places, rig frame.
        t_s: (N,) epochs [s].
        R, p_m: The object as the tracker foretells it, rig frame.
        off: (N, 6) what cameras saw against that: place [m], turn [rad], rig axes.
        outlier: (N,) which epochs no registration explains.
        scale: By how much more than predicted the good half is off.
        cov: (13, 13) of the unknowns, by the normal equations.
        rejected: (B, 13) how the unknowns change when a block of time is omitted.
    """

    placed: Placed
    middle_m: Float
    t_s: Float
    R: Float
    p_m: Float
    off: Float
    outlier: Bool
    scale: float
    cov: Float
    rejected: Float


@dataclass(frozen=True, slots=True, eq=False)
class _Lines:
    """Linearised equations at a registration.

    Residuals (N, 6), and their derivatives by the unknowns (N, 6, 13).
    """

    R: Float
    p_m: Float
    off: Float
    jacobian: Float


class _Problem:
    """Observations at the epochs that count."""

    def __init__(self, seen: PoseTrack, tracker: PoseTrack, rows: Int) -> None:
        self._tracker = tracker
        self.t_s, self.R, self.p_m = seen.t_s[rows], seen.R[rows], seen.p_m[rows]
        self.middle_m = self.p_m.mean(axis=0)
        default_sigma_m = 3e-3  # of an object's pose without covariance
        default_cov = np.diag(np.repeat([default_sigma_m, DEFAULT_SIGMA_RAD], 3) ** 2)
        with_cov = np.isfinite(seen.cov[rows].sum(axis=(1, 2)))[:, None, None]
        tracker_m = 1e-3
        jitter = np.diag(np.repeat([tracker_m, TRACKER_RAD], 3) ** 2)
        cov = np.where(with_cov, seen.cov[rows], default_cov) + jitter
        self.weight: Float = np.asarray(np.linalg.inv(cov), np.float64)

    def lines(self, placed: Placed) -> _Lines:
        at = self.t_s - placed.late_s
        R, p = self._predicted(placed, at)
        dt_s = 4e-3
        before, after = (self._predicted(placed, at + dt) for dt in (-dt_s, dt_s))
        v = (after[1] - before[1]) / (2.0 * dt_s)
        w = matrix_to_rotation_vector(after[0] @ before[0].swapaxes(1, 2)) / (2.0 * dt_s)
        off = np.concatenate([self.p_m - p, matrix_to_rotation_vector(self.R @ R.swapaxes(1, 2))], axis=1)
        jacobian = np.zeros((len(at), 6, _UNKNOWNS))
        jacobian[:, :3, 0:3] = -skew(p - self.middle_m)
        jacobian[:, :3, 3:6] = jacobian[:, 3:, 0:3] = np.eye(3)
        jacobian[:, 3:, 6:9] = jacobian[:, :3, 9:12] = R
        jacobian[:, :3, 12], jacobian[:, 3:, 12] = -v, -w
        return _Lines(R, p, off, jacobian)

    def _predicted(self, placed: Placed, at_s: Float) -> tuple[Float, Float]:
        rotation, place, _ = self._tracker.at(at_s)
        return predicted(placed.T_rig_tracking, placed.T_object_tracker, rotation, place)

    def retracted(self, placed: Placed, by: Float) -> Placed:
        rotation = rotation_vector_to_matrix(by[:3])
        X = rigid(rotation, self.middle_m - rotation @ self.middle_m + by[3:6]) @ placed.T_rig_tracking
        Z = invert(placed.T_object_tracker) @ rigid(rotation_vector_to_matrix(by[6:9]), by[9:12])
        return Placed(X, invert(Z), placed.late_s + float(by[12]))


def fit_registration(seen: PoseTrack, tracker: PoseTrack, first: Placed) -> Fit:
    """Fit the registration to all epochs known to both cameras and tracker.

    Args:
        seen: The object, by the cameras.
        tracker: The device, by its system.
        first: Right to some centimetres, degrees and ten milliseconds.
    """
    most = 900  # epochs
    coarse = _Problem(seen, tracker, shared_epochs(seen, tracker, first.late_s, most))
    better, _ = _refined(coarse, first)
    # Again, because the lag decides which epochs are known.
    problem = _Problem(seen, tracker, shared_epochs(seen, tracker, better.late_s, most))
    placed, scale = _refined(problem, better)
    lines = problem.lines(placed)
    sizes = _sizes(problem.weight, lines.off) / scale
    counts = _counts(sizes)
    normal = _normal(problem.weight, lines, counts) / scale**2 + np.diag(_PRIOR)
    rejected = [_without(problem, lines, counts / scale**2, block) for block in _blocks(problem.t_s)]
    return Fit(
        placed,
        problem.middle_m,
        problem.t_s,
        lines.R,
        lines.p_m,
        lines.off,
        sizes > OUTLIER,
        scale,
        np.asarray(np.linalg.inv(normal), np.float64),
        np.array(rejected).reshape(-1, _UNKNOWNS),
    )


def sigma_at(fit: Fit, R: Float, p_m: Float) -> tuple[float, float]:
    """Return the uncertainty of an object's pose by the tracker.

    At poses (T, 3, 3), (T, 3) of the rig: position [m], rotation [rad].

    Root of the mean square over the poses, all axes together.
    """
    jacobian = np.zeros((len(R), 6, _UNKNOWNS))
    jacobian[:, :3, 0:3] = -skew(p_m - fit.middle_m)
    jacobian[:, :3, 3:6] = jacobian[:, 3:, 0:3] = np.eye(3)
    jacobian[:, 3:, 6:9] = jacobian[:, :3, 9:12] = R
    formal = np.einsum("tij,jk,tik->ti", jacobian, fit.cov, jacobian)
    count = len(fit.rejected)
    change = np.einsum("tij,bj->tbi", jacobian, fit.rejected - fit.rejected.mean(axis=0))
    left = (count - 1) / count * (change**2).sum(axis=1) if count > 1 else np.zeros_like(formal)
    both = np.maximum(formal, left)
    place, rotation = both[:, :3].sum(axis=1).mean(), both[:, 3:].sum(axis=1).mean()
    return float(np.sqrt(place)), float(np.sqrt(rotation))


def late_sigma_s(fit: Fit) -> float:
    """Standard deviation of the lag [s]."""
    count = len(fit.rejected)
    off = fit.rejected[:, 12] - fit.rejected[:, 12].mean()
    left = (count - 1) / count * float((off**2).sum()) if count > 1 else 0.0
    return float(np.sqrt(max(left, fit.cov[12, 12])))


def _refined(problem: _Problem, placed: Placed) -> tuple[Placed, float]:
    scale = 1.0
    for _ in range(_ROUNDS):
        sizes = _sizes(problem.weight, problem.lines(placed).off)
        half = 5.348  # median of chi square with six degrees of freedom
        scale = max(float(np.sqrt(np.median(sizes**2) / half)), 1e-3)
        steps = 6
        for _ in range(steps):
            lines = problem.lines(placed)
            counts = _counts(_sizes(problem.weight, lines.off) / scale)
            normal = _normal(problem.weight, lines, counts) / scale**2 + np.diag(_PRIOR)
            pull = _pull(problem.weight, lines, counts) / scale**2
            by = np.asarray(np.linalg.solve(normal, pull), np.float64)
            placed = problem.retracted(placed, by)
            if np.abs(by).max() < 1e-7:
                break
    return placed, scale


def _sizes(weight: Float, off: Float) -> Float:
    """(N,) how far off, in sigmas of six dimensions."""
    return np.sqrt(np.einsum("ni,nij,nj->n", off, weight, off))


def _counts(sizes: Float) -> Float:
    """Return the weights (N,) of the epochs by Tukey's biweight.

    Zero for a residual of twice the outlier limit or more.
    """
    return np.clip(1.0 - (sizes / (2.0 * OUTLIER)) ** 2, 0.0, 1.0) ** 2


def _normal(weight: Float, lines: _Lines, counts: Float) -> Float:
    return np.einsum("n,nia,nij,njb->ab", counts, lines.jacobian, weight, lines.jacobian, optimize=True)


def _pull(weight: Float, lines: _Lines, counts: Float) -> Float:
    return np.einsum("n,nia,nij,nj->a", counts, lines.jacobian, weight, lines.off, optimize=True)


def _blocks(t_s: Float) -> list[Bool]:
    """Return one mask (N,) for each block of time: the epochs in it."""
    share = (t_s - t_s[0]) / (t_s[-1] - t_s[0] + 1e-9)
    blocks = 12
    number = (blocks * share).astype(np.int64)
    return [number == k for k in range(blocks) if (number == k).any()]


def _without(problem: _Problem, lines: _Lines, counts: Float, block: Bool) -> Float:
    """Return the change of the unknowns (13,) when a block is omitted.

    One step from the whole.
    """
    kept = np.where(block, 0.0, counts)
    normal = _normal(problem.weight, lines, kept) + np.diag(_PRIOR)
    return np.asarray(np.linalg.solve(normal, _pull(problem.weight, lines, kept)), np.float64)
