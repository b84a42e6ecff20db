"""FABRIK for any chain: a chain is prepared for many targets, and says where each lies.

The line's fingers go by `master.fabrik.fabrik.solve_chain`, from the closed form and within reach; here chains stand
alone, as the papers have them: with the test of reach, without a seed, and without restarts where they are compared.
"""

from dataclasses import dataclass
from enum import Enum
from math import isfinite
from typing import NamedTuple

import numpy as np

from common.arrays import Float
from master.fabrik.fabrik import RESTART_BENDS, Chain, solve_chain
from master.fabrik.joints import Rotor, end_of
from master.fabrik.linear_algebra import IDENTITY, Matrix, Vector, length, minus, rotate_back

_SEARCH_STARTS = (1.0, 0.5, 0.0)


class Reach(Enum):
    """Where the target lies, by distance from the root alone."""

    WITHIN = "within"
    TOO_FAR = "farther than the sum of the bones"
    TOO_NEAR = "nearer than the joint limits allow"
    NOT_SEEN = "not finite"


class ChainResult(NamedTuple):
    """One solved pose of N links; NaN where the target is not finite."""

    positions: Float  # joints, root first, and the end (N + 1, 3) [m]
    orientations: Float  # link frames (N, 3, 3) in the frame of the target
    angles: Float  # (n,) of every joint [rad], legal: of a rotor abduction and flexion
    residual_m: float  # distance of the end to the target
    iterations: int  # of all attempts
    reached: bool  # residual within the tolerance
    reach: Reach  # verdict of the distance bounds
    degenerate: bool  # a bone has no length, or the target is at the root and gives no direction


@dataclass(frozen=True, slots=True)
class Fabrik:
    """A chain prepared for many targets."""

    chain: Chain
    farthest_m: float  # sum of the bones
    nearest_m: float  # least distance of the end to the root that the limits allow (found by search)
    tolerance_m: float  # residual that counts as reached
    max_iterations: int  # per attempt
    restarts: int  # attempts after a stall, at most 3; 0: FABRIK as published, with limits

    @classmethod
    def of(
        cls,
        chain: Chain,
        tolerance_m: float = 1e-5,
        max_iterations: int = 100,
        restarts: int = len(RESTART_BENDS),
    ) -> "Fabrik":
        """Prepare a chain.

        Raises:
            ValueError: Tolerance or iterations are not positive, or there are not 0 to 3 restarts.
        """
        if not tolerance_m > 0.0 or max_iterations < 1:
            raise ValueError(
                f"tolerance {tolerance_m} m and {max_iterations} iterations: both must be positive"
            )
        if not 0 <= restarts <= len(RESTART_BENDS):
            raise ValueError(f"{restarts} restarts: there are 0 to {len(RESTART_BENDS)}")
        return cls(chain, sum(chain.lengths), least_root_to_end(chain), tolerance_m, max_iterations, restarts)

    def solve(
        self,
        target: Vector,
        initial: Float | None = None,
        root: Vector = (0.0, 0.0, 0.0),
        frame: Matrix = IDENTITY,
    ) -> ChainResult:
        """Bring the chain's end to the target; return the best legal pose found.

        `target` [m], in the frame the result shall be in; NaN: so is the pose. `initial`: angles (n,) [rad] to
        start from, clamped; None: the rest pose. `root` [m], `frame`: of the first joint.

        Raises:
            ValueError: There are too many angles, or too few.
        """
        goal = rotate_back(frame, minus(target, root))
        reach, chain = self._reach(goal), self.chain
        n, count = len(chain.spans), len(chain.links)
        angles = np.zeros(n) if initial is None else np.array(initial, np.float64)
        if len(angles) != n:
            raise ValueError(f"{len(angles)} angles for a chain that has {n}")
        if reach is Reach.NOT_SEEN:
            nowhere = np.full((count + 1, 3), np.nan), np.full((count, 3, 3), np.nan), np.full(n, np.nan)
            return ChainResult(*nowhere, float("nan"), 0, False, reach, False)
        restarts = self.restarts if reach is Reach.WITHIN else 0
        residual, iterations = solve_chain(
            chain.arrays, goal, self.tolerance_m, self.max_iterations, restarts, angles
        )
        positions, orientations = chain.forward(angles)
        rotation = np.array(frame)
        shortest_m = 1e-9
        return ChainResult(
            positions=positions @ rotation.T + np.array(root),
            orientations=rotation @ orientations,
            angles=angles,
            residual_m=residual,
            iterations=iterations,
            reached=residual <= self.tolerance_m,
            reach=reach,
            degenerate=min(chain.lengths) < shortest_m or length(goal) < shortest_m,
        )

    def _reach(self, goal: Vector) -> Reach:
        distance = length(goal)
        if not isfinite(distance):
            return Reach.NOT_SEEN
        if distance > self.farthest_m + self.tolerance_m:
            return Reach.TOO_FAR
        return Reach.TOO_NEAR if distance < self.nearest_m - self.tolerance_m else Reach.WITHIN


def least_root_to_end(chain: Chain) -> float:
    """Least |end - root| [m] inside the limits, by pattern search from three starts."""
    return min(_nearest_from(chain, share) for share in _SEARCH_STARTS)


def _nearest_from(chain: Chain, share: float) -> float:
    """Least |end - root| [m] from joints at a share of their range."""

    def distance(angles: Float) -> float:
        return length(end_of(chain.arrays, chain.clamp(angles)))

    low, high = chain.arrays.spans.T
    first = 2 if isinstance(chain.links[0].joint, Rotor) else 1
    angles = np.append(np.clip(0.0, low[:first], high[:first]), (low + share * (high - low))[first:])
    first_step, least_step = 0.25, 1e-4  # of the range
    here, step = distance(angles), first_step
    while step > least_step:
        before = here
        for i in range(first, len(angles)):
            start = angles[i]
            for move in (step, -step):
                trial = angles.copy()
                trial[i] = min(max(start + move * (high[i] - low[i]), low[i]), high[i])
                found = distance(trial)
                if found < here:
                    angles, here = trial, found
        no_gain_m = 1e-12
        if here >= before - no_gain_m:
            step *= 0.5
    return here
