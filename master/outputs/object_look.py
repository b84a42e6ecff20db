"""How well the place of an object is known, in one word: what the viewer and the picture of a run colour it by."""

from enum import Enum

import numpy as np

from common.messages import ObjectPose
from master.outputs.palette import Rgb


class ObjectLook(Enum):
    """One state of an object, and what it means."""

    WHOLE = "tracked"
    HIDDEN = "tracked, a part is hidden"
    HELD = "held (lost from sight)"
    GONE = "nobody knows where"

    @staticmethod
    def of(pose: ObjectPose) -> "ObjectLook":
        """That of a pose."""
        if not np.isfinite(pose.position_m).all():
            return ObjectLook.GONE
        if not pose.tracked:
            return ObjectLook.HELD
        return ObjectLook.HIDDEN if pose.occluded else ObjectLook.WHOLE


OBJECT_RGB: dict[ObjectLook, Rgb] = {
    ObjectLook.WHOLE: (0, 158, 115),
    ObjectLook.HIDDEN: (86, 180, 233),
    ObjectLook.HELD: (230, 159, 0),
    ObjectLook.GONE: (130, 130, 130),
}
