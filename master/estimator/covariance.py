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
from common.records import array
from master.estimator.kinematics import (
    DIRECTION,
    PLACE,
    Scratch,
    finger_jacobian,
    hinge_axis,
    marker_jacobian,
    marker_point,
    palm_jacobian,
)
from master.estimator.parameters import HandTables
from master.estimator.problem import Rig
from master.estimator.settings import KERNEL, Settings
from master.estimator.state import Hidden
from master.fabrik.joints import START, put_vector, vector_at
from master.fabrik.linear_algebra import Vector, cholesky, eigen, minus, plus

_LAST = constant(3)  # joint of a finger: its tip
MOST_ROTATIONS = KERNEL.rotations
_PAIRS = MOST_ROTATIONS * (MOST_ROTATIONS + 1) // 2


class CovarianceScratch:
    """Scratch for N unknowns and M markers."""

    A: Float = array("N", "N")
    L: Float = array("N", "N")
    V: Float = array("N", "N")
    work: Float = array("N", "N")
    values: Float = array("N")
    rotations: Float = array(MOST_ROTATIONS, "N")  # columns of the factor, as rows
    left: Float = array("N")
    w: Float = array(5, 4, MOST_ROTATIONS, 3)
    joint: Float = array(_PAIRS, 26, 3)  # arcs of joints, by pair
    marker: Float = array(_PAIRS, "3M")  # of markers, whitened
    Jm: Float = array("3M", "N")
    gain: Float = array("N", "3M")
    B: Float = array("3M", "3M")
    BL: Float = array("3M", "3M")
    BV: Float = array("3M", "3M")
    B_values: Float = array("3M")
    row: Float = array("3M")
    white: Float = array(3, 3)
    C: Float = array(10, 3)
    J: Float = array(10, 3)
    at: Int = array(10, kind="i8")


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
    finger_jacobian(hand, T, work, f, level, work.point, PLACE, scratch.J)
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
    rig: Rig,
    T: Float,
    cov: Float,
    work: Scratch,
    scratch: CovarianceScratch,
    tilt: Float,
    process_noise: Float,
) -> None:
    """Write the last phalanges' covariances (5, 3, 3) [rad^2] and walk [rad^2/s^2]."""
    hand, settings = rig.hand, rig.settings
    for f in range(5):
        squared = 0.0
        for i in range(3):
            work.ahead[i] = work.P[f, 3, i] - work.P[f, 2, i]
            squared += work.ahead[i] ** 2
        for i in range(3):
            work.ahead[i] /= sqrt(squared)
        palm_jacobian(work.ahead, scratch.J)
        finger_jacobian(hand, T, work, f, _LAST, work.ahead, DIRECTION, scratch.J)
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
    most_m2 = most_m * most_m / KERNEL.region_95
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
            ax, ay, az = hinge_axis(hand, T, work.R[f], f, axis)
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
def _arc(one: Float, other: Float, bone: Vector) -> Vector:
    """Return h of a bone that is turned by two turns (3,)."""
    x, y, z = bone
    one_b = one[0] * x + one[1] * y + one[2] * z
    other_b = other[0] * x + other[1] * y + other[2] * z
    both = one[0] * other[0] + one[1] * other[1] + one[2] * other[2]
    return (
        0.5 * (one[0] * other_b + other[0] * one_b) - both * x,
        0.5 * (one[1] * other_b + other[1] * one_b) - both * y,
        0.5 * (one[2] * other_b + other[2] * one_b) - both * z,
    )


@inner
def _second_derivatives(
    rig: Rig, T: Float, seen: Bool, k: int, m: int, pair: int, work: Scratch, scratch: CovarianceScratch
) -> None:
    """Write second derivatives of joints and markers (not whitened) by k and m."""
    hand, mounts, w, P = rig.hand, rig.mounts, scratch.w, work.P
    palm = T[0, 3], T[1, 3], T[2, 3]
    for joint in range(26):  # joints of a finger follow each other
        f, level = hand.finger[joint], hand.level[joint]
        if f < 0:
            x, y, z = vector_at(hand.rest_m, joint, START)
            rest = (
                T[0, 0] * x + T[0, 1] * y + T[0, 2] * z,
                T[1, 0] * x + T[1, 1] * y + T[1, 2] * z,
                T[2, 0] * x + T[2, 1] * y + T[2, 2] * z,
            )
            h = _arc(w[0, 0, k], w[0, 0, m], rest)
        else:
            before = vector_at(P[f], level - 1, START) if level > 0 else palm
            h = _arc(w[f, level, k], w[f, level, m], minus(vector_at(P[f], level, START), before))
            if level > 0:
                h = plus(h, vector_at(scratch.joint[pair], joint - 1, START))
        put_vector(scratch.joint[pair], joint, h)
    for marker in range(mounts.finger.shape[0]):
        if not seen[marker]:
            continue
        f, level = int(mounts.finger[marker]), int(mounts.level[marker])
        marker_point(mounts, marker, T, work, work.point)
        point, bone = (work.point[0], work.point[1], work.point[2]), min(level, 2) + 1
        if f < 0:
            h = _arc(w[0, 0, k], w[0, 0, m], minus(point, palm))
        else:
            h = _arc(w[f, bone, k], w[f, bone, m], minus(point, vector_at(P[f], level, START)))
            h = plus(vector_at(scratch.joint[pair], CHAINS[f, level], START), h)
        for i in range(3):
            scratch.marker[pair, 3 * marker + i] = h[i]


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
        size, start = marker_jacobian(hand, mounts, m, T, work, scratch.J)
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


@inlined
def _add_square(out: Float, share: float, x: float, y: float, z: float) -> None:
    """Add the upper triangle of a vector's square, by a share."""
    out[0, 0] += share * x * x
    out[0, 1] += share * x * y
    out[0, 2] += share * x * z
    out[1, 1] += share * y * y
    out[1, 2] += share * y * z
    out[2, 2] += share * z * z


@inner
def add_second_order(
    rig: Rig,
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
    count, N = _rotation_columns(rig.settings, cov, scratch), cov.shape[0]
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
                hx, hy, hz = vector_at(scratch.joint[pair], joint, START)
                for r in range(K):
                    hx -= scratch.BL[0, r] * scratch.marker[pair, r]
                    hy -= scratch.BL[1, r] * scratch.marker[pair, r]
                    hz -= scratch.BL[2, r] * scratch.marker[pair, r]
                share = 0.5 if k == m else 1.0  # those of two turns count twice
                if k == m:
                    mx, my, mz = mx + hx, my + hy, mz + hz
                _add_square(out, share, hx, hy, hz)
                pair += 1
        _add_square(out, 1.0 / 4.0, mx, my, mz)
        out[1, 0], out[2, 0], out[2, 1] = out[0, 1], out[0, 2], out[1, 2]
