"""Finger motions before the wrist camera: curls, study poses, spreads, and all.

A motion of stations goes from posture to posture (C2), holds each for a while and drifts all the time, as a hand in
the air does. The wrist stays straight in all of them: the palm pose of a state is that of the forearm in the room,
and the palm never moves in the camera's frame, since the device is strapped to the forearm. Of motions in which the
wrist bends, `OnForearm` is what the device feels.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from common.arrays import Float
from common.geometry.transforms import rigid
from common.hand.model import HandModel
from common.hand.wrist import STRAIGHT, forearm_palm
from common.sim.grasp import MCP_PER_PIP
from common.sim.motion import (
    FIST,
    PERIOD_S,
    POSES,
    REST,
    DriftingMotion,
    HandMotion,
    HandState,
    angles_of,
    base_pose,
    between,
    posture_of,
    smooth_step,
    station_at,
)

CURL_S = 10.0  # there and back
CURL_PIP_DEG = 110.0
DIP_PER_PIP = 0.84  # Kamper's ratio, in Kim et al. 2012
SUBJECT_S = 16.0
KNUCKLES_S, FIST_S = (0.8, 7.2), (8.8, 15.2)  # of the two bends within it, there and back
WOBBLE = np.radians(1.0)
_THUMB_OPEN, _THUMB_CLOSED = np.radians([[-6.0, -4.0, 0.0, 0.0], [-2.0, 18.0, 18.0, 26.0]])
RANDOM_POSES = 60
# abduction, MCP, PIP; DIP / PIP
RANDOM_DEG, RANDOM_DIP = ((-10.0, 10.0), (0.0, 80.0), (0.0, 100.0)), (0.5, 0.9)
FOREARM_ROTATION = np.radians(12.0)
_NONE = np.zeros(3)
_HALF_BENT = posture_of((8, 2, 6), *[(0, 22, 36)] * 4)
_WIDE = posture_of((24, -4, 0), (14, 8, 10), (0, 8, 10), (-12, 8, 10), (-15, 8, 10))
_CLOSED = posture_of((-6, 4, 6), (-6, 10, 14), (0, 10, 14), (4, 10, 14), (7, 10, 14))
_ACROSS = posture_of((4, 40, 40), (3, 10, 16), (0, 10, 17), (-4, 11, 18), (-9, 12, 19))
_HOOK = posture_of((8, 2, 6), (3, 12, 80), (0, 12, 82), (-4, 12, 80), (-9, 12, 76))


def _alone(finger: int, share: float) -> Float:
    """One finger closed by a share, the others at rest."""
    posture = REST.copy()
    posture[finger] += share * (FIST[finger] - posture[finger])
    return posture


def _swung(degrees: float) -> Float:
    """Half-bent fingers abducted sideways together, to the thumb if positive."""
    posture = _HALF_BENT.copy()
    posture[1:, 0] += degrees
    return posture


_STANDARD = (
    *(REST, FIST, REST, *(_alone(f, 0.9) for f in (1, 2, 3, 4, 0))),
    *(_WIDE, _CLOSED, _WIDE, REST, _ACROSS, REST),
    *(*POSES.values(), REST, _HOOK, REST, *(_alone(f, 0.5) for f in (4, 3, 2, 1)), _swung(9.0), _swung(-9.0)),
    *(POSES["pinch"], REST, POSES["pinch"], POSES["large_grasp"], POSES["small_grasp"], REST, FIST),
)
_SPREAD = (_HALF_BENT, _WIDE, _CLOSED, *(_swung(d) for d in (10.0, -10.0, 5.0, -5.0)), _CLOSED)


class Stations(DriftingMotion):
    """Sequence of postures, every one hit nearly, as people do.

    After `period_s` [s] the first comes again; the motion is closed there where that is 60 s.
    """

    def __init__(
        self, model: HandModel, postures: Sequence[Float], seed: int, period_s: float = PERIOD_S
    ) -> None:
        rng = np.random.default_rng([seed, 11])
        super().__init__(model, _NONE, rng)
        self._postures = np.array(postures, dtype=np.float64)
        self._postures += rng.normal(0.0, (1.0, 2.5, 4.0), self._postures.shape)
        self.period_s, self._each_s = period_s, period_s / len(postures)
        move_s = 0.8  # at most: the way from one posture to the next
        self._move_s = min(move_s, 0.7 * self._each_s)

    def _moved(self, t: float, wobble: Float, shift: Float, rotation: Float) -> HandState:
        place, since_s = station_at(t, self._each_s, len(self._postures))
        posture = between(self._postures, place, smooth_step(since_s / self._move_s))
        pose = _forearm(self._model, t, shift, rotation)
        return HandState(pose, angles_of(self._model, posture, wobble))


class GuidedCurl:
    """All fingers curl slowly from straight to PIP 110 degrees and back.

    MCP and DIP follow the PIP by the ratios of Kim et al. 2012; the limits do not clip what they give.
    """

    period_s = CURL_S

    def __init__(self, model: HandModel) -> None:
        self._model = model

    def at(self, t_s: float) -> HandState:
        """The hand at time `t_s` [s]; before 0 the pose of 0."""
        t = max(t_s, 0.0) % CURL_S
        share = 0.5 - 0.5 * np.cos(2.0 * np.pi * t / CURL_S)
        pip = share * np.radians(CURL_PIP_DEG)
        angles = np.zeros((5, 4))
        angles[0] = _THUMB_OPEN + share * (_THUMB_CLOSED - _THUMB_OPEN)
        angles[1:, 1:] = MCP_PER_PIP * pip, pip, DIP_PER_PIP * pip
        return HandState(_forearm(self._model, t), angles)


class GuidedSubject:
    """Flat hand, straight fingers flexed at the knuckles, fist, and back.

    It is what `calibrate wrist subject` asks for. Nobody does it exactly: each seed is a person whose flat
    hand is not quite flat, whose straight fingers follow a little, and whose fist has ratios of its own.
    """

    period_s = SUBJECT_S

    def __init__(self, model: HandModel, seed: int) -> None:
        rng = np.random.default_rng([seed, 13])
        self._model = model
        self._flat = np.radians(rng.normal(0.0, (2.0, 2.0, 2.0, 2.0), (4, 4)))
        knuckle, follows = np.radians(rng.uniform(72.0, 88.0, (4, 1))), rng.uniform(0.0, 0.06, (4, 2))
        self._bent = knuckle * np.concatenate([np.zeros((4, 1)), np.ones((4, 1)), follows], axis=1)
        ratios = np.array([0.0, MCP_PER_PIP, 1.0, DIP_PER_PIP])
        own = 1.0 + rng.normal(0.0, (0.0, 0.10, 0.03, 0.06), (4, 4))
        self._fist = np.radians(CURL_PIP_DEG - 5.0) * ratios * own
        self._cycles, self._phase = rng.integers(2, 5, (4, 4)), rng.uniform(0.0, 2.0 * np.pi, (4, 4))

    def at(self, t_s: float) -> HandState:
        """The hand at time `t_s` [s]; before 0 the pose of 0."""
        t = max(t_s, 0.0) % SUBJECT_S
        bend, fist = (
            0.5 - 0.5 * np.cos(2.0 * np.pi * np.clip((t - first) / (last - first), 0.0, 1.0))
            for first, last in (KNUCKLES_S, FIST_S)
        )
        wobble = WOBBLE * np.sin(2.0 * np.pi * self._cycles * t / SUBJECT_S + self._phase)
        angles = np.empty((5, 4))
        angles[0] = _THUMB_OPEN + fist * (_THUMB_CLOSED - _THUMB_OPEN)
        angles[1:] = self._flat + wobble + bend * self._bent + fist * self._fist
        return HandState(_forearm(self._model, t), angles)


class RandomPoses:
    """Sequence of poses whose joints are independent, each held for half of its time.

    They are drawn from `RANDOM_DEG` and `RANDOM_DIP`, and the thumb from its limits.
    """

    period_s = PERIOD_S

    def __init__(self, model: HandModel, seed: int) -> None:
        rng = np.random.default_rng([seed, 14])
        self._model = model
        self._angles = np.empty((RANDOM_POSES, 5, 4))
        of = (RANDOM_POSES, 4)
        low, high = model.limits_rad[0].T
        self._angles[:, 0] = low + rng.uniform(0.0, 1.0, of) * (high - low)
        abduction, mcp, pip = (np.radians(rng.uniform(a, b, of)) for a, b in RANDOM_DEG)
        self._angles[:, 1:] = np.stack([abduction, mcp, pip, rng.uniform(*RANDOM_DIP, of) * pip], axis=-1)

    def at(self, t_s: float) -> HandState:
        """The hand at time `t_s` [s]; before 0 the pose of 0."""
        t = max(t_s, 0.0) % PERIOD_S
        each_s = PERIOD_S / RANDOM_POSES
        place, since_s = station_at(t, each_s, RANDOM_POSES)
        angles = between(self._angles, place, smooth_step(since_s / (0.5 * each_s)))
        return HandState(_forearm(self._model, t), angles)


class OnForearm:
    """Motion of the forearm: where the palm would be if the wrist were straight."""

    def __init__(self, motion: HandMotion) -> None:
        self._motion, self.period_s = motion, motion.period_s

    def at(self, t_s: float) -> HandState:
        """Forearm and fingers at time `t_s` [s]; before 0 the pose of 0."""
        state = self._motion.at(t_s)
        if not state.wrist_angles_rad.any():
            return state
        # both frames have their origin in the wrist
        back = rigid(forearm_palm(state.wrist_angles_rad).T, np.zeros(3))
        return replace(state, T_rig_palm=state.T_rig_palm @ back, wrist_angles_rad=STRAIGHT)


def _poses(model: HandModel, seed: int) -> Stations:
    rng = np.random.default_rng([seed, 12])
    names = [name for _ in range(4) for name in rng.permutation(list(POSES)).tolist()]
    return Stations(model, [POSES[name] for name in names], seed)


_MOTIONS: Mapping[str, Callable[[HandModel, int], HandMotion]] = {
    "standard": lambda model, seed: Stations(model, _STANDARD, seed),
    "curl": lambda model, _seed: GuidedCurl(model),
    "subject": GuidedSubject,
    "poses": _poses,
    "spread": lambda model, seed: Stations(model, 3 * _SPREAD, seed),
    "random": RandomPoses,
}
MOTIONS = tuple(_MOTIONS)


def wrist_motion(name: str, model: HandModel, seed: int) -> HandMotion | None:
    """The motion of a name of `MOTIONS`; None: there is no such."""
    make = _MOTIONS.get(name)
    return None if make is None else make(model, seed)


def _forearm(model: HandModel, t_s: float, shift_m: Float = _NONE, rotation_rad: Float = _NONE) -> Float:
    """Palm pose in the room (4, 4): the forearm turns slowly while the fingers move."""
    phase = np.array([0.0, 2.1, 4.2])
    slow = FOREARM_ROTATION * np.sin(2.0 * np.pi * t_s / (PERIOD_S / 6) + phase)
    return base_pose(model, _NONE, shift_m, slow - FOREARM_ROTATION * np.sin(phase) + rotation_rad)
