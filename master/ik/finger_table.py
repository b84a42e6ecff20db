"""The usual finger at once: a target that one coupled, legal pose hits, from a table and three arc tangents.

In the root joint's frame the point lies at w(PIP), and |w| gives PIP (`master.ik.reach_table`). What is left is
R_y(a) rest R_x(-f) w = target. With rest = R_y(h) R_z(r) R_x(t), which every rotation is, t is added to the
angle of w in the y, z plane and h is taken from the abduction, and only r stays between the two:

    u = R_x(t - f) w        v = R_z(r) u        R_y(a + h) v = target
    v_y = y of the target,  v_x = w_x / cos r - tan r v_y,  u_y = v_y / cos r - tan r w_x,  u_z = v_z by the length
    f = t + angle of w - angle of u in y, z        a = angle of the target - angle of v in x, z - h

so a table per PIP needs three numbers: PIP, the angle of w, and w_x. The constants of a finger are cells of a
closure: as attributes they would cost a third of the time. The table is packed, because in a running pipeline it is
never in the processor's cache: a list of tuples is five times as large.
"""

from collections.abc import Callable
from math import atan2, copysign, cos, floor, hypot, pi, sin, sqrt, tan
from struct import Struct
from typing import NamedTuple

import numpy as np

from common.arrays import Float
from common.hand_limits import spread_left
from master.ik.chain import Chain
from master.ik.joints import Rotor
from master.ik.reach_table import Branch, ReachCurve
from master.ik.vectors import IDENTITY, Matrix, Vector, product

SLACK_RAD = 1e-6
"""A limit passed by less is the table's rounding: the angle is clamped, which moves the point < 0.2 um."""
_POLE_M = 2e-7
"""Error of the point that an error of w_x may grow to near the abduction's pole, where it grows by |w| / v_z; nearer
to the pole the tables alone are not exact enough."""
_LEAST_POLE = 1e-12
_ROW = Struct("6d")
_HALF_TURN: Matrix = ((-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, -1.0))


class FingerSolution(NamedTuple):
    """Angles of one finger [rad] (thumb: CMC abduction, CMC flexion, MCP, IP) and how well they fit.

    Attributes:
        residual_m: Distance of the point to the target; in the closed form the bound of the table's error.
        reached: Whether legal angles hit the target within 1 um.
    """

    abduction_rad: float
    flexion_rad: float
    pip_rad: float
    dip_rad: float
    residual_m: float
    reached: bool


Quick = Callable[[Vector], FingerSolution | None]
_New = Callable[[type[FingerSolution], tuple[float, ...]], FingerSolution]


