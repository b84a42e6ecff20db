"""Covariance of each joint, to second order where joints move on arcs.

The estimates of this epoch and of the state before share priors and the errors of markers that repeat, so
they are not added up as a Kalman filter does (Julier, Uhlmann 1997, "A non-divergent estimation algorithm in
the presence of unknown correlations"). In each direction the surer of the two counts: in the coordinates in
which the covariance of this epoch is the unit matrix and that of the past diagonal, the smaller of each pair.

Linear covariances leave arcs out: a palm turned by 30 degrees about the one marker on its back has its wrist
8 mm off the tangent. A bone b that is turned by w moves by w x b + w x (w x b) / 2 to second order. With w =
sum_k c_k w_k, c_k independent of variance one, and h summed over the bones from the palm's origin to the
joint (Isserlis 1918),

    h_kl = (w_k x (w_l x b) + w_l x (w_k x b)) / 2
    E[(sum_kl c_k c_l h_kl / 2)(sum_kl c_k c_l h_kl / 2)'] = (sum_k h_kk)(sum_k h_kk)' / 4 + sum_kl h_kl h_kl' / 2

w_k are columns of a pivoted Cholesky factor of the turns' covariance, as many as are not straight. No turn
moves a marker that is seen: its arc h^m is taken back by the response of the fit to a marker that moved so
far,

    h - J K h^m,   K = cov Jm' (Jm cov Jm' v R)^-1

R is the covariance of the markers, and v takes the larger in each direction.
"""

from math import acos, cos, sqrt

from common.arrays import Bool, Float, Int
from common.hand.model import CHAINS
from common.kernels import constant, inlined, inner
from common.records import record
from master.estimator.kinematics import (
    DIRECTION,
    PLACE,
    Scratch,
    finger_jacobian,
    marker_point,
    palm_jacobian,
)
from master.estimator.parameters import HandTables
from master.estimator.problem import Rig
from master.estimator.settings import Settings
from master.estimator.state import Hidden
from master.fabrik.linear_algebra import cholesky, eigen

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
            **dict.fromkeys(("A", "L", "V", "work"), (N, N)),
            **dict.fromkeys(("B", "BL", "BV"), (K, K)),
            values=N,
            left=N,
            rotations=(MOST_ROTATIONS, N),
            w=(5, 4, MOST_ROTATIONS, 3),
            joint=(pairs, 26, 3),
            marker=(pairs, K),
            Jm=(K, N),
            gain=(N, K),
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
    """Write, in each direction, the smaller of two positive definite covariances."""
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
    """Reduce an epoch's information on hidden fingers to their limits."""
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
    """Write a joint's derivatives (10, 3) and their unknowns; return how many."""
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
    """Write the covariances of the joints (26, 3, 3) [m^2] by derivatives."""
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
    """Write the last phalanges' covariances (5, 3, 3) [rad^2] and walk [rad^2/s^2]."""
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
    """Return the largest eigenvalue of a symmetric matrix (3, 3)."""
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
    """Return whether the 95 % region of a joint stays within a distance.

    That of its finger's PIP must, too: a tip may be known to millimetres, and not how the finger is bent.
    """
    quantile_95 = 7.815  # chi square of three numbers
    most_m2 = most_m * most_m / quantile_95
    return _widest(cov[joint]) < most_m2 and _widest(cov[hand.middle[joint]]) < most_m2


_NONE = constant(0)


