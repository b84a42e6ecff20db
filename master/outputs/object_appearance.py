"""How well an object's position is known, in one word.

The viewer and the picture of a run colour the object by it.
"""

from enum import Enum

import numpy as np

from common.messages import ObjectPose
from master.outputs.palette import Rgb


class ObjectAppearance(Enum):
    """One state of an object, and what it means."""

    WHOLE = "tracked"
    HIDDEN = "tracked, a part is hidden"
    HELD = "held (lost from sight)"
    GONE = "nobody knows where"

    @staticmethod
    def of(pose: ObjectPose) -> "ObjectAppearance":
        """That of a pose."""
        if not np.isfinite(pose.position_m).all():
            return ObjectAppearance.GONE
        if not pose.tracked:
            return ObjectAppearance.HELD
        return ObjectAppearance.HIDDEN if pose.occluded else ObjectAppearance.WHOLE


OBJECT_RGB: dict[ObjectAppearance, Rgb] = {
    ObjectAppearance.WHOLE: (0, 158, 115),
    ObjectAppearance.HIDDEN: (86, 180, 233),
    ObjectAppearance.HELD: (230, 159, 0),
    ObjectAppearance.GONE: (130, 130, 130),
}
