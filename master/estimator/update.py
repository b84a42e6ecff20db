"""Kernels of one epoch: predict, fit, and update the state with the result."""

from math import exp
from typing import Any, NamedTuple

import numpy as np

from common.arrays import Bool, Code, Float
from common.kernels import inner, kernel
from common.messages import Source
from master.estimator.covariance import add_second_order, is_small, linear, only_limits, surer, tilts
from master.estimator.kinematics import angles_of, chains, clamp, free_of, joints, marker_point
from master.estimator.posterior import Ground, Model, Task, posterior
from master.estimator.priors import PosturePrior
from master.estimator.problem import (
    EpochPrior,
    Observations,
    Problem,
    Rig,
    Search,
    contrary,
    marker_rows,
    sensed_palm,
)
from master.estimator.sensors import EXTRAS
from master.estimator.settings import Settings
from master.estimator.solve import Blank, descend, likelier
from master.estimator.state import PALM_PART, HandState, grow, keep_extras, predict
from master.estimator.wrist_update import extras_only, start_scanned, take_scanned
from master.fabrik.linear_algebra import copy, inverse_3
from master.fabrik.settings import NEVER_NS

_SOLVED, _MEASURED, _HELD, _WRIST = (
    int(source) for source in (Source.SOLVED, Source.MEASURED, Source.HELD, Source.WRIST)
)


class Estimate(NamedTuple):
    """A hand at one epoch, as kernels write it."""

    palm: Float  # (4, 4)
    angles: Float  # (20,) [rad]
    position: Float  # (26, 3) [m], rig frame
    rotation: Float  # (26, 3, 3)
    cov: Float  # (26, 3, 3) [m^2] of the joints
    tilt: Float  # (5, 3, 3) [rad^2] of the last phalanges' directions, by this epoch alone
    tilt_process_noise: Float  # (5,) [rad^2/s^2] by how much their trace grows, by the time squared
    tracked: Bool  # (26,), as `source`: as of `HandPose`
    source: Code

    @classmethod
    def empty(cls) -> "Estimate":
        """Scratch for one."""
        joints_m = np.empty((26, 3)), np.empty((26, 3, 3)), np.empty((26, 3, 3))
        fingers = np.empty((5, 3, 3)), np.empty(5), np.empty(26, np.bool_), np.empty(26, np.uint8)
        return cls(np.empty((4, 4)), np.empty(20), *joints_m, *fingers)


@inner
def chi_square(
    rig: Rig, observed: Observations, T: Float, x: Float, process_noise_m: float, search: Search
) -> float:
    """Return the markers' chi square on a hand that may move by `process_noise_m`."""
    work, mounts = search.rows, rig.mounts
    angles_of(rig.hand, x, work)
    chains(rig.hand, T, work)
    total = 0.0
    for m in range(mounts.finger.shape[0]):
        if not observed.seen[m]:
            continue
        kept, K = search.J, work.K
        own = observed.information[m] if observed.triangulated[m] else observed.own[m]
        marker_point(mounts, m, T, work, work.point)
        for i in range(3):
            for j in range(3):
                kept[i, j], K[i, j] = own[i, j], 0.0
        if process_noise_m > 0.0:
            inverse_3(own, K, own)
            for i in range(3):
                own[i, i] += process_noise_m * process_noise_m
            inverse_3(own, K, own)
        _, chi2 = marker_rows(rig.cameras, observed, m, work.point, work)
        copy(kept, own)
        total += chi2
    return total


@inner
def _judge(rig: Rig, state: HandState, t_ns: int, observed: Observations, out: Estimate) -> None:
    """Write which joints are tracked (small 95 % region, not too old), on what."""
    hand, settings = rig.hand, rig.settings
    for joint in range(26):
        f = hand.finger[joint]
        part = f if f >= 0 else PALM_PART
        by_wrist = f >= 0 and state.solver_mode[f] > 0
        most_s = settings.tracked_cycle_s if by_wrist else settings.tracked_age_s
        measured_lately = (t_ns - state.measured_ns[part]) * 1e-9 <= most_s
        sure = f < 0 or not state.vague[f]
        out.tracked[joint] = measured_lately and sure and is_small(hand, out.cov, joint, settings.tracked_m)
        now = state.measured_ns[part] == t_ns
        out.source[joint] = _SOLVED if now else _HELD
        if by_wrist and measured_lately:
            out.source[joint] = _WRIST
    for m in range(rig.mounts.finger.shape[0]):
        f = rig.mounts.finger[m]
        if f >= 0 and observed.rays[m] > 1 and rig.mounts.level[m] == 3:
            for joint in range(26):
                if hand.finger[joint] == f and hand.level[joint] == 3:
                    out.source[joint] = _MEASURED


