"""The fit minimises the residuals of one epoch under each hypothesis.

Unknowns are the palm's turn and shift and the free angles (`master.estimator.kinematics`). What is minimised
is half the sum of squares of the rows (`master.estimator.problem`) and of the priors:

    posture   of one hypothesis (`master.estimator.priors`)
    own       single angles, of fingers that are curled out of sight
    past      single angles and the palm, from the state before; and its depth, where one camera sees all there is
    facing    the back of the hand looks towards the cameras that see a marker on it
    extras    what other sensors leave open: hinges, the wrist's bend, tilt and heading, the unit of light
    place     of a palm that stands still before a wrist device
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from common.arrays import Float
from common.kernels import inlined, inner
from common.records import boxed, record
from master.estimator.kinematics import (
    PLACE,
    angles_of,
    chains,
    finger_jacobian,
    marker_point,
    palm_jacobian,
    rotate_by,
    twist_hand,
)
from master.estimator.parameters import Cut, HandTables
from master.estimator.priors import PosturePrior
from master.estimator.problem import (
    EpochPrior,
    Observations,
    Rig,
    Search,
    finger_rows,
    marker_rows,
    orientation_row,
)
from master.estimator.sensors import EXTRAS, WRIST_ANGLES, flexed_palm
from master.fabrik.linear_algebra import cholesky, copy, substitute

MAX_ITERATIONS = 25


@inlined
def palm_off(T: Float, palm: Float, out: Float) -> None:
    """Write turn, as sine times axis, and shift from a palm (4, 4) to T: (6,)."""
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        skew_sum = 0.0
        for c in range(3):
            skew_sum += T[k, c] * palm[j, c] - T[j, c] * palm[k, c]
        out[i] = 0.5 * skew_sum
        out[3 + i] = T[i, 3] - palm[i, 3]


@inlined
def past_cost(epoch_prior: EpochPrior, T: Float, x: Float, off: Float) -> float:
    """What the state before costs at a hand; `off`: (6,) scratch."""
    palm_off(T, epoch_prior.palm, off)
    cost, depth = 0.0, 0.0
    for i in range(6):
        cost += 0.5 * epoch_prior.palm_w2[i] * off[i] * off[i]
    for i in range(3):
        depth += epoch_prior.line_of_sight[i] * off[3 + i]
    cost += 0.5 * epoch_prior.depth_w2[0] * depth * depth
    for i in range(x.shape[0]):
        cost += 0.5 * epoch_prior.past_w2[i] * (x[i] - epoch_prior.past[i]) ** 2
    return cost


@inlined
def own_cost(posture_prior: PosturePrior, epoch_prior: EpochPrior, h: int, x: Float) -> float:
    """Return the cost of hypothesis h's posture prior and of own angle priors."""
    cost = posture_prior.constant[h]
    for i in range(x.shape[0]):
        total = 0.0
        for j in range(x.shape[0]):
            total += posture_prior.normal[h, i, j] * x[j]
        cost += (0.5 * total - posture_prior.pull[h, i]) * x[i]
        cost += 0.5 * epoch_prior.own_w2[i] * (x[i] - epoch_prior.own[i]) ** 2
    return cost


@inlined
def _add_priors(
    posture_prior: PosturePrior,
    epoch_prior: EpochPrior,
    h: int,
    T: Float,
    x: Float,
    z: Float,
    gradient: Float,
    normal: Float,
    search: Search,
) -> float:
    """Write gradient and normal matrix of all priors; return their cost."""
    n, K = x.shape[0], z.shape[0]
    for i in range(6 + n + K):
        gradient[i] = 0.0
        for j in range(6 + n + K):
            normal[i, j] = 0.0
    cost = past_cost(epoch_prior, T, x, search.off) + own_cost(posture_prior, epoch_prior, h, x)
    depth = 0.0
    for i in range(3):
        depth += epoch_prior.line_of_sight[i] * search.off[3 + i]
    for i in range(6):
        gradient[i] = epoch_prior.palm_w2[i] * search.off[i]
        normal[i, i] = epoch_prior.palm_w2[i]
    for i in range(3):
        gradient[3 + i] += epoch_prior.depth_w2[0] * depth * epoch_prior.line_of_sight[i]
        for j in range(3):
            normal[3 + i, 3 + j] += (
                epoch_prior.depth_w2[0] * epoch_prior.line_of_sight[i] * epoch_prior.line_of_sight[j]
            )
    for i in range(n):
        total = 0.0
        for j in range(n):
            normal[6 + i, 6 + j] = posture_prior.normal[h, i, j]
            total += posture_prior.normal[h, i, j] * x[j]
        gradient[6 + i] = (
            total - posture_prior.pull[h, i] + epoch_prior.own_w2[i] * (x[i] - epoch_prior.own[i])
        )
        gradient[6 + i] += epoch_prior.past_w2[i] * (x[i] - epoch_prior.past[i])
        normal[6 + i, 6 + i] += epoch_prior.own_w2[i] + epoch_prior.past_w2[i]
    for i in range(K):
        total = 0.0
        for j in range(K):
            normal[6 + n + i, 6 + n + j] = epoch_prior.z_info[i, j]
            total += epoch_prior.z_info[i, j] * (z[j] - epoch_prior.z[j])
        gradient[6 + n + i] = total
        cost += 0.5 * total * (z[i] - epoch_prior.z[i])
    if epoch_prior.place_w2[0] > 0.0:
        for i in range(3):
            off = T[i, 3] - epoch_prior.place[i]
            cost += 0.5 * epoch_prior.place_w2[0] * off * off
            gradient[3 + i] += epoch_prior.place_w2[0] * off
            normal[3 + i, 3 + i] += epoch_prior.place_w2[0]
    return cost


