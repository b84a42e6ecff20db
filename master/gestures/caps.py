"""Where the painted caps of the fingertips are: measured where they are seen, else where the hand has them.

A cap's centroid is measured to a fraction of a millimetre, however the palm lies. The tip's joint is inferred from it
by way of the hand, and is some millimetres off where the palm is known from the tips alone.
"""

import numpy as np

from common.arrays import Float
from common.hand_model import FINGERS, TIPS, HandModel
from common.messages import HandPose

_OWN_M = 0.012  # a marker farther from where the hand has the cap is not this finger's


class Caps:
    """Where the caps of a hand sit on it. Holds the profile's mounts; a finger without one has its tip's joint."""

    def __init__(self, model: HandModel) -> None:
        self._joint, self._offset = TIPS.copy(), np.zeros((5, 3))
        for finger, name in enumerate(FINGERS):
            mount = model.mounts.get(name)
            if mount is not None and mount.joint is not None:
                self._joint[finger], self._offset[finger] = mount.joint, mount.offset_m

    def of(self, pose: HandPose, rotation: Float) -> Float:
        """(5, 3) [m], rig frame, of a pose whose joints have the rotations (26, 3, 3), joint frame -> rig frame."""
        caps = pose.position_m[self._joint] + (rotation[self._joint] @ self._offset[..., None])[..., 0]
        seen = pose.markers_m[np.isfinite(pose.markers_m[:, 0])]
        if not len(seen):
            return caps
        off = caps[:, None] - seen[None]
        apart = np.sqrt(np.vecdot(off, off))
        own = apart.argmin(axis=1)
        # The nearest to this cap, and this cap the nearest to it.
        mutual = (apart.argmin(axis=0)[own] == np.arange(5)) & (apart.min(axis=1) <= _OWN_M)
        return np.where(mutual[:, None], seen[own], caps)
