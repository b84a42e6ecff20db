"""Angles of a finger follow from one point on it, in closed form.

Angles are (4,): abduction, flexion, PIP, DIP (thumb: CMC abduction, CMC flexion, MCP, IP) [rad]. A point
leaves one angle free; with DIP = ratio * PIP the finger is exactly determined. In the root joint's frame the
point lies at w(PIP), which neither flexion nor abduction can stretch:

    |target - root| = |w(PIP)|       monotone but for a few degrees round the straight finger -> PIP
    R_y(a) rest R_x(-f) w = target   y gives the flexion, x and z the abduction: two atan2

This holds for bones out of plane too. The range of the PIP is cut where |w| turns, and where the DIP meets
its own limit, into branches on which |w| is monotone; each is inverted by Newton's method inside a bracket.

Where no such pose is legal, damped least squares (Wampler 1986; Levenberg-Marquardt) go on from the nearest
of them inside the limits. An angle at its limit that the gradient would push outside is left out of the step,
J^T (J J^T + damping I)^-1 r: with more angles than equations the step of least change, which keeps a
redundant finger near its seed. Where abduction narrows with flexion the region is no box. So the first
unknown is not the abduction a but a / (share of the range that is left at this flexion), whose limits are
constant.
"""

from math import cos, inf, isfinite, sin, sqrt

import numpy as np

from common.arrays import Float
from common.kernels import constant, inner, kernel
from master.fabrik.joints import (
    BONE,
    REST,
    ROOT,
    ROTATION,
    SIGN,
    START,
    ChainArrays,
    clamp_angles,
    end_of,
    forward,
    hinge_fit,
    limits_of,
    matrix_at,
    narrowing,
    put_vector,
    swing_and_flex,
    vector_at,
)
from master.fabrik.linear_algebra import (
    Vector,
    cross,
    dot,
    length,
    minus,
    plus,
    rotate,
    rotate_back,
)
from master.fabrik.settings import FABRIK


@kernel
def least_squares(
    chain: ChainArrays, goal: Vector, tolerance_m: float, max_steps: int, angles: Float
) -> float:
    """Improve a finger's angles until the target is hit; return the distance [m].

    A rotor (box) and two flexion hinges; its coupling is obeyed. `goal` [m], root frame, finite; `max_steps`
    of the search, taken or refused; `angles` (4,) [rad]; in: start, clamped to the limits; out: legal.
    """
    share, _ = narrowing(limits_of(chain, ROOT), angles[1])
    unknowns, trial = angles.copy(), np.empty(4)
    unknowns[0] = angles[0] / share if share > 0.0 else 0.0
    columns, trial_columns = np.empty((4, 3)), np.empty((4, 3))
    next_angles = np.empty(4)
    left = _evaluate(chain, goal, unknowns, angles, columns)
    cost, damping = dot(left, left), FABRIK.first_damping_m2
    for _ in range(max_steps):
        if cost <= tolerance_m * tolerance_m or not _step(chain, unknowns, left, columns, damping, trial):
            break
        trial_left = _evaluate(chain, goal, trial, next_angles, trial_columns)
        trial_cost = dot(trial_left, trial_left)
        least_damping_m2, most_damping_m2 = 1e-13, 1.0
        if trial_cost < cost:
            gain = cost - trial_cost
            left, cost, damping = trial_left, trial_cost, max(damping * FABRIK.damping_down, least_damping_m2)
            for i in range(4):
                unknowns[i], angles[i] = trial[i], next_angles[i]
                put_vector(columns, i, vector_at(trial_columns, i, START))
            least_gain = 1e-7
            if gain < least_gain * (cost + gain):
                break
        elif damping > most_damping_m2:
            break
        else:
            damping *= FABRIK.damping_up
    return length(left)


