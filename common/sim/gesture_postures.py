"""Postures of a hand that pinches, grips a knob or lays its thumb on a key.

Solved on the hand model itself, skin on skin. What a posture must do is a handful of residuals, each over the width
that it may miss by; the angles that meet them best and stay nearest to a natural posture are found by damped
Gauss-Newton steps with differences for derivatives. Some tenths of a second for all of them.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from common.arrays import Float, Int
from common.geometry.tapered_capsules import Capsules
from common.hand.model import CHAINS, TIPS, HandModel
from common.hand.skin import Gaps, finger_segments, gaps_between
from common.sim.motion import POSES, angles_of, posture_of

PAD_DEG = posture_of((18, 8, 14), (2, 68, 34), (0, 68, 34), (-1, 68, 34), (-2, 68, 34))
# Thumb, then MCP and PIP of all fingers, from which a key is reached for.
_REACH_DEG = (
    ((-10, 12, 30), (72, 36)),
    ((0, 25, 25), (72, 40)),
    ((-12, 35, 40), (78, 25)),
    ((-5, 42, 42), (80, 32)),
)
KNOB_DEG = posture_of((26, 22, 18), (8, 38, 44), (2, 42, 46), (-6, 42, 46), (-12, 38, 44))
PRESSED_M = 0.0005
KNOB_M = (0.020, 0.026)  # radius of knobs


@dataclass(frozen=True, slots=True, eq=False)
class Knob:
    """A grip of a knob: posture (5, 3) [deg], centre [m], axis (3,), palm frame.

    The axis goes from the back of the hand through the palm.
    """

    posture_deg: Float
    centre_m: Float
    axis: Float


@dataclass(frozen=True, slots=True, eq=False)
class Key:
    """Thumb on finger 1 ... 4, segment 0 ... 2 from the knuckle, posture (5, 3)."""

    finger: int
    segment: int
    posture_deg: Float


@dataclass(frozen=True, slots=True, eq=False)
class Posed:
    """Candidate postures (N, 5, 3) [deg] as geometry, palm frame.

    Joints (N, 26, 3) [m], their rotations (N, 26, 3, 3), capsules (N, 5, 3) of the segments.
    """

    posture_deg: Float
    joints_m: Float
    rotation: Float
    capsules: Capsules

    @classmethod
    def of(cls, model: HandModel, posture_deg: Float, wobble: Float) -> "Posed":
        """Of postures (N, 5, 3) [deg] with the wobble (5, 4) of `angles_of`."""
        found = model.joints(np.eye(4), model.chains(angles_of(model, posture_deg, wobble)))
        capsules = finger_segments(found.position_m, model.radius_m)
        return cls(posture_deg, found.position_m, found.rotation, capsules)

    def thumb_gaps(self) -> Gaps:
        """From the thumb's last segment to all of the fingers' (N, 4, 3)."""
        return gaps_between(
            self.capsules.of(slice(0, 1), slice(2, 3)), self.capsules.of(slice(1, 5), slice(None))
        )

    def palmar(self, finger: int, segment: int) -> Float:
        """Unit vectors (N, 3) out of a segment's palmar side: -y of its first joint."""
        return -self.rotation[:, CHAINS[finger, segment], :, 1]


def pinch_posture(model: HandModel, finger: int, wobble: Float) -> Float:
    """Posture (5, 3) [deg] in which the pads of thumb and finger 1 ... 4 meet."""
    start = POSES["pinch"].copy()
    start[1:, 1:] = (12.0, 18.0)
    start[finger, 1:] = (46.0, 44.0)

    def misses(posed: Posed) -> Float:
        found = gaps_between(posed.capsules.of(slice(0, 1), 2), posed.capsules.of(slice(1, 5), 2))
        way, gap = found.a_to_b[:, finger - 1], found.gap_m[:, finger - 1]
        thumb, other = (np.vecdot(way, posed.palmar(f, 2)) for f in (0, finger))
        face = np.stack([1.0 - thumb, 1.0 + other], axis=1)
        others_clear_m = 0.016
        clear = np.maximum(others_clear_m - np.delete(found.gap_m, finger - 1, axis=1), 0.0)
        return np.concatenate([(gap[:, None] + PRESSED_M) / 2e-4, face / 0.4, clear / 2e-3], axis=1)

    free = np.array([0, 1, 2, *range(3 * finger, 3 * finger + 3)])
    return _solved(model, start, free, np.array([12.0, 12.0, 15.0, 5.0, 15.0, 15.0]), misses, wobble)