@inner
def _rotation_columns(settings: Settings, cov: Float, scratch: CovarianceScratch) -> int:
    """Write rotations above `rotation_most_rad` (pivoted Cholesky); return how many."""
    N, left = cov.shape[0], scratch.left
    for i in range(N):
        left[i] = 0.0 if 3 <= i < 6 else cov[i, i]
    count = 0
    while count < MOST_ROTATIONS:
        pivot = 0
        for i in range(3):
            if left[i] > left[pivot]:
                pivot = i
        if not left[pivot] > settings.straight_rad**2:
            for i in range(6, N):
                if left[i] > left[pivot]:
                    pivot = i
        if not left[pivot] > settings.straight_rad**2:
            break
        root, squared = sqrt(left[pivot]), 0.0
        for i in range(N):
            value = 0.0 if 3 <= i < 6 else cov[i, pivot]
            for k in range(count):
                value -= scratch.rotations[k, i] * scratch.rotations[k, pivot]
            value = 0.0 if 3 <= i < 6 else value / root
            scratch.rotations[count, i] = value
            squared += value * value
            left[i] = max(left[i] - value * value, 0.0)
        left[pivot] = 0.0
        most = settings.rotation_most_rad
        scratch.values[count] = min(most / sqrt(squared), 1.0)
        count += 1
    return count


@inner
def _bone_rotations(
    hand: HandTables, T: Float, count: int, work: Scratch, scratch: CovarianceScratch
) -> None:
    """Write how palm and joints before it rotate each bone (5, 4, K, 3)."""
    for f in range(5):
        columns = hand.first[f + 1] - hand.first[f]
        for k in range(count):
            scale = scratch.values[k]
            for i in range(3):
                scratch.w[f, 0, k, i] = scale * scratch.rotations[k, i]
        for axis in range(4):
            ax, ay, az = -work.R[f, max(axis - 1, 0), 0, 0], -work.R[f, max(axis - 1, 0), 1, 0], 0.0
            az = -work.R[f, max(axis - 1, 0), 2, 0]
            if axis == 0:
                ax = ay = az = 0.0
                for j in range(3):
                    ax += T[0, j] * hand.abduction_axis[f, j]
                    ay += T[1, j] * hand.abduction_axis[f, j]
                    az += T[2, j] * hand.abduction_axis[f, j]
            # Abduction and flexion turn the first bone behind the root, PIP the next, DIP the last.
            bone, before = max(axis, 1), max(axis - 1, 0)
            for k in range(count):
                rate = 0.0
                for c in range(columns):
                    rate += work.by[4 * f + axis, c] * scratch.rotations[k, 6 + hand.first[f] + c]
                rate *= scratch.values[k]
                for i in range(3):
                    if axis != 1:
                        scratch.w[f, bone, k, i] = scratch.w[f, before, k, i]
                scratch.w[f, bone, k, 0] += rate * ax
                scratch.w[f, bone, k, 1] += rate * ay
                scratch.w[f, bone, k, 2] += rate * az


@inlined
def _second_derivative(one: Float, other: Float, bx: float, by: float, bz: float, i: int) -> float:
    """Component i of h of a bone that is turned by two turns (3,)."""
    b = bx if i == 0 else (by if i == 1 else bz)
    one_b = one[0] * bx + one[1] * by + one[2] * bz
    other_b = other[0] * bx + other[1] * by + other[2] * bz
    both = one[0] * other[0] + one[1] * other[1] + one[2] * other[2]
    return 0.5 * (one[i] * other_b + other[i] * one_b) - both * b


