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

Plain lists, not arrays: for 18 signals a numpy step costs more than the whole loop.
"""

from dataclasses import dataclass
from math import isfinite, pi

import numpy as np

from common.arrays import Float

_NAN = float("nan")


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
                state[i] += change * r / (r + 1.0)
            out.append(state[i])
        self._x = state
        self._in_step = all(s == t_ns for s in seen)
        return out

    def _catch_up(self) -> None:
        """Write down the times that `_step_all` leaves implicit."""
        if self._in_step:
            self._seen_ns = [self._t_ns] * len(self._x)
