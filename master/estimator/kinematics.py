"""Kinematics of a hand: places of its points, and their derivatives.

Unknowns are the palm's turn (3, a rotation vector in front of its rotation, rig axes) and shift (3) [m], then
the free angles [rad]. A point on a finger moves with the palm and the axes of its own finger's joints before
it alone (level 0: abduction and flexion, 1: PIP, 2: DIP), so kernels keep derivatives as ten rows at most:
six of the palm, then those of the finger (`HandTables.first`). What turns about axis a through o moves by a x
(point - o).

`BodyPoints` does the same for many poses at once, in the palm frame.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import cos, sin, sqrt
from typing import Any

import numpy as np

from common.arrays import Bool, Float, Int
from common.geometry.transforms import skew
from common.hand.model import CHAINS, Chains, HandModel
from common.kernels import constant, inlined, inner, kernel
from common.records import array
from master.estimator.parameters import HandParameters, HandTables, Mounts
from master.fabrik.linear_algebra import Vector, copy

PLACE, DIRECTION = constant(0), constant(1)


class Scratch:
    """Scratch of kernels; it holds nothing from one call to the next."""

    uv: Float = array(2)
    J: Float = array(2, 3)
    K: Float = array(3, 3)
    gain: Float = array(3)
    left: Float = array(3, 3)
    gained: Float = array(3, 3)
    H: Float = array(3, 3)
    g: Float = array(3)
    by_place: Float = array(10, 3)
    rows: Float = array(10, 3)
    angles: Float = array(20)
    by: Float = array(20, 4)
    R: Float = array(5, 4, 3, 3)
    P: Float = array(5, 4, 3)
    point: Float = array(3)
    arm: Float = array(3)
    ahead: Float = array(3)
    palm: Float = array(4, 4)


@inlined
def _narrowed(tables: HandTables, f: int, flexion: float) -> tuple[float, float]:
    """Return a flexion as share of the highest, and what it leaves of abduction."""
    flexed = min(max(flexion, 0.0), tables.most[f]) / tables.most[f]
    return flexed, 1.0 - (1.0 - tables.left[f]) * flexed * flexed


@inner
def angles_of(tables: HandTables, x: Float, work: Scratch) -> None:
    """Write all `angles` of the free (n,) [rad], and `by`, their derivatives."""
    angles, by = work.angles, work.by
    for f in range(5):
        start, count = int(tables.first[f]), int(tables.first[f + 1] - tables.first[f])
        for a in range(4 * f, 4 * f + 4):
            total = 0.0
            for k in range(count):
                by[a, k] = tables.complete[a, k]
                total += tables.complete[a, k] * x[start + k]
            angles[a] = total
        if tables.narrows[f]:  # abduction and flexion are always free
            flexed, share = _narrowed(tables, f, float(x[start + 1]))
            angles[4 * f] = share * x[start]
            by[4 * f, 0] = share
            by[4 * f, 1] = -2.0 * (1.0 - tables.left[f]) * flexed / tables.most[f] * x[start]


@inner
def free_of(tables: HandTables, angles: Float, x: Float) -> None:
    """Write free angles (n,) of all (20,) [rad]: `HandParameters.of_angles`."""
    for f in range(5):
        start, count = int(tables.first[f]), int(tables.first[f + 1] - tables.first[f])
        for k in range(count):
            x[start + k] = angles[4 * f + k]
        if tables.narrows[f]:
            x[start] /= max(_narrowed(tables, f, float(x[start + 1]))[1], 1e-6)
        for k in range(start, start + count):
            x[k] = min(max(x[k], tables.low[k]), tables.high[k])


@inner
def clamp(tables: HandTables, angles: Float) -> None:
    """Cut angles (20,) [rad] at their limits, as `HandModel.clamp`; in place."""
    for f in range(5):
        for k in range(4):
            a = 4 * f + k
            angles[a] = min(max(angles[a], tables.limits[f, k, 0]), tables.limits[f, k, 1])
        if tables.narrows[f]:
            _, left = _narrowed(tables, f, angles[4 * f + 1])
            low, high = left * tables.limits[f, 0, 0], left * tables.limits[f, 0, 1]
            angles[4 * f] = min(max(angles[4 * f], low), high)


@inner
def chains(tables: HandTables, T: Float, work: Scratch) -> None:
    """Write the joints' rotations `R` and places `P` by `angles`, rig frame."""
    for f in range(5):
        finger_chain(tables, T, work.angles, f, work.R[f], work.P[f])


