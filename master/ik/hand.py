"""Palm and five fingers together: the hand that best explains the markers within limits and priors.

Six markers give 18 numbers for 21 unknowns and more (the palm's orientation is not among them), so the
missing ones come from what hands do: natural flexion, small abduction, neighbours that move alike, and the
last frame. All of it is one bounded least-squares problem (`master.ik.hand_problem`).

It is solved twice side by side, for a natural hand and for one that is free of habits (`master.ik.priors`), and each
counts by its evidence (`master.ik.mixture`).
"""

from dataclasses import dataclass, field

import numpy as np

from common.arrays import Bool, Float, Int
from common.geometry import fit_rigid, skew
from common.hand_model import CHAINS, HandModel
from common.messages import Level
from master.estimator.attached import Attached
from master.estimator.parameters import HandParameters
from master.fabrik.estimate import SolvedHand
from master.fusion.sensed_hand import SensedHand
from master.ik.hand_problem import ENOUGH, MAX_ITERATIONS, HandProblem, Minimum
from master.ik.mixture import Mixture
from master.ik.palm import Facing, Orientation, PalmPrior
from master.ik.priors import AnglePrior, Priors, hidden_belief, last_belief

_SPREAD_M = 5e-3  # markers nearer than this to one line do not turn a hand about it
_LENGTH_M = 20e-3  # a line shorter than this has no direction
_ACROSS = 0.9  # cosine to the sight, at most
EXPLAINED = 16.3  # chi square of three numbers, 1 in 1000
_BENDS = (0.1, 0.7, 1.3)  # [rad] of the PIP, from which a search afresh begins: open to closed
_SHOWS_RAD = np.radians(45.0)  # a finger bent by less in all its joints shows its end from behind
_PIP = 2  # of a finger's four angles
_MIND_S = 0.3  # how fast a hand may change from habits to none
_EYE = np.eye(3)


@dataclass(frozen=True, slots=True, eq=False)
class HandSolution(SolvedHand):
    """A hand solved by least squares; its `cov_m2` is of this instant alone, of a tracker by the past as well.

    Attributes:
        residual_m: (M,) distance of each marker from its place on the model [m]; NaN: not seen.
        cost: Half the sum of squared weighted residuals, of the likeliest hypothesis.
        iterations: Steps taken.
        natural: Probability that the hand obeys habits; 1 where nothing else is considered.
        alone: (6 + n, 6 + n) covariance of the palm's turn [rad] and shift [m] and of the free angles [rad], by this
            instant alone.
        moved: (26, 3, 6 + n) derivatives of the joint positions by these.
        x: (n,) free angles that the fit ended with.
        scale: By how much the misfit of the instant has scaled `alone`.
        others: What other sensors said, as the fit took it; None: nothing.
    """

    residual_m: Float
    cost: float
    iterations: int
    natural: float
    alone: Float
    moved: Float
    x: Float = field(default_factory=lambda: np.zeros(0))
    scale: float = 1.0
    others: SensedHand | None = None


@dataclass(frozen=True, slots=True, eq=False)
class _Told:
    """What `HandSolver.solve` is told; `seen` (M,): which markers, `shown`: fingers that have one or are told of."""

    points_m: Float
    cov_m2: Float
    seen: Bool
    shown: frozenset[int]
    last: HandSolution | None
    dt_s: float
    age_s: Float
    hidden: tuple[Float, Float] | None
    facing: Float | None
    enough: float
    near: SolvedHand | None
    orientation: Orientation | None
    others: SensedHand | None


