"""What another sensor than the markers says of the fingers, as one more belief of the whole-hand fit.

A wrist device tells angles with a covariance. In the free angles x of the fit (`master.ik.parameters`) that is

    (A x - y)' W (A x - y) / 2,   y: the angles, W: the inverse of their covariance, A: free angles -> all angles

which joins the habits, the last pose and the markers in the same normal equations: no sensor is switched on or off.

A sensor that errs once in a while (a false fingertip) must not win by being narrow. A finger whose angles by the fit
are farther from y than W allows counts less: by (N + 4) / (N + chi square), the weight of Student's t with N = 4
degrees of freedom (Lange, Little, Taylor 1989, "Robust statistical modeling using the t distribution").
"""

from dataclasses import dataclass, replace

import numpy as np

from common.arrays import Bool, Code, Float
from master.ik.parameters import HandParameters

_FREEDOM = 4.0
_SURPRISED = 9.5  # chi square of four numbers, 1 in 20: below it nothing is weighed down
_ANGLES = 4


@dataclass(frozen=True, slots=True, eq=False)
class FingerBelief:
    """Angles of fingers at one instant as another sensor has them.

    Attributes:
        angles_rad: (5, 4); a finger of which nothing is known has NaN.
        information: (5, 4, 4) [1/rad^2], what that is worth, without habits; zeros where nothing is known.
        told: (5,) fingers that are seen now, well enough to say how they are bent.
        level: (5,) `Level` codes: what they are told from.
    """

    angles_rad: Float
    information: Float
    told: Bool
    level: Code

    @property
    def fingers(self) -> frozenset[int]:
        """Those that are told."""
        return frozenset(np.flatnonzero(self.told).tolist())

    def rows(self, parameters: HandParameters) -> tuple[Float, Float, float]:
        """Normal matrix (n, n), pull (n,) and constant of the belief in the free angles, as of `AnglePrior`."""
        known = np.isfinite(self.angles_rad[:, 0])
        y = np.where(known[:, None], self.angles_rad, 0.0)
        W = np.where(known[:, None, None], self.information, 0.0)
        A = parameters.by_angles(parameters.of_angles(y)).reshape(5, _ANGLES, -1)
        WA = W @ A
        normal = (np.swapaxes(A, 1, 2) @ WA).sum(axis=0)
        # Of an abduction that narrows A is the derivative there.
        y = y + (A @ parameters.of_angles(y)) - parameters.angles(parameters.of_angles(y))
        pull = (y[:, None] @ WA)[:, 0].sum(axis=0)
        constant = 0.5 * float(np.vecdot(y, (W @ y[..., None])[..., 0]).sum())
        return normal, pull, constant

    def surprise(self, angles_rad: Float) -> Float:
        """Chi square (5,) of angles (5, 4); 0 where nothing is known."""
        off = np.nan_to_num(angles_rad - self.angles_rad)
        return np.asarray(np.vecdot(off, (self.information @ off[..., None])[..., 0]), np.float64)

    def weighed(self, angles_rad: Float) -> "FingerBelief | None":
        """The belief with fingers counting less that a hand of angles (5, 4) contradicts; None: it contradicts none."""
        surprise = self.surprise(angles_rad)
        if not (surprise > _SURPRISED).any():
            return None
        share = np.where(surprise > _SURPRISED, (_FREEDOM + _ANGLES) / (_FREEDOM + surprise), 1.0)
        return replace(self, information=self.information * share[:, None, None])
