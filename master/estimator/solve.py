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
from common.records import array, boxed, part, record
from master.estimator.kinematics import (
    angles_of,
    chains,
    marker_jacobian,
    rotate_by,
    twist_hand,
)
from master.estimator.parameters import Cut, HandTables
from master.estimator.priors import PosturePrior
from master.estimator.problem import (
    EpochPrior,
    Iterate,
    Observations,
    Problem,
    Search,
    finger_rows,
    marker_rows,
    orientation_row,
)
from master.estimator.sensors import EXTRAS, WRIST_ANGLES, flexed_palm
from master.estimator.settings import KERNEL
from master.fabrik.linear_algebra import cholesky, copy, substitute


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
    """What the state before costs at a hand; writes `off` (6,), as of `palm_off`."""
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
def past_gradient(epoch_prior: EpochPrior, off: Float, gradient: Float) -> None:
    """Write the gradient (6,) of the palm's past; `off` as `past_cost` left it."""
    depth = 0.0
    for i in range(3):
        depth += epoch_prior.line_of_sight[i] * off[3 + i]
    for i in range(6):
        gradient[i] = epoch_prior.palm_w2[i] * off[i]
        if i >= 3:
            gradient[i] += epoch_prior.depth_w2[0] * depth * epoch_prior.line_of_sight[i - 3]


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
def _add_priors(problem: Problem, h: int, at: Iterate, search: Search) -> float:
    """Write gradient and normal matrix of all priors; return their cost."""
    prior, posture, x, z = problem.epoch_prior, problem.posture_prior, at.x, at.z
    gradient, normal, n, K = at.gradient, at.normal, at.x.shape[0], at.z.shape[0]
    for i in range(6 + n + K):
        gradient[i] = 0.0
        for j in range(6 + n + K):
            normal[i, j] = 0.0
    cost = past_cost(prior, at.palm, x, search.off) + own_cost(posture, prior, h, x)
    past_gradient(prior, search.off, gradient)
    for i in range(6):
        normal[i, i] = prior.palm_w2[i]
    for i in range(3):
        for j in range(3):
            normal[3 + i, 3 + j] += prior.depth_w2[0] * prior.line_of_sight[i] * prior.line_of_sight[j]
    for i in range(n):
        total = 0.0
        for j in range(n):
            normal[6 + i, 6 + j] = posture.normal[h, i, j]
            total += posture.normal[h, i, j] * x[j]
        gradient[6 + i] = total - posture.pull[h, i] + prior.own_w2[i] * (x[i] - prior.own[i])
        gradient[6 + i] += prior.past_w2[i] * (x[i] - prior.past[i])
        normal[6 + i, 6 + i] += prior.own_w2[i] + prior.past_w2[i]
    for i in range(K):
        total = 0.0
        for j in range(K):
            normal[6 + n + i, 6 + n + j] = prior.z_info[i, j]
            total += prior.z_info[i, j] * (z[j] - prior.z[j])
        gradient[6 + n + i] = total
        cost += 0.5 * total * (z[i] - prior.z[i])
    if prior.place_w2[0] > 0.0:
        for i in range(3):
            off = at.palm[i, 3] - prior.place[i]
            cost += 0.5 * prior.place_w2[0] * off * off
            gradient[3 + i] += prior.place_w2[0] * off
            normal[3 + i, 3 + i] += prior.place_w2[0]
    return cost


@inlined
def _limit_cost(hand: HandTables, at: Iterate) -> float:
    """Add what angles beyond their limits cost; return it."""
    cost = 0.0
    for i in range(at.x.shape[0]):
        off = max(at.x[i] - hand.legal_high[i], 0.0) + min(at.x[i] - hand.legal_low[i], 0.0)
        if off != 0.0:
            cost += 0.5 * hand.limit_w2[i] * off * off
            at.gradient[6 + i] += hand.limit_w2[i] * off
            at.normal[6 + i, 6 + i] += hand.limit_w2[i]
    return cost


@inlined
def _faced(epoch_prior: EpochPrior, at: Iterate) -> float:
    """Add that the back (the palm's +y) looks along `back_normal`; return its cost."""
    w2, T, normal = epoch_prior.back_normal_w2[0], at.palm, at.normal
    cost = 0.0
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        off = T[i, 1] - epoch_prior.back_normal[i]
        cost += 0.5 * w2 * off * off
        off_j, off_k = T[j, 1] - epoch_prior.back_normal[j], T[k, 1] - epoch_prior.back_normal[k]
        at.gradient[i] += w2 * (T[j, 1] * off_k - T[k, 1] * off_j)
        normal[i, i] += w2 * (T[j, 1] * T[j, 1] + T[k, 1] * T[k, 1])
        normal[i, j] -= w2 * T[i, 1] * T[j, 1]
        normal[j, i] -= w2 * T[i, 1] * T[j, 1]
    return cost


