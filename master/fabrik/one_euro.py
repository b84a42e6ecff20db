"""The 1 € filter smooths signals by their speed and measured noise.

Casiez, Roussel, Vogel, "1 € Filter", CHI 2012. A low pass whose cut-off rises with speed. Per signal, with x^
the filtered value and dt the time since the signal was last seen:

    dx^ += a(d_cutoff) ((x - x^) / dt - dx^)               against the previous *filtered* value
    x^  += a(min_cutoff + beta |dx^|) (x - x^)             a(f) = r / (r + 1),  r = 2 pi f dt

Beside the paper: NaN = not observed, the output is NaN and the state is held; a signal that returns continues
with the true dt, after more than `restart_gap_s` it restarts; a time that is not after the last one changes
nothing: the last output is returned and `late` counts it. Signals of one group have the cut-off of the
fastest of them, so that errors that cancel, as those of place and rotation of one body do, stay together.

A sample may come with the variance s^2 of its noise. Where s is above `jitter`, it is taken with no more than
the larger of

    at rest     a = 2 q / (1 + q),  q = (jitter / s)^2           which leaves `jitter` of the noise: s^2 a / (2 - a)
    in motion   a = 2 / (1 + sqrt(1 + 4 / u^2)),  u^2 = max((v dt / s)^2, ((x - x^) / s)^2 - 9)

the second of which is the gain of the steady Kalman filter of a random walk with steps of u s (Kalman 1960).
v is the speed beyond what noise alone makes of it, at three standard deviations: white noise of s leaves s^2
/ dt^2 a / (2 - a) in dx^ squared, with a = a(d_cutoff). Give variances with room: noise passes three standard
deviations once in 370 samples, and what that lets in takes long to fade where s is many times `jitter`.

The noise is measured by second differences: of steps dt, k dt and noise s that is new in every sample their
variance is 2 (1 + k + k^2) s^2 where the first is scaled by k. Of noise that keeps a share p from sample to
sample they show only 1 - 4/3 p + p^2 / 3.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, isfinite, isnan, nan, pi

import numpy as np

from common.arrays import Float, Int
from common.calibration import FilterCalibration
from common.kernels import bound, kernel
from master.fabrik.settings import FILTER, NEVER_NS


@dataclass(frozen=True, slots=True)
class OneEuroParameters:
    """Settings of the filter, the same for all its signals."""

    min_cutoff_hz: float  # at rest; lower: less jitter
    beta: float  # cut-off per speed [Hz per (unit of the signal)/s]; higher: less lag
    d_cutoff_hz: float  # of the speed estimate
    restart_gap_s: float = 0.5  # a signal unseen for longer restarts from its next value
    jitter: float = inf  # noise that may be left at rest where it is known, standard deviation [unit]

    def __post_init__(self) -> None:
        for name in ("min_cutoff_hz", "d_cutoff_hz", "restart_gap_s"):
            value: float = getattr(self, name)
            if not (isfinite(value) and value > 0.0):
                raise ValueError(f"1 € filter: {name} must be positive and finite, not {value}")
        if not (isfinite(self.beta) and self.beta >= 0.0):
            raise ValueError(f"1 € filter: beta must be finite and not negative, not {self.beta}")
        if not self.jitter > 0.0:
            raise ValueError(f"1 € filter: jitter must be positive, not {self.jitter}")

    @classmethod
    def of(cls, settings: FilterCalibration) -> "OneEuroParameters":
        """Return the filter parameters of a rig file [Hz, m, s]."""
        return cls(settings.min_cutoff_hz, settings.beta, settings.d_cutoff_hz, jitter=settings.jitter_m)

    def array(self) -> Float:
        """The settings (5,) as `filter_step` takes them."""
        rates = (self.min_cutoff_hz, self.beta, self.d_cutoff_hz)
        return np.array([*rates, self.restart_gap_s, self.jitter**2])


class OneEuro:
    """Push machine; holds each signal's filtered value, speed and last time."""

    def __init__(self, parameters: OneEuroParameters, groups: Sequence[int] | None = None) -> None:
        """Set up; `groups`: number of signals of each, in order; None: each is its own."""
        self.parameters = parameters
        self.late = 0
        self._groups = groups
        self._t_ns: int | None = None
        self._settings = parameters.array()
        self._shape: tuple[int, ...] = ()
        self._unknown = self._x = self._speed = self._last = np.empty(0)
        self._seen_ns: Int = np.empty(0, np.int64)
        self._group: Int = np.empty(0, np.int64)
        self._fastest = np.empty((0, 2))
        none = self._x
        state = self._fastest, none, none, self._seen_ns, none
        # compiles it here, so that no sample waits for that
        self._step = bound(filter_step, 0, none, none, self._settings, self._group, *state)

    def push(self, t_ns: int, values: Float, variance: Float | None = None) -> Float:
        """Filter one sample of every signal; NaN where the input is.

        Args:
            t_ns: Time of the sample [ns]; 0 is a time like any other.
            values: Any shape, the same at every push. NaN: not seen.
            variance: Variances of their noise that is new in each sample, same shape; NaN or None: not known.

        Raises:
            ValueError: The shape differs from the first push, or is not that of the groups or variances.
        """
        if values.shape != self._shape or self._t_ns is None:
            self._first(values)
        elif t_ns <= self._t_ns:
            self.late += 1
            return self._last.reshape(self._shape).copy()
        # Writable copies (n,) are the one type that the kernel is bound to.
        signals = np.array(values, np.float64, order="C").reshape(-1)
        noise = self._unknown if variance is None else np.array(variance, np.float64, order="C").reshape(-1)
        if len(noise) != len(self._x):
            raise ValueError(f"1 € filter: {len(noise)} variances for {len(self._x)} signals")
        self._t_ns, self._last = t_ns, np.empty(len(signals))
        state = self._fastest, self._x, self._speed, self._seen_ns, self._last
        self._step(t_ns, signals, noise, self._settings, self._group, *state)
        return self._last.reshape(self._shape).copy()

    def _first(self, values: Float) -> None:
        if self._t_ns is not None:
            raise ValueError(f"1 € filter: shape was {self._shape}, now {values.shape}: use a new filter")
        n = values.size
        sizes = np.ones(n, np.int64) if self._groups is None else np.asarray(self._groups, np.int64)
        if sizes.sum() != n:
            raise ValueError(f"1 € filter: groups of {sizes.tolist()} signals, but {n} came")
        self._shape = values.shape
        self._group = np.repeat(np.arange(len(sizes)), sizes)
        self._fastest = np.zeros((len(sizes), 2))
        self._x, self._speed, self._unknown = np.zeros(n), np.zeros(n), np.full(n, nan)
        self._seen_ns = np.full(n, NEVER_NS)


