"""Six poses of the Digits study in sequence, with the palm rotated every way.

Occlusion is measured on them.

Open palm, counting two, pointing, small grasp, large grasp and pinch (Kim et al., "Digits", UIST 2012, poses A-F) in
a new order each round; each is held for a while, in a place and with a turn of the palm of its own, with slow drift
all the time. From one to the next the hand goes smoothly (C2), and from the last back to the first.
"""

import numpy as np

from common.arrays import Float
from common.hand.model import HandModel
from common.sim.motion import PERIOD_S, POSES, Drift, HandState, angles_of, base_pose, smooth_step

ROUNDS = 4
STATION_S = PERIOD_S / (ROUNDS * len(POSES))
MOVE_S = 1.0  # of each station: the way to it
ROTATION_DEG = 35.0  # as far as a wrist turns without the elbow, about any axis
REACH_M = np.array([0.05, 0.03, 0.05])  # half of the box that the palm's middle moves in, rig axes


class StudyPoses:
    """Six poses, four times in 60 s.

    The state it holds is its script, fixed by the constructor.

    Attributes:
        order: (ROUNDS * 6,) names of the poses, station by station.
    """

    def __init__(self, model: HandModel, centre_m: Float, seed: int) -> None:
        """Write the script.

        Args:
            model: Whose limits and coupling hold.
            centre_m: Place (3,) of the middle of the open hand, rig frame [m].
            seed: Same seed, same motion.
        """
        rng = np.random.default_rng([seed, 3])
        self._model, self._centre = model, np.asarray(centre_m, dtype=np.float64)
        self._drift = Drift(rng)
        names = tuple(POSES)
        places = [int(k) for _ in range(ROUNDS) for k in rng.permutation(len(names))]
        self.order: tuple[str, ...] = tuple(names[k] for k in places)
        count = len(self.order)
        self._posture = np.array([POSES[name] for name in self.order], dtype=np.float64)
        self._shift = rng.uniform(-1.0, 1.0, (count, 3)) * REACH_M
        axis = rng.normal(size=(count, 3))
        # Evenly over the ball: most turns are large ones.
        size = np.radians(ROTATION_DEG) * np.cbrt(rng.uniform(size=(count, 1)))
        self._rotations = size * axis / np.linalg.norm(axis, axis=1, keepdims=True)

    @property
    def period_s(self) -> float:
        """Time [s] after which the motion repeats."""
        return PERIOD_S

    def at(self, t_s: float) -> HandState:
        """The hand at time `t_s` [s]; before 0 the pose of 0."""
        t = max(t_s, 0.0) % PERIOD_S
        place = min(int(t / STATION_S), len(self.order) - 1)
        share = smooth_step((t - place * STATION_S) / MOVE_S)

        def between(stations: Float) -> Float:
            before = stations[place - 1]  # that of the first is the last
            return before + share * (stations[place] - before)

        wobble, shift, rotation = self._drift.at(t)
        angles = angles_of(self._model, between(self._posture), wobble)
        pose = base_pose(
            self._model, self._centre, between(self._shift) + shift, between(self._rotations) + rotation
        )
        return HandState(pose, angles)

    def held(self, t_s: float) -> str | None:
        """Name of the pose that is held at `t_s` [s]; None while the hand is on its way."""
        t = max(t_s, 0.0) % PERIOD_S
        place = min(int(t / STATION_S), len(self.order) - 1)
        return self.order[place] if t - place * STATION_S >= MOVE_S else None
