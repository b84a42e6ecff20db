"""The card's solver turns centroids into a hand, finger by finger.

Centroids, disparity, depth, 1 €, palm, FABRIK per finger from its closed form: a hand. Push machine without
clock, socket or thread. It holds what joins the cameras in time, the filter and the last hand.
"""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from math import inf, isfinite, nan
from typing import NamedTuple

import numpy as np

from common.arrays import Bool, Float
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import rigid
from common.hand.model import CHAINS, METACARPALS, PALM, TIPS, WRIST, HandModel
from common.kernels import bound, constant, kernel
from common.messages import MarkerDetections, Source
from master.estimator.epoch import Epoch, Fitted, HandEstimate, SolvedHand
from master.estimator.estimator import Estimator
from master.estimator.parameters import Mounts
from master.estimator.posterior import ON_MARKERS
from master.estimator.state import PALM_PART
from master.fabrik.closed_form import (
    closed_form,
    distance2_of,
    distances2,
    nearest_pose,
)
from master.fabrik.fabrik import Chain, Coupling, Link, back_normal_of, solve_chain, targets_of
from master.fabrik.joints import ChainArrays, Hinge, Rotor, end_of
from master.fabrik.linear_algebra import IDENTITY, Vector, as_matrix, as_vector, length, minus
from master.fabrik.one_euro import PointFilter
from master.fabrik.rays import RayTriangulator
from master.fabrik.settings import FABRIK, NEVER_NS
from master.fabrik.sync import FrameSet, FrameSync
from master.fabrik.triangulate import DepthTriangulator

THUMB = 0
Four = tuple[float, float, float, float]

_NO_RESTARTS = constant(0)
_NAN = float("nan")
_UNKNOWN = (_NAN,) * 4


class FingerSolution(NamedTuple):
    """Angles of one finger [rad] (thumb: CMC, CMC, MCP, IP) and how well they fit."""

    abduction_rad: float
    flexion_rad: float
    pip_rad: float
    dip_rad: float
    residual_m: float  # distance of the point to the target
    reached: bool  # whether legal angles hit the target within 1 um


class FingerResult(NamedTuple):
    """How FABRIK ended on one finger."""

    residual_m: float  # distance of the point to the target; NaN: not seen
    iterations: int  # 0: the seed was on the target
    reached: bool  # residual within the tolerance


NOT_SEEN = FingerSolution(_NAN, _NAN, _NAN, _NAN, _NAN, False)


