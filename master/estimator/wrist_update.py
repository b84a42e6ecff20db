"""Wrist data updates the fingers before the fit, and after it.

A natural MCP is a share of the PIP (`master.estimator.priors`). Each hand has its own share, and keeps to it
more closely or less. Both are learnt from fingers whose tips are seen, by a regression through the origin,

    e = MCP - natural MCP,   share = sum(PIP e) / sum(PIP^2),   spread^2 = sum(e^2) / sum(PIP^2) - share^2,

of expected squares, so that a finger that is hardly known feigns no closeness. The sums begin as if some
fingers of usual hands had been seen, and fade back to that.
"""

from math import exp, inf, sqrt
from typing import Any

from common.arrays import Float
from common.kernels import inner, kernel
from common.messages import SolverMode
from master.estimator.finger_scan import ROWS, Prior, Scan, choose, scan_finger, weigh_hands
from master.estimator.finger_surface import MOVES, look
from master.estimator.kinematics import Scratch, angles_of, clamp, free_of
from master.estimator.parameters import HandTables
from master.estimator.posterior import Ground, Model, Task
from master.estimator.problem import EpochPrior, Rig, Search
from master.estimator.sensors import (
    EXTRAS,
    LED_SCALE,
    WRIST_ANGLES,
    CycleRows,
    flexed_palm,
    loosen,
    loosen_short,
)
from master.estimator.settings import Settings
from master.estimator.solve import Posterior, palm_off, past_gradient
from master.estimator.state import HandState, predict_extras
from master.fabrik.settings import NEVER_NS


@inner
def expect_coupling(settings: Settings, state: HandState, dt_s: float, prior: Prior) -> None:
    """Write the coupling share and spread expected after a time."""
    kept, sums = exp(-dt_s / settings.coupled_s), state.coupling
    for i in range(3):
        sums[i] *= kept
    stationary = settings.coupled_fingers * settings.bent_rad**2
    squared = stationary + sums[0]
    share = sums[1] / squared
    spread2 = (stationary * settings.coupled_spread**2 + sums[2]) / squared - share * share
    prior.coupled_share[0], prior.coupled_spread[0] = share, sqrt(max(spread2, 0.0))


@inner
def learn_coupling(prior: Prior, f: int, scan: Scan, state: HandState) -> None:
    """Add a finger that laser and tip measure unambiguously."""
    pip, pip2, sums = scan.out[f, 2], scan.pip2[f], state.coupling
    off = scan.out[f, 1] - prior.base_rad[f, 1] - prior.per_pip[f, 1] * pip
    way = scan.way[f, 1] - prior.per_pip[f, 1]
    sums[0] += pip * pip + pip2
    sums[1] += pip * off + way * pip2
    sums[2] += off * off + way * way * pip2


_FK, _IK = int(SolverMode.FK), int(SolverMode.IK)


@inner
def _expected(rig: Rig, state: HandState, task: Task, lines: CycleRows, scan: Scan, prior: Prior) -> None:
    """Write the fingers' prior before a strobe cycle; bring its rows to the epoch."""
    settings = rig.settings
    dt_s = (task.t_ns[0] - state.t_ns[0]) * 1e-9
    measured_lately = task.continuous[0] > 0 and state.known[0] > 0 and 0.0 < dt_s <= settings.forget_s
    prior.light[0], prior.light2[0] = state.z[LED_SCALE], state.z_cov[LED_SCALE, LED_SCALE]
    for f in range(5):
        prior.twist[f], prior.twist2[f] = state.z[f], max(state.z_cov[f, f], 1e-8)
        age_s = (task.t_ns[0] - state.measured_ns[f]) * 1e-9
        had_previous = measured_lately and age_s <= settings.forget_s
        prior.had_previous[f] = 1.0 if had_previous else 0.0
        well = state.solver_mode[f] > 0 and state.vague[f] == 0
        known = had_previous and well and age_s <= settings.tracked_cycle_s
        state.searched[f] = state.searched[f] + 1 if known else 0
        known = known and state.searched[f] % settings.search_again != 0
        prior.window_rad[f] = settings.window_rad if known else 0.0
        for k in range(4 * f, 4 * f + 4):
            scan.angles[k] = settings.curled_rad  # somewhere
            if had_previous:
                scan.angles[k] = state.angles[k]
        prior.last[f] = scan.angles[4 * f + 2]
        prior.process_noise[f] = max(settings.process_noise_rad_s * age_s, settings.goes_on_rad)
        if lines.lit[f] == 0.0 and lines.shown[f] == 0.0:
            continue
        look(rig.hand, rig.device, prior.palm, prior.wrist_axes, scan.angles, f, MOVES, scan.surface)
        J = scan.surface.J
        loosen(lines.laser_W[f], J, 0, state.z_cov)
        loosen(lines.tip_W[f], J, 2, state.z_cov)
        if not had_previous:
            continue
        for k in range(4):
            rate = state.rates[4 * f + k]
            for i in range(2):
                lines.laser[f, i] -= J[i, k] * rate * lines.laser_s[0]
                lines.tip[f, i] -= J[2 + i, k] * rate * lines.tip_s[0]
            lines.depth[f] -= J[4, k] * rate * lines.tip_s[0]


