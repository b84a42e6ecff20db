"""A finger of a hand: its chain, its closed form, and FABRIK from there."""

from collections.abc import Callable
from dataclasses import dataclass
from math import inf, isfinite, nan
from typing import NamedTuple

import numpy as np

from common.arrays import Float
from common.hand.model import CHAINS, HandModel
from common.kernels import bound, constant, kernel
from master.fabrik.chain import Chain, Coupling, Link
from master.fabrik.chain_arrays import ChainArrays, end_of
from master.fabrik.closed_form import REACHED_M, closed_form, distance2_of, distances2, nearest_pose
from master.fabrik.fabrik import solve_chain
from master.fabrik.joints import Hinge, Rotor
from master.fabrik.limits import Pair
from master.fabrik.rotations import IDENTITY, Vector, as_matrix, as_vector, length, minus

THUMB = 0
Four = tuple[float, float, float, float]

_GRID = 2001
_NO_RESTARTS = constant(0)
_NAN = float("nan")
_UNKNOWN = (_NAN,) * 4


class FingerSolution(NamedTuple):
    """Angles of one finger [rad] and how well they fit.

    The thumb's are CMC abduction, CMC flexion, MCP and IP.

    Attributes:
        residual_m: Distance of the point to the target.
        reached: Whether legal angles hit the target within 1 um.
    """

    abduction_rad: float
    flexion_rad: float
    pip_rad: float
    dip_rad: float
    residual_m: float
    reached: bool


class FingerResult(NamedTuple):
    """How FABRIK ended on one finger.

    Attributes:
        residual_m: Distance of the point to the target; NaN: not seen.
        iterations: 0: the seed was on the target.
        reached: Residual within the tolerance.
    """

    residual_m: float
    iterations: int
    reached: bool


NOT_SEEN = FingerSolution(_NAN, _NAN, _NAN, _NAN, _NAN, False)