@inner
def _depth_noise(
    settings: Settings, state: HandState, t_ns: int, ground: Ground, epoch_prior: EpochPrior, out: Estimate
) -> None:
    """Add possible drift in depth over the time that one camera alone saw a hand.

    Perspective constrains it to centimetres only, and the fit is as sure of it as of the last epoch's.
    """
    triangulated, seen, line_of_sight = ground.most[0] > 1, ground.seen[0] > 0, epoch_prior.line_of_sight
    if triangulated or state.triangulated_ns[0] == NEVER_NS:
        state.triangulated_ns[0] = t_ns
    if triangulated or not seen:
        return
    drifted_m = settings.unobserved_depth_m_s * (t_ns - state.triangulated_ns[0]) * 1e-9
    sigma_m = min(drifted_m, settings.unobserved_depth_most_m)
    for joint in range(26):
        for i in range(3):
            for j in range(3):
                out.cov[joint, i, j] += sigma_m * sigma_m * line_of_sight[i] * line_of_sight[j]


@kernel
def predict_epoch(model: Model, boxed_state: Any, observed: Observations, boxed_space: Any) -> float:
    """Write the state's prediction for an epoch, and the start of its search.

    Returns chi square of the markers above which another hand explains them better; infinity: there is none;
    negative: no motion explains them, but it does.
    """
    rig = Rig(model.hand[0], model.settings[0], model.mounts, model.cameras, model.device[0])
    state, space, settings = boxed_state[0], boxed_space[0], rig.settings
    task, epoch_prior, start = space.task, space.epoch_prior, space.scratch.start
    search = space.scratch.search
    t_ns, limit = task.t_ns[0], np.inf
    dt_s = (t_ns - state.t_ns[0]) * 1e-9
    if task.may_leave[0] > 0:
        free_of(rig.hand, task.angles, start.x)
        limit = chi_square(rig, observed, task.palm, start.x, 0.0, search) + settings.misled
        process_noise_m = settings.palm_process_noise_m_s * dt_s
        if chi_square(rig, observed, state.palm, state.x, process_noise_m, search) > limit:
            return -1.0
    predict(rig.hand, settings, state, t_ns, space.ground.shown, space.hidden, epoch_prior)
    _rotate_on(state, epoch_prior, search)
    task.natural_weight[0], task.counts[0] = state.natural_weight[0], exp(-dt_s / settings.component_memory_s)
    copy(epoch_prior.palm, start.palm)
    for c in range(state.x.shape[0]):
        start.x[c] = state.x[c]
    start_scanned(rig.hand, space.scan, task.scanned, search.trial.x, start.x)
    return limit


@inner
def _rotate_on(state: HandState, epoch_prior: EpochPrior, search: Search) -> None:
    """Write `epoch_prior.palm`: that of the state, rotated on by other sensors."""
    by = search.J
    for i in range(3):
        for j in range(3):
            by[i, j] = 1.0 if i == j else 0.0
    if epoch_prior.oriented[0] > 0.0 and state.measured_rotation_known[0] > 0:
        sensed_palm(epoch_prior, state.z, search)
        for i in range(3):
            for j in range(3):
                by[i, j] = 0.0
                for k in range(3):
                    by[i, j] += search.palm[i, k] * state.measured_rotation[j, k]
    for i in range(3):
        for j in range(3):
            epoch_prior.palm[i, j] = 0.0
            for k in range(3):
                epoch_prior.palm[i, j] += by[i, k] * state.palm[k, j]


@kernel
def fit_epoch(
    model: Model, posture_prior: PosturePrior, observed: Observations, blank: Blank, boxed_space: Any
) -> float:
    """Fit the hand of one epoch in place; return chi square of the markers.

    From `start` of the scratch, or roughly, in place: then the cost is returned. What is found is in `found`
    of `boxed_space`, (1,) `Workspace`.
    """
    rig = Rig(model.hand[0], model.settings[0], model.mounts, model.cameras, model.device[0])
    space, settings = boxed_space[0], rig.settings
    task, epoch_prior, scratch, found = space.task, space.epoch_prior, space.scratch, space.found
    problem, search = Problem(rig, posture_prior, epoch_prior, observed), scratch.search
    if task.coarse[0] > 0:
        widest = posture_prior.constant.shape[0] - 1
        cost, _ = descend(problem, widest, settings.coarse, settings.tolerance_share, scratch.start, search)
        return cost
    posterior(problem, task, space.ground.numbers[0], blank, scratch, found)
    if found.z.shape[0] == EXTRAS:
        extras_only(epoch_prior, found, search)
    if epoch_prior.cycle_rows.rows[0] > 0.0:
        take_scanned(rig, space.ground, space.scan, found, search.rows)
    oriented = epoch_prior.oriented[0] > 0.0
    found.contrary[0] = contrary(epoch_prior, found.palm, found.z, search) if oriented else 0.0
    return chi_square(rig, observed, found.palm, found.x, 0.0, search)


