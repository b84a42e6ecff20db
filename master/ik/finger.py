"""Finger angles from one point on the finger, in closed form: seed and oracle of FABRIK.

A point leaves one angle free; with DIP = ratio * PIP the finger is exactly determined. In the MCP's frame the
point lies at w(PIP), which neither flexion nor abduction can stretch:

    |target - MCP| = |w(PIP)|        monotone but for a few degrees round the straight finger -> PIP
    R_y(a) rest R_x(-f) w = target   y gives the flexion, x and z the abduction: two atan2

This holds for bones out of plane too. The 1-D inversion is a table per monotone branch over
s = sqrt(|w|_max^2 - |w|^2): PIP and w are smooth in s, also at the straight finger, where they are not in |w|.
The thumb is the same chain (CMC, MCP, IP); its IP follows its MCP by the ratio of their highest angles, so that
one ratio reaches every distance the two can reach. Where that ratio cannot hit the target but another pair can
(only a thumb, or a hand whose DIP is free), damped least squares finds it from there, bounded by the limits.

Targets that no legal pose hits get the bounded least-squares pose (stretched or bent towards the target) and
`reached` False. Tables are built once per hand; solving is plain Python on single numbers.
"""

from dataclasses import dataclass
from math import cos, dist, isfinite, sin

from common.arrays import Float
from common.hand_model import HandModel
from master.ik.bounded import Four, bounded_least_squares
from master.ik.chain import THUMB, Chain, finger_chain, finger_root
from master.ik.finger_table import SLACK_RAD, FingerSolution, Quick, quick_solver
from master.ik.joints import Hinge, Rotor, swing_and_flex
from master.ik.reach_table import Branch, ReachCurve
from master.ik.vectors import Matrix, Vector, dot, rotate, rotate_back

REACHED_M = 1e-6
_EDGE = 1e-12
"""Relative slack of a squared distance at the end of a branch."""
_SPREAD_OF_SEEDS = ((0.1, 0.9), (0.9, 0.1), (0.5, 0.0), (0.5, 1.0), (0.0, 0.5), (1.0, 0.5))
"""PIP and DIP, as shares of their ranges, from which a free pair is sought when the coupled one fails."""
_NAN = float("nan")


NOT_SEEN = FingerSolution(_NAN, _NAN, _NAN, _NAN, _NAN, False)


