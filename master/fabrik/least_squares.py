"""The legal pose of a finger whose end is nearest to a target.

Damped least squares (Wampler 1986; Levenberg-Marquardt) on the four angles, with an active set: an angle at its limit
that the gradient would push outside is left out of the step. Three equations, so the step is
J^T (J J^T + damping I)^-1 r with one 3x3 solve; with more angles than equations it is the step of least change, which
keeps a redundant finger near its seed.

Where abduction narrows with flexion the region is no box. So the first unknown is not the abduction a but
a / (share of the range that is left at this flexion): its limits are constant, and the region is a box again.
"""

import numpy as np

from common.arrays import Float
from common.kernels import inner, kernel
from master.fabrik.chain_arrays import (
    ROOT,
    ROTATION,
    START,
    ChainArrays,
    clamp_angles,
    forward,
    limits_of,
    put_vector,
    vector_at,
)
from master.fabrik.limits import narrowing
from master.fabrik.rotations import Vector, cross, dot, length, minus


@kernel
def least_squares(
    chain: ChainArrays, goal: Vector, tolerance_m: float, max_steps: int, angles: Float
) -> float:
    """Improve a finger's angles until the target is hit or no legal step helps.

    Args:
        chain: A rotor (box) and two flexion hinges; its coupling, when it has one, is obeyed.
        goal: Target [m], root frame, finite.
        tolerance_m: Residual that ends the search [m].
        max_steps: Of the search, taken or refused.
        angles: (4,) [rad]; in: start, clamped to the limits; out: legal.

    Returns:
        Distance left [m].
    """
    share, _ = narrowing(limits_of(chain, ROOT), angles[1])
    unknowns, trial = angles.copy(), np.empty(4)
    unknowns[0] = angles[0] / share if share > 0.0 else 0.0
    columns, trial_columns = np.empty((4, 3)), np.empty((4, 3))
    next_angles = np.empty(4)
    left = _evaluate(chain, goal, unknowns, angles, columns)
    first_damping_m2 = 1e-7
    cost, damping = dot(left, left), first_damping_m2
    for _ in range(max_steps):
        if cost <= tolerance_m * tolerance_m or not _step(chain, unknowns, left, columns, damping, trial):
            break
        trial_left = _evaluate(chain, goal, trial, next_angles, trial_columns)
        trial_cost = dot(trial_left, trial_left)
        least_damping_m2, most_damping_m2 = 1e-13, 1.0
        if trial_cost < cost:
            gain = cost - trial_cost
            left, cost, damping = trial_left, trial_cost, max(damping * 0.1, least_damping_m2)
            for i in range(4):
                unknowns[i], angles[i] = trial[i], next_angles[i]
                put_vector(columns, i, vector_at(trial_columns, i, START))
            least_gain = 1e-7
            if gain < least_gain * (cost + gain):
                break
        elif damping > most_damping_m2:
            break
        else:
            damping *= 10.0
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
    x, y, z = (
        chain.links[ROOT, ROTATION + 1],
        chain.links[ROOT, ROTATION + 4],
        chain.links[ROOT, ROTATION + 7],
    )
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
    weights = (
        dot((a, b, c), left) / determinant,
        dot((b, d, e), left) / determinant,
        dot((c, e, f), left) / determinant,
    )
    for i in range(4):
        moved = (
            dot(vector_at(columns, i, START), weights) if _free(chain, unknowns, left, columns, i) else 0.0
        )
        new[i] = unknowns[i] + moved
    return True


@inner
def _free(chain: ChainArrays, unknowns: Float, left: Vector, columns: Float, i: int) -> bool:
    """Whether unknown i has room, and is not pushed out at its limit."""
    low, high = chain.spans[i, 0], chain.spans[i, 1]
    pull = dot(vector_at(columns, i, START), left)
    return not (low == high or (unknowns[i] <= low and pull <= 0.0) or (unknowns[i] >= high and pull >= 0.0))
