"""Kernel of the filter of the solved hand, and its memory.

`master.estimator.smooth` has the law.
"""

from math import nan
from typing import Any, NamedTuple

import numpy as np

from common.arrays import Bool, Float, Int
from common.hand.model import CHAINS, MIDDLE_PROXIMAL, TIPS, HandModel
from common.kernels import constant, inner, kernel
from common.messages.records import record
from master.estimator.blend import PARTS
from master.estimator.hand_tables import HandTables
from master.estimator.joint_covariance import is_small
from master.estimator.kinematics import Scratch, chains, clamp, joints, rotate_by, rotation_between
from master.estimator.matrices import copy
from master.estimator.settings import Settings
from master.estimator.state import NEVER_NS, PALM_PART
from master.fabrik.noise import measure
from master.fabrik.one_euro import UNSEEN_NS, OneEuroParameters, filter_step

WHOLE, SIGNALS, REST = constant(0), constant(1), constant(2)


class Pose(NamedTuple):
    """Pose of a hand: palm, angles, joints and covariances.

    They are palm (4, 4), angles (5, 4) [rad], joints (26, 3) [m], (26, 3, 3), and their covariances (26, 3, 3) [m^2].
    """

    palm: Float
    angles: Float
    position: Float
    rotation: Float
    cov: Float

    @classmethod
    def empty(cls) -> "Pose":
        """Scratch for one."""
        joint = np.empty((26, 3)), np.empty((26, 3, 3)), np.empty((26, 3, 3))
        return cls(np.empty((4, 4)), np.empty((5, 4)), *joint)


class Smoothing:
    """What was shown last, the filter of its 26 signals, and what is left of leaps.

    The signals are place (3), turn (3), angles (5, 4), all [m].

    Attributes:
        t_ns: (1,) when; NEVER_NS: there is no hand.
        rests: (6,) what the fingers, and the palm, rested on: `Fitted.sources`.
        values: (26,) [m] the filtered signals.
        palm: (4, 4) as filtered.
        offset: (26,) [m] what was shown less what was solved, when each part was last seen again.
        since_ns: (6,) when that was, and `until_ns` (1,) when nothing is left of any.
        count, dt_s, past: The measured noise (`master.fabrik.noise.measure`).
        x, speed, seen_ns: The filter (`master.fabrik.one_euro.filter_step`), and `filter` (5,) its settings.
        part: (26,) finger of each signal, PALM_PART: the palm.
        marker_of: (5,) marker of each finger; -1: there is none.
        knuckle: (3,) [m] the place in the palm frame.
        across: (1,) [m/rad] by how much a turn counts, and `reach` (20,) the angles.
        dip_per_pip: (1,) how the DIP follows the PIP.
        blend_s: (1,) in which leaps fade, and `tracked_m` (1,) how large the region of a tracked joint may be.
    """

    t_ns: Int
    sources: Int
    values: Float
    palm: Float
    offset: Float
    since_ns: Int
    until_ns: Int
    count: Int
    dt_s: Float
    past: Float
    x: Float
    speed: Float
    seen_ns: Int
    filter: Float
    part: Int
    marker_of: Int
    knuckle: Float
    across: Float
    reach: Float
    dip_per_pip: Float
    blend_s: Float
    tracked_m: Float
    signals: Float  # (26,) [m] as solved, and what is left of leaps
    largest: Float  # (26,) room
    noise: Float  # (26,) room
    filtered: Float  # (26,) room
    fastest: Float  # (6, 2) room
    work: Scratch

    @classmethod
    def of(
        cls, model: HandModel, markers: tuple[str, ...], parameters: OneEuroParameters, settings: Settings
    ) -> "Smoothing":
        """Nothing was shown yet; arguments as of `HandOneEuro`."""
        out = record(
            cls,
            **dict.fromkeys(
                ("values", "offset", "x", "speed", "signals", "largest", "noise", "filtered"), 26
            ),
            **dict.fromkeys(("dt_s", "across", "dip_per_pip", "blend_s", "tracked_m"), 1),
            **dict.fromkeys(("t_ns", "until_ns"), ("i8", 1)),
            **dict.fromkeys(("sources", "since_ns"), ("i8", 6)),
            **dict.fromkeys(("part", "seen_ns"), ("i8", 26)),
            count=("i8", 2),
            marker_of=("i8", 5),
            palm=(4, 4),
            past=(3, 26),
            filter=5,
            knuckle=3,
            reach=20,
            fastest=(6, 2),
            work=Scratch.empty(),
        )
        rest = model.rest_position_m
        out.t_ns[:] = out.until_ns[:] = out.since_ns[:] = NEVER_NS
        out.part[:] = PARTS
        out.seen_ns[:] = UNSEEN_NS
        out.filter[:] = parameters.array()
        fingers = [model.mount(name).finger for name in markers]
        out.marker_of[:] = [fingers.index(f) if f in fingers else -1 for f in range(5)]
        out.knuckle[:] = rest[MIDDLE_PROXIMAL]
        out.across[:] = np.linalg.norm(rest[TIPS[1:]] - out.knuckle, axis=1).mean()
        # The DIP bends with the PIP, so it counts as far.
        out.reach[:] = np.linalg.norm(rest[TIPS][:, None] - rest[CHAINS[:, [0, 0, 1, 1]]], axis=2).ravel()
        out.dip_per_pip[:] = model.dip_per_pip or 0.0
        out.blend_s[:], out.tracked_m[:] = settings.blend_s, settings.tracked_m
        return out


