"""A gesture that lasts: its start time and its messages.

The messages are those of its beginning, its course and its end.
"""

from dataclasses import dataclass
from math import erf, isfinite, nan, sqrt

import numpy as np

from common.arrays import Float
from common.messages import Gesture, GestureKind, Phase

_NOWHERE = np.full(3, np.nan)
_NOWHERE.flags.writeable = False


@dataclass(frozen=True, slots=True, eq=False)
class HeldGesture:
    """One that has begun.

    Attributes:
        hand: Name of the hand profile.
        kind, name: As of `Gesture`.
        began_t_ns: When it began [ns].
    """

    hand: str
    kind: GestureKind
    name: str
    began_t_ns: int

    def message(
        self,
        phase: Phase,
        t_ns: int,
        confidence: float,
        *,
        distance_m: float = nan,
        strength: float = nan,
        angle_rad: float = nan,
        origin_m: Float = _NOWHERE,
        direction: Float = _NOWHERE,
    ) -> Gesture:
        """Return the message of an epoch."""
        return Gesture(
            hand=self.hand,
            t_ns=t_ns,
            kind=self.kind,
            name=self.name,
            phase=phase,
            began_t_ns=self.began_t_ns,
            confidence=min(max(confidence, 0.0), 1.0),
            distance_m=distance_m,
            strength=strength,
            angle_rad=angle_rad,
            origin_m=origin_m,
            direction=direction,
        )


def below(value: float, limit: float, sigma: float) -> float:
    """Return the probability that a measured quantity is below the limit.

    It was measured as `value` with a standard deviation; 0.5 if unknown.
    """
    if not isfinite(sigma):
        return 0.5
    return 0.5 * (1.0 + erf((limit - value) / (max(sigma, 1e-6) * sqrt(2.0))))
