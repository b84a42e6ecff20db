"""Simulated hand that pinches, turns knobs, taps its keys and points.

In 75 s two rounds of everything, in an order, at a pace, in places and with knobs that are drawn from the seed: each
finger is pinched, a knob is turned to and fro, another is turned farther than a hand turns at once and gripped again,
keys are tapped, the index finger points. Between them the hand waves, opens, makes a fist and travels, and signals
nothing.

In each round every act is shown another way (`_SHOWN_DEG`). Knobs, keys and pinches are seen more or less from the
palm's side, for they hide tips of a hand that is seen from behind; who points has the back of his hand up.

Skin meets skin (`gesture_postures`). A hand that touches or grips stands still but for what it does, else it wanders
as hands do. While a knob is turned the palm goes round its axis.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from common.arrays import Float
from common.geometry.transforms import axis_rotation, rigid, rotation_vector_to_matrix
from common.hand.model import FINGERS, HandModel
from common.messages import GestureKind
from common.sim.gesture_postures import (
    KNOB_M,
    Knob,
    hover_posture,
    knob_grip,
    pad_before,
    pinch_posture,
    reachable_keys,
)
from common.sim.motion import (
    FIST,
    PALM_TO_CAMERAS,
    POSES,
    REST,
    WAVE_CREST,
    DriftingMotion,
    HandState,
    Waves,
    angles_of,
    palm_pose,
    smooth_step,
)

KEY_NAMES = (("3", "2", "1"), ("6", "5", "4"), ("9", "8", "7"), ("hash", "0", "star"))
PERIOD_S = 75.0
# Act -> two ways to show it: fingers towards the cameras, and rolled about them, 0: the palm to the cameras.
_SHOWN_DEG = {
    "pinches": ((15.0, 0.0), (35.0, -30.0)),
    "dial": ((15.0, 0.0), (35.0, 30.0)),
    "dial_again": ((15.0, 0.0), (25.0, -20.0)),
    "taps": ((15.0, 0.0), (30.0, 0.0)),
    "point": ((50.0, 175.0), (25.0, 140.0)),
}
REACH_M = np.array([0.04, 0.025, 0.04])
WRIST_DEG = np.array([5.0, 3.0])
_FREE = (REST, POSES["open_palm"], FIST, WAVE_CREST, POSES["counting_two"], REST)
_LOOSEN_DEG = np.array([[14.0, -14.0, -14.0], *[[0.0, -17.0, -16.0]] * 4])


@dataclass(frozen=True, slots=True)
class Annotation:
    """One gesture of the hand: kind and name of its message, begin and end [s]."""

    kind: GestureKind
    name: str
    start_s: float
    stop_s: float


class Track:
    """Values that change smoothly (C2) from one to the next, and rest between."""

    def __init__(self, first: Float) -> None:
        self._start, self._stop, self._value = [-1.0], [0.0], [np.asarray(first, dtype=np.float64)]

    @property
    def last(self) -> Float:
        """Where it ends so far."""
        return self._value[-1]

    def to(self, value: Float, start_s: float, stop_s: float) -> None:
        """Go to a value from a time to a time [s], not before the last move is over."""
        if start_s < self._stop[-1] - 1e-9 or stop_s <= start_s:
            raise ValueError(f"a move from {start_s} to {stop_s} s after one until {self._stop[-1]} s")
        self._start.append(start_s)
        self._stop.append(stop_s)
        self._value.append(np.asarray(value, dtype=np.float64))

    def at(self, t_s: float) -> Float:
        """The value at a time [s]."""
        k = int(np.searchsorted(self._start, t_s, side="right")) - 1
        if k <= 0:
            return self._value[0]
        share = smooth_step((t_s - self._start[k]) / (self._stop[k] - self._start[k]))
        return self._value[k - 1] + share * (self._value[k] - self._value[k - 1])


class Gestures(DriftingMotion):
    """One round of gestures: its script and, in order, its annotations."""

    period_s = PERIOD_S

    def __init__(self, model: HandModel, centre_m: Float, seed: int) -> None:
        """Write the script, whose postures are solved (some tenths of a second)."""
        rng = np.random.default_rng([seed, 37])
        super().__init__(model, centre_m, rng, PERIOD_S)
        self._rng, self._sway = rng, Waves(rng, 2, PERIOD_S)
        self._own = np.zeros((5, 4))  # how DIPs differ from their coupling while the hand is held
        self._own[:, 3] = rng.uniform(-0.5, 0.5, 5)
        self._posture, self._steady, self._place = Track(REST), Track(np.zeros(1)), Track(np.zeros(6))
        self._rotation_vector, self._knob_angle = Track(np.zeros(1)), Track(np.zeros(1))
        # of its own, so that what the fingers do stays as it is
        self._ways = np.random.default_rng([seed, 41])
        self._shown = Track(np.array(_SHOWN_DEG["dial"][0]))
        self._knobs: list[tuple[float, Knob]] = []
        self._keys = reachable_keys(model, self._own)
        self.annotations: tuple[Annotation, ...] = ()
        self._now = 0.6
        second = self._ways.integers(0, 2, len(_SHOWN_DEG))
        for k in range(2):
            self._round(
                {act: ways[(k + s) % 2] for (act, ways), s in zip(_SHOWN_DEG.items(), second, strict=True)}
            )
        self._finish()

    def dial_rad(self, t_s: float) -> float:
        """Turn of all knobs until a time [s], clockwise from the back of the hand."""
        return float(self._knob_angle.at(max(t_s, 0.0) % PERIOD_S)[0])

    def _moved(self, t: float, wobble: Float, shift: Float, rotation: Float) -> HandState:
        steady, place = float(self._steady.at(t)[0]), self._place.at(t)
        angles = angles_of(self._model, self._posture.at(t), wobble + steady * (self._own - wobble))
        loose, (towards, rolled) = 1.0 - steady, np.radians(self._shown.at(t)).tolist()
        shown = axis_rotation(0, towards) @ PALM_TO_CAMERAS @ axis_rotation(2, rolled)
        turned = rotation_vector_to_matrix(place[3:] + loose * rotation) @ shown
        pose = palm_pose(self._model, self._centre + (place[:3] + loose * shift), turned)
        knob = next((knob for start, knob in reversed(self._knobs) if t >= start), None)
        if knob is not None:
            about = rotation_vector_to_matrix(knob.axis * float(self._rotation_vector.at(t)[0]))
            pose = pose @ rigid(about, knob.centre_m - about @ knob.centre_m)
        return HandState(pose, angles, np.radians(WRIST_DEG) * self._sway.at(t))

    def _round(self, ways: dict[str, tuple[float, float]]) -> None:
        acts: dict[str, Callable[[], None]] = {
            "pinches": self._pinches,
            "dial": self._dial,
            "dial_again": self._dial_again,
            "taps": self._taps,
            "point": self._point,
        }
        start = self._now - 0.6
        for k in self._order(0, len(acts)):
            act = tuple(acts)[k]
            shown = np.array(ways[act]) + self._ways.uniform(-6.0, 6.0, 2)
            self._shown.to(shown, start, self._now)  # while the hand moves freely
            acts[act]()
            start = self._now
            self._free()

    def _finish(self) -> None:
        """Back to how it began."""
        if self._now > PERIOD_S - 0.7:
            raise ValueError(f"the script lasts {self._now} s")
        for track in (self._posture, self._place, self._shown):
            track.to(track.at(0.0), self._now, self._now + 0.6)

    def _go(self, posture: Float, seconds: float, rest_s: float, steady: float) -> None:
        """To a posture in so many seconds, and stay."""
        stop = self._now + seconds
        self._posture.to(posture, self._now, stop)
        if float(self._steady.last[0]) != steady:
            self._steady.to(np.array([steady]), self._now, stop)
        self._now = stop + rest_s

    def _annotate(self, kind: GestureKind, name: str, start_s: float) -> None:
        self.annotations = (*self.annotations, Annotation(kind, name, start_s, self._now))

    def _order(self, first: int, end: int) -> list[int]:
        """The numbers from one to before the other, shuffled."""
        return [int(k) for k in self._rng.permutation(np.arange(first, end))]

    def _some(self, low: float, high: float) -> float:
        return float(self._rng.uniform(low, high))

    def _pinches(self) -> None:
        relaxed = REST + np.array([[12.0, 4.0, 4.0], *[[0.0, 4.0, 6.0]] * 4])
        for finger in self._order(1, 5):
            start = self._now
            posture = pinch_posture(self._model, finger, self._own)
            self._go(posture, self._some(0.28, 0.5), self._some(0.25, 0.6), 1.0)
            self._go(relaxed, self._some(0.28, 0.45), self._some(0.1, 0.2), 0.0)
            self._annotate("pinch", FINGERS[finger], start)

    def _dial(self) -> None:
        knob, start = self._grip(), self._now
        self._go(knob.posture_deg, self._some(0.4, 0.6), 0.35, 1.0)
        self._rotate_knob(np.radians(self._some(35.0, 55.0)) * self._rng.choice((-1.0, 1.0)), 0.2)
        self._rotate_knob(-0.6 * float(self._rotation_vector.last[0]), 0.3)
        self._leave(knob, start)

    def _dial_again(self) -> None:
        knob, start = self._grip(), self._now
        self._go(knob.posture_deg, self._some(0.4, 0.6), 0.35, 1.0)
        way = float(self._rng.choice((-1.0, 1.0)))
        self._rotate_knob(way * np.radians(self._some(35.0, 50.0)), 0.1)
        self._go(knob.posture_deg + _LOOSEN_DEG, 0.25, 0.0, 1.0)
        self._rotate_palm(-way * np.radians(self._some(20.0, 30.0)), 0.3)
        self._go(knob.posture_deg, 0.22, 0.12, 1.0)
        self._rotate_knob(
            way * np.radians(self._some(55.0, 70.0)) - float(self._rotation_vector.last[0]), 0.3
        )
        self._leave(knob, start)

    def _grip(self) -> Knob:
        knob = knob_grip(self._model, self._some(*KNOB_M), self._own)
        self._knobs.append((self._now, knob))
        return knob

    def _leave(self, knob: Knob, start_s: float) -> None:
        self._go(knob.posture_deg + 1.6 * _LOOSEN_DEG, 0.35, 0.0, 1.0)
        self._rotate_palm(0.0, 0.6)
        self._go(REST, 0.4, 0.3, 0.0)
        self._annotate("dial", "dial", start_s)

    def _rotate_palm(self, to_rad: float, seconds: float) -> None:
        self._rotation_vector.to(np.array([to_rad]), self._now, self._now + seconds)
        self._now += seconds

    def _rotate_knob(self, by_rad: float, rest_s: float) -> None:
        """Turn palm and knob together, at a pace of up to two radians a second."""
        seconds = max(abs(by_rad) / self._some(0.8, 1.4), 0.3)
        self._knob_angle.to(self._knob_angle.last + by_rad, self._now, self._now + seconds)
        self._rotate_palm(float(self._rotation_vector.last[0]) + by_rad, seconds)
        self._now += rest_s

    def _taps(self) -> None:
        """Tap some keys; the thumb comes and goes over the nearest, touching none."""
        door = hover_posture(self._model, self._keys[0], self._own)
        aside = pad_before(self._model, door, self._own)
        self._go(aside, 0.5, 0.2, 1.0)
        self._go(door, 0.25, 0.05, 1.0)
        for k in self._order(0, len(self._keys))[:4]:
            key = self._keys[k]
            hover = hover_posture(self._model, key, self._own)
            self._go(hover, 0.25, 0.08, 1.0)
            start = self._now
            self._go(key.posture_deg, self._some(0.12, 0.18), self._some(0.04, 0.1), 1.0)
            self._go(hover, self._some(0.12, 0.18), self._some(0.1, 0.2), 1.0)
            self._annotate("tap", KEY_NAMES[key.finger - 1][key.segment], start)
        self._go(door, 0.25, 0.05, 1.0)
        self._go(aside, 0.25, 0.05, 1.0)
        self._go(REST, 0.5, 0.1, 0.0)

    def _point(self) -> None:
        start = self._now
        rotation_deg = [self._some(-10.0, 25.0), self._some(-15.0, 15.0), 0.0]
        self._place.to(np.append(np.zeros(3), np.radians(rotation_deg)), self._now, self._now + 0.6)
        self._go(POSES["pointing"], self._some(0.4, 0.6), self._some(1.0, 1.4), 0.0)
        self._go(REST, self._some(0.4, 0.6), 0.2, 0.0)
        self._annotate("point", "point", start)

    def _free(self) -> None:
        """Fingers from posture to posture, the palm from place to place."""
        for _ in range(2):
            seconds = self._some(0.45, 0.7)
            rotation_deg = 14.0
            shift = self._rng.uniform(-1.0, 1.0, 3) * REACH_M
            rotation = np.radians(rotation_deg) * self._rng.uniform(-1.0, 1.0, 3)
            self._place.to(np.append(shift, rotation), self._now, self._now + seconds)
            self._go(_FREE[int(self._rng.integers(len(_FREE)))], seconds, 0.05, 0.0)
        self._place.to(self._place.last * 0.3, self._now, self._now + 0.4)
        self._go(REST, 0.4, 0.05, 0.0)
