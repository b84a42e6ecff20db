"""The problem of a fit: a rig, a prior, and residuals of what is measured.

    RAY        where a camera would see a marker, minus where it did [px]; without what the visible side of a painted
               cap shifts its centroid by (`master.fabrik.rays`)
    POINT      a place, minus the measured one [m]
    LASER      where the laser meets the finger's skin [x, y of the ray], minus where it was seen
    TIP        the fingertip, minus where it was seen
    TIP_DEPTH  logarithm of its distance in the unit of the light, minus that by its brightness
    TURN       rotation vector from where the sensors have the palm to where it is

What is wrong with a marker itself (colour, bones, the side of a cap that is not known) is seen by all
cameras. It is a shift d with a covariance S, and is integrated out: with H, g the information and gradient of
the rays,

    H - H (H + S^-1)^-1 H,   g - H (H + S^-1)^-1 g,   cost - g' (H + S^-1)^-1 g / 2

so a marker that one camera sees gives two numbers and one that sixteen see is no surer than its colour.

What a wrist device saw before or after the epoch is brought to it by the rates of the angles
(`master.estimator.update`). Its rows move with the finger's angles, the twist of its hinges and the bend of
the wrist. The bend they constrain little (`wrist_share`): that all fingers seem bent by as much is mostly an
error that they share; what its uncertainty makes of them is in their noise.
"""

from math import sqrt, tan
from typing import NamedTuple

import numpy as np

from common.arrays import Bool, Float, Int
from common.kernels import inlined, inner, kernel
from common.records import array, part
from master.estimator.finger_surface import MOVES, Surface, look
from master.estimator.kinematics import Scratch, rotation_between
from master.estimator.parameters import HandTables, Mounts
from master.estimator.priors import PosturePrior
from master.estimator.sensors import (
    LED_SCALE,
    TILT,
    WRIST_ANGLES,
    CameraArrays,
    CycleRows,
    Device,
    flexed_palm,
    project,
)
from master.estimator.settings import KERNEL, Settings
from master.fabrik.linear_algebra import inverse_3


class Rig(NamedTuple):
    """Everything that is the same at every epoch."""

    hand: HandTables
    settings: Settings
    mounts: Mounts
    cameras: CameraArrays
    device: Device


class EpochPrior:
    """Prior at one epoch beside the posture prior, filled in place."""

    own_w2: Float = array("n")  # inverse variances, and `own` means, of single angles, by this epoch
    own: Float = array("n")
    past_w2: Float = array("n")  # the same, by the state before
    past: Float = array("n")
    palm: Float = array(4, 4)  # the palm by the state before
    palm_w2: Float = array(6)  # inverse variances of turn [rad] and shift [m] from there; 0: no prior
    line_of_sight: Float = array(3)  # unit vector along which depth is held
    depth_w2: Float = array(1)  # how firmly [1/m^2]
    back_normal: Float = array(3)  # unit vector along which the back looks
    back_normal_w2: Float = array(1)
    z: Float = array("K")  # mean of the extras (`master.estimator.sensors`)
    z_info: Float = array("K", "K")  # their information
    orientation_info: Float = array(3, 3)  # [1/rad^2] information of the measured orientation, rig axes
    oriented: Float = array(1)  # whether there is any
    forearm: Float = array(4, 4)  # rotation of the palm by these; `on_forearm`: of a straight wrist
    on_forearm: Float = array(1)
    axes: Float = array(3, 3)  # rows, rig axes, about which tilt and heading turn a forearm
    place: Float = array(3)  # [m] where the palm is
    place_w2: Float = array(1)  # how firmly; 0: not known
    cycle_rows: CycleRows = part(CycleRows)


class Iterate:
    """A hand of N = 6 + n + K unknowns in a search, and the normal equations there."""

    palm: Float = array(4, 4)
    x: Float = array("n")  # free angles
    z: Float = array("K")  # extras
    gradient: Float = array("N")
    normal: Float = array("N", "N")


