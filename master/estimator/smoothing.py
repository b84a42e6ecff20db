"""The 1 € filter smooths the solved hand, and a blend covers leaps.

**Signals.** Position and rotation of the palm and the angles go through one filter
(`master.fabrik.one_euro`), the palm and each finger as a group. All 26 signals are in metres, so that the
rig's settings mean for the hand what they mean for points: an angle counts by how far it moves the end of its
finger, the rotation by the ends of the fingers. The palm's position is that of its middle knuckle: at the
wrist the noise of the rotation would shake it as well. A rotation is the sum of the filter's own steps and
the rotation vector from there to what was solved, so it is never near half a turn. Joints come from forward
kinematics of what was filtered, so bones keep their lengths. Where the DIP follows the PIP, what is filtered
is by how much it does not.

**Noise.** The variance of each signal is measured while it runs and is at most that of the markers it rests
on: neither the markers' nor the solution's covariance states what is new in each frame.

**Leaps.** What is seen again, or by another sensor, is elsewhere than it was held. The difference between
what was shown last and what is solved now fades within a tenth of a second, as networked games lead a player
over: the motion goes on, the error goes. Meanwhile the covariance of a joint contains the square of how far
it is shown off; otherwise it is the solution's. A hand that its tracker reports as wrong a moment ago is
shown at once, and the filter begins anew.

**Blend.** A hand that several kinds of sensors watch leaps more often. Palm and fingers are led in no faster
than a given speed. How it moves meanwhile is estimated without solving it: the palm goes as those markers on
its back that are in both epochs, and everything else at half the speed at which it was shown.
"""

from dataclasses import replace
from math import exp, nan
from typing import Any, NamedTuple

import numpy as np

from common.arrays import Bool, Float, Int
from common.hand.model import CHAINS, MIDDLE_PROXIMAL, TIPS, HandJoints, HandModel
from common.kernels import bound, constant, inner, kernel
from common.records import array, boxed, fields, filled, part, record
from master.estimator.covariance import is_small
from master.estimator.epoch import Fitted
from master.estimator.kinematics import (
    Scratch,
    chains,
    clamp,
    joints,
    rotate_by,
    rotation_between,
    twist_boxed,
)
from master.estimator.parameters import HandParameters, HandTables, Mounts
from master.estimator.posterior import BY_MARKERS
from master.estimator.settings import DEFAULT, Settings
from master.estimator.state import PALM_PART
from master.fabrik.linear_algebra import copy
from master.fabrik.one_euro import OneEuroParameters, filter_step, measure
from master.fabrik.settings import NEVER_NS

PLACE, ROTATION, ANGLES = slice(0, 3), slice(3, 6), slice(6, 26)
PARTS: Int = np.repeat([5, 0, 1, 2, 3, 4], [6, 4, 4, 4, 4, 4])  # signal -> finger, or 5: the palm


class Blend:
    """Push machine that holds what is left of jumps, by palm and finger."""

    def __init__(self, blend_m_s: float, on_palm: Bool, settings: Settings) -> None:
        """Blend no faster than a speed [m/s]; `on_palm` (M,): markers on the back."""
        self._blend_m_s, self._on_palm, self._settings = blend_m_s, on_palm, settings
        self._offset, self._speed = np.zeros(26), np.zeros(26)
        self._sources = np.zeros(6, np.int64)
        self._points_m = np.full((len(on_palm), 3), np.nan)

    def push(self, gap_s: float, sources: Int, shown: Float, solved: Float, points_m: Float) -> Float:
        """Return the offset to be added to the solved signals (26,) [m].

        `gap_s`: since the last; 0: there is none. `sources` (6,) as of `Fitted`; `shown`, `solved` (26,):
        what was shown last, what is solved now; `points_m` (M, 3) the markers; NaN: not seen.
        """
        if gap_s > 0.0:
            # of it: a motion that is not seen any more rather ends than goes on
            s = self._settings
            goes_on = shown + 0.5 * min(gap_s, s.led_stale_s) * self._speed
            went = (points_m - self._points_m)[self._on_palm]
            went = went[np.isfinite(went[:, 0])]
            if len(went) and gap_s <= s.led_stale_s:
                goes_on[PLACE] = shown[PLACE] + went.mean(axis=0)
            off = np.sqrt(np.bincount(PARTS, np.square(goes_on - solved - self._offset)))
            triangulated = (sources & self._sources & BY_MARKERS) > 0
            led = np.bincount(PARTS, np.abs(self._offset)) > s.led_off_m
            leaps = ((sources != self._sources) | ~triangulated | led) & (off > s.led_leap_m)
            self._offset = np.where(leaps[PARTS], goes_on - solved, self._offset)
            size_m = np.maximum(np.bincount(PARTS, np.abs(self._offset)), 1e-5)  # no division by 0
            left = 1.0 - min(self._blend_m_s * gap_s, s.led_step_m) / size_m
            self._offset = self._offset * np.maximum(left, exp(-gap_s / s.led_fades_s))[PARTS]
        self._sources, self._points_m = sources, points_m
        return self._offset

    def moved(self, gap_s: float, step: Float) -> None:
        """Learn from the step (26,) [m] of what was shown."""
        if gap_s > 0.0:
            new = 1.0 - exp(-gap_s / self._settings.led_speed_s)
            self._speed = self._speed + new * (step / gap_s - self._speed)


