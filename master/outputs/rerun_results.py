"""Results of a master other than hands, in one Rerun recording.

Objects, contact and gestures.
"""

from collections.abc import Sequence

import numpy as np
import rerun as rr

from common.arrays import Float
from common.calibration.object_profile import ObjectProfile
from common.hand.model import PALM, TIPS
from common.messages import Contact, Gesture, ObjectPose, ResultMessage
from master.outputs.poses import Poses
from master.outputs.rerun_gestures import GesturesLayer
from master.outputs.rerun_objects import ObjectsLayer
from master.outputs.rerun_states import States

_NAMED = [*TIPS.tolist(), PALM]


class ResultLayer:
    """Logger of results to a recording that belongs to the caller.

    Holds tips and palm of the last poses.

    Contact and gestures are drawn at the joints of their own epoch.
    """

    def __init__(self, recording: rr.RecordingStream, objects: Sequence[ObjectProfile]) -> None:
        states = States(recording)
        self._objects = ObjectsLayer(recording, states, objects)
        self._gestures = GesturesLayer(recording, states)
        self._joints: dict[tuple[str, int], Float] = {}

    def remember(self, poses: Poses) -> None:
        """Take the poses of a hand, before the results that refer to them."""
        at = np.where(poses.valid[..., None], poses.position_m, np.nan)[:, _NAMED]
        self._joints |= {(poses.hand, t): row for t, row in zip(poses.t_ns.tolist(), at, strict=True)}
        remembered = 1024  # poses
        for old in list(self._joints)[: -max(remembered, len(poses))]:
            del self._joints[old]

    def log(self, results: Sequence[ResultMessage]) -> None:
        """Log a batch, each kind in the order of time; hands are passed over."""
        self._objects.log_poses([one for one in results if isinstance(one, ObjectPose)])
        self._objects.log_contacts([one for one in results if isinstance(one, Contact)], self._joints)
        self._gestures.log([one for one in results if isinstance(one, Gesture)], self._joints)
