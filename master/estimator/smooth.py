"""Smooth the solved hand by the rig's 1 € filter, and blend over leaps.

**Signals.** Position and rotation of the palm and the angles go through one filter (`master.fabrik.one_euro`), the
palm and each finger as a group. All 26 signals are in metres, so that the rig's settings mean for the hand what they
mean for points: an angle counts by how far it moves the end of its finger, the rotation by how far it moves the ends of
the fingers. The palm's position is that of its middle knuckle, about which its rotation is unsure: at the wrist the
noise of the rotation would shake the position as well. A rotation is filtered as the sum of the filter's own steps and
the rotation vector from there to what was solved, so it is never near half a turn.

**Noise.** The variance of each signal is measured while it runs (`master.fabrik.noise`) and is at most that of the
markers it rests on. A solved pose is steadier than its markers in one pose and less steady in another, as its priors
hold it, and its covariance contains errors that stay; neither says what is new in each frame.

The joints come from forward kinematics of what was filtered, so bones keep their lengths. Where the DIP follows the
PIP, what goes through the filter is by how much it does not. A filtered angle lies between angles that were within
limits; what has to be cut is an abduction that the filtered flexion does not allow.

**Leaps.** A finger that is seen again, or the palm, is elsewhere than it was held; and where another sensor takes over
from markers, or these from it, it is elsewhere by their errors. The difference between what was shown last and what is
solved now is added to the solution and fades within a tenth of a second, as networked games lead a player over to where
the server says it is: the motion goes on, the error goes. While it fades, the covariance of a joint contains the square
of how far it is shown from where it is solved to be.

A hand that was wrong a moment ago, as its tracker says, is shown at once where it is, and the filter begins anew.

A hand that several kinds of sensors watch leaps more often, and is led in as `master.estimator.lead` has it. A joint of
it is not called tracked while it is shown more than 5 mm from where it is solved to be.

Beside that the covariance is the solution's. Filtering takes noise away and adds lag; neither is in it.
"""

from dataclasses import dataclass, replace
from math import atan2

import numpy as np

from common.arrays import Bool, Float, Int
from common.geometry import matrix_to_rotation_vector, rigid, rotation_vector_to_matrix, unskew
from common.hand_model import CHAINS, MIDDLE_PROXIMAL, TIPS, HandJoints, HandModel
from master.estimator.estimator import Fitted, FittedHand
from master.estimator.lead import ANGLES, PARTS, PLACE, TURN, Lead
from master.fabrik.noise import NoiseEstimator
from master.fabrik.one_euro import OneEuro, OneEuroParameters

LEAD_OVER_S = 0.1
_GROUPS = (6, 4, 4, 4, 4, 4)  # the palm and each finger
_ELSEWHERE_M = 5e-3
_FORGET_S = 0.5  # after this long without a hand the next one begins anew


@dataclass(slots=True, eq=False)
class _Shown:
    """What was shown last, and what is left of leaps; a new hand has a new one.

    Attributes:
        noise: Measures the noise of the signals.
        smooth: The filter of the 26 signals: place (3), turn (3), angles (5, 4), all [m].
        t_ns: When.
        rests: (6,) what the fingers, and the palm, rested on: `Fitted.rests`.
        values: (26,) [m] the filtered signals.
        rotation: (3, 3) palm to rig, as filtered.
        offset: (26,) [m] what was shown less what was solved, when each part was last seen again.
        since_ns: (6,) when that was.
        until_ns: When nothing is left of any.
    """

    noise: NoiseEstimator
    smooth: OneEuro
    t_ns: int
    rests: Int
    values: Float
    rotation: Float
    offset: Float
    since_ns: Int
    until_ns: int

    def leap(self, t_ns: int, parts: Bool, solved: Float) -> None:
        """Parts (6,) are seen again, at signals (26,)."""
        self.offset = np.where(parts[PARTS], self.values - solved, self.offset)
        self.since_ns = np.where(parts, t_ns, self.since_ns)
        self.until_ns = t_ns + round(LEAD_OVER_S * 1e9)

    def left(self, t_ns: int) -> Float | None:
        """What is left of the leaps (26,) [m]; None: nothing."""
        if t_ns >= self.until_ns:
            return None
        x = np.minimum((t_ns - self.since_ns) * (1e-9 / LEAD_OVER_S), 1.0)
        return self.offset * (1.0 - x * x * (3.0 - 2.0 * x))[PARTS]  # smooth at both ends