@inner
def _second_derivatives(
    rig: Rig, T: Float, seen: Bool, k: int, m: int, pair: int, work: Scratch, scratch: CovarianceScratch
) -> None:
    """Write second derivatives of joints and markers (not whitened) by k and m."""
    hand, mounts, w = rig.hand, rig.mounts, scratch.w
    for joint in range(26):
        if hand.finger[joint] >= 0:
            continue
        bx = by = bz = 0.0
        for j in range(3):
            bx += T[0, j] * hand.rest_m[joint, j]
            by += T[1, j] * hand.rest_m[joint, j]
            bz += T[2, j] * hand.rest_m[joint, j]
        for i in range(3):
            scratch.joint[pair, joint, i] = _second_derivative(w[0, 0, k], w[0, 0, m], bx, by, bz, i)
    for joint in range(26):
        f, level = hand.finger[joint], hand.level[joint]
        if f < 0:
            continue
        bx, by, bz = work.P[f, level, 0], work.P[f, level, 1], work.P[f, level, 2]
        if level > 0:  # joints of a finger follow each other
            bx, by, bz = (
                bx - work.P[f, level - 1, 0],
                by - work.P[f, level - 1, 1],
                bz - work.P[f, level - 1, 2],
            )
        else:
            bx, by, bz = bx - T[0, 3], by - T[1, 3], bz - T[2, 3]
        for i in range(3):
            second_derivative = _second_derivative(w[f, level, k], w[f, level, m], bx, by, bz, i)
            scratch.joint[pair, joint, i] = second_derivative + (
                scratch.joint[pair, joint - 1, i] if level > 0 else 0.0
            )
    for marker in range(mounts.finger.shape[0]):
        if not seen[marker]:
            continue
        f, level = mounts.finger[marker], mounts.level[marker]
        marker_point(mounts, marker, T, work.R, work.P, work.point)
        bone = min(level, 2) + 1
        bx, by, bz = work.point[0] - T[0, 3], work.point[1] - T[1, 3], work.point[2] - T[2, 3]
        if f >= 0:
            bx, by, bz = (
                work.point[0] - work.P[f, level, 0],
                work.point[1] - work.P[f, level, 1],
                work.point[2] - work.P[f, level, 2],
            )
        for i in range(3):
            if f < 0:
                scratch.marker[pair, 3 * marker + i] = _second_derivative(
                    w[0, 0, k], w[0, 0, m], bx, by, bz, i
                )
            else:
                carried = scratch.joint[pair, scratch.joint_of[f, level], i]
                second_derivative = _second_derivative(w[f, bone, k], w[f, bone, m], bx, by, bz, i)
                scratch.marker[pair, 3 * marker + i] = carried + second_derivative


@inner
def _whiten(information: Float, white: Float) -> None:
    """Write W (3, 3), W' W = information, which may be singular (Cholesky)."""
    for j in range(3):
        total = information[j, j]
        for k in range(j):
            total -= white[k, j] ** 2
        root = sqrt(max(total, 0.0))
        white[j, j] = root
        for i in range(j + 1, 3):
            total = information[i, j]
            for k in range(j):
                total -= white[k, i] * white[k, j]
            white[j, i] = total / root if root > 1e-6 else 0.0
            white[i, j] = 0.0


@inner
def _gain(
    rig: Rig,
    T: Float,
    cov: Float,
    seen: Bool,
    information: Float,
    pairs: int,
    work: Scratch,
    scratch: CovarianceScratch,
) -> int:
    """Write the response of the fit to moved markers (N, K); return K."""
    hand, mounts, N, K = rig.hand, rig.mounts, cov.shape[0], 0
    for m in range(mounts.finger.shape[0]):
        if not seen[m]:
            continue
        f = mounts.finger[m]
        marker_point(mounts, m, T, work.R, work.P, work.point)
        for i in range(3):
            work.arm[i] = work.point[i] - T[i, 3]
        palm_jacobian(work.arm, scratch.J)
        size, start = 6, 0
        if f >= 0:
            start, size = hand.first[f], 6 + hand.first[f + 1] - hand.first[f]
            finger_jacobian(
                hand, work.by, T, work.R, work.P, f, mounts.level[m], work.point, PLACE, scratch.J
            )
        _whiten(information[m], scratch.white)
        for i in range(3):
            for c in range(N):
                scratch.Jm[K + i, c] = 0.0
            for a in range(size):
                total = 0.0
                for j in range(3):
                    total += scratch.white[i, j] * scratch.J[a, j]
                scratch.Jm[K + i, a if a < 6 else start + a] = total
        for p in range(pairs):
            hx, hy, hz = scratch.marker[p, 3 * m], scratch.marker[p, 3 * m + 1], scratch.marker[p, 3 * m + 2]
            for i in range(3):
                whitened = scratch.white[i, 0] * hx + scratch.white[i, 1] * hy + scratch.white[i, 2] * hz
                scratch.marker[p, K + i] = whitened  # K <= 3 m: nothing that is still needed
        K += 3
    for c in range(N):
        for r in range(K):
            total = 0.0
            for d in range(N):
                total += cov[c, d] * scratch.Jm[r, d]
            scratch.gain[c, r] = total
    for r in range(K):
        for q in range(r + 1):
            total = 0.0
            for d in range(N):
                total += scratch.Jm[r, d] * scratch.gain[d, q]
            scratch.B[r, q] = scratch.B[q, r] = total
    return K


