"""General solver for limited chains: FABRIK with the joint limits in both passes (K24, K25).

Aristidou & Lasenby, "FABRIK: a fast, iterative solver for the inverse kinematics problem", 2011. One iteration:

    backward   put the end on the target and walk to the root: each bone keeps its length and points as it did,
               as far as the joint between it and the bone behind it allows
    forward    put the root back and walk to the end: each bone points to its place of the backward pass, as far
               as its own joint allows

The forward pass ends legal, so every pose that leaves this file obeys the limits; joints keep full orientations,
so bones need not be straight or planar. A coupled hinge follows its leader in the forward pass.

FABRIK as published deadlocks on reachable targets: a limit flattens a finger and a straight limited chain cannot
leave its line (I8). Hence the seed (from the closed form, `master.ik.finger`, it starts on the target), and, when
an attempt stalls, restarts from bent poses turned to the target. The best pose found is returned with its
residual; nothing is claimed that is not so, and no finite target raises or gives NaN.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from math import dist, isfinite, sqrt
from typing import NamedTuple

from master.ik.chain import Chain
from master.ik.finger import FingerSolver
from master.ik.joints import (
    IDENTITY,
    Angles,
    Hinge,
    Matrix,
    Rotor,
    Vector,
    cross,
    dot,
    length,
    product,
    rotate,
    rotate_back,
)

_NAN = float("nan")
_RESTART_SHARES = (0.5, 0.2, 0.8)
_STALL = 0.995
_STALL_ITERATIONS = 6
_SHORTEST_M = 1e-9

Pose = tuple[Angles, ...]


class Reach(Enum):
    """Where the target lies, by distance from the root alone (I6)."""

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
    """

    chain: Chain
    farthest_m: float
    nearest_m: float
    tolerance_m: float
    max_iterations: int

    @classmethod
    def of(cls, chain: Chain, tolerance_m: float = 1e-5, max_iterations: int = 100) -> "Fabrik":
        """Prepare a chain.

        Raises:
            ValueError: Tolerance or iterations are not positive.
        """
        if not tolerance_m > 0.0 or max_iterations < 1:
            raise ValueError(
                f"tolerance {tolerance_m} m and {max_iterations} iterations: both must be positive"
            )
        return cls(chain, sum(chain.lengths), _nearest(chain), tolerance_m, max_iterations)

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
        goal = rotate_back(frame, _minus(target, root))
        reach = self._reach(goal)
        links = self.chain.links
        if reach is Reach.NOT_SEEN:
            return _not_seen(self.chain)
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
        """The seed, then bent poses whose end points to the target: never on one line with it."""
        yield seed
        for share in _RESTART_SHARES:
            bent: list[Angles] = []
            for link in self.chain.links:
                joint = link.joint
                if isinstance(joint, Hinge):
                    bent.append((joint.low_rad + share * (joint.high_rad - joint.low_rad),))
                else:
                    bent.append(joint.clamp((0.0, 0.0)))
            pose = self.chain.clamp(tuple(bent))
            first = self.chain.links[0]
            end = self.chain.forward(pose)[0][-1]
            arm = rotate_back(first.joint.rotation(pose[0]), rotate_back(first.turn, end))
            yield first.joint.fit(arm, rotate_back(first.turn, goal), pose[0]), *pose[1:]

    def _attempt(self, start: Pose, goal: Vector) -> _Attempt:
        """FABRIK from one start until it arrives, stalls or tires; the best pose on the way."""
        positions, orientations = self.chain.forward(start)
        angles = list(start)
        best = _Attempt(positions, orientations, angles, dist(positions[-1], goal), 0)
        slow, last = 0, best.residual
        for iteration in range(1, self.max_iterations + 1):
            if best.residual <= self.tolerance_m or slow >= _STALL_ITERATIONS:
                return best
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
        behind = _turned(orientations[last], links[last].bone, _minus(goal, positions[last]))
        places[last] = _minus(goal, rotate(behind, links[last].bone))
        for k in range(last - 1, -1, -1):
            wanted = _minus(places[k + 1], positions[k])
            next_link, bone = links[k + 1], links[k].bone
            joint = next_link.joint
            if isinstance(joint, Hinge) and joint.frame == "local":
                # seen from the bone behind, this bone turns the other way about the same axis
                mirrored = Hinge(-joint.high_rad, -joint.low_rad, joint.axis)
                seen = rotate_back(next_link.turn, bone)
                (angle,) = mirrored.fit(seen, rotate_back(behind, wanted), (-angles[k + 1][0],))
                undo = product(mirrored.rotation((angle,)), _transposed(next_link.turn))
                here = product(behind, undo)
            else:
                here = _turned(orientations[k], bone, wanted)
                if joint.frame == "local":
                    here = self._agree(here, behind, k + 1, angles[k + 1])
            places[k] = _minus(places[k + 1], rotate(here, bone))
            behind = here
        return places

    def _agree(self, here: Matrix, behind: Matrix, k: int, now: Angles) -> Matrix:
        """Turn a link so that the bone after its rotor k lies in a direction the rotor allows."""
        link = self.chain.links[k]
        frame = product(here, link.turn)
        actual = rotate(behind, link.bone)
        angles = link.joint.fit(link.bone, rotate_back(frame, actual), now)
        allowed = rotate(frame, rotate(link.joint.rotation(angles), link.bone))
        return product(_between(allowed, actual), here)

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
                wanted = rotate_back(frame, _minus(places[k + 1], position))
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
        return _not_seen(fabrik.chain)
    return fabrik.solve(target, ((a, f), (pip,), (dip,)), closed_form.root)


