"""Kernels of a hand: joints, points on them, derivatives, covariances."""

from math import cos, sin, sqrt

import numpy as np

from common.arrays import Float, Int
from common.kernels import kernel
from master.fabrik.hand_tables import HandTables, Mounts


@kernel
def angles_of(tables: HandTables, x: Float, angles: Float, by: Float) -> None:
    """Write all angles (20,) [rad] of the free ones (n,), and derivatives (20, n).

    As `HandParameters.angles`.
    """
    n = x.shape[0]
    for a in range(20):
        total = 0.0
        for c in range(n):
            by[a, c] = tables.complete[a, c]
            total += tables.complete[a, c] * x[c]
        angles[a] = total
    for f in range(5):
        a, c = tables.abduction[f], tables.flexion[f]
        if a < 0:
            continue
        flexed = min(max(x[c], 0.0), tables.most[f]) / tables.most[f]
        share = 1.0 - (1.0 - tables.left[f]) * flexed * flexed
        angles[4 * f] = share * x[a]
        by[4 * f, a] = share
        by[4 * f, c] = -2.0 * (1.0 - tables.left[f]) * flexed / tables.most[f] * x[a]


@kernel
def chains(tables: HandTables, angles: Float, R: Float, P: Float) -> None:
    """Write joint rotations and places, palm frame, of angles (20,) [rad].

    R: (5, 4, 3, 3); P: (5, 4, 3) [m].
    """
    local, frame = np.empty((3, 3)), np.empty((3, 3))
    for f in range(5):
        for k in range(4):
            c, s = cos(angles[4 * f + k]), sin(angles[4 * f + k])
            for i in range(3):
                for j in range(3):
                    turned = c * tables.swing[1, f, k, i, j] + s * tables.swing[2, f, k, i, j]
                    local[i, j] = tables.swing[0, f, k, i, j] + turned
            if k == 0:
                frame[:, :] = local
                continue
            for i in range(3):
                a, b, d = frame[i, 0], frame[i, 1], frame[i, 2]
                for j in range(3):
                    frame[i, j] = a * local[0, j] + b * local[1, j] + d * local[2, j]
                    R[f, k - 1, i, j] = frame[i, j]
        for i in range(3):
            a, b, d = frame[i, 0], frame[i, 1], frame[i, 2]
            for j in range(3):
                R[f, 3, i, j] = (
                    a * tables.tip_turn[f, 0, j] + b * tables.tip_turn[f, 1, j] + d * tables.tip_turn[f, 2, j]
                )
            P[f, 0, i] = tables.root_m[f, i]
        for k in range(3):
            for i in range(3):
                bone = R[f, k, i, 0] * tables.bone_m[f, k, 0] + R[f, k, i, 1] * tables.bone_m[f, k, 1]
                P[f, k + 1, i] = P[f, k, i] + bone + R[f, k, i, 2] * tables.bone_m[f, k, 2]


@kernel
def place(mounts: Mounts, m: int, R: Float, P: Float, out: Float) -> None:
    """Write where marker m sits in the palm frame (3,) [m]."""
    f, k = mounts.finger[m], mounts.level[m]
    for i in range(3):
        out[i] = mounts.offset_m[m, i]
        if f >= 0:
            turned = R[f, k, i, 0] * mounts.offset_m[m, 0] + R[f, k, i, 1] * mounts.offset_m[m, 1]
            out[i] = P[f, k, i] + turned + R[f, k, i, 2] * mounts.offset_m[m, 2]


@kernel
def pose(
    tables: HandTables,
    mounts: Mounts,
    T: Float,
    angles: Float,
    position: Float,
    rotation: Float,
    places: Float,
) -> None:
    """Write the joints of a hand, rig frame, and its markers, palm frame.

    Args:
        tables, mounts: The hand and its markers.
        T: (4, 4) palm.
        angles: (20,) [rad].
        position, rotation, places: Written: (26, 3) [m], (26, 3, 3), (M, 3) [m].
    """
    R, P = np.empty((5, 4, 3, 3)), np.empty((5, 4, 3))
    chains(tables, angles, R, P)
    for joint in range(26):
        f, k = tables.finger[joint], tables.level[joint]
        for i in range(3):
            total = T[i, 3]
            for j in range(3):
                total += T[i, j] * (P[f, k, j] if f >= 0 else tables.rest_m[joint, j])
            position[joint, i] = total
            for c in range(3):
                turned = 0.0
                for j in range(3):
                    turned += T[i, j] * (R[f, k, j, c] if f >= 0 else tables.rest_R[joint, j, c])
                rotation[joint, i, c] = turned
    for m in range(mounts.finger.shape[0]):
        place(mounts, m, R, P, places[m])


@kernel
def turn_slopes(by: Float, axes: Float, f: int, level: int, arms: Float, out: Float) -> None:
    """Write the sum over a finger's axes of (axis x arm) by the free angles (n, 3).

    Args:
        by: (20, n) derivatives of all angles by the free ones.
        axes: (4, 3) axes of abduction, flexion, PIP and DIP.
        f, level: Finger, and joint of its chain up to which axes count.
        arms: (4, 3) from each axis to what it turns.
        out: Written.
    """
    n = by.shape[1]
    for c in range(n):
        for i in range(3):
            out[c, i] = 0.0
    for k in range(min(level, 2) + 2):
        tx = axes[k, 1] * arms[k, 2] - axes[k, 2] * arms[k, 1]
        ty = axes[k, 2] * arms[k, 0] - axes[k, 0] * arms[k, 2]
        tz = axes[k, 0] * arms[k, 1] - axes[k, 1] * arms[k, 0]
        for c in range(n):
            share = by[4 * f + k, c]
            if share != 0.0:
                out[c, 0] += share * tx
                out[c, 1] += share * ty
                out[c, 2] += share * tz


