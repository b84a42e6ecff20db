"""Motions that a marker rig and a wrist device see together, and of two hands.

Fusion is measured on them, and extrinsics are calibrated from them.

All of them are pure in time, smooth (C2) and closed over their period, and the wrist bends in all of them, since the
device sits on the forearm (`common.hand.wrist`; limits of the bend as flexion / deviation):

    grasp         closes round a bar, lifts, turns and puts it back (`grasp`); 3 degrees flexed, +-7 / +-8 about that
    both-poses    the six study poses, the palm in a new place and turned another way each (`StudyPoses`); +-8 / +-5
    both-curl     all fingers curl slowly from straight to PIP 105 degrees and back; +-8 / +-5
    both-travel   the hand goes to and fro at a peak of 1 m/s, its fingers slowly moving; +-8 / +-5
    gestures      pinches, knobs, keys, pointing and free motion for 75 s (`gestures`); +-5 / +-3
    both-moves    10 s in which fingers bend one by one and together, the palm turns about all axes; +-25 / +-12

`TwoHands`: a right and a left hand before one marker rig, 20 s. Middles of their palms pass at 0.1 m in depth, one hand
and then the other in front, lie side by side at 0.1 m, and one hides the other for half a second; the left hand leaves
and comes back on the other side.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from common.arrays import Float
from common.hand.model import HandModel
from common.sim.gestures import Gestures
from common.sim.grasp import MCP_PER_PIP, Grasp
from common.sim.motion import (
    PEAK_SPEED_M_S,
    PERIOD_S,
    DriftingMotion,
    HandMotion,
    HandState,
    StudyPoses,
    Waves,
    closing,
    smooth_step,
    station_at,
    window,
)

TYPICAL_FLEXION_DEG = np.array([8.0, 5.0])
_CURL_LAG_RAD = np.array([0.3, 0.0, 0.1, 0.2, 0.3])  # no finger follows another at once
_CURL_SPREAD_DEG = np.array([8.0, 4.0, 0.0, -4.0, -8.0])
_THUMB_DEG = np.array([[14.0, -6.0, 0.0], [6.0, 26.0, 26.0]])  # open, closed
TRAVEL_S = 6.0
TRAVEL_HZ = (1.3, 1.8)
MOVES_S = 10.0
MOVES_ROTATION_DEG = np.array([26.0, 24.0, 30.0])
MOVES_WRIST_DEG = np.array([25.0, 12.0])
MOVES_SHIFT_M = np.array([0.05, 0.03, 0.04])


class FlexedWrist:
    """Motion during which the wrist also flexes as in normal use."""

    def __init__(self, motion: HandMotion, seed: int) -> None:
        self._motion, self.period_s = motion, motion.period_s
        self._waves = Waves(np.random.default_rng([seed, 19]), 2, motion.period_s)

    def at(self, t_s: float) -> HandState:
        """The hand at time `t_s` [s]; before 0 the pose of 0."""
        wrist_angles = np.radians(TYPICAL_FLEXION_DEG) * self._waves.at(max(t_s, 0.0))
        return replace(self._motion.at(t_s), wrist_angles_rad=wrist_angles)


class Curls(DriftingMotion):
    """All fingers curl and stretch six times a minute while the palm slowly rotates."""

    def __init__(self, model: HandModel, centre_m: Float, seed: int) -> None:
        rng = np.random.default_rng([seed, 23])
        super().__init__(model, centre_m, rng)
        self._rotations = Waves(rng, 3)
        curl_pip_deg = 101.0
        self._most = curl_pip_deg * (1.0 - rng.uniform(0.0, 0.06, 4))
        self._ratio = MCP_PER_PIP * (1.0 + rng.normal(0.0, 0.06, 4))

    def _moved(self, t: float, wobble: Float, shift: Float, rotation: Float) -> HandState:
        curl_s, straight_deg = 10.0, 4.0
        share = 0.5 - 0.5 * np.cos(2.0 * np.pi * t / curl_s - _CURL_LAG_RAD)
        pip = share[1:] * self._most
        posture = np.empty((5, 3))
        posture[0] = _THUMB_DEG[0] + share[0] * (_THUMB_DEG[1] - _THUMB_DEG[0])
        posture[1:, 0] = _CURL_SPREAD_DEG[1:] * (1.0 - share[1:])
        posture[1:, 1], posture[1:, 2] = straight_deg + self._ratio * pip, straight_deg + pip
        curl_rotation_deg = 14.0
        rotation = rotation + np.radians(curl_rotation_deg) * self._rotations.at(t)
        return self._state(posture, wobble, shift, rotation)


class Travel(DriftingMotion):
    """The hand moves to and fro, ten ways a minute, while its fingers move slowly."""

    def __init__(self, model: HandModel, centre_m: Float, seed: int) -> None:
        rng = np.random.default_rng([seed, 29])
        super().__init__(model, centre_m, rng)
        self._fingers = Waves(rng, 5)
        count = round(PERIOD_S / TRAVEL_S)
        way = np.array([1.0, 0.0, 0.0]) + rng.uniform(-1.0, 1.0, (count, 3)) * np.array([0.2, 0.4, 0.6])
        self._way = way / np.linalg.norm(way, axis=1, keepdims=True)
        self._rate_hz = rng.uniform(*TRAVEL_HZ, count)

    def _moved(self, t: float, wobble: Float, shift: Float, rotation: Float) -> HandState:
        k, s = station_at(t, TRAVEL_S, len(self._way))
        rate = 2.0 * np.pi * float(self._rate_hz[k])
        travel_fade_s = 0.6
        size = window(s, 0.0, TRAVEL_S, travel_fade_s) * 0.98 * PEAK_SPEED_M_S / rate
        shift = shift + size * np.sin(rate * s) * self._way[k]
        return self._state(closing(0.35 + 0.35 * self._fingers.at(t)), wobble, shift, rotation)


class Moves(DriftingMotion):
    """Ten seconds of all motions that reveal where the device sits."""

    period_s = MOVES_S

    def __init__(self, model: HandModel, centre_m: Float, seed: int) -> None:
        rng = np.random.default_rng([seed, 31])
        super().__init__(model, centre_m, rng, MOVES_S)
        self._order = rng.permutation(5)
        self._depth = rng.uniform(0.75, 0.95, 5)
        # Turns, shifts, bends: each a wave of its own that closes over the period.
        self._cycles = np.concatenate([rng.permutation(n) for n in ([3, 4, 5], [2, 3, 4], [4, 5])])
        self._phase = rng.uniform(0.0, 2.0 * np.pi, 8)

    def _moved(self, t: float, wobble: Float, shift: Float, rotation: Float) -> HandState:
        share = np.empty(5)
        for place, finger in enumerate(self._order):
            start = 0.3 + 0.8 * place
            share[finger] = window(t, start, start + 1.1, 0.5)
        together = window(t, 4.9, 9.7, 0.5) * 0.5 * (1.0 - np.cos(2.0 * np.pi * (t - 4.9) * 3.0 / 4.8))
        posture = closing(self._depth * np.maximum(share + together, 0.0))
        wave = np.sin(2.0 * np.pi * self._cycles * t / MOVES_S + self._phase)
        shift, rotation = (
            shift + MOVES_SHIFT_M * wave[3:6],
            rotation + np.radians(MOVES_ROTATION_DEG) * wave[:3],
        )
        state = self._state(posture, wobble, shift, rotation)
        return replace(state, wrist_angles_rad=np.radians(MOVES_WRIST_DEG) * wave[6:])


APART_M, NEAR_M, CROSS_M = 0.13, 0.0525, 0.05  # half distances: to the side, where they are nearest, in depth
AWAY_M = np.array([0.0, 0.42, 0.0])
_WAYS: dict[str, tuple[tuple[float, float, float], ...]] = {  # from, until [s], value afterwards
    # right hand to the right 1 ... left of the left hand -1
    "side": (
        *((1.5, 3.0, -1.0), (4.0, 5.0, -NEAR_M / APART_M), (5.6, 6.6, -1.0), (7.4, 8.6, 1.0)),
        *((10.0, 11.0, 0.0), (11.5, 12.5, 1.0), (14.0, 15.0, -1.0), (17.2, 18.6, 1.0)),
    ),
    "front": ((6.4, 7.4, -1.0), (8.6, 9.8, 1.0)),  # right hand in front of the left one 1 ... behind it -1
    "away": ((13.0, 14.0, 1.0), (15.0, 16.0, 0.0)),  # of the left hand
}


class TwoHands(DriftingMotion):
    """One of two hands that cross; its side is that of the hand."""

    period_s = 20.0

    def __init__(self, model: HandModel, centre_m: Float, seed: int) -> None:
        self._right = 1.0 if model.profile.side == "right" else -1.0
        rng = np.random.default_rng([seed, 41, int(self._right) + 1])
        super().__init__(model, centre_m, rng, self.period_s)
        self._fingers, self._rotations = Waves(rng, 5, self.period_s), Waves(rng, 3, self.period_s)

    def _moved(self, t: float, wobble: Float, shift: Float, rotation: Float) -> HandState:
        side, front, away = _way("side", 1.0, t), _way("front", 1.0, t), _way("away", 0.0, t)
        far_m = 0.06  # from the middle of the view, so that both hands are in it
        shift = 0.3 * shift + np.array(
            [self._right * side * APART_M, 0.0, far_m - self._right * front * CROSS_M]
        )
        rotation_deg = 10.0
        rotation = rotation + np.radians(rotation_deg) * self._rotations.at(t)
        if self._right < 0.0:
            shift = shift + away * AWAY_M
        return self._state(closing(0.12 + 0.12 * self._fingers.at(t)), wobble, shift, rotation)


def _way(name: str, value: float, t_s: float) -> float:
    """Value of a course at a time [s], which begins with `value`."""
    for start_s, stop_s, end in _WAYS[name]:
        value += (end - value) * smooth_step((t_s - start_s) / (stop_s - start_s))
    return value


_MOTIONS: Mapping[str, Callable[[HandModel, Float, int], HandMotion]] = {
    "grasp": Grasp,
    "both-poses": lambda model, centre_m, seed: FlexedWrist(StudyPoses(model, centre_m, seed), seed),
    "both-curl": lambda model, centre_m, seed: FlexedWrist(Curls(model, centre_m, seed), seed),
    "both-travel": lambda model, centre_m, seed: FlexedWrist(Travel(model, centre_m, seed), seed),
    "both-moves": Moves,
    "gestures": Gestures,
}
TWO_RIG_SCENES = tuple(_MOTIONS)


def two_rig_motion(name: str, model: HandModel, centre_m: Float, seed: int) -> HandMotion | None:
    """Motion of a name of `TWO_RIG_SCENES` about (3,) [m], rig frame; None: no such.

    The place alone differs between rigs: with the same hand and seed the fingers, the turns of the palm, the
    bend of the wrist and the shifts are the same.
    """
    make = _MOTIONS.get(name)
    return None if make is None else make(model, centre_m, seed)
