"""Free parameters of the whole-hand fit.

They are the angles that no coupling fixes, and the bounds of each.

A parameter vector is the palm's rotation (3, rotation vector about the wrist, rig frame) and translation (3),
then these n angles: four of the thumb; abduction, flexion, PIP (and DIP where it does not follow exactly) of each
finger. Where flexion narrows the abduction (`common.hand.limits`), the parameter is the abduction before that:

    abduction = share(flexion) parameter

so that a box of parameters is all the legal poses, and the prior of spreading fades in a fist as the range does. Where
limits have a tolerance, what is beyond them costs, and the box ends three standard deviations farther out.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float, Int
from common.hand.limits import ABDUCTION, FLEXION, spread_left
from common.hand.model import HandModel

_PALM = (1.0, 0.1)  # [rad], [m]: a hand in front of cameras, before anything is seen of it
REACH = 3.0  # standard deviations beyond a limit, where there is no hand


@dataclass(frozen=True, slots=True, eq=False)
class HandParameters:
    """Free angles of one hand model.

    Attributes:
        free: (n,) their indices in the flat (20,) table of angles.
        complete: (20, n) all angles = complete @ free ones, couplings included; abductions before they narrow.
        low, high: (n,) [rad] bounds that keep coupled angles inside their limits, too.
        legal_low, legal_high: (n,) [rad] the limits themselves.
        beyond_w2: (n,) [1/rad^2] inverse variance by which they are exceeded; 0: not at all.
        rests: (n,) whether it often stands at its low bound: that of a straight finger.
        abduction, flexion: Columns of the free angles of the K fingers whose abduction narrows; slices where they are
            evenly spaced, as they mostly are: those are views.
        most: (K,) [rad] their highest flexion.
        left: (K,) share of the abduction left there.
        anywhere: (6 + n,) inverse variances of the palm's turn and shift and of the angles, of a hand of which nothing
            is known but its limits.
    """

    free: Int
    complete: Float
    low: Float
    high: Float
    legal_low: Float
    legal_high: Float
    beyond_w2: Float
    at_low_limit: Bool
    abduction: Int | slice
    flexion: Int | slice
    most: Float
    left: Float
    anywhere: Float

    @classmethod
    def of(cls, model: HandModel) -> "HandParameters":
        """Return the free angles of a hand: 20, or 16 where the DIPs follow exactly.

        There are 16 only if no posture prior has the spread of the DIPs.
        """
        follows = model.dip_spread_rad == 0.0 and model.posture is None
        ratio = model.dip_per_pip if follows else None
        free = np.array([a for a in range(20) if not (ratio is not None and a >= 4 and a % 4 == 3)])
        complete = np.zeros((20, len(free)))
        complete[free, np.arange(len(free))] = 1.0
        low, high = model.limits_rad[..., 0].copy(), model.limits_rad[..., 1].copy()
        if ratio is not None:
            for column in np.flatnonzero((free >= 4) & (free % 4 == 2)):
                complete[free[column] + 1, column] = ratio
            if ratio > 0:
                low[1:, 2] = np.maximum(low[1:, 2], low[1:, 3] / ratio)
                high[1:, 2] = np.minimum(high[1:, 2], high[1:, 3] / ratio)
        low, high, tolerance = low.reshape(20), high.reshape(20), model.tolerance_rad.reshape(20)[free]
        inverse = np.where(tolerance > 0.0, tolerance, np.inf) ** -2.0
        narrowest_rad = 1e-3  # limits that leave an angle no room
        span = np.maximum(high - low, narrowest_rad)[free]
        most = model.limits_rad[:, FLEXION, 1]
        narrows = np.flatnonzero((model.spread_at_full_flexion < 1.0) & (most > 0.0))
        return cls(
            free,
            complete,
            low[free] - REACH * tolerance,
            high[free] + REACH * tolerance,
            low[free],
            high[free],
            inverse,
            (free >= 4) & (free % 4 != ABDUCTION),
            _evenly(np.searchsorted(free, 4 * narrows + ABDUCTION)),
            _evenly(np.searchsorted(free, 4 * narrows + FLEXION)),
            most[narrows],
            model.spread_at_full_flexion[narrows],
            np.concatenate([np.repeat(np.array(_PALM) ** -2.0, 3), 12.0 / (span * span)]),
        )

    def angles(self, x: Float) -> Float:
        """Angles (..., 5, 4) of the free ones (..., n)."""
        if len(self.most):
            x = x.copy()
            x[..., self.abduction] *= self._share(self._flexed(x))
        return (x @ self.complete.T).reshape(*x.shape[:-1], 5, 4)

    def by_angles(self, x: Float) -> Float:
        """Derivatives (20, n) of all angles by the free ones at x (n,)."""
        return self.by_parameters(self.complete[:, None].copy(), x)[:, 0]

    def by_parameters(self, J: Float, x: Float) -> Float:
        """Convert derivatives (..., P, 3, n) by free angles to those by parameters.

        The former are by the free angles as they are, the latter by the parameters at x (..., n); in place.
        """
        if len(self.most):
            flexed = self._flexed(x)
            spread_derivative = -2.0 * (1.0 - self.left) * flexed / self.most * x[..., self.abduction]
            spread = J[..., self.abduction]
            J[..., self.flexion] += spread * spread_derivative[..., None, None, :]
            J[..., self.abduction] = spread * self._share(flexed)[..., None, None, :]
        return J

    def free_of(self, values: Float) -> Float:
        """Those of values (5, 4), one per angle, that belong to free angles: (n,)."""
        return values.reshape(20)[self.free]

    def of_angles(self, angles_rad: Float) -> Float:
        """The parameters (n,) of legal angles (5, 4)."""
        x = self.free_of(angles_rad)
        if len(self.most):
            least_share = 1e-6  # an abduction that is narrowed to nothing may come from any
            x[self.abduction] /= np.maximum(self._share(self._flexed(x)), least_share)
        return np.minimum(np.maximum(x, self.low), self.high)

    def _flexed(self, x: Float) -> Float:
        """Flexions of the fingers that narrow, as shares (..., K) of the highest."""
        return np.minimum(np.maximum(x[..., self.flexion], 0.0), self.most) / self.most

    def _share(self, flexed: Float) -> Float:
        return spread_left(flexed, self.left)


def _evenly(columns: Int) -> Int | slice:
    """The same columns (K,) as a slice, if there is one."""
    step = np.diff(columns)
    if len(step) == 0 or step[0] < 1 or (step != step[0]).any():
        return columns
    return slice(int(columns[0]), int(columns[-1]) + 1, int(step[0]))