@inner
def finger_chain(tables: HandTables, T: Float, angles: Float, f: int, R: Float, P: Float) -> None:
    """Write rotations R (4, 3, 3) and places P (4, 3) [m] of one finger's joints."""
    local = R[3]  # until it is the tip's
    for i in range(3):
        P[0, i] = T[i, 3]
        for j in range(3):
            P[0, i] += T[i, j] * tables.root_m[f, j]
    for k in range(4):
        c, s = cos(angles[4 * f + k]), sin(angles[4 * f + k])
        before, after = max(k - 2, 0), max(k - 1, 0)
        for i in range(3):
            for j in range(3):
                partial = c * tables.swing[1, f, k, i, j] + s * tables.swing[2, f, k, i, j]
                local[i, j] = tables.swing[0, f, k, i, j] + partial
        for i in range(3):
            a, b, d = R[before, i, 0], R[before, i, 1], R[before, i, 2]
            if k == 0:
                a, b, d = T[i, 0], T[i, 1], T[i, 2]
            for j in range(3):
                R[after, i, j] = a * local[0, j] + b * local[1, j] + d * local[2, j]
    for i in range(3):
        a, b, d = R[2, i, 0], R[2, i, 1], R[2, i, 2]
        for j in range(3):
            partial = a * tables.tip_rotation[f, 0, j] + b * tables.tip_rotation[f, 1, j]
            R[3, i, j] = partial + d * tables.tip_rotation[f, 2, j]
    for k in range(3):
        for i in range(3):
            bone = R[k, i, 0] * tables.bone_m[f, k, 0] + R[k, i, 1] * tables.bone_m[f, k, 1]
            P[k + 1, i] = P[k, i] + bone + R[k, i, 2] * tables.bone_m[f, k, 2]


@inlined
def hinge_axis(tables: HandTables, T: Float, R: Float, f: int, k: int) -> Vector:
    """Return axis k of finger f: abduction, flexion, PIP, DIP; R (4, 3, 3)."""
    if k > 0:
        return -R[k - 1, 0, 0], -R[k - 1, 1, 0], -R[k - 1, 2, 0]
    x = y = z = 0.0
    for j in range(3):
        x += T[0, j] * tables.abduction_axis[f, j]
        y += T[1, j] * tables.abduction_axis[f, j]
        z += T[2, j] * tables.abduction_axis[f, j]
    return x, y, z


@inner
def twist_hand(tables: HandTables, twist: Float) -> None:
    """Roll the hinges of each finger about its first bone (5,) [rad], in `swing`.

    Those of a person lie askew to the drawing's in a hand file by a few degrees. Rodrigues.
    """
    for f in range(5):
        if tables.twist[f] == twist[f]:
            continue
        tables.twist[f] = twist[f]
        c, s, Q = cos(twist[f]), sin(twist[f]), tables.product
        x, y, z = tables.twist_axis[f, 0], tables.twist_axis[f, 1], tables.twist_axis[f, 2]
        k = 1.0 - c
        Q[0, 0], Q[0, 1], Q[0, 2] = c + x * x * k, x * y * k - z * s, x * z * k + y * s
        Q[1, 0], Q[1, 1], Q[1, 2] = y * x * k + z * s, c + y * y * k, y * z * k - x * s
        Q[2, 0], Q[2, 1], Q[2, 2] = z * x * k - y * s, z * y * k + x * s, c + z * z * k
        for part in range(3):
            for i in range(3):
                for j in range(3):
                    total = 0.0
                    for a in range(3):
                        total += tables.untwisted[part, f, i, a] * Q[a, j]
                    tables.swing[part, f, 0, i, j] = total