@dataclass(frozen=True, slots=True, eq=False)
class Finger:
    """One finger of one hand, prepared, without state; build it with `of`."""

    chain: Chain  # its links and limits, root frame (the palm's axes, origin at the root joint)
    root: Vector  # MCP (thumb: CMC) in the palm frame [m]
    ratio: float  # DIP (thumb: IP) per PIP (MCP) that makes the closed form exact
    edges: Float  # (B + 1,) ends of the branches of the PIP, rising [rad]
    tolerance_m: float  # of FABRIK: residual that counts as reached
    max_iterations: int  # the seed is the answer, and what it cannot reach iterations improve little
    start: Callable[..., float]  # `start_of`, and `bring_onto`, bound to the types of this finger
    bring: Callable[..., tuple[float, int]]

    @classmethod
    def of(
        cls,
        model: HandModel,
        finger: int,
        offset_m: Float,
        tolerance_m: float = FABRIK.tolerance_m,
        max_iterations: int = FABRIK.finger_iterations,
    ) -> "Finger":
        """Prepare one finger, 0 thumb ... 4 little.

        The ratio is the model's; where it leaves it free, that of the highest angles, with which every
        distance is reached. `offset_m`: the observed point (3,) in the tip joint's frame [m]; zero: the joint.

        Raises:
            ValueError: Tolerance or iterations are not positive.
        """
        if not tolerance_m > 0.0 or max_iterations < 1:
            raise ValueError(
                f"tolerance {tolerance_m} m and {max_iterations} iterations: both must be positive"
            )
        chain, root = finger_chain(model, finger, offset_m), finger_root(model, finger)
        (_, pip_high), (_, dip_high) = chain.spans[2:].tolist()
        ratio = dip_high / pip_high if pip_high > 0.0 else 1.0
        if chain.coupling is not None:
            ratio = chain.coupling.ratio
        elif finger != THUMB and model.dip_per_pip is not None:
            ratio = model.dip_per_pip
        ratio, tolerance_m = float(ratio), float(tolerance_m)
        edges, angles = _branches(chain, ratio), np.zeros(4)
        prepared = chain.arrays, edges, ratio
        start = bound(start_of, *prepared, (0.0, 0.0, 0.0), angles, angles)
        bring = bound(bring_onto, *prepared, root, np.zeros(3), tolerance_m, max_iterations, angles)
        return cls(chain, root, ratio, edges, tolerance_m, max_iterations, start, bring)

    def solve(self, target_m: Float, angles_rad: Float) -> FingerResult:
        """Bring the finger's point to a target: FABRIK from the closed form.

        Where the DIP is free (always the thumb's) the point does not fix all angles, and FABRIK starts from
        the given ones; from the closed form only where they are NaN or do not lead to the target. `target_m`
        (3,), palm frame; NaN: not seen. `angles_rad` (4,) in place, contiguous; in: those of a moment ago,
        NaN: not known; out: the best legal ones, or as given where the target is not finite.
        """
        prepared = self.chain.arrays, self.edges, self.ratio, self.root
        residual, iterations = self.bring(
            *prepared, target_m, self.tolerance_m, self.max_iterations, angles_rad
        )
        return FingerResult(residual, iterations, residual <= self.tolerance_m)

    def closed_form(self, target: Vector, warm_start: Four | None = None) -> FingerSolution:
        """Angles that bring the point to `target`, or as near to it as the limits allow.

        `target`: (x, y, z) in the palm frame [m]; NaN: not seen, so are the angles. `warm_start`: angles of a
        moment ago; where several legal poses hit the target (straight finger, pole of the abduction) the
        nearest is taken, else the more bent one.
        """
        goal = minus(target, self.root)
        if not isfinite(length(goal)):
            return NOT_SEEN
        before, angles = np.array(_UNKNOWN if warm_start is None else warm_start), np.empty(4)
        left = self.start(self.chain.arrays, self.edges, self.ratio, goal, before, angles)
        a, f, pip, dip = angles.tolist()
        return FingerSolution(a, f, pip, dip, left, left < FABRIK.reached_m)

    def forward(self, angles: Four) -> Vector:
        """The point [m] in the palm frame at given angles [rad]."""
        x, y, z = end_of(self.chain.arrays, np.array(angles, np.float64))
        return x + self.root[0], y + self.root[1], z + self.root[2]