@inlined
def _beyond(hand: HandTables, x: Float, gradient: Float, normal: Float) -> float:
    """Add what angles beyond their limits cost; return it."""
    cost = 0.0
    for i in range(x.shape[0]):
        off = max(x[i] - hand.legal_high[i], 0.0) + min(x[i] - hand.legal_low[i], 0.0)
        if off != 0.0:
            cost += 0.5 * hand.beyond_w2[i] * off * off
            gradient[6 + i] += hand.beyond_w2[i] * off
            normal[6 + i, 6 + i] += hand.beyond_w2[i]
    return cost


@inlined
def _faced(epoch_prior: EpochPrior, T: Float, gradient: Float, normal: Float) -> float:
    """Add that the back (the palm's +y) looks along `back_normal`; return its cost."""
    w2 = epoch_prior.back_normal_w2[0]
    cost = 0.0
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        off = T[i, 1] - epoch_prior.back_normal[i]
        cost += 0.5 * w2 * off * off
        off_j, off_k = T[j, 1] - epoch_prior.back_normal[j], T[k, 1] - epoch_prior.back_normal[k]
        gradient[i] += w2 * (T[j, 1] * off_k - T[k, 1] * off_j)
        normal[i, i] += w2 * (T[j, 1] * T[j, 1] + T[k, 1] * T[k, 1])
        normal[i, j] -= w2 * T[i, 1] * T[j, 1]
        normal[j, i] -= w2 * T[i, 1] * T[j, 1]
    return cost


@inner
def linearise(
    rig: Rig,
    posture_prior: PosturePrior,
    epoch_prior: EpochPrior,
    observed: Observations,
    h: int,
    T: Float,
    x: Float,
    z: Float,
    gradient: Float,
    normal: Float,
    search: Search,
) -> float:
    """Write gradient (N,) and normal matrix (N, N) at a hand; return the cost.

    Gauss-Newton, under hypothesis h. To search.marker_chi2 (M,) chi square of each marker, to search.outliers
    (1,) half of what non-meeting rays have between them, to search.information (M, 3, 3) what is known of
    each marker's place.
    """
    work = search.rows
    cost = _add_priors(posture_prior, epoch_prior, h, T, x, z, gradient, normal, search)
    cost += _beyond(rig.hand, x, gradient, normal)
    if epoch_prior.back_normal_w2[0] > 0.0:
        cost += _faced(epoch_prior, T, gradient, normal)
    if epoch_prior.oriented[0] > 0.0:
        cost += orientation_row(epoch_prior, T, z, x.shape[0], gradient, normal, search)
    hand, mounts = rig.hand, rig.mounts
    angles_of(hand, x, work.angles, work.by)
    if z.shape[0] == EXTRAS:
        for f in range(5):
            search.twist[f] = z[f]
        twist_hand(hand, search.twist)
        if epoch_prior.lines_of_sight.rows[0] > 0.0:
            flexed_palm(
                rig.device.palm, z[WRIST_ANGLES], z[WRIST_ANGLES + 1], search.palm_camera, search.wrist_axes
            )
            for f in range(5):
                cost += finger_rows(rig, epoch_prior, f, z, x.shape[0], gradient, normal, search)
    chains(hand, T, work.angles, work.R, work.P)
    search.outliers[0] = 0.0
    for m in range(mounts.finger.shape[0]):
        search.marker_chi2[m] = 0.0
        if not observed.seen[m]:
            continue
        cost += _marker(rig, observed, m, T, gradient, normal, search)
    return cost


