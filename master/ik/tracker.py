"""One hand over time: what to believe about fingers that nobody sees, and what to say about each joint.

A finger whose marker is seen is solved from it. When the marker goes, the finger moves on a little the way it
was moving, and with its neighbours, and is *held* there while the doubt grows (`master.ik.hidden`, `master.ik.doubt`);
a finger that was never seen is believed to be curled out of sight, because a stretched one would show. It is never
put back to an open flat hand. When a marker returns, the last pose is only a wide prior, so the finger is solved from
what is seen at once.

The bits are those of XR_EXT_hand_tracking: an active hand has all joints valid; tracked is what is seen now.
"""

from dataclasses import dataclass, replace

import numpy as np

from common.arrays import Bool, Code, Float, Int
from common.calibration import Volume
from common.geometry import matrix_to_quaternion
from common.hand_model import CHAINS, METACARPALS, PALM, TIPS, WRIST, HandModel
from common.messages import HandPose, Source
from master.estimator.attached import Attached
from master.fabrik.estimate import HandEstimate, SolvedHand
from master.fusion.sensed_hand import MarkerCheck, SensedHand
from master.ik.arcs import Arcs
from master.ik.doubt import JointDoubt
from master.ik.hand import EXPLAINED, HandSolution, HandSolver, determined, seen_markers
from master.ik.hidden import FingerMemory
from master.ik.palm import Orientation
from master.ik.priors import Priors
from master.volume import inside

_FORGET_S = 0.5  # after this long without any marker the pose is no longer valid
_NEVER_NS = -(2**61)
# Chi square by which another hand explains the markers better than one that the last hand has led astray.
_MISLED = 2.0 * EXPLAINED
_MODEL_M2 = 1e-3**2 * np.eye(3)  # bones and caps are known to about 1 mm
ON_MARKERS, ON_OTHERS, BY_MARKERS = 1, 2, 16
_FIRST_MARKER = 8  # bit
_PALM_JOINTS = np.array([PALM, WRIST, *METACARPALS])
_PALM_BY_MARKERS = 3
_OBSERVED_M = 0.010  # standard deviation, all axes together
_SOMEWHERE_M = 0.1  # about each axis: a hand that is known no better than this is lost


@dataclass(frozen=True, slots=True, eq=False)
class TrackedHand:
    """A solution with its bits.

    Attributes:
        solution: The hand; None: nothing was solved yet.
        valid, tracked, source: (26,) as of `HandPose`.
        rests: (6,) what thumb ... little and the palm rest on now; 0: on nothing. Equal numbers are equal grounds: for
            a finger the sum of `ON_MARKERS`, `BY_MARKERS` where its own is placed, and `ON_OTHERS` by its level; for
            the palm one of the former and which markers are seen.
        anew: The hand of a moment ago was wrong: nothing of it is in this one.
    """

    solution: HandSolution | None
    valid: Bool
    tracked: Bool
    source: Code
    rests: Int
    anew: bool = False