class Search:
    """Scratch for a search."""

    trial: Iterate = part(Iterate)
    damped: Float = array("N", "N")
    L: Float = array("N", "N")
    step: Float = array("N")
    down: Float = array("N")
    palm: Float = array(4, 4)
    off: Float = array(6)
    q: Float = array(3)
    J: Float = array(3, 3)
    palm_straight: Float = array(4, 4)
    extras_jacobian: Float = array(5, 3)
    by_rotation: Float = array(8, 3)
    palm_camera: Float = array(4, 4)
    wrist_axes: Float = array(2, 3)
    twist: Float = array(5)
    local_J: Float = array(3, 8)
    local_r: Float = array(3)
    local_w: Float = array(3)
    column: Int = array(8, kind="i8")  # unknowns of the rows of a finger
    surface: Surface = part(Surface)
    held: Bool = array("N", kind="u1")
    marker_chi2: Float = array("M")
    information: Float = array("M", 3, 3)
    outliers: Float = array(1)
    rows: Scratch = part(Scratch)


class Observations(NamedTuple):
    """What is measured of M markers of a hand at one epoch."""

    uv: Float  # (C, M, 2) [px] centroids in the distorted images
    weight: Float  # (C, M) [1/px^2] inverse variance per axis, of each camera's own errors; 0: no row
    own: Float  # (M, 3, 3) [1/m^2] inverse covariance of what is wrong with the marker itself
    point: Float  # (M, 3) [m] measured places, rig frame
    information: Float  # (M, 3, 3) [1/m^2] their inverse covariances
    triangulated: Bool  # (M,) whether there is a POINT row
    seen: Bool  # (M,) whether there is any row
    rays: Int  # (M,) how many rays; of a POINT row two

    @classmethod
    def empty(cls, cameras: int, markers: int) -> "Observations":
        """Scratch for one epoch; nothing is seen yet."""
        return cls(
            np.zeros((cameras, markers, 2)),
            np.zeros((cameras, markers)),
            np.zeros((markers, 3, 3)),
            np.zeros((markers, 3)),
            np.zeros((markers, 3, 3)),
            np.zeros(markers, np.bool_),
            np.zeros(markers, np.bool_),
            np.zeros(markers, np.int64),
        )


class Problem(NamedTuple):
    """What a search minimises."""

    rig: Rig
    posture_prior: PosturePrior
    epoch_prior: EpochPrior
    observed: Observations


@inlined
def _ray(cameras: CameraArrays, observed: Observations, c: int, m: int, point: Float, work: Scratch) -> float:
    """Add one RAY row to information and gradient by place; return half chi square."""
    J, g, H = work.J, work.g, work.H
    if not project(cameras, c, point, work.uv, J):
        return KERNEL.behind_chi2
    w, r0, r1 = observed.weight[c, m], work.uv[0] - observed.uv[c, m, 0], work.uv[1] - observed.uv[c, m, 1]
    for a in range(3):
        g[a] += w * (J[0, a] * r0 + J[1, a] * r1)
        for b in range(3):
            H[a, b] += w * (J[0, a] * J[0, b] + J[1, a] * J[1, b])
    return 0.5 * w * (r0 * r0 + r1 * r1)


@inlined
def marker_rows(
    cameras: CameraArrays, observed: Observations, m: int, point: Float, work: Scratch
) -> tuple[float, float]:
    """Write information `work.H` (3, 3) and gradient `work.g` (3,) of marker m.

    `point` (3,): where the hand has it. Returns half chi square, and chi square of the place alone: without
    what rays that do not meet have between them.
    """
    H, g, K, gain, left = work.H, work.g, work.K, work.gain, work.left
    cost = 0.0
    for a in range(3):
        g[a] = 0.0
        for b in range(3):
            H[a, b] = 0.0
    if observed.triangulated[m]:
        for i in range(3):
            for j in range(3):
                H[i, j] = observed.information[m, i, j]
                g[i] += observed.information[m, i, j] * (point[j] - observed.point[m, j])
            cost += 0.5 * g[i] * (point[i] - observed.point[m, i])
        return cost, 2.0 * cost
    for c in range(observed.uv.shape[0]):
        if observed.weight[c, m] > 0.0:
            cost += _ray(cameras, observed, c, m, point, work)
    for i in range(3):
        for j in range(3):
            nowhere = 1.0  # [1/m^2] information about a marker that no row constrains
            K[i, j] = nowhere if i == j else 0.0
    inverse_3(H, K, K)
    whole, shared = 0.0, 0.0
    for i in range(3):
        whole += g[i] * (K[i, 0] * g[0] + K[i, 1] * g[1] + K[i, 2] * g[2])
    inverse_3(H, observed.own[m], K)
    for i in range(3):
        gain[i] = K[i, 0] * g[0] + K[i, 1] * g[1] + K[i, 2] * g[2]
        shared += g[i] * gain[i]
        for j in range(3):
            left[i, j] = H[i, j]
    for a in range(3):
        g[a] -= left[a, 0] * gain[0] + left[a, 1] * gain[1] + left[a, 2] * gain[2]
        for k in range(3):
            work.gained[a, k] = left[a, 0] * K[0, k] + left[a, 1] * K[1, k] + left[a, 2] * K[2, k]
        for b in range(3):
            total = 0.0
            for k in range(3):
                total += work.gained[a, k] * left[b, k]
            H[a, b] -= total
    return cost - 0.5 * shared, max(whole - shared, 0.0)


