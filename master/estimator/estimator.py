"""The estimator predicts a hand, fits it, and starts again when lost.

`Reinitialiser` fits one epoch alone, from another hand of the epoch if there is one that explains the
markers; else from several, open to closed, each laid on the markers as a rigid body, of which the best goes
on.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache

import numpy as np

from common.arrays import Float, Int
from common.calibration import Volume
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import fit_rigid
from common.hand.model import HandJoints, HandModel
from common.hand.wrist import forearm_palm
from common.messages import HandPose
from master.estimator.epoch import Epoch, EpochSteps, Fitted, FittedHand, HandEstimate, MarkerPositions
from master.estimator.kinematics import quaternions
from master.estimator.parameters import HandParameters
from master.estimator.posterior import ON_OTHERS
from master.estimator.priors import PosturePrior, WristModel, curled, posture_prior_of
from master.estimator.sensors import HEADING, LED_SCALE, WRIST_ANGLES
from master.estimator.settings import DEFAULT, KERNEL, LAWS, Settings
from master.estimator.update import Estimate
from master.rig.merge import inside

_AT_ORIGIN = np.eye(4)
NONE = frozenset[int]()


class Reinitialiser:
    """Fits without the state. What it holds was prepared by the constructor."""

    def __init__(
        self,
        steps: EpochSteps,
        parameters: HandParameters,
        posture_prior: Callable[[frozenset[int]], PosturePrior],
        settings: Settings,
    ) -> None:
        """Prepare; `posture_prior` gives that of a hand with fingers unlike the others."""
        self._steps, self._parameters = steps, parameters
        self._posture_prior, self._settings = posture_prior, settings
        postures = np.zeros((len(LAWS.begin_pip_rad), 5, 4))
        postures[:, 1:, 1:3] = np.multiply.outer(LAWS.begin_pip_rad, (settings.begin_mcp_per_pip, 1.0))[
            :, None
        ]
        self._postures = np.array([parameters.of_angles(angles) for angles in postures])
        self._finger_of_free = parameters.free // 4
        any_finger = posture_prior(NONE)
        likeliest = np.asarray(np.linalg.solve(any_finger.normal[0], any_finger.pull[0]), np.float64)
        self._natural = np.minimum(np.maximum(likeliest, parameters.low), parameters.high)

    def begin(self, at: Epoch) -> float:
        """Fit without the state; return chi square of the markers.

        From the other hand, or several starts. A finger between two that show is rather bent as they are: no
        hand curls it alone, but straight it would show.
        """
        shown = frozenset(np.flatnonzero(self._steps.at.ground.shown).tolist())
        like = frozenset(f for f in (2, 3) if f not in shown and {f - 1, f + 1} <= shown)
        chi2 = self._begin_with(at, shown, like)
        angles = self._parameters.angles(self._steps.at.found.x)
        straight = frozenset(f for f in like if angles[f, 1:].sum() < self._settings.shows_rad)
        return self._begin_with(at, shown, like - straight) if straight else chi2

    def _begin_with(self, at: Epoch, shown: frozenset[int], like: frozenset[int]) -> float:
        """As `begin`, while the hidden fingers of `like` are bent as their neighbours."""
        steps, outliers, start = self._steps, frozenset(range(5)) - shown - like, at.start
        task, epoch_prior, begin = steps.at.task, steps.at.epoch_prior, steps.at.scratch.start
        epoch_prior.past_w2[:] = epoch_prior.past[:] = 0.0
        epoch_prior.palm_w2[:] = epoch_prior.depth_w2[:] = 0.0
        fingers = np.isin(np.arange(5), list(outliers))
        epoch_prior.own_w2[:], epoch_prior.own[:] = curled(self._parameters, self._settings, fingers)
        even = 0.5  # probability
        task.natural_weight[0], task.counts[0] = even, 0.0
        posture_prior = self._posture_prior(outliers)
        try:
            if start is not None:
                shows = steps.at.ground.shown[self._finger_of_free] > 0
                x = np.where(shows, self._parameters.of_angles(start.angles_rad), self._natural)
                begin.palm[:], begin.x[:] = start.T_rig_palm, self._with_scanned(x)
                chi2 = steps.fit(posture_prior)
                if steps.at.found.steps[0] < KERNEL.steps and not steps.has_outlier():
                    return chi2
            ends = list[tuple[float, Float, Float]]()
            starts = self._starts(at)
            if len(starts) == 1:
                begin.palm[:], begin.x[:] = starts[0]
                return steps.fit(posture_prior)
            for T, x in starts:
                begin.palm[:], begin.x[:] = T, x
                ends.append((steps.fit(posture_prior, coarse=True), begin.palm.copy(), begin.x.copy()))
            _, begin.palm[:], begin.x[:] = min(ends, key=lambda end: end[0])
            return steps.fit(posture_prior)
        finally:
            epoch_prior.own_w2[:] = 0.0

    def _starts(self, epoch: Epoch) -> list[tuple[Float, Float]]:
        """Return three hands laid on the markers as rigid bodies, or a known palm's."""
        steps, measured = self._steps, self._measured_rotation(epoch)
        if epoch.place is not None and measured is not None:
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = measured, epoch.place
            return [(T, self._with_scanned(self._natural.copy()))]
        triangulated, s = steps.triangulated, self._settings
        weight = np.where(steps.finger[triangulated] >= 0, 1.0, s.begin_palm_weight)
        observed = epoch.points_m[steps.on_hand][triangulated]
        starts: list[tuple[Float, Float]] = []
        for posture in self._postures:
            x = self._with_scanned(posture.copy())
            expected = steps.pose(_AT_ORIGIN, self._parameters.angles(x))[1][triangulated]
            if measured is not None and epoch.orientation is not None and epoch.orientation.sure:
                T = np.eye(4)
                T[:3, :3] = measured
                T[:3, 3] = np.average(observed - expected @ measured.T, axis=0, weights=weight)
            elif steps.at.epoch_prior.back_normal_w2[0] > 0.0:
                # A point above the wrist stands for "the back of the hand faces the cameras".
                above = expected.mean(axis=0) + np.array([0.0, s.begin_above_m, 0.0])
                towards = observed.mean(axis=0) + s.begin_above_m * epoch.back_normal
                T = fit_rigid(
                    np.vstack([observed, towards]),
                    np.vstack([expected, above]),
                    np.append(weight, s.begin_above_weight),
                )
            else:
                T = fit_rigid(observed, expected, weight)
            starts.append((np.ascontiguousarray(T), x))
        return starts

    def _measured_rotation(self, at: Epoch) -> Float | None:
        """Return the palm (3, 3) by other sensors and wrist flexion; None: neither."""
        if at.orientation is None or at.orientation.axes is None:
            return None if at.orientation is None else at.orientation.rotation
        return at.orientation.rotation @ forearm_palm(self._steps.now.z[WRIST_ANGLES : WRIST_ANGLES + 2])

    def _with_scanned(self, x: Float) -> Float:
        """Return free angles (n,) with those of scanned fingers filled in."""
        known = self._steps.at.scan.known > 0.0
        if not known.any():
            return x
        scanned = self._parameters.of_angles(self._steps.at.task.scanned.reshape(5, 4))
        return np.where(known[self._finger_of_free], scanned, x)


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
        """Prepare; cameras in the rig's order, markers in that of every marker array.

        Args:
            hand_markers: Those of them that are on this hand.
            continuous: False: every epoch is an unrelated pose, nothing is remembered.
            natural: Whether the hand follows the posture prior, and begins anew where markers are unexplained: the
                fit of the card's line, which has no other hand to begin from.
            wrist: A wrist device on the forearm of this hand; None: there is none.

        Raises:
            CalibrationError: The profile mounts no marker of one of the names.
        """
        self.model, self.settings, self.wrist = model, settings, wrist is not None
        self._continuous, self._natural_only = continuous, natural
        self.parameters = HandParameters.of(model)

        @cache
        def posture_prior(unlike: frozenset[int]) -> PosturePrior:
            prior = posture_prior_of(model, self.parameters, settings, unlike)
            return prior.natural_component() if natural else prior

        self._posture_prior = posture_prior(NONE)
        self._natural_prior = self._posture_prior.natural_component()
        self._steps = EpochSteps(
            cameras, model, self.parameters, markers, hand_markers, self._posture_prior, settings, wrist
        )
        self._reinitialiser = Reinitialiser(self._steps, self.parameters, posture_prior, settings)
        self.state, self._now, self._at = self._steps.state, self._steps.now, self._steps.at

    @property
    def known(self) -> bool:
        """Whether there is a hand to go on from."""
        return bool(self._now.known[0])

    @property
    def t_ns(self) -> int:
        """The last epoch that had a hand."""
        return int(self._now.t_ns[0])

    def has_previous(self, t_ns: int) -> bool:
        """Return whether the state is still informative at `t_ns`."""
        age_s = (t_ns - int(self._now.t_ns[0])) * 1e-9
        return self._continuous and bool(self._now.known[0]) and 0.0 < age_s <= self.settings.forget_s

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
        cov, learnt = self._now.z_cov, np.arange(WRIST_ANGLES, LED_SCALE)
        cov[learnt] = cov[:, learnt] = 0.0
        cov[learnt, learnt] = self._now.stationary[learnt]

    def begin_heading(self, heading_rad: float, variance_rad2: float) -> None:
        """Take the heading of an IMU from a palm that was solved without it."""
        self._now.z[HEADING] = heading_rad
        self._now.z_cov[HEADING] = self._now.z_cov[:, HEADING] = 0.0
        self._now.z_cov[HEADING, HEADING] = variance_rad2
        self._now.measured_rotation_known[0] = False

    def pose(self, T: Float, angles_rad: Float) -> tuple[HandJoints, Float]:
        """Place joints, markers (M, 3) [m], rig frame; clip the angles (5, 4), in place."""
        return self._steps.pose(T, angles_rad)

    def push(self, at: Epoch) -> Fitted:
        """Fit one epoch."""
        steps, task, ground = self._steps, self._at.task, self._at.ground
        steps.observe(at, continuous=self._continuous)
        if self.wrist:
            steps.prepare()
        sure = at.orientation is not None and at.orientation.sure
        palm_shown = bool(ground.by_markers[0]) or (sure and ground.seen[0] > 0) or at.place is not None
        task.palm_shown[0] = palm_shown
        known = self.has_previous(at.t_ns)
        steps.set_priors(at, known=known)
        may_contradict = self.wrist and at.orientation is not None and bool(ground.by_markers[0])
        before, rejected = steps.kept() if may_contradict else None, False
        out, reinitialised = self._solve(at, known=known)
        if out is not None and before is not None and self._at.found.contrary[0] > self.settings.contrary:
            # The IMU is rejected: it began anew, or the wrist was flicked. But not where it is the only measurement.
            for orientation in (None, at.orientation):
                steps.put_back(before)
                steps.set_priors(replace(at, orientation=orientation), known=known)
                out, reinitialised = self._solve(replace(at, orientation=orientation), known=known)
                rejected = orientation is None
                sure_rad2 = 3.0 * self.settings.sure_palm_rad**2
                if rejected and np.trace(self._at.found.cov[:3, :3]) < sure_rad2:
                    break
        by_device = self.wrist and bool(task.solver_mode.any())
        if ground.seen[0] > 0 or (by_device and (at.place is not None or self._knows_place())):
            self._now.seen_ns[0] = at.t_ns
        sources = self._sources(at, palm_shown=palm_shown)
        if out is None:
            none = np.zeros((2, 26), np.bool_)
            return Fitted(None, none[0], none[1], np.zeros(26, np.uint8), sources)
        return self._fitted(at, out, sources, reinitialised=reinitialised, rejected=rejected)

    def _solve(self, at: Epoch, *, known: bool) -> tuple[Estimate | None, bool]:
        """Fit an epoch and take it over; return the hand, and if it began anew."""
        if known:
            wrong, consistent = self._go_on(at, may_leave=True)
            # Where nothing is better, what goes on is kept.
            goes_on = consistent or wrong <= self.settings.misled + self._reinitialiser.begin(at)
            if goes_on and not consistent:
                self._go_on(at, may_leave=False)
        elif self._steps.determines_hand(at):
            goes_on = False
            self._reinitialiser.begin(at)
        else:
            return None, False
        reinitialised = known and not goes_on and not self._natural_only
        return self._steps.take_over(goes_on=goes_on), reinitialised

    def _go_on(self, at: Epoch, *, may_leave: bool) -> tuple[float, bool]:
        """Fit from the state; return chi square of the markers, and if the fit stands.

        Infinite: no motion explains the markers, but another hand does.
        """
        start, task = at.start, self._at.task
        task.may_leave[0] = may_leave and start is not None and self._steps.determines_hand(at)
        if start is not None:
            task.palm[:], task.angles[:] = start.T_rig_palm, start.angles_rad.reshape(20)
        limit = self._steps.predict()
        if limit < 0.0:
            return np.inf, False
        # Whether a hand follows the posture prior, fingers before a wrist device decide by themselves.
        wrong = self._steps.fit(self._posture_prior if self._at.ground.seen[0] > 0 else self._natural_prior)
        if self._natural_only and may_leave:
            return wrong, not (self._steps.has_outlier() and self._steps.determines_hand(at))
        return wrong, not wrong > limit  # NaN: there is nothing to compare

    def _knows_place(self) -> bool:
        """Return whether the position of a hand measured only by its fingers is known."""
        return self.known and float(np.trace(self._now.cov[3:6, 3:6])) < 3.0 * self.settings.lost_m**2

    def _sources(self, at: Epoch, *, palm_shown: bool) -> Int:
        """What each finger and the palm rest on (6,), as of `Fitted`; devices by level."""
        ground = self._at.ground
        sources: list[int] = ground.sources.tolist()
        if self.wrist:
            # of fingers alone
            by_device = zip(self._now.solver_mode.tolist(), self._now.measured_ns.tolist(), strict=False)
            for f, (solver_mode, measured_ns) in enumerate(by_device):
                if (at.t_ns - measured_ns) * 1e-9 <= self.settings.tracked_cycle_s:
                    sources[f] += ON_OTHERS * solver_mode
        if not palm_shown:
            sources[5] = 0
        elif not ground.by_markers[0]:
            sources[5] += ON_OTHERS
        return np.array(sources)

    def _fitted(
        self, at: Epoch, out: Estimate, sources: Int, *, reinitialised: bool, rejected: bool
    ) -> Fitted:
        found, task = self._at.found, self._at.task
        has_previous = (at.t_ns - int(self._now.seen_ns[0])) * 1e-9 <= self.settings.forget_s
        known = 6 + len(found.x)
        hand = FittedHand(
            T_rig_palm=out.palm,
            angles_rad=out.angles.reshape(5, 4),
            joints=HandJoints(out.position, out.rotation, out.palm),
            cov_m2=out.cov,
            tilt_cov_rad2=out.tilt,
            tilt_process_noise_rad2_s2=out.tilt_process_noise,
            measurement_cov=found.cov[:known, :known].copy(),
            x=found.x.copy(),
            scale=float(found.scale[0]),
            natural_weight=float(found.natural_weight[0]),
            marker_chi2=found.marker_chi2[: len(self._steps.on_hand)].copy(),
            steps=int(found.steps[0]),
            twist=self._now.z[:5].copy() if self.wrist else np.zeros(5),
        )
        return Fitted(
            hand,
            np.full(26, has_previous),
            out.tracked if has_previous else np.zeros(26, np.bool_),
            out.source,
            sources,
            reinitialised,
            solver_mode=task.solver_mode.copy(),
            ambiguous=task.ambiguous.astype(np.bool_),
            rotation_rejected=rejected,
            refused=task.refused.astype(np.bool_),
            off=task.off.astype(np.bool_),
        )


def pose_of(
    hand: Fitted | HandEstimate,
    model: HandModel,
    t_ns: int,
    smooth_m: Float,
    markers: MarkerPositions,
    volume: Volume | None = None,
) -> HandPose:
    """The message of one hand, markers smoothed and not; all NaN, not valid: unknown."""
    solution = hand.solution
    if solution is None:
        nothing = np.full((26, 3, 3), np.nan)
        position, cov, orientation = nothing[:, 0].copy(), nothing, np.full((26, 4), np.nan)
        angles = np.full((5, 4), np.nan)
    else:
        position, cov, angles = solution.joints.position_m, solution.cov_m2, solution.angles_rad
        orientation = np.empty((26, 4))
        quaternions(solution.joints.rotation, orientation)
    return HandPose.known_good(
        model.profile.name,
        t_ns,
        position_m=position,
        orientation_wxyz=orientation,
        radius_m=model.radius_m,
        valid=hand.valid,
        tracked=hand.tracked,
        cov_m2=cov,
        source=hand.source,
        angles_rad=angles,
        markers_m=smooth_m,
        markers_raw_m=markers.points_m,
        markers_cov_m2=markers.cov_m2,
        inside_volume=inside(volume, position),
    )
