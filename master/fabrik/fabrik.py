"""General solver for limited chains: FABRIK with the joint limits in both passes.

Aristidou & Lasenby, "FABRIK: a fast, iterative solver for the inverse kinematics problem", 2011. One iteration:

    aim        turn the first joint so that the end lies towards the target
    backward   put the end on the target and walk to the root: each bone keeps its length and points as it did,
               as far as the joint between it and the bone behind it allows
    forward    put the root back and walk to the end: each bone points to its place of the backward pass, as far
               as its own joint allows

Aiming is ours: hinges hold the bones in one plane, and a backward pass that starts from a plane beside the
target tilts it the wrong way. The forward pass ends legal, so every pose that leaves this file obeys the limits;
joints keep full orientations, so bones need not be straight or planar. A coupled hinge follows its leader in the
forward pass.

FABRIK as published deadlocks on reachable targets: a limit flattens a finger and a straight limited chain cannot
leave its line. Hence the seed (from the closed form, `master.fabrik.finger`, it starts on the target), and, when
an attempt stalls, restarts from bent poses turned to the target. The best pose found is returned with its
residual; nothing is claimed that is not so, and no finite target raises or gives NaN.
"""

from dataclasses import dataclass
from enum import Enum
from math import isfinite
from typing import NamedTuple

import numpy as np

from common.arrays import Float
from common.kernels import inner, kernel
from master.fabrik.chain import Chain, Pose, least_root_to_end
from master.fabrik.chain_arrays import (
    START,
    ChainArrays,
    clamp_angles,
    end_of,
    forward,
    limits_of,
    put_angles,
    vector_at,
)
from master.fabrik.limits import HINGE, clamp
from master.fabrik.passes import aim, backward_pass, forward_pass
from master.fabrik.rotations import IDENTITY, Matrix, Vector, length, minus, rotate_back

_RESTART_BENDS = ((1.0, 1.0), (2.0, 0.5), (0.5, 2.0))
"""How a restart shares out its bend between the front and the back of the chain."""


class Reach(Enum):
    """Where the target lies, by distance from the root alone."""

    WITHIN = "within"
    TOO_FAR = "farther than the sum of the bones"
    TOO_NEAR = "nearer than the joint limits allow"
    NOT_SEEN = "not finite"


class ChainResult(NamedTuple):
    """One solved pose of N links; NaN where the target is not finite.

    Attributes:
        positions: Joints, root first, and the end (N + 1, 3) [m].
        orientations: Link frames (N, 3, 3) in the frame of the target.
        angles: Of every joint [rad], legal.
        residual_m: Distance of the end to the target.
        iterations: Of all attempts.
        reached: Residual within the tolerance.
        reach: Verdict of the distance bounds.
        degenerate: A bone has no length, or the target is at the root and gives no direction.
    """

    positions: Float
    orientations: Float
    angles: Pose
    residual_m: float
    iterations: int
    reached: bool
    reach: Reach
    degenerate: bool