@kernel
def prepare_epoch(model: Model, boxed_state: Any, boxed_space: Any) -> None:
    """Step the extras to an epoch; search the minima of fingers a wrist device sees.

    What no pose explains is no row: a fingertip that is another thing, a laser point on one. The rows that
    are left are counted.
    """
    rig = Rig(model.hand[0], model.settings[0], model.mounts, model.cameras, model.device[0])
    state, space, settings = boxed_state[0], boxed_space[0], rig.settings
    task, epoch_prior, scan, prior = space.task, space.epoch_prior, space.scan, space.prior
    lines, z = epoch_prior.cycle_rows, state.z
    dt_s = 0.0 if state.z_ns[0] == NEVER_NS else (task.t_ns[0] - state.z_ns[0]) * 1e-9
    predict_extras(settings, state, dt_s, task.process_noise_rad2[0], epoch_prior, space.extras)
    state.z_ns[0] = task.t_ns[0]
    for i in range(z.shape[0]):
        space.scratch.start.z[i] = z[i]
    for f in range(5):
        scan.known[f] = lines.teaches[f] = 0.0
        task.refused[f] = task.off[f] = task.ambiguous[f] = False
        task.solver_mode[f] = 0
    if z.shape[0] < EXTRAS or lines.rows[0] == 0.0:
        return
    flexed_palm(rig.device.palm, z[WRIST_ANGLES], z[WRIST_ANGLES + 1], prior.palm, prior.wrist_axes)
    _expected(rig, state, task, lines, scan, prior)
    expect_coupling(settings, state, max(dt_s, 0.0), prior)
    for f in range(5):
        if lines.lit[f] == 0.0:
            if prior.had_previous[f] == 0.0:
                lines.shown[f] = 0.0
            continue
        _scan(rig, lines, prior, f, scan, task)
    weigh_hands(rig, lines, prior, scan)
    for f in range(5):
        if scan.known[f] > 0.0:
            _choose(rig, lines, prior, f, scan, task, state)
    _count(lines, space.ground)


@inner
def _scan(rig: Rig, lines: CycleRows, prior: Prior, f: int, scan: Scan, task: Task) -> None:
    """Search the minima of a lit finger; drop rows that no pose explains."""
    settings = rig.settings
    scan_finger(rig, lines, prior, f, scan)
    if loosen_short(rig.device, lines, f, _length_px(scan, f), scan.g[:3], scan.H[:2, :2]):
        scan_finger(rig, lines, prior, f, scan)
    if prior.window_rad[f] > 0.0 and scan.chi2[f] > settings.refused:
        prior.window_rad[f] = 0.0
        scan_finger(rig, lines, prior, f, scan)
    if scan.chi2[f] > settings.refused and lines.depth_w2[f] > 0.0:
        # a tip may shine, or lie in shade: what it is off then is its light
        lines.depth_w2[f] = 0.0
        scan_finger(rig, lines, prior, f, scan)
    gate = settings.refused if lines.depth_w2[f] > 0.0 else settings.refused_unlit
    if scan.chi2[f] > gate and lines.shown[f] > 0.0:
        task.refused[f], lines.shown[f] = True, 0.0
        scan_finger(rig, lines, prior, f, scan)
    if scan.chi2[f] > settings.refused:
        task.off[f], lines.lit[f], scan.known[f] = True, 0.0, 0.0