@kernel
def _evaluate(chain: ChainArrays, goal: Vector, unknowns: Float, angles: Float, columns: Float) -> Vector:
    """Clamp the unknowns, write angles and Jacobian's columns (4, 3); what is left."""
    limits = limits_of(chain, ROOT)
    unknowns[0] = min(max(unknowns[0], limits.low), limits.high)
    unknowns[1] = min(max(unknowns[1], limits.flexion_low), limits.flexion_high)
    share, narrowing_derivative = narrowing(limits, unknowns[1])
    angles[0] = share * unknowns[0]
    for i in range(1, 4):
        angles[i] = unknowns[i]
    clamp_angles(chain, angles)
    for i in range(1, 4):
        unknowns[i] = angles[i]
    positions, orientations = np.empty((4, 3)), np.empty((3, 9))
    forward(chain, angles, positions, orientations)
    end, sign = vector_at(positions, len(positions) - 1, START), limits.sign
    (_, x, _), (_, y, _), (_, z, _) = matrix_at(chain.links, ROOT, ROTATION)
    axis = (sign * x, sign * y, sign * z)
    put_vector(columns, ROOT, cross(axis, minus(end, vector_at(positions, ROOT, START))))
    for k in range(3):
        axis = (-orientations[k, 0], -orientations[k, 3], -orientations[k, 6])
        put_vector(columns, k + 1, cross(axis, minus(end, vector_at(positions, k, START))))
    coupled_rad = 1e-12
    follows = chain.follower >= 0 and abs(angles[3] - chain.ratio * angles[2]) < coupled_rad
    ratio, narrows = chain.ratio if follows else 0.0, unknowns[0] * narrowing_derivative
    for j in range(3):
        if chain.follower >= 0:
            columns[2, j] += ratio * columns[3, j]
            columns[3, j] = 0.0
        columns[1, j] += narrows * columns[0, j]
        columns[0, j] *= share
    return minus(goal, end)


@inner
def _step(
    chain: ChainArrays, unknowns: Float, left: Vector, columns: Float, damping: float, new: Float
) -> bool:
    """Write the next unknowns (4,), not yet clamped; False: all are uphill."""
    xx = yy = zz = damping
    xy = xz = yz = 0.0
    some = False
    for i in range(4):
        x, y, z = vector_at(columns, i, START)
        if _free(chain, unknowns, left, columns, i):
            some = True
            xx += x * x
            yy += y * y
            zz += z * z
            xy += x * y
            xz += x * z
            yz += y * z
    a, b, c = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    d, e, f = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    determinant = xx * a + xy * b + xz * c
    if not some or not determinant > 0.0:
        return False
    x, y, z = dot((a, b, c), left), dot((b, d, e), left), dot((c, e, f), left)
    weights = (x / determinant, y / determinant, z / determinant)
    for i in range(4):
        free = _free(chain, unknowns, left, columns, i)
        new[i] = unknowns[i] + (dot(vector_at(columns, i, START), weights) if free else 0.0)
    return True


@inner
def _free(chain: ChainArrays, unknowns: Float, left: Vector, columns: Float, i: int) -> bool:
    """Whether unknown i has room, and is not pushed out at its limit."""
    low, high = chain.spans[i, 0], chain.spans[i, 1]
    pull = dot(vector_at(columns, i, START), left)
    return not (low == high or (unknowns[i] <= low and pull <= 0.0) or (unknowns[i] >= high and pull >= 0.0))


PIP, DIP = constant(1), constant(2)  # links
_STARTS = 4 + 2 * len(FABRIK.starts)


@kernel
def closed_form(
    chain: ChainArrays,
    edges: Float,
    ratio: float,
    goal: Vector,
    warm_start: Float,
    angles: Float,
    initial_angles: Float,
) -> float:
    """The legal pose that hits the target; return the distance [m], or infinity.

    Args:
        edges: (B + 1,) ends of the branches of the PIP, rising [rad].
        ratio: DIP per PIP.
        goal: Target [m], root frame, finite.
        warm_start: (4,) angles of a moment ago [rad]: where several legal poses hit the target (straight finger, pole
            of the abduction) the nearest is taken; NaN: the more bent one, then the less abducted.
        angles: (4,) [rad]; out, where there is such a pose.
        initial_angles: (3, 4) [rad]; out, legal poses from which to search on where there is none.
    """
    local = rotate_back(matrix_at(chain.links, ROOT, ROTATION), goal)
    distance2, branches = dot(local, local), len(edges) - 1
    penalties, trial = np.full(2, inf), np.empty(4)
    best, residual = inf, inf
    for b in range(branches - 1, -1, -1):
        pip, off = _invert(chain, ratio, edges[b], edges[b + 1], distance2)
        dip = min(max(ratio * pip, chain.spans[3, 0]), chain.spans[3, 1])
        for side in range(2):
            cut = _swing(chain, pip, dip, local, side, trial)
            slack_rad = 1e-6
            edge_m2 = 1e-14
            if cut <= slack_rad and off <= edge_m2:
                # bones out of plane cannot point exactly at the pole: legal angles may still miss
                miss = length(minus(end_of(chain, trial), goal))
                rank = _rank(trial, warm_start, branches - 1 - b)
                if miss < FABRIK.reached_m and rank < best:
                    best, residual = rank, miss
                    _copy(trial, angles)
            _keep(initial_angles, penalties, trial, cut + 1e2 * sqrt(max(off, 0.0)))
    if residual == inf:
        _in_plane(chain, edges, ratio, local, initial_angles)
    return residual


