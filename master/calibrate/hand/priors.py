"""Priors before a marker is seen.

Of hands in general, and of a user who follows the routine roughly.

None of it is exact, and all of it is wide: where the markers do not overrule it, a bone is reported as undetermined.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float
from common.hand.routine import move_at, posture_at


@dataclass(frozen=True, slots=True)
class Priors:
    """Standard deviations.

    Attributes:
        bone: Of one bone about its share of the hand length, as a share of its length. Individuals spread by 5 to 8 %
            (Buchholz, Armstrong & Goldstein, 1992; Greiner, 1991).
        root_m: Of a knuckle's place, and of the thumb's CMC.
        root_rad, thumb_rad: Of a finger's and the thumb's rest orientation, about each axis.
        dip_ratio, thumb_ratio: Mean and sd of DIP per PIP, between Kalbfleisch's 2/3 and Kamper's 0.84, and of the
            thumb's IP per MCP.
        dip_bias_rad: Of the DIP of a finger whose PIP is straight.
        dip_rad, thumb_dip_rad: By how much the DIP drifts from that, slowly.
        straight_rad: Mean and sd of the PIP of a finger that is held straight.
        level_rad, moving_level_rad: Of an angle about what the routine asks for, while held and while it moves.
        held_rad_s: Wandering of a joint that is to be held [rad/sqrt(s)].
        moving_rad_s: Of one that is to move.
        palm_rad_s, palm_m_s: Of a palm that rests [rad/sqrt(s)], [m/sqrt(s)].
        free_palm_rad_s, free_palm_m_s: Of one that need not, because three markers on it are seen.
        back_m: Of the place of a marker on the back.
        slow_s: Time over which deviations live [s].
        model_m: Of a cap's place, by what the model leaves out: skin that moves, caps not quite round.
    """

    bone: float = 0.07
    root_m: float = 6e-3
    root_rad: float = float(np.radians(5.0))
    thumb_rad: float = float(np.radians(12.0))
    dip_ratio: tuple[float, float] = (0.75, 0.08)
    thumb_ratio: tuple[float, float] = (0.9, 0.3)
    dip_bias_rad: float = float(np.radians(3.0))
    dip_rad: float = float(np.radians(5.0))
    thumb_dip_rad: float = float(np.radians(12.0))
    straight_rad: tuple[float, float] = (float(np.radians(1.5)), float(np.radians(1.5)))
    level_rad: float = float(np.radians(12.0))
    moving_level_rad: float = float(np.radians(30.0))
    held_rad_s: float = float(np.radians(2.5))
    moving_rad_s: float = float(np.radians(400.0))
    palm_rad_s: float = float(np.radians(0.3))
    palm_m_s: float = 3e-4
    free_palm_rad_s: float = float(np.radians(100.0))
    free_palm_m_s: float = 0.3
    back_m: float = 8e-3
    slow_s: float = 1.0
    model_m: float = 2e-4


@dataclass(frozen=True, slots=True, eq=False)
class RoutineTargets:
    """What the routine asks for at each knot.

    Attributes:
        posture_rad: (K, 5, 3).
        moving: (K, 5, 3) the angle is to change.
        straight: (K, 5) the finger is to be straight.
    """

    posture_rad: Float
    moving: Bool
    straight: Bool

    @classmethod
    def of(cls, script_s: Float) -> "RoutineTargets":
        """Return the targets at routine times (K,) [s].

        What may be moving by then counts as moving, since times are known roughly.
        """
        coarse_s = 0.1
        around = [[move_at(t + d) for d in (-coarse_s, 0.0, coarse_s)] for t in script_s.tolist()]
        return cls(
            np.radians([posture_at(t) for t in script_s.tolist()]),
            np.array([np.any([move.moving for move in moves], axis=0) for moves in around]),
            np.array([np.all([move.straight for move in moves], axis=0) for moves in around]),
        )
