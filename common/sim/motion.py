"""Seeded motions move a simulated hand, its fingers and what it holds.

Pure functions of time. A motion is a sum: a resting posture with slow natural drift is always there; on top of it
acts come and go, each faded in and out by a smooth window (C2), so that the whole is smooth for every t, and closed
over its period. Finger targets are whole postures in degrees; DIP angles follow the hand's coupling only nearly, as
real ones do, so that a solver's prior is never exactly true.

`StudyPoses` (occlusion is measured on it): open palm, counting two, pointing, small grasp, large grasp and pinch (Kim
et al., "Digits", UIST 2012, poses A-F) in a new order each round, each held in a place and with a turn of the palm of
its own.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Protocol

import cv2
import numpy as np

from common.arrays import Float
from common.geometry.transforms import axis_rotation, rigid
from common.hand.model import HandModel
from common.hand.routine import smooth_step
from common.hand.wrist import STRAIGHT


@dataclass(frozen=True, slots=True, eq=False)
class Cylinder:
    """Matt dark cylinder about its own z, origin in the middle; `held`: by the hand."""

    T_rig_object: Float
    radius_m: float
    length_m: float
    held: bool


PERIOD_S = 60.0
PEAK_SPEED_M_S = 1.0


def posture_of(*rows: tuple[float, float, float]) -> Float:
    """Posture (5, 3) [deg]: thumb ... little; abduction, MCP (thumb CMC), PIP.

    The third of the thumb is its MCP, which its IP follows.
    """
    posture = np.array(rows, dtype=np.float64)
    posture.flags.writeable = False
    return posture


REST = posture_of((8, 2, 6), (3, 10, 16), (0, 10, 17), (-4, 11, 18), (-9, 12, 19))
POSES = {
    "open_palm": posture_of((22, -6, 0), (9, 4, 5), (0, 4, 5), (-7, 4, 5), (-13, 4, 5)),
    "counting_two": posture_of((2, 34, 38), (9, 5, 6), (0, 5, 6), (-3, 70, 92), (-5, 72, 90)),
    "pointing": posture_of((4, 32, 34), (2, 5, 7), (0, 68, 92), (-2, 70, 94), (-4, 72, 92)),
    "small_grasp": posture_of((6, 30, 30), (2, 58, 82), (0, 60, 86), (-3, 62, 86), (-5, 62, 82)),
    "large_grasp": posture_of((30, 16, 14), (8, 28, 40), (0, 28, 44), (-6, 30, 44), (-11, 32, 42)),
    "pinch": posture_of((14, 28, 20), (2, 44, 46), (0, 20, 26), (-5, 16, 22), (-10, 14, 20)),
}
FIST = posture_of((4, 32, 34), (1, 66, 88), (0, 68, 92), (-2, 68, 92), (-4, 68, 88))
WAVE_CREST = posture_of((12, 8, 12), (5, 34, 30), (0, 34, 30), (-5, 34, 30), (-10, 34, 30))
_WOBBLE_DEG = np.array([1.0, 3.0, 3.0])
_TILT_DEG = 12.0  # of the fingers towards the cameras
_SEEN_FROM_BEHIND = axis_rotation(0, np.radians(_TILT_DEG)) @ np.array(
    [[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]]
)
PALM_TO_CAMERAS = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # fingers up in the image


@dataclass(frozen=True, slots=True, eq=False)
class HandState:
    """State of the hand at one time.

    Attributes:
        T_rig_palm: Palm pose (4, 4) [m].
        angles_rad: (5, 4) [rad].
        wrist_angles_rad: (2,) how the wrist is bent between forearm and palm (`common.hand.wrist`).
        things: What stands about, or is held.
        objects: Poses (4, 4) [m], rig frame, of the tracked objects that move by themselves, in the rig's
            order.
    """

    T_rig_palm: Float
    angles_rad: Float
    wrist_angles_rad: Float = field(default_factory=lambda: STRAIGHT)
    things: tuple[Cylinder, ...] = ()
    objects: tuple[Float, ...] = ()


class HandMotion(Protocol):
    """A motion: pure, smooth, the same in every process."""

    @property
    def period_s(self) -> float:
        """Time [s] after which the motion repeats."""
        ...

    def at(self, t_s: float) -> HandState:
        """Return the hand at time `t_s` [s]: before 0 the pose of 0, periodic."""
        ...


def window(t_s: float, start_s: float, stop_s: float, fade_s: float) -> float:
    """1 inside an act, 0 outside, smooth over `fade_s` [s] at both ends."""
    return smooth_step((t_s - start_s) / fade_s) * smooth_step((stop_s - t_s) / fade_s)


def closing(share: Float) -> Float:
    """Posture (5, 3) [deg] with each finger closed by a share (5,) from rest to fist."""
    return REST + share[:, None] * (FIST - REST)


def angles_of(model: HandModel, posture_deg: Float, wobble: Float) -> Float:
    """Angles (..., 5, 4) [rad], in the limits, of postures (..., 5, 3) [deg].

    The wobble (5, 4), about -1..1, moves MCP and PIP by up to 3 degrees and abduction by 1, and spoils the
    DIP coupling by up to 12 %.
    """
    angles = np.empty((*posture_deg.shape[:-1], 4))
    angles[..., :3] = posture_deg + _WOBBLE_DEG * wobble[:, :3]
    ratio = np.full(5, 2.0 / 3.0 if model.dip_per_pip is None else model.dip_per_pip)
    ratio[0] = 0.9
    angles[..., 3] = ratio * angles[..., 2] * (1.0 + 0.12 * wobble[:, 3])
    return model.clamp(np.radians(angles))


def palm_pose(model: HandModel, middle_m: Float, rotation: Float) -> Float:
    """`T_rig_palm` (4, 4) by a rotation and the place (3,) [m] of the flat hand."""
    middle = 0.5 * float(model.rest_position_m[:, 2].max())
    return rigid(rotation, middle_m - middle * rotation[:, 2])


def base_pose(model: HandModel, centre_m: Float, shift_m: Float, rotation_rad: Float) -> Float:
    """`T_rig_palm` (4, 4) of the hand seen from behind, fingers up in the image.

    The flat hand's middle is at `centre_m` + `shift_m`; `rotation_rad` (3,) turns the palm about the rig's
    axes through that middle. Fingers point a little towards the cameras.
    """
    rotation = np.asarray(cv2.Rodrigues(rotation_rad)[0], np.float64) @ _SEEN_FROM_BEHIND
    return palm_pose(model, centre_m + shift_m, rotation)


class Waves:
    """Random Fourier sums within -1..1, slow and closed over the period."""

    def __init__(self, rng: np.random.Generator, count: int, period_s: float = PERIOD_S) -> None:
        slow, fast = (max(round(rate * period_s / PERIOD_S), 1) for rate in (5, 30))
        self._period_s = period_s
        self._cycles = rng.integers(slow, fast, (count, 4)).astype(np.float64)
        self._phase = rng.uniform(0.0, 2.0 * np.pi, (count, 4))
        self._weight = rng.uniform(0.5, 1.0, (count, 4))
        self._weight /= self._weight.sum(axis=1, keepdims=True)

    def at(self, t_s: float) -> Float:
        """The values (count,) at a time [s]."""
        waves = np.sin(2.0 * np.pi * self._cycles * t_s / self._period_s + self._phase)
        return (self._weight * waves).sum(axis=1)


class DriftingMotion:
    """Base of motions of a hand in the air, which wanders slowly all the time.

    A motion is written about a place (3,) [m], rig frame, where the flat hand's middle is; the same seed, the
    same motion.
    """

    period_s = PERIOD_S

    def __init__(
        self, model: HandModel, centre_m: Float, rng: np.random.Generator, drift_s: float = PERIOD_S
    ) -> None:
        self._model, self._centre = model, np.asarray(centre_m, dtype=np.float64)
        self._drift = Waves(rng, 20 + 6, drift_s)

    def at(self, t_s: float) -> HandState:
        """The hand at time `t_s` [s]; before 0 the pose of 0."""
        t = max(t_s, 0.0) % self.period_s
        return self._moved(t, *self._drift_at(t))

    def _moved(self, t: float, wobble: Float, shift: Float, rotation: Float) -> HandState:
        """The hand at a time within the period [s], with its drift."""
        raise NotImplementedError

    def _drift_at(self, t: float) -> tuple[Float, Float, Float]:
        """Wobble (5, 4) in -1..1, shift (3,) [m], rotation (3,) [rad]."""
        value = self._drift.at(t)
        drift_m, drift_deg = 0.006, 2.0
        return value[:20].reshape(5, 4), drift_m * value[20:23], np.radians(drift_deg) * value[23:]

    def _state(self, posture: Float, wobble: Float, shift: Float, rotation: Float) -> HandState:
        """The hand seen from behind in a posture (5, 3) [deg], shifted, rotated (3,)."""
        pose = base_pose(self._model, self._centre, shift, rotation)
        return HandState(pose, angles_of(self._model, posture, wobble))


@dataclass(frozen=True, slots=True, eq=False)
class Change:
    """What an act adds: posture (5, 3) [deg], shift (3,) [m], rotation (3,) [rad]."""

    posture: Float = field(default_factory=lambda: np.zeros((5, 3)))
    shift: Float = field(default_factory=lambda: np.zeros(3))
    rotation: Float = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True, slots=True, eq=False)
class Act:
    """One act; `change` takes the seconds since its start, faded at both ends."""

    name: str
    start_s: float
    stop_s: float
    fade_s: float
    change: Callable[[float], Change]


class ScriptedMotion(DriftingMotion):
    """The motion of the standard scene: all acts in each half of its period."""

    def __init__(self, model: HandModel, centre_m: Float, seed: int) -> None:
        rng = np.random.default_rng(seed)
        super().__init__(model, centre_m, rng)
        self.acts = _half(rng, 0.0, 0) + _half(rng, PERIOD_S / 2, 1)

    def _moved(self, t: float, wobble: Float, shift: Float, rotation: Float) -> HandState:
        posture = REST.copy()
        for act in self.acts:
            if act.start_s < t < act.stop_s:
                weight = window(t, act.start_s, act.stop_s, act.fade_s)
                change = act.change(t - act.start_s)
                posture += weight * change.posture
                shift = shift + weight * change.shift
                rotation = rotation + weight * change.rotation
        return self._state(posture, wobble, shift, rotation)


def _hold(posture: Float, _s: float) -> Change:
    return Change(posture - REST)


def _open_close(rate_hz: float, depth: float, s: float) -> Change:
    return Change(depth * (FIST - REST) * 0.5 * (1.0 - np.cos(2.0 * np.pi * rate_hz * s)))


def _one_by_one(order: tuple[int, ...], each_s: float, depth: float, s: float) -> Change:
    bend = np.zeros(5)
    for place, finger in enumerate(order):
        start = place * each_s
        bend[finger] = window(s, start, start + 1.25 * each_s, 0.6 * each_s)
    return Change(bend[:, None] * (depth * (FIST - REST)))


def _wave(rate_hz: float, roll_rad: float, s: float) -> Change:
    phase = 2.0 * np.pi * (rate_hz * s - 0.13 * np.arange(5))
    posture = (WAVE_CREST - REST) * (0.5 - 0.5 * np.cos(phase))[:, None]
    return Change(posture, rotation=np.array([0.0, 0.0, roll_rad * np.sin(2.0 * np.pi * 0.5 * s)]))


def _travel(direction: Float, rate_hz: float, s: float) -> Change:
    # Sideways sine: its peak speed is amplitude times angular rate. The fade adds none where it is over.
    along = direction / np.linalg.norm(direction)
    amplitude = 0.98 * PEAK_SPEED_M_S / (2.0 * np.pi * rate_hz)
    return Change(shift=amplitude * np.sin(2.0 * np.pi * rate_hz * s) * along)


def _rotate_about(axes: tuple[int, ...], each_s: float, s: float) -> Change:
    palm_swing_deg = 20.0
    rotation = np.zeros(3)
    for place, axis in enumerate(axes):
        start = place * each_s
        if start <= s <= start + each_s:
            inside = window(s, start, start + each_s, 0.2 * each_s)
            rotation[axis] = np.radians(palm_swing_deg) * inside * np.sin(2.0 * np.pi * (s - start) / each_s)
    return Change(rotation=rotation)


def _half(rng: np.random.Generator, start_s: float, half: int) -> tuple[Act, ...]:
    """All acts once, in 30 s from `start_s`; tempo, order and direction by half."""
    rate, order = (0.5, 0.625)[half], ((1, 2, 3, 4, 0), (4, 3, 2, 1, 0))[half]
    direction = (np.array([1.0, 0.1, 0.0]), np.array([0.8, 0.25, 0.55]))[half]
    one_by_one = partial(_one_by_one, order, 0.72, float(rng.uniform(0.75, 0.9)))
    # name, seconds, fade and pause after it [s], what it does
    script: list[tuple[str, float, float, float, Callable[[float], Change]]] = [
        ("open_close", 2.0 / rate, 0.3, 0.1, partial(_open_close, rate, 0.92 - 0.12 * half)),
        ("one_by_one", 4.0, 0.3, 0.1, one_by_one),
        *((f"pose_{name}", 1.35, 0.42, 0.0, partial(_hold, posture)) for name, posture in POSES.items()),
        ("wave", 3.0, 0.5, 0.1, partial(_wave, (0.7, 0.9)[half], np.radians(12.0))),
        ("travel", 3.0, 0.5, 0.1, partial(_travel, direction, (1.35, 1.8)[half])),
        ("turns", 4.5, 0.2, 0.1, partial(_rotate_about, ((2, 0, 1), (1, 0, 2))[half], 1.5)),
    ]
    acts: list[Act] = []
    t = start_s + 0.6
    for name, seconds, fade_s, pause_s, change in script:
        acts.append(Act(name, t, t + seconds, fade_s, change))
        t += seconds + pause_s
    return tuple(acts)


ROUNDS = 4
STATION_S = PERIOD_S / (ROUNDS * len(POSES))
MOVE_S = 1.0  # of each station: the way to it
ROTATION_DEG = 35.0  # as far as a wrist turns without the elbow, about any axis
REACH_M = np.array([0.05, 0.03, 0.05])  # half of the box that the palm's middle moves in, rig axes


def station_at(t_s: float, each_s: float, count: int) -> tuple[int, float]:
    """The station at a time within the period, and for how long [s] it has been."""
    place = min(int(t_s / each_s), count - 1)
    return place, t_s - place * each_s


def between(stations: Float, place: int, share: float) -> Float:
    """Value between a station and the one before it, which of the first is the last."""
    before = stations[place - 1]
    return before + share * (stations[place] - before)


class StudyPoses(DriftingMotion):
    """Six poses, four times in 60 s; `order` (ROUNDS * 6,) are their names."""

    def __init__(self, model: HandModel, centre_m: Float, seed: int) -> None:
        rng = np.random.default_rng([seed, 3])
        super().__init__(model, centre_m, rng)
        names = tuple(POSES)
        drawn: list[int] = [int(k) for _ in range(ROUNDS) for k in rng.permutation(len(names))]
        self.order = tuple(names[k] for k in drawn)
        count = len(self.order)
        self._posture = np.array([POSES[name] for name in self.order])
        self._shift = rng.uniform(-1.0, 1.0, (count, 3)) * REACH_M
        axis = rng.normal(size=(count, 3))
        # Evenly over the ball: most turns are large ones.
        size = np.radians(ROTATION_DEG) * np.cbrt(rng.uniform(size=(count, 1)))
        self._rotations = size * axis / np.linalg.norm(axis, axis=1, keepdims=True)

    def _moved(self, t: float, wobble: Float, shift: Float, rotation: Float) -> HandState:
        place, since_s = station_at(t, STATION_S, len(self.order))
        share = smooth_step(since_s / MOVE_S)
        posture, own_shift, own_rotation = (
            between(stations, place, share) for stations in (self._posture, self._shift, self._rotations)
        )
        return self._state(posture, wobble, own_shift + shift, own_rotation + rotation)

    def held(self, t_s: float) -> str | None:
        """Name of the pose that is held at `t_s` [s]; None while the hand is on its way."""
        place, since_s = station_at(max(t_s, 0.0) % PERIOD_S, STATION_S, len(self.order))
        return self.order[place] if since_s >= MOVE_S else None
