"""Kernel of the palm's fit: six numbers, and the angles beside them.

Where three markers lie on the back they fix the palm. With one, its turn is open: every finger reaches its tip from
many palms, and what tells them apart is how hands bend. So the fit has the fingers' free angles beside the palm's six
numbers, with their posture prior; only the palm is taken from it, the fingers are solved by FABRIK afterwards.

Levenberg-Marquardt on the stacked residuals (Madsen, Nielsen, Tingleff 2004, algorithm 3.16), angles within their
limits by holding those that the next step would carry across (projected Newton, Bertsekas 1982).
"""

from math import cos, sin, sqrt
from typing import NamedTuple

import numpy as np

from common.arrays import Bool, Float
from common.kernels import kernel
from master.estimator.small_matrices import factor, inverse_3, substitute
from master.fabrik.hand_tables import HandTables, Mounts
from master.fabrik.kinematics import angles_of, chains, place, point_slopes, rig_slopes

MAX_ITERATIONS = 30


class PalmPrior(NamedTuple):
    """What is known before the markers of this instant.

    Attributes:
        normal, pull: (n, n), (n,) of the angles' habits: cost x' normal x / 2 - pull' x.
        x, weight: (n,) angles [rad] expected from the last instant, one per standard deviation; 0: nothing is.
        T: (4, 4) palm expected from the last instant.
        palm_weight: (6,) one per standard deviation of its turn [rad] and shift [m]; 0: nothing is expected.
        facing: (3,) unit vector along which the back of the hand looks.
        facing_weight: One per standard deviation; 0: not known.
    """

    normal: Float
    pull: Float
    x: Float
    weight: Float
    T: Float
    palm_weight: Float
    facing: Float
    facing_weight: float


@kernel
def linearise(
    tables: HandTables,
    mounts: Mounts,
    prior: PalmPrior,
    points: Float,
    information: Float,
    seen: Bool,
    T: Float,
    x: Float,
    gradient: Float,
    normal: Float,
    surprise: Float,
) -> float:
    """Return half the sum of squared residuals; write its derivatives.

    Written are gradient, normal matrix, and chi square of each marker. Arguments as of `fit`.
    """
    n = x.shape[0]
    angles, by = np.empty(20), np.empty((20, n))
    angles_of(tables, x, angles, by)
    R, P = np.empty((5, 4, 3, 3)), np.empty((5, 4, 3))
    chains(tables, angles, R, P)
    gradient[:] = 0.0
    normal[:, :] = 0.0
    cost = 0.0
    for i in range(n):
        total = 0.0
        for j in range(n):
            normal[6 + i, 6 + j] = prior.normal[i, j]
            total += prior.normal[i, j] * x[j]
        gradient[6 + i] = total - prior.pull[i]
        cost += (0.5 * total - prior.pull[i]) * x[i]
        w2, off_x = prior.weight[i] * prior.weight[i], x[i] - prior.x[i]
        normal[6 + i, 6 + i] += w2
        gradient[6 + i] += w2 * off_x
        cost += 0.5 * w2 * off_x * off_x
    point, arm, off, pull = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    by_x = np.empty((n, 3))
    J, WJ, used = np.empty((6 + n, 3)), np.empty(3), np.empty(6 + n, np.int64)
    for m in range(mounts.finger.shape[0]):
        surprise[m] = 0.0
        if not seen[m]:
            continue
        place(mounts, m, R, P, point)
        for i in range(3):
            arm[i] = T[i, 0] * point[0] + T[i, 1] * point[1] + T[i, 2] * point[2]
            off[i] = arm[i] + T[i, 3] - points[m, i]
        f = mounts.finger[m]
        if f >= 0:
            point_slopes(tables, by, f, mounts.level[m], point, R, P, by_x)
        else:
            by_x[:, :] = 0.0
        count = rig_slopes(T, arm, by_x, True, J, used)
        for i in range(3):
            pull[i] = (
                information[m, i, 0] * off[0] + information[m, i, 1] * off[1] + information[m, i, 2] * off[2]
            )
            cost += 0.5 * pull[i] * off[i]
            surprise[m] += pull[i] * off[i]
        for a in range(count):
            gradient[used[a]] += J[a, 0] * pull[0] + J[a, 1] * pull[1] + J[a, 2] * pull[2]
            for i in range(3):
                WJ[i] = (
                    information[m, i, 0] * J[a, 0]
                    + information[m, i, 1] * J[a, 1]
                    + information[m, i, 2] * J[a, 2]
                )
            for b in range(count):
                normal[used[a], used[b]] += WJ[0] * J[b, 0] + WJ[1] * J[b, 1] + WJ[2] * J[b, 2]
    w2 = prior.facing_weight * prior.facing_weight
    if w2 > 0.0:
        # dorsal - facing, with the derivative of the palm's +y by a turn: axis x y
        yx, yy, yz = T[0, 1], T[1, 1], T[2, 1]
        dx, dy, dz = yx - prior.facing[0], yy - prior.facing[1], yz - prior.facing[2]
        cost += 0.5 * w2 * (dx * dx + dy * dy + dz * dz)
        gradient[0] += w2 * (yy * dz - yz * dy)
        gradient[1] += w2 * (yz * dx - yx * dz)
        gradient[2] += w2 * (yx * dy - yy * dx)
        normal[0, 0] += w2 * (yy * yy + yz * yz)
        normal[1, 1] += w2 * (yx * yx + yz * yz)
        normal[2, 2] += w2 * (yx * yx + yy * yy)
        normal[0, 1] -= w2 * yx * yy
        normal[1, 0] -= w2 * yx * yy
        normal[0, 2] -= w2 * yx * yz
        normal[2, 0] -= w2 * yx * yz
        normal[1, 2] -= w2 * yy * yz
        normal[2, 1] -= w2 * yy * yz
    if prior.palm_weight[0] > 0.0:
        step = np.empty(6)
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            turned = 0.0  # sine of the angle times the axis, of T prior.T'
            for c in range(3):
                turned += T[k, c] * prior.T[j, c] - T[j, c] * prior.T[k, c]
            step[i] = 0.5 * turned
            step[3 + i] = T[i, 3] - prior.T[i, 3]
        for i in range(6):
            w2 = prior.palm_weight[i] * prior.palm_weight[i]
            cost += 0.5 * w2 * step[i] * step[i]
            gradient[i] += w2 * step[i]
            normal[i, i] += w2
    return cost


