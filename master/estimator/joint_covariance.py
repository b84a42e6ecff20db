"""Kernels of how sure each joint is: this epoch and the state before.

The estimates of this epoch and of the state before are not independent: the same priors, and errors of markers
that repeat, are in both. So they are never added up as the Kalman filter does (Julier, Uhlmann 1997, "A non-divergent
estimation algorithm in the presence of unknown correlations", show what that leads to). In each direction the surer of
the two is taken, and no more: in the coordinates in which the covariance of this epoch is the unit matrix and that of
the past diagonal, the smaller of each pair. Where every finger is seen this epoch constrains more, and counts alone.
"""

from math import acos, cos, sqrt

from common.arrays import Float, Int
from common.hand.model import CHAINS
from common.kernels import constant, inlined, inner
from common.messages.records import record
from master.estimator.hand_tables import HandTables
from master.estimator.kinematics import DIRECTION, PLACE, Scratch, finger_jacobian, palm_jacobian
from master.estimator.matrices import cholesky, eigen
from master.estimator.settings import Settings
from master.estimator.state import Hidden

_LAST = constant(3)  # joint of a finger: its tip
MOST_ROTATIONS = 12  # turns that count in arcs: those of the palm, which moves all joints, then the largest


class CovarianceScratch:
    """Scratch for N unknowns and M markers."""

    A: Float  # (N, N)
    L: Float  # (N, N)
    V: Float  # (N, N)
    work: Float  # (N, N)
    values: Float  # (N,)
    rotations: Float  # (12, N) columns of the factor, as rows
    left: Float  # (N,)
    w: Float  # (5, 4, 12, 3)
    joint: Float  # (78, 26, 3) arcs of joints, by pair
    marker: Float  # (78, 3 M) of markers, whitened
    Jm: Float  # (3 M, N)
    gain: Float  # (N, 3 M)
    B: Float  # (3 M, 3 M)
    BL: Float  # (3 M, 3 M)
    BV: Float  # (3 M, 3 M)
    B_values: Float  # (3 M,)
    row: Float  # (3 M,)
    white: Float  # (3, 3)
    C: Float  # (10, 3)
    J: Float  # (10, 3)
    at: Int  # (10,)
    joint_of: Int  # (5, 4) the joints of the chains

    @classmethod
    def empty(cls, N: int, markers: int) -> "CovarianceScratch":
        """Allocate it."""
        K, pairs = 3 * markers, MOST_ROTATIONS * (MOST_ROTATIONS + 1) // 2
        scratch = record(
            cls,
            A=(N, N),
            L=(N, N),
            V=(N, N),
            work=(N, N),
            values=N,
            rotations=(MOST_ROTATIONS, N),
            left=N,
            w=(5, 4, MOST_ROTATIONS, 3),
            joint=(pairs, 26, 3),
            marker=(pairs, K),
            Jm=(K, N),
            gain=(N, K),
            B=(K, K),
            BL=(K, K),
            BV=(K, K),
            B_values=K,
            row=K,
            white=(3, 3),
            C=(10, 3),
            J=(10, 3),
            at=("i8", 10),
            joint_of=("i8", (5, 4)),
        )
        scratch.joint_of[:] = CHAINS
        return scratch


@inner
def surer(now: Float, past: Float, scratch: CovarianceScratch, out: Float) -> None:
    """Write the covariance (N, N) that is the smaller of two in each direction.

    Both are positive definite.
    """
    N, L, A, V = now.shape[0], scratch.L, scratch.A, scratch.V
    if not cholesky(now, N, L):
        for i in range(N):
            for j in range(N):
                out[i, j] = past[i, j]
        return
    for j in range(N):  # A = L^-1 past
        for i in range(N):
            total = past[i, j]
            for k in range(i):
                total -= L[i, k] * A[k, j]
            A[i, j] = total / L[i, i]
    for i in range(N):  # A L^-T, row by row
        for j in range(N):
            total = A[i, j]
            for k in range(j):
                total -= scratch.work[i, k] * L[j, k]
            scratch.work[i, j] = total / L[j, j]
    for i in range(N):
        for j in range(N):
            A[i, j] = 0.5 * (scratch.work[i, j] + scratch.work[j, i])
    eigen(A, N, scratch.values, V)
    for i in range(N):
        for j in range(N):
            total = 0.0
            for k in range(i + 1):
                total += L[i, k] * V[k, j]
            scratch.work[i, j] = total
    for i in range(N):
        for j in range(i + 1):
            total = 0.0
            for k in range(N):
                total += scratch.work[i, k] * min(scratch.values[k], 1.0) * scratch.work[j, k]
            out[i, j] = out[j, i] = total


@inner
def only_limits(hand: HandTables, x: Float, hidden: Hidden, cov: Float) -> None:
    """Reduce an epoch's information on hidden fingers to their limits.

    The limits are seen from where the fingers are expected.
    """
    N = cov.shape[0]
    for f in range(5):
        if hidden.gone_s[f] <= 0.0:
            continue
        for c in range(hand.first[f], hand.first[f + 1]):
            for i in range(N):
                cov[6 + c, i] = cov[i, 6 + c] = 0.0
            off = 0.5 * (hand.low[c] + hand.high[c]) - x[c]
            cov[6 + c, 6 + c] = 1.0 / hand.anywhere[6 + c] + off * off


