"""The posterior of an epoch mixes the hands of all hypotheses.

The evidence of a hypothesis is the density of the markers under it at its solution, by Laplace's
approximation (MacKay 1992, "Bayesian interpolation", section 4),

    log p = -cost + log density of the posture prior - log det(normal) / 2

Whether a hand is natural does not change from frame to frame, so this is smoothed in time. Mean and
covariance are those of the mixture: the spread between solutions is uncertainty as well. Of a free hand the
mean within its limits is taken, of a natural one the likeliest pose (`master.estimator.parameters`).

The covariance is that of this epoch alone. The state before is a prior to the fit, but not independent: the
same prior led to it from the same markers, so a wrong direction of a finger is as wrong in every frame of a
held pose. The posture prior holds better of some postures than of others. By how much, the residual of the
epoch itself shows, which scales the covariance (Birge 1932), with the claimed widths as one observation more
(a prior of unit information: Kass, Wasserman 1995):

    covariance = s^2 normal^-1,   s^2 = max(1, (1 + chi^2) / (1 + f)),   f = numbers that are measured - 6

Priors that contradict each other, whatever the markers, are no evidence: their least cost is no part of
chi^2.
"""

from math import exp, log
from typing import Any, NamedTuple

from common.arrays import Bool, Code, Float, Int
from common.kernels import constant, inlined, inner, kernel
from common.records import array, part
from master.estimator.covariance import CovarianceScratch
from master.estimator.finger_scan import Prior, Scan
from master.estimator.kinematics import markers_of, rotate_by, rotation_between
from master.estimator.parameters import Mounts, truncated_mean
from master.estimator.priors import PosturePrior
from master.estimator.problem import EpochPrior, Observations, Problem, Rig
from master.estimator.sensors import CameraArrays
from master.estimator.settings import KERNEL
from master.estimator.solve import (
    Blank,
    Hypothesis,
    Posterior,
    Scratch,
    copy_hand,
    descend,
    likelier,
    linearise,
    own_cost,
    past_cost,
)
from master.estimator.state import ExtrasScratch, Hidden
from master.fabrik.linear_algebra import cholesky, copy, half_log_determinant, inverse, substitute

_ONLY = constant(0)  # hypothesis of `Blank`


@inner
def _solve_each(problem: Problem, scratch: Scratch) -> int:
    """Search under each hypothesis from one start; return the steps of the first."""
    settings, search, steps = problem.rig.settings, scratch.search, 0
    for h in range(problem.posture_prior.constant.shape[0]):
        one = scratch.each[h]
        copy_hand(scratch.start, one.at)
        _, taken = descend(problem, h, settings.tolerance, settings.tolerance_share, one.at, search)
        one.cost[0] = linearise(problem, h, one.at, search)
        one.outliers[0] = search.outliers[0]
        for m in range(problem.rig.mounts.finger.shape[0]):
            one.marker_chi2[m] = search.marker_chi2[m]
            copy(search.information[m], one.information[m])
        steps = taken if h == 0 else steps
    return steps


@inner
def _weigh(problem: Problem, natural_weight: float, counts: float, scratch: Scratch) -> None:
    """Write each hypothesis's probability, by evidence and what it was before."""
    N, share, other = scratch.middle.shape[0], scratch.each[0].share, scratch.each[1].share
    posture_prior, certain = problem.posture_prior, problem.rig.settings.certain
    share[0], other[0] = 1.0, 0.0
    if posture_prior.constant.shape[0] < 2:
        return
    odds = 0.0
    for h in range(2):
        one = scratch.each[h]
        known = half_log_determinant(scratch.L, N) if cholesky(one.at.normal, N, scratch.L) else 0.0
        odds += (1.0 - 2.0 * h) * (posture_prior.log_density[h] - one.cost[0] - known)
    odds = min(max(odds, -certain), certain)
    then = log(max(natural_weight, 1e-9)) - log(max(1.0 - natural_weight, 1e-9))
    odds += counts * (min(max(then, -certain), certain) - odds)
    share[0] = 1.0 / (1.0 + exp(-odds))
    other[0] = 1.0 - share[0]


