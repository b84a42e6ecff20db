"""The parameters of a hand, their limits, and the mean within them.

A parameter vector is the palm's rotation (3, rotation vector about the wrist, rig frame) and translation (3),
then the n angles that no coupling fixes: four of the thumb; abduction, flexion, PIP (and DIP where it does
not follow exactly) of each finger. Where flexion narrows the abduction (`common.hand.profiles`), the
parameter is the abduction before that,

    abduction = share(flexion) parameter

so that a box of parameters is all the legal poses, and the prior of spreading fades in a fist as the range
does. Where limits have a tolerance, what is beyond them costs, and the box ends three standard deviations
farther out.

Of a finger that is poorly known the likeliest pose is often the limit itself: everything beyond is forbidden,
so what lies before it is piled up there. `truncated_mean` is the mean of the normal posterior cut by the box,
by expectation propagation (Minka 2001; for boxes: Cunningham, Hennig, Lacoste-Julien 2011, "Gaussian
probabilities and expectation propagation"): a normal factor for each limit leaves its angle the mean and
variance of the cut distribution. It is for hands that are free of the posture prior only: natural ones rest
at their limits, as flat ones do.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import erfc, exp, inf, pi, sqrt
from typing import NamedTuple

import numpy as np

from common.arrays import Bool, Float, Int
from common.hand.model import CHAINS, FINGER_JOINTS, HandModel
from common.hand.profiles import ABDUCTION, FLEXION, spread_left
from common.kernels import inlined, inner
from common.records import array, filled, record
from master.estimator.settings import KERNEL
from master.fabrik.linear_algebra import cholesky, inverse


@dataclass(frozen=True, slots=True, eq=False)
class HandParameters:
    """Free angles of one hand model."""

    free: Int  # (n,) their indices in the flat (20,) table of angles
    complete: Float  # (20, n) all angles = complete @ free ones, couplings included, abductions not narrowed
    low: Float  # (n,) [rad] low and `high` bounds that keep coupled angles inside their limits, too
    high: Float
    legal_low: Float  # (n,) [rad] the limits themselves, low and `legal_high`
    legal_high: Float
    limit_w2: Float  # (n,) [1/rad^2] inverse variance by which they are exceeded; 0: not at all
    at_low_limit: Bool  # (n,) whether it often stands at its low bound: that of a straight finger
    abduction: Int | slice  # columns of the K fingers whose abduction narrows: a slice (view) if even,
    flexion: Int | slice  # as this
    most: Float  # (K,) [rad] their highest flexion
    left: Float  # (K,) share of the abduction left there
    anywhere: Float  # (6 + n,) inverse variances of turn, shift, angles of a hand known by its limits only

    @classmethod
    def of(cls, model: HandModel) -> "HandParameters":
        """Return the free angles of a hand: 20, or 16 where the DIPs follow exactly."""
        follows = model.dip_spread_rad == 0.0 and model.posture is None
        ratio = model.dip_per_pip if follows else None
        free = np.array([a for a in range(20) if not (ratio is not None and a >= 4 and a % 4 == 3)])
        complete = np.zeros((20, len(free)))
        complete[free, np.arange(len(free))] = 1.0
        low, high = model.limits_rad[..., 0].copy(), model.limits_rad[..., 1].copy()
        if ratio is not None:
            for column in np.flatnonzero((free >= 4) & (free % 4 == 2)):
                complete[free[column] + 1, column] = ratio
            if ratio > 0:
                low[1:, 2] = np.maximum(low[1:, 2], low[1:, 3] / ratio)
                high[1:, 2] = np.minimum(high[1:, 2], high[1:, 3] / ratio)
        low, high, tolerance = low.reshape(20), high.reshape(20), model.tolerance_rad.reshape(20)[free]
        inverse = np.where(tolerance > 0.0, tolerance, np.inf) ** -2.0
        span = np.maximum(high - low, KERNEL.narrowest_rad)[free]
        most = model.limits_rad[:, FLEXION, 1]
        narrows = np.flatnonzero((model.spread_at_full_flexion < 1.0) & (most > 0.0))
        return cls(
            free,
            complete,
            low[free] - KERNEL.tolerances * tolerance,
            high[free] + KERNEL.tolerances * tolerance,
            low[free],
            high[free],
            inverse,
            (free >= 4) & (free % 4 != ABDUCTION),
            _evenly(np.searchsorted(free, 4 * narrows + ABDUCTION)),
            _evenly(np.searchsorted(free, 4 * narrows + FLEXION)),
            most[narrows],
            model.spread_at_full_flexion[narrows],
            np.concatenate([np.repeat(np.array([1.0, KERNEL.anywhere_m]) ** -2.0, 3), 12.0 / (span * span)]),
        )

    def angles(self, x: Float) -> Float:
        """Angles (..., 5, 4) of the free ones (..., n)."""
        if len(self.most):
            x = x.copy()
            x[..., self.abduction] *= self._share(self._flexed(x))
        return (x @ self.complete.T).reshape(*x.shape[:-1], 5, 4)

    def by_parameters(self, J: Float, x: Float) -> Float:
        """Convert derivatives by free angles to those by parameters x (..., n), in place."""
        if len(self.most):
            flexed = self._flexed(x)
            spread_derivative = -2.0 * (1.0 - self.left) * flexed / self.most * x[..., self.abduction]
            spread = J[..., self.abduction]
            J[..., self.flexion] += spread * spread_derivative[..., None, None, :]
            J[..., self.abduction] = spread * self._share(flexed)[..., None, None, :]
        return J

    def free_of(self, values: Float) -> Float:
        """Those of values (5, 4), one per angle, that belong to free angles: (n,)."""
        return values.reshape(20)[self.free]

    def of_angles(self, angles_rad: Float) -> Float:
        """The parameters (n,) of legal angles (5, 4)."""
        x = self.free_of(angles_rad)
        if len(self.most):
            least_share = 1e-6  # an abduction that is narrowed to nothing may come from any
            x[self.abduction] /= np.maximum(self._share(self._flexed(x)), least_share)
        return np.minimum(np.maximum(x, self.low), self.high)

    def _flexed(self, x: Float) -> Float:
        """Flexions of the fingers that narrow, as shares (..., K) of the highest."""
        return np.minimum(np.maximum(x[..., self.flexion], 0.0), self.most) / self.most

    def _share(self, flexed: Float) -> Float:
        return spread_left(flexed, self.left)


def _evenly(columns: Int) -> Int | slice:
    """The same columns (K,) as a slice, if there is one."""
    step = np.diff(columns)
    if len(step) == 0 or step[0] < 1 or (step != step[0]).any():
        return columns
    return slice(int(columns[0]), int(columns[-1]) + 1, int(step[0]))


class HandTables:
    """A hand profile with n free angles, as flat arrays for kernels."""

    swing: Float = array(3, 5, 4, 3, 3)  # as `HandModel.swing`
    tip_rotation: Float = array(5, 3, 3)  # rest rotation of the tip in the frame of the joint before it
    root_m: Float = array(5, 3)  # first joint of each chain, palm frame [m]
    bone_m: Float = array(5, 3, 3)  # bones in the frames of their joints [m]
    abduction_axis: Float = array(5, 3)  # palm frame
    first: Int = array(6, kind="i8")  # finger f has the free angles first[f] ... first[f + 1] - 1
    complete: Float = array(20, 4)  # all angles by the free ones of their finger, abductions not narrowed
    narrows: Bool = array(5, kind="u1")  # whether flexion narrows the finger's abduction
    most: Float = array(5)  # [rad] highest flexion
    left: Float = array(5)  # share of the abduction left there
    low: Float = array("n")  # from here to `anywhere` as of `HandParameters`
    high: Float = array("n")
    legal_low: Float = array("n")
    legal_high: Float = array("n")
    limit_w2: Float = array("n")
    at_low_limit: Bool = array("n", kind="u1")
    anywhere: Float = array("6+n")
    limits: Float = array(5, 4, 2)  # [rad] low and high of all angles, abductions not narrowed
    finger: Int = array(26, kind="i8")  # chain of each joint, -1: fixed to the palm
    level: Int = array(26, kind="i8")  # its place in the chain
    middle: Int = array(26, kind="i8")  # PIP of its finger; thumb, palm, wrist: the joint itself
    rest_m: Float = array(26, 3)  # [m] place, palm frame, and `rest_R` rotation of those fixed to the palm
    rest_R: Float = array(26, 3, 3)
    twist: Float = array(5)  # [rad] roll of the hinges about the first bone, in `swing` (`twist_hand`)
    twist_axis: Float = array(5, 3)  # that bone, in the frame of the abduction
    untwisted: Float = array(3, 5, 3, 3)  # `swing` of the abductions with hinges as the profile has them
    product: Float = array(3, 3)  # scratch

    @classmethod
    def of(cls, model: HandModel, parameters: HandParameters) -> "HandTables":
        """Lay out a hand model."""
        axis = np.zeros((5, 3))
        axis[:, 1] = model.side_sign
        axis[0] = model.side_sign * model.rest_rotation[CHAINS[0, 0]][:, 1]
        finger, level = np.full(26, -1, np.int64), np.zeros(26, np.int64)
        for f, chain in enumerate(CHAINS):
            finger[chain], level[chain] = f, np.arange(4)
        middle: Int = np.arange(26)
        for chain, joints in zip(CHAINS[1:], FINGER_JOINTS[1:], strict=True):
            middle[list(joints)] = chain[1]
        first = np.searchsorted(parameters.free, 4 * np.arange(6)).astype(np.int64)
        complete = np.zeros((20, 4))
        for f in range(5):
            own = parameters.complete[4 * f : 4 * f + 4, first[f] : first[f + 1]]
            complete[4 * f : 4 * f + 4, : own.shape[1]] = own
        most = np.ascontiguousarray(model.limits_rad[:, 1, 1])
        first_bone = np.einsum("fij,fj->fi", model.swing[:2, :, 1].sum(axis=0), model.bone_m[:, 0])
        stiff_rad = 1e-9  # an angle whose highest flexion is 0 narrows nothing
        tolerance = KERNEL.tolerances * model.tolerance_rad
        return filled(
            record(cls, n=len(parameters.free)),
            swing=model.swing,
            tip_rotation=model.link_rotation[:, 2],
            root_m=model.rest_position_m[CHAINS[:, 0]],
            bone_m=model.bone_m,
            abduction_axis=axis,
            first=first,
            complete=complete,
            narrows=(model.spread_at_full_flexion < 1.0) & (most > 0.0),
            most=np.maximum(most, stiff_rad),
            left=model.spread_at_full_flexion,
            low=parameters.low,
            high=parameters.high,
            legal_low=parameters.legal_low,
            legal_high=parameters.legal_high,
            limit_w2=parameters.limit_w2,
            at_low_limit=parameters.at_low_limit,
            anywhere=parameters.anywhere,
            limits=model.limits_rad + np.stack([-tolerance, tolerance], axis=2),
            finger=finger,
            level=level,
            middle=middle,
            rest_m=model.rest_position_m,
            rest_R=model.rest_rotation,
            twist_axis=first_bone / np.linalg.norm(first_bone, axis=1, keepdims=True),
            untwisted=model.swing[:, :, 0],
        )


class Mounts(NamedTuple):
    """Where M markers sit on a hand."""

    finger: Int  # (M,) chain; -1: the palm
    level: Int  # (M,) joint of the chain
    offset_m: Float  # (M, 3) [m] place in that joint's frame
    on_back: Bool  # (M,) whether it is on the palm itself

    @classmethod
    def of(cls, model: HandModel, names: Sequence[str]) -> "Mounts":
        """Lay out the markers of these names.

        Raises:
            CalibrationError: The profile mounts no marker of one of the names.
        """
        finger, level = np.full(len(names), -1, np.int64), np.zeros(len(names), np.int64)
        offset = np.zeros((len(names), 3))
        for m, name in enumerate(names):
            mount = model.mount(name)
            offset[m] = mount.offset_m
            if mount.finger is not None:
                finger[m], level[m] = np.argwhere(mount.joint == CHAINS)[0]
            elif mount.joint is not None:  # wrist and metacarpals do not move against the palm
                R, p = model.rest_rotation[mount.joint], model.rest_position_m[mount.joint]
                offset[m] = p + R @ mount.offset_m
        on_back = np.array([model.mount(name).joint is None for name in names], np.bool_)
        return cls(finger, level, offset, on_back)


class Cut:
    """Scratch for the mean within limits, of N unknowns, of which n are angles."""

    weight: Float = array("n")
    push: Float = array("n")
    pull: Float = array("N")
    total: Float = array("N", "N")
    L: Float = array("N", "N")
    work: Float = array("N", "N")
    cov: Float = array("N", "N")


@inlined
def _below(value: float) -> float:
    """The standard normal distribution function."""
    return 0.5 * erfc(-value / sqrt(2.0))


@inlined
def _cut(middle: float, variance: float, low: float, high: float) -> tuple[float, float]:
    """Mean and variance of a normal distribution cut at low and high."""
    sigma = sqrt(variance)
    a, b = (low - middle) / sigma, (high - middle) / sigma
    flipped = a > 0.0  # mirrored, so that no tail is the difference of two numbers near 1
    if flipped:
        a, b = -b, -a
    a, b = min(max(a, -KERNEL.tail), KERNEL.tail), min(max(b, -KERNEL.tail), KERNEL.tail)
    at_a, at_b = exp(-0.5 * a * a), exp(-0.5 * b * b)
    norm = max(_below(b) - _below(a), 1e-300) * sqrt(2.0 * pi)
    shift = (at_a - at_b) / norm
    left = 1.0 + (a * at_a - b * at_b) / norm - shift * shift
    return middle + sigma * (-shift if flipped else shift), min(max(variance * left, 1e-12), variance)


@inner
def truncated_mean(hand: HandTables, normal: Float, gradient: Float, x: Float, cut: Cut, mean: Float) -> None:
    """Write the step (N,) from the most likely hand to the mean within the limits.

    Straight fingers do rest at their limit, so nothing is piled up there. `normal` (N, N) and `gradient` (N,)
    of the cost at the likeliest hand x (n,); the gradient counts at limits, elsewhere it is 0. The angles
    stay within the limits.
    """
    n, N = x.shape[0], cut.pull.shape[0]
    for i in range(N):
        cut.pull[i] = 0.0
    fixed_rad, fixed_weight = 1e-6, 1e10  # limits that leave no room, and how that is weighed
    for i in range(n):
        below, above = (-inf if hand.at_low_limit[i] else hand.low[i] - x[i]), hand.high[i] - x[i]
        fixed = above - below < fixed_rad
        cut.weight[i], cut.push[i] = fixed_weight if fixed else 0.0, 0.0
        on_limit_rad = 1e-9
        if below > -on_limit_rad or above < on_limit_rad:
            cut.pull[6 + i] = -gradient[6 + i]
    for sweep in range(KERNEL.sweeps + 1):
        for i in range(N):
            for j in range(i + 1):
                cut.total[i, j] = normal[i, j]
            if 6 <= i < 6 + n:
                cut.total[i, i] += cut.weight[i - 6]
        if not cholesky(cut.total, N, cut.L):  # by rounding: nothing is known of where the mean is
            for i in range(N):
                mean[i] = 0.0
            return
        inverse(cut.L, N, cut.work, cut.cov)
        for i in range(N):
            mean[i] = 0.0
            for j in range(N):
                pushed = cut.push[j - 6] if 6 <= j < 6 + n else 0.0
                mean[i] += cut.cov[i, j] * (cut.pull[j] + pushed)
        if sweep == KERNEL.sweeps:
            break
        for i in range(n):
            below, above = (-inf if hand.at_low_limit[i] else hand.low[i] - x[i]), hand.high[i] - x[i]
            if above - below < fixed_rad:
                continue
            variance = cut.cov[6 + i, 6 + i]
            # the distribution of the angle without the factor of its own limits
            cavity_variance = 1.0 / max(1.0 / variance - cut.weight[i], 1e-9)
            middle = cavity_variance * (mean[6 + i] / variance - cut.push[i])
            at, narrow = _cut(middle, cavity_variance, below, above)
            better = max(1.0 / narrow - 1.0 / cavity_variance, 0.0)
            cut.weight[i] += KERNEL.sweep_share * (better - cut.weight[i])
            cut.push[i] += KERNEL.sweep_share * (at / narrow - middle / cavity_variance - cut.push[i])
    for i in range(n):
        below = -inf if hand.at_low_limit[i] else hand.low[i] - x[i]
        mean[6 + i] = min(max(mean[6 + i], below), hand.high[i] - x[i])