class HandOneEuro:
    """Push machine. Holds what was shown last, the filter, what is left of leaps."""

    def __init__(
        self,
        model: HandModel,
        markers: tuple[str, ...],
        parameters: OneEuroParameters,
        lead_m_s: float | None = None,
    ) -> None:
        """Set up.

        Args:
            model: The hand.
            markers: Names of its markers in the order of the covariances.
            parameters: Of the 1 € filter [m, s].
            lead_m_s: How fast the palm, and a finger on it, may be led over [m/s]; None: within a tenth of a second.

        Raises:
            CalibrationError: The profile mounts no marker of one of the names.
        """
        self._model, self._parameters = model, parameters
        rest = model.rest_position_m
        self._knuckle = rest[MIDDLE_PROXIMAL]
        fingers = [model.mount(name).finger for name in markers]
        self._marker_of = np.array([fingers.index(f) if f in fingers else -1 for f in range(5)])
        self._dip_per_pip = model.dip_per_pip or 0.0
        # The DIP bends with the PIP, so it counts as far.
        self._reach_m = np.linalg.norm(rest[TIPS][:, None] - rest[CHAINS[:, [0, 0, 1, 1]]], axis=2)
        self._across_m = float(np.linalg.norm(rest[TIPS[1:]] - self._knuckle, axis=1).mean())
        self._on_palm = np.array([model.mount(name).joint is None for name in markers], np.bool_)
        self._lead_m_s = lead_m_s
        self._lead: Lead | None = None
        self._shown: _Shown | None = None

    def push(self, t_ns: int, hand: Fitted, cov_m2: Float, points_m: Float | None = None) -> Fitted:
        """Filter palm, angles and joints of a hand; the rest of it stays.

        Args:
            t_ns: The instant; a hand that is not after the last one is passed on as it is.
            hand: As solved. One that is not valid is passed on, and what follows begins anew.
            cov_m2: (M, 3, 3) [m^2] noise of the markers; NaN: not measured. What rests on none is filtered by
                the noise it shows.
            points_m: (M, 3) [m] the markers, of a hand that other sensors watch, too; NaN: not seen.
        """
        solution, shown = hand.solution, self._shown
        if solution is None or not hand.valid.any():
            self._shown = None
            return hand
        rests = hand.rests
        seen: Bool = rests > 0
        gap_s = 0.0 if shown is None else (t_ns - shown.t_ns) * 1e-9
        if shown is None or gap_s > _FORGET_S or (hand.anew and self._lead is None):
            shown, gap_s = self._begin(t_ns, solution, rests), 0.0
            self._shown = shown
        elif gap_s <= 0.0:
            return hand
        signals = self._signals(solution, shown)
        if self._lead is not None and points_m is not None:
            left: Float | None = self._lead.push(gap_s, rests, shown.values, signals, points_m)
        else:
            self._leap(t_ns, gap_s, shown, rests, signals)
            left = shown.left(t_ns)
        if left is not None:
            signals = signals + left
        variance = shown.noise.push(t_ns, signals, self._noise(cov_m2, seen))
        signals = shown.smooth.push(t_ns, signals, variance)
        rotation = rotation_vector_to_matrix((signals - shown.values)[TURN] / self._across_m) @ shown.rotation
        joints, angles = self._posed(signals, rotation)
        cov, tracked = solution.cov_m2, hand.tracked
        if left is not None:
            off = joints.position_m - solution.joints.position_m
            cov = cov + off[:, :, None] * off[:, None, :]
            if self._lead is not None:
                tracked = tracked & (np.vecdot(off, off) < _ELSEWHERE_M**2)
        if self._lead is not None:
            self._lead.moved(gap_s, signals - shown.values)
        shown.t_ns, shown.rests, shown.values, shown.rotation = t_ns, rests, signals, rotation
        T = joints.T_rig_palm
        return replace(
            hand,
            solution=replace(solution, T_rig_palm=T, angles_rad=angles, joints=joints, cov_m2=cov),
            tracked=tracked,
        )

    def _leap(self, t_ns: int, gap_s: float, shown: _Shown, rests: Int, solved: Float) -> None:
        """Keep what is seen again from leaping to where it is solved to be (26,) [m]."""
        if gap_s <= 0.0:
            return
        seen: Bool = rests > 0
        again = seen if gap_s > LEAD_OVER_S else seen & (shown.rests == 0)  # without frames, nothing was seen
        if again.any():
            shown.leap(t_ns, again, solved)

    def _begin(self, t_ns: int, solution: FittedHand, rests: Int) -> _Shown:
        self._lead = None if self._lead_m_s is None else Lead(self._lead_m_s, self._on_palm)
        rotation, never = solution.T_rig_palm[:3, :3], np.zeros(6, np.int64)
        noise, smooth = NoiseEstimator(), OneEuro(self._parameters, _GROUPS)
        return _Shown(noise, smooth, t_ns, rests, np.zeros(26), rotation, np.zeros(26), never, t_ns)

    def _signals(self, solution: FittedHand, shown: _Shown) -> Float:
        """What is filtered (26,) [m]."""
        rotation, angles = solution.T_rig_palm[:3, :3], solution.angles_rad.copy()
        angles[1:, 3] -= self._dip_per_pip * angles[1:, 2]
        signals = np.empty(26)
        signals[PLACE] = rotation @ self._knuckle + solution.T_rig_palm[:3, 3]
        signals[TURN] = shown.values[TURN] + self._across_m * _turn(rotation @ shown.rotation.T)
        signals[ANGLES] = (angles * self._reach_m).ravel()
        return signals

    def _posed(self, signals: Float, rotation: Float) -> tuple[HandJoints, Float]:
        """Joints and angles (5, 4) [rad] of filtered signals (26,) [m]."""
        angles = signals[ANGLES].reshape(5, 4) / self._reach_m
        angles[1:, 3] += self._dip_per_pip * angles[1:, 2]
        angles = self._model.clamp(angles)
        wrist = signals[PLACE] - rotation @ self._knuckle
        return self._model.joints(rigid(rotation, wrist), self._model.chains(angles)), angles

    def _noise(self, cov_m2: Float, seen: Bool) -> Float:
        """Return variances (26,) [m^2] of the markers that each part rests on.

        A finger rests on its own and the palm's; NaN: on none.
        """
        noise = np.full(26, np.nan)
        axes = cov_m2.reshape(-1, 9)[:, ::4]
        measured = axes[axes[:, 0] > 0.0]  # NaN is not
        if not len(measured):
            return noise
        place = measured.sum(axis=0) / len(measured)
        turn = place.sum() / 3.0
        if seen[5]:
            noise[PLACE], noise[TURN] = place, turn
        finger = axes[self._marker_of].sum(axis=1) / 3.0 + turn
        finger[~seen[:5] | (self._marker_of < 0)] = np.nan
        noise[ANGLES] = finger.repeat(4)
        return noise


def _turn(rotation: Float) -> Float:
    """Return the rotation vector (3,) of a rotation (3, 3).

    As `matrix_to_rotation_vector`, in a third of the time.
    """
    vector = unskew(rotation)
    sine = float(vector @ vector) ** 0.5
    if sine < 1e-6:  # none, or half a turn
        return matrix_to_rotation_vector(rotation)
    return vector * (atan2(sine, 0.5 * (float(rotation.trace()) - 1.0)) / sine)
