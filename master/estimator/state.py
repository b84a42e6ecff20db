"""The state is the estimator's only memory; it predicts the next epoch.

A finger that is seen moves by a wide random walk, so that what is seen decides. One that nobody sees moves on
a little the way it was moving, and with its neighbours, whose muscles and nerves it shares (Hager-Ross,
Schieber 2000, "Quantifying the independence of human finger movements"; Ingram, Kording, Howard, Wolpert
2008, "The statistics of natural hand movements"). From there it drifts as a smooth stationary process, whose
steps in a time have the variance (the structure function of a Gaussian correlation)

    drift(t) = DRIFT^2 (1 - exp(-(t / DRIFT_S)^2))

and the steps of two of the four fingers that are k apart correlate by ALIKE^k, which gives the conditional
mean and variance of the hidden ones. A hand that defied it when the marker went moves its fingers one by one,
and so does every hand its thumb. The extra unknowns that other sensors leave open are filtered:

    twist    of the hinges of each finger about its first bone: of the person, all but constant
    bend     of the wrist, flexion and deviation, and their rates: Gauss-Markov of second order (Matern 3/2) about a
             posture kept for a while, stepped exactly (Hartikainen, Saerkkae 2010, "Kalman filtering and smoothing
             solutions to temporal Gaussian process regression models")
    tilt     what the IMU has the vertical off by, for seconds
    heading  walks as far as the IMU's drift is stated
    light    logarithm of the unit of distances by light: of the device and its subject, all but constant

Wrists at work flex by a median of 1.4...54 deg/s about -30...3 deg (43 types of work; Hansson et al. 2009,
Int. J. Ind. Ergonomics 39, 221); daily life takes 5 deg of flexion, 30 of extension, 10 and 15 of deviation
(Palmer et al. 1985, J. Hand Surg. 10A, 39). The errors of an epoch are those of the last, so of the
information that it gains on what is constant only a share counts, as much as is new in that time.
"""

from math import exp, sqrt

import numpy as np

from common.arrays import Bool, Code, Float, Int
from common.hand.model import FINGERS
from common.kernels import constant, inlined, inner
from common.records import array, filled, record
from master.estimator.kinematics import clamp, free_of
from master.estimator.parameters import HandTables
from master.estimator.problem import EpochPrior
from master.estimator.sensors import EXTRAS, HEADING, LED_SCALE, RATE, TILT, WRIST_ANGLES
from master.estimator.settings import Settings
from master.fabrik.linear_algebra import cholesky, copy, inverse, substitute
from master.fabrik.settings import NEVER_NS

_NONE = constant(0)
PALM_PART = len(FINGERS)  # behind the fingers


class HandState:
    """A hand with n free angles as the last epoch left it."""

    t_ns: Int = array(1, kind="i8")  # when
    known: Bool = array(1, kind="u1")  # whether there is a hand
    seen_ns: Int = array(1, kind="i8")  # when anything of it was measured last
    triangulated_ns: Int = array(1, kind="i8")  # when two cameras, or a depth law, placed a marker of it last
    measured_ns: Int = array(6, kind="i8")  # when each finger, and the palm, was measured last
    palm: Float = array(4, 4)
    x: Float = array("n")  # free angles [rad]
    angles: Float = array(20)  # all angles [rad]
    rates: Float = array(20)  # [rad/s]
    cov: Float = array("N", "N")  # of turn [rad], shift [m], rig axes, free angles [rad] and extras
    z: Float = array("K")  # mean of the extras, which are filtered
    z_cov: Float = array("K", "K")
    z_ns: Int = array(1, kind="i8")  # when they were stepped last
    stationary: Float = array("K")  # variances to grow to
    wrist_mean_rad: Float = array(2)  # [rad] the bend of the wrist that is kept
    solver_mode: Code = array(5, kind="u1")  # `SolverMode` last used by the device; 0: markers since
    searched: Int = array(5, kind="i8")  # strobe cycles since the whole cost map of a finger was searched
    vague: Bool = array(5, kind="u1")  # whether that was not well enough to be tracked
    coupling: Float = array(3)  # sums of what was learnt of MCP and PIP (`master.estimator.wrist_update`)
    natural_weight: Float = array(1)  # probability that it follows the posture prior
    speed: Float = array(1)  # [m/s] of the palm
    lost_s: Float = array(1)  # how long nothing measures where it is
    hidden_ns: Int = array(5, kind="i8")  # when a hidden finger was seen last; NEVER_NS: it is seen
    then: Float = array(5, 20)  # the angles of the whole hand at that time
    then_rates: Float = array(5, 20)  # [rad/s]
    then_alike: Float = array(5)  # how neighbours correlated then
    measured_rotation: Float = array(3, 3)  # of the palm by other sensors
    measured_rotation_known: Bool = array(1, kind="u1")