@inlined
def _marker(
    rig: Rig, observed: Observations, m: int, T: Float, gradient: Float, normal: Float, search: Search
) -> float:
    """Add the rows of one marker; return their cost."""
    work, hand, mounts = search.rows, rig.hand, rig.mounts
    f = mounts.finger[m]
    marker_point(mounts, m, T, work.R, work.P, work.point)
    cost, search.marker_chi2[m] = marker_rows(rig.cameras, observed, m, work.point, work)
    search.outliers[0] += cost - 0.5 * search.marker_chi2[m]
    for i in range(3):
        work.arm[i] = work.point[i] - T[i, 3]
        for j in range(3):
            search.information[m, i, j] = work.H[i, j]
    size, start, D = 6, 0, work.by_place
    palm_jacobian(work.arm, D)
    if f >= 0:
        start = hand.first[f]
        size += hand.first[f + 1] - start
        finger_jacobian(hand, work.by, T, work.R, work.P, f, mounts.level[m], work.point, PLACE, D)
    for a in range(size):
        ia = a if a < 6 else start + a
        gradient[ia] += D[a, 0] * work.g[0] + D[a, 1] * work.g[1] + D[a, 2] * work.g[2]
        for k in range(3):
            work.rows[a, k] = D[a, 0] * work.H[0, k] + D[a, 1] * work.H[1, k] + D[a, 2] * work.H[2, k]
        for b in range(a + 1):
            total = work.rows[a, 0] * D[b, 0] + work.rows[a, 1] * D[b, 1] + work.rows[a, 2] * D[b, 2]
            ib = b if b < 6 else start + b
            normal[ia, ib] += total
            if a != b:
                normal[ib, ia] += total
    return cost


@inner
def _step(rig: Rig, x: Float, damping: float, gradient: Float, normal: Float, search: Search) -> float:
    """Write the damped step (N,); return the cost's expected fall; < 0: no step.

    Angles that stand at a limit and are pushed outwards are omitted.
    """
    n, N, hand = x.shape[0], search.step.shape[0], rig.hand
    down, damped, step, held = search.down, search.damped, search.step, search.held
    for i in range(N):
        down[i], held[i] = -gradient[i], False
        if 6 <= i < 6 + n:
            c = i - 6
            held[i] = x[c] <= hand.low[c] if down[i] < 0.0 else x[c] >= hand.high[c]
        if held[i]:
            down[i] = 0.0
        for j in range(i):
            damped[i, j] = 0.0 if held[i] or held[j] else normal[i, j]
        damped[i, i] = 1.0 if held[i] else normal[i, i] * (1.0 + damping)
        step[i] = down[i]
    if not cholesky(damped, N, search.L):
        return -1.0
    substitute(search.L, N, step)
    hoped = 0.0
    for i in range(N):
        hoped += 0.5 * down[i] * step[i]
    return hoped


@inner
def descend(
    rig: Rig,
    posture_prior: PosturePrior,
    epoch_prior: EpochPrior,
    observed: Observations,
    h: int,
    tolerance: float,
    share: float,
    T: Float,
    x: Float,
    z: Float,
    gradient: Float,
    normal: Float,
    search: Search,
) -> tuple[float, int]:
    """Search downhill by Levenberg-Marquardt, in place; return cost and steps.

    The damping follows the gain ratio (Madsen, Nielsen, Tingleff, "Methods for Non-Linear Least Squares
    Problems", 2nd edition, 2004, eq. 2.21). A search ends where a step gains less than `tolerance` and that
    `share` of the cost. The last step, of which an all but undamped model hopes for no more than the
    tolerance, is taken without another linearisation. `gradient`, `normal` are those at the end, or before
    the last step.
    """
    n, K, hand = x.shape[0], z.shape[0], rig.hand
    cost = linearise(rig, posture_prior, epoch_prior, observed, h, T, x, z, gradient, normal, search)
    first_damping, most_damping = 1e-3, 1e6
    damping, growth, iterations = first_damping, 2.0, 0
    while iterations < MAX_ITERATIONS and damping <= most_damping:
        iterations += 1
        hoped = _step(rig, x, damping, gradient, normal, search)
        least_gain = tolerance + share * cost
        if hoped < 0.0:
            damping, growth = damping * growth, 2.0 * growth
            continue
        rotate_by(search.step, T, search.next_palm)
        for i in range(n):
            search.x[i] = min(max(x[i] + search.step[6 + i], hand.low[i]), hand.high[i])
        for i in range(K):
            search.z[i] = z[i] + search.step[6 + n + i]
        for i in range(5 if K == EXTRAS else 0):
            rolled_rad = 0.25  # no hinges are askew by more
            search.z[i] = min(max(search.z[i], -rolled_rad), rolled_rad)
        if damping <= first_damping and hoped < least_gain:
            copy(search.next_palm, T)
            for i in range(n):
                x[i] = search.x[i]
            for i in range(K):
                z[i] = search.z[i]
            break
        there = linearise(
            rig,
            posture_prior,
            epoch_prior,
            observed,
            h,
            search.next_palm,
            search.x,
            search.z,
            search.gradient,
            search.normal,
            search,
        )
        gain = cost - there
        if not gain > 0.0:
            damping, growth = damping * growth, 2.0 * growth
            continue
        damping = max(damping * max(1.0 / 3.0, 1.0 - (2.0 * gain / hoped - 1.0) ** 3), 1e-9)
        growth, cost = 2.0, there
        copy(search.next_palm, T)
        copy(search.normal, normal)
        for i in range(n):
            x[i] = search.x[i]
        for i in range(K):
            z[i] = search.z[i]
        for i in range(6 + n + K):
            gradient[i] = search.gradient[i]
        if gain < least_gain:
            break
    return cost, iterations