class HandTracker:
    """Push machine. Holds the last solution, when it and each part of it were seen, and what its motion taught."""

    def __init__(
        self,
        model: HandModel,
        markers: tuple[str, ...],
        *,
        continuous: bool = True,
        priors: Priors | None = None,
    ) -> None:
        """Track one hand.

        Args:
            model: The hand.
            markers: Marker names in the order of the points.
            continuous: False: every push is an unrelated pose, nothing is remembered.
            priors: Widths of the priors; None: the defaults.

        Raises:
            CalibrationError: The profile mounts no marker of one of the names.
        """
        self.model, self.markers = model, markers
        self._solver = HandSolver(model, markers, priors)
        self.parameters = self._solver.parameters
        self._arcs = Arcs(model, self.parameters, markers)
        self._elsewhere = MarkerCheck(model, markers)
        self._continuous = continuous
        mounts = [model.mount(name) for name in markers]
        self._attached = Attached.markers(model, self.parameters, markers)
        self._finger = np.array([-1 if m.finger is None else m.finger for m in mounts])
        self._carries = self._finger == np.arange(5)[:, None]  # (5, M)
        self._on_palm = np.array([m.joint is None for m in mounts])
        self._bit = 1 << np.arange(_FIRST_MARKER, _FIRST_MARKER + len(markers))
        self.last: HandSolution | None = None
        self._last_ns = 0
        self._seen_ns: int | None = None
        self._told_ns: Int = np.full(6, _NEVER_NS)
        self._oriented: Orientation | None = None
        self._forget()

    def _forget(self) -> None:
        self._memory = FingerMemory(self.model)
        self.doubt = JointDoubt(self.parameters, self._solver.priors, self._arcs)

    def recent(self, t_ns: int) -> tuple[HandSolution | None, float]:
        """The last solution, if it still says anything at `t_ns`, and how long ago it held [s]."""
        age_s = (t_ns - self._last_ns) * 1e-9
        if self.last is None or not self._continuous or not 0.0 < age_s <= _FORGET_S:
            return None, 0.0
        return self.last, age_s

    def push(
        self,
        t_ns: int,
        points_m: Float,
        cov_m2: Float,
        towards_cameras: Float,
        measured: Bool | None = None,
        orientation: Orientation | None = None,
        others: SensedHand | None = None,
        start: SolvedHand | None = None,
    ) -> TrackedHand:
        """Solve one instant.

        Args:
            t_ns: The instant.
            points_m: Cap centroids (M, 3) [m], rig frame; NaN: not seen.
            cov_m2: (M, 3, 3) [m^2].
            towards_cameras: (3,) unit vector from the working volume to the cameras, rig frame.
            measured: (M,) markers whose point was measured, not put on the ray of a single camera; None: all.
            orientation: The palm's orientation as an IMU has it; None: not known.
            others: Palm and fingers as other sensors have them, in place of `orientation`; None: there are none.
            start: A hand solved otherwise from the same instant: the fit begins there where there is no last hand, or
                where that leaves markers unexplained which this one explains; None: there is none.
        """
        seen = seen_markers(points_m, cov_m2)
        if others is not None:
            orientation = others.palm
        palm_rests = self._palm_rests(seen, orientation)
        tells_palm = palm_rests > 0
        last, dt_s = self.recent(t_ns)
        known = last is not None
        facing = towards_cameras if (seen & self._on_palm).any() else None
        if (
            last is not None
            and start is not None
            and determined(points_m[seen], facing, orientation)  # else there is no hand without the last one
            and self._leapt(last, dt_s, start, points_m, cov_m2)
        ):
            last = None
        if last is None:
            self._forget()
        before = None if last is None else self._turned(last, orientation)
        self._oriented = orientation
        told = np.empty(6, np.bool_)
        told[:5], told[5] = (self._carries & seen).any(axis=1), tells_palm
        if others is not None:
            if before is not None and seen.any():
                wrong = self._elsewhere(others, before.T_rig_palm, points_m, cov_m2)
                others = others.without(wrong) if wrong.any() else others
            told[:5] |= others.told
        hidden = None
        if last is not None:
            shown = frozenset(np.flatnonzero(told[:5]).tolist())
            hidden = self._memory.belief(t_ns, self._last_ns, last.angles_rad, last.natural, shown)
        held = None if hidden is None else (hidden.angles_rad, hidden.sigma_rad)
        age_s = self._ages_s(t_ns, dt_s, told)

        def solve(from_last: HandSolution | None) -> HandSolution | None:
            return self._solve(
                points_m, cov_m2, from_last, dt_s, held, facing, orientation, age_s, others, start
            )

        solution = solve(before)
        if solution is not None and last is not None and start is not None:
            wrong = self._surprise(solution, points_m, cov_m2)
            if wrong > _MISLED + self._surprise(start, points_m, cov_m2):
                fresh = solve(None)
                if fresh is not None and wrong > _MISLED + self._surprise(fresh, points_m, cov_m2):
                    solution, last = fresh, None  # the leap was no motion
                    self._forget()
        if solution is not None:
            cov = self.doubt.push(solution, last, dt_s, hidden, cov_m2, seen, palm_seen=tells_palm)
            solution = replace(solution, cov_m2=cov)
            if last is not None:
                self._memory.moved(last.angles_rad, solution.angles_rad, dt_s)
        if seen.any() or (others is not None and others.told.any() and self._knows_place()):
            self._seen_ns = t_ns
        placed = seen if measured is None else seen & measured
        bits = self._bits(t_ns, solution, seen, placed, others, palm_rests, held=hidden is not None)
        if solution is not None:
            self.last, self._last_ns = solution, t_ns
        return replace(bits, anew=True) if known and last is None else bits

    def _solve(
        self,
        points_m: Float,
        cov_m2: Float,
        last: HandSolution | None,
        dt_s: float,
        held: tuple[Float, Float] | None,
        facing: Float | None,
        orientation: Orientation | None,
        age_s: Float,
        others: SensedHand | None,
        start: SolvedHand | None,
    ) -> HandSolution | None:
        """The fit; once more where markers contradict what is told of a finger, which counts less then."""

        def fit(told: SensedHand | None) -> HandSolution | None:
            return self._solver.solve(
                points_m,
                cov_m2,
                last,
                dt_s,
                held,
                facing,
                near=start,
                orientation=orientation,
                age_s=age_s,
                others=told,
            )

        found = fit(others)
        if found is None or others is None:
            return found
        weighed = others.weighed(found.angles_rad)
        return found if weighed is None else fit(weighed)

    def _turned(self, last: HandSolution, orientation: Orientation | None) -> HandSolution:
        """The last hand turned as its orientation says it has turned since: of that it is surer than of itself."""
        then = self._oriented
        if orientation is None or then is None:
            return last
        T = last.T_rig_palm.copy()
        T[:3, :3] = orientation.rotation @ then.rotation.T @ T[:3, :3]
        return replace(last, T_rig_palm=T)

    def _knows_place(self) -> bool:
        """Whether it is still known where the hand is, when nothing but its fingers is told."""
        cov = self.doubt.cov
        if self._seen_ns is None or cov is None:
            return False
        return float(np.trace(cov[3:6, 3:6])) < 3.0 * _SOMEWHERE_M**2

    def _ages_s(self, t_ns: int, dt_s: float, told: Bool) -> Float:
        """(6,) [s] how old what the last pose says of each finger and of the palm is, where these are told (6,) now.

        A finger that was hidden, or a palm, moved on for as long as nobody saw it, not since the last frame.
        """
        ages = np.where(told, (t_ns - self._told_ns) * 1e-9, dt_s)
        self._told_ns = np.where(told, t_ns, self._told_ns)
        return ages

    def _leapt(
        self, last: HandSolution, dt_s: float, start: SolvedHand, points_m: Float, cov_m2: Float
    ) -> bool:
        """Whether no motion from the last hand explains the markers, but another hand does."""
        walked = cov_m2 + (self._solver.priors.palm_walk_m_s * dt_s) ** 2 * np.eye(3)
        return self._surprise(last, points_m, walked) > _MISLED + self._surprise(start, points_m, cov_m2)

    def _surprise(self, hand: SolvedHand, points_m: Float, cov_m2: Float) -> float:
        """Chi square of the markers (M, 3) [m] on a hand; NaN: not seen."""
        off = points_m - self._attached.on(hand.joints)
        return float(np.nansum(np.vecdot(off, np.linalg.solve(cov_m2 + _MODEL_M2, off[..., None])[..., 0])))

    def _palm_rests(self, seen: Bool, orientation: Orientation | None) -> int:
        """What tells at this instant where the palm is and how it is turned; 0: nothing does."""
        if seen.sum() >= _PALM_BY_MARKERS or (seen.sum() == 2 and (seen & self._on_palm).any()):
            return ON_MARKERS
        return ON_OTHERS if orientation is not None and orientation.sure and seen.any() else 0

    def _bits(
        self,
        t_ns: int,
        solution: HandSolution | None,
        seen: Bool,
        placed: Bool,
        others: SensedHand | None,
        palm_rests: int,
        *,
        held: bool,
    ) -> TrackedHand:
        valid, tracked, source = np.zeros(26, np.bool_), np.zeros(26, np.bool_), np.zeros(26, np.uint8)
        recent = self._seen_ns is not None and (t_ns - self._seen_ns) * 1e-9 <= _FORGET_S
        rests, tells_palm = np.zeros(6, np.int64), palm_rests > 0
        if solution is None:
            return TrackedHand(None, valid, tracked, source, rests)
        valid[:] = recent
        unseen = Source.HELD if held else Source.SOLVED
        source[:] = unseen
        if tells_palm:
            tracked[_PALM_JOINTS] = True
            source[_PALM_JOINTS] = Source.SOLVED
        by_seen, by_placed = (self._carries & seen).any(axis=1), (self._carries & placed).any(axis=1)
        if tells_palm:
            rests[5] = palm_rests | (BY_MARKERS if palm_rests == ON_MARKERS else 0)
            rests[5] += int(seen @ self._bit)
        if others is not None:
            # Where a finger is rests on where the palm is; how it is bent does not.
            rests[:5] += ON_OTHERS * np.where(others.told, others.level, 0)
            chains = CHAINS[others.told]
            source[chains] = Source.WRIST
            tracked[chains] = tells_palm
        told = (CHAINS if tells_palm else TIPS)[by_seen]
        tracked[told] = True
        source[told] = Source.SOLVED
        rests[:5] += ON_MARKERS * by_seen + BY_MARKERS * by_placed
        source[TIPS[by_placed]] = Source.MEASURED
        if others is not None:
            # Sights through a wrist that bends may leave a joint anywhere: that is not to observe it.
            tracked &= np.trace(solution.cov_m2, axis1=1, axis2=2) < _OBSERVED_M**2
        return TrackedHand(solution, valid, tracked & valid, source, rests)


def pose_of(
    hand: TrackedHand | HandEstimate,
    model: HandModel,
    t_ns: int,
    markers_m: Float,
    markers_raw_m: Float,
    markers_cov_m2: Float,
    volume: Volume | None = None,
) -> HandPose:
    """The message for one hand; all NaN and not valid where nothing has been solved yet."""
    solution = hand.solution
    if solution is None:
        nan = np.full(26, np.nan)
        position, cov = np.full((26, 3), np.nan), np.full((26, 3, 3), np.nan)
        orientation, angles = np.repeat(nan[:, None], 4, axis=1), np.full((5, 4), np.nan)
    else:
        position, cov, angles = solution.joints.position_m, solution.cov_m2, solution.angles_rad
        orientation = matrix_to_quaternion(solution.joints.rotation)
    return HandPose(
        hand=model.profile.name,
        t_ns=t_ns,
        position_m=position,
        orientation_wxyz=orientation,
        radius_m=model.radius_m,
        valid=hand.valid,
        tracked=hand.tracked,
        cov_m2=cov,
        source=hand.source,
        angles_rad=angles,
        markers_m=markers_m,
        markers_raw_m=markers_raw_m,
        markers_cov_m2=markers_cov_m2,
        inside_volume=inside(volume, position),
    )