@kernel
def rotate_by(step: Float, T: Float, out: Float) -> None:
    """Write T (4, 4) turned in front by step[:3] [rad], shifted by step[3:6] [m]."""
    x, y, z = step[0], step[1], step[2]
    angle = sqrt(x * x + y * y + z * z)
    a = sin(angle) / angle if angle > 1e-9 else 1.0
    b = (1.0 - cos(angle)) / (angle * angle) if angle > 1e-5 else 0.5
    r = np.empty((3, 3))
    r[0, 0], r[0, 1], r[0, 2] = 1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y
    r[1, 0], r[1, 1], r[1, 2] = b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x
    r[2, 0], r[2, 1], r[2, 2] = b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)
    for i in range(3):
        for j in range(3):
            out[i, j] = r[i, 0] * T[0, j] + r[i, 1] * T[1, j] + r[i, 2] * T[2, j]
        out[i, 3] = T[i, 3] + step[3 + i]


@kernel
def fit(
    tables: HandTables,
    mounts: Mounts,
    prior: PalmPrior,
    points: Float,
    information: Float,
    seen: Bool,
    T: Float,
    x: Float,
    normal: Float,
    surprise: Float,
    tolerance: float,
) -> tuple[float, int]:
    """Descend from T and x, in place, to the least cost; return it and the steps.

    Args:
        tables, mounts, prior: The hand, its markers, what is known of it.
        points: (M, 3) [m], rig frame.
        information: (M, 3, 3) [1/m^2] inverse covariances.
        seen: (M,).
        T, x: (4, 4), (n,) start, and then the end.
        normal: (6 + n, 6 + n) Gauss-Newton normal matrix at the end.
        surprise: (M,) chi square of each marker at the end; 0: not seen.
        tolerance: Of half chi square that a further step may gain.
    """
    n = x.shape[0]
    size = 6 + n
    gradient, trial_gradient = np.empty(size), np.empty(size)
    trial_normal, damped, L = np.empty((size, size)), np.empty((size, size)), np.zeros((size, size))
    trial_surprise = np.empty_like(surprise)
    step, downhill, held = np.empty(size), np.empty(size), np.zeros(size, np.bool_)
    T_new, x_new = T.copy(), x.copy()
    cost = linearise(tables, mounts, prior, points, information, seen, T, x, gradient, normal, surprise)
    damping, growth = 1e-4, 2.0
    iterations = 0
    while iterations < MAX_ITERATIONS:
        iterations += 1
        damped[:, :] = normal
        for i in range(size):
            damped[i, i] *= 1.0 + damping
            downhill[i] = -gradient[i]
            held[i] = False
            if i >= 6:
                c = i - 6
                held[i] = (x[c] <= tables.low[c] and downhill[i] < 0.0) or (
                    x[c] >= tables.high[c] and downhill[i] > 0.0
                )
        if not factor(damped, held, L):
            damping, growth = damping * growth, 2.0 * growth
            continue
        substitute(L, downhill, held, step)
        hoped = 0.0
        for i in range(size):
            if not held[i]:
                hoped += 0.5 * downhill[i] * step[i]
        if hoped < tolerance and damping <= 1e-3:
            break
        rotate_by(step, T, T_new)
        for c in range(n):
            x_new[c] = min(max(x[c] + step[6 + c], tables.low[c]), tables.high[c])
        there = linearise(
            tables,
            mounts,
            prior,
            points,
            information,
            seen,
            T_new,
            x_new,
            trial_gradient,
            trial_normal,
            trial_surprise,
        )
        gain = cost - there
        if gain > 0.0:
            T[:, :] = T_new
            x[:] = x_new
            cost = there
            gradient[:] = trial_gradient
            normal[:, :] = trial_normal
            surprise[:] = trial_surprise
            damping = max(damping * max(1.0 / 3.0, 1.0 - (2.0 * gain / hoped - 1.0) ** 3), 1e-9)
            growth = 2.0
            if gain < tolerance:
                break
        else:
            damping, growth = damping * growth, 2.0 * growth
            if damping > 1e6:
                break
    return cost, iterations


