"""The mean of a hand within its limits, where the likeliest one leans on them.

A fit ends at the likeliest pose, and of a finger that is poorly known this is often the limit itself: everything
beyond is forbidden, so what lies before it is piled up there. The mean of what is possible lies inside. Near its
solution the posterior is a normal distribution cut by a box, whose moments are found by expectation propagation (Minka
2001; for boxes: Cunningham, Hennig, Lacoste-Julien 2011, "Gaussian probabilities and expectation propagation"): each
limit is stood for by a normal factor that leaves its own angle the mean and variance of the cut distribution.

For hands that are free of the posture prior only: natural ones rest at their limits, as flat ones do.
"""

from math import erfc, exp, inf, pi, sqrt

from common.arrays import Float
from common.kernels import inlined, inner
from common.messages.records import record
from master.estimator.hand_tables import HandTables
from master.estimator.matrices import cholesky, inverse


class Cut:
    """Scratch for the mean within limits, of N unknowns, of which n are angles."""

    weight: Float  # (n,)
    push: Float  # (n,)
    pull: Float  # (N,)
    total: Float  # (N, N)
    L: Float  # (N, N)
    work: Float  # (N, N)
    cov: Float  # (N, N)

    @classmethod
    def empty(cls, n: int, N: int) -> "Cut":
        """Allocate it."""
        return record(cls, weight=n, push=n, pull=N, total=(N, N), L=(N, N), work=(N, N), cov=(N, N))


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
    far = 30.0  # standard deviations, beyond which the normal distribution underflows
    a, b = min(max(a, -far), far), min(max(b, -far), far)
    at_a, at_b = exp(-0.5 * a * a), exp(-0.5 * b * b)
    norm = max(_below(b) - _below(a), 1e-300) * sqrt(2.0 * pi)
    shift = (at_a - at_b) / norm
    left = 1.0 + (a * at_a - b * at_b) / norm - shift * shift
    return middle + sigma * (-shift if flipped else shift), min(max(variance * left, 1e-12), variance)


@inner
def truncated_mean(hand: HandTables, normal: Float, gradient: Float, x: Float, cut: Cut, mean: Float) -> None:
    """Write the step (N,) from the most likely hand to the mean within the limits.

    Straight fingers are no chance: they do rest at their limit, so nothing is piled up there.

    Args:
        hand: Its limits.
        normal: (N, N) normal matrix of the cost at the likeliest hand.
        gradient: (N,) there; counts where the angles stand at a limit, elsewhere it is 0.
        x: (n,) its angles.
        cut: Scratch.
        mean: Written: turn [rad], shift [m] and angles [rad]; the angles stay within the limits.
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
    sweeps, damping = 6, 0.8
    for sweep in range(sweeps + 1):
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
        if sweep == sweeps:
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
            cut.weight[i] += damping * (better - cut.weight[i])
            cut.push[i] += damping * (at / narrow - middle / cavity_variance - cut.push[i])
    for i in range(n):
        below = -inf if hand.at_low_limit[i] else hand.low[i] - x[i]
        mean[6 + i] = min(max(mean[6 + i], below), hand.high[i] - x[i])