@inner
def _take_rates(settings: Settings, state: HandState, t_ns: int, shown: Bool, angles: Float) -> None:
    """Follow rates of angles (20,) [rad/s]; of a finger shown again, since last seen."""
    for a in range(20):
        f, before_ns, rate, before = a // 4, state.t_ns[0], state.rates[a], state.angles[a]
        if shown[f] and state.hidden_ns[f] != NEVER_NS:
            before_ns, rate, before = state.hidden_ns[f], state.then_rates[f, a], state.then[f, a]
        since_s = (t_ns - before_ns) * 1e-9
        share = 1.0 - exp(-since_s / settings.rate_memory_s)
        state.rates[a] = rate + share * ((angles[a] - before) / since_s - rate)


@inner
def _begin(state: HandState) -> None:
    """Forget what was measured: it was another hand."""
    state.lost_s[0] = state.speed[0] = 0.0
    for a in range(20):
        state.rates[a] = 0.0
    for f in range(5):
        state.hidden_ns[f] = NEVER_NS
    for part in range(6):
        state.measured_ns[part] = NEVER_NS


@inner
def _take_measured(
    hand: Any, settings: Settings, state: HandState, task: Task, ground: Ground, scan: Any, t_ns: int
) -> None:
    """Follow when, by which level and how surely each part was measured."""
    if task.palm_shown[0] > 0:
        state.measured_ns[PALM_PART] = t_ns
    for f in range(5):
        if ground.shown[f]:
            state.measured_ns[f], state.hidden_ns[f] = t_ns, NEVER_NS
        pip = 6 + hand.first[f] + 2
        pip_open = state.cov[pip, pip] > settings.tracked_pip_rad**2
        if ground.sources[f] > 0:
            state.solver_mode[f], state.vague[f] = 0, f > 0 and pip_open
        elif scan.known[f] > 0.0:
            state.solver_mode[f], state.vague[f] = task.solver_mode[f], task.ambiguous[f] or pip_open


@inner
def _take_rotation(state: HandState, epoch_prior: EpochPrior, search: Search) -> None:
    """Follow the palm's measured rotation.

    Tilt and heading are as this epoch leaves them, so that what is learnt of these is no motion.
    """
    state.measured_rotation_known[0] = epoch_prior.oriented[0] > 0.0
    if state.measured_rotation_known[0] > 0:
        sensed_palm(epoch_prior, state.z, search)
        for i in range(3):
            for j in range(3):
                state.measured_rotation[i, j] = search.palm[i, j]


@kernel
def take_over_epoch(
    model: Model, boxed_state: Any, goes_on: bool, observed: Observations, boxed_space: Any, out: Estimate
) -> None:
    """Write the hand `fit_epoch` found, and the state; not `goes_on`: forget it."""
    rig = Rig(model.hand[0], model.settings[0], model.mounts, model.cameras, model.device[0])
    state, space, settings, task = boxed_state[0], boxed_space[0], rig.settings, boxed_space[0].task
    t_ns, shown, palm_shown = task.t_ns[0], space.ground.shown, task.palm_shown[0] > 0
    found, hidden, scratch, work = space.found, space.hidden, space.cov_scratch, space.scratch.search.rows
    hand, n = rig.hand, found.x.shape[0]
    angles_of(hand, found.x, work)
    clamp(hand, work.angles)
    dt_s = (t_ns - state.t_ns[0]) * 1e-9 if state.t_ns[0] != NEVER_NS else 0.0
    lost = not palm_shown
    if goes_on:
        grow(hand, settings, state, dt_s, found.palm, palm_shown, hidden)
        _take_rates(settings, state, t_ns, shown, work.angles)
        for f in range(5):
            lost = lost or hidden.gone_s[f] > 0.0
    else:
        _begin(state)
    if goes_on and lost:
        now = space.scratch.cov
        copy(found.cov, now)
        only_limits(hand, found.x, hidden, now)
        surer(now, state.cov, scratch, space.scratch.A)
        copy(space.scratch.A, state.cov)
    else:
        copy(found.cov, state.cov)
    chains(hand, found.palm, work)
    joints(hand, found.palm, work, out.position, out.rotation)
    linear(hand, found.palm, state.cov, work, scratch, out.cov)
    tilts(rig, found.palm, found.cov, work, scratch, out.tilt, out.tilt_process_noise)
    if task.second_order[0] > 0:
        information = space.scratch.each[likelier(space.scratch)].information
        add_second_order(rig, found.palm, state.cov, observed.seen, information, work, scratch, out.cov)
    _depth_noise(settings, state, t_ns, space.ground, space.epoch_prior, out)
    state.t_ns[0], state.known[0], state.natural_weight[0] = t_ns, True, found.natural_weight[0]
    copy(found.palm, state.palm)
    since_s = dt_s if goes_on else settings.long_s
    keep_extras(settings, state, since_s, space.epoch_prior, found.z, found.cov, found.scale[0], space.extras)
    _take_rotation(state, space.epoch_prior, space.scratch.search)
    _take_measured(hand, settings, state, task, space.ground, space.scan, t_ns)
    copy(found.palm, out.palm)
    for a in range(20):
        out.angles[a] = state.angles[a] = work.angles[a]
    for c in range(n):
        state.x[c] = found.x[c]
    _judge(rig, state, t_ns, observed, out)
