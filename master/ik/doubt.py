"""How sure each joint is over time: what this instant tells, and what earlier ones still do.

What this instant tells of palm and angles is one covariance (`master.ik.certainty`). What earlier ones told is the
covariance of the last instant, grown by what the hand did meanwhile:

- a palm or finger whose markers are seen: by as much as the fit lets go of its last pose in that time (`Priors`),
- a finger that is hidden: by how far hidden fingers stray (`master.ik.hidden`),
- a palm without markers: by a turn and a shift that grow with the time it is lost, the shift with its speed, too.

The two are no independent witnesses: the same habits, and errors of markers that repeat, are in both. So they are never
added up as the Kalman filter does (Julier, Uhlmann 1997, "A non-divergent estimation algorithm in the presence of
unknown correlations", show what that leads to). In each direction the surer of the two is taken, and no more: in the
coordinates in which the covariance of this instant is the unit matrix and that of the past diagonal, the smaller of
each pair. So what is claimed is never surer than one instant was, and grows while nothing is seen, up to a finger that
is somewhere within its limits. Where every finger is seen this instant tells more than the past, and counts alone.

Joints move on arcs, which is added to what this covariance says of them (`master.ik.arcs`).
"""

from math import exp

import numpy as np

from common.arrays import Bool, Float
from common.hand_model import PALM
from master.estimator.parameters import HandParameters
from master.ik.arcs import Arcs
from master.ik.hand import HandSolution
from master.ik.hidden import HiddenFingers, strayed_rad2
from master.ik.priors import Priors

# A palm without markers: about each axis, and along it beside what it was moving at.
_TURNS_RAD_S, _STARTS_M_S = np.radians(20.0), 0.02
_GOES_ON = 0.35  # of its speed, along each axis
_EASE_S = 0.047  # of the speed: three tenths of a new one count at 60 frames a second


class JointDoubt:
    """Push machine. Holds the covariance of palm and free angles, and since when and how fast the palm is lost.

    Attributes:
        cov: (6 + n, 6 + n) of the palm's turn [rad] and shift [m] and of the free angles [rad], at the last instant.
    """

    def __init__(self, parameters: HandParameters, priors: Priors, arcs: Arcs) -> None:
        self._finger, self._priors, self._arcs = parameters.free // 4, priors, arcs
        self._parameters = parameters
        self._model_m2 = priors.model_m**2 * np.eye(3)
        self._anywhere = 1.0 / parameters.anywhere
        self.cov: Float | None = None
        self._lost_s = 0.0
        self._speed_m_s = 0.0

    def push(
        self,
        found: HandSolution,
        last: HandSolution | None,
        dt_s: float,
        hidden: HiddenFingers | None,
        markers_cov_m2: Float,
        seen: Bool,
        *,
        palm_seen: bool,
    ) -> Float:
        """Covariances (26, 3, 3) [m^2] of the joints at an instant.

        Args:
            found: The hand at this instant.
            last, dt_s: That of the instant before and the time since then [s]; None: nothing is taken over.
            hidden: Fingers without a marker; None: nothing is known of what they did.
            markers_cov_m2, seen: Covariances (M, 3, 3) [m^2] of the markers, and which of them are seen (M,).
            palm_seen: Whether markers tell where the palm is.
        """
        now = found.alone
        if self.cov is not None and last is not None and hidden is not None:
            past = self.cov.copy()
            np.einsum("ii->i", past)[...] += self._grown(last, found, dt_s, hidden, palm_seen=palm_seen)
            if not palm_seen or hidden.gone_s.any():
                now = surer(self._without(found, hidden), past)
        else:
            self._lost_s = self._speed_m_s = 0.0
        self.cov = now
        linear, moved = found.cov_m2, found.moved
        if now is not found.alone:
            linear = (moved.reshape(-1, len(now)) @ now).reshape(moved.shape) @ moved.swapaxes(1, 2)
        fitted = markers_cov_m2[seen] + self._model_m2
        return linear + self._arcs.covariance(found, now, fitted, seen)

    def _without(self, found: HandSolution, hidden: HiddenFingers) -> Float:
        """What this instant tells (6 + n, 6 + n), but of hidden fingers no more than their limits."""
        now, column = found.alone, 6 + np.flatnonzero(hidden.gone_s[self._finger] > 0.0)
        if len(column):
            now = now.copy()
            now[column] = now[:, column] = 0.0
            # Anywhere within the limits, seen from where it is believed to be.
            x = self._parameters.of_angles(found.angles_rad)
            off = 0.5 * (self._parameters.low + self._parameters.high) - x
            now[column, column] = self._anywhere[column] + np.square(off)[column - 6]
        return now

    def _grown(
        self, last: HandSolution, found: HandSolution, dt_s: float, hidden: HiddenFingers, *, palm_seen: bool
    ) -> Float:
        """(6 + n,) variances that the time since the last instant adds to what was known then."""
        grown = np.empty(6 + len(self._finger))
        gone = hidden.gone_s
        strayed = hidden.own * (strayed_rad2(gone) - strayed_rad2(np.maximum(gone - dt_s, 0.0)))
        seen = (self._priors.walk_rad_s * dt_s) ** 2
        grown[6:] = np.where(gone > 0.0, strayed, seen)[self._finger]
        if palm_seen:
            self._lost_s = 0.0
            step = found.joints.position_m[PALM] - last.joints.position_m[PALM]
            share = 1.0 - exp(-dt_s / _EASE_S)  # a short step is mostly noise
            self._speed_m_s += share * (float(np.sqrt(step @ step)) / dt_s - self._speed_m_s)
            grown[:6] = self._priors.palm_weight(dt_s) ** -2.0
        else:
            before, self._lost_s = self._lost_s, self._lost_s + dt_s
            rates = (_TURNS_RAD_S, _STARTS_M_S + _GOES_ON * self._speed_m_s)
            grown[:6] = np.repeat(np.square(rates), 3) * (self._lost_s**2 - before**2)
        return grown


def surer(now: Float, past: Float) -> Float:
    """The covariance (n, n) that is in each direction that of the surer of two, both positive definite."""
    root = np.linalg.cholesky(now)
    relative = np.linalg.solve(root, np.linalg.solve(root, past).T)
    value, direction = np.linalg.eigh(0.5 * (relative + relative.T))
    axes = root @ direction
    return (axes * np.minimum(value, 1.0)) @ axes.T