def quick_solver(
    chain: Chain,
    root: Vector,
    before: Matrix | None,
    curve: ReachCurve,
    branch: Branch,
) -> Quick:
    """The solver of one finger on one branch: target (palm frame, [m]) -> the pose that hits it, or None.

    Args:
        chain: The finger's links and limits.
        root: Its first joint in the palm frame [m].
        before: Turn in front of the abduction (thumb), else None.
        curve, branch: w(PIP), and the monotone stretch to use.
    """
    joint = chain.links[0].joint
    if not isinstance(joint, Rotor):
        raise TypeError("a finger's first joint is a rotor")
    heading, roll, tip = _euler(joint.rest)
    if cos(heading) < 0.0:  # so that the abduction is within a quarter turn of where the target is
        heading, before = heading - copysign(pi, heading), product(before or IDENTITY, _HALF_TURN)
    nodes, bound_m, pole = _table(curve, branch, roll, tip)
    table, row_at = nodes.tobytes(), _ROW.unpack_from
    root_x, root_y, root_z = root
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = before or IDENTITY
    turned = before is not None
    near2, far2, per_cell = branch.near2, branch.far2, branch.per_cell
    sin_roll, tan_roll, per_cos = sin(roll), tan(roll), 1.0 / cos(roll)
    sign, offset, bound_m = joint.sign, joint.sign * heading, bound_m + SLACK_RAD * sum(chain.lengths)
    (low, high), (f_low, f_high) = joint.abduction_rad, joint.flexion_rad
    share = joint.spread_at_full_flexion
    a_low, a_high = share * low, share * high  # legal at any flexion
    dip_low, dip_high = curve.dip
    ratio, exact, clamp = curve.ratio, curve.exact, joint.clamp
    # a tuple's own constructor takes half the time
    new: _New = tuple.__new__  # pyright: ignore[reportUnknownVariableType]

    def solve(target: Vector) -> FingerSolution | None:
        x, y, z = target
        x -= root_x
        y -= root_y
        z -= root_z
        if turned:
            x, y, z = ax * x + bx * y + cx * z, ay * x + by * y + cy * z, az * x + bz * y + cz * z
        across2 = x * x + z * z
        distance2 = across2 + y * y
        if not near2 < distance2 < far2:
            return None
        u = sqrt(far2 - distance2) * per_cell
        i = floor(u)
        u -= i
        pip, d_pip, turn, d_turn, side, d_side = row_at(table, 48 * i)
        pip += u * d_pip
        turn += u * d_turn
        side += u * d_side
        v_x = side - tan_roll * y
        v_z = across2 - v_x * v_x
        if v_z < pole * distance2:
            pip, (wx, wy, wz) = exact(branch, distance2)
            turn, side = _near(atan2(wz, wy) + tip, turn), wx * per_cos
            v_x = side - tan_roll * y
            v_z = across2 - v_x * v_x
            if v_z <= 0.0:
                return None
        v_z = sqrt(v_z)
        u_y = y * per_cos - sin_roll * side
        if z > 0.0:
            a = sign * (atan2(x, z) - atan2(v_x, v_z)) - offset
            f = turn - atan2(v_z, u_y)
        else:
            a = sign * (atan2(-x, -z) - atan2(-v_x, v_z)) - offset
            f = turn - atan2(-v_z, u_y)
        if not (a_low <= a <= a_high and f_low <= f <= f_high):
            left = spread_left(f / f_high, share) if 0.0 < f <= f_high else 1.0
            if not (left * low <= a <= left * high and f_low <= f <= f_high):
                legal_a, legal_f = clamp((a, f))
                if abs(legal_a - a) > SLACK_RAD or abs(legal_f - f) > SLACK_RAD:
                    return None
                a, f = legal_a, legal_f
        dip = ratio * pip
        if not dip_low <= dip <= dip_high:
            dip = dip_low if dip < dip_low else dip_high
        return new(FingerSolution, (a, f, pip, dip, bound_m, True))

    return solve


def _euler(m: Matrix) -> tuple[float, float, float]:
    """h, r, t of m = R_y(h) R_z(r) R_x(t), of the two ways the one with cos t < 0 for a dorsal y.

    A finger's flexion then turns through the middle of the range of atan2, and its ends are behind the back.
    """
    sin_roll = m[1][0]
    cos_roll = -copysign(hypot(m[1][1], m[1][2]), m[1][1])
    s = copysign(1.0, cos_roll)
    return atan2(-s * m[2][0], s * m[0][0]), atan2(sin_roll, cos_roll), atan2(-s * m[1][2], s * m[1][1])


def _table(curve: ReachCurve, branch: Branch, roll: float, tip: float) -> tuple[Float, float, float]:
    """What is tabulated, how exact it is, and where it is not.

    Returns:
        Value and step (cells + 1, 6) of PIP [rad], angle of w [rad] and w_x / cos r [m]; the largest error of the
        point [m]; the squared share of v_z in |w| below which it may be larger.
    """
    rows = np.array(branch.rows)
    pip = np.clip(np.append(rows[:, 0], rows[-1, 0] + rows[-1, 1]), *curve.pip)
    _, y0, z0 = curve.point(pip[:1])[0]
    first = _near(atan2(z0, y0) + tip, 0.0)

    def values(pip: Float) -> Float:
        x, y, z = curve.point(pip).T
        angle = first + np.arctan2(
            y0 * z - z0 * y, y0 * y + z0 * z
        )  # a curling finger turns by less than half a turn
        return np.column_stack([pip, angle, x / cos(roll)])

    nodes = values(pip)
    steps = np.diff(nodes, axis=0, append=nodes[-1:])  # at the end of the branch there is no next
    middle = (nodes + 0.5 * steps)[:-1]
    exact = values(middle[:, 0])
    s = (np.arange(len(middle)) + 0.5) / branch.per_cell if branch.per_cell > 0.0 else np.zeros(1)
    length = np.sqrt(branch.far2 - s * s)
    along = np.abs(np.sqrt(curve.distance2(middle[:, 0])) - length)
    _, turn, side = np.abs(middle - exact).T
    pole = max((float(side.max()) / _POLE_M) ** 2, _LEAST_POLE)
    error = float((along + length * turn).max() + _POLE_M)
    return np.stack([nodes, steps], axis=2).reshape(len(nodes), 6), error, pole


def _near(angle: float, other: float) -> float:
    """The angle a whole number of turns away that is nearest to the other."""
    return angle - 2.0 * pi * round((angle - other) / (2.0 * pi))