@kernel
def start_of(
    chain: ChainArrays, edges: Float, ratio: float, goal: Vector, warm_start: Float, angles: Float
) -> float:
    """Write the start of FABRIK (4,): closed form, or nearest legal; return distance."""
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
    """Bring a finger onto its target; return the distance [m] and iterations.

    NaN where nothing is seen.
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

    `offset_m` (3,): end effector in the tip joint's frame; zero: the joint itself. `coupled`: whether the DIP
    follows the PIP where the model keeps their ratio exactly (never for the thumb).
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

    low, high = map(float, chain.spans[2])
    dip_span = [float(bound) for bound in chain.spans[3]]
    grid: Float = np.linspace(low, high, FABRIK.grid)
    squares = np.empty(FABRIK.grid)
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
    for _ in range(FABRIK.thirds):
        third = (high - low) / 3.0
        if (function(low + third) < function(high - third)) == maximum:
            low += third
        else:
            high -= third
    return 0.5 * (low + high)


Stage = Callable[[str], AbstractContextManager[None]]
_FIT_M2 = FABRIK.fit_m**2
_PALM_JOINTS = np.array([PALM, WRIST, *METACARPALS])
_IN_VIEW = rigid(
    np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.5])
)  # a hand before a camera at the origin


class FabrikSolver:
    """Solves the hand of a rig by the card's line."""

    def __init__(
        self,
        cameras: dict[str, CameraModel],
        model: HandModel,
        markers: tuple[str, ...],
        hand_markers: tuple[str, ...],
        *,
        sync: FrameSync,
        triangulate: DepthTriangulator | RayTriangulator,
        one_euro: PointFilter | None,
        palm: Estimator,
        once: Estimator,
        stage: Stage = lambda name: nullcontext(),
    ) -> None:
        """Join the parts; cameras in the rig's order, markers in that of every array.

        Args:
            hand_markers: Those of them that are on this hand.
            triangulate: Centroids to points by the rig's depth model.
            one_euro: Filter of the points; None: epochs are unrelated, nothing is filtered or remembered.
            palm: Fits the palm, with the angles that go best with it, from the hand's markers.
            once: The same without memory; fingers that are not seen may be anywhere natural.
            stage: Opens a timer by stage name.
        """
        self.sync, self.triangulate = sync, triangulate
        self._one_euro, self._palm, self._once, self._stage = one_euro, palm, once, stage
        self.continuous = one_euro is not None  # epochs follow each other; else nothing is remembered
        self.on_hand = np.array([markers.index(name) for name in hand_markers], np.int64)
        self._centres = np.array([camera.centre for camera in cameras.values()])
        self._focal_px = np.array([camera.matrix[0, 0] for camera in cameras.values()])
        self._ahead = -next(iter(cameras.values())).T_rig_camera[:3, 2]
        mounts, places = [model.mount(name) for name in hand_markers], Mounts.of(model, hand_markers)
        self._count = len(markers)
        self._back = self.on_hand[places.on_back]
        self._finger_of = places.finger
        self._on_finger = self._finger_of >= 0
        at_tips = {int(self._finger_of[m]): m for m, mount in enumerate(mounts) if mount.joint in TIPS}
        self._fingers = {
            m: (f, Finger.of(model, f, mounts[m].offset_m, FABRIK.target_m)) for f, m in at_tips.items()
        }
        self._last: SolvedHand | None = None
        self._last_ns = NEVER_NS

    def push(self, message: MarkerDetections) -> list[HandEstimate]:
        """Take one camera's centroids; return the hands they complete, oldest first."""
        return [self.solve(frames) for frames in self.sync.push(message)]

    def flush(self) -> list[HandEstimate]:
        """At the end of a recording: the hands that still wait for a camera."""
        return [self.solve(frames) for frames in self.sync.flush()]

    def solve(
        self, frames: FrameSet, warm_start: SolvedHand | None = None, warm_start_age_s: float = 0.0
    ) -> HandEstimate:
        """Solve one epoch.

        `warm_start`: a hand of `warm_start_age_s` ago that is surer than this line's last one, for the side
        of the caps that the cameras see; this line's then has its covariance to first order.
        """
        last, age_s = self._recent(frames.t_ns)
        seen_as, seen_age_s = (last, age_s) if warm_start is None else (warm_start, warm_start_age_s)
        pixels = frames.uv, frames.sigma_px, frames.area
        with self._stage("triangulate"):
            markers = self.triangulate(*pixels, seen_as, seen_age_s)
            if seen_as is None:
                first = self.solve_once(markers.points_m, markers.cov_m2, frames.area)
                markers = self.triangulate(*pixels, first, 0.0, as_seen=first is None)
        with self._stage("filter"):
            smooth = markers.points_m
            if self._one_euro is not None:
                smooth = self._one_euro.push(frames.t_ns, smooth, markers.noise_m2)
        with self._stage("fabrik"):
            back_normal = self.towards(smooth[self.on_hand], frames.area)
            out = HandEstimate.unseen(frames.t_ns, markers, smooth, back_normal)
            palm = self._palm.push(
                Epoch(
                    frames.t_ns, smooth, back_normal, cov_m2=markers.cov_m2, second_order=warm_start is None
                )
            )
            return self._estimate(out, smooth[self.on_hand], markers.cov_m2[self.on_hand], palm)

    def solve_once(self, points: Float, cov: Float, area_px2: Float) -> SolvedHand | None:
        """Solve from points alone and remember nothing; None: they are too few.

        A finger that is not seen may be anywhere natural. `points`, `cov` (M, 3) [m] and (M, 3, 3) [m^2] of
        all markers; NaN: not placed. `area_px2` (C, M) as the cameras see them.
        """
        back_normal = self.towards(points[self.on_hand], area_px2)
        return self._once.push(Epoch(0, points, back_normal, cov_m2=cov)).solution

    def rehearse(self) -> None:
        """Call every kernel once, so that none is compiled while a hand is tracked."""
        self.sync.at(0)
        _, places = self._palm.pose(_IN_VIEW, np.full((5, 4), 0.5))
        points, cov = np.full((self._count, 3), np.nan), np.full((self._count, 3, 3), np.nan)
        points[self.on_hand], cov[self.on_hand] = places, 1e-6 * np.eye(3)
        seen = np.ones((len(self._centres), self._count))
        first = self.solve_once(points, cov, seen)
        self.triangulate(1e2 * np.stack([seen, seen], axis=-1), seen, seen, first, 0.0)
        targets = np.empty_like(places)
        targets_of(places, cov[self.on_hand], _IN_VIEW, places, _FIT_M2, targets)

    def _recent(self, t_ns: int) -> tuple[SolvedHand | None, float]:
        """Return the last hand, if it is still informative, and its age [s]."""
        age_s = (t_ns - self._last_ns) * 1e-9
        if not self.continuous or self._last is None or not 0.0 < age_s <= FABRIK.forget_s:
            return None, 0.0
        return self._last, age_s

    def towards(self, points: Float, area_px2: Float) -> Float:
        """Return the unit vector (3,) from points (H, 3) to cameras that see the back."""
        out = self._ahead.copy()
        back_normal_of(points, area_px2[:, self._back], self._centres, self._focal_px, out)
        return out

    def _estimate(self, out: HandEstimate, points: Float, cov: Float, palm: Fitted) -> HandEstimate:
        """Bring a palm's fingers onto their markers; without a palm hold the last hand."""
        last, age_s = self._recent(out.t_ns)
        fit, triangulated = palm.solution, np.isfinite(points[:, 0])
        if fit is None or not triangulated.any():
            out.valid[:] = last is not None
            return out if last is None else replace(out, solution=_drifted(last, age_s))
        T, angles = fit.T_rig_palm, fit.angles_rad.copy()
        _, fitted = self._palm.pose(T, angles)
        targets = np.empty_like(fitted)
        targets_of(points, cov, T, fitted, _FIT_M2, targets)
        for m, (f, finger) in self._fingers.items():
            if isfinite(targets[m, 0]):
                out.residual_m[f], out.iterations[f], out.reached[f] = finger.solve(targets[m], angles[f])
        joints, _ = self._palm.pose(T, angles)
        off = joints.position_m - fit.joints.position_m
        joint_cov = fit.cov_m2 + off[:, :, None] * off[:, None, :]
        hand = SolvedHand(T, angles, joints, joint_cov, fit.tilt_cov_rad2, fit.tilt_process_noise_rad2_s2)
        self._judge(out, palm, fit.marker_chi2, triangulated)
        self._last, self._last_ns = hand, out.t_ns
        solved = bool(np.isfinite(out.residual_m).any() or out.tracked.any())
        return replace(out, solution=hand, solved=solved)

    def _judge(self, out: HandEstimate, palm: Fitted, marker_chi2: Float, triangulated: Bool) -> None:
        """Write the bits of a solved hand: tracked is what (H,) markers explain."""
        out.seen[self._finger_of[triangulated & self._on_finger]] = True
        inlier = out.seen.copy()
        wrong = marker_chi2 >= self._palm.settings.marker_gate
        inlier[self._finger_of[wrong & self._on_finger]] = False
        out.valid[:] = True
        out.source[CHAINS[out.seen]] = Source.SOLVED
        out.source[TIPS[out.seen]] = Source.MEASURED
        if palm.sources[PALM_PART] & ON_MARKERS:
            out.tracked[_PALM_JOINTS], out.source[_PALM_JOINTS] = True, Source.SOLVED
            out.tracked[CHAINS[inlier]] = True
        else:
            out.tracked[TIPS[inlier]] = True


def _drifted(hand: SolvedHand, age_s: float) -> SolvedHand:
    """A hand that was solved a time ago, as much less sure as it may have moved."""
    return replace(hand, cov_m2=hand.cov_m2 + (FABRIK.held_m_s * age_s) ** 2 * np.eye(3))