@inlined
def marker_point(mounts: Mounts, m: int, T: Float, work: Scratch, out: Float) -> None:
    """Write where marker m sits (3,) [m], rig frame, by `chains`."""
    f, k, R, P = mounts.finger[m], mounts.level[m], work.R, work.P
    for i in range(3):
        total = P[f, k, i] if f >= 0 else T[i, 3]
        for j in range(3):
            total += (R[f, k, i, j] if f >= 0 else T[i, j]) * mounts.offset_m[m, j]
        out[i] = total


@inner
def markers_of(tables: HandTables, mounts: Mounts, T: Float, x: Float, work: Scratch, out: Float) -> None:
    """Write where the markers of a hand are (M, 3) [m], rig frame."""
    angles_of(tables, x, work)
    chains(tables, T, work)
    for m in range(mounts.finger.shape[0]):
        marker_point(mounts, m, T, work, out[m])


@inner
def joints(tables: HandTables, T: Float, work: Scratch, position: Float, rotation: Float) -> None:
    """Write the 26 joints (26, 3) [m], (26, 3, 3), rig frame, by `chains`."""
    R, P = work.R, work.P
    for joint in range(26):
        f, k = tables.finger[joint], tables.level[joint]
        for i in range(3):
            if f >= 0:
                position[joint, i] = P[f, k, i]
                for j in range(3):
                    rotation[joint, i, j] = R[f, k, i, j]
                continue
            position[joint, i] = T[i, 3]
            for j in range(3):
                position[joint, i] += T[i, j] * tables.rest_m[joint, j]
                partial = T[i, 0] * tables.rest_R[joint, 0, j] + T[i, 1] * tables.rest_R[joint, 1, j]
                rotation[joint, i, j] = partial + T[i, 2] * tables.rest_R[joint, 2, j]


@inlined
def palm_jacobian(arm: Float, J: Float) -> None:
    """Write J[:6] (6, 3): how a point `arm` (3,) from its origin moves by the palm."""
    for i in range(3):
        for j in range(3):
            J[i, j] = 0.0
            J[3 + i, j] = 1.0 if i == j else 0.0
    J[0, 1], J[0, 2] = -arm[2], arm[1]  # axis x arm
    J[1, 0], J[1, 2] = arm[2], -arm[0]
    J[2, 0], J[2, 1] = -arm[1], arm[0]


@inlined
def finger_jacobian(
    tables: HandTables, T: Float, work: Scratch, f: int, level: int, point: Float, what: int, J: Float
) -> None:
    """Write J[6:] of (10, 3): derivatives by the free angles of finger f.

    Of a point (3,) [m], rig frame, on joint `level` of its chain, or of a direction (3,): `what` is PLACE or
    DIRECTION.
    """
    R, P, by = work.R, work.P, work.by
    count = tables.first[f + 1] - tables.first[f]
    for c in range(count):
        for i in range(3):
            J[6 + c, i] = 0.0
    for k in range(min(level, 2) + 2):
        ax, ay, az = hinge_axis(tables, T, R[f], f, k)
        dx, dy, dz = point[0], point[1], point[2]
        if what == PLACE:
            joint = max(k - 1, 0)
            dx, dy, dz = dx - P[f, joint, 0], dy - P[f, joint, 1], dz - P[f, joint, 2]
        tx, ty, tz = ay * dz - az * dy, az * dx - ax * dz, ax * dy - ay * dx
        for c in range(count):
            share = by[4 * f + k, c]
            if share != 0.0:
                J[6 + c, 0] += share * tx
                J[6 + c, 1] += share * ty
                J[6 + c, 2] += share * tz