@inner
def joint_jacobian(hand: HandTables, joint: int, T: Float, work: Scratch, scratch: CovarianceScratch) -> int:
    """Write the derivatives of a joint (10, 3) and their unknowns.

    Return how many unknowns they belong to.
    """
    f, level = hand.finger[joint], hand.level[joint]
    for i in range(3):
        work.point[i] = work.P[f, level, i] if f >= 0 else T[i, 3]
        for j in range(3):
            work.point[i] += 0.0 if f >= 0 else T[i, j] * hand.rest_m[joint, j]
        work.arm[i] = work.point[i] - T[i, 3]
    palm_jacobian(work.arm, scratch.J)
    for a in range(6):
        scratch.at[a] = a
    if f < 0:
        return 6
    count = int(hand.first[f + 1] - hand.first[f])
    finger_jacobian(hand, work.by, T, work.R, work.P, f, level, work.point, PLACE, scratch.J)
    for c in range(count):
        scratch.at[6 + c] = 6 + hand.first[f] + c
    return 6 + count


@inlined
def _project(cov: Float, count: int, scratch: CovarianceScratch, out: Float) -> None:
    """Write J' cov J (3, 3) of the rows in use."""
    for a in range(count):
        for i in range(3):
            total = 0.0
            for b in range(count):
                total += cov[scratch.at[a], scratch.at[b]] * scratch.J[b, i]
            scratch.C[a, i] = total
    for i in range(3):
        for j in range(3):
            total = 0.0
            for a in range(count):
                total += scratch.J[a, i] * scratch.C[a, j]
            out[i, j] = total


@inner
def linear(
    hand: HandTables, T: Float, cov: Float, work: Scratch, scratch: CovarianceScratch, joint_cov: Float
) -> None:
    """Write the covariances of the joints (26, 3, 3) [m^2], by derivatives.

    `work` is as `chains` left it.
    """
    for joint in range(26):
        count = joint_jacobian(hand, joint, T, work, scratch)
        _project(cov, count, scratch, joint_cov[joint])


@inner
def tilts(
    hand: HandTables,
    settings: Settings,
    T: Float,
    cov: Float,
    work: Scratch,
    scratch: CovarianceScratch,
    tilt: Float,
    process_noise: Float,
) -> None:
    """Write the covariances of the last phalanges' directions (5, 3, 3) [rad^2].

    Write also how fast they walk (5,).

    `work` as `chains` left it; of the walk the trace [rad^2/s^2].
    """
    for f in range(5):
        squared = 0.0
        for i in range(3):
            work.ahead[i] = work.P[f, 3, i] - work.P[f, 2, i]
            squared += work.ahead[i] ** 2
        for i in range(3):
            work.ahead[i] /= sqrt(squared)
        palm_jacobian(work.ahead, scratch.J)
        finger_jacobian(hand, work.by, T, work.R, work.P, f, _LAST, work.ahead, DIRECTION, scratch.J)
        count = hand.first[f + 1] - hand.first[f]
        for a in range(6 + count):
            scratch.at[a] = a if a < 6 else hand.first[f] + a
            for i in range(3):
                scratch.J[a, i] = 0.0 if 3 <= a < 6 else scratch.J[a, i]
        process_noise[f] = 0.0
        for a in range(6 + count):
            rate = settings.palm_process_noise_rad_s if a < 3 else settings.process_noise_rad_s
            for i in range(3):
                process_noise[f] += (rate * scratch.J[a, i]) ** 2
        _project(cov, 6 + count, scratch, tilt[f])


@inlined
def _widest(C: Float) -> float:
    """Return the largest eigenvalue of a symmetric matrix (3, 3).

    It solves the characteristic polynomial.
    """
    mean = (C[0, 0] + C[1, 1] + C[2, 2]) / 3.0
    a, b, c = C[0, 0] - mean, C[1, 1] - mean, C[2, 2] - mean
    d, e, f = C[0, 1], C[0, 2], C[1, 2]
    p = sqrt((a * a + b * b + c * c + 2.0 * (d * d + e * e + f * f)) / 6.0)
    if not p > 0.0:
        return mean
    determinant = a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e)
    return mean + 2.0 * p * cos(acos(min(max(0.5 * determinant / p**3, -1.0), 1.0)) / 3.0)


@inner
def is_small(hand: HandTables, cov: Float, joint: int, most_m: float) -> bool:
    """Return whether a joint's 95 % region stays within a distance.

    The covariances are (26, 3, 3).

    And that of its finger's PIP: a tip may be known to millimetres, and not how the finger is bent.
    """
    quantile_95 = 7.815  # chi square of three numbers
    most_m2 = most_m * most_m / quantile_95
    return _widest(cov[joint]) < most_m2 and _widest(cov[hand.middle[joint]]) < most_m2