def key_posture(model: HandModel, finger: int, segment: int, wobble: Float) -> Float:
    """Return the posture (5, 3) [deg] in which the thumb's tip lies on a key.

    Segment 0 ... 2, from the knuckle, of finger 1 ... 4. All fingers bend alike, as far as the thumb needs to
    reach the key, and that finger a little on its own.
    """
    mine = slice(3 * (finger - 1), 3 * finger)

    def misses(posed: Posed) -> Float:
        found = posed.thumb_gaps()
        count = len(posed.joints_m)
        gap, way = found.gap_m.reshape(count, 12), found.a_to_b[:, finger - 1, segment]
        own = gap[:, mine][:, segment]
        on_b, on_a = found.on_b[:, finger - 1, segment], found.on_a[:, finger - 1, segment]
        on = np.stack([on_b - 0.5, 0.5 * on_a - 0.5], axis=1)
        side = 0.6 - np.maximum(-np.vecdot(way, posed.palmar(finger, segment)), -1.0)
        clear = np.maximum(0.004 - np.delete(gap, mine, axis=1), 0.0)
        posture = posed.posture_deg
        alike = (posture[:, 1:, 1:] - posture[:, 1:, 1:].mean(axis=1, keepdims=True)).reshape(count, -1)
        skin, side = (own[:, None] + PRESSED_M) / 2e-4, np.maximum(side, 0.0)[:, None] / 0.2
        return np.concatenate([skin, on / 0.12, side, clear / 1e-3, alike / 7.0], axis=1)

    free = np.array([0, 1, 2, *(3 * f + k for f in range(1, 5) for k in (1, 2))])
    width = np.array([25.0, 25.0, 25.0, *[25.0] * 8])
    starts = np.array([_pad(*start) for start in _REACH_DEG])
    nearest = np.square(misses(Posed.of(model, starts, wobble))).sum(axis=1).argmin()
    return _solved(model, starts[nearest], free, width, misses, wobble)


def hover_posture(model: HandModel, key: Key, wobble: Float) -> Float:
    """Posture (5, 3) [deg] of a thumb retracted from a key, straight off the skin."""
    there = Posed.of(model, key.posture_deg[None], wobble)
    hover_m = 0.020
    target = there.joints_m[0, TIPS[0]] + hover_m * there.palmar(key.finger, key.segment)[0]

    def misses(posed: Posed) -> Float:
        return (posed.joints_m[:, TIPS[0]] - target) / 2e-3

    return _solved(model, key.posture_deg, np.arange(3), np.array([40.0, 40.0, 40.0]), misses, wobble)


def pad_before(model: HandModel, hover_deg: Float, wobble: Float) -> Float:
    """Posture (5, 3) [deg] with the thumb aside, from where it touches no finger."""
    aside = [(across, bend, 6.0) for across in (0.0, 15.0, 30.0, 45.0) for bend in (-10.0, 5.0, 20.0)]
    share = np.linspace(0.0, 1.0, 9)[:, None]
    ways = np.tile(hover_deg, (len(aside), len(share), 1, 1))
    for k, thumb in enumerate(aside):
        ways[k, :, 0] = (1.0 - share) * np.array(thumb) + share * hover_deg[0]
    posed = Posed.of(model, ways.reshape(-1, 5, 3), wobble)
    nearest = posed.thumb_gaps().gap_m.reshape(len(aside), -1).min(axis=1)
    return ways[int(nearest.argmax()), 0]