@kernel
def observe_rays(uv: Float, variance: Float, own: Float, markers: Int, observed: Observations) -> None:
    """Write the RAY rows of a hand's markers (M,) among A of the rig.

    `uv` (C, A, 2) [px]; NaN: not seen. `variance` (C, A) [px^2] of each camera's own errors, `own` (A, 3, 3)
    [m^2] of what is wrong with each marker itself.
    """
    zero = np.zeros((3, 3))
    for k in range(markers.shape[0]):
        m, rays = markers[k], 0
        for c in range(uv.shape[0]):
            row = np.isfinite(uv[c, m, 0] + uv[c, m, 1] + variance[c, m])
            observed.weight[c, k] = 1.0 / variance[c, m] if row else 0.0
            observed.uv[c, k, 0], observed.uv[c, k, 1] = uv[c, m, 0], uv[c, m, 1]
            rays += 1 if row else 0
        observed.seen[k], observed.triangulated[k], observed.rays[k] = rays > 0, False, rays
        if rays > 0:
            inverse_3(own[m], zero, observed.own[k])


@kernel
def observe_points(point: Float, cov: Float, own_m2: float, observed: Observations) -> None:
    """Write POINT rows of points (M, 3) [m] and cov (M, 3, 3) [m^2]; NaN: not seen.

    `own_m2`: variance of what is wrong with the markers themselves.
    """
    own = np.zeros((3, 3))
    for i in range(3):
        own[i, i] = own_m2
    for m in range(point.shape[0]):
        total = 0.0
        for i in range(3):
            total += point[m, i]
            observed.point[m, i] = point[m, i]
            for j in range(3):
                total += cov[m, i, j]
        seen = np.isfinite(total)
        observed.seen[m], observed.triangulated[m], observed.rays[m] = seen, seen, 2 if seen else 0
        for c in range(observed.weight.shape[0]):
            observed.weight[c, m] = 0.0
        if seen:
            inverse_3(cov[m], own, observed.information[m])


@inlined
def rotation_vector_jacobian(rotation: Float, J: Float) -> None:
    """Write a rotation vector's derivative (3, 3) by a small rotation in front.

    The inverse of the left Jacobian of SO(3) (Sola, Deray, Atchuthan 2018, "A micro Lie theory", eq. 146).
    """
    squared = rotation[0] * rotation[0] + rotation[1] * rotation[1] + rotation[2] * rotation[2]
    angle = max(sqrt(squared), KERNEL.small_rad)
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
    """Write the palm's rotation by other sensors, and its derivative by the extras.

    To `search.palm` (3, 3) and `extras_jacobian` (5, 3). By an IMU on the forearm it is exp(axes . (tilt,
    heading less its prior)) forearm R_y(deviation) R_x(flexion), and extras are tilt 2, heading, flexion,
    deviation; by one on the palm itself it is `forearm`, which none turns.
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
    """Return chi square of a palm against its rotation by other sensors.

    That of the extras' deviation from their prior, by which they accommodated the palm, is included.
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
def orientation_row(epoch_prior: EpochPrior, at: Iterate, search: Search) -> float:
    """Add the TURN row; return its cost."""
    J, q, extras_jacobian, n = search.J, search.q, search.extras_jacobian, at.x.shape[0]
    K = 5 if epoch_prior.on_forearm[0] > 0.0 else 0
    sensed_palm(epoch_prior, at.z, search)
    rotation_between(at.palm, search.palm, J, q)
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
        at.gradient[ia] += D[a, 0] * w[0] + D[a, 1] * w[1] + D[a, 2] * w[2]
        for b in range(3 + K):
            ib = b if b < 3 else _column(n, b - 3)
            total = 0.0
            for i in range(3):
                for j in range(3):
                    total += D[a, i] * L[i, j] * D[b, j]
            at.normal[ia, ib] += total
    return cost


