"""Smooth the solved hand by the rig's 1 € filter, and blend over leaps.

**Signals.** Position and rotation of the palm and the angles go through one filter (`master.fabrik.one_euro`), the
palm and each finger as a group. All 26 signals are in metres, so that the rig's settings mean for the hand what they
mean for points: an angle counts by how far it moves the end of its finger, the rotation by how far it moves the ends of
the fingers. The palm's position is that of its middle knuckle, about which its rotation is unsure: at the wrist the
noise of the rotation would shake the position as well. A rotation is filtered as the sum of the filter's own steps and
the rotation vector from there to what was solved, so it is never near half a turn.

**Noise.** The variance of each signal is measured while it runs (`master.fabrik.noise`) and is at most that of the
markers it rests on. A solved pose is steadier than its markers in one pose and less steady in another, as its priors
hold it, and its covariance contains errors that stay; neither states what is new in each frame.

The joints come from forward kinematics of what was filtered, so bones keep their lengths. Where the DIP follows the
PIP, what goes through the filter is by how much it does not. A filtered angle lies between angles that were within
limits; what has to be cut is an abduction that the filtered flexion does not allow.

**Leaps.** A finger that is seen again, or the palm, is elsewhere than it was held; and where another sensor takes over
from markers, or these from it, it is elsewhere by their errors. The difference between what was shown last and what is
solved now is added to the solution and fades within a tenth of a second, as networked games lead a player over to where
the server has it: the motion goes on, the error goes. While it fades, the covariance of a joint contains the square
of how far it is shown from where it is solved to be; one whose region is too large now is not tracked.

A hand that was wrong a moment ago, as its tracker reports, is shown at once where it is, and the filter begins anew.

A hand that several kinds of sensors watch leaps more often, and is led in as `master.estimator.blend` has it.

Beside that the covariance is the solution's. Filtering takes noise away and adds lag; neither is in it.
"""

from dataclasses import replace

import numpy as np

from common.arrays import Float
from common.hand.model import HandJoints, HandModel
from common.kernels import bound
from common.messages.records import boxed, fields
from master.estimator.blend import Blend
from master.estimator.epoch import Fitted, FittedHand
from master.estimator.hand_tables import HandTables, Mounts
from master.estimator.kinematics import twist_boxed
from master.estimator.parameters import HandParameters
from master.estimator.settings import DEFAULT, Settings
from master.estimator.smoothing import REST, SIGNALS, WHOLE, Pose, Smoothing, smooth
from master.estimator.state import NEVER_NS
from master.fabrik.one_euro import OneEuroParameters


class HandOneEuro:
    """Push machine that holds the last output, the filter and jump offsets.

    The offsets are what is left of leaps (`Smoothing`).
    """

    def __init__(
        self,
        model: HandModel,
        markers: tuple[str, ...],
        parameters: OneEuroParameters,
        blend_m_s: float | None = None,
        settings: Settings = DEFAULT,
    ) -> None:
        """Set up.

        Args:
            model: The hand.
            markers: Names of its markers in the order of the covariances.
            parameters: Of the 1 € filter [m, s].
            blend_m_s: How fast the palm, and a finger on it, may be led over [m/s]; None: within a tenth of a second.
            settings: Of the estimator.

        Raises:
            CalibrationError: The profile mounts no marker of one of the names.
        """
        self._settings = settings
        self._on_palm = Mounts.of(model, markers).on_back
        self._blend_m_s = blend_m_s
        self._blend: Blend | None = None
        state = Smoothing.of(model, markers, parameters, settings)
        self._t_ns, self._values, self._signals = state.t_ns, state.values, state.signals
        self._state = boxed(state)
        self._fresh = self._state.copy()
        tables = HandTables.of(model, HandParameters.of(model))
        self._hand, self._tables = boxed(tables), fields(tables)
        twist_boxed(self._hand, np.zeros(5))  # compiled now
        sources, cov, scratch = np.zeros(6, np.int64), np.zeros((len(markers), 3, 3)), Pose.empty()
        none = np.zeros(26, np.bool_)
        self._kernel = bound(smooth, self._hand, self._state, WHOLE, 0, sources, cov, scratch, scratch, none)

    def push(self, t_ns: int, hand: Fitted, cov_m2: Float, points_m: Float | None = None) -> Fitted:
        """Filter palm, angles and joints of a hand; the rest of it stays.

        Args:
            t_ns: The epoch; a hand that is not after the last one is passed on as it is.
            hand: As solved. One that is not valid is passed on, and what follows begins anew.
            cov_m2: (M, 3, 3) [m^2] noise of the markers; NaN: not measured. What rests on none is filtered by
                the noise it shows.
            points_m: (M, 3) [m] the markers, of a hand that other sensors watch, too; NaN: not seen.
        """
        solution, sources = hand.solution, hand.sources
        if solution is None or not hand.valid.any():
            self._t_ns[0] = NEVER_NS
            return hand
        gap_s = (t_ns - int(self._t_ns[0])) * 1e-9
        if gap_s > self._settings.forget_s or (hand.reinitialised and self._blend_m_s is None):
            self._state[:], gap_s = self._fresh, 0.0
            self._blend = None if self._blend_m_s is None else Blend(self._blend_m_s, self._on_palm)
        elif gap_s <= 0.0:
            return hand
        at = solution.joints
        solved = Pose(solution.T_rig_palm, solution.angles_rad, at.position_m, at.rotation, solution.cov_m2)
        if (self._tables.twist != solution.twist).any():
            twist_boxed(self._hand, solution.twist)
        shown, cov_m2 = Pose.empty(), np.ascontiguousarray(cov_m2)
        blend, tracked, before, what = self._blend, hand.tracked.copy(), self._values.copy(), WHOLE
        if blend is not None and points_m is not None:
            self._kernel(self._hand, self._state, SIGNALS, t_ns, sources, cov_m2, solved, shown, tracked)
            self._signals += blend.push(gap_s, sources, before, self._signals, points_m)
            what = REST
        off = self._kernel(self._hand, self._state, what, t_ns, sources, cov_m2, solved, shown, tracked)
        if blend is not None:
            blend.moved(gap_s, self._values - before)
        smooth_hand = FittedHand(
            T_rig_palm=shown.palm,
            angles_rad=shown.angles,
            joints=HandJoints(shown.position, shown.rotation, shown.palm),
            cov_m2=shown.cov if off else solution.cov_m2,
            tilt_cov_rad2=solution.tilt_cov_rad2,
            tilt_process_noise_rad2_s2=solution.tilt_process_noise_rad2_s2,
            measurement_cov=solution.measurement_cov,
            x=solution.x,
            scale=solution.scale,
            natural_weight=solution.natural_weight,
            marker_chi2=solution.marker_chi2,
            steps=solution.steps,
            twist=solution.twist,
        )
        return replace(hand, solution=smooth_hand, tracked=tracked)