@dataclass(frozen=True, slots=True)
class Fabrik:
    """A chain prepared for many targets.

    Attributes:
        chain: Links, limits, coupling.
        farthest_m: Sum of the bones.
        nearest_m: Least distance of the end to the root that the limits allow (found by search).
        tolerance_m: Residual that counts as reached.
        max_iterations: Per attempt.
        restarts: Attempts after a stall, at most 3; 0: FABRIK as published, with limits.
    """

    chain: Chain
    farthest_m: float
    nearest_m: float
    tolerance_m: float
    max_iterations: int
    restarts: int

    @classmethod
    def of(
        cls, chain: Chain, tolerance_m: float = 1e-5, max_iterations: int = 100, restarts: int = 3
    ) -> "Fabrik":
        """Prepare a chain.

        Raises:
            ValueError: Tolerance or iterations are not positive, or there are not 0 to 3 restarts.
        """
        if not tolerance_m > 0.0 or max_iterations < 1:
            raise ValueError(
                f"tolerance {tolerance_m} m and {max_iterations} iterations: both must be positive"
            )
        if not 0 <= restarts <= len(_RESTART_BENDS):
            raise ValueError(f"{restarts} restarts: there are 0 to {len(_RESTART_BENDS)}")
        return cls(chain, sum(chain.lengths), least_root_to_end(chain), tolerance_m, max_iterations, restarts)

    def solve(
        self,
        target: Vector,
        initial: Pose | None = None,
        root: Vector = (0.0, 0.0, 0.0),
        frame: Matrix = IDENTITY,
    ) -> ChainResult:
        """Bring the chain's end to the target.

        Args:
            target: [m], in the frame the result shall be in. NaN: not seen.
            seed: Angles to start from; None: the rest pose. Clamped to the limits.
            root: Place of the first joint [m].
            frame: Orientation of the chain's root frame.

        Returns:
            The best legal pose found; NaN poses for a target that is not finite.
        """
        goal = rotate_back(frame, minus(target, root))
        reach = self._reach(goal)
        chain = self.chain
        angles = np.zeros(len(chain.arrays.spans)) if initial is None else chain.flat(initial)
        if reach is Reach.NOT_SEEN:
            return self._not_seen(chain.pose(np.full_like(angles, np.nan)))
        restarts = self.restarts if reach is Reach.WITHIN else 0
        residual, iterations = solve_chain(
            chain.arrays, goal, self.tolerance_m, self.max_iterations, restarts, angles
        )
        positions, orientations = chain.forward_flat(angles)
        rotation = np.array(frame)
        shortest_m = 1e-9
        return ChainResult(
            positions=positions @ rotation.T + np.array(root),
            orientations=rotation @ orientations,
            angles=chain.pose(angles),
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

    def _not_seen(self, nowhere: Pose) -> ChainResult:
        count = len(self.chain.links)
        positions, orientations = np.full((count + 1, 3), np.nan), np.full((count, 3, 3), np.nan)
        return ChainResult(positions, orientations, nowhere, float("nan"), 0, False, Reach.NOT_SEEN, False)


@kernel
def solve_chain(
    chain: ChainArrays, goal: Vector, tolerance_m: float, max_iterations: int, restarts: int, angles: Float
) -> tuple[float, int]:
    """Bring the chain's end to `goal` [m], root frame, finite.

    Args:
        chain, goal, tolerance_m, max_iterations: As of `Fabrik`.
        restarts: Attempts from bent poses as long as the target is not reached.
        angles: (n,) [rad]; in: seed; out: the best legal pose found.

    Returns:
        Distance of the end to the goal [m]; iterations of all attempts.
    """
    clamp_angles(chain, angles)
    residual, iterations = _attempt(chain, goal, tolerance_m, max_iterations, angles)
    trial = np.empty_like(angles)
    for front, back in _RESTART_BENDS:
        if residual <= tolerance_m or restarts <= 0:
            break
        restarts -= 1
        _bend_to(chain, length(goal), front, back, trial)
        aim(chain, end_of(chain, trial), goal, trial)
        clamp_angles(chain, trial)
        found, more = _attempt(chain, goal, tolerance_m, max_iterations, trial)
        iterations += more
        if found < residual:
            residual = found
            for i in range(len(angles)):
                angles[i] = trial[i]
    return residual, iterations


@inner
def _bend_to(chain: ChainArrays, distance: float, front: float, back: float, angles: Float) -> None:
    """Write the bent pose whose end is as far from the root as the target."""
    low, high = 0.0, 1.0
    restart_halvings = 14
    for _ in range(restart_halvings):
        share = 0.5 * (low + high)
        _bend(chain, share, front, back, angles)
        if length(end_of(chain, angles)) > distance:
            low = share
        else:
            high = share
    _bend(chain, 0.5 * (low + high), front, back, angles)


@inner
def _bend(chain: ChainArrays, share: float, front: float, back: float, angles: Float) -> None:
    """Bend every hinge by a share of its longer way from rest, weighted."""
    last = max(len(chain.joints) - 1, 1)
    for k in range(len(chain.joints)):
        limits = limits_of(chain, k)
        rest = clamp(limits, (0.0, 0.0))
        if limits.kind == HINGE:
            end = limits.high if limits.high - rest[0] >= rest[0] - limits.low else limits.low
            weight = front + (back - front) * k / last
            rest = (rest[0] + min(share * weight, 1.0) * (end - rest[0]), 0.0)
        put_angles(chain, angles, k, rest)
    clamp_angles(chain, angles)


@kernel
def _attempt(
    chain: ChainArrays, goal: Vector, tolerance_m: float, max_iterations: int, angles: Float
) -> tuple[float, int]:
    """FABRIK from legal angles, which become the best, until it arrives or stalls."""
    best = length(minus(end_of(chain, angles), goal))
    if best <= tolerance_m:
        return best, 0
    count = len(chain.joints)
    positions, orientations = np.empty((count + 1, 3)), np.empty((count, 9))
    places, now = np.empty((count + 1, 3)), angles.copy()
    forward(chain, now, positions, orientations)
    slow, last = 0, best
    for iteration in range(1, max_iterations + 1):
        # hinges keep the chain in a plane, and only the first joint can turn that to the goal
        aim(chain, vector_at(positions, count, START), goal, now)
        forward(chain, now, positions, orientations)
        backward_pass(chain, positions, orientations, now, goal, places)
        forward_pass(chain, places, now, positions, orientations)
        residual = length(minus(vector_at(positions, count, START), goal))
        stall = 0.995
        slow = slow + 1 if residual > stall * last else 0
        last = residual
        if residual < best:
            best = residual
            for i in range(len(angles)):
                angles[i] = now[i]
        stall_iterations = 6
        if best <= tolerance_m or slow >= stall_iterations:
            return best, iteration
    return best, max_iterations