@inner
def _least(posture_prior: PosturePrior, epoch_prior: EpochPrior, h: int, scratch: Scratch) -> float:
    """Return the least cost of posture and own priors: how they contradict."""
    n = epoch_prior.own.shape[0]
    x = scratch.cut.weight
    for i in range(n):
        for j in range(n):
            scratch.work[i, j] = posture_prior.normal[h, i, j]
        scratch.work[i, i] += epoch_prior.own_w2[i]
        x[i] = posture_prior.pull[h, i] + epoch_prior.own_w2[i] * epoch_prior.own[i]
    if not cholesky(scratch.work, n, scratch.L):
        return 0.0
    substitute(scratch.L, n, x)
    return own_cost(posture_prior, epoch_prior, h, x)


@inner
def _covariance(problem: Problem, h: int, numbers: float, scratch: Scratch) -> float:
    """Write a hypothesis's covariance (N, N) by this epoch; return its scale."""
    hand, prior, A, one = problem.rig.hand, problem.epoch_prior, scratch.A, scratch.each[h]
    N, at, known = scratch.middle.shape[0], one.at, hand.anywhere.shape[0]
    for i in range(N):
        for j in range(i + 1):
            A[i, j] = at.normal[i, j]
        if i < known:
            A[i, i] += hand.anywhere[i] - (prior.palm_w2[i] if i < 6 else prior.past_w2[i - 6])
    for i in range(at.x.shape[0]):  # a limit keeps an angle, and measures none
        if at.x[i] > hand.legal_high[i] or at.x[i] < hand.legal_low[i]:
            A[6 + i, 6 + i] -= hand.limit_w2[i]
    for i in range(3):
        for j in range(i + 1):
            A[3 + i, 3 + j] -= prior.depth_w2[0] * prior.line_of_sight[i] * prior.line_of_sight[j]
    if not cholesky(A, N, scratch.L):  # by rounding: nothing is known but limits
        for i in range(N):
            for j in range(N):
                scratch.cov[i, j] = 0.0
            w2 = hand.anywhere[i] if i < known else prior.z_info[i - known, i - known]
            scratch.cov[i, i] = 1.0 / w2
        return 1.0
    inverse(scratch.L, N, scratch.work, scratch.cov)
    past = past_cost(prior, at.palm, at.x, scratch.search.off)
    least = _least(problem.posture_prior, prior, h, scratch)
    chi2 = 2.0 * (one.cost[0] - past - one.outliers[0] - least)
    free, claimed = max(numbers - 6.0, 0.0), problem.rig.settings.claimed
    scale = max((claimed + max(chi2, 0.0)) / (claimed + free), 1.0)
    for i in range(N):
        for j in range(N):
            scratch.cov[i, j] *= scale
    return scale


@inner
def _mix(problem: Problem, numbers: float, scratch: Scratch, out: Posterior) -> int:
    """Write mean step and covariance of all hypotheses; return the likelier one."""
    rig, n, N, best = problem.rig, out.x.shape[0], scratch.middle.shape[0], likelier(scratch)
    if scratch.each[best].share[0] > 1.0 - rig.settings.negligible:
        scratch.each[best].share[0], scratch.each[1 - best].share[0] = 1.0, 0.0
    out.scale[0] = 0.0
    for i in range(N):
        scratch.middle[i] = 0.0
        for j in range(N):
            out.cov[i, j] = 0.0
    for h in range(problem.posture_prior.constant.shape[0]):
        one, at, from_here = scratch.each[h], scratch.each[h].at, scratch.each[best].at
        share = one.share[0]
        for i in range(N):
            one.off[i] = one.step[i] = 0.0
        if share == 0.0:
            continue
        if h != best:
            rotation_between(at.palm, from_here.palm, scratch.search.J, one.off)
            for i in range(3):
                one.off[3 + i] = at.palm[i, 3] - from_here.palm[i, 3]
            for i in range(n):
                one.off[6 + i] = at.x[i] - from_here.x[i]
            for i in range(out.z.shape[0]):
                one.off[6 + n + i] = at.z[i] - from_here.z[i]
        out.scale[0] += share * _covariance(problem, h, numbers, scratch)
        for i in range(N):
            for j in range(N):
                out.cov[i, j] += share * scratch.cov[i, j]
        if h > 0 and share > rig.settings.noticed:
            truncated_mean(rig.hand, at.normal, at.gradient, at.x, scratch.cut, one.step)
        for i in range(N):
            one.off[i] += one.step[i]
            scratch.middle[i] += share * one.off[i]
    for h in range(problem.posture_prior.constant.shape[0]):
        one = scratch.each[h]
        for i in range(N):
            for j in range(N):
                between = (one.off[i] - scratch.middle[i]) * (one.off[j] - scratch.middle[j])
                out.cov[i, j] += one.share[0] * between
    return best