class Posterior:
    """A hand by one epoch."""

    palm: Float  # (4, 4)
    x: Float  # (n,) free angles
    z: Float  # (K,) extras
    cov: Float  # (N, N) turn [rad], shift [m], rig axes, free angles [rad], extras, by this epoch alone
    marker_chi2: Float  # (M,)
    steps: Float  # (1,) of the search
    natural_weight: Float  # (1,) probability that the hand follows the posture prior
    scale: Float  # (1,) by how much the residual has scaled the covariance
    contrary: Float  # (1,) chi square of the palm against other sensors, and of what the extras gave in

    @classmethod
    def empty(cls, n: int, extras: int, markers: int) -> "Posterior":
        """Scratch for one."""
        N = 6 + n + extras
        return record(
            cls,
            **dict.fromkeys(("steps", "natural_weight", "scale", "contrary"), 1),
            palm=(4, 4),
            x=n,
            z=extras,
            cov=(N, N),
            marker_chi2=markers,
        )


class Blank(NamedTuple):
    """Empty prior, in boxes, used by `_onto` for a fit to points alone."""

    posture_prior: PosturePrior
    epoch_prior: Any
    between: Observations

    @classmethod
    def of(cls, n: int, extras: int, cameras: int, markers: int) -> "Blank":
        """For a hand with n free angles."""
        nothing = PosturePrior(np.zeros((1, n, n)), np.zeros((1, n)), np.zeros(1), np.zeros(1))
        return cls(nothing, boxed(EpochPrior.none(n, extras)), Observations.empty(cameras, markers))


class Hypothesis:
    """A hand of N = 6 + n + K unknowns and M markers under one hypothesis."""

    palm: Float  # (4, 4) where its search ended
    x: Float  # (n,)
    z: Float  # (K,)
    gradient: Float  # (N,) there
    normal: Float  # (N, N)
    marker_chi2: Float  # (M,)
    information: Float  # (M, 3, 3) of the place of each marker
    cost: Float  # (1,) half the sum of squares
    outliers: Float  # (1,) half of what rays that do not meet have between them
    share: Float  # (1,) its probability
    step: Float  # (N,) from there to the mean within the limits
    off: Float  # (N,) the same from the likelier hand

    @classmethod
    def empty(cls, n: int, extras: int, markers: int) -> "Hypothesis":
        """Scratch for one."""
        N = 6 + n + extras
        return record(
            cls,
            **dict.fromkeys(("gradient", "step", "off"), N),
            **dict.fromkeys(("cost", "outliers", "share"), 1),
            palm=(4, 4),
            x=n,
            z=extras,
            normal=(N, N),
            marker_chi2=markers,
            information=(markers, 3, 3),
        )


class Scratch:
    """Scratch for both hypotheses of N = 6 + n + K unknowns and M markers."""

    each: Sequence[Hypothesis]  # (2,) natural and free
    start_T: Float  # (4, 4)
    start_x: Float  # (n,)
    start_z: Float  # (K,)
    middle: Float  # (N,)
    A: Float  # (N, N)
    L: Float  # (N, N)
    work: Float  # (N, N)
    cov: Float  # (N, N)
    here: Float  # (M, 3)
    there: Float  # (M, 3)
    cut: Cut
    search: Search

    @classmethod
    def empty(cls, n: int, extras: int, markers: int) -> "Scratch":
        """Allocate it."""
        N, M = 6 + n + extras, markers
        return record(
            cls,
            **dict.fromkeys(("A", "L", "work", "cov"), (N, N)),
            each=(Hypothesis.empty(n, extras, markers), 2),
            start_T=(4, 4),
            start_x=n,
            start_z=extras,
            middle=N,
            here=(M, 3),
            there=(M, 3),
            cut=Cut.empty(n, N),
            search=Search.empty(n, extras, markers),
        )


@inlined
def likelier(scratch: Scratch) -> int:
    """The hypothesis with the larger probability."""
    return 0 if scratch.each[0].share[0] >= scratch.each[1].share[0] else 1
