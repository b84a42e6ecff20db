"""Kernels of the measurement rows of a wrist device.

The rows are LASER, TIP, TIP_DEPTH of its camera, and TURN of its IMU.

    LASER      where the laser meets the finger's skin [x, y of the ray], minus where it was seen
    TIP        the fingertip, minus where it was seen
    TIP_DEPTH  logarithm of its distance in the unit of the light, minus that by its brightness
    TURN       rotation vector from where the sensors have the palm to where it is

What was seen before or after the epoch is brought to it by the rates of the angles (`master.estimator.update`).
A finger is seen from the forearm, so the first three move with its own angles, the twist of its hinges and the bend of
the wrist, and not with where the hand is in the room. The bend they constrain little (`wrist_share`), for that all
fingers seem bent by as much is mostly an error that they share; what its uncertainty makes of them is in their noise.
"""

from math import sqrt, tan

from common.arrays import Float
from common.kernels import inlined, inner
from master.estimator.finger_surface import MOVES, look
from master.estimator.kinematics import rotation_between
from master.estimator.problem import EpochPrior, Rig, Search
from master.estimator.wrist_device import LED_SCALE, TILT, WRIST_ANGLES, flexed_palm


@inlined
def rotation_vector_jacobian(rotation: Float, J: Float) -> None:
    """Write the derivative (3, 3) of a rotation vector by a small rotation.

    The rotation vector is (3,); the small rotation is applied in front of it (from the left).

    The inverse of the left Jacobian of SO(3) (Sola, Deray, Atchuthan 2018, "A micro Lie theory", eq. 146).
    """
    squared = rotation[0] * rotation[0] + rotation[1] * rotation[1] + rotation[2] * rotation[2]
    small_rad = 1e-4  # below it a rotation vector counts as so long in the derivative
    angle = max(sqrt(squared), small_rad)
    factor = 1.0 / (angle * angle) - 0.5 / (angle * tan(0.5 * angle))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        for c in range(3):
            J[i, c] = factor * rotation[i] * rotation[c]
        J[i, i] += 1.0 - factor * squared
        J[i, j] += 0.5 * rotation[k]
        J[i, k] -= 0.5 * rotation[j]


@inner
def sensed_palm(epoch_prior: EpochPrior, z: Float, search: Search) -> None:
    """Write the palm's rotation as other sensors measure it.

    The rotation goes to `search.palm` (3, 3), its derivative to `extras_jacobian` (5, 3).

    By an IMU on the forearm it is  exp(axes . (tilt, heading less its prior)) forearm R_y(deviation) R_x(flexion),
    and extras are tilt 2, heading, flexion, deviation; by one on the palm itself it is `forearm`, which none turns.
    """
    R, extras_jacobian, F = search.palm_straight, search.extras_jacobian, epoch_prior.forearm
    if epoch_prior.on_forearm[0] == 0.0:
        for i in range(3):
            for j in range(3):
                search.palm[i, j] = F[i, j]
        return
    flexed_palm(F, z[WRIST_ANGLES], z[WRIST_ANGLES + 1], R, search.wrist_axes)
    for i in range(3):  # rig axes
        for a in range(3):
            extras_jacobian[a, i] = epoch_prior.axes[a, i]
        extras_jacobian[3, i], extras_jacobian[4, i] = search.wrist_axes[0, i], search.wrist_axes[1, i]
    for i in range(3):
        search.off[i] = 0.0
        for a in range(3):
            search.off[i] += epoch_prior.axes[a, i] * (z[TILT + a] - epoch_prior.z[TILT + a])
    rotate_by_vector(search.off, R, search.palm)


@inner
def contrary(epoch_prior: EpochPrior, T: Float, z: Float, search: Search) -> float:
    """Return the chi-square of a palm against its rotation by other sensors.

    The chi-square of the extras' deviation from their prior, by which they accommodated the palm, is included.
    """
    sensed_palm(epoch_prior, z, search)
    rotation_between(T, search.palm, search.J, search.q)
    total, q = 0.0, search.q
    for i in range(3):
        for j in range(3):
            total += q[i] * epoch_prior.orientation_info[i, j] * q[j]
    for i in range(z.shape[0]):
        for j in range(z.shape[0]):
            total += (z[i] - epoch_prior.z[i]) * epoch_prior.z_info[i, j] * (z[j] - epoch_prior.z[j])
    return total


@inner
def orientation_row(
    epoch_prior: EpochPrior, T: Float, z: Float, n: int, gradient: Float, normal: Float, search: Search
) -> float:
    """Add the TURN row; return its cost."""
    J, q, extras_jacobian = search.J, search.q, search.extras_jacobian
    K = 5 if epoch_prior.on_forearm[0] > 0.0 else 0
    sensed_palm(epoch_prior, z, search)
    rotation_between(T, search.palm, J, q)
    rotation_vector_jacobian(q, J)
    L, w = epoch_prior.orientation_info, search.off
    cost = 0.0
    for i in range(3):
        w[i] = L[i, 0] * q[0] + L[i, 1] * q[1] + L[i, 2] * q[2]
        cost += 0.5 * w[i] * q[i]
    # Rows of the unknowns: the palm's turn in front of T by J, the sensed palm's by -J' (from behind).
    D = search.by_rotation
    for i in range(3):
        for c in range(3):
            D[i, c] = J[c, i]
    for a in range(K):
        for c in range(3):
            D[3 + a, c] = -(
                J[0, c] * extras_jacobian[a, 0]
                + J[1, c] * extras_jacobian[a, 1]
                + J[2, c] * extras_jacobian[a, 2]
            )
    for a in range(3 + K):
        ia = a if a < 3 else _column(n, a - 3)
        gradient[ia] += D[a, 0] * w[0] + D[a, 1] * w[1] + D[a, 2] * w[2]
        for b in range(3 + K):
            ib = b if b < 3 else _column(n, b - 3)
            total = 0.0
            for i in range(3):
                for j in range(3):
                    total += D[a, i] * L[i, j] * D[b, j]
            normal[ia, ib] += total
    return cost