WHOLE, SIGNALS, REST = constant(0), constant(1), constant(2)


class Pose(NamedTuple):
    """Pose of a hand: palm, angles, joints and covariances."""

    palm: Float  # (4, 4)
    angles: Float  # (5, 4) [rad]
    position: Float  # (26, 3) [m]
    rotation: Float  # (26, 3, 3)
    cov: Float  # (26, 3, 3) [m^2]

    @classmethod
    def empty(cls) -> "Pose":
        """Scratch for one."""
        joint = np.empty((26, 3)), np.empty((26, 3, 3)), np.empty((26, 3, 3))
        return cls(np.empty((4, 4)), np.empty((5, 4)), *joint)


class Smoothing:
    """What was shown last, the filter of its 26 signals, and what is left of leaps.

    The signals are place (3), turn (3), angles (5, 4), all [m].
    """

    t_ns: Int = array(1, kind="i8")  # when; NEVER_NS: there is no hand
    sources: Int = array(6, kind="i8")  # what the fingers, and the palm, rested on: `Fitted.sources`
    values: Float = array(26)  # [m] the filtered signals
    palm: Float = array(4, 4)  # as filtered
    offset: Float = array(26)  # [m] what was shown less what was solved, when each part was last seen again
    since_ns: Int = array(6, kind="i8")  # when that was
    until_ns: Int = array(1, kind="i8")  # when nothing is left of any
    count: Int = array(2, kind="i8")  # with `dt_s`, `past`: noise (`master.fabrik.one_euro.measure`)
    dt_s: Float = array(1)
    past: Float = array(3, 26)
    x: Float = array(26)  # with `speed`, `seen_ns`: the filter (`master.fabrik.one_euro.filter_step`)
    speed: Float = array(26)
    seen_ns: Int = array(26, kind="i8")
    filter: Float = array(5)  # its settings
    part_of: Int = array(26, kind="i8")  # finger of each signal, PALM_PART: the palm
    marker_of: Int = array(5, kind="i8")  # marker of each finger; -1: there is none
    knuckle: Float = array(3)  # [m] the place in the palm frame
    across: Float = array(1)  # [m/rad] by how much a turn counts
    lever: Float = array(20)  # [m/rad] the angles
    dip_per_pip: Float = array(1)  # how the DIP follows the PIP
    blend_s: Float = array(1)  # in which leaps fade
    tracked_m: Float = array(1)  # how large the region of a tracked joint may be
    signals: Float = array(26)  # [m] as solved, and what is left of leaps
    largest: Float = array(26)  # room
    noise: Float = array(26)  # room
    filtered: Float = array(26)  # room
    fastest: Float = array(6, 2)  # room
    step: Float = array(6)  # room: turn, and no shift
    work: Scratch = part(Scratch)