class HandSolver:
    """Bounded least squares for one hand model and one set of marker names. Holds no state between calls but tables."""

    def __init__(self, model: HandModel, markers: tuple[str, ...], priors: Priors | None = None) -> None:
        """Prepare what is the same in every frame.

        Raises:
            CalibrationError: The profile mounts no marker of one of the names.
        """
        self.model, self.markers, self.priors = model, markers, priors or Priors()
        self.parameters = HandParameters.of(model)
        self._attached = Attached.markers(model, self.parameters, markers)
        self._joints = Attached.joints(model, self.parameters)
        self._priors = {frozenset[int](): AnglePrior.of(model, self.parameters, self.priors)}
        habits = self._priors[frozenset()]
        natural = np.asarray(np.linalg.solve(habits.normal[0], habits.pull[0]), np.float64)
        self._natural = np.minimum(np.maximum(natural, self.parameters.low), self.parameters.high)
        bent = np.zeros((len(_BENDS), 5, 4))
        bent[:, 1:, 1:3] = np.multiply.outer(_BENDS, (0.6, 1.0))[:, None]
        self._postures = np.array([self.parameters.of_angles(angles) for angles in bent])
        self._shapes_m = self._attached.place(model.chains(self.parameters.angles(self._postures)))
        walks = (self.priors.palm_walk_rad_s, 0.0, self.priors.walk_rad_s)  # a shift turns nothing
        self._walk_2 = np.repeat(walks, (3, 3, len(self.parameters.free))) ** 2
        self._model_m2 = self.priors.model_m**2 * np.eye(3)

    def solve(
        self,
        points_m: Float,
        cov_m2: Float,
        last: HandSolution | None = None,
        dt_s: float = 0.0,
        hidden: tuple[Float, Float] | None = None,
        facing: Float | None = None,
        enough: float = ENOUGH,
        near: SolvedHand | None = None,
        orientation: Orientation | None = None,
        age_s: Float | None = None,
        others: SensedHand | None = None,
    ) -> HandSolution | None:
        """Fit the hand to its markers, and to what other sensors say of palm and fingers.

        Args:
            points_m: Cap centroids (M, 3) [m], rig frame; NaN row: not seen.
            cov_m2: Their covariance (M, 3, 3) [m^2].
            last: Solution of the last frame, as seed and prior; None: solve afresh.
            dt_s: Time since then [s].
            hidden: Where fingers without a marker are believed to be, angles (5, 4) [rad], and the
                standard deviation (5,) [rad] of that belief; None: curled out of sight.
            facing: (3,) unit vector, rig frame, from the hand to the cameras where a marker on the back
                of the hand is seen: that marker faces them. None: nothing known.
            enough: How much of half chi square the search may leave.
            near: A hand that may be near, where `last` is None: one search from there, and none from afresh if it
                ends where all markers are explained. Nothing else is taken from it, and fingers without a marker
                begin at a natural posture.
            orientation: The palm's orientation as an IMU has it; None: not known.
            age_s: (6,) [s] how long ago each finger, and the palm, was told of what `last` says; None: `dt_s`.
            others: Palm and fingers as other sensors have them, in place of `orientation`; None: there are none.

        Returns:
            The solution, or None where there is no last frame and too few markers: three that are not in
            one line, two where `facing` is known and not along theirs, or one where the orientation is known.
        """
        seen = seen_markers(points_m, cov_m2)
        if others is not None:
            orientation = others.palm
        if last is None and not determined(points_m[seen], facing, orientation):
            return None
        shown = frozenset(self._attached.finger[seen & self._attached.on_finger[:, 0]].tolist())
        if others is not None:
            shown |= others.fingers
        age_s = np.full(6, dt_s) if age_s is None else age_s
        told = _Told(
            points_m,
            cov_m2,
            seen,
            shown,
            last,
            dt_s,
            age_s,
            hidden,
            facing,
            enough,
            near,
            orientation,
            others,
        )
        # A finger between two that show is rather bent as they are: no hand curls it alone. But straight it would show.
        like = frozenset(f for f in (2, 3) if hidden is None and f not in shown and {f - 1, f + 1} <= shown)
        found = self._fit(told, like)
        straight = frozenset(f for f in like if found.angles_rad[f, 1:].sum() < _SHOWS_RAD)
        return self._fit(told, like - straight) if straight else found

    def _fit(self, told: _Told, like: frozenset[int]) -> HandSolution:
        """The solution, while the hidden fingers of `like` are bent as their neighbours."""
        habits = self._habits(told, like)
        # Where a hidden finger was held is a memory, not what this instant tells.
        alone = habits if told.hidden is None else self._priors[frozenset()]
        if told.others is not None and self.model.mcp_per_pip is not None:
            lit = self._by_laser(told.others, told.seen)
            if len(lit):
                habits, alone = (
                    prior.without_single(lit, self.priors.pip_mean, self.priors.pip)
                    for prior in (habits, alone)
                )
        problem = self._problem(told, habits)
        last, near, points = told.last, told.near, told.points_m
        if last is not None:
            before = last.natural, float(np.exp(-told.dt_s / _MIND_S))
            way = problem.minimise(*self._seed_of(last), told.enough)
            return self._solution(problem, alone, way, points, before)
        if near is not None:
            way = problem.minimise(*self._seed_near(near, told), told.enough)
            found = self._solution(problem, alone, way, points)
            if found.iterations < MAX_ITERATIONS and self._explains(found, problem, told):
                return found
        best = problem.minimise(*self._seeds(points, told), told.enough)
        return self._solution(problem, alone, best, points)

    def _by_laser(self, others: SensedHand, seen: Bool) -> Int:
        """Columns of the PIPs of fingers that a laser point alone tells: they bend as their knuckles do."""
        lit = others.told & (others.level == Level.FK)
        lit[self._attached.finger[seen & self._attached.on_finger[:, 0]]] = False
        lit[0] = False  # a thumb has other habits
        return np.flatnonzero(lit[self.parameters.free // 4] & (self.parameters.free % 4 == _PIP))

    def _problem(self, told: _Told, habits: AnglePrior) -> HandProblem:
        last, seen = told.last, told.seen
        return HandProblem(
            self.model,
            self.parameters,
            self._attached.only(seen),
            told.points_m[seen],
            np.asarray(np.linalg.inv(np.linalg.cholesky(told.cov_m2[seen] + self._model_m2)), np.float64),
            self._and_last(habits, last, told.age_s[:5]),
            None
            if last is None
            else PalmPrior(last.T_rig_palm, self.priors.palm_weight(float(told.age_s[5]))),
            None if told.facing is None else Facing(told.facing, 1.0 / self.priors.facing),
            told.orientation if told.others is None else None,
            None if told.others is None else told.others.of(self.parameters),
        )

    def _explains(self, found: HandSolution, problem: HandProblem, told: _Told) -> bool:
        """Whether every seen marker is where the hand has it, within its noise."""
        off = (self._attached.on(found.joints) - told.points_m)[told.seen]
        whitened = (problem.whiten @ off[..., None])[..., 0]
        return bool((np.vecdot(whitened, whitened) < EXPLAINED).all())

    def _habits(self, told: _Told, like: frozenset[int]) -> AnglePrior:
        """Habits, with what is believed of fingers that are not shown."""
        if told.hidden is not None and len(told.shown) == 5:
            return self._priors[frozenset()]
        if told.hidden is not None:
            belief = hidden_belief(self.parameters, self.priors, told.shown, told.hidden)
            return self._priors[frozenset()].and_single(*belief)
        # A finger that is out of sight because it is curled is bent unlike one that shows.
        belief = hidden_belief(self.parameters, self.priors, told.shown | like, None)
        return self._prior_of(frozenset(range(5)) - told.shown - like).and_single(*belief)

    def _prior_of(self, unlike: frozenset[int]) -> AnglePrior:
        """Habits while some fingers are bent unlike the others; each of the 32 sets is worked out once."""
        if unlike not in self._priors:
            self._priors[unlike] = AnglePrior.of(self.model, self.parameters, self.priors, unlike)
        return self._priors[unlike]

    def _and_last(self, habits: AnglePrior, last: HandSolution | None, age_s: Float) -> AnglePrior:
        if last is None:
            return habits
        return habits.and_single(*last_belief(self.parameters, self.priors, last.angles_rad, age_s))

    def _seed_of(self, last: HandSolution) -> tuple[Float, Float]:
        return last.T_rig_palm[None], self.parameters.of_angles(last.angles_rad)[None]

    def _seed_near(self, hand: SolvedHand, told: _Told) -> tuple[Float, Float]:
        known = np.isin(self.parameters.free // 4, list(told.shown))
        x = np.where(known, self.parameters.of_angles(hand.angles_rad), self._natural)
        return hand.T_rig_palm[None], self._as_told(x[None], told.others)

    def _as_told(self, x: Float, others: SensedHand | None) -> Float:
        """Free angles (S, n) with those of fingers that another sensor tells."""
        if others is None or not others.told.any():
            return x
        known = np.isin(self.parameters.free // 4, list(others.fingers))
        return np.where(known, self.parameters.of_angles(np.nan_to_num(others.angles_rad)), x)

    def _seeds(self, points: Float, told: _Told) -> tuple[Float, Float]:
        """Three hands, open to closed, each laid on the markers as a rigid body: (3, 4, 4), (3, n)."""
        seen, facing = told.seen, told.facing
        weight = np.where(self._attached.on_finger[seen, 0], 1.0, 3.0)
        postures, shapes_m = self._as_told(self._postures, told.others), self._shapes_m
        if postures is not self._postures:
            shapes_m = self._attached.place(self.model.chains(self.parameters.angles(postures)))
        observed, expected = points[seen], shapes_m[:, seen]
        if facing is not None:
            # A point above the wrist stands for "the back of the hand faces the cameras".
            above = expected.mean(axis=1, keepdims=True) + np.array([0.0, 0.05, 0.0])
            observed = np.vstack([observed, observed.mean(axis=0) + 0.05 * facing])
            expected, weight = np.concatenate([expected, above], axis=1), np.append(weight, 0.3)
        if told.orientation is not None and told.orientation.sure:
            R = told.orientation.rotation
            T = np.tile(np.eye(4), (len(postures), 1, 1))
            T[:, :3, :3] = R
            T[:, :3, 3] = np.average(observed - expected @ R.T, axis=1, weights=weight)
            return T, postures
        return fit_rigid(observed, expected, weight), postures

    def _solution(
        self,
        problem: HandProblem,
        habits: AnglePrior,
        minima: list[Minimum],
        points_m: Float,
        before: tuple[float, float] = (0.5, 0.0),
    ) -> HandSolution:
        found = Mixture.of(problem, habits, minima, before)
        T = found.T_rig_palm
        # The bounds hold already; what is cut is the rounding of an angle that follows others.
        angles = self.model.clamp(self.parameters.angles(found.x))
        chains = self.model.chains(angles)
        joints = self.model.joints(T, chains)
        marker = self._attached.place(chains) @ T[:3, :3].T + T[:3, 3]
        local = self._joints.place(chains)
        count, n = len(local), 6 + len(found.x)
        J = np.empty((count, 3, n))
        J[:, :, :3] = skew(-local @ T[:3, :3].T)
        J[:, :, 3:6] = _EYE
        np.matmul(T[:3, :3], self._joints.jacobian(chains, local, found.x), out=J[:, :, 6:])
        cov = (J.reshape(3 * count, n) @ found.alone).reshape(count, 3, n)
        ends, starts = CHAINS[:, 3], CHAINS[:, 2]
        bone = local[ends] - local[starts]
        # How the last phalanges' directions turn (5, 3, n).
        turn = (J[ends] - J[starts]) / np.sqrt(np.vecdot(bone, bone))[:, None, None]
        turn_t, off = turn.swapaxes(1, 2), marker - points_m
        return HandSolution(
            T_rig_palm=T,
            angles_rad=angles,
            joints=joints,
            cov_m2=cov @ J.swapaxes(1, 2),
            tilt_cov_rad2=turn @ found.alone @ turn_t,
            tilt_walk_rad2_s2=(turn * self._walk_2) @ turn_t,
            residual_m=np.sqrt(np.vecdot(off, off)),
            cost=found.cost,
            iterations=minima[0].iterations,
            natural=found.natural,
            alone=found.alone,
            moved=J,
            x=found.x,
            scale=found.scale,
            others=None if problem.others is None else problem.others.belief,
        )


def seen_markers(points_m: Float, cov_m2: Float) -> Bool:
    """(M,) which markers can be used: points (M, 3) and covariances (M, 3, 3) without a gap."""
    return np.asarray(np.isfinite(points_m.sum(axis=1) + cov_m2.reshape(-1, 9).sum(axis=1)))


def determined(points: Float, facing: Float | None, orientation: Orientation | None) -> bool:
    """Whether points (N, 3) fix a hand: not all in one line, or in a line across `facing`.

    What faces the cameras turns the hand about a line of markers, but not about one that points at them. With an
    orientation that is known any one marker is enough.
    """
    if orientation is not None and orientation.sure:
        return len(points) > 0
    if len(points) < 2:
        return False
    _, extent, axes = np.linalg.svd(points - points.mean(axis=0))
    if len(points) > 2 and extent[1] > _SPREAD_M:
        return True
    return facing is not None and bool(extent[0] > _LENGTH_M and abs(axes[0] @ facing) < _ACROSS)
