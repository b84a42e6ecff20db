"""Predict a hand from the epoch before, and fit it to what is measured."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from common.arrays import Float, Int
from common.geometry.camera_model import CameraModel
from common.hand.model import HandJoints, HandModel
from master.estimator.epoch import Epoch, Fitted, FittedHand
from master.estimator.epoch_steps import EpochSteps
from master.estimator.observation_sources import ON_OTHERS
from master.estimator.parameters import HandParameters
from master.estimator.reinitialise import NONE, PosturePriorTables, Reinitialiser
from master.estimator.settings import DEFAULT, Settings
from master.estimator.update import Estimate
from master.estimator.wrist_device import HEADING, LED_SCALE, WRIST_ANGLES
from master.estimator.wrist_model import WristModel

_SURE_RAD2 = 3.0 * np.radians(5.0) ** 2  # of the turn of a palm that markers place well


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
            natural: Whether the hand follows the posture prior, and begins anew where markers are unexplained: the fit
                of the card's line, which has no other hand to begin from.
            settings: Every number that tunes it.
            wrist: A wrist device on the forearm of this hand; None: there is none.

        Raises:
            CalibrationError: The profile mounts no marker of one of the names.
        """
        self.model, self.settings, self.wrist = model, settings, wrist is not None
        self._continuous, self._natural_only = continuous, natural
        self.parameters = HandParameters.of(model)
        posture_prior = PosturePriorTables(model, self.parameters, settings, natural=natural)
        self._posture_prior = posture_prior.unlike(NONE)
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
        self._now.z_cov[WRIST_ANGLES:LED_SCALE] = self._now.z_cov[:, WRIST_ANGLES:LED_SCALE] = 0.0
        self._now.z_cov[range(WRIST_ANGLES, LED_SCALE), range(WRIST_ANGLES, LED_SCALE)] = (
            self._now.stationary[WRIST_ANGLES:LED_SCALE]
        )

    def begin_heading(self, heading_rad: float, variance_rad2: float) -> None:
        """Take the heading of an IMU from a palm that was solved without it."""
        self._now.z[HEADING] = heading_rad
        self._now.z_cov[HEADING] = self._now.z_cov[:, HEADING] = 0.0
        self._now.z_cov[HEADING, HEADING] = variance_rad2
        self._now.measured_rotation_known[0] = False

    def pose(self, T: Float, angles_rad: Float) -> tuple[HandJoints, Float]:
        """Place joints and markers (M, 3) [m], rig frame.

        Of a palm (4, 4) and angles (5, 4) [rad]. The angles are cut at their limits, in place.
        """
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
                if rejected and np.trace(self._at.found.cov[:3, :3]) < _SURE_RAD2:
                    break
        by_device = self.wrist and bool(task.solver_mode.any())
        if ground.seen[0] > 0 or (by_device and (at.place is not None or self._knows_place())):
            self._now.seen_ns[0] = at.t_ns
        sources = self._sources(at, palm_shown=palm_shown)
        return (
            _unknown(sources)
            if out is None
            else self._fitted(at, out, sources, reinitialised=reinitialised, rejected=rejected)
        )

    def _solve(self, at: Epoch, *, known: bool) -> tuple[Estimate | None, bool]:
        """Fit an epoch and take it over.

        Returns:
            The hand; None: there is none. And whether the one before was wrong.
        """
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
        """Fit from the state.

        Returns:
            Chi square of the markers, infinite where no motion explains them but another hand does; and whether no hand
            that may take its place is better.
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
        somewhere_m = 0.1  # about each axis: a hand that is known no better than this is lost
        return self.known and float(np.trace(self._now.cov[3:6, 3:6])) < 3.0 * somewhere_m**2

    def _sources(self, at: Epoch, *, palm_shown: bool) -> Int:
        """What thumb ... little and the palm rest on now (6,), as of `Fitted`.

        Of what a wrist device measures the level counts, that of now or of the strobe cycle before.
        """
        ground = self._at.ground
        sources: list[int] = ground.sources.tolist()
        if self.wrist:
            by_device = zip(
                self._now.solver_mode.tolist(), self._now.measured_ns.tolist(), strict=False
            )  # of fingers alone
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


def _unknown(sources: Int) -> Fitted:
    """No hand."""
    none = np.zeros(26, np.bool_)
    return Fitted(None, none, none.copy(), np.zeros(26, np.uint8), sources, False)