class PointFilter:
    """Push machine for points in space, filtered along the axes of the view.

    A point from two cameras is several times less sure along the sight than across it: one cut-off for both
    either trembles in depth or lags sideways.
    """

    def __init__(self, parameters: OneEuroParameters, R_view_rig: Float) -> None:
        """Set up, parameters in [m, s], `jitter` per axis.

        `R_view_rig` (3, 3): rows are the axes of the view in the rig frame, the last along the sight.
        """
        self._filter = OneEuro(parameters)
        self._R = R_view_rig

    def push(self, t_ns: int, points: Float, cov: Float) -> Float:
        """Filter points (M, 3) [m] of noise cov (M, 3, 3), rig frame, as `OneEuro.push`."""
        variance = np.vecdot(self._R @ cov, self._R)  # of each coordinate: the diagonal of R cov R'
        return self._filter.push(t_ns, points @ self._R.T, FILTER.new_share * variance) @ self._R


@kernel
def filter_step(
    t_ns: int,
    values: Float,
    variance: Float,
    settings: Float,
    group: Int,
    fastest: Float,
    x: Float,
    speed: Float,
    seen_ns: Int,
    out: Float,
) -> None:
    """Filter one sample of N signals into `out`, later than the last.

    `settings` (5,) as of `OneEuroParameters.array`, `group` (N,), state `x`, `speed`, `seen_ns` (N,),
    changed; `fastest` (G, 2) scratch: speed of each group, and the largest u squared.
    """
    min_cutoff, beta, d_cutoff, restart_gap, jitter_2 = settings
    fastest[:] = 0.0
    for i in range(len(values)):
        out[i] = nan
        if not isfinite(values[i]):
            continue
        dt = 1e-9 * (t_ns - seen_ns[i]) if seen_ns[i] != NEVER_NS else inf
        if dt > restart_gap:
            x[i], speed[i], seen_ns[i] = values[i], 0.0, t_ns
            out[i] = values[i]
            continue
        r = 2.0 * pi * d_cutoff * dt
        speed[i] += r / (r + 1.0) * ((values[i] - x[i]) / dt - speed[i])
        fastest[group[i], 0] = max(fastest[group[i], 0], abs(speed[i]))
        if variance[i] > jitter_2:
            moved_2 = speed[i] * speed[i] * dt * dt - FILTER.quantile * r / (2.0 + r) * variance[i]
            off = values[i] - x[i]
            u2 = max(moved_2, off * off - FILTER.quantile * variance[i]) / variance[i]
            fastest[group[i], 1] = max(fastest[group[i], 1], u2)
    for i in range(len(values)):
        if seen_ns[i] == t_ns or not isfinite(values[i]):
            continue
        r = 2.0 * pi * 1e-9 * (t_ns - seen_ns[i]) * (min_cutoff + beta * fastest[group[i], 0])
        gain = r / (r + 1.0)
        if variance[i] > jitter_2:
            q = jitter_2 / variance[i]
            gain = min(gain, max(2.0 * q / (1.0 + q), _gain_in_motion(fastest[group[i], 1])))
        x[i] += gain * (values[i] - x[i])
        seen_ns[i] = t_ns
        out[i] = x[i]