def knob_grip(model: HandModel, radius_m: float, wobble: Float) -> Knob:
    """How five tips lie about a knob of that radius, in one plane across its axis."""
    start = KNOB_DEG
    reach_m = radius_m + model.radius_m[TIPS]

    def misses(posed: Posed) -> Float:
        tips = posed.joints_m[:, TIPS]
        centre, axis = _middle_and_axis(tips)
        off = tips - centre[:, None]
        along = np.vecdot(off, axis[:, None])
        round_m = np.linalg.norm(off - along[..., None] * axis[:, None], axis=-1)
        return np.concatenate([(round_m - reach_m) / 5e-4, along / 1e-3], axis=1)

    posture = _solved(model, start, np.arange(15), np.tile([8.0, 15.0, 15.0], 5), misses, wobble)
    centre, axis = _middle_and_axis(Posed.of(model, posture[None], wobble).joints_m[:, TIPS])
    return Knob(posture, centre[0], axis[0])


def _middle_and_axis(tips_m: Float) -> tuple[Float, Float]:
    """Middle (N, 3) between thumb tip and finger tips (N, 5, 3), normal of the tips."""
    middle = 0.5 * tips_m[:, 0] + 0.5 * tips_m[:, 1:].mean(axis=1)
    across = tips_m[:, 0] - middle
    along = tips_m[:, 1] - tips_m[:, 4]
    axis: Float = np.asarray(np.cross(across, along), dtype=np.float64)
    axis = axis / np.linalg.norm(axis, axis=1, keepdims=True)
    return middle, np.where(axis[:, 1:2] > 0.0, -axis, axis)


def _solved(
    model: HandModel,
    start_deg: Float,
    free: Int,
    width_deg: Float,
    misses: Callable[[Posed], Float],
    wobble: Float,
) -> Float:
    """Posture (5, 3) [deg] of least residual and deviation over width."""

    def residuals(x: Float) -> Float:
        posture = np.tile(start_deg.ravel(), (len(x), 1))
        posture[:, free] += x
        out = misses(Posed.of(model, posture.reshape(-1, 5, 3), wobble))
        return np.concatenate([out, x / width_deg], axis=1)

    x = np.zeros(len(free))
    nudge_deg = 0.25
    steps = np.concatenate([np.zeros((1, len(free))), nudge_deg * np.eye(len(free))])
    here = residuals(x + steps)
    best_x, best, damping = x, float(here[0] @ here[0]), 0.05
    for _ in range(24):
        jacobian = (here[1:] - here[0]) / nudge_deg
        square = jacobian @ jacobian.T
        move: Float = np.asarray(
            np.linalg.solve(square + damping * np.diag(np.diag(square)), jacobian @ here[0]), np.float64
        )
        x = best_x - np.clip(move, -15.0, 15.0)
        found = residuals(x + steps)
        cost = float(found[0] @ found[0])
        if cost < best:
            here, best_x, best, damping = found, x, cost, max(0.3 * damping, 1e-4)
        else:
            damping *= 8.0
    posture = start_deg.ravel().copy()
    posture[free] += best_x
    # `angles_of` holds a joint at its limit: a posture beyond it would be the same, but the way there has a kink.
    low, high = np.degrees(model.limits_rad[:, :3, 0]), np.degrees(model.limits_rad[:, :3, 1])
    return np.clip(posture.reshape(5, 3), low, high)


def _pad(thumb: tuple[float, float, float], bend: tuple[float, float]) -> Float:
    """Posture (5, 3) [deg] of a pad of fingers that are all bent like that."""
    posture = PAD_DEG.copy()
    posture[0], posture[1:, 1:] = thumb, bend
    return posture


def reachable_keys(model: HandModel, wobble: Float) -> tuple[Key, ...]:
    """Keys that the hand's thumb can lie on, and how.

    A key counts where skin meets skin on its palmar side, near its middle, and no other finger is near. The model's
    thumb does not turn about its own length as it goes across the palm, so it reaches fewer keys than a real one.
    """
    out: list[Key] = []
    for finger in range(1, 5):
        for segment in range(3):
            posture = key_posture(model, finger, segment, wobble)
            posed = Posed.of(model, posture[None], wobble)
            found = posed.thumb_gaps()
            gap, on = found.gap_m[0], float(found.on_b[0, finger - 1, segment])
            others = np.delete(gap, finger - 1, axis=0).min()
            touches = abs(float(gap[finger - 1, segment])) < 1e-3 and float(gap[finger - 1].min()) > -1.5e-3
            key_clear_m = 0.0035
            if touches and others > key_clear_m and 0.2 < on < 0.8:
                out.append(Key(finger, segment, posture))
    return tuple(out)