@inner
def _write_signals(state: Smoothing, solved: Pose) -> None:
    """Write the signals of a solved hand."""
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
            state.signals[6 + 4 * f + k] = (angles[f, k] - follows) * state.reach[4 * f + k]


@inner
def _blend(state: Smoothing, t_ns: int, sources: Int) -> bool:
    """Add what is left of leaps to the signals; return whether anything is.

    What is seen again leaps now; without frames, nothing was seen.
    """
    blend_s = state.blend_s[0]
    gap = (t_ns - state.t_ns[0]) * 1e-9 > blend_s
    for p in range(6):
        if sources[p] > 0 and (gap or state.sources[p] == 0):
            state.since_ns[p] = t_ns
            state.until_ns[0] = t_ns + round(blend_s * 1e9)
    if t_ns >= state.until_ns[0]:
        return False
    for i in range(26):
        since_ns = state.since_ns[state.part[i]]
        if since_ns == t_ns:
            state.offset[i] = state.values[i] - state.signals[i]
        x = min((t_ns - since_ns) * (1e-9 / blend_s), 1.0)
        state.signals[i] += state.offset[i] * (1.0 - x * x * (3.0 - 2.0 * x))  # smooth at both ends
    return True


@inner
def _write_largest(state: Smoothing, sources: Int, cov: Float) -> None:
    """Write variances (26,) [m^2] of the markers that each part rests on.

    A finger rests on its own and the palm's; NaN: on none.
    """
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
        p = state.part[i]
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
    """Write the filtered signals."""
    _write_largest(state, sources, marker_cov)
    measure(t_ns, state.signals, state.largest, state.count, state.dt_s, state.past, state.noise)
    filter_step(
        t_ns,
        state.signals,
        state.noise,
        state.filter,
        state.part,
        state.fastest,
        state.x,
        state.speed,
        state.seen_ns,
        state.filtered,
    )


@inner
def _write_pose(hand: HandTables, state: Smoothing, shown: Pose) -> None:
    """Write palm, angles and joints of the filtered signals."""
    T, rotation, angles, work = state.work.palm, state.work.g, state.work.angles, state.work
    for i in range(3):
        rotation[i] = (state.filtered[3 + i] - state.values[3 + i]) / state.across[0]
    rotate_by(rotation, state.palm, T)
    for i in range(3):
        T[i, 3] = state.filtered[i]
        for j in range(3):
            T[i, 3] -= T[i, j] * state.knuckle[j]
    for a in range(20):
        angles[a] = state.filtered[6 + a] / state.reach[a]
        if a > 3 and a % 4 == 3:
            angles[a] += state.dip_per_pip[0] * angles[a - 1]
    clamp(hand, angles)
    chains(hand, T, angles, work.R, work.P)
    joints(hand, T, work.R, work.P, shown.position, shown.rotation)
    copy(T, shown.palm)
    for a in range(20):
        shown.angles[a // 4, a % 4] = angles[a]


@inner
def _add_offset(hand: HandTables, state: Smoothing, solved: Pose, shown: Pose, tracked: Bool) -> None:
    """Write the covariance of the joints, widened by the display offset.

    The offset is how far each joint is shown from where it is solved to be.

    A region that is too large now is that of a joint that is not tracked.
    """
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
    """Filter one hand.

    Args:
        boxed_hand, boxed_state: (1,) `HandTables`, `Smoothing` (`common.kernels.boxed`).
        what: WHOLE; or SIGNALS: write the solved signals alone; or REST: filter them, with what was added to them.
        t_ns, rests: Of the hand.
        marker_cov: (M, 3, 3) [m^2].
        solved, shown: The hand; `shown` is written, its covariance where anything was added.
        tracked: (26,) as solved, changed to as shown.

    Returns:
        Whether anything was added to the solved signals.
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
