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
leave its line. Hence the seed (from the closed form, `master.ik.finger`, it starts on the target), and, when
an attempt stalls, restarts from bent poses turned to the target. The best pose found is returned with its
residual; nothing is claimed that is not so, and no finite target raises or gives NaN.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from math import dist, isfinite

from master.ik.chain import Chain, nearest_reach
from master.ik.chain_result import ChainResult, Pose, Reach, not_seen
from master.ik.finger import FingerSolver
from master.ik.joints import Angles, Hinge, Rotor
from master.ik.vectors import (
    IDENTITY,
    Matrix,
    Vector,
    between,
    length,
    minus,
    product,
    rotate,
    rotate_back,
    transposed,
    turned,
)

_RESTART_BENDS = ((1.0, 1.0), (2.0, 0.5), (0.5, 2.0))
"""How a restart shares out its bend between the front and the back of the chain."""
_RESTART_HALVINGS = 14
_STALL = 0.995
_STALL_ITERATIONS = 6
_SHORTEST_M = 1e-9


@dataclass(frozen=True, slots=True)
class _Attempt:
    positions: list[Vector]
    orientations: list[Matrix]
    angles: list[Angles]
    residual: float
    iterations: int


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
            ValueError: Tolerance or iterations are not positive.
        """
        if not tolerance_m > 0.0 or max_iterations < 1:
            raise ValueError(
                f"tolerance {tolerance_m} m and {max_iterations} iterations: both must be positive"
            )
        return cls(chain, sum(chain.lengths), nearest_reach(chain), tolerance_m, max_iterations, restarts)

    def solve(
        self,
        target: Vector,
        seed: Pose | None = None,
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
        links = self.chain.links
        if reach is Reach.NOT_SEEN:
            return not_seen(self.chain)
        rest: Pose = tuple((0.0, 0.0) if isinstance(link.joint, Rotor) else (0.0,) for link in links)
        best: _Attempt | None = None
        iterations = 0
        for start in self._starts(rest if seed is None else seed, goal):
            attempt = self._attempt(self.chain.clamp(start), goal)
            iterations += attempt.iterations
            if best is None or attempt.residual < best.residual:
                best = attempt
            if best.residual <= self.tolerance_m or reach is not Reach.WITHIN:
                break
        assert best is not None  # the seed is always tried
        shifted = [rotate(frame, p) for p in best.positions]
        return ChainResult(
            positions=tuple((p[0] + root[0], p[1] + root[1], p[2] + root[2]) for p in shifted),
            orientations=tuple(product(frame, m) for m in best.orientations),
            angles=tuple(best.angles),
            residual_m=best.residual,
            iterations=iterations,
            reached=best.residual <= self.tolerance_m,
            reach=reach,
            degenerate=min(self.chain.lengths) < _SHORTEST_M or length(goal) < _SHORTEST_M,
        )

    def _reach(self, goal: Vector) -> Reach:
        distance = length(goal)
        if not isfinite(distance):
            return Reach.NOT_SEEN
        if distance > self.farthest_m + self.tolerance_m:
            return Reach.TOO_FAR
        return Reach.TOO_NEAR if distance < self.nearest_m - self.tolerance_m else Reach.WITHIN

    def _starts(self, seed: Pose, goal: Vector) -> Iterator[Pose]:
        """The seed, then bent poses as long as the target is far, turned to it: never on one line with it."""
        yield seed
        distance = length(goal)
        for front, back in _RESTART_BENDS[: self.restarts]:
            low, high = 0.0, 1.0
            for _ in range(_RESTART_HALVINGS):
                share = 0.5 * (low + high)
                pose = self._bent(share, front, back)
                end = self.chain.forward(pose)[0][-1]
                low, high = (share, high) if length(end) > distance else (low, share)
            pose = self._bent(0.5 * (low + high), front, back)
            yield self._aimed(pose, self.chain.forward(pose)[0][-1], goal)

    def _aimed(self, pose: Pose, end: Vector, goal: Vector) -> Pose:
        """The pose with its first joint turned so that the end lies towards the goal."""
        first = self.chain.links[0]
        arm = rotate_back(first.joint.rotation(pose[0]), rotate_back(first.turn, end))
        return first.joint.fit(arm, rotate_back(first.turn, goal), pose[0]), *pose[1:]

    def _bent(self, share: float, front: float, back: float) -> Pose:
        """Every hinge bent by its share of the longer way from rest; weight from `front` to `back`."""
        links = self.chain.links
        bent: list[Angles] = []
        for k, link in enumerate(links):
            joint = link.joint
            if isinstance(joint, Hinge):
                (rest,) = joint.clamp((0.0,))
                end = joint.high_rad if joint.high_rad - rest >= rest - joint.low_rad else joint.low_rad
                weight = front + (back - front) * k / max(len(links) - 1, 1)
                bent.append((rest + min(share * weight, 1.0) * (end - rest),))
            else:
                bent.append(joint.clamp((0.0, 0.0)))
        return self.chain.clamp(tuple(bent))

    def _attempt(self, start: Pose, goal: Vector) -> _Attempt:
        """FABRIK from one start until it arrives, stalls or tires; the best pose on the way."""
        positions, orientations = self.chain.forward(start)
        angles = list(start)
        best = _Attempt(positions, orientations, angles, dist(positions[-1], goal), 0)
        slow, last = 0, best.residual
        for iteration in range(1, self.max_iterations + 1):
            if best.residual <= self.tolerance_m or slow >= _STALL_ITERATIONS:
                return best
            # hinges keep the chain in a plane, and only the first joint can turn that to the goal
            angles = list(self._aimed(tuple(angles), positions[-1], goal))
            positions, orientations = self.chain.forward(tuple(angles))
            places = self._backward(positions, orientations, angles, goal)
            positions, orientations, angles = self._forward(places, angles)
            residual = dist(positions[-1], goal)
            slow = slow + 1 if residual > _STALL * last else 0
            last = residual
            kept = best if residual >= best.residual else None
            best = _Attempt(
                kept.positions if kept else positions,
                kept.orientations if kept else orientations,
                kept.angles if kept else angles,
                min(residual, best.residual),
                iteration,
            )
        return best

    def _backward(
        self, positions: list[Vector], orientations: list[Matrix], angles: list[Angles], goal: Vector
    ) -> list[Vector]:
        """Places of the joints when the end is on the target, limits between neighbours kept."""
        links = self.chain.links
        last = len(links) - 1
        places = list(positions)
        places[last + 1] = goal
        behind = self._pointed(last, orientations[last], angles[last], minus(goal, positions[last]))
        places[last] = minus(goal, rotate(behind, links[last].bone))
        for k in range(last - 1, -1, -1):
            wanted = minus(places[k + 1], positions[k])
            next_link, bone = links[k + 1], links[k].bone
            joint = next_link.joint
            if links[k].joint.frame == "world" or joint.frame == "world":
                here = self._pointed(k, orientations[k], angles[k], wanted)
            elif isinstance(joint, Hinge):
                # seen from the bone behind, this bone turns the other way about the same axis
                mirrored = Hinge(-joint.high_rad, -joint.low_rad, joint.axis)
                seen = rotate_back(next_link.turn, bone)
                (angle,) = mirrored.fit(seen, rotate_back(behind, wanted), (-angles[k + 1][0],))
                undo = product(mirrored.rotation((angle,)), transposed(next_link.turn))
                here = product(behind, undo)
            else:
                here = self._agree(turned(orientations[k], bone, wanted), behind, k + 1, angles[k + 1])
            places[k] = minus(places[k + 1], rotate(here, bone))
            behind = here
        return places

    def _pointed(self, k: int, now: Matrix, angles: Angles, wanted: Vector) -> Matrix:
        """Orientation of link k whose bone points as wanted, as far as a joint with axes of the world allows."""
        link = self.chain.links[k]
        if link.joint.frame == "local":
            return turned(now, link.bone, wanted)
        fitted = link.joint.fit(link.bone, rotate_back(link.turn, wanted), angles)
        return product(link.turn, link.joint.rotation(fitted))

    def _agree(self, here: Matrix, behind: Matrix, k: int, now: Angles) -> Matrix:
        """Turn a link so that the bone after its rotor k lies in a direction the rotor allows."""
        link = self.chain.links[k]
        frame = product(here, link.turn)
        actual = rotate(behind, link.bone)
        angles = link.joint.fit(link.bone, rotate_back(frame, actual), now)
        allowed = rotate(frame, rotate(link.joint.rotation(angles), link.bone))
        return product(between(allowed, actual), here)

    def _forward(
        self, places: list[Vector], now: list[Angles]
    ) -> tuple[list[Vector], list[Matrix], list[Angles]]:
        """The legal pose whose bones point to the places of the backward pass."""
        position: Vector = (0.0, 0.0, 0.0)
        positions, orientations, angles = [position], list[Matrix](), list[Angles]()
        coupling = self.chain.coupling
        for k, link in enumerate(self.chain.links):
            frame = self.chain.rest_frame(k, orientations)
            if coupling is not None and k == coupling.follower:
                fitted = link.joint.clamp((coupling.ratio * angles[coupling.leader][0],))
            else:
                wanted = rotate_back(frame, minus(places[k + 1], position))
                fitted = link.joint.fit(link.bone, wanted, now[k])
            orientation = product(frame, link.joint.rotation(fitted))
            x, y, z = rotate(orientation, link.bone)
            position = (position[0] + x, position[1] + y, position[2] + z)
            angles.append(fitted)
            orientations.append(orientation)
            positions.append(position)
        return positions, orientations, angles


def solve_chain(
    chain: Chain,
    target: Vector,
    seed: Pose | None = None,
    *,
    root: Vector = (0.0, 0.0, 0.0),
    frame: Matrix = IDENTITY,
    tolerance_m: float = 1e-5,
    max_iterations: int = 100,
) -> ChainResult:
    """One target for one chain; prepare a `Fabrik` for many. Arguments as of `Fabrik.of` and `Fabrik.solve`."""
    return Fabrik.of(chain, tolerance_m, max_iterations).solve(target, seed, root, frame)


def solve_finger(fabrik: Fabrik, closed_form: FingerSolver, target: Vector) -> ChainResult:
    """One finger, seeded by the closed form; `target` and result in the palm frame [m].

    Args:
        fabrik: Prepared from `closed_form.chain`.
        closed_form: The same finger.
        target: The observed point. NaN: not seen.
    """
    a, f, pip, dip, _, _ = closed_form.solve(target)
    if not isfinite(a):
        return not_seen(fabrik.chain)
    return fabrik.solve(target, ((a, f), (pip,), (dip,)), closed_form.root)
