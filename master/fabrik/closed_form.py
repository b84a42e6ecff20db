"""Finger angles from one point on the finger, in closed form.

A point leaves one angle free; with DIP = ratio * PIP the finger is exactly determined. In the root joint's frame the
point lies at w(PIP), which neither flexion nor abduction can stretch:

    |target - root| = |w(PIP)|       monotone but for a few degrees round the straight finger -> PIP
    R_y(a) rest R_x(-f) w = target   y gives the flexion, x and z the abduction: two atan2

This holds for bones out of plane too. The range of the PIP is cut where |w| turns, and where the DIP meets its own
limit, into branches on which |w| is monotone; each is inverted by Newton's method inside a bracket.

Where no such pose is legal, least squares go on from the nearest of them inside the limits. There a free DIP finds
its own angle, and a target out of reach the nearest pose.

Kernels of a finger's chain: a rotor (box) and two flexion hinges, coupled or not. Angles are (4,): abduction, flexion,
PIP, DIP (thumb: CMC abduction, CMC flexion, MCP, IP) [rad].
"""

from math import cos, inf, isfinite, pi, sin, sqrt

import numpy as np

from common.arrays import Float
from common.kernels import constant, inner, kernel
from master.fabrik.chain_arrays import (
    BONE,
    REST,
    ROOT,
    ROTATION,
    SIGN,
    ChainArrays,
    clamp_angles,
    end_of,
    matrix_at,
    vector_at,
)
from master.fabrik.least_squares import least_squares
from master.fabrik.limits import hinge_fit, swing_and_flex
from master.fabrik.rotations import Vector, dot, length, minus, plus, rotate, rotate_back

REACHED_M = 1e-6
_TOLERANCE_M = 0.05 * REACHED_M
"""A limit passed by less is rounding: the angle is clamped, which moves the point < 0.2 um."""
_FIRST = constant(0)
PIP, DIP = constant(1), constant(2)  # links
"""Rounding of a squared distance at the end of a branch."""
_PER_BRANCH = 2.0 * pi
"""How much rather the more bent branch is taken: more than any abduction, by which the poses of one are ranked."""
_SPREAD_OF_STARTS = ((0.1, 0.9), (0.9, 0.1), (0.5, 0.0), (0.5, 1.0), (0.0, 0.5), (1.0, 0.5))
"""PIP and DIP, as shares of their ranges, from which a free pair is sought when the coupled one fails."""
_STARTS = 4 + 2 * len(_SPREAD_OF_STARTS)
_FIRST_STEPS, _MOST_STEPS = constant(8), constant(60)
"""Of least squares: from each start, and from the best of their ends."""


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
    """The legal pose that hits the target.

    Args:
        chain: Of the finger.
        edges: (B + 1,) ends of the branches of the PIP, rising [rad].
        ratio: DIP per PIP.
        goal: Target [m], root frame, finite.
        near: (4,) angles of a moment ago [rad]: where several legal poses hit the target (straight finger, pole of
            the abduction) the nearest is taken; NaN: the more bent one, then the less abducted.
        angles: (4,) [rad]; out, where there is such a pose.
        seeds: (3, 4) [rad]; out, legal poses from which to search on where there is none.

    Returns:
        Distance of the point to the target [m]; infinite: no such pose is legal.
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
                if miss < REACHED_M and rank < best:
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
    end, rotating, link_rotation = (
        _flexed(pip, end),
        _flexed(pip, rotating),
        matrix_at(chain.links, PIP, ROTATION),
    )
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

    It starts with PIP linear in sqrt(|w|_far^2 - |w|^2), which it nearly is, also at the straight finger.
    """
    d_low, d_high = distance2_of(chain, ratio, low)[0], distance2_of(chain, ratio, high)[0]
    far, bent = (low, high) if d_low >= d_high else (high, low)
    far2, near2 = max(d_low, d_high), min(d_low, d_high)
    off = max(distance2 - far2, near2 - distance2)
    if off >= 0.0:
        return far if distance2 >= far2 else bent, off
    pip = far + sqrt((far2 - distance2) / (far2 - near2)) * (bent - far)
    root_steps = 60
    for _ in range(root_steps):
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
    """Whether all of a finger's angles (4,) are known."""
    return isfinite(angles[0] + angles[1] + angles[2] + angles[3])


@inner
def _rank(angles: Float, warm_start: Float, branch: int) -> float:
    """Rank of a pose that hits, least first: change [rad], or branch and abduction."""
    if not _known(warm_start):
        return branch * _PER_BRANCH + abs(angles[0])
    rank = 0.0
    for i in range(4):
        rank += abs(angles[i] - warm_start[i])
    return rank


@inner
def _copy(source: Float, out: Float) -> None:
    """Write angles (4,)."""
    for i in range(4):
        out[i] = source[i]


@inner
def _copy_row(rows: Float, row: int, out: Float) -> None:
    """Write angles (4,) from a row of (S, 4)."""
    for i in range(4):
        out[i] = rows[row, i]


@inner
def _keep(initial_angles: Float, penalties: Float, angles: Float, penalty: float) -> None:
    """Keep a pose among the two (rows 1 and 2) that are least beyond what is legal."""
    row = 1
    if penalty < penalties[0]:
        penalties[1] = penalties[0]
        for i in range(4):
            initial_angles[2, i] = initial_angles[1, i]
    elif penalty < penalties[1]:
        row = 2
    else:
        return
    penalties[row - 1] = penalty
    for i in range(4):
        initial_angles[row, i] = angles[i]


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
    initial_angles[0, 0], initial_angles[0, 1], initial_angles[0, 2], initial_angles[0, 3] = (
        a,
        f,
        pip,
        ratio * pip,
    )


@kernel
def nearest_pose(
    chain: ChainArrays, goal: Vector, warm_start: Float, initial_angles: Float, angles: Float
) -> float:
    """The legal pose nearest to the target, where none hits it in closed form.

    Args:
        chain, goal, near: As of `closed_form`.
        seeds: (3, 4) [rad], of `closed_form`.
        angles: (4,) [rad], out.

    Returns:
        Distance of the point to the target [m].
    """
    best, trial = inf, np.empty(4)
    local = rotate_back(matrix_at(chain.links, ROOT, ROTATION), goal)
    starts = len(initial_angles) if chain.follower >= 0 else _STARTS
    for start in range(starts + 1):
        steps = _FIRST_STEPS
        if start < starts:
            _start(chain, local, warm_start, initial_angles, start, trial)
        else:
            steps = _MOST_STEPS
            _copy(angles, trial)
        left = least_squares(chain, goal, _TOLERANCE_M, steps, trial)
        if start == 0 or left < best:
            best = left
            _copy(trial, angles)
        if best < REACHED_M:
            break
    return best


@inner
def _start(
    chain: ChainArrays, local: Vector, warm_start: Float, initial_angles: Float, start: int, angles: Float
) -> None:
    """Write start (4,): a seed; for a free DIP also the last pose, and pairs."""
    pair = start - len(initial_angles) - 1
    if start < len(initial_angles):
        _copy_row(initial_angles, start, angles)
    elif pair < 0:
        _copy_row(initial_angles, _FIRST, angles)
        if _known(warm_start):
            _copy(warm_start, angles)
    else:
        pip_share, dip_share = _SPREAD_OF_STARTS[pair // 2]
        pip = chain.spans[2, 0] + pip_share * (chain.spans[2, 1] - chain.spans[2, 0])
        dip = chain.spans[3, 0] + dip_share * (chain.spans[3, 1] - chain.spans[3, 0])
        _swing(chain, pip, dip, local, pair % 2, angles)
