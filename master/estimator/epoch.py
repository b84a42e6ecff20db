"""What the estimator is handed at an epoch, and what it says."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from common.arrays import Bool, Code, Float, Int
from master.fabrik.estimate import SolvedHand


@dataclass(frozen=True, slots=True, eq=False)
class Epoch:
    """What is measured at one time.

    Attributes:
        t_ns: When.
        points_m: (A, 3) where rays place the markers; NaN: they do not.
        cov_m2: (A, 3, 3) covariances of these, where they are what is measured; None: the centroids are.
        uv: (C, A, 2) [px] centroids of all markers of the rig; NaN: not seen, or gated out.
        variance_px2: (C, A) of each camera's own errors; NaN: not to be used.
        own_m2: (A, 3, 3) covariance of what is wrong with each marker itself, beside bones.
        facing: (3,) unit vector from the hand to the cameras that see its back.
        sensed: What other sensors say of the palm's turn and of angles; None: nothing.
        start: Another hand of this epoch; None: there is none.
        second_order: Whether the joints' covariance is wanted to second order, as a hand that is published has it.
    """

    t_ns: int
    points_m: Float
    facing: Float
    cov_m2: Float | None = None
    uv: Float | None = None
    variance_px2: Float | None = None
    own_m2: Float | None = None
    sensed: "Sensed | None" = None
    start: SolvedHand | None = None
    second_order: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class Sensed:
    """What other sensors say of the palm's turn and the free angles, as normal equations.

    Attributes:
        rotation: (3, 3) palm -> rig about which turns count; None: only angles are known.
        sure: Whether it is known about every axis how the palm lies.
        information, pull, constant: (3 + n, 3 + n), (3 + n,) and a number, of turn and free angles.
        told: (5,) fingers that are told, and `level` (5,) from what (`Level`).
        angles: (n,) the angles of those, where a search may begin.
        lit: Columns of the PIPs of fingers that a laser point alone tells: they bend as their knuckles do.
        weighed: The same with fingers counting less that a hand of angles (5, 4) contradicts; None: there are none.
        belief: Where it is from.
    """

    rotation: Float | None
    sure: bool
    information: Float
    pull: Float
    constant: float
    told: Bool
    level: Code
    angles: Float
    lit: Int = field(default_factory=lambda: np.zeros(0, np.int64))
    weighed: "Callable[[Float], Sensed | None]" = lambda _: None
    belief: object = None

    @classmethod
    def turn(cls, rotation: Float, information: Float, n: int, *, sure: bool) -> "Sensed":
        """Of the palm's rotation (3, 3) alone, with information (3, 3) [1/rad^2] about it."""
        both = np.zeros((3 + n, 3 + n))
        both[:3, :3] = information
        none, level = np.zeros(5, np.bool_), np.zeros(5, np.uint8)
        return cls(rotation, sure, both, np.zeros(3 + n), 0.0, none, level, np.zeros(n))


@dataclass(frozen=True, slots=True, eq=False)
class FittedHand(SolvedHand):
    """A hand fitted by the estimator.

    Attributes:
        alone: (6 + n, 6 + n) covariance of the palm's turn [rad] and shift [m] and of the free angles [rad], by this
            instant alone.
        x: (n,) free angles.
        scale: By how much the misfit of the instant has scaled `alone`.
        natural: Probability that the hand obeys habits.
        surprise: (M,) chi square of each marker.
        steps: Of the search.
    """

    alone: Float
    x: Float
    scale: float
    natural: float
    surprise: Float
    steps: int


@dataclass(frozen=True, slots=True, eq=False)
class Fitted:
    """What the estimator says at an epoch.

    Attributes:
        solution: The hand; None: nothing is known of it.
        valid, tracked, source: (26,) as of `HandPose`.
        rests: (6,) what thumb ... little and the palm rest on now; 0: on nothing. Equal numbers are equal grounds: for
            a finger the sum of `ON_MARKERS`, `BY_MARKERS` where its own is placed, and `ON_OTHERS` by its level; for
            the palm one of the former and which markers are seen.
        anew: The hand of a moment ago was wrong: nothing of it is in this one.
        sensed: What other sensors said, as the fit took it; None: nothing.
    """

    solution: FittedHand | None
    valid: Bool
    tracked: Bool
    source: Code
    rests: Int
    anew: bool = False
    sensed: "Sensed | None" = None