def unknown_hand(**sizes: int) -> HandState:
    """The state before anything is known."""
    state = record(HandState, **sizes)
    never = ("t_ns", "z_ns", "seen_ns", "triangulated_ns", "measured_ns", "hidden_ns")
    return filled(state, **dict.fromkeys(never, NEVER_NS), z_cov=np.eye(sizes["K"]))


class Hidden:
    """Prediction of fingers that nobody sees."""

    angles: Float = array(20)  # [rad]; those of fingers that are seen mean nothing
    sigma: Float = array(20)  # [rad] standard deviations of these
    gone_s: Float = array(5)  # time since they were seen last; 0: seen now
    own: Float = array(5)  # share of the variance of a step that the fingers that are seen do not explain
    x: Float = array("n")  # room
    K: Float = array(4, 4)  # room
    L: Float = array(4, 4)  # room
    weight: Float = array(4)  # room
    ahead: Float = array(20)  # room


@inlined
def growth(settings: Settings, a: int, gone_s: float) -> float:
    """Return the variance [rad^2] of angle a about its course, `gone_s` after."""
    most = settings.growth_rad
    if a < 4:
        most = settings.growth_thumb_rad
    elif a % 4 == 0:
        most = settings.growth_abduction_rad
    return most**2 * (1.0 - exp(-((gone_s / settings.growth_s) ** 2)))


@inner
def _neighbours(settings: Settings, state: HandState, f: int, shown: Bool, hidden: Hidden) -> None:
    """Move the hidden finger f as the seen ones moved since it was lost."""
    count, alike, K, weight = _NONE, state.then_alike[f], hidden.K, hidden.weight
    for g in range(1, 5):
        if not shown[g]:
            continue
        row = 0
        for other in range(1, g + 1):
            if shown[other]:
                K[count, row] = alike ** abs(g - other) if g != other else 1.0
                row += 1
        weight[count] = alike ** abs(f - g)
        count += 1
    if count == 0 or not cholesky(K, count, hidden.L):
        return
    substitute(hidden.L, count, weight)
    count = 0
    for g in range(1, 5):
        if shown[g]:
            for k in range(1, 4):
                moved = state.angles[4 * g + k] - hidden.ahead[4 * g + k]
                hidden.angles[4 * f + k] += weight[count] * moved
            hidden.own[f] -= weight[count] * alike ** abs(f - g)
            count += 1


@inner
def hide(
    hand: HandTables, settings: Settings, state: HandState, t_ns: int, shown: Bool, hidden: Hidden
) -> None:
    """Write the predicted angles of unmeasured fingers; note when each was lost."""
    for a in range(20):
        hidden.angles[a] = state.angles[a]
    for f in range(5):
        hidden.gone_s[f], hidden.own[f] = 0.0, 1.0
        for a in range(4 * f, 4 * f + 4):
            hidden.sigma[a] = settings.held_rad
        if shown[f]:
            continue
        if state.hidden_ns[f] == NEVER_NS:
            state.hidden_ns[f] = state.t_ns[0]
            state.then_alike[f] = settings.alike * state.natural_weight[0]
            for a in range(20):
                state.then[f, a], state.then_rates[f, a] = state.angles[a], state.rates[a]
        gone_s = (t_ns - state.hidden_ns[f]) * 1e-9
        coasted_s = settings.coast_s * (1.0 - exp(-gone_s / settings.coast_s))
        for a in range(20):
            hidden.ahead[a] = state.then[f, a] + state.then_rates[f, a] * coasted_s
        for a in range(4 * f, 4 * f + 4):
            hidden.angles[a] = hidden.ahead[a]
        hidden.gone_s[f] = gone_s
        if f > 0:
            _neighbours(settings, state, f, shown, hidden)
        for a in range(4 * f, 4 * f + 4):
            hidden.sigma[a] = sqrt(settings.held_rad**2 + hidden.own[f] * growth(settings, a, gone_s))
    clamp(hand, hidden.angles)


