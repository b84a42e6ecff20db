"""Kernels of the filtered extra unknowns that other sensors leave open.

They cover how the extras go on by themselves, and what an epoch leaves.

    twist    of the hinges of each finger about its first bone: of the person, all but constant
    bend     of the wrist, flexion and deviation, and their rates: motion about a posture that somebody keeps for a
             while, a Gauss-Markov process of second order (Matern 3/2), stepped exactly (Hartikainen, Saerkkae 2010,
             "Kalman filtering and smoothing solutions to temporal Gaussian process regression models")
    tilt     what the IMU has the vertical off by, for seconds
    heading  walks as far as the IMU's drift is stated
    light    logarithm of the unit of distances by light: of the device and its subject, all but constant

Wrists at work flex by a median of 1.4...54 deg/s about a median posture of -30...3 deg (43 types of work; Hansson et
al. 2009, Int. J. Ind. Ergonomics 39, 221); most of what hands do daily takes 5 deg of flexion, 30 of extension, 10 and
15 of deviation (Palmer et al. 1985, J. Hand Surg. 10A, 39).

The errors of an epoch are those of the last: shape, skin and hidden fingers hardly change from frame to frame. So of
the information that it gains on what is constant only a share counts, as much as is new in that time.
"""

from math import exp, sqrt

import numpy as np

from common.arrays import Float
from common.kernels import inlined, inner
from common.messages.records import record
from master.estimator.matrices import cholesky, inverse
from master.estimator.problem import EpochPrior
from master.estimator.settings import Settings
from master.estimator.state import HandState
from master.estimator.wrist_device import EXTRAS, HEADING, LED_SCALE, RATE, TILT, WRIST_ANGLES


class ExtrasScratch:
    """Scratch for the extras' steps."""

    M: Float  # (K, K)
    A: Float  # (K, K)
    B: Float  # (K, K)
    L: Float  # (K, K)

    @classmethod
    def empty(cls, extras: int) -> "ExtrasScratch":
        """Allocate it."""
        K = extras
        return record(cls, M=(K, K), A=(K, K), B=(K, K), L=(K, K))


def stationary_of(settings: Settings, *, loose: bool, tilt_rad: float) -> Float:
    """Return the variances (K,) to which the uncertainty grows.

    The heading's is that at the beginning.

    Args:
        settings: Widths.
        loose: Whether the wrist may bend; False: the palm was calibrated and stands still.
        tilt_rad: Of the IMU's vertical.
    """
    stationary = np.zeros(EXTRAS)
    stationary[:WRIST_ANGLES] = settings.hinge_rad**2
    stationary[:1] = 1e-6  # a thumb's hinges are no parallel ones
    wrist_angles = np.array(
        [settings.flexion_rad, settings.deviation_rad] if loose else 2 * [settings.calibrated_palm_rad]
    )
    stationary[WRIST_ANGLES : WRIST_ANGLES + 2] = wrist_angles**2
    stationary[RATE : RATE + 2] = (settings.wrist_rate_1_s * wrist_angles) ** 2
    stationary[TILT : TILT + 2] = max(tilt_rad, 1e-3) ** 2
    stationary[HEADING] = np.pi**2 / 3.0
    stationary[LED_SCALE] = settings.led_scale**2
    return stationary


@inlined
def _correlation_time(settings: Settings, i: int) -> float:
    constant_s = 1e4
    return settings.tilt_s if TILT <= i < TILT + 2 else constant_s


@inner
def predict_extras(
    settings: Settings,
    state: HandState,
    dt_s: float,
    process_noise_rad2: float,
    epoch_prior: EpochPrior,
    scratch: ExtrasScratch,
) -> None:
    """Predict the extras to an epoch, in the state.

    Write `EpochPrior.z` and `z_info`.

    Args:
        settings: Paces.
        state: Changed.
        dt_s: Since they were stepped last.
        process_noise_rad2: Variance of what the heading has drifted in that time.
        epoch_prior, scratch: Written.
    """
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
    """Take over what an epoch leaves of the extras.

    The epoch's own information is what its posterior has beyond `EpochPrior.z_info`; so much of it counts as is new.

    Args:
        settings: How much of it is new.
        state: Changed.
        dt_s: Since the last epoch.
        epoch_prior: The prior of the epoch.
        z: (K,) their mean.
        cov: (N, N) covariance, with theirs last, and `scale` by how much the residual has scaled it.
        room: Scratch.
    """
    K, P, A, B, new = state.z.shape[0], state.z_cov, scratch.A, scratch.B, scratch.M[0]
    if K < EXTRAS:
        return
    first = cov.shape[0] - K
    for i in range(K):
        # What the palm and what fingers constrain are two blocks: within one, as much is new of everything.
        errs_s = settings.wrist_errs_s if WRIST_ANGLES <= i < LED_SCALE else settings.errs_s
        new[i] = 1.0 - exp(-min(dt_s, 10.0) / errs_s)
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
    share = 1.0 - exp(-min(dt_s, 10.0) / settings.wrist_mean_s)
    for b in range(2):
        state.wrist_mean_rad[b] += share * (state.z[WRIST_ANGLES + b] - state.wrist_mean_rad[b])