@inlined
def marker_jacobian(
    tables: HandTables, mounts: Mounts, m: int, T: Float, work: Scratch, J: Float
) -> tuple[int, int]:
    """Write where marker m is, to `point`, and its derivatives J (10, 3).

    By the palm (6), then by the free angles of its finger. Returns how many, and the column of the first angle.
    """
    f = mounts.finger[m]
    marker_point(mounts, m, T, work, work.point)
    for i in range(3):
        work.arm[i] = work.point[i] - T[i, 3]
    palm_jacobian(work.arm, J)
    if f < 0:
        return 6, 0
    finger_jacobian(tables, T, work, f, mounts.level[m], work.point, PLACE, J)
    start = int(tables.first[f])
    return 6 + int(tables.first[f + 1]) - start, start


@inlined
def rotate_by(step: Float, T: Float, out: Float) -> None:
    """Write T (4, 4) turned in front by step[:3] [rad], shifted by step[3:6] [m]."""
    x, y, z = step[0], step[1], step[2]
    angle = sqrt(x * x + y * y + z * z)
    a = sin(angle) / angle if angle > 1e-9 else 1.0
    b = (1.0 - cos(angle)) / (angle * angle) if angle > 1e-5 else 0.5
    r00, r01, r02 = 1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y
    r10, r11, r12 = b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x
    r20, r21, r22 = b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)
    for j in range(3):
        u, v, w = T[0, j], T[1, j], T[2, j]
        out[0, j] = r00 * u + r01 * v + r02 * w
        out[1, j] = r10 * u + r11 * v + r12 * w
        out[2, j] = r20 * u + r21 * v + r22 * w
    for i in range(3):
        out[i, 3] = T[i, 3] + step[3 + i]
    for j in range(4):
        out[3, j] = T[3, j]


@inlined
def rotation_between(A: Float, B: Float, c: Float, out: Float) -> None:
    """Write the rotation vector (3,) of A B'; `c`: (3, 3) scratch."""
    for i in range(3):
        for j in range(3):
            c[i, j] = A[i, 0] * B[j, 0] + A[i, 1] * B[j, 1] + A[i, 2] * B[j, 2]
    out[0] = 0.5 * (c[2, 1] - c[1, 2])
    out[1] = 0.5 * (c[0, 2] - c[2, 0])
    out[2] = 0.5 * (c[1, 0] - c[0, 1])
    sine = sqrt(out[0] * out[0] + out[1] * out[1] + out[2] * out[2])
    cosine = 0.5 * (c[0, 0] + c[1, 1] + c[2, 2] - 1.0)
    if sine > 1e-6:
        scale = np.arctan2(sine, cosine) / sine
        for i in range(3):
            out[i] *= scale
    elif cosine < 0.0:  # half a turn: about the axis whose diagonal is largest
        k = 0
        for i in range(1, 3):
            if c[i, i] > c[k, k]:
                k = i
        length = sqrt(max(0.5 * (1.0 + c[k, k]), 1e-12))
        for i in range(3):
            out[i] = np.pi * (length if i == k else (c[i, k] + c[k, i]) / (4.0 * length))


@kernel
def quaternions(rotation: Float, out: Float) -> None:
    """Write unit quaternions (N, 4) wxyz, w >= 0, of matrices (Shepperd, 1978)."""
    for n in range(rotation.shape[0]):
        R, q = rotation[n], out[n]
        trace = R[0, 0] + R[1, 1] + R[2, 2]
        i = 0
        for k in range(1, 3):
            if R[k, k] > R[i, i]:
                i = k
        j, k = (i + 1) % 3, (i + 2) % 3
        if trace >= R[i, i]:
            q[0], q[1], q[2], q[3] = 1.0 + trace, R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
        else:
            q[0], q[1 + i] = R[k, j] - R[j, k], 1.0 + R[i, i] - R[j, j] - R[k, k]
            q[1 + j], q[1 + k] = R[i, j] + R[j, i], R[i, k] + R[k, i]
        length = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
        length = -length if q[0] < 0.0 else length
        for c in range(4):
            q[c] /= length


