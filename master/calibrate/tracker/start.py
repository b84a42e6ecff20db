"""Initial registration without a prior.

The lag by how fast both rotate, the positions in closed form, outliers outvoted.

Cameras and tracker sit in frames that nobody knows yet, but by how much the object turned within a fifth of a second
is the same number in all frames. So the lag is where the two courses of that number differ least.

The closed form is that of robot-world/hand-eye calibration, A Y = X B for all epochs (Shah, "Solving the
robot-world/hand-eye calibration problem using the Kronecker product", J. Mechanisms Robotics 5, 2013): the turns of X
and Y are the first singular vectors of the sum of R_B (x) R_A, their shifts then a linear least squares.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float
from common.geometry.transforms import matrix_to_rotation_vector, rigid
from master.calibrate.tracker.tracks import PoseTrack, shared_epochs

_DRAWN = 6
_NEAR_RAD = np.radians(6.0)


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """A registration: A(t) = X B(t - late) inv(Y).

    Attributes:
        T_rig_tracking: X (4, 4).
        T_object_tracker: Y (4, 4).
        late_s: How much later the tracker's poses hold than their time stamps [s].
    """

    T_rig_tracking: Float
    T_object_tracker: Float
    late_s: float


def first_lag(seen: PoseTrack, tracker: PoseTrack) -> float | None:
    """Return how much later the tracker's poses hold than their stamps [s].

    To some milliseconds; None: they hardly overlap.
    """
    most_lag_s = 0.5
    begin = min(seen.t_s[0], tracker.t_s[0]) - most_lag_s
    grid_s = 0.01
    grid = np.arange(begin, max(seen.t_s[-1], tracker.t_s[-1]) + most_lag_s, grid_s)
    ours, theirs = _rotated(seen, grid), _rotated(tracker, grid)
    steps = round(most_lag_s / grid_s)
    costs: list[float] = []
    for lag in range(-steps, steps + 1):
        moved = np.full_like(theirs, np.nan)
        if lag >= 0:
            moved[lag:] = theirs[: len(theirs) - lag]
        else:
            moved[:lag] = theirs[-lag:]
        off = np.abs(ours - moved)
        off = off[np.isfinite(off)]
        least_overlap = 100  # of the grid: one second
        costs.append(float(np.mean(np.minimum(off, 0.3))) if len(off) >= least_overlap else np.inf)
    best = int(np.argmin(costs))
    if not np.isfinite(costs[best]):
        return None
    fine = 0.0
    if 0 < best < len(costs) - 1 and np.isfinite([costs[best - 1], costs[best + 1]]).all():
        before, here, after = costs[best - 1 : best + 2]
        curvature = before - 2.0 * here + after
        fine = 0.5 * (before - after) / curvature if curvature > 0.0 else 0.0
    return (best - steps + fine) * grid_s


def _rotated(track: PoseTrack, t_s: Float) -> Float:
    """Return the angle of rotation around each time [rad].

    NaN where that is not known.
    """
    chord_s = 0.2
    first, _, known = track.at(t_s - 0.5 * chord_s)
    last, _, also = track.at(t_s + 0.5 * chord_s)
    angle = np.linalg.norm(matrix_to_rotation_vector(first.swapaxes(1, 2) @ last), axis=1)
    return np.where(known & also, angle, np.nan)


def first_places(seen: PoseTrack, tracker: PoseTrack, late_s: float, seed: int = 0) -> Placed | None:
    """Return a registration that most epochs agree with.

    None: too few epochs are shared.

    Args:
        seen: The object, by the cameras.
        tracker: The device, by its system.
        late_s: How much later its poses hold than their time stamps [s].
        seed: Of the draws.
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
    near_m = 0.03
    return (off < _NEAR_RAD) & (np.linalg.norm(pA - place, axis=1) < near_m)


def predicted(X: Float, Y: Float, RB: Float, pB: Float) -> tuple[Float, Float]:
    """Predict the object's rotations (N, 3, 3) and positions (N, 3) in the rig.

    Where the device is at (RB, pB): X B inv(Y).
    """
    rotation = X[:3, :3] @ RB @ Y[:3, :3].T
    device = pB @ X[:3, :3].T + X[:3, 3]
    return rotation, device - rotation @ Y[:3, 3]


def closed_form(RA: Float, pA: Float, RB: Float, pB: Float) -> tuple[Float, Float]:
    """X and Y (4, 4) of A Y = X B, least squares, no weights (Shah, 2013).

    Args:
        RA, pA: The object in the rig (N, 3, 3), (N, 3).
        RB, pB: The device in its system's frame.
    """
    total = np.einsum("nij,nkl->ikjl", RB, RA).reshape(9, 9)
    left, _, right = np.linalg.svd(total)
    RX, RY = _rotation(left[:, 0]), _rotation(right[0])
    if _rotation_residual(RX, RY, RA, RB) > _rotation_residual(
        -RX, RY, RA, RB
    ):  # the sign of singular vectors means nothing
        RX = -RX
    RX, RY = (RX, RY) if np.linalg.det(RX) > 0.0 else (-RX, -RY)
    RX, RY = _nearest(RX), _nearest(RY)
    lines = np.concatenate([RA, np.broadcast_to(-np.eye(3), RA.shape)], axis=2).reshape(-1, 6)
    shifts: Float = np.asarray(np.linalg.lstsq(lines, (pB @ RX.T - pA).ravel(), rcond=None)[0], np.float64)
    return rigid(RX, shifts[3:]), rigid(RY, shifts[:3])


def _rotation(stacked: Float) -> Float:
    """Return the matrix (3, 3) whose columns were stacked.

    Scaled to a determinant of 1 or -1.
    """
    matrix = stacked.reshape(3, 3).T
    size = float(np.cbrt(np.linalg.det(matrix)))
    return matrix / (abs(size) if abs(size) > 1e-9 else 1.0)


def _rotation_residual(RX: Float, RY: Float, RA: Float, RB: Float) -> float:
    return float(((RA @ RY - RX @ RB) ** 2).sum())


def _nearest(matrix: Float) -> Float:
    """The rotation nearest to a matrix (3, 3)."""
    left, _, right = np.linalg.svd(matrix)
    return np.asarray(left @ np.diag([1.0, 1.0, float(np.linalg.det(left @ right))]) @ right)
