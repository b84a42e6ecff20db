"""Smooths noisy positions as they arrive: the 1 € filter for many signals at once.

Casiez, Roussel, Vogel, "1 € Filter", CHI 2012. A low pass whose cut-off rises with speed, so that a hand
at rest does not tremble and a fast one does not lag. Per signal, with x^ the filtered value and dt the time
since the signal was last seen:

    dx   = (x - x^) / dt                                   against the previous *filtered* value
    dx^ += a(d_cutoff) (dx - dx^)
    x^  += a(min_cutoff + beta |dx^|) (x - x^)             a(f) = r / (r + 1),  r = 2 pi f dt

Rules beside the paper's:
- Not finite (NaN) = not observed: the output of that signal is NaN, its state is held, the others go on.
- A signal that returns continues with the true dt since it was last seen, so that a stale state fades by
  itself; after more than `restart_gap_s` it restarts from that value, as a new signal does.
- A time that is not after the last one changes nothing: the last output is returned and `late` counts it.

`PointFilter` filters 3D points whose noise is known, different along each axis and from sample to sample. A point from
two cameras is several times less sure along the sight than across it; one cut-off for both either trembles in depth or
lags sideways. So each axis of the view is filtered by itself, with the paper's gain as the most it may have. Of a
sample with standard deviation s it takes no more than

    at rest     a = 2 q / (1 + q),  q = (jitter / s)^2           which leaves `jitter` of the noise: s^2 a / (2 - a)
    in motion   a = c / (1 + c),    c = (4 u^2)^(1/3),  u = v dt / s   which balances lag v dt / a and noise s sqrt(a/2)

whichever is more. v is the speed beyond what noise alone makes of it. Where the noise is small, sideways and near by,
this is the paper's filter; a sample far less sure than its neighbours is ridden over.

Plain lists, not arrays: for 18 signals a numpy step costs more than the whole loop.
"""

from dataclasses import dataclass
from math import isfinite, pi

import numpy as np

from common.arrays import Float

_NAN = float("nan")
# Part of the variance of a marker's noise that is new in each frame: about 0.1 on rendered hands, here with room. The
# rest is light and shape, which stay.
_FRESH = 0.25
_BEYOND = 4.0  # times its variance, a speed is no noise: two standard deviations


@dataclass(frozen=True, slots=True)
class OneEuroParameters:
    """Settings of the filter, the same for all its signals.

    Attributes:
        min_cutoff_hz: Cut-off at rest; lower: less jitter.
        beta: Cut-off per speed [Hz per (unit of the signal)/s]; higher: less lag.
        d_cutoff_hz: Cut-off of the speed estimate.
        restart_gap_s: A signal unseen for longer restarts from its next value.
    """

    min_cutoff_hz: float = 1.0
    beta: float = 0.1
    d_cutoff_hz: float = 1.0
    restart_gap_s: float = 0.5

    def __post_init__(self) -> None:
        for name in ("min_cutoff_hz", "d_cutoff_hz", "restart_gap_s"):
            value: float = getattr(self, name)
            if not (isfinite(value) and value > 0.0):
                raise ValueError(f"1 € filter: {name} must be positive and finite, not {value}")
        if not (isfinite(self.beta) and self.beta >= 0.0):
            raise ValueError(f"1 € filter: beta must be finite and not negative, not {self.beta}")