@inner
def predict(
    hand: HandTables,
    settings: Settings,
    state: HandState,
    t_ns: int,
    shown: Bool,
    hidden: Hidden,
    epoch_prior: EpochPrior,
) -> None:
    """Write the state's prediction to `EpochPrior.past`, `palm` and their weights.

    A hand moved on since anything of it was seen, a hidden finger since that was. What comes back to a hand
    that was seen meanwhile is measured by its marker, not by a hand that is let go for it. `shown` (5,):
    fingers measured now; `state.hidden_ns` and what goes with it are kept up.
    """
    hide(hand, settings, state, t_ns, shown, hidden)
    free_of(hand, hidden.angles, hidden.x)
    age_s = max((t_ns - state.seen_ns[0]) * 1e-9, settings.shortest_s)
    process_noise = 1.0 / (settings.process_noise_rad_s * age_s) ** 2
    for f in range(5):
        for c in range(hand.first[f], hand.first[f + 1]):
            held = 0.0 if shown[f] else 1.0 / hidden.sigma[4 * f + c - hand.first[f]] ** 2
            epoch_prior.past_w2[c] = process_noise + held
            epoch_prior.past[c] = (process_noise * state.x[c] + held * hidden.x[c]) / (process_noise + held)
    rotation_rad_s = settings.palm_process_noise_rad_s if shown[0] else settings.palm_held_rad_s
    for i in range(3):
        epoch_prior.palm_w2[i] = 1.0 / (rotation_rad_s * age_s) ** 2
        epoch_prior.palm_w2[3 + i] = 1.0 / (settings.palm_process_noise_m_s * age_s) ** 2
    copy(state.palm, epoch_prior.palm)


@inner
def grow(
    hand: HandTables,
    settings: Settings,
    state: HandState,
    dt_s: float,
    T: Float,
    palm_shown: bool,
    hidden: Hidden,
) -> None:
    """Add to the covariance what the hand may have done since.

    - a palm or finger that is seen: by as much as the fit lets go of its last pose in that time,
    - a finger that is hidden: by how far hidden fingers drift,
    - a palm without markers: by a turn and a shift that grow with the time it is lost, the shift with its speed, too.
    """
    elapsed_noise_s = max(dt_s, settings.shortest_s)
    rotation2 = (settings.palm_process_noise_rad_s * elapsed_noise_s) ** 2
    shift2 = (settings.palm_process_noise_m_s * elapsed_noise_s) ** 2
    if palm_shown:
        squared = 0.0
        for i in range(3):
            step = T[i, 3] - state.palm[i, 3]
            for j in range(3):
                step += (T[i, j] - state.palm[i, j]) * hand.rest_m[0, j]
            squared += step * step
        state.lost_s[0] = 0.0
        share = 1.0 - exp(-dt_s / settings.speed_memory_s)  # a short step is mostly noise
        state.speed[0] += share * (sqrt(squared) / dt_s - state.speed[0])
    else:
        before = state.lost_s[0]
        state.lost_s[0] = before + dt_s
        longer = state.lost_s[0] ** 2 - before**2
        rotation2 = settings.lost_rotation_rad_s**2 * longer
        shift2 = (settings.lost_shift_m_s + settings.lost_goes_on * state.speed[0]) ** 2 * longer
    for i in range(3):
        state.cov[i, i] += rotation2
        state.cov[3 + i, 3 + i] += shift2
    for f in range(5):
        gone_s = hidden.gone_s[f]
        for c in range(hand.first[f], hand.first[f + 1]):
            added = (settings.process_noise_rad_s * dt_s) ** 2
            if gone_s > 0.0:
                a = 4 * f + c - hand.first[f]
                added = growth(settings, a, gone_s) - growth(settings, a, max(gone_s - dt_s, 0.0))
                added *= hidden.own[f]
            state.cov[6 + c, 6 + c] += added


class ExtrasScratch:
    """Scratch for the extras' steps."""

    M: Float = array("K", "K")
    A: Float = array("K", "K")
    B: Float = array("K", "K")
    L: Float = array("K", "K")


def stationary_of(settings: Settings, *, loose: bool, tilt_rad: float) -> Float:
    """Return the variances (K,) to which the extras grow, the heading's at first.

    `loose`: the wrist may bend; else the palm was calibrated and stands still. `tilt_rad`: of the IMU's
    vertical.
    """
    stationary = np.zeros(EXTRAS)
    stationary[:WRIST_ANGLES] = settings.hinge_rad**2
    stationary[:1] = 1e-6  # a thumb's hinges are no parallel ones
    wrist_angles = np.array(
        [settings.flexion_rad, settings.deviation_rad] if loose else 2 * [settings.calibrated_palm_rad]
    )
    stationary[WRIST_ANGLES : WRIST_ANGLES + 2] = wrist_angles**2
    stationary[RATE : RATE + 2] = (settings.wrist_rate_1_s * wrist_angles) ** 2
    stationary[TILT : TILT + 2] = max(tilt_rad, settings.tilt_least_rad) ** 2
    stationary[HEADING] = np.pi**2 / 3.0
    stationary[LED_SCALE] = settings.led_scale**2
    return stationary


@inlined
def _correlation_time(settings: Settings, i: int) -> float:
    return settings.tilt_s if TILT <= i < TILT + 2 else settings.constant_s