@inlined
def _ends(rig: Rig, one: Hypothesis, scratch: Scratch) -> None:
    """Write where a hypothesis's step brings the markers (M, 3), going straight."""
    search, trial, at = scratch.search, scratch.search.trial, one.at
    markers_of(rig.hand, rig.mounts, at.palm, at.x, search.rows, scratch.here)
    moves = False
    for i in range(one.step.shape[0]):
        search.step[i] = KERNEL.difference * one.step[i]
        moves = moves or one.step[i] != 0.0
    if not moves:
        return
    rotate_by(search.step, at.palm, trial.palm)
    for i in range(at.x.shape[0]):
        trial.x[i] = at.x[i] + search.step[6 + i]
    markers_of(rig.hand, rig.mounts, trial.palm, trial.x, search.rows, scratch.there)
    for m in range(rig.mounts.finger.shape[0]):
        for i in range(3):
            scratch.here[m, i] += (scratch.there[m, i] - scratch.here[m, i]) / KERNEL.difference


@inner
def _onto(problem: Problem, blank: Blank, best: int, scratch: Scratch, out: Posterior) -> None:
    """Move the likelier hand by the mean step, then to the mean of the markers.

    A pose between two hands that explain the markers does so a little worse, since fingers move on arcs. So
    it is one step, the shortest by the normal matrix, to where the mean of their markers is.
    """
    rig, search, likely, between = problem.rig, scratch.search, scratch.each[best], blank.between
    n, N, at = out.x.shape[0], scratch.middle.shape[0], search.trial
    for m in range(rig.mounts.finger.shape[0]):
        between.seen[m] = between.triangulated[m] = problem.observed.seen[m]
        copy(likely.information[m], between.information[m])
        for i in range(3):
            between.point[m, i] = 0.0
    for h in range(2):
        one = scratch.each[h]
        if one.share[0] > 0.0:
            _ends(rig, one, scratch)
            for m in range(rig.mounts.finger.shape[0]):
                for i in range(3):
                    between.point[m, i] += one.share[0] * scratch.here[m, i]
    rotate_by(scratch.middle, likely.at.palm, at.palm)
    for i in range(n):
        at.x[i] = likely.at.x[i] + scratch.middle[6 + i]
    for i in range(out.z.shape[0]):
        at.z[i] = likely.at.z[i] + scratch.middle[6 + n + i]
    linearise(Problem(rig, blank.posture_prior, blank.epoch_prior[0], between), _ONLY, at, search)
    for i in range(N):
        search.step[i] = -at.gradient[i]
        for j in range(i + 1):
            scratch.A[i, j] = at.normal[i, j] + rig.settings.stiff * likely.at.normal[i, j]
    copy_hand(at, out)
    if cholesky(scratch.A, N, scratch.L):
        substitute(scratch.L, N, search.step)
        rotate_by(search.step, at.palm, out.palm)
        for i in range(n):
            out.x[i] += search.step[6 + i]
        for i in range(out.z.shape[0]):
            out.z[i] += search.step[6 + n + i]
    for i in range(n):
        out.x[i] = min(max(out.x[i], rig.hand.low[i]), rig.hand.high[i])


@inner
def posterior(
    problem: Problem, task: "Task", numbers: float, blank: Blank, scratch: Scratch, out: Posterior
) -> None:
    """Fit one epoch, of which so many numbers are measured, from `scratch.start`."""
    out.steps[0] = _solve_each(problem, scratch)
    _weigh(problem, task.natural_weight[0], task.counts[0], scratch)
    out.natural_weight[0] = scratch.each[0].share[0]
    best = _mix(problem, numbers, scratch, out)
    moves = False
    for i in range(scratch.middle.shape[0]):
        moves = moves or scratch.middle[i] != 0.0
    if moves:
        _onto(problem, blank, best, scratch, out)
    else:
        copy_hand(scratch.each[best].at, out)
    for m in range(problem.rig.mounts.finger.shape[0]):
        out.marker_chi2[m] = scratch.each[best].marker_chi2[m]