@dataclass(frozen=True, slots=True, eq=False)
class FingerSolver:
    """One finger of one hand, prepared; build once with `of`.

    Attributes:
        chain: The finger's links and limits, root frame (the palm's axes, origin at the root joint).
        root: MCP (thumb: CMC) in the palm frame [m].
        curve, branches: PIP -> distance, and back.
        limits: Low and high of the four angles; the abduction's where flexion does not narrow it.
        before: Turn in front of the abduction (thumb), else None.
        rest: Turn between abduction and flexion (identity for the thumb).
        quick: For each branch, the usual target's pose or None (`master.ik.finger_table`).
    """

    chain: Chain
    root: Vector
    curve: ReachCurve
    branches: tuple[Branch, ...]
    limits: tuple[tuple[float, float], ...]
    before: Matrix | None
    rest: Matrix
    sign: float
    quick: tuple[Quick, ...]

    @classmethod
    def of(
        cls, model: HandModel, finger: int, offset_m: Float, free_ratio: float | None = None
    ) -> "FingerSolver":
        """Prepare one finger.

        Args:
            model: The hand.
            finger: 0 thumb ... 4 little.
            offset_m: The observed point (3,) in the tip joint's frame [m]; zero: the tip joint.
            free_ratio: DIP (thumb: IP) per PIP (MCP) to prefer where the model leaves it free; None: the
                ratio it tends to, else that of their highest angles.
        """
        chain = finger_chain(model, finger, offset_m)
        joint = chain.links[0].joint
        if not isinstance(joint, Rotor):
            raise TypeError("a finger's first joint is a rotor")
        (_, pip_high), (_, dip_high) = chain.spans[2:]
        if chain.coupling is not None:
            ratio = chain.coupling.ratio
        elif free_ratio is not None:
            ratio = free_ratio
        elif finger != THUMB and model.dip_per_pip is not None:
            ratio = model.dip_per_pip
        else:
            ratio = dip_high / pip_high if pip_high > 0.0 else 1.0
        curve = ReachCurve.of(chain, ratio)
        branches = curve.branches()
        root, before = finger_root(model, finger), chain.links[0].turn if finger == THUMB else None
        return cls(
            chain=chain,
            root=root,
            curve=curve,
            branches=branches,
            limits=chain.spans,
            before=before,
            rest=joint.rest,
            sign=joint.sign,
            quick=tuple(quick_solver(chain, root, before, curve, branch) for branch in branches),
        )

    @property
    def ratio(self) -> float:
        """DIP per PIP that makes the closed form exact."""
        return self.curve.ratio

    def solve(self, target: Vector, near: Four | None = None) -> FingerSolution:
        """Angles that bring the point to `target`.

        Args:
            target: (x, y, z) of the point in the palm frame [m]. NaN: not seen.
            near: Angles of a moment ago; where several legal poses hit the target (straight finger, pole of
                the abduction) the nearest is taken, else the more bent one.

        Returns:
            Angles inside the limits; NaN where the target is not finite.
        """
        if near is None:
            for quick in self.quick:
                found = quick(target)
                if found is not None:
                    return found
        x, y, z = self._local(target)
        if not isfinite(x + y + z):
            return NOT_SEEN
        return self._thorough((x, y, z), near)

    def reachable(self, target: Vector) -> FingerSolution | None:
        """The coupled, legal pose that hits `target` (palm frame, [m]), or None: a few microseconds either way."""
        return next((found for quick in self.quick if (found := quick(target)) is not None), None)

    def _local(self, target: Vector) -> Vector:
        """The target from the root, in the frame the tables are made in."""
        root = self.root
        here = (target[0] - root[0], target[1] - root[1], target[2] - root[2])
        return here if self.before is None else rotate_back(self.before, here)

    def forward(self, angles: Four) -> Vector:
        """The point [m] in the palm frame at given angles [rad]."""
        a, f, pip, dip = angles
        x, y, z = self.chain.forward(((a, f), (pip,), (dip,)))[0][-1]
        return x + self.root[0], y + self.root[1], z + self.root[2]

    def _thorough(self, target: Vector, near: Four | None) -> FingerSolution:
        """Every branch and both flexions; where none is legal or exact enough, bounded least squares."""
        seeds: list[tuple[float, float, Four]] = []
        distance2 = dot(target, target)
        for rank, branch in enumerate(self.branches):
            pip, w = self.curve.exact(branch, distance2)
            off = max(distance2 - branch.far2, branch.near2 - distance2)
            for angles, miss in self._swings(pip, self.ratio * pip, w, target):
                legal = miss <= SLACK_RAD and off <= _EDGE * branch.far2
                close = rank if near is None else sum(abs(p - q) for p, q in zip(angles, near, strict=True))
                seeds.append((0.0 if legal else 1.0 + miss + 1e2 * max(off, 0.0) ** 0.5, close, angles))
        seeds.sort()
        goal = target if self.before is None else rotate(self.before, target)
        for penalty, _, angles in seeds:
            if penalty == 0.0:
                # bones out of plane cannot point exactly at the pole: legal angles may still miss
                left = self._miss(angles, goal)
                if left < REACHED_M:
                    return FingerSolution(*angles, left, True)
        return self._fallback([angles for _, _, angles in seeds[:2]], target, goal, near)

    def _improve(self, seed: Four, goal: Vector) -> FingerSolution:
        angles, left = bounded_least_squares(self.chain, seed, goal, 0.05 * REACHED_M)
        return FingerSolution(*angles, left, left < REACHED_M)

    def _swings(self, pip: float, dip: float, w: Vector, target: Vector) -> list[tuple[Four, float]]:
        """Both legalised poses of one PIP, and by how much each had to be cut [rad]."""
        found: list[tuple[Four, float]] = []
        for a, f in swing_and_flex(w, target, self.rest, self.sign):
            ((ca, cf), (cp,), (cd,)) = self.chain.clamp(((a, f), (pip,), (dip,)))
            found.append(((ca, cf, cp, cd), max(abs(ca - a), abs(cf - f))))
        return found

    def _fallback(self, seeds: list[Four], target: Vector, goal: Vector, near: Four | None) -> FingerSolution:
        """No closed-form pose is legal: improve the nearest ones inside the limits."""
        seeds = [self._in_plane(seeds[0][0], target), *seeds]
        free = self.chain.coupling is None
        if free:
            if near is not None:
                seeds.append(near)
            seeds += [seed for share in _SPREAD_OF_SEEDS for seed in self._free_pair(*share, target)]
        else:
            # a coupled finger that misses in closed form is out of reach: the best start is enough
            seeds = [min(seeds, key=lambda seed: self._miss(seed, goal))]
        best: FingerSolution | None = None
        for seed in seeds:
            solution = self._improve(seed, goal)
            if best is None or solution.residual_m < best.residual_m - 1e-9:
                best = solution
            if best.reached:
                break
        return best or NOT_SEEN

    def _miss(self, angles: Four, goal: Vector) -> float:
        a, f, pip, dip = angles
        return dist(self.chain.forward(((a, f), (pip,), (dip,)))[0][-1], goal)

    def _in_plane(self, abduction: float, target: Vector) -> Four:
        """The abduction is given (cut at its limit): the point of the finger's plane nearest to the target."""
        c, s = cos(self.sign * abduction), sin(self.sign * abduction)
        x, y, z = rotate_back(
            self.rest, (c * target[0] - s * target[2], target[1], s * target[0] + c * target[2])
        )
        branch = self.branches[0]
        _, w = branch.at(y * y + z * z)
        pip, w = branch.at(y * y + z * z + w[0] * w[0])
        (f,) = Hinge(*self.limits[1]).fit(w, (x, y, z), (0.0,))
        return abduction, f, pip, self.ratio * pip

    def _free_pair(self, pip_share: float, dip_share: float, target: Vector) -> list[Four]:
        (p_low, p_high), (d_low, d_high) = self.limits[2:]
        pip, dip = p_low + pip_share * (p_high - p_low), d_low + dip_share * (d_high - d_low)
        w = self.curve.place(pip, dip)
        return [angles for angles, _ in self._swings(pip, dip, w, target)]
