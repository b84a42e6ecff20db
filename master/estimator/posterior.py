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
from common.records import record
from master.estimator.covariance import CovarianceScratch
from master.estimator.finger_scan import Prior, Scan
from master.estimator.kinematics import markers_of, rotate_by, rotation_between
from master.estimator.parameters import Mounts, truncated_mean
from master.estimator.priors import PosturePrior
from master.estimator.problem import EpochPrior, Observations, Rig
from master.estimator.sensors import CameraArrays
from master.estimator.settings import Settings
from master.estimator.solve import (
    Blank,
    Hypothesis,
    Posterior,
    Scratch,
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
def _solve_each(
    rig: Rig,
    settings: Settings,
    posture_prior: PosturePrior,
    epoch_prior: EpochPrior,
    observed: Observations,
    T: Float,
    x: Float,
    z: Float,
    scratch: Scratch,
) -> int:
    """Search under each hypothesis from one start; return the steps of the first."""
    steps = 0
    for h in range(posture_prior.constant.shape[0]):
        one = scratch.each[h]
        copy(T, one.palm)
        for i in range(x.shape[0]):
            one.x[i] = x[i]
        for i in range(z.shape[0]):
            one.z[i] = z[i]
        _, taken = descend(
            rig,
            posture_prior,
            epoch_prior,
            observed,
            h,
            settings.tolerance,
            settings.tolerance_share,
            one.palm,
            one.x,
            one.z,
            one.gradient,
            one.normal,
            scratch.search,
        )
        one.cost[0] = linearise(
            rig,
            posture_prior,
            epoch_prior,
            observed,
            h,
            one.palm,
            one.x,
            one.z,
            one.gradient,
            one.normal,
            scratch.search,
        )
        one.outliers[0] = scratch.search.outliers[0]
        for m in range(rig.mounts.finger.shape[0]):
            one.marker_chi2[m] = scratch.search.marker_chi2[m]
            for i in range(3):
                for j in range(3):
                    one.information[m, i, j] = scratch.search.information[m, i, j]
        steps = taken if h == 0 else steps
    return steps


@inner
def _weigh(
    posture_prior: PosturePrior, settings: Settings, natural_weight: float, counts: float, scratch: Scratch
) -> None:
    """Write each hypothesis's probability, by evidence and what it was before."""
    N, share, other = scratch.middle.shape[0], scratch.each[0].share, scratch.each[1].share
    share[0], other[0] = 1.0, 0.0
    if posture_prior.constant.shape[0] < 2:
        return
    odds = 0.0
    for h in range(2):
        one = scratch.each[h]
        known = half_log_determinant(scratch.L, N) if cholesky(one.normal, N, scratch.L) else 0.0
        odds += (1.0 - 2.0 * h) * (posture_prior.log_density[h] - one.cost[0] - known)
    odds = min(max(odds, -settings.certain), settings.certain)
    then = log(max(natural_weight, 1e-9)) - log(max(1.0 - natural_weight, 1e-9))
    odds += counts * (min(max(then, -settings.certain), settings.certain) - odds)
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
def _covariance(
    rig: Rig,
    settings: Settings,
    posture_prior: PosturePrior,
    epoch_prior: EpochPrior,
    h: int,
    numbers: float,
    scratch: Scratch,
) -> float:
    """Write a hypothesis's covariance (N, N) by this epoch; return its scale."""
    N, A, one = scratch.middle.shape[0], scratch.A, scratch.each[h]
    for i in range(N):
        for j in range(i + 1):
            A[i, j] = one.normal[i, j]
        if i < 6 + epoch_prior.past_w2.shape[0]:
            A[i, i] += rig.hand.anywhere[i] - (
                epoch_prior.palm_w2[i] if i < 6 else epoch_prior.past_w2[i - 6]
            )
    for i in range(one.x.shape[0]):  # a limit keeps an angle, and measures none
        if one.x[i] > rig.hand.legal_high[i] or one.x[i] < rig.hand.legal_low[i]:
            A[6 + i, 6 + i] -= rig.hand.beyond_w2[i]
    for i in range(3):
        for j in range(i + 1):
            A[3 + i, 3 + j] -= (
                epoch_prior.depth_w2[0] * epoch_prior.line_of_sight[i] * epoch_prior.line_of_sight[j]
            )
    if not cholesky(A, N, scratch.L):  # by rounding: nothing is known but limits
        known = rig.hand.anywhere.shape[0]
        for i in range(N):
            for j in range(N):
                scratch.cov[i, j] = 0.0
            w2 = rig.hand.anywhere[i] if i < known else epoch_prior.z_info[i - known, i - known]
            scratch.cov[i, i] = 1.0 / w2
        return 1.0
    inverse(scratch.L, N, scratch.work, scratch.cov)
    past = past_cost(epoch_prior, one.palm, one.x, scratch.search.off)
    chi2 = 2.0 * (one.cost[0] - past - one.outliers[0] - _least(posture_prior, epoch_prior, h, scratch))
    free = max(numbers - 6.0, 0.0)
    scale = max((settings.claimed + max(chi2, 0.0)) / (settings.claimed + free), 1.0)
    for i in range(N):
        for j in range(N):
            scratch.cov[i, j] *= scale
    return scale


@inner
def _mix(
    rig: Rig,
    settings: Settings,
    posture_prior: PosturePrior,
    epoch_prior: EpochPrior,
    numbers: float,
    scratch: Scratch,
    out: Posterior,
) -> int:
    """Write mean step and covariance of all hypotheses; return the likelier one."""
    n, N = out.x.shape[0], scratch.middle.shape[0]
    best = likelier(scratch)
    if scratch.each[best].share[0] > 1.0 - settings.negligible:
        scratch.each[best].share[0], scratch.each[1 - best].share[0] = 1.0, 0.0
    out.scale[0] = 0.0
    for i in range(N):
        scratch.middle[i] = 0.0
        for j in range(N):
            out.cov[i, j] = 0.0
    for h in range(posture_prior.constant.shape[0]):
        one, from_here = scratch.each[h], scratch.each[best]
        share = one.share[0]
        for i in range(N):
            one.off[i] = one.step[i] = 0.0
        if share == 0.0:
            continue
        if h != best:
            rotation_between(one.palm, from_here.palm, scratch.search.J, one.off)
            for i in range(3):
                one.off[3 + i] = one.palm[i, 3] - from_here.palm[i, 3]
            for i in range(n):
                one.off[6 + i] = one.x[i] - from_here.x[i]
            for i in range(out.z.shape[0]):
                one.off[6 + n + i] = one.z[i] - from_here.z[i]
        out.scale[0] += share * _covariance(rig, settings, posture_prior, epoch_prior, h, numbers, scratch)
        for i in range(N):
            for j in range(N):
                out.cov[i, j] += share * scratch.cov[i, j]
        if h > 0 and share > settings.noticed:
            truncated_mean(rig.hand, one.normal, one.gradient, one.x, scratch.cut, one.step)
        for i in range(N):
            one.off[i] += one.step[i]
            scratch.middle[i] += share * one.off[i]
    for h in range(posture_prior.constant.shape[0]):
        one = scratch.each[h]
        for i in range(N):
            for j in range(N):
                between = (one.off[i] - scratch.middle[i]) * (one.off[j] - scratch.middle[j])
                out.cov[i, j] += one.share[0] * between
    return best


@inlined
def _ends(rig: Rig, one: Hypothesis, scratch: Scratch) -> None:
    """Write where a hypothesis's step brings the markers (M, 3), going straight."""
    markers_of(rig.hand, rig.mounts, one.palm, one.x, scratch.search.rows, scratch.here)
    moves = False
    difference_step = 1e-4  # of a step: what a difference is taken over
    for i in range(one.step.shape[0]):
        scratch.search.step[i] = difference_step * one.step[i]
        moves = moves or one.step[i] != 0.0
    if not moves:
        return
    rotate_by(scratch.search.step, one.palm, scratch.search.palm)
    for i in range(one.x.shape[0]):
        scratch.search.x[i] = one.x[i] + scratch.search.step[6 + i]
    markers_of(
        rig.hand, rig.mounts, scratch.search.palm, scratch.search.x, scratch.search.rows, scratch.there
    )
    for m in range(rig.mounts.finger.shape[0]):
        for i in range(3):
            scratch.here[m, i] += (scratch.there[m, i] - scratch.here[m, i]) / difference_step


@inner
def _onto(
    rig: Rig,
    settings: Settings,
    observed: Observations,
    blank: Blank,
    best: int,
    scratch: Scratch,
    out: Posterior,
) -> None:
    """Move the likelier hand by the mean step, then to the mean of the markers.

    A pose between two hands that explain the markers does so a little worse, since fingers move on arcs. So
    it is one step, the shortest by the normal matrix, to where the mean of their markers is.
    """
    n, N, between, likely = out.x.shape[0], scratch.middle.shape[0], blank.between, scratch.each[best]
    for m in range(rig.mounts.finger.shape[0]):
        between.seen[m] = between.triangulated[m] = observed.seen[m]
        for i in range(3):
            between.point[m, i] = 0.0
            for j in range(3):
                between.information[m, i, j] = likely.information[m, i, j]
    for h in range(2):
        one = scratch.each[h]
        if one.share[0] > 0.0:
            _ends(rig, one, scratch)
            for m in range(rig.mounts.finger.shape[0]):
                for i in range(3):
                    between.point[m, i] += one.share[0] * scratch.here[m, i]
    search = scratch.search
    rotate_by(scratch.middle, likely.palm, out.palm)
    for i in range(n):
        out.x[i] = likely.x[i] + scratch.middle[6 + i]
    for i in range(out.z.shape[0]):
        out.z[i] = likely.z[i] + scratch.middle[6 + n + i]
    linearise(
        rig,
        blank.posture_prior,
        blank.epoch_prior[0],
        between,
        _ONLY,
        out.palm,
        out.x,
        out.z,
        search.gradient,
        search.normal,
        search,
    )
    for i in range(N):
        search.step[i] = -search.gradient[i]
        for j in range(i + 1):
            scratch.A[i, j] = search.normal[i, j] + settings.stiff * likely.normal[i, j]
    if cholesky(scratch.A, N, scratch.L):
        substitute(scratch.L, N, search.step)
        copy(out.palm, search.palm)
        rotate_by(search.step, search.palm, out.palm)
        for i in range(n):
            out.x[i] += search.step[6 + i]
        for i in range(out.z.shape[0]):
            out.z[i] += search.step[6 + n + i]
    for i in range(n):
        out.x[i] = min(max(out.x[i], rig.hand.low[i]), rig.hand.high[i])


@inner
def posterior(
    rig: Rig,
    settings: Settings,
    posture_prior: PosturePrior,
    epoch_prior: EpochPrior,
    observed: Observations,
    T: Float,
    x: Float,
    z: Float,
    natural_weight: float,
    counts: float,
    numbers: float,
    blank: Blank,
    scratch: Scratch,
    out: Posterior,
) -> None:
    """Fit one epoch from a palm T, x, z.

    `natural_weight`: probability of a natural hand a moment ago, `counts`: what that counts, 0 ... 1;
    `numbers` measured.
    """
    out.steps[0] = _solve_each(rig, settings, posture_prior, epoch_prior, observed, T, x, z, scratch)
    _weigh(posture_prior, settings, natural_weight, counts, scratch)
    out.natural_weight[0] = scratch.each[0].share[0]
    best = _mix(rig, settings, posture_prior, epoch_prior, numbers, scratch, out)
    likely = scratch.each[best]
    moves = False
    for i in range(scratch.middle.shape[0]):
        moves = moves or scratch.middle[i] != 0.0
    if moves:
        _onto(rig, settings, observed, blank, best, scratch, out)
    else:
        copy(likely.palm, out.palm)
        for i in range(x.shape[0]):
            out.x[i] = likely.x[i]
        for i in range(z.shape[0]):
            out.z[i] = likely.z[i]
    for m in range(rig.mounts.finger.shape[0]):
        out.marker_chi2[m] = likely.marker_chi2[m]


ON_MARKERS, ON_OTHERS, BY_MARKERS = 1, 2, 16


class Ground:
    """What an epoch rests on: the rows of its markers, counted."""

    shown: Bool  # (5,) fingers that are measured
    sources: Int  # (6,) as of `Fitted`, by markers alone; of the palm where `by_markers`
    seen: Int  # (1,) markers that have a row
    most: Int  # (1,) the most rays of any; a marker that is placed as a point counts as two
    numbers: Float  # (1,) numbers that are measured
    back: Bool  # (1,) whether a marker on the palm's back is seen
    by_markers: Bool  # (1,) whether they determine where the palm is

    @classmethod
    def empty(cls) -> "Ground":
        """Scratch for one."""
        return record(
            cls,
            shown=("u1", 5),
            sources=("i8", 6),
            seen=("i8", 1),
            most=("i8", 1),
            numbers=1,
            back=("u1", 1),
            by_markers=("u1", 1),
        )


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
        first_marker = 8  # bit
        out.sources[5] |= 1 << (first_marker + m)
    for f in range(5):
        out.shown[f] = out.sources[f] > 0
    back_numbers = 2.0  # a marker on the back measures where that looks, by two angles
    out.numbers[0] += back_numbers if out.back[0] else 0.0
    palm_by = 3  # markers
    out.by_markers[0] = out.seen[0] >= palm_by or (out.seen[0] == palm_by - 1 and out.back[0] > 0)
    if out.by_markers[0]:
        out.sources[5] |= ON_MARKERS | BY_MARKERS


class Task:
    """What is to be done at an epoch."""

    t_ns: Int  # (1,)
    palm_shown: Bool  # (1,) whether something measures where the palm is
    palm: Float  # (4, 4) of another hand of the epoch, and `angles` (20,) [rad]
    angles: Float
    x: Float  # (n,) its free angles, inside the limits; or, with the palm, where a search begins
    may_leave: Bool  # (1,) whether there is another, and it may take the place of the state
    coarse: Bool  # (1,) whether a search ends early, in place, under the widest hypothesis alone
    natural_weight: Float  # (1,) probability of a natural hand a moment ago
    counts: Float  # (1,) what that counts, 0 ... 1
    second_order: Bool  # (1,) whether covariance is wanted to second order
    process_noise_rad2: Float  # (1,) variance of what the heading has drifted since the last epoch
    continuous: Bool  # (1,) whether epochs follow each other
    scanned: Float  # (20,) angles of fingers whose cost map was searched, where it is likeliest
    refused: Bool  # (5,) fingertips, and `off` (5,) laser points, that no pose explains
    off: Bool
    solver_mode: Code  # (5,) `SolverMode` codes of what fingers are solved from
    ambiguous: Bool  # (5,) whether another pose explains as much

    @classmethod
    def empty(cls, n: int) -> "Task":
        """Scratch for one."""
        return record(
            cls,
            **dict.fromkeys(("palm_shown", "may_leave", "coarse", "second_order", "continuous"), ("u1", 1)),
            **dict.fromkeys(("natural_weight", "counts", "process_noise_rad2"), 1),
            **dict.fromkeys(("refused", "off", "solver_mode", "ambiguous"), ("u1", 5)),
            t_ns=("i8", 1),
            palm=(4, 4),
            angles=20,
            scanned=20,
            x=n,
        )


class Workspace:
    """Scratch for all kernels of one hand, with the task and the prior of the epoch."""

    task: Task
    ground: Ground
    epoch_prior: EpochPrior
    hidden: Hidden
    found: Posterior
    scratch: Scratch
    cov_scratch: CovarianceScratch
    prior: Prior
    scan: Scan
    extras: ExtrasScratch

    @classmethod
    def empty(cls, n: int, extras: int, markers: int) -> "Workspace":
        """Allocate it."""
        return record(
            cls,
            task=Task.empty(n),
            ground=Ground.empty(),
            epoch_prior=EpochPrior.none(n, extras),
            hidden=Hidden.none(n),
            found=Posterior.empty(n, extras, markers),
            scratch=Scratch.empty(n, extras, markers),
            cov_scratch=CovarianceScratch.empty(6 + n + extras, markers),
            prior=Prior.empty(),
            scan=Scan.empty(),
            extras=ExtrasScratch.empty(extras),
        )


class Model(NamedTuple):
    """Everything that is the same at every epoch, in boxes (`common.records.boxed`)."""

    hand: Any
    settings: Any
    mounts: Mounts
    cameras: CameraArrays
    device: Any