@kernel
def distance2_of(chain: ChainArrays, ratio: float, pip: float) -> tuple[float, float]:
    """Squared distance |w|^2 [m^2] at a PIP [rad], and its derivative [m^2/rad]."""
    led = ratio * pip
    dip = min(max(led, chain.spans[3, 0]), chain.spans[3, 1])
    dip_per_pip, link_rotation = ratio if dip == led else 0.0, matrix_at(chain.links, DIP, ROTATION)
    tip = _flexed(dip, vector_at(chain.links, DIP, BONE))
    rotating = rotate(link_rotation, (0.0, dip_per_pip * tip[2], -dip_per_pip * tip[1]))
    end = plus(rotate(link_rotation, tip), vector_at(chain.links, PIP, BONE))
    end, rotating = _flexed(pip, end), _flexed(pip, rotating)
    link_rotation = matrix_at(chain.links, PIP, ROTATION)
    w = plus(rotate(link_rotation, end), vector_at(chain.links, ROOT, BONE))
    return dot(w, w), 2.0 * dot(w, rotate(link_rotation, plus(rotating, (0.0, end[2], -end[1]))))


@kernel
def distances2(chain: ChainArrays, ratio: float, pips: Float, squares: Float) -> None:
    """Squared distances |w|^2 [m^2] at many PIPs [rad], into `squares`."""
    for i in range(len(pips)):
        squares[i] = distance2_of(chain, ratio, pips[i])[0]


@inner
def _point(chain: ChainArrays, pip: float, dip: float) -> Vector:
    """The point w [m] in the root joint's frame at PIP and DIP [rad]."""
    tip = _flexed(dip, vector_at(chain.links, DIP, BONE))
    end = plus(rotate(matrix_at(chain.links, DIP, ROTATION), tip), vector_at(chain.links, PIP, BONE))
    end = rotate(matrix_at(chain.links, PIP, ROTATION), _flexed(pip, end))
    return plus(end, vector_at(chain.links, ROOT, BONE))


@inner
def _flexed(angle: float, v: Vector) -> Vector:
    """Vector v turned by R_x(-angle)."""
    c, s = cos(angle), sin(angle)
    return v[0], c * v[1] + s * v[2], c * v[2] - s * v[1]


@inner
def _invert(
    chain: ChainArrays, ratio: float, low: float, high: float, distance2: float
) -> tuple[float, float]:
    """PIP [rad] of |w|^2 on the branch [low, high], and how far that is beyond it.

    It starts linear in sqrt(|w|_far^2 - |w|^2), as the PIP nearly is, also at the straight finger.
    """
    d_low, d_high = distance2_of(chain, ratio, low)[0], distance2_of(chain, ratio, high)[0]
    far, bent = (low, high) if d_low >= d_high else (high, low)
    far2, near2 = max(d_low, d_high), min(d_low, d_high)
    off = max(distance2 - far2, near2 - distance2)
    if off >= 0.0:
        return far if distance2 >= far2 else bent, off
    pip = far + sqrt((far2 - distance2) / (far2 - near2)) * (bent - far)
    for _ in range(FABRIK.root_steps):
        value, dip_per_pip = distance2_of(chain, ratio, pip)
        if value > distance2:
            far = pip
        else:
            bent = pip
        new = pip + (distance2 - value) / dip_per_pip if dip_per_pip != 0.0 else inf
        if not min(far, bent) <= new <= max(far, bent):
            new = 0.5 * (far + bent)
        rounding = 1e-15
        if new == pip or abs(value - distance2) <= rounding * far2:
            break
        pip = new
    return pip, off


@inner
def _swing(chain: ChainArrays, pip: float, dip: float, local: Vector, side: int, angles: Float) -> float:
    """Write one of both poses that point w at the target, clamped by so much [rad]."""
    rest, w = matrix_at(chain.links, ROOT, REST), _point(chain, pip, dip)
    a, f = swing_and_flex(w, local, rest, chain.links[ROOT, SIGN])[side]
    angles[0], angles[1], angles[2], angles[3] = a, f, pip, dip
    clamp_angles(chain, angles)
    return max(abs(angles[0] - a), abs(angles[1] - f))