@inner
def linearise(problem: Problem, h: int, at: Iterate, search: Search) -> float:
    """Write gradient and normal matrix of an iterate; return its cost.

    Gauss-Newton, under hypothesis h. To search.marker_chi2 (M,) chi square of each marker, to search.outliers
    (1,) half of what non-meeting rays have between them, to search.information (M, 3, 3) what is known of
    each marker's place.
    """
    rig, epoch_prior, T, z = problem.rig, problem.epoch_prior, at.palm, at.z
    hand, work = rig.hand, search.rows
    cost = _add_priors(problem, h, at, search)
    cost += _limit_cost(hand, at)
    if epoch_prior.back_normal_w2[0] > 0.0:
        cost += _faced(epoch_prior, at)
    if epoch_prior.oriented[0] > 0.0:
        cost += orientation_row(epoch_prior, at, search)
    angles_of(hand, at.x, work)
    if z.shape[0] == EXTRAS:
        for f in range(5):
            search.twist[f] = z[f]
        twist_hand(hand, search.twist)
        if epoch_prior.cycle_rows.rows[0] > 0.0:
            flexion, deviation = z[WRIST_ANGLES], z[WRIST_ANGLES + 1]
            flexed_palm(rig.device.palm, flexion, deviation, search.palm_camera, search.wrist_axes)
            for f in range(5):
                cost += finger_rows(rig, epoch_prior, f, at, search)
    chains(hand, T, work)
    search.outliers[0] = 0.0
    for m in range(rig.mounts.finger.shape[0]):
        search.marker_chi2[m] = 0.0
        if problem.observed.seen[m]:
            cost += _marker(problem, m, at, search)
    return cost


@inlined
def _marker(problem: Problem, m: int, at: Iterate, search: Search) -> float:
    """Add the rows of one marker; return their cost."""
    rig, work = problem.rig, search.rows
    D = work.by_place
    size, start = marker_jacobian(rig.hand, rig.mounts, m, at.palm, work, D)
    cost, search.marker_chi2[m] = marker_rows(rig.cameras, problem.observed, m, work.point, work)
    search.outliers[0] += cost - 0.5 * search.marker_chi2[m]
    copy(work.H, search.information[m])
    for a in range(size):
        ia = a if a < 6 else start + a
        at.gradient[ia] += D[a, 0] * work.g[0] + D[a, 1] * work.g[1] + D[a, 2] * work.g[2]
        for k in range(3):
            work.rows[a, k] = D[a, 0] * work.H[0, k] + D[a, 1] * work.H[1, k] + D[a, 2] * work.H[2, k]
        for b in range(a + 1):
            total = work.rows[a, 0] * D[b, 0] + work.rows[a, 1] * D[b, 1] + work.rows[a, 2] * D[b, 2]
            ib = b if b < 6 else start + b
            at.normal[ia, ib] += total
            if a != b:
                at.normal[ib, ia] += total
    return cost


@inner
def _step(hand: HandTables, damping: float, at: Iterate, search: Search) -> float:
    """Write the damped step (N,); return the cost's expected fall; < 0: no step.

    Angles that stand at a limit and are pushed outwards are omitted.
    """
    n, N, x = at.x.shape[0], search.step.shape[0], at.x
    down, damped, step, held = search.down, search.damped, search.step, search.held
    for i in range(N):
        down[i], held[i] = -at.gradient[i], False
        if 6 <= i < 6 + n:
            c = i - 6
            held[i] = x[c] <= hand.low[c] if down[i] < 0.0 else x[c] >= hand.high[c]
        if held[i]:
            down[i] = 0.0
        for j in range(i):
            damped[i, j] = 0.0 if held[i] or held[j] else at.normal[i, j]
        damped[i, i] = 1.0 if held[i] else at.normal[i, i] * (1.0 + damping)
        step[i] = down[i]
    if not cholesky(damped, N, search.L):
        return -1.0
    substitute(search.L, N, step)
    hoped = 0.0
    for i in range(N):
        hoped += 0.5 * down[i] * step[i]
    return hoped


@inlined
def copy_hand(source: Iterate, out: "Iterate | Posterior") -> None:
    """Copy palm, angles and extras."""
    copy(source.palm, out.palm)
    for i in range(source.x.shape[0]):
        out.x[i] = source.x[i]
    for i in range(source.z.shape[0]):
        out.z[i] = source.z[i]


