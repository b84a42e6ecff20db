"""Least-squares angles inside limits, for finger targets the closed form cannot hit.

Damped least squares (Wampler 1986; Levenberg-Marquardt) on the four angles of one finger, with an active set:
an angle at its limit that the gradient would push outside is left out of the step. Three equations, so the step
is J^T (J J^T + damping I)^-1 r with one 3x3 solve, whatever the number of free angles; with more angles than
equations it is the step of least change, which keeps a redundant finger near its seed.

Where abduction narrows with flexion the region is no box. So the first unknown is not the abduction a but
a / (share of the range that is left at this flexion): its limits are constant, and the region is a box again.
"""

from dataclasses import dataclass
from math import sqrt

from master.ik.chain import Chain
from master.ik.joints import Rotor
from master.ik.vectors import Vector, cross, dot

Four = tuple[float, float, float, float]
_MAX_STEPS = 60
_FIRST_DAMPING_M2 = 1e-7
_LEAST_DAMPING_M2 = 1e-13


@dataclass(frozen=True, slots=True)
class _State:
    """Angles, the unknowns behind them, what is left to the target, and the columns of the Jacobian [m/rad]."""

    angles: Four
    unknowns: Four
    left: Vector
    columns: tuple[Vector, Vector, Vector, Vector]

    @property
    def cost(self) -> float:
        return dot(self.left, self.left)


def bounded_least_squares(chain: Chain, seed: Four, target: Vector, enough_m: float) -> tuple[Four, float]:
    """Improve a finger's angles until the target is hit or no legal step helps.

    Args:
        chain: Rotor (box) and two hinges; its coupling, when it has one, is obeyed.
        seed: Start (abduction, flexion, PIP, DIP) [rad]; clamped to the limits.
        target: In the chain's root frame [m].
        enough_m: Residual that ends the search [m].

    Returns:
        Legal angles and the distance left [m].

    Raises:
        TypeError: The chain is not a finger.
    """
    root = chain.links[0].joint
    if not isinstance(root, Rotor) or root.shape != "box":
        raise TypeError("a finger's first joint is a rotor with a range per angle")
    share, _ = root.narrowing(seed[1])
    state = _evaluate(chain, root, (seed[0] / share if share > 0.0 else 0.0, *seed[1:]), target)
    damping = _FIRST_DAMPING_M2
    for _ in range(_MAX_STEPS):
        if state.cost <= enough_m * enough_m:
            break
        step = _step(chain, state, damping)
        if step is None:
            break
        trial = _evaluate(chain, root, step, target)
        if trial.cost < state.cost:
            stuck = state.cost - trial.cost < 1e-7 * state.cost
            state, damping = trial, max(damping * 0.1, _LEAST_DAMPING_M2)
            if stuck:
                break
        elif damping > 1.0:
            break
        else:
            damping *= 10.0
    return state.angles, sqrt(state.cost)


def _evaluate(chain: Chain, root: Rotor, unknowns: Four, target: Vector) -> _State:
    spread, f, pip, dip = unknowns
    (low, high), (f_low, f_high) = root.abduction_rad, root.flexion_rad
    spread, f = min(max(spread, low), high), min(max(f, f_low), f_high)
    share, slope = root.narrowing(f)
    (a, f), (pip,), (dip,) = chain.clamp(((spread * share, f), (pip,), (dip,)))
    positions, frames = chain.forward(((a, f), (pip,), (dip,)))
    tip = positions[-1]
    turn, sign = chain.links[0].turn, chain.root_sign
    axes = (
        (sign * turn[0][1], sign * turn[1][1], sign * turn[2][1]),
        *((-m[0][0], -m[1][0], -m[2][0]) for m in frames),
    )
    origins = (positions[0], positions[0], positions[1], positions[2])
    columns = [
        cross(axis, (tip[0] - o[0], tip[1] - o[1], tip[2] - o[2]))
        for axis, o in zip(axes, origins, strict=True)
    ]
    if chain.coupling is not None:
        ratio = chain.coupling.ratio if abs(dip - chain.coupling.ratio * pip) < 1e-12 else 0.0
        x, y, z = columns[3]
        columns[2] = (columns[2][0] + ratio * x, columns[2][1] + ratio * y, columns[2][2] + ratio * z)
        columns[3] = (0.0, 0.0, 0.0)
    x, y, z = columns[0]
    narrows = spread * slope
    columns[0] = (share * x, share * y, share * z)
    columns[1] = (columns[1][0] + narrows * x, columns[1][1] + narrows * y, columns[1][2] + narrows * z)
    left = (target[0] - tip[0], target[1] - tip[1], target[2] - tip[2])
    return _State(
        (a, f, pip, dip), (spread, f, pip, dip), left, (columns[0], columns[1], columns[2], columns[3])
    )


def _step(chain: Chain, state: _State, damping: float) -> Four | None:
    """The next unknowns, not yet clamped; None when every legal direction is uphill."""
    free: list[bool] = []
    for q, (low, high), column in zip(state.unknowns, chain.spans, state.columns, strict=True):
        pull = dot(column, state.left)
        free.append(not (low == high or (q <= low and pull <= 0.0) or (q >= high and pull >= 0.0)))
    xx = yy = zz = damping
    xy = xz = yz = 0.0
    for (x, y, z), use in zip(state.columns, free, strict=True):
        if use:
            xx += x * x
            yy += y * y
            zz += z * z
            xy += x * y
            xz += x * z
            yz += y * z
    if not any(free):
        return None
    a, b, c = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    d, e, f = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    determinant = xx * a + xy * b + xz * c
    if not determinant > 0.0:
        return None
    x, y, z = state.left
    weights = (
        (a * x + b * y + c * z) / determinant,
        (b * x + d * y + e * z) / determinant,
        (c * x + e * y + f * z) / determinant,
    )
    new = [
        q + dot(column, weights) if use else q
        for q, column, use in zip(state.unknowns, state.columns, free, strict=True)
    ]
    return new[0], new[1], new[2], new[3]
