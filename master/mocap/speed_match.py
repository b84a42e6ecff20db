"""Time offset between two clocks, by the speeds of the same points.

No rotation and no shift changes a speed.

Normalised cross-correlation, samples that are missing masked (Padfield, "Masked object registration in the Fourier
domain", IEEE Trans. Image Process. 21, 2012).
"""

import numpy as np
from scipy import signal

from common.arrays import Float
from common.errors import FitError
from master.mocap.track import Track

HALF_NS = 20_000_000
"""Half of the time over which a speed is a difference."""
_STEP_NS = 10_000_000


def clock_offset(ours: Track, theirs: Track) -> tuple[int, float, float]:
    """Return our time less theirs [ns] and the correlation of speeds.

    The third value is how much later an alternative offset is [s], NaN: none.

    Raises:
        FitError: The speeds do not agree anywhere.
    """
    a, first_a = _speeds(ours)
    b, first_b = _speeds(theirs)
    half = 0.5 * min(np.isfinite(a).sum(), np.isfinite(b).sum())
    least_s = 2.0  # that both must show together
    together = min(len(a), len(b), max(least_s * 1e9 / _STEP_NS, half))
    score = _masked_correlation(a, b, together)
    best = int(np.argmax(score))
    correlated = 0.5
    if not score[best] > correlated:
        raise FitError(
            f"the speeds of poses and motion capture agree nowhere (correlation {max(score[best], 0.0):.2f} at best, of"
            f" {together * _STEP_NS * 1e-9:.1f} s or more together): the same hand at the same time? Where both have"
            " one clock and one frame, give --aligned"
        )
    inner = score[best - 1 : best + 2]
    shift = 0.0
    if 0 < best < len(score) - 1 and np.isfinite(inner).all():
        curvature = inner[0] - 2.0 * inner[1] + inner[2]
        shift = 0.5 * (inner[0] - inner[2]) / curvature if curvature < 0.0 else 0.0
    lags = np.arange(len(score)) - best
    alternative, apart_ns = 0.9, 500_000_000  # a second peak that counts
    far = np.where(np.abs(lags) * _STEP_NS > apart_ns, score, -1.0)
    second = int(np.argmax(far))
    alternative_s = (
        (second - best) * _STEP_NS * 1e-9 if far[second] > alternative * score[best] else float("nan")
    )
    lag = best + shift - (len(b) - 1)
    return round(first_a - first_b + lag * _STEP_NS), float(score[best]), alternative_s


def _speeds(track: Track) -> tuple[Float, int]:
    """Return the mean speed of the points (K,) [m/s] and the first time [ns].

    Steps are 10 ms; NaN: not known.
    """
    count = int((track.t_ns[-1] - track.t_ns[0]) // _STEP_NS) + 1 if len(track.t_ns) else 0
    most_steps = 400_000  # 67 minutes
    if count > most_steps:
        raise FitError(
            f"{count * _STEP_NS * 6e-11:.0f} minutes are too long to align: take a part, --from and --until"
        )
    t_ns = track.t_ns[0] + _STEP_NS * np.arange(count) if count else np.zeros(0, np.int64)
    speed = np.linalg.norm(track.velocity(t_ns, HALF_NS), axis=2)
    known = np.isfinite(speed)
    total = np.where(known, speed, 0.0).sum(axis=1)
    some = known.any(axis=1)
    if not some.any():
        raise FitError("no point is seen for two frames in a row: nothing to align by")
    return np.where(some, total / np.maximum(known.sum(axis=1), 1), np.nan), int(t_ns[0])


def _masked_correlation(a: Float, b: Float, together: float) -> Float:
    """Return the correlation of `a` and shifted `b` for each lag.

    Lags are those of `scipy.signal.correlate`; -1: too little shared.
    """
    known_a, known_b = np.isfinite(a).astype(np.float64), np.isfinite(b).astype(np.float64)
    a = np.where(known_a > 0.0, a - np.nanmean(a), 0.0)
    b = np.where(known_b > 0.0, b - np.nanmean(b), 0.0)

    def of(first: Float, second: Float) -> Float:
        return np.asarray(signal.correlate(first, second, mode="full", method="fft"), np.float64)

    count = np.maximum(of(known_a, known_b), 1.0)
    sum_a, sum_b = of(a, known_b), of(known_a, b)
    variance_a = of(a * a, known_b) - sum_a**2 / count
    variance_b = of(known_a, b * b) - sum_b**2 / count
    least = 1e-9 * max(float((a * a).sum()), float((b * b).sum()), 1e-12)
    good = (count > together - 0.5) & (variance_a > least) & (variance_b > least)
    spread = np.sqrt(np.where(good, variance_a * variance_b, 1.0))
    return np.where(good, (of(a, b) - sum_a * sum_b / count) / spread, -1.0)