@dataclass(frozen=True, slots=True, eq=False)
class FingerSolver:
    """Closed form of one finger of one hand, prepared; build once with `of`.

    Attributes:
        chain: The finger's links and limits, root frame (the palm's axes, origin at the root joint).
        root: MCP (thumb: CMC) in the palm frame [m].
        ratio: DIP per PIP that makes the closed form exact.
        edges: (B + 1,) ends of the branches of the PIP, rising [rad].
        start: `start_of`, bound to the types of this finger.
    """

    chain: Chain
    root: Vector
    ratio: float
    edges: Float
    start: Callable[..., float]

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
                ratio it tends to, else that of their highest angles, with which every distance is reached.
        """
        chain = finger_chain(model, finger, offset_m)
        (_, pip_high), (_, dip_high) = chain.spans[2:]
        if chain.coupling is not None:
            ratio = chain.coupling.ratio
        elif free_ratio is not None:
            ratio = free_ratio
        elif finger != THUMB and model.dip_per_pip is not None:
            ratio = model.dip_per_pip
        else:
            ratio = dip_high / pip_high if pip_high > 0.0 else 1.0
        edges, four, goal = _branches(chain, float(ratio)), np.zeros(4), (0.0, 0.0, 0.0)
        start = bound(start_of, chain.arrays, edges, float(ratio), goal, four, four)
        return cls(chain, finger_root(model, finger), float(ratio), edges, start)

    @property
    def limits(self) -> tuple[Pair, ...]:
        """Low and high of the four angles [rad]; as of `Chain.spans`."""
        return self.chain.spans

    def solve(self, target: Vector, warm_start: Four | None = None) -> FingerSolution:
        """Angles that bring the point to `target`, or as near to it as the limits allow.

        Args:
            target: (x, y, z) of the point in the palm frame [m]. NaN: not seen.
            near: Angles of a moment ago; where several legal poses hit the target (straight finger, pole of
                the abduction) the nearest is taken, else the more bent one.

        Returns:
            Angles inside the limits; NaN where the target is not finite.
        """
        goal = minus(target, self.root)
        if not isfinite(length(goal)):
            return NOT_SEEN
        before, angles = np.array(_UNKNOWN if warm_start is None else warm_start), np.empty(4)
        left = self.start(self.chain.arrays, self.edges, self.ratio, goal, before, angles)
        a, f, pip, dip = angles.tolist()
        return FingerSolution(a, f, pip, dip, left, left < REACHED_M)

    def forward(self, angles: Four) -> Vector:
        """The point [m] in the palm frame at given angles [rad]."""
        x, y, z = end_of(self.chain.arrays, np.array(angles, np.float64))
        return x + self.root[0], y + self.root[1], z + self.root[2]


@dataclass(frozen=True, slots=True, eq=False)
class Finger:
    """FABRIK for one finger of one hand, prepared. Holds no state between calls.

    Attributes:
        closed_form: The same finger.
        tolerance_m: Residual that counts as reached.
        max_iterations: Of FABRIK; the seed is the answer, and what it cannot reach iterations improve little.
        bring: `bring_onto`, bound to the types of this finger.
    """

    closed_form: FingerSolver
    tolerance_m: float
    max_iterations: int
    bring: Callable[..., tuple[float, int]]

    @classmethod
    def of(
        cls,
        model: HandModel,
        finger: int,
        offset_m: Float,
        tolerance_m: float = 1e-5,
        max_iterations: int = 10,
    ) -> "Finger":
        """Prepare one finger; arguments as of `FingerSolver.of`.

        Raises:
            ValueError: Tolerance or iterations are not positive.
        """
        if not tolerance_m > 0.0 or max_iterations < 1:
            raise ValueError(
                f"tolerance {tolerance_m} m and {max_iterations} iterations: both must be positive"
            )
        solver = FingerSolver.of(model, finger, offset_m)
        chain, root, tolerance_m = solver.chain.arrays, solver.root, float(tolerance_m)
        target, angles = np.zeros(3), np.zeros(4)
        bring = bound(
            bring_onto, chain, solver.edges, solver.ratio, root, target, tolerance_m, max_iterations, angles
        )
        return cls(solver, tolerance_m, max_iterations, bring)

    def solve(self, target_m: Float, angles_rad: Float) -> FingerResult:
        """Bring the finger's point to a target: FABRIK from the closed form.

        Where the DIP is free (always the thumb's) the point does not fix all angles, and FABRIK starts from the given
        ones; from the closed form only where they are NaN or do not lead to the target.

        Args:
            target_m: (3,) in the palm frame. NaN: not seen.
            angles_rad: (4,) in place, contiguous; in: the angles of a moment ago, NaN: not known; out: the best legal
                angles found, or as given where the target is not finite.
        """
        solver, tolerance_m, most = self.closed_form, self.tolerance_m, self.max_iterations
        residual, iterations = self.bring(
            solver.chain.arrays,
            solver.edges,
            solver.ratio,
            solver.root,
            target_m,
            tolerance_m,
            most,
            angles_rad,
        )
        return FingerResult(residual, iterations, residual <= tolerance_m)


@kernel
def start_of(
    chain: ChainArrays, edges: Float, ratio: float, goal: Vector, warm_start: Float, angles: Float
) -> float:
    """Return the start pose of FABRIK.

    It is the closed form, or the legal pose nearest to the target.

    Args:
        chain, edges, ratio, goal, near: As of `closed_form`.
        angles: (4,) [rad], out.

    Returns:
        Distance of the point to the target [m].
    """
    initial_angles = np.empty((3, 4))
    left = closed_form(chain, edges, ratio, goal, warm_start, angles, initial_angles)
    return left if left < inf else nearest_pose(chain, goal, warm_start, initial_angles, angles)


@kernel
def bring_onto(
    chain: ChainArrays,
    edges: Float,
    ratio: float,
    root: Vector,
    target: Float,
    tolerance_m: float,
    max_iterations: int,
    angles: Float,
) -> tuple[float, int]:
    """Bring a finger onto its target, as `Finger.solve`.

    Returns the distance that is left [m], NaN where nothing is seen, and the iterations.
    """
    goal = minus((target[0], target[1], target[2]), root)
    if not isfinite(length(goal)):
        return nan, 0
    warm_start, before = angles.copy(), 0
    if chain.follower < 0 and isfinite(warm_start.sum()):
        residual, before = solve_chain(chain, goal, tolerance_m, max_iterations, _NO_RESTARTS, angles)
        if residual <= tolerance_m:
            return residual, before
    start_of(chain, edges, ratio, goal, warm_start, angles)
    residual, iterations = solve_chain(chain, goal, tolerance_m, max_iterations, _NO_RESTARTS, angles)
    return residual, before + iterations


def finger_chain(model: HandModel, finger: int, offset_m: Float, *, coupled: bool = True) -> Chain:
    """The chain from a finger's MCP (thumb: CMC) to a point fixed to its tip joint.

    Args:
        model: The hand.
        finger: 0 thumb ... 4 little.
        offset_m: End effector (3,) in the tip joint's frame [m]; zero: the tip joint itself.
        coupled: Whether the DIP follows the PIP where the model keeps their ratio exactly (never for the thumb).
    """
    limits = [(float(low), float(high)) for low, high in model.limits_rad[finger]]
    rest = as_matrix(model.rest_rotation[CHAINS[finger, 0]])
    link_rotation, bone = model.link_rotation[finger], model.bone_m[finger]
    thumb = finger == THUMB
    root = Rotor(
        limits[0],
        limits[1],
        spread_at_full_flexion=float(model.spread_at_full_flexion[finger]),
        sign=model.side_sign,
        rest=IDENTITY if thumb else rest,
    )
    last = bone[2] + link_rotation[2] @ np.asarray(offset_m, dtype=np.float64)
    links = (
        Link(rest if thumb else IDENTITY, root, as_vector(bone[0])),
        Link(as_matrix(link_rotation[0]), Hinge(*limits[2]), as_vector(bone[1])),
        Link(as_matrix(link_rotation[1]), Hinge(*limits[3]), as_vector(last)),
    )
    ratio = model.dip_per_pip
    if not coupled or thumb or ratio is None or model.dip_spread_rad > 0.0:
        return Chain(links)
    return Chain(links, Coupling(1, 2, ratio))


def finger_root(model: HandModel, finger: int) -> Vector:
    """The MCP (thumb: CMC) in the palm frame [m]."""
    return as_vector(model.rest_position_m[CHAINS[finger, 0]])


def _branches(chain: Chain, ratio: float) -> Float:
    """Ends of the stretches of the PIP on which |w| is monotone, rising [rad]."""

    def distance2(pip: float) -> float:
        return distance2_of(chain.arrays, ratio, pip)[0]

    (low, high), dip_span = chain.spans[2:]
    grid, squares = np.linspace(low, high, _GRID), np.empty(_GRID)
    distances2(chain.arrays, ratio, grid, squares)
    rising = np.diff(squares) > 0.0
    cuts = {low, high}
    for i in np.flatnonzero(rising[1:] != rising[:-1]).tolist():
        cuts.add(_extremum(distance2, float(grid[i]), float(grid[i + 2]), maximum=bool(rising[i])))
    if ratio > 0.0:
        cuts |= {bound / ratio for bound in dip_span if low < bound / ratio < high}
    edges = sorted(cuts)
    return np.array(edges if len(edges) > 1 else edges * 2, np.float64)


def _extremum(function: Callable[[float], float], low: float, high: float, *, maximum: bool) -> float:
    """By thirds: the curve is smooth and has one extremum inside."""
    thirds = 52
    for _ in range(thirds):
        third = (high - low) / 3.0
        if (function(low + third) < function(high - third)) == maximum:
            low += third
        else:
            high -= third
    return 0.5 * (low + high)