def _begun(
    model: HandModel, markers: tuple[str, ...], parameters: OneEuroParameters, settings: Settings
) -> Smoothing:
    """Nothing was shown yet; arguments as of `HandOneEuro`."""
    rest, fingers = model.rest_position_m, [model.mount(name).finger for name in markers]
    knuckle = rest[MIDDLE_PROXIMAL]
    return filled(
        record(Smoothing),
        t_ns=NEVER_NS,
        until_ns=NEVER_NS,
        since_ns=NEVER_NS,
        part_of=PARTS,
        seen_ns=NEVER_NS,
        filter=parameters.array(),
        marker_of=[fingers.index(f) if f in fingers else -1 for f in range(5)],
        knuckle=knuckle,
        across=np.linalg.norm(rest[TIPS[1:]] - knuckle, axis=1).mean(),
        # The DIP bends with the PIP, so it counts as far.
        lever=np.linalg.norm(rest[TIPS][:, None] - rest[CHAINS[:, [0, 0, 1, 1]]], axis=2).ravel(),
        dip_per_pip=model.dip_per_pip or 0.0,
        blend_s=settings.blend_s,
        tracked_m=settings.tracked_m,
    )


@inner
def _write_signals(state: Smoothing, solved: Pose) -> None:
    T, angles = solved.palm, solved.angles
    rotation = state.work.g
    rotation_between(T, state.palm, state.work.K, rotation)
    for i in range(3):
        state.signals[i] = T[i, 3]
        for j in range(3):
            state.signals[i] += T[i, j] * state.knuckle[j]
        state.signals[3 + i] = state.values[3 + i] + state.across[0] * rotation[i]
    for f in range(5):
        for k in range(4):
            follows = state.dip_per_pip[0] * angles[f, 2] if f > 0 and k == 3 else 0.0
            state.signals[6 + 4 * f + k] = (angles[f, k] - follows) * state.lever[4 * f + k]


@inner
def _blend(state: Smoothing, t_ns: int, sources: Int) -> bool:
    """Add what is left of leaps to the signals; return whether anything is."""
    blend_s = state.blend_s[0]
    gap = (t_ns - state.t_ns[0]) * 1e-9 > blend_s
    for p in range(6):
        if sources[p] > 0 and (gap or state.sources[p] == 0):
            state.since_ns[p] = t_ns
            state.until_ns[0] = t_ns + round(blend_s * 1e9)
    if t_ns >= state.until_ns[0]:
        return False
    for i in range(26):
        since_ns = state.since_ns[state.part_of[i]]
        if since_ns == t_ns:
            state.offset[i] = state.values[i] - state.signals[i]
        x = min((t_ns - since_ns) * (1e-9 / blend_s), 1.0)
        state.signals[i] += state.offset[i] * (1.0 - x * x * (3.0 - 2.0 * x))  # smooth at both ends
    return True


@inner
def _write_largest(state: Smoothing, sources: Int, cov: Float) -> None:
    """Write largest variances (26,) [m^2], by own and palm's markers; NaN: none."""
    count, rotation, place = 0, 0.0, state.work.g
    for i in range(3):
        place[i] = 0.0
    for m in range(cov.shape[0]):
        if cov[m, 0, 0] > 0.0:  # NaN is not
            count += 1
            for i in range(3):
                place[i] += cov[m, i, i]
    for i in range(3):
        place[i] /= max(count, 1)
        rotation += place[i] / 3.0
    for i in range(26):
        p = state.part_of[i]
        state.largest[i] = nan
        if count == 0 or sources[p] == 0:
            continue
        if p == PALM_PART:
            state.largest[i] = place[i] if i < 3 else rotation
        elif state.marker_of[p] >= 0:
            m = state.marker_of[p]
            state.largest[i] = (cov[m, 0, 0] + cov[m, 1, 1] + cov[m, 2, 2]) / 3.0 + rotation


@inner
def _filter(state: Smoothing, t_ns: int, sources: Int, marker_cov: Float) -> None:
    _write_largest(state, sources, marker_cov)
    measure(t_ns, state.signals, state.largest, state.count, state.dt_s, state.past, state.noise)
    filter_step(
        t_ns,
        state.signals,
        state.noise,
        state.filter,
        state.part_of,
        state.fastest,
        state.x,
        state.speed,
        state.seen_ns,
        state.filtered,
    )