@inlined
def _column(n: int, a: int) -> int:
    """The unknown of tilt 2, heading, flexion, deviation."""
    return 6 + n + (TILT + a if a < 3 else WRIST_ANGLES + a - 3)


@inlined
def rotate_by_vector(rotation: Float, R: Float, out: Float) -> None:
    """Write R (3, 3) rotated by a small rotation vector (3,).

    The rotation is applied in front (from the left), to second order.
    """
    x, y, z = rotation[0], rotation[1], rotation[2]
    for j in range(3):
        a, b, c = R[0, j], R[1, j], R[2, j]
        u, v, w = y * c - z * b, z * a - x * c, x * b - y * a
        out[0, j] = a + u + 0.5 * (y * w - z * v)
        out[1, j] = b + v + 0.5 * (z * u - x * w)
        out[2, j] = c + w + 0.5 * (x * v - y * u)


@inner
def finger_rows(
    rig: Rig,
    epoch_prior: EpochPrior,
    f: int,
    z: Float,
    n: int,
    gradient: Float,
    normal: Float,
    search: Search,
) -> float:
    """Add the rows of finger f, of angles `search.rows.angles`; return their cost.

    `search.palm_camera` and `search.wrist_axes` are those of the bend.
    """
    hand, lines_of_sight, work, surface = rig.hand, epoch_prior.lines_of_sight, search.rows, search.surface
    start = hand.first[f]
    count, base = hand.first[f + 1] - start, 6 + n
    J, r, w, at = search.local_J, search.local_r, search.local_w, search.at
    for c in range(count):
        at[c] = 6 + start + c
    at[count], at[count + 1], at[count + 2], at[count + 3] = (
        base + f,
        base + WRIST_ANGLES,
        base + WRIST_ANGLES + 1,
        base + LED_SCALE,
    )
    size, cost = count + 4, 0.0
    if lines_of_sight.lit[f] == 0.0 and lines_of_sight.shown[f] == 0.0:
        return 0.0
    look(hand, rig.device, search.palm_camera, search.wrist_axes, work.angles, f, MOVES, surface)
    for what in range(2):
        if (what == 0 and lines_of_sight.lit[f] == 0.0) or (what == 1 and lines_of_sight.shown[f] == 0.0):
            continue
        rows, first = 2, 0
        if what == 0:
            W = lines_of_sight.laser_W[f]
            r[0] = surface.seen[0] + lines_of_sight.lack[f, 0] - lines_of_sight.laser[f, 0]
            r[1] = surface.seen[1] + lines_of_sight.lack[f, 1] - lines_of_sight.laser[f, 1]
        else:
            W, first = lines_of_sight.tip_W[f], 2
            r[0], r[1] = (
                surface.seen[2] - lines_of_sight.tip[f, 0],
                surface.seen[3] - lines_of_sight.tip[f, 1],
            )
            if lines_of_sight.depth_w2[f] > 0.0:
                rows = 3
                r[2] = surface.seen[4] + z[LED_SCALE] - lines_of_sight.depth[f]
        for i in range(rows):
            for c in range(count):
                J[i, c] = 0.0
                for k in range(4):
                    J[i, c] += surface.J[first + i, k] * work.by[4 * f + k, c]
            for c in range(3):
                J[i, count + c] = surface.J[first + i, 4 + c]
            J[i, count] *= lines_of_sight.teaches[f]
            J[i, count + 3] = 1.0 if i == 2 else 0.0
        for i in range(rows):
            if i == 2:
                w[2] = lines_of_sight.depth_w2[f] * r[2]
            else:
                w[i] = W[i, 0] * r[0] + W[i, 1] * r[1]
            cost += 0.5 * w[i] * r[i]
        for a in range(size):
            # What fingers measure of the bend counts for little: they err together, as the device is put on.
            of_wrist = a == count + 1 or a == count + 2
            share = search.wrist_share[0] if of_wrist else 1.0
            for i in range(rows):
                gradient[at[a]] += share * J[i, a] * w[i]
            p0 = W[0, 0] * J[0, a] + W[0, 1] * J[1, a]
            p1 = W[1, 0] * J[0, a] + W[1, 1] * J[1, a]
            p2 = lines_of_sight.depth_w2[f] * J[2, a] if rows == 3 else 0.0
            for b in range(size):
                total = p0 * J[0, b] + p1 * J[1, b]
                if rows == 3:
                    total += p2 * J[2, b]
                if b == count + 1 or b == count + 2 or of_wrist:
                    total *= search.wrist_share[0]
                normal[at[a], at[b]] += total
    return cost