@inner
def _known(angles: Float) -> bool:
    return isfinite(angles[0] + angles[1] + angles[2] + angles[3])


@inner
def _rank(angles: Float, warm_start: Float, branch: int) -> float:
    """Rank of a pose that hits, least first: change [rad], or branch and abduction."""
    if not _known(warm_start):
        return branch * FABRIK.branch + abs(angles[0])
    rank = 0.0
    for i in range(4):
        rank += abs(angles[i] - warm_start[i])
    return rank


@inner
def _copy(source: Float, out: Float) -> None:
    for i in range(4):
        out[i] = source[i]


@inner
def _keep(initial_angles: Float, penalties: Float, angles: Float, penalty: float) -> None:
    """Keep a pose among the two (rows 1 and 2) that are least beyond what is legal."""
    if penalty < penalties[0]:
        penalties[1] = penalties[0]
        _copy(initial_angles[1], initial_angles[2])
        penalties[0] = penalty
        _copy(angles, initial_angles[1])
    elif penalty < penalties[1]:
        penalties[1] = penalty
        _copy(angles, initial_angles[2])


@inner
def _in_plane(chain: ChainArrays, edges: Float, ratio: float, local: Vector, initial_angles: Float) -> None:
    """Write row 0: with row 1's abduction, its plane's nearest point to the target."""
    a = initial_angles[1, 0]
    c, s = cos(chain.links[ROOT, SIGN] * a), sin(chain.links[ROOT, SIGN] * a)
    x, y, z = local
    x, y, z = rotate_back(matrix_at(chain.links, ROOT, REST), (c * x - s * z, y, s * x + c * z))
    last, in_plane2 = len(edges) - 1, y * y + z * z
    pip, lateral = 0.0, 0.0
    for _ in range(2):
        pip, _off = _invert(chain, ratio, edges[last - 1], edges[last], in_plane2 + lateral * lateral)
        lateral = _point(chain, pip, ratio * pip)[0]
    w = _point(chain, pip, ratio * pip)
    f = hinge_fit(chain.spans[1, 0], chain.spans[1, 1], (-1.0, 0.0, 0.0), w, (x, y, z), 0.0)
    initial_angles[0, 0], initial_angles[0, 1] = a, f
    initial_angles[0, 2], initial_angles[0, 3] = pip, ratio * pip


@kernel
def nearest_pose(
    chain: ChainArrays, goal: Vector, warm_start: Float, initial_angles: Float, angles: Float
) -> float:
    """The legal pose nearest to the target, where none hits it in closed form.

    Arguments as of `closed_form`, `angles` written; returns the distance of the point to the target [m].
    """
    best, trial = inf, np.empty(4)
    local = rotate_back(matrix_at(chain.links, ROOT, ROTATION), goal)
    starts = len(initial_angles) if chain.follower >= 0 else _STARTS
    for start in range(starts + 1):
        steps = FABRIK.first_steps
        if start < starts:
            _start(chain, local, warm_start, initial_angles, start, trial)
        else:
            steps = FABRIK.most_steps
            _copy(angles, trial)
        left = least_squares(chain, goal, FABRIK.within * FABRIK.reached_m, steps, trial)
        if start == 0 or left < best:
            best = left
            _copy(trial, angles)
        if best < FABRIK.reached_m:
            break
    return best


@inner
def _start(
    chain: ChainArrays, local: Vector, warm_start: Float, initial_angles: Float, start: int, angles: Float
) -> None:
    """Write start (4,): a seed; for a free DIP also the last pose, and pairs."""
    pair = start - len(initial_angles) - 1
    if start < len(initial_angles):
        _copy(initial_angles[start], angles)
    elif pair < 0:
        _copy(warm_start if _known(warm_start) else initial_angles[0], angles)
    else:
        pip_share, dip_share = FABRIK.starts[pair // 2]
        pip = chain.spans[2, 0] + pip_share * (chain.spans[2, 1] - chain.spans[2, 0])
        dip = chain.spans[3, 0] + dip_share * (chain.spans[3, 1] - chain.spans[3, 0])
        _swing(chain, pip, dip, local, pair % 2, angles)