@inner
def _at_most_one(N: int, K: int, scratch: CovarianceScratch) -> None:
    """Divide the gain by what residual or hypotheses made wider than its markers."""
    for r in range(K):
        for q in range(K):
            scratch.BL[r, q] = (1.0 if r == q else 0.0) - scratch.B[r, q]
    if cholesky(scratch.BL, K, scratch.BV):
        return
    eigen(scratch.B, K, scratch.B_values, scratch.BV)
    for r in range(K):
        for q in range(K):
            total = 0.0
            for d in range(K):
                total += scratch.BV[r, d] * scratch.BV[q, d] / max(scratch.B_values[d], 1.0)
            scratch.BL[r, q] = total
    for c in range(N):
        for r in range(K):
            total = 0.0
            for q in range(K):
                total += scratch.gain[c, q] * scratch.BL[q, r]
            scratch.row[r] = total
        for r in range(K):
            scratch.gain[c, r] = scratch.row[r]


@inner
def add_second_order(
    rig: Rig,
    settings: Settings,
    T: Float,
    cov: Float,
    seen: Bool,
    information: Float,
    work: Scratch,
    scratch: CovarianceScratch,
    joint_cov: Float,
) -> None:
    """Add to joints' covariances (26, 3, 3) [m^2] what the linear ones leave out.

    `work` has chains and derivatives of T; `seen` (M,) markers, `information` (M, 3, 3) [1/m^2] of their
    places.
    """
    count, N = _rotation_columns(settings, cov, scratch), cov.shape[0]
    if count == 0:
        return
    _bone_rotations(rig.hand, T, count, work, scratch)
    pairs = _NONE
    for k in range(count):
        for m in range(k + 1):
            _second_derivatives(rig, T, seen, k, m, pairs, work, scratch)
            pairs += 1
    K = _gain(rig, T, cov, seen, information, pairs, work, scratch)
    _at_most_one(N, K, scratch)
    for joint in range(26):
        size = joint_jacobian(rig.hand, joint, T, work, scratch)
        mx = my = mz = 0.0
        out = joint_cov[joint]
        for i in range(3):
            for r in range(K):  # how the joint answers to the markers
                total = 0.0
                for a in range(size):
                    total += scratch.J[a, i] * scratch.gain[scratch.at[a], r]
                scratch.BL[i, r] = total
        pair = 0
        for k in range(count):
            for m in range(k + 1):
                hx, hy, hz = (
                    scratch.joint[pair, joint, 0],
                    scratch.joint[pair, joint, 1],
                    scratch.joint[pair, joint, 2],
                )
                for r in range(K):
                    hx -= scratch.BL[0, r] * scratch.marker[pair, r]
                    hy -= scratch.BL[1, r] * scratch.marker[pair, r]
                    hz -= scratch.BL[2, r] * scratch.marker[pair, r]
                share = 0.5 if k == m else 1.0  # those of two turns count twice
                if k == m:
                    mx, my, mz = mx + hx, my + hy, mz + hz
                out[0, 0] += share * hx * hx
                out[0, 1] += share * hx * hy
                out[0, 2] += share * hx * hz
                out[1, 1] += share * hy * hy
                out[1, 2] += share * hy * hz
                out[2, 2] += share * hz * hz
                pair += 1
        out[0, 0] += 0.25 * mx * mx
        out[0, 1] += 0.25 * mx * my
        out[0, 2] += 0.25 * mx * mz
        out[1, 1] += 0.25 * my * my
        out[1, 2] += 0.25 * my * mz
        out[2, 2] += 0.25 * mz * mz
        out[1, 0], out[2, 0], out[2, 1] = out[0, 1], out[0, 2], out[1, 2]
