"""What a solver of one chain answers: the pose, the distance left to the target, and whether it could be less."""

from enum import Enum
from typing import NamedTuple

from master.ik.chain import Chain
from master.ik.joints import Angles, Rotor
from master.ik.vectors import Matrix, Vector

_NAN = float("nan")

Pose = tuple[Angles, ...]


class Reach(Enum):
    """Where the target lies, by distance from the root alone."""

    WITHIN = "within"
    TOO_FAR = "farther than the sum of the bones"
    TOO_NEAR = "nearer than the joint limits allow"
    NOT_SEEN = "not finite"


class ChainResult(NamedTuple):
    """One solved pose.

    Attributes:
        positions: Joints, root first, and the end (links + 1) [m].
        orientations: Link frames in the frame of the target.
        angles: Of every joint [rad], legal.
        residual_m: Distance of the end to the target.
        iterations: Of all attempts.
        reached: Residual within the tolerance.
        reach: Verdict of the distance bounds.
        degenerate: A bone has no length, or the target is at the root and says no direction.
    """

    positions: tuple[Vector, ...]
    orientations: tuple[Matrix, ...]
    angles: Pose
    residual_m: float
    iterations: int
    reached: bool
    reach: Reach
    degenerate: bool


def not_seen(chain: Chain) -> ChainResult:
    """The answer for a target that is not finite: NaN everywhere."""
    nowhere = (_NAN, _NAN, _NAN)
    angles = tuple((_NAN,) * (2 if isinstance(link.joint, Rotor) else 1) for link in chain.links)
    count = len(chain.links)
    return ChainResult(
        positions=(nowhere,) * (count + 1),
        orientations=((nowhere, nowhere, nowhere),) * count,
        angles=angles,
        residual_m=_NAN,
        iterations=0,
        reached=False,
        reach=Reach.NOT_SEEN,
        degenerate=False,
    )
