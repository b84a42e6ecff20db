"""Tracked object that travels and rotates freely at half a metre, beside a hand.

Object tracking is measured on it.

    0 - 12 s    wanders and turns at once, about all axes
    12 - 15 s   rests
    15 - 23 s   goes to and fro, at 0.6 m/s where it is fastest
    23 - 32 s   turns once about its own axis and once about another, wholly
    32 - 35 s   rests
    35 - 45 s   wanders; a card passes before it (`CARDS`) that hides it from above
    45 - 53 s   comes to rest; the open hand comes before it, hides some of it and goes again
    53 - 60 s   wanders

Else the hand is aside, its fingers slowly moving. Place, pace, axes and order of the turns are drawn from the seed.
All is smooth (C2) and closed over the period.
"""

import numpy as np

from common.arrays import Float
from common.geometry.transforms import rigid, rotation_vector_to_matrix
from common.hand.model import HandModel
from common.sim.motion import (
    FIST,
    PERIOD_S,
    REST,
    Drift,
    HandState,
    Waves,
    angles_of,
    base_pose,
    smooth_step,
    window,
)
from common.sim.scene import Card
from common.sim.tracked import facing

AT_M = np.array([-0.05, -0.015, 0.03])  # the object's middle, against that of the view
ASIDE_M = np.array([0.165, 0.06, 0.07])  # the hand, where it hides nothing
BEFORE_M = np.array([0.0, 0.055, -0.11])  # the hand where it hides some of it, against the object
WANDER_M = np.array([0.07, 0.055, 0.06])
WANDER_DEG = np.array([75.0, 75.0, 90.0])
WANDERS_S = ((0.3, 12.0), (35.0, 46.4), (51.6, 59.7))
SHUTTLE_S, SHUTTLE_M_S, SHUTTLE_HZ = (15.0, 23.0), 0.6, (0.8, 1.1)
SPINS_S = ((23.2, 27.4), (27.6, 31.8))
COMES_S = (45.0, 46.6, 51.4, 53.0)
CARDS = (Card(middle_s=40.0, width_m=0.09, top_m=-0.40, bottom_m=0.005, depth_m=0.36, speed_m_s=0.09),)


class ObjectTravel:
    """Motion of a travelling object and the hand.

    The state it holds is its script, fixed by the constructor.
    """

    def __init__(self, model: HandModel, centre_m: Float, seed: int) -> None:
        """Of a hand and an object about a place (3,) [m]; the same seed, the same motion."""
        rng = np.random.default_rng([seed, 37])
        self._model, self._centre = model, np.asarray(centre_m, dtype=np.float64)
        self._wander, self._drift, self._wrist = Waves(rng, 6), Drift(rng), Waves(rng, 5)
        self._place = self._centre + AT_M + rng.uniform(-0.01, 0.01, 3)
        self._facing = rotation_vector_to_matrix(np.radians(rng.uniform(-20.0, 20.0, 3))) @ facing(
            np.radians(25.0)
        )
        way = np.array([1.0, 0.0, 0.0]) + rng.uniform(-1.0, 1.0, 3) * np.array([0.0, 0.6, 0.8])
        self._way = way / np.linalg.norm(way)
        self._rate = 2.0 * np.pi * float(rng.uniform(*SHUTTLE_HZ))
        other = rng.normal(size=3)
        axes = np.stack([self._facing[:, 2], other / np.linalg.norm(other)])
        self._spins = axes[rng.permutation(2)] * rng.choice((-1.0, 1.0), (2, 1))
        self._before = BEFORE_M + rng.uniform(-1.0, 1.0, 3) * np.array([0.035, 0.01, 0.01])

    @property
    def period_s(self) -> float:
        """Time [s] after which the motion repeats."""
        return PERIOD_S

    def at(self, t_s: float) -> HandState:
        """Hand and object at time `t_s` [s]; before 0 those of 0."""
        t = max(t_s, 0.0) % PERIOD_S
        wobble, shift, rotation = self._drift.at(t)
        come, there, leave, gone = COMES_S
        before = smooth_step((t - come) / (there - come)) * smooth_step((gone - t) / (gone - leave))
        aside = self._centre + ASIDE_M
        shift = shift + (1.0 - before) * ASIDE_M + before * (self._place - self._centre + self._before)
        share = (1.0 - before) * (0.25 + 0.25 * self._wrist.at(t))
        rest, fist = np.array(REST, dtype=np.float64), np.array(FIST, dtype=np.float64)
        posture = rest + share[:, None] * (fist - rest)
        palm = base_pose(self._model, aside - ASIDE_M, shift, rotation)
        return HandState(palm, angles_of(self._model, posture, wobble), objects=(self.object_at(t),))

    def object_at(self, t_s: float) -> Float:
        """`T_rig_object` (4, 4) [m] at a time within the period [s]."""
        fade_s = 1.0
        inside = sum(window(t_s, start, stop, fade_s) for start, stop in WANDERS_S)
        waves = inside * self._wander.at(t_s)
        place = self._place + WANDER_M * waves[:3]
        start, stop = SHUTTLE_S
        size = window(t_s, start, stop, fade_s) * SHUTTLE_M_S / self._rate
        place = place + size * np.sin(self._rate * (t_s - start)) * self._way
        rotation = rotation_vector_to_matrix(np.radians(WANDER_DEG) * waves[3:])
        for axis, (start, stop) in zip(self._spins, SPINS_S, strict=True):
            spun = 2.0 * np.pi * smooth_step((t_s - start) / (stop - start))
            rotation = rotation @ rotation_vector_to_matrix(spun * axis)
        return rigid(rotation @ self._facing, place)
