"""Predict a hand from the epoch before, and fit it to what is measured."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from common.arrays import Bool, Float, Int
from common.camera_model import CameraModel
from common.geometry import fit_rigid, matrix_to_rotation_vector, rotation_vector_to_matrix
from common.hand_model import HandJoints, HandModel
from common.kernels import bound
from common.records import boxed, fields
from common.wrist_bend import forearm_palm
from master.estimator.cameras import CameraArrays
from master.estimator.epoch import Epoch, Fitted, FittedHand
from master.estimator.extras import usual_of
from master.estimator.ground import ON_OTHERS, count_rows
from master.estimator.hand_tables import HandTables, Mounts
from master.estimator.hypotheses import Blank
from master.estimator.kinematics import Scratch, pose
from master.estimator.parameters import HandParameters
from master.estimator.priors import Habits, curled, habits_of
from master.estimator.problem import Rig
from master.estimator.residuals import Observations, observe_points, observe_rays
from master.estimator.settings import DEFAULT, Settings
from master.estimator.solve import MAX_ITERATIONS
from master.estimator.state import HandState
from master.estimator.update import Estimate, fit_epoch, predict_epoch, take_over_epoch
from master.estimator.workspace import Model, Workspace
from master.estimator.wrist_device import BEND, EXTRAS, HEADING, LIGHT, NO_EXTRAS, TILT, Device, observe_wrist
from master.estimator.wrist_model import WristModel
from master.estimator.wrist_update import prepare_epoch

_BENDS_RAD = (0.1, 0.7, 1.3)  # of the PIP, from which a search afresh begins: open to closed
_MCP_PER_PIP = 0.6
_ABOVE_M, _ABOVE_WEIGHT, _PALM_WEIGHT = 0.05, 0.3, 3.0
_STEP = 16
_SPREAD_M = 5e-3  # markers nearer than this to one line do not turn a hand about it
_LENGTH_M = 20e-3  # a line shorter than this has no direction
_ACROSS = 0.9  # cosine to the sight, at most
_EVEN = 0.5  # probability
_SOMEWHERE_M = 0.1  # about each axis: a hand that is known no better than this is lost
_STIFF_RAD = np.radians(1.0)  # of fingers that are taken to bend as their PIP does
_SURE_RAD2 = 3.0 * np.radians(5.0) ** 2  # of the turn of a palm that markers place well
_STANDS_M = 1e-4  # of a palm before the wrist device alone, whose frame is the rig's
_EYE, _AT_ORIGIN = np.eye(3), np.eye(4)
_NONE = frozenset[int]()
_NOBODY, _NO_LEVEL = np.zeros(5, np.bool_), np.zeros(5, np.uint8)
_NOBODY.flags.writeable = _NO_LEVEL.flags.writeable = False


class Estimator:
    """Push machine. Holds the state of one hand (`HandState`), and tables."""

    def __init__(
        self,
        cameras: Sequence[CameraModel],
        model: HandModel,
        markers: tuple[str, ...],
        hand_markers: tuple[str, ...],
        *,
        continuous: bool = True,
        natural: bool = False,
        settings: Settings = DEFAULT,
        wrist: WristModel | None = None,
    ) -> None:
        """Prepare.

        Args:
            cameras: In the rig's order.
            model: The hand.
            markers: Names in the order of every marker array.
            hand_markers: Those of them that are on this hand.
            continuous: False: every epoch is an unrelated pose, nothing is remembered.
            natural: Whether the hand is taken to obey habits, and begins anew where markers are unexplained: the fit
                of the card's line, which has no other hand to begin from.
            settings: Every number that tunes it.
            wrist: A wrist device on the forearm of this hand; None: there is none.

        Raises:
            CalibrationError: The profile mounts no marker of one of the names.
        """
        self.model, self.settings, self._continuous = model, settings, continuous
        self.parameters = HandParameters.of(model)
        self._on_hand = np.array([markers.index(name) for name in hand_markers], np.int64)
        mounts = Mounts.of(model, hand_markers)
        self.wrist = wrist is not None
        extras, device = (NO_EXTRAS, Device.none()) if wrist is None else (EXTRAS, wrist.device)
        self._rig = Rig(HandTables.of(model, self.parameters), mounts, CameraArrays.of(cameras), device)
        n, count = len(self.parameters.free), len(hand_markers)
        self._observed = Observations.empty(len(cameras), count)
        self._space = Workspace.empty(n, extras, _capacity(count))
        self._blank = Blank.of(n, extras, len(cameras), count)
        self.state = HandState.unknown(n, extras)
        self._only_natural = natural
        self._habits: dict[frozenset[int], Habits] = {}
        self._finger = mounts.finger
        bent = np.zeros((len(_BENDS_RAD), 5, 4))
        bent[:, 1:, 1:3] = np.multiply.outer(_BENDS_RAD, (_MCP_PER_PIP, 1.0))[:, None]
        self._postures = np.array([self.parameters.of_angles(angles) for angles in bent])
        self._natural = self._likeliest()
        self._natural_habits = self._habits_of(_NONE).natural()
        self._finger_of_free = self.parameters.free // 4
        self._turn: Float | None = None
        self._scratch = Scratch.empty()
        self._model = Model(
            boxed(self._rig.hand),
            boxed(settings.record()),
            self._rig.mounts,
            self._rig.cameras,
            boxed(self._rig.device),
        )
        self._boxed_state, self._boxed_space = boxed(self.state), boxed(self._space)
        self._now, self._at = fields(self.state), fields(self._space)
        self._boxed_ground = self._boxed_space["ground"]
        self._at.room.search.bend_share[0] = settings.bend_share
        self._at.belief.z_info[0, 0] = 1.0  # of a rig without wrist device: one extra that means nothing
        if wrist is not None:
            self._lay_out(wrist)
        nothing = np.full((len(cameras), len(markers), 2), np.nan)
        own = np.zeros((len(markers), 3, 3))
        observed, room = self._observed, (np.empty((26, 3)), np.empty((26, 3, 3)), np.empty((count, 3)))
        self._observe_rays = bound(
            observe_rays, nothing, nothing[..., 0].copy(), own, self._on_hand, observed
        )
        self._observe_points = bound(observe_points, room[2], own[self._on_hand], 0.0, observed)
        self._count_rows = bound(count_rows, mounts, observed, self._boxed_ground)
        self._work = work = boxed(self._scratch)
        self._pose = bound(pose, self._model.hand, mounts, _AT_ORIGIN, np.zeros(20), work, *room)
        state, space = self._boxed_state, self._boxed_space
        none = np.full((5, 2), np.nan)
        self._sights = self._boxed_space["belief"]["sights"]
        self._observe_wrist = bound(
            observe_wrist, self._model.device, none, none[:, 0].copy(), none[:, 0].copy(), none, none[:, 0].copy(),
            none[:, 0].copy(), 0.0, 0.0, 0.0, self._sights,
        )  # fmt: skip
        self._prepare = bound(prepare_epoch, self._model, state, space)
        self._predict = bound(predict_epoch, self._model, state, self._observed, space)
        self._fit = bound(fit_epoch, self._model, self._habits_of(_NONE), self._observed, self._blank, space)
        self._take_over = bound(
            take_over_epoch, self._model, state, True, self._observed, space, Estimate.empty()
        )

    @property
    def known(self) -> bool:
        """Whether there is a hand to go on from."""
        return bool(self._now.known[0])

    def recent(self, t_ns: int) -> bool:
        """Whether the state still says anything at `t_ns`."""
        age_s = (t_ns - int(self._now.t_ns[0])) * 1e-9
        return self._continuous and self.known and 0.0 < age_s <= self.settings.forget_s

    @property
    def extras(self) -> Float:
        """Mean (K,) of what other sensors leave open, as the last epoch left it."""
        return self._now.z

    @property
    def extras_cov(self) -> Float:
        """Its covariance (K, K)."""
        return self._now.z_cov

    def forget_heading(self) -> None:
        """Let the heading of an IMU be any, and what was learnt with it."""
        self._now.z_cov[BEND:LIGHT] = self._now.z_cov[:, BEND:LIGHT] = 0.0
        self._now.z_cov[range(BEND, LIGHT), range(BEND, LIGHT)] = self._now.usual[BEND:LIGHT]

    def begin_heading(self, heading_rad: float, variance_rad2: float) -> None:
        """Take the heading of an IMU from a palm that was solved without it."""
        self._now.z[HEADING] = heading_rad
        self._now.z_cov[HEADING] = self._now.z_cov[:, HEADING] = 0.0
        self._now.z_cov[HEADING, HEADING] = variance_rad2
        self._turn = None

    def pose(self, T: Float, angles_rad: Float) -> tuple[HandJoints, Float]:
        """Place joints and markers (M, 3) [m], rig frame.

        Of a palm (4, 4) and angles (5, 4) [rad]. The angles are cut at their limits, in place.
        """
        position, rotation = np.empty((26, 3)), np.empty((26, 3, 3))
        places = np.empty((len(self._on_hand), 3))
        hand, mounts, angles = self._model.hand, self._model.mounts, angles_rad.reshape(20)
        self._pose(hand, mounts, np.ascontiguousarray(T), angles, self._work, position, rotation, places)
        return HandJoints(position, rotation, T), places

    def push(self, at: Epoch) -> Fitted:
        """Fit one epoch."""
        task, ground = self._at.task, self._at.ground
        self._observe(at)
        task.t_ns[0], task.second_order[0], task.continuous[0] = at.t_ns, at.second_order, self._continuous
        task.walked_rad2[0] = 0.0 if at.turn is None else at.turn.walked_rad2
        if self.wrist:
            self._prepare(self._model, self._boxed_state, self._boxed_space)
        told = self._told() if self.wrist else _NOBODY
        if told.any():
            ground.shown[:] |= told
            ground.numbers[0] += 2.0 * (int(told.sum()) + int((self._at.belief.sights.shown > 0.0).sum()))
        sure = at.turn is not None and at.turn.sure
        palm_shown = bool(ground.by_markers[0]) or (sure and ground.seen[0] > 0) or at.place is not None
        task.palm_shown[0] = palm_shown
        known = self.recent(at.t_ns)
        self._believe(at, known=known)
        out, left_out = Estimate.empty(), False
        before = (
            self._boxed_state.copy() if self.wrist and at.turn is not None and ground.by_markers[0] else None
        )
        solved, anew = self._solve(at, out, known=known)
        if solved and before is not None and self._contradicts(at):
            # What the IMU says is left out: it began anew, or the wrist was flicked. But not where it alone tells.
            for turn in (None, at.turn):
                self._boxed_state[:] = before
                self._believe(replace(at, turn=turn), known=known)
                solved, anew = self._solve(replace(at, turn=turn), out, known=known)
                left_out = turn is None
                if left_out and np.trace(self._at.found.cov[:3, :3]) < _SURE_RAD2:
                    break
        self._turn = None if left_out or at.turn is None else self._turned(at, learnt=True)
        if ground.seen[0] > 0 or (told.any() and (at.place is not None or self._knows_place())):
            self._now.seen_ns[0] = at.t_ns
        rests = self._rests(at, palm_shown=palm_shown)
        return self._fitted(at, out, rests, anew=anew, left_out=left_out) if solved else _unknown(rests)

    def _lay_out(self, wrist: WristModel) -> None:
        """Write what is believed of fingers before a wrist device, and of what it leaves open."""
        prior, state, s = self._at.prior, self._now, self.settings
        prior.natural[:], prior.slope[:], prior.frame[:] = wrist.natural, wrist.slope, wrist.frame
        prior.abduction[:], prior.flexion[:] = s.abduction_rad, s.coupled_rad
        prior.abduction[0] = prior.flexion[0] = 0.5 * s.thumb_rad
        if wrist.only_natural:
            prior.only_natural[0], prior.flexion[:] = 1.0, _STIFF_RAD
        state.usual[:] = usual_of(s, loose=wrist.loose, tilt_rad=wrist.tilt_rad)
        state.z_cov[:] = np.diag(state.usual)
        if wrist.heading_rad is not None:
            state.z_cov[HEADING, HEADING] = wrist.heading_rad**2

    def _contradicts(self, at: Epoch) -> bool:
        """Tell whether the palm is too far from how other sensors have it turned, however extras are bent for it."""
        assert at.turn is not None
        belief, found = self._at.belief, self._at.found
        off = found.z - belief.z
        bent = at.turn.rotation @ forearm_palm(found.z[BEND : BEND + 2])
        by_axes = rotation_vector_to_matrix(off[TILT : HEADING + 1] @ belief.axes)
        q = matrix_to_rotation_vector(found.palm[:3, :3] @ (by_axes @ bent).T)
        return float(q @ belief.turn_info @ q + off @ belief.z_info @ off) > self.settings.contrary

    def _told(self) -> Bool:
        """Tell which fingers (5,) a wrist device tells now."""
        return self._at.belief.sights.lit > 0.0

    def _turned(self, at: Epoch, *, learnt: bool = False) -> Float | None:
        """How the palm is turned by other sensors (3, 3), with the bend that is believed; None: they do not say.

        `learnt`: with tilt and heading as this epoch leaves them, so that what is learnt of these is no motion.
        """
        if at.turn is None:
            return None
        if at.turn.axes is None:
            return at.turn.rotation
        bent = at.turn.rotation @ forearm_palm(self._now.z[BEND : BEND + 2])
        if not learnt:
            return bent
        off = self._now.z[TILT : HEADING + 1] - self._at.belief.z[TILT : HEADING + 1]
        return rotation_vector_to_matrix(off @ at.turn.axes) @ bent

    def _solve(self, at: Epoch, out: Estimate, *, known: bool) -> tuple[bool, bool]:
        """Fit an epoch and take it over.

        Returns:
            Whether there is a hand, and whether the one before was wrong.
        """
        if known:
            wrong, explained = self._go_on(at, may_leave=True)
            # Where nothing is better, what goes on is kept.
            goes_on = explained or wrong <= self.settings.misled + self._begin(at)
            if goes_on and not explained:
                self._go_on(at, may_leave=False)
        elif self._enough(at):
            goes_on = False
            self._begin(at)
        else:
            return False, False
        self._take_over(self._model, self._boxed_state, goes_on, self._observed, self._boxed_space, out)
        return True, known and not goes_on and not self._only_natural

    def _go_on(self, at: Epoch, *, may_leave: bool) -> tuple[float, bool]:
        """Fit from the state.

        Returns:
            Chi square of the markers, infinite where no motion explains them but another hand does; and whether no hand
            that may take its place is better.
        """
        start, task = at.start, self._at.task
        turned = None if at.turn is None else self._turned(at)
        task.turned[:] = _EYE if turned is None or self._turn is None else turned @ self._turn.T
        task.may_leave[0] = may_leave and start is not None and self._enough(at)
        if start is not None:
            task.palm[:], task.angles[:] = start.T_rig_palm, start.angles_rad.reshape(20)
        limit = self._predict(self._model, self._boxed_state, self._observed, self._boxed_space)
        if limit < 0.0:
            return np.inf, False
        room = self._at.room
        if self.wrist:
            room.start_x[:] = self._as_told(room.start_x.copy())
        # Whether a hand obeys habits, fingers before a wrist device say by themselves.
        habits = self._habits[_NONE] if self._at.ground.seen[0] > 0 else self._natural_habits
        wrong = self._search(habits)
        if self._only_natural and may_leave:
            return wrong, not (self._unexplained() and self._enough(at))
        return wrong, not wrong > limit  # NaN: there is nothing to compare

    def _unexplained(self) -> bool:
        """Whether a marker is too far from what was found."""
        surprise = self._at.found.surprise[: len(self._on_hand)]
        return bool((surprise > self.settings.explained).any())

    def _search(self, habits: Habits, *, rough: bool = False) -> float:
        """Fit what is measured; return chi square, or the cost of a rough search."""
        self._at.task.rough[0] = rough
        return self._fit(self._model, habits, self._observed, self._blank, self._boxed_space)

    def _observe(self, at: Epoch) -> None:
        """Write the rows of an epoch, and count them."""
        if at.wrist is None:
            self._at.belief.sights.rows[0] = 0.0
            self._at.belief.sights.lit[:] = self._at.belief.sights.shown[:] = 0.0
        else:
            self._at.prior.law[:] = at.wrist.law
            self._observe_wrist(
                self._model.device,
                at.wrist.laser,
                at.wrist.laser_sigma_px,
                at.wrist.laser_px,
                at.wrist.tip,
                at.wrist.tip_sigma_px,
                at.wrist.tip_depth,
                self.settings.light_rad,
                at.wrist.laser_s,
                at.wrist.tip_s,
                self._sights,
            )
        if at.uv is None and at.cov_m2 is None:
            self._observed.seen[:] = False
        elif at.cov_m2 is not None:
            bones_m2 = self.settings.bones_m**2
            points, cov = at.points_m[self._on_hand], at.cov_m2[self._on_hand]
            self._observe_points(points, cov, bones_m2, self._observed)
        else:
            assert at.uv is not None
            assert at.variance_px2 is not None
            assert at.own_m2 is not None
            own = at.own_m2 + self.settings.bones_m**2 * _EYE
            uv, variance = np.ascontiguousarray(at.uv), np.ascontiguousarray(at.variance_px2)
            self._observe_rays(uv, variance, own, self._on_hand, self._observed)
        self._count_rows(self._rig.mounts, self._observed, self._boxed_ground)

    def _begin(self, at: Epoch) -> float:
        """Fit without the state; return chi square of the markers.

        From the other hand, or from several starts. A finger between two that show is rather bent as they are: no hand
        curls it alone. But straight it would show.
        """
        shown = frozenset(np.flatnonzero(self._at.ground.shown).tolist())
        like = frozenset(f for f in (2, 3) if f not in shown and {f - 1, f + 1} <= shown)
        chi2 = self._begin_with(at, shown, like)
        angles = self.parameters.angles(self._at.found.x)
        straight = frozenset(f for f in like if angles[f, 1:].sum() < self.settings.shows_rad)
        return self._begin_with(at, shown, like - straight) if straight else chi2

    def _begin_with(self, at: Epoch, shown: frozenset[int], like: frozenset[int]) -> float:
        """As `_begin`, while the hidden fingers of `like` are bent as their neighbours."""
        apart, task, start = frozenset(range(5)) - shown - like, self._at.task, at.start
        belief, room = self._at.belief, self._at.room
        belief.past_w2[:], belief.past[:], belief.palm_w2[:], belief.depth_w2[:] = 0.0, 0.0, 0.0, 0.0
        fingers = np.isin(np.arange(5), list(apart))
        belief.own_w2[:], belief.own[:] = curled(self.parameters, self.settings, fingers)
        task.natural[0], task.counts[0] = _EVEN, 0.0
        habits = self._habits_of(apart)
        try:
            if start is not None:
                shows = self._at.ground.shown[self._finger_of_free] > 0
                x = np.where(shows, self.parameters.of_angles(start.angles_rad), self._natural)
                room.start_T[:], room.start_x[:] = start.T_rig_palm, self._as_told(x)
                chi2 = self._search(habits)
                if self._at.found.steps[0] < MAX_ITERATIONS and not self._unexplained():
                    return chi2
            ends = list[tuple[float, Float, Float]]()
            starts = self._starts(at)
            if len(starts) == 1:
                room.start_T[:], room.start_x[:] = starts[0]
                return self._search(habits)
            for T, x in starts:
                task.palm[:], task.x[:] = T, x
                ends.append((self._search(habits, rough=True), task.palm.copy(), task.x.copy()))
            _, room.start_T[:], room.start_x[:] = min(ends, key=lambda end: end[0])
            return self._search(habits)
        finally:
            belief.own_w2[:] = 0.0

    def _starts(self, epoch: Epoch) -> list[tuple[Float, Float]]:
        """Three hands, open to closed, each laid on the markers as a rigid body; one where the palm is known."""
        turned = self._turned(epoch)
        if epoch.place is not None and turned is not None:
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = turned, epoch.place
            return [(T, self._as_told(self._natural.copy()))]
        placed = self._placed(epoch)
        weight = np.where(self._finger[placed] >= 0, 1.0, _PALM_WEIGHT)
        observed = epoch.points_m[self._on_hand][placed]
        starts: list[tuple[Float, Float]] = []
        for posture in self._postures:
            x = self._as_told(posture.copy())
            expected = self.pose(_AT_ORIGIN, self.parameters.angles(x))[1][placed]
            if turned is not None and epoch.turn is not None and epoch.turn.sure:
                T = np.eye(4)
                T[:3, :3] = turned
                T[:3, 3] = np.average(observed - expected @ turned.T, axis=0, weights=weight)
            elif self._at.belief.facing_w2[0] > 0.0:
                # A point above the wrist stands for "the back of the hand faces the cameras".
                above = expected.mean(axis=0) + np.array([0.0, _ABOVE_M, 0.0])
                towards = observed.mean(axis=0) + _ABOVE_M * epoch.facing
                T = fit_rigid(
                    np.vstack([observed, towards]),
                    np.vstack([expected, above]),
                    np.append(weight, _ABOVE_WEIGHT),
                )
            else:
                T = fit_rigid(observed, expected, weight)
            starts.append((np.ascontiguousarray(T), x))
        return starts

    def _as_told(self, x: Float) -> Float:
        """Free angles (n,) with those of fingers whose valley was searched."""
        known = self._at.scan.known > 0.0
        if not known.any():
            return x
        scanned = self.parameters.of_angles(self._at.task.scanned.reshape(5, 4))
        return np.where(known[self._finger_of_free], scanned, x)

    def _believe(self, epoch: Epoch, *, known: bool) -> None:
        """Write what is believed beside the past and habits."""
        belief, ground, turn = self._at.belief, self._at.ground, epoch.turn
        belief.facing[:] = epoch.facing
        belief.facing_w2[0] = self.settings.facing_rad**-2.0 if ground.back[0] else 0.0
        belief.depth_w2[0] = 0.0
        if known and ground.most[0] == 1:
            alone = self._rig.cameras.centre[(self._observed.weight > 0.0).sum(axis=1).argmax()]
            sight = self._now.palm[:3, 3] - alone
            belief.sight[:] = sight / np.sqrt(sight @ sight)
            belief.depth_w2[0] = self.settings.held_depth_m**-2.0
        belief.turned[0] = turn is not None
        if turn is not None:
            belief.forearm[:3, :3], belief.turn_info[:] = turn.rotation, turn.information
            belief.on_forearm[0] = turn.axes is not None
            belief.axes[:] = 0.0 if turn.axes is None else turn.axes
        belief.place_w2[0] = 0.0
        if epoch.place is not None:
            belief.place[:], belief.place_w2[0] = epoch.place, _STANDS_M**-2.0

    def _enough(self, epoch: Epoch) -> bool:
        """Tell whether the markers fix a hand: not in one line, or across `facing`.

        What faces the cameras turns the hand about a line of markers, but not about one that points at them. With an
        orientation that is known any one marker is enough.
        """
        if epoch.place is not None:
            return True
        points = epoch.points_m[self._on_hand][self._placed(epoch)]
        if epoch.turn is not None and epoch.turn.sure:
            return len(points) > 0
        if len(points) < 2:
            return False
        off = points - points.mean(axis=0)
        if len(points) > 2:  # plainly not in one line, without what a decomposition takes
            length2 = np.vecdot(off, off)
            along, longest2 = off @ off[length2.argmax()], float(length2.max())
            if longest2 > 0.0 and float((length2 - along * along / longest2).max()) > (4.0 * _SPREAD_M) ** 2:
                return True
        _, extent, axes = np.linalg.svd(off)
        if len(points) > 2 and extent[1] > _SPREAD_M:
            return True
        return bool(
            self._at.ground.back[0] and extent[0] > _LENGTH_M and abs(axes[0] @ epoch.facing) < _ACROSS
        )

    def _placed(self, epoch: Epoch) -> Bool:
        """Tell of which of the hand's markers (M,) the places are known."""
        if epoch.cov_m2 is not None:
            return self._observed.placed
        return np.isfinite(epoch.points_m[self._on_hand].sum(axis=1))

    def _knows_place(self) -> bool:
        """Tell whether the place of a hand is known of which only fingers are told."""
        return self.known and float(np.trace(self._now.cov[3:6, 3:6])) < 3.0 * _SOMEWHERE_M**2

    def _habits_of(self, unlike: frozenset[int]) -> Habits:
        """Habits while some fingers are bent unlike the others, worked out once."""
        if unlike not in self._habits:
            habits = habits_of(self.model, self.parameters, self.settings, unlike)
            self._habits[unlike] = habits.natural() if self._only_natural else habits
        return self._habits[unlike]

    def _likeliest(self) -> Float:
        """Free angles (n,) of the natural hand."""
        habits = self._habits_of(_NONE)
        x = np.asarray(np.linalg.solve(habits.normal[0], habits.pull[0]), np.float64)
        return np.minimum(np.maximum(x, self.parameters.low), self.parameters.high)

    def _levels(self, at: Epoch) -> Int:
        """What a wrist device tells the fingers from (5,), now or in the triple before."""
        age_s = (at.t_ns - self._now.told_ns[:5]) * 1e-9
        return np.where(age_s <= self.settings.tracked_triple_s, self._now.level, 0).astype(np.int64)

    def _rests(self, at: Epoch, *, palm_shown: bool) -> Int:
        """What thumb ... little and the palm rest on now (6,), as of `Fitted`."""
        ground = self._at.ground
        rests = ground.rests.copy()
        if self.wrist:
            rests[:5] += ON_OTHERS * self._levels(at)
        if not palm_shown:
            rests[5] = 0
        elif not ground.by_markers[0]:
            rests[5] += ON_OTHERS
        return rests

    def _fitted(self, at: Epoch, out: Estimate, rests: Int, *, anew: bool, left_out: bool) -> Fitted:
        found, task = self._at.found, self._at.task
        recent = (at.t_ns - int(self._now.seen_ns[0])) * 1e-9 <= self.settings.forget_s
        known = 6 + len(found.x)
        hand = FittedHand(
            T_rig_palm=out.palm,
            angles_rad=out.angles.reshape(5, 4),
            joints=HandJoints(out.position, out.rotation, out.palm),
            cov_m2=out.cov,
            tilt_cov_rad2=out.tilt,
            tilt_walk_rad2_s2=out.tilt_walk,
            alone=found.cov[:known, :known].copy(),
            x=found.x.copy(),
            scale=float(found.scale[0]),
            natural=float(found.natural[0]),
            surprise=found.surprise[: len(self._on_hand)].copy(),
            steps=int(found.steps[0]),
            twist=self._now.z[:5].copy() if self.wrist else np.zeros(5),
        )
        return Fitted(
            hand,
            np.full(26, recent),
            out.tracked & recent,
            out.source,
            rests,
            anew,
            level=np.where(self._told(), task.level, 0).astype(np.uint8) if self.wrist else _NO_LEVEL,
            ambiguous=task.ambiguous > 0,
            turn_left_out=left_out,
            refused=task.refused > 0,
            off=task.off > 0,
        )


def _unknown(rests: Int) -> Fitted:
    """No hand."""
    none = np.zeros(26, np.bool_)
    return Fitted(None, none, none.copy(), np.zeros(26, np.uint8), rests, False)


def _capacity(markers: int) -> int:
    """Round a count of markers up, so that kernels are compiled once for most rigs."""
    return max(-(-markers // _STEP), 1) * _STEP