@kernel
def pose(
    boxed_hand: Any,
    mounts: Mounts,
    T: Float,
    angles: Float,
    boxed_work: Any,
    position: Float,
    rotation: Float,
    out: Float,
) -> None:
    """Write joints, markers (M, 3) [m], rig frame; clip the angles (20,), in place."""
    hand, work = boxed_hand[0], boxed_work[0]
    copy(T, work.palm)
    clamp(hand, angles)
    for a in range(20):
        work.angles[a] = angles[a]
    chains(hand, work.palm, work)
    joints(hand, work.palm, work, position, rotation)
    for m in range(mounts.finger.shape[0]):
        marker_point(mounts, m, work.palm, work, out[m])


@kernel
def twist_boxed(boxed_hand: Any, twist: Float) -> None:
    """As `twist_hand`, of a hand in its array."""
    twist_hand(boxed_hand[0], twist)


_AXIS_JOINT: Int = np.array([0, 0, 1, 2])  # joint of the chain at which abduction, flexion, PIP, DIP turn


@dataclass(frozen=True, slots=True, eq=False)
class BodyPoints:
    """P points, each fixed to a joint of a finger's chain or to the palm."""

    finger: Int  # (P,) chain; 0 for the palm
    level: Int  # (P,) joint of the chain (0 root ... 3 tip); 0 for the palm
    on_finger: Bool  # (P, 1) whether it is fixed to a chain
    offset_m: Float  # (P, 3) place in that joint's frame; palm: in the palm frame
    moves: Float  # (P, 4, n) how much the free angles turn each of the four axes, 0: leaves the point alone
    abduction_axis: Float  # (5, 1, 3) palm frame; the only axis that no angle turns
    parameters: HandParameters

    @classmethod
    def markers(cls, model: HandModel, parameters: HandParameters, names: Sequence[str]) -> "BodyPoints":
        """The markers of these names.

        Raises:
            CalibrationError: The profile mounts no marker of one of the names.
        """
        finger, level, offset_m, _ = Mounts.of(model, names)
        moves = np.zeros((len(finger), 4, len(parameters.free)))
        for p in np.flatnonzero(finger >= 0):
            used = min(int(level[p]), 2) + 2
            moves[p, :used] = parameters.complete[4 * finger[p] : 4 * finger[p] + used]
        axis = np.zeros((5, 1, 3))
        axis[:, 0, 1] = model.side_sign
        axis[0, 0] = model.side_sign * model.rest_rotation[CHAINS[0, 0]][:, 1]
        on_finger = (finger >= 0)[:, None]
        return cls(np.maximum(finger, 0), level, on_finger, offset_m, moves, axis, parameters)

    def place(self, chains: Chains) -> Float:
        """Return the points (..., P, 3) [m], palm frame, of poses (...)."""
        R = chains.rotation[..., self.finger, self.level, :, :]
        p = chains.position_m[..., self.finger, self.level, :]
        return np.where(self.on_finger, p + (R @ self.offset_m[..., None])[..., 0], self.offset_m)

    def jacobian(self, chains: Chains, points_m: Float, x: Float) -> Float:
        """Return derivatives (..., P, 3, n) [m/rad] of points at x (..., n)."""
        axes = np.empty((*chains.position_m.shape[:-3], 5, 4, 3))
        axes[..., :1, :] = self.abduction_axis
        np.negative(chains.rotation[..., :3, :, 0], out=axes[..., 1:, :])
        arm = points_m[..., None, :] - chains.position_m[..., self.finger[:, None], _AXIS_JOINT, :]
        moments = skew(axes)[..., self.finger, :, :, :] @ arm[..., None]  # (..., P, 4, 3, 1)
        return self.parameters.by_parameters(moments[..., 0].swapaxes(-1, -2) @ self.moves, x)