@kernel
def axes_of(tables: HandTables, f: int, R: Float, axes: Float) -> None:
    """Write the axes (4, 3) of a finger's angles, palm frame."""
    for i in range(3):
        axes[0, i] = tables.abduction_axis[f, i]
        for k in range(3):
            axes[k + 1, i] = -R[f, k, i, 0]


@kernel
def point_slopes(
    tables: HandTables, by: Float, f: int, level: int, point: Float, R: Float, P: Float, out: Float
) -> None:
    """Write derivatives (n, 3) [m/rad] of a point of finger f by the free angles."""
    axes, arms = np.empty((4, 3)), np.empty((4, 3))
    axes_of(tables, f, R, axes)
    for k in range(4):
        for i in range(3):
            arms[k, i] = point[i] - P[f, max(k - 1, 0), i]
    turn_slopes(by, axes, f, level, arms, out)


@kernel
def rig_slopes(T: Float, arm: Float, by_x: Float, shifted: bool, J: Float, used: Int) -> int:
    """Write derivatives by palm and free angles, rig frame; count those not 0.

    Args:
        T: (4, 4) palm.
        arm: (3,) of what is turned, from the palm's origin, rig frame.
        by_x: (n, 3) derivatives by the free angles, palm frame.
        shifted: Whether it is a place; else a direction, which no shift moves.
        J, used: (6 + n, 3) and (6 + n,): the rows and which unknowns they belong to; written.
    """
    J[:6, :] = 0.0
    J[0, 1], J[0, 2] = -arm[2], arm[1]  # axis x arm
    J[1, 0], J[1, 2] = arm[2], -arm[0]
    J[2, 0], J[2, 1] = -arm[1], arm[0]
    count = 3
    if shifted:
        J[3, 0], J[4, 1], J[5, 2] = 1.0, 1.0, 1.0
        count = 6
    for i in range(count):
        used[i] = i
    for c in range(by_x.shape[0]):
        if by_x[c, 0] != 0.0 or by_x[c, 1] != 0.0 or by_x[c, 2] != 0.0:
            for i in range(3):
                J[count, i] = T[i, 0] * by_x[c, 0] + T[i, 1] * by_x[c, 1] + T[i, 2] * by_x[c, 2]
            used[count] = 6 + c
            count += 1
    return count


@kernel
def _covariance_of(J: Float, used: Int, count: int, C: Float, out: Float) -> None:
    """Write J' C J (3, 3) of the rows in use."""
    for i in range(3):
        for j in range(3):
            out[i, j] = 0.0
    for a in range(count):
        for b in range(count):
            c = C[used[a], used[b]]
            for i in range(3):
                for j in range(3):
                    out[i, j] += J[a, i] * c * J[b, j]


@kernel
def covariances(tables: HandTables, T: Float, x: Float, C: Float, cov: Float, tilt: Float) -> None:
    """Write covariances of the joints and of the last phalanges' directions.

    Args:
        tables: The hand.
        T: (4, 4) palm.
        x: (n,) [rad] free angles.
        C: (6 + n, 6 + n) covariance of the palm's turn [rad] and shift [m], rig frame, and of x.
        cov, tilt: Written: (26, 3, 3) [m^2], (5, 3, 3) [rad^2].
    """
    n = x.shape[0]
    angles, by = np.empty(20), np.empty((20, n))
    R, P = np.empty((5, 4, 3, 3)), np.empty((5, 4, 3))
    angles_of(tables, x, angles, by)
    chains(tables, angles, R, P)
    point, arm, by_x = np.empty(3), np.empty(3), np.empty((n, 3))
    axes, arms = np.empty((4, 3)), np.empty((4, 3))
    J, used = np.empty((6 + n, 3)), np.empty(6 + n, np.int64)
    for joint in range(26):
        f, k = tables.finger[joint], tables.level[joint]
        for c in range(n):
            for i in range(3):
                by_x[c, i] = 0.0
        for i in range(3):
            point[i] = P[f, k, i] if f >= 0 else tables.rest_m[joint, i]
        if f >= 0:
            point_slopes(tables, by, f, k, point, R, P, by_x)
        for i in range(3):
            arm[i] = T[i, 0] * point[0] + T[i, 1] * point[1] + T[i, 2] * point[2]
        count = rig_slopes(T, arm, by_x, True, J, used)
        _covariance_of(J, used, count, C, cov[joint])
    for f in range(5):
        length = 0.0
        for i in range(3):
            point[i] = P[f, 3, i] - P[f, 2, i]
            length += point[i] * point[i]
        for i in range(3):
            point[i] /= sqrt(length)
        axes_of(tables, f, R, axes)
        for k in range(4):
            for i in range(3):
                arms[k, i] = point[i]
        turn_slopes(by, axes, f, 3, arms, by_x)
        for i in range(3):
            arm[i] = T[i, 0] * point[0] + T[i, 1] * point[1] + T[i, 2] * point[2]
        count = rig_slopes(T, arm, by_x, False, J, used)
        _covariance_of(J, used, count, C, tilt[f])