@kernel
def _gain_in_motion(u2: float) -> float:
    """Gain of the steady Kalman filter of a random walk; u2: step by noise variance."""
    return 2.0 / (1.0 + (1.0 + 4.0 / u2) ** 0.5) if u2 > 0.0 else 0.0


class NoiseEstimator:
    """Push machine. Holds the last sample and step, and the variance of each signal."""

    def __init__(self) -> None:
        """Nothing is known yet: the noise counts as none."""
        self._count, self._dt_s = np.zeros(2, np.int64), np.zeros(1)
        self._past = np.empty((3, 0))

    def push(self, t_ns: int, values: Float, largest: Float) -> Float:
        """Variances (n,) of the noise of one sample, as those before it show.

        `largest` (n,): variances that their noise may have, for what is more is acceleration; NaN: not known.
        """
        if self._count[0] == 0:
            self._past = np.zeros((3, len(values)))
        known = np.empty(len(values))
        measure(t_ns, values, largest, self._count, self._dt_s, self._past, known)
        return known


@kernel
def measure(
    t_ns: int, values: Float, largest: Float, count: Int, dt_s: Float, past: Float, known: Float
) -> None:
    """Write the variances (n,) of the noise of one sample, and take it in.

    State: `count` (2,) samples, time of the last [ns]; `dt_s` (1,) length of the last step; `past` (3, n)
    last sample and step, and variance that shows.
    """
    passed_s = 1e-9 * (t_ns - count[1])
    ratio = passed_s / dt_s[0] if count[0] > 1 else 0.0
    for i in range(values.shape[0]):
        step, variance = values[i] - past[0, i], past[2, i]
        smaller = largest[i] < variance or isnan(variance)
        known[i] = (largest[i] if smaller else variance) / FILTER.shown
        if count[0] > 1:
            off = step - ratio * past[1, i]
            shown = off * off / (2.0 * (1.0 + ratio + ratio * ratio))
            past[2, i] += passed_s / (FILTER.memory_s + passed_s) * (shown - variance)
        past[0, i], past[1, i] = values[i], step
    dt_s[0] = passed_s
    count[0], count[1] = count[0] + 1, t_ns