@inner
def predict_extras(
    settings: Settings,
    state: HandState,
    dt_s: float,
    process_noise_rad2: float,
    epoch_prior: EpochPrior,
    scratch: ExtrasScratch,
) -> None:
    """Predict the extras to an epoch, `dt_s` on: state, `EpochPrior.z`, `z_info`."""
    K, z, P, M = state.z.shape[0], state.z, state.z_cov, scratch.M
    if K < EXTRAS:
        epoch_prior.z[0], epoch_prior.z_info[0, 0] = 0.0, 1.0
        return
    away = min(max(dt_s, 0.0), 1e3)
    for i in range(K):
        for j in range(K):
            M[i, j] = 0.0
        M[i, i] = 1.0 if i == HEADING else exp(-away / _correlation_time(settings, i))
    paced = settings.wrist_rate_1_s * away
    decay = exp(-paced)
    for b in range(2):
        at, rate = WRIST_ANGLES + b, RATE + b
        M[at, at], M[at, rate] = (1.0 + paced) * decay, away * decay
        M[rate, at], M[rate, rate] = -(settings.wrist_rate_1_s**2) * away * decay, (1.0 - paced) * decay
        z[at] -= state.wrist_mean_rad[b]
    for i in range(K):
        total = 0.0
        for j in range(K):
            total += M[i, j] * z[j]
            inside = 0.0
            for k in range(K):
                stationary = state.stationary[k] if k == j and k != HEADING else 0.0
                inside += M[i, k] * (P[k, j] - stationary)
            scratch.A[i, j] = inside
        scratch.B[0, i] = total
    for i in range(K):
        z[i] = scratch.B[0, i]
    for i in range(K):
        for j in range(K):
            total = 0.0
            for k in range(K):
                total += scratch.A[i, k] * M[j, k]
            P[i, j] = total
    for i in range(K):
        if i != HEADING:
            P[i, i] += state.stationary[i]
    P[HEADING, HEADING] += process_noise_rad2
    for b in range(2):
        z[WRIST_ANGLES + b] += state.wrist_mean_rad[b]
    for i in range(K):
        epoch_prior.z[i] = z[i]
        for j in range(i + 1):
            scratch.A[i, j] = 0.5 * (P[i, j] + P[j, i])
    if cholesky(scratch.A, K, scratch.L):
        inverse(scratch.L, K, scratch.B, epoch_prior.z_info)
        return
    for i in range(K):  # by rounding: nothing is known
        for j in range(K):
            P[i, j] = state.stationary[i] if i == j else 0.0
            epoch_prior.z_info[i, j] = 1.0 / state.stationary[i] if i == j else 0.0


@inner
def keep_extras(
    settings: Settings,
    state: HandState,
    dt_s: float,
    epoch_prior: EpochPrior,
    z: Float,
    cov: Float,
    scale: float,
    scratch: ExtrasScratch,
) -> None:
    """Take over what an epoch, `dt_s` after the last, leaves of the extras.

    The epoch's own information is what its posterior (z (K,), cov (N, N), scaled by `scale`) has beyond
    `EpochPrior.z_info`; so much of it counts as is new.
    """
    K, P, A, B, new = state.z.shape[0], state.z_cov, scratch.A, scratch.B, scratch.M[0]
    if K < EXTRAS:
        return
    first = cov.shape[0] - K
    for i in range(K):
        # What the palm and what fingers constrain are two blocks: within one, as much is new of everything.
        errs_s = settings.wrist_errs_s if WRIST_ANGLES <= i < LED_SCALE else settings.errs_s
        new[i] = 1.0 - exp(-min(dt_s, settings.long_s) / errs_s)
        for j in range(K):
            A[i, j] = cov[first + i, first + j] / scale
    if not cholesky(A, K, scratch.L):
        return
    inverse(scratch.L, K, B, A)  # the posterior's information
    for i in range(K):
        pull = 0.0
        for j in range(K):
            pull += A[i, j] * (z[j] - epoch_prior.z[j])
        scratch.M[1, i] = new[i] * pull
    for i in range(K):
        for j in range(K):
            gained = A[i, j] - epoch_prior.z_info[i, j]
            B[i, j] = epoch_prior.z_info[i, j] + sqrt(new[i] * new[j]) * gained
    if not cholesky(B, K, scratch.L):
        return
    inverse(scratch.L, K, A, P)
    for i in range(K):
        state.z[i] = epoch_prior.z[i]
        for j in range(K):
            state.z[i] += P[i, j] * scratch.M[1, j]
    share = 1.0 - exp(-min(dt_s, settings.long_s) / settings.wrist_mean_s)
    for b in range(2):
        state.wrist_mean_rad[b] += share * (state.z[WRIST_ANGLES + b] - state.wrist_mean_rad[b])
