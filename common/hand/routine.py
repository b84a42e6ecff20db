"""Guided routine by which a hand is measured: postures and instructions of 20 s.

A straight finger that bends at the knuckle alone draws a circle about the knuckle; one that curls while the knuckle is
held draws the arc of its two farther bones. The postures (flat, tabletop, hook, fist) are those of the tendon-gliding
exercises of hand therapy (Wehbe & Hunter, 1985). Repetition separates lengths from what drifts meanwhile.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float

_FINGERS = (1, 2, 3, 4)
_FLAT = ((10, 0, 0), (0, 0, 0), (0, 0, 0), (0, 0, 0), (0, 0, 0))
_SPREAD = ((38, 0, 0), (12, 0, 0), (0, 0, 0), (-9, 0, 0), (-14, 0, 0))


def smooth_step(x: float) -> float:
    """Smooth step (C2): 0 below 0, 1 above 1, between 6x^5 - 15x^4 + 10x^3."""
    x = min(max(x, 0.0), 1.0)
    return x * x * x * (x * (6.0 * x - 15.0) + 10.0)


@dataclass(frozen=True, slots=True, eq=False)
class Move:
    """One way of the hand, or a rest.

    Attributes:
        step: Index of its step.
        start_s, stop_s: When [s], since the beginning of the routine.
        before, after: Postures (5, 3) [deg]: rows thumb ... little; columns abduction, flexion (MCP), PIP.
    """

    step: int
    start_s: float
    stop_s: float
    before: Float
    after: Float

    @property
    def moving(self) -> Bool:
        """(5, 3) which angles change."""
        moved_deg = 1.0
        return np.abs(self.after - self.before) > moved_deg

    @property
    def straight(self) -> Bool:
        """(5,) which fingers are straight all the way."""
        straight_deg = 5.0
        return np.maximum(self.before[:, 2], self.after[:, 2]) < straight_deg

    def posture(self, share: float) -> Float:
        """Posture (5, 3) [deg] after `share` (0 ... 1) of its time, at rest at both ends."""
        return self.before + (self.after - self.before) * smooth_step(share)


@dataclass(frozen=True, slots=True)
class Step:
    """What the user is asked to do, and for how long [s]."""

    name: str
    instruction: str
    seconds: float


def _corners(fingers: tuple[int, ...], knuckle: float, curl: float) -> Float:
    posture = np.array(_FLAT, dtype=np.float64)
    posture[list(fingers), 1:] = knuckle, curl
    return posture


def _script() -> Iterator[tuple[Step, list[Float]]]:
    """Each step with the postures it goes through, evenly in time."""
    flat, spread = np.array(_FLAT, dtype=np.float64), np.array(_SPREAD, dtype=np.float64)
    knuckle_deg, curl_deg = 88.0, 100.0
    table, hook = _corners(_FINGERS, knuckle_deg, 0.0), _corners(_FINGERS, 0.0, curl_deg)
    fist = _corners(_FINGERS, knuckle_deg, curl_deg)
    yield Step("flat", "hand flat and still", 1.0), [flat]
    yield Step("spread", "spread the fingers, and close them", 1.2), [spread, flat]
    yield (
        Step("knuckles", "six times: bend the straight fingers at the knuckles, and back", 6.0),
        [table, flat] * 6,
    )
    yield Step("curl", "three times: curl the fingers, knuckles still, and open them", 3.0), [hook, flat] * 3
    yield Step("fist", "make a fist, and open it", 1.6), [fist, flat]
    for finger, name in zip(_FINGERS, ("index", "middle", "ring", "little"), strict=True):
        instruction = f"{name} finger alone: bend it straight at its knuckle, and back"
        yield Step(name, instruction, 1.4), [_corners((finger,), knuckle_deg, 0.0), flat]
    across, curled = flat.copy(), flat.copy()
    thumb = 0
    across[thumb, :2], curled[thumb, 2] = (20.0, 40.0), 50.0
    instruction = "thumb alone: lay it straight across the palm, back, bend its two joints, back"
    yield Step("thumb", instruction, 1.8), [across, flat, curled, flat]


def _moves() -> tuple[tuple[Step, ...], tuple[Move, ...]]:
    steps: list[Step] = []
    moves: list[Move] = []
    t, last = 0.0, np.array(_FLAT, dtype=np.float64)
    for number, (step, postures) in enumerate(_script()):
        steps.append(step)
        for posture in postures:
            stop = t + step.seconds / len(postures)
            moves.append(Move(number, t, stop, last, posture))
            t, last = stop, posture
    return tuple(steps), tuple(moves)


STEPS, MOVES = _moves()
ROUTINE_S = MOVES[-1].stop_s


def move_at(t_s: float) -> Move:
    """The move at routine time `t_s` [s]; before and after it the first and last."""
    return next((move for move in MOVES if t_s < move.stop_s), MOVES[-1])


def posture_at(t_s: float) -> Float:
    """Posture (5, 3) [deg] of routine time `t_s` [s]."""
    move = move_at(t_s)
    return move.posture((t_s - move.start_s) / (move.stop_s - move.start_s))