@kernel
def informations(points: Float, cov: Float, model_m2: float, seen: Bool, out: Float) -> int:
    """Write which markers are seen and their inverse covariances; count them.

    `out`: (M, 3, 3) inverses of cov + model_m2 I, of those `seen` (M,).
    """
    count = 0
    for m in range(points.shape[0]):
        total = points[m, 0] + points[m, 1] + points[m, 2]
        for i in range(3):
            total += cov[m, i, 0] + cov[m, i, 1] + cov[m, i, 2]
        seen[m] = np.isfinite(total)
        if seen[m]:
            inverse_3(cov[m], model_m2, out[m])
            count += 1
    return count


@kernel
def facing_of(points: Float, area_px2: Float, centres: Float, focal_px: Float, out: Float) -> bool:
    """Write the unit vector from a hand to the cameras that see its back.

    A flat marker shows each camera its area times the cosine of its tilt, so the directions to the cameras, weighed by
    what each sees, add up to where it faces, as far as they tell.

    Args:
        points: (M, 3) [m] its markers, rig frame; NaN: not placed.
        area_px2: (C, K) of those on its back as each camera sees them; NaN: not seen.
        centres, focal_px: (C, 3) [m] and (C,) of the cameras.
        out: (3,) written.

    Returns:
        Whether a marker is placed; else nothing is written.
    """
    count = 0
    middle, back = np.zeros(3), np.empty(3)
    for m in range(points.shape[0]):
        if np.isfinite(points[m, 0]):
            count += 1
            for i in range(3):
                middle[i] += points[m, i]
    if count == 0:
        return False
    sum_px2, shown_px2 = 0.0, np.zeros(centres.shape[0])
    for c in range(centres.shape[0]):
        for k in range(area_px2.shape[1]):
            if np.isfinite(area_px2[c, k]):
                shown_px2[c] += area_px2[c, k]
        sum_px2 += shown_px2[c]
    for i in range(3):
        out[i] = 0.0
    for c in range(centres.shape[0]):
        squared = 0.0
        for i in range(3):
            back[i] = centres[c, i] - middle[i] / count
            squared += back[i] * back[i]
        weight = 1.0 if sum_px2 == 0.0 else shown_px2[c] * squared / (focal_px[c] * focal_px[c])
        for i in range(3):
            out[i] += weight * back[i] / sqrt(squared)
    length = sqrt(out[0] * out[0] + out[1] * out[1] + out[2] * out[2])
    if length > 0.0:
        for i in range(3):
            out[i] /= length
    else:  # cameras on both sides
        for i in range(3):
            out[i] = 1.0 if i == 2 else 0.0
    return True


@kernel
def targets_of(points: Float, cov: Float, T: Float, places: Float, fit_m2: float, out: Float) -> None:
    """Write where fingers are to bring their markers (M, 3) [m], palm frame.

    Where they are measured, as far as that is surer than the fit.

    Args:
        points, cov: (M, 3) [m] and (M, 3, 3) [m^2] measured, rig frame; NaN: not seen.
        T: (4, 4) palm.
        places: (M, 3) [m] where the palm's fit has them, palm frame.
        fit_m2: Variance of these.
        out: Written; NaN where not seen.
    """
    gain, off, moved = np.empty((3, 3)), np.empty(3), np.empty(3)
    for m in range(points.shape[0]):
        inverse_3(cov[m], fit_m2, gain)
        for i in range(3):
            here = T[i, 0] * places[m, 0] + T[i, 1] * places[m, 1] + T[i, 2] * places[m, 2]
            off[i] = points[m, i] - here - T[i, 3]
        for i in range(3):
            moved[i] = fit_m2 * (gain[i, 0] * off[0] + gain[i, 1] * off[1] + gain[i, 2] * off[2])
        for i in range(3):
            out[m, i] = places[m, i] + T[0, i] * moved[0] + T[1, i] * moved[1] + T[2, i] * moved[2]