@inlined
def _column(n: int, a: int) -> int:
    """The unknown of tilt 2, heading, flexion, deviation."""
    return 6 + n + (TILT + a if a < 3 else WRIST_ANGLES + a - 3)


@inlined
def rotate_by_vector(rotation: Float, R: Float, out: Float) -> None:
    """Write R (3, 3) turned in front by a small vector (3,), to second order."""
    x, y, z = rotation[0], rotation[1], rotation[2]
    for j in range(3):
        a, b, c = R[0, j], R[1, j], R[2, j]
        u, v, w = y * c - z * b, z * a - x * c, x * b - y * a
        out[0, j] = a + u + 0.5 * (y * w - z * v)
        out[1, j] = b + v + 0.5 * (z * u - x * w)
        out[2, j] = c + w + 0.5 * (x * v - y * u)


@inner
def finger_rows(rig: Rig, epoch_prior: EpochPrior, f: int, at: Iterate, search: Search) -> float:
    """Add the rows of finger f at `search.rows.angles`; return their cost."""
    hand, cycle_rows, work, surface = rig.hand, epoch_prior.cycle_rows, search.rows, search.surface
    start = hand.first[f]
    count, base = hand.first[f + 1] - start, 6 + at.x.shape[0]
    J, r, w, column = search.local_J, search.local_r, search.local_w, search.column
    for c in range(count):
        column[c] = 6 + start + c
    column[count], column[count + 1] = base + f, base + WRIST_ANGLES
    column[count + 2], column[count + 3] = base + WRIST_ANGLES + 1, base + LED_SCALE
    size, cost = count + 4, 0.0
    if cycle_rows.lit[f] == 0.0 and cycle_rows.shown[f] == 0.0:
        return 0.0
    look(hand, rig.device, search.palm_camera, search.wrist_axes, work.angles, f, MOVES, surface)
    for what in range(2):
        if (what == 0 and cycle_rows.lit[f] == 0.0) or (what == 1 and cycle_rows.shown[f] == 0.0):
            continue
        W, first = cycle_rows.laser_W[f], 2 * what
        rows = 3 if what == 1 and cycle_rows.depth_w2[f] > 0.0 else 2
        if what == 0:
            r[0] = surface.seen[0] + cycle_rows.lack[f, 0] - cycle_rows.laser[f, 0]
            r[1] = surface.seen[1] + cycle_rows.lack[f, 1] - cycle_rows.laser[f, 1]
        else:
            W = cycle_rows.tip_W[f]
            r[0] = surface.seen[2] - cycle_rows.tip[f, 0]
            r[1] = surface.seen[3] - cycle_rows.tip[f, 1]
            if rows == 3:
                r[2] = surface.seen[4] + at.z[LED_SCALE] - cycle_rows.depth[f]
        for i in range(rows):
            for c in range(count):
                J[i, c] = 0.0
                for k in range(4):
                    J[i, c] += surface.J[first + i, k] * work.by[4 * f + k, c]
            for c in range(3):
                J[i, count + c] = surface.J[first + i, 4 + c]
            J[i, count] *= cycle_rows.teaches[f]
            J[i, count + 3] = 1.0 if i == 2 else 0.0
        for i in range(rows):
            if i == 2:
                w[2] = cycle_rows.depth_w2[f] * r[2]
            else:
                w[i] = W[i, 0] * r[0] + W[i, 1] * r[1]
            cost += 0.5 * w[i] * r[i]
        for a in range(size):
            # What fingers measure of the bend counts for little: they err together, as the device is put on.
            of_wrist = a == count + 1 or a == count + 2
            share = rig.settings.wrist_share if of_wrist else 1.0
            for i in range(rows):
                at.gradient[column[a]] += share * J[i, a] * w[i]
            p0 = W[0, 0] * J[0, a] + W[0, 1] * J[1, a]
            p1 = W[1, 0] * J[0, a] + W[1, 1] * J[1, a]
            p2 = cycle_rows.depth_w2[f] * J[2, a] if rows == 3 else 0.0
            for b in range(size):
                total = p0 * J[0, b] + p1 * J[1, b]
                if rows == 3:
                    total += p2 * J[2, b]
                if b == count + 1 or b == count + 2 or of_wrist:
                    total *= rig.settings.wrist_share
                at.normal[column[a], column[b]] += total
    return cost
