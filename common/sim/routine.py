"""Hand that follows the guided routine the way people do.

It is late, at its own tempo, and never holds a joint quite still.

The palm rests on something and faces the cameras, so that the finger tips are seen however the fingers bend.
"""

import numpy as np

from common.arrays import Float
from common.geometry.transforms import axis_rotation, rigid, rotation_vector_to_matrix
from common.hand.model import HandModel
from common.hand.routine import MOVES, ROUTINE_S, STEPS, posture_at
from common.sim.motion import Drift, HandState, angles_of

REACTION_S, TAIL_S = 1.0, 0.8
PERIOD_S = REACTION_S + ROUTINE_S + TAIL_S
LATE_S = (0.05, 0.45)  # by how much a step is begun late, least and most
REST = 0.1  # share of the drift of a hand in the air that is left when the palm rests on something


class HandRoutine:
    """One pass through the guided routine.

    The state it holds is its script, fixed by the constructor.
    """

    def __init__(self, model: HandModel, centre_m: Float, seed: int, rest: float = REST) -> None:
        """Write the script.

        Args:
            model: Whose limits and coupling hold.
            centre_m: Place (3,) of the middle of the open hand, rig frame [m].
            seed: Same seed, same motion.
            rest: Share of the drift of a hand held in the air that the palm keeps.
        """
        rng = np.random.default_rng([seed, 5])
        self._model, self._centre, self._rest = model, np.asarray(centre_m, np.float64), rest
        self._drift = Drift(rng)
        starts = [next(m.start_s for m in MOVES if m.step == k) for k in range(len(STEPS))]
        late = rng.uniform(*LATE_S, len(STEPS))
        self._script_s = np.array([*starts, ROUTINE_S])
        self._done_s = REACTION_S + np.array([*(starts + late), ROUTINE_S + LATE_S[1]])

    @property
    def period_s(self) -> float:
        """Time [s] after which the motion repeats."""
        return PERIOD_S

    def script_s(self, t_s: float) -> float:
        """Where in the routine [s] the hand is at time `t_s` [s]."""
        return float(np.interp(t_s, self._done_s, self._script_s))

    def at(self, t_s: float) -> HandState:
        """The hand at time `t_s` [s]; before 0 the pose of 0."""
        t = max(t_s, 0.0) % PERIOD_S
        wobble, shift, rotation = self._drift.at(t)
        angles = angles_of(self._model, posture_at(self.script_s(t)), wobble)
        return HandState(self._pose(self._rest * shift, self._rest * rotation), angles)

    def _pose(self, shift_m: Float, rotation_rad: Float) -> Float:
        """`T_rig_palm` (4, 4): palm to the cameras, fingers up in the image."""
        to_cameras = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
        tilt_deg = 15.0  # of the fingers towards the cameras
        rotation = (
            rotation_vector_to_matrix(rotation_rad) @ axis_rotation(0, np.radians(tilt_deg)) @ to_cameras
        )
        middle = np.array([0.0, 0.0, 0.5 * float(self._model.rest_position_m[:, 2].max())])
        return rigid(rotation, self._centre + shift_m - rotation @ middle)