@inner
def descend(
    problem: Problem, h: int, tolerance: float, share: float, at: Iterate, search: Search
) -> tuple[float, int]:
    """Search downhill by Levenberg-Marquardt, in place; return cost and steps.

    The damping follows the gain ratio (Madsen, Nielsen, Tingleff, "Methods for Non-Linear Least Squares
    Problems", 2nd edition, 2004, eq. 2.21). A search ends where a step gains less than `tolerance` and that
    `share` of the cost. The last step, of which an all but undamped model hopes for no more than the
    tolerance, is taken without another linearisation: then the normal equations are those before it.
    """
    hand, trial, n, K = problem.rig.hand, search.trial, at.x.shape[0], at.z.shape[0]
    cost = linearise(problem, h, at, search)
    damping, growth, iterations = KERNEL.first_damping, 2.0, 0
    while iterations < KERNEL.steps and damping <= KERNEL.most_damping:
        iterations += 1
        hoped = _step(hand, damping, at, search)
        least_gain = tolerance + share * cost
        if hoped < 0.0:
            damping, growth = damping * growth, 2.0 * growth
            continue
        rotate_by(search.step, at.palm, trial.palm)
        for i in range(n):
            trial.x[i] = min(max(at.x[i] + search.step[6 + i], hand.low[i]), hand.high[i])
        for i in range(K):
            trial.z[i] = at.z[i] + search.step[6 + n + i]
        for i in range(5 if K == EXTRAS else 0):
            trial.z[i] = min(max(trial.z[i], -KERNEL.rolled_rad), KERNEL.rolled_rad)
        if damping <= KERNEL.first_damping and hoped < least_gain:
            copy_hand(trial, at)
            break
        there = linearise(problem, h, trial, search)
        gain = cost - there
        if not gain > 0.0:
            damping, growth = damping * growth, 2.0 * growth
            continue
        damping = max(damping * max(1.0 / 3.0, 1.0 - (2.0 * gain / hoped - 1.0) ** 3), 1e-9)
        growth, cost = 2.0, there
        copy_hand(trial, at)
        copy(trial.normal, at.normal)
        for i in range(6 + n + K):
            at.gradient[i] = trial.gradient[i]
        if gain < least_gain:
            break
    return cost, iterations


class Posterior:
    """A hand by one epoch."""

    palm: Float = array(4, 4)
    x: Float = array("n")  # free angles
    z: Float = array("K")  # extras
    cov: Float = array("N", "N")  # turn, shift, rig axes, free angles, extras, by this epoch alone
    marker_chi2: Float = array("M")
    steps: Float = array(1)  # of the search
    natural_weight: Float = array(1)  # probability that the hand follows the posture prior
    scale: Float = array(1)  # by how much the residual has scaled the covariance
    contrary: Float = array(1)  # chi square of the palm against other sensors, and of what the extras gave in


class Blank(NamedTuple):
    """Empty prior, in boxes, used by `_onto` for a fit to points alone."""

    posture_prior: PosturePrior
    epoch_prior: Any
    between: Observations

    @classmethod
    def of(cls, n: int, extras: int, cameras: int, markers: int) -> "Blank":
        """For a hand with n free angles."""
        nothing = PosturePrior(np.zeros((1, n, n)), np.zeros((1, n)), np.zeros(1), np.zeros(1))
        return cls(nothing, boxed(record(EpochPrior, n=n, K=extras)), Observations.empty(cameras, markers))


class Hypothesis:
    """A hand under one hypothesis."""

    at: Iterate = part(Iterate)  # where its search ended
    marker_chi2: Float = array("M")
    information: Float = array("M", 3, 3)  # of the place of each marker
    cost: Float = array(1)  # half the sum of squares
    outliers: Float = array(1)  # half of what rays that do not meet have between them
    share: Float = array(1)  # its probability
    step: Float = array("N")  # from there to the mean within the limits
    off: Float = array("N")  # the same from the likelier hand


class Scratch:
    """Scratch for both hypotheses."""

    each: Sequence[Hypothesis] = part(Hypothesis, 2)  # natural and free
    start: Iterate = part(Iterate)  # where searches begin, and a rough one ends
    middle: Float = array("N")
    A: Float = array("N", "N")
    L: Float = array("N", "N")
    work: Float = array("N", "N")
    cov: Float = array("N", "N")
    here: Float = array("M", 3)
    there: Float = array("M", 3)
    cut: Cut = part(Cut)
    search: Search = part(Search)


@inlined
def likelier(scratch: Scratch) -> int:
    """The hypothesis with the larger probability."""
    return 0 if scratch.each[0].share[0] >= scratch.each[1].share[0] else 1