ON_MARKERS, ON_OTHERS, BY_MARKERS, _FIRST_MARKER = 1, 2, 16, 8  # bits; of the marker its number


class Ground:
    """What an epoch rests on: the rows of its markers, counted."""

    shown: Bool = array(5, kind="u1")  # fingers that are measured
    sources: Int = array(6, kind="i8")  # as of `Fitted`, by markers alone; of the palm where `by_markers`
    seen: Int = array(1, kind="i8")  # markers that have a row
    most: Int = array(1, kind="i8")  # the most rays of any; a marker that is placed as a point counts as two
    numbers: Float = array(1)  # numbers that are measured
    back: Bool = array(1, kind="u1")  # whether a marker on the palm's back is seen
    by_markers: Bool = array(1, kind="u1")  # whether they determine where the palm is


@kernel
def count_rows(mounts: Mounts, observed: Observations, boxed_out: Any) -> None:
    """Count the rows of an epoch into `boxed_out`, (1,) `Ground`."""
    out = boxed_out[0]
    out.seen[0], out.most[0], out.numbers[0], out.back[0] = 0, 0, 0.0, False
    for p in range(6):
        out.sources[p] = 0
    for m in range(mounts.finger.shape[0]):
        if not observed.seen[m]:
            continue
        f, rays = mounts.finger[m], observed.rays[m]
        out.seen[0] += 1
        out.most[0] = max(out.most[0], rays)
        out.numbers[0] += 3.0 if rays > 1 else 2.0
        out.back[0] = out.back[0] or mounts.on_back[m]
        if f >= 0:
            out.sources[f] |= ON_MARKERS | (BY_MARKERS if rays > 1 else 0)
        out.sources[5] |= 1 << (_FIRST_MARKER + m)
    for f in range(5):
        out.shown[f] = out.sources[f] > 0
    back_numbers = 2.0  # a marker on the back measures where that looks, by two angles
    out.numbers[0] += back_numbers if out.back[0] else 0.0
    out.by_markers[0] = out.seen[0] >= 3 or (out.seen[0] == 2 and out.back[0] > 0)
    if out.by_markers[0]:
        out.sources[5] |= ON_MARKERS | BY_MARKERS


class Task:
    """What is to be done at an epoch."""

    t_ns: Int = array(1, kind="i8")
    palm_shown: Bool = array(1, kind="u1")  # whether something measures where the palm is
    palm: Float = array(4, 4)  # of another hand of the epoch, and `angles` (20,) [rad]
    angles: Float = array(20)
    may_leave: Bool = array(1, kind="u1")  # whether there is another, and it may take the place of the state
    coarse: Bool = array(1, kind="u1")  # a search ends early, in place, under the widest hypothesis
    natural_weight: Float = array(1)  # probability of a natural hand a moment ago
    counts: Float = array(1)  # what that counts, 0 ... 1
    second_order: Bool = array(1, kind="u1")  # whether covariance is wanted to second order
    process_noise_rad2: Float = array(1)  # variance of what the heading has drifted since the last epoch
    continuous: Bool = array(1, kind="u1")  # whether epochs follow each other
    scanned: Float = array(20)  # angles of fingers whose cost map was searched, where it is likeliest
    refused: Bool = array(5, kind="u1")  # fingertips, and `off` (5,) laser points, that no pose explains
    off: Bool = array(5, kind="u1")
    solver_mode: Code = array(5, kind="u1")  # `SolverMode` codes of what fingers are solved from
    ambiguous: Bool = array(5, kind="u1")  # whether another pose explains as much


class Workspace:
    """Scratch for all kernels of one hand, with the task and the prior of the epoch."""

    task: Task = part(Task)
    ground: Ground = part(Ground)
    epoch_prior: EpochPrior = part(EpochPrior)
    hidden: Hidden = part(Hidden)
    found: Posterior = part(Posterior)
    scratch: Scratch = part(Scratch)
    cov_scratch: CovarianceScratch = part(CovarianceScratch)
    prior: Prior = part(Prior)
    scan: Scan = part(Scan)
    extras: ExtrasScratch = part(ExtrasScratch)


class Model(NamedTuple):
    """Everything that is the same at every epoch, in boxes (`common.records.boxed`)."""

    hand: Any
    settings: Any
    mounts: Mounts
    cameras: CameraArrays
    device: Any