@inner
def _write_pose(hand: HandTables, state: Smoothing, shown: Pose) -> None:
    T, angles, work = state.work.palm, state.work.angles, state.work
    for i in range(3):
        state.step[i] = (state.filtered[3 + i] - state.values[3 + i]) / state.across[0]
    rotate_by(state.step, state.palm, T)
    for i in range(3):
        T[i, 3] = state.filtered[i]
        for j in range(3):
            T[i, 3] -= T[i, j] * state.knuckle[j]
    for a in range(20):
        angles[a] = state.filtered[6 + a] / state.lever[a]
        if a > 3 and a % 4 == 3:
            angles[a] += state.dip_per_pip[0] * angles[a - 1]
    clamp(hand, angles)
    chains(hand, T, work)
    joints(hand, T, work, shown.position, shown.rotation)
    copy(T, shown.palm)
    for a in range(20):
        shown.angles[a // 4, a % 4] = angles[a]


@inner
def _add_offset(hand: HandTables, state: Smoothing, solved: Pose, shown: Pose, tracked: Bool) -> None:
    """Widen joints' covariances by how far each is shown off; recheck `tracked`."""
    for joint in range(26):
        for i in range(3):
            for j in range(3):
                off2 = shown.position[joint, i] - solved.position[joint, i]
                off2 *= shown.position[joint, j] - solved.position[joint, j]
                shown.cov[joint, i, j] = solved.cov[joint, i, j] + off2
    for joint in range(26):
        tracked[joint] = tracked[joint] and is_small(hand, shown.cov, joint, state.tracked_m[0])


@kernel
def smooth(
    boxed_hand: Any,
    boxed_state: Any,
    what: int,
    t_ns: int,
    sources: Int,
    marker_cov: Float,
    solved: Pose,
    shown: Pose,
    tracked: Bool,
) -> bool:
    """Filter one hand; return whether anything was added to the solved signals.

    `what`: WHOLE; or SIGNALS: write the solved signals alone; or REST: filter them, with what was added to
    them. `marker_cov` (M, 3, 3) [m^2]. `shown` is written, its covariance where anything was added; `tracked`
    (26,) is changed from as solved to as shown.
    """
    hand, state = boxed_hand[0], boxed_state[0]
    begins, added = state.t_ns[0] == NEVER_NS, what == REST
    if what != REST:
        if begins:
            copy(solved.palm, state.palm)
        _write_signals(state, solved)
        if what == SIGNALS:
            return False
        added = not begins and _blend(state, t_ns, sources)
    _filter(state, t_ns, sources, marker_cov)
    _write_pose(hand, state, shown)
    if added:
        _add_offset(hand, state, solved, shown, tracked)
    state.t_ns[0] = t_ns
    for p in range(6):
        state.sources[p] = sources[p]
    for i in range(26):
        state.values[i] = state.filtered[i]
    copy(shown.palm, state.palm)
    return added


class HandOneEuro:
    """Push machine that holds the last output, the filter, and what is left of leaps."""

    def __init__(
        self,
        model: HandModel,
        markers: tuple[str, ...],
        parameters: OneEuroParameters,
        blend_m_s: float | None = None,
        settings: Settings = DEFAULT,
    ) -> None:
        """Set up; markers in the order of the covariances, parameters in [m, s].

        `blend_m_s`: how fast palm and fingers may be led over; None: within a tenth of a second.

        Raises:
            CalibrationError: The profile mounts no marker of one of the names.
        """
        self._settings = settings
        self._on_palm = Mounts.of(model, markers).on_back
        self._blend_m_s = blend_m_s
        self._blend: Blend | None = None
        state = _begun(model, markers, parameters, settings)
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

        A hand not after the last, or not valid, is passed on; after the latter what follows begins anew.
        `cov_m2` (M, 3, 3) noise of the markers; NaN: not measured; what rests on none is filtered by the
        noise it shows. `points_m` (M, 3) the markers, of a hand that other sensors watch, too; NaN: not seen.
        """
        solution, sources = hand.solution, hand.sources
        if solution is None or not hand.valid.any():
            self._t_ns[0] = NEVER_NS
            return hand
        gap_s = (t_ns - int(self._t_ns[0])) * 1e-9
        if gap_s > self._settings.forget_s or (hand.reinitialised and self._blend_m_s is None):
            self._state[:], gap_s = self._fresh, 0.0
            self._blend = (
                None if self._blend_m_s is None else Blend(self._blend_m_s, self._on_palm, self._settings)
            )
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
        smooth_hand = replace(
            solution,
            T_rig_palm=shown.palm,
            angles_rad=shown.angles,
            joints=HandJoints(shown.position, shown.rotation, shown.palm),
            cov_m2=shown.cov if off else solution.cov_m2,
        )
        return replace(hand, solution=smooth_hand, tracked=tracked)