class OneEuro:
    """Push machine; holds each signal's filtered value, its speed and when it was last seen."""

    def __init__(
        self, min_cutoff_hz: float, beta: float, d_cutoff_hz: float = 1.0, restart_gap_s: float = 0.5
    ) -> None:
        """Set up by numbers, see `OneEuroParameters`.

        Raises:
            ValueError: A parameter is out of range.
        """
        self.parameters = OneEuroParameters(min_cutoff_hz, beta, d_cutoff_hz, restart_gap_s)
        self.late = 0
        self._t_ns: int | None = None
        self._shape: tuple[int, ...] = ()
        self._x: list[float] = []
        self._speed: list[float] = []
        self._seen_ns: list[int | None] = []
        self._in_step = False  # all signals were seen at _t_ns: one dt serves all
        self._last: list[float] = []

    @classmethod
    def of(cls, parameters: OneEuroParameters) -> "OneEuro":
        """Set up from a parameter set."""
        return cls(
            parameters.min_cutoff_hz, parameters.beta, parameters.d_cutoff_hz, parameters.restart_gap_s
        )

    def push(self, t_ns: int, values: Float) -> Float:
        """Filter one sample of every signal.

        Args:
            t_ns: Time of the sample [ns]; 0 is a time like any other.
            values: Any shape, the same at every push. NaN: not seen.

        Returns:
            Filtered values, same shape; NaN where the input is.

        Raises:
            ValueError: The shape differs from the first push.
        """
        if values.shape != self._shape or self._t_ns is None:
            self._first(values)
        x: list[float] = values.ravel().tolist()
        if self._t_ns is not None and t_ns <= self._t_ns:
            self.late += 1
            return np.array(self._last).reshape(self._shape)
        total = sum(x)
        # total - total is 0 only if every value is finite
        if self._in_step and self._t_ns is not None and total - total == 0.0:
            dt = (t_ns - self._t_ns) * 1e-9
            out = self._step_all(x, dt) if dt <= self.parameters.restart_gap_s else self._step_each(x, t_ns)
        else:
            out = self._step_each(x, t_ns)
        self._t_ns = t_ns
        self._last = out
        return np.array(out).reshape(self._shape)

    def _first(self, values: Float) -> None:
        if self._t_ns is not None:
            raise ValueError(f"1 € filter: shape was {self._shape}, now {values.shape}: use a new filter")
        n = values.size
        self._shape = values.shape
        self._x = [0.0] * n
        self._speed = [0.0] * n
        self._seen_ns = [None] * n

    def _step_all(self, x: list[float], dt: float) -> list[float]:
        """The common case: every signal is here, and was here last time."""
        p = self.parameters
        turn = 2.0 * pi * dt
        base, gain = turn * p.min_cutoff_hz, turn * p.beta
        r = turn * p.d_cutoff_hz
        a_speed = r / (r + 1.0)
        inverse_dt = 1.0 / dt
        state, speed = self._x, self._speed
        out: list[float] = []
        new_speed: list[float] = []
        for value, held, v in zip(x, state, speed, strict=True):
            change = value - held
            v += a_speed * (change * inverse_dt - v)
            r = base + gain * (v if v >= 0.0 else -v)
            new_speed.append(v)
            out.append(held + change * r / (r + 1.0))
        self._x, self._speed = out, new_speed
        return out

    def _step_each(self, x: list[float], t_ns: int) -> list[float]:
        """Signals that come and go: each with its own dt."""
        self._catch_up()
        p = self.parameters
        state, speed, seen = self._x.copy(), self._speed, self._seen_ns
        out: list[float] = []
        for i, value in enumerate(x):
            if not isfinite(value):
                out.append(_NAN)
                continue
            last = seen[i]
            seen[i] = t_ns
            if last is None or (t_ns - last) * 1e-9 > p.restart_gap_s:
                state[i], speed[i] = value, 0.0
            else:
                turn = 2.0 * pi * 1e-9 * (t_ns - last)
                r = turn * p.d_cutoff_hz
                change = value - state[i]
                speed[i] += r / (r + 1.0) * (change * 1e9 / (t_ns - last) - speed[i])
                r = turn * (p.min_cutoff_hz + p.beta * abs(speed[i]))
                state[i] += change * self._gain(i, r / (r + 1.0), speed[i], 1e-9 * (t_ns - last))
            out.append(state[i])
        self._x = state
        self._in_step = all(s == t_ns for s in seen)
        return out

    def _gain(self, i: int, gain: float, speed: float, dt: float) -> float:
        """The share of a sample that signal `i` takes; the paper's, unless a subclass knows better."""
        return gain

    def _catch_up(self) -> None:
        """Write down the times that `_step_all` leaves implicit."""
        if self._in_step:
            self._seen_ns = [self._t_ns] * len(self._x)


class _ByNoise(OneEuro):
    """The filter with gains limited by the noise of each sample. Holds what its base holds."""

    def __init__(self, parameters: OneEuroParameters, jitter: float) -> None:
        super().__init__(
            parameters.min_cutoff_hz, parameters.beta, parameters.d_cutoff_hz, parameters.restart_gap_s
        )
        self._jitter_2 = jitter * jitter
        self._variance: list[float] = []

    def push_with(self, t_ns: int, values: Float, variance: Float) -> Float:
        """As `push`, with the variances of the values, same shape; NaN or 0: as `push`."""
        self._variance = (_FRESH * variance).ravel().tolist()
        return self.push(t_ns, values)

    def _step_all(self, x: list[float], dt: float) -> list[float]:
        return self._step_each(x, (self._t_ns or 0) + round(dt * 1e9))

    def _gain(self, i: int, gain: float, speed: float, dt: float) -> float:
        variance = self._variance[i]
        if not variance > self._jitter_2:
            return gain
        q = self._jitter_2 / variance
        rest = 2.0 * q / (1.0 + q)
        turn = 2.0 * pi * dt * self.parameters.d_cutoff_hz
        # Of the speed squared, noise alone makes s^2 / dt^2 a / (2 - a), with a = turn / (1 + turn).
        u2 = speed * speed * dt * dt / variance - _BEYOND * turn / (2.0 + turn)
        if u2 <= 0.0:
            return min(gain, rest)
        c = (4.0 * u2) ** (1.0 / 3.0)
        return min(gain, max(rest, c / (1.0 + c)))


class PointFilter:
    """Push machine for points in space; holds the filter of their coordinates along the axes of the view."""

    def __init__(self, parameters: OneEuroParameters, jitter_m: float, R_view_rig: Float) -> None:
        """Set up.

        Args:
            parameters: Of the 1 € filter [m, s].
            jitter_m: Standard deviation that may be left of the noise of a point at rest, per axis [m].
            R_view_rig: (3, 3) rows are the axes of the view in the rig frame, the last along the sight.
        """
        self._filter = _ByNoise(parameters, jitter_m)
        self._R = R_view_rig

    def push(self, t_ns: int, points: Float, cov: Float) -> Float:
        """Filter points (M, 3) [m], rig frame, with covariances (M, 3, 3) [m^2] of their noise; NaN: not seen.

        Times as in `OneEuro.push`.
        """
        variance = np.vecdot(self._R @ cov, self._R)  # of each coordinate: the diagonal of R cov R'
        return self._filter.push_with(t_ns, points @ self._R.T, variance) @ self._R