@inner
def _choose(
    rig: Rig, lines: CycleRows, prior: Prior, f: int, scan: Scan, task: Task, state: HandState
) -> None:
    """Choose a pose of a scanned finger; note what it teaches."""
    settings, shown = rig.settings, lines.shown[f] > 0.0
    choose(rig, lines, prior, f, scan)
    for k in range(4):
        task.scanned[4 * f + k] = scan.mode[f, k]
    task.solver_mode[f] = _IK if shown else _FK
    curled = f > 0 and scan.out[f, 2] > settings.branch_rad
    task.ambiguous[f] = scan.parts[f] > 1.0 or (curled and not shown)
    # The unit of light is learnt a little at a time, and nothing of a finger that is ambiguous.
    excluded = task.ambiguous[f] or scan.chi2[f] > settings.teaching_gate
    lines.teaches[f] = 1.0 if shown and not excluded else 0.0
    lines.depth_w2[f] *= 0.0 if excluded else settings.light_share
    if f > 0 and not curled and lines.teaches[f] > 0.0:
        learn_coupling(prior, f, scan, state)


@inner
def _length_px(scan: Scan, f: int) -> float:
    """Length of the laser's line at the best node of a finger."""
    least, best = inf, scan.first[f]
    for node in range(scan.first[f], scan.last[f] + 1):
        total = 0.0
        for i in range(ROWS):
            total += scan.rows[f, node, i] ** 2
        if total < least:
            least, best = total, node
    return float(scan.length_px[f, best])


@inner
def _count(lines: CycleRows, ground: Ground) -> None:
    """Count the rows of a wrist device; tips without laser points count for nothing."""
    lit, shown = 0, 0
    for f in range(5):
        shown += 1 if lines.shown[f] > 0.0 else 0
        if lines.lit[f] > 0.0:
            lit += 1
            ground.shown[f] = True
    if lit > 0:
        ground.numbers[0] += 2.0 * (lit + shown)


@inner
def start_scanned(hand: HandTables, scan: Scan, scanned: Float, x: Float, out: Float) -> None:
    """Write the free angles (n,) of scanned fingers from angles (20,)."""
    free_of(hand, scanned, x)
    for f in range(5):
        if scan.known[f] > 0.0:
            for c in range(hand.first[f], hand.first[f + 1]):
                out[c] = x[c]


@inner
def extras_only(epoch_prior: EpochPrior, found: Posterior, search: Search) -> None:
    """Move the extras to their estimate from this epoch alone.

    At the solution the pull of the past is that of the epoch, reversed: a Newton step, by the epoch's
    covariance, without it.
    """
    n, K, off = found.x.shape[0], found.z.shape[0], search.off
    palm_off(found.palm, epoch_prior.palm, off)
    past_gradient(epoch_prior, off, search.step)
    for i in range(n):
        search.step[6 + i] = epoch_prior.past_w2[i] * (found.x[i] - epoch_prior.past[i])
    for k in range(K):
        total = 0.0
        for j in range(6 + n):
            total += found.cov[6 + n + k, j] * search.step[j]
        found.z[k] += total / found.scale[0]


@inner
def take_scanned(rig: Rig, ground: Ground, scan: Scan, found: Posterior, work: Scratch) -> None:
    """Take fingers without markers from their minima: median, covariance of all.

    What the others know of the finger beside its PIP is in the fit's covariance given the PIP.
    """
    hand, cov = rig.hand, found.cov
    angles_of(hand, found.x, work)
    for f in range(5):
        if scan.known[f] > 0.0 and ground.sources[f] == 0:
            for k in range(4):
                work.angles[4 * f + k] = scan.out[f, k]
    clamp(hand, work.angles)
    free_of(hand, work.angles, found.x)
    for f in range(5):
        if scan.known[f] == 0.0 or ground.sources[f] > 0:
            continue
        first, count = 6 + hand.first[f], hand.first[f + 1] - hand.first[f]
        pip, N = first + 2, cov.shape[0]
        was = cov[pip, pip]
        for i in range(N):
            work_i = cov[i, pip] / was
            if first <= i < first + count:
                continue
            for c in range(count):  # with the rest of the hand it varies as its PIP does
                cov[i, first + c] = cov[first + c, i] = work_i * scan.way[f, c] * min(was, scan.pip2[f])
        for c in range(count):
            for d in range(c + 1):
                if c == 2 or d == 2:
                    continue
                given = cov[first + c, first + d] - cov[first + c, pip] * cov[first + d, pip] / was
                cov[first + c, first + d] = given + scan.pip2[f] * scan.way[f, c] * scan.way[f, d]
                cov[first + d, first + c] = cov[first + c, first + d]
        for c in range(count):
            cov[first + c, pip] = cov[pip, first + c] = scan.pip2[f] * scan.way[f, c]