def _not_seen(chain: Chain) -> ChainResult:
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


def _nearest(chain: Chain) -> float:
    """Least |end - root| inside the limits: pattern search over the joints behind the first, several starts."""
    spans = chain.spans
    first = 2 if isinstance(chain.links[0].joint, Rotor) else 1

    def distance(flat: list[float]) -> float:
        pose: list[Angles] = []
        rest = iter(flat)
        for link in chain.links:
            count = 2 if isinstance(link.joint, Rotor) else 1
            pose.append(tuple(next(rest) for _ in range(count)))
        return length(chain.forward(chain.clamp(tuple(pose)))[0][-1])

    least = float("inf")
    for share in (1.0, 0.5, 0.0):
        flat = [
            min(max(0.0, low), high) if i < first else low + share * (high - low)
            for i, (low, high) in enumerate(spans)
        ]
        here, step = distance(flat), 0.25
        while step > 1e-4:
            before = here
            for i in range(first, len(flat)):
                low, high = spans[i]
                for move in (step, -step):
                    trial = flat.copy()
                    trial[i] = min(max(flat[i] + move * (high - low), low), high)
                    found = distance(trial)
                    if found < here:
                        flat, here = trial, found
            if here >= before - 1e-12:
                step *= 0.5
        least = min(least, here)
    return least


def _minus(a: Vector, b: Vector) -> Vector:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def _transposed(m: Matrix) -> Matrix:
    a, b, c = m
    return (a[0], b[0], c[0]), (a[1], b[1], c[1]), (a[2], b[2], c[2])


def _turned(orientation: Matrix, bone: Vector, wanted: Vector) -> Matrix:
    """The orientation turned the shortest way so that its bone points as wanted."""
    return product(_between(rotate(orientation, bone), wanted), orientation)


def _between(a: Vector, b: Vector) -> Matrix:
    """Shortest rotation from direction a to direction b; identity where either has none."""
    scale = length(a) * length(b)
    if not scale > _SHORTEST_M * _SHORTEST_M:
        return IDENTITY
    x, y, z = (component / scale for component in cross(a, b))
    c = dot(a, b) / scale
    if c < -1.0 + 1e-12:
        # half a turn about any axis across a
        least = min(range(3), key=lambda i: abs(a[i]))
        x, y, z = cross(a, (float(least == 0), float(least == 1), float(least == 2)))
        n = sqrt(x * x + y * y + z * z)
        x, y, z = x / n, y / n, z / n
        return (
            (2 * x * x - 1, 2 * x * y, 2 * x * z),
            (2 * x * y, 2 * y * y - 1, 2 * y * z),
            (2 * x * z, 2 * y * z, 2 * z * z - 1),
        )
    k = 1.0 / (1.0 + c)
    return (
        (c + k * x * x, k * x * y - z, k * x * z + y),
        (k * x * y + z, c + k * y * y, k * y * z - x),
        (k * x * z - y, k * y * z + x, c + k * z * z),
    )
