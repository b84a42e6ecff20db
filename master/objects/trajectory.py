"""Where an object went: the last poses that were fitted, and where they lead it.

Led on for a fit, for what is seen too little of it, and for what is shown while nobody sees it: then its speed dies.
"""

from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from common.arrays import Float
from master.objects.fit import Fitted
from master.objects.motion import Motion, Past

HELD_S = 0.5
_DIES_S = 0.12  # in which the speed of a thing that nobody sees dies
_PUSHED: Float = np.repeat([5.0, 40.0], 3)  # [m/s^2, rad/s^2] what may happen to its speed meanwhile
_ARM_M = 0.1  # how it moves unseen, a turn counting by what it does a decimetre away
_SCALE: Float = np.array([1.0] * 3 + [_ARM_M] * 3)
_SIX, _TWELVE = np.arange(6), np.arange(12)


@dataclass(frozen=True, slots=True, eq=False)
class _Known:
    """A pose that was fitted."""

    t_ns: int
    fitted: Fitted


class Trajectory:
    """Recent fitted poses of an object, sixteen at most.

    Push machine. Also holds when a pose was last fully constrained by the observations alone.
    """

    def __init__(self) -> None:
        poses = 16
        self._known: deque[_Known] = deque(maxlen=poses)
        self._sure_ns = -(2**63)

    def __bool__(self) -> bool:
        """Whether there is any."""
        return bool(self._known)

    def push(self, t_ns: int, fitted: Fitted) -> bool:
        """Add the pose of an epoch.

        False: the pose has not been fully constrained for too long, and all poses are forgotten.
        """
        self._known.append(_Known(t_ns, fitted))
        if fitted.measured_only:
            self._sure_ns = t_ns
        elif self.unsure_s(t_ns) > HELD_S:
            self._known.clear()
            return False
        return True

    def clear(self) -> None:
        """What was known of where it went is of another thing."""
        self._known.clear()

    def unsure_s(self, t_ns: int) -> float:
        """Return the time [s] since the pose was last fully constrained."""
        return (t_ns - self._sure_ns) * 1e-9

    def predicted(self, t_ns: int) -> Motion | None:
        """Where the object is led to; None: it was not seen for long."""
        if not self._known:
            return None
        last = self._known[-1]
        dt = (t_ns - last.t_ns) * 1e-9
        if dt > HELD_S:
            self._known.clear()
            return None
        return last.fitted.motion.at(_DIES_S * float(1.0 - np.exp(-dt / _DIES_S)))

    def past(self, t_ns: int, oldest_ns: int) -> Past:
        """Return the prior at an epoch from before all that is seen around it.

        The oldest of these observations is at `oldest_ns`.
        """
        known = next((k for k in reversed(self._known) if k.t_ns <= oldest_ns), self._known[0])
        dt = max((t_ns - known.t_ns) * 1e-9, 1e-3)
        step = np.eye(12)
        step[_SIX, _SIX + 6] = dt
        grown = step @ known.fitted.cov @ step.T
        grown[_TWELVE, _TWELVE] += np.concatenate([0.5 * dt * dt * _PUSHED, dt * _PUSHED]) ** 2
        return Past(known.fitted.motion.at(dt), np.asarray(np.linalg.inv(grown), np.float64))

    def held_cov(self, t_ns: int) -> Float | None:
        """Return the covariance (6, 6) of the pose predicted without observations.

        None: the pose is no longer to be held.
        """
        if not self._known or self.unsure_s(t_ns) > HELD_S:
            return None
        known = self._known[-1]
        dt = (t_ns - known.t_ns) * 1e-9
        cov = known.fitted.cov[:6, :6].copy()
        grown = _PUSHED * 0.5 * dt * dt
        speed = known.fitted.motion.rates[1].ravel() * (dt - _DIES_S * (1.0 - np.exp(-dt / _DIES_S)))
        cov[_SIX, _SIX] += grown**2 + speed**2
        return cov


def unheeded(fitted: Fitted, measured: Fitted, since_s: float, poor_m: float) -> Fitted:
    """Grow a fit's covariance in the directions the observations do not constrain.

    By what may have happened in these directions for so long [s].

    A turn about the line through two beads shows in nothing but what it does to other turns, which is too little to
    rest on: its covariance grows as that of a thing that nobody sees.

    Args:
        fitted: With the past.
        alone: Without.
        since_s: For how long.
        poor_m: What is less sure than this is not reported [m].
    """
    size, axes = np.linalg.eigh(measured.cov[:6, :6] * np.outer(_SCALE, _SCALE))
    unobserved = axes[:, size > poor_m**2] / _SCALE[:, None]
    cov = fitted.cov.copy()
    unseen_m_s2 = 1.5  # how it moves unseen, a turn counting by what it does a decimetre away
    cov[:6, :6] += (0.5 * unseen_m_s2 * min(since_s, HELD_S) ** 2) ** 2 * (unobserved @ unobserved.T)
    return replace(fitted, cov=cov, measured_only=False)
