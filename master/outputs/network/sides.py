"""Left or right side of a hand, as other programs name it.

A pose determines it by its shape, so no hand file is needed.
"""

from math import isfinite
from typing import Literal

from common.hand.model import JOINTS, WRIST
from common.messages import HandPose

Side = Literal["left", "right"]
_THUMB, _LITTLE = JOINTS.index("thumb-metacarpal"), JOINTS.index("pinky-finger-phalanx-proximal")


def side_of(pose: HandPose) -> Side | None:
    """Which hand it is; None where wrist, thumb or little finger are not known.

    The wrist's x axis points from a right hand's thumb to its little finger, and from a left hand's little finger to
    its thumb: y is dorsal and -z goes to the fingers on both.
    """
    ax, ay, az = (pose.position_m[_LITTLE] - pose.position_m[_THUMB]).tolist()
    w, x, y, z = pose.orientation_wxyz[WRIST].tolist()
    # The first column of the quaternion's matrix: numbers, as arrays this small would cost ten times as much.
    along = ax * (1.0 - 2.0 * (y * y + z * z)) + 2.0 * ay * (x * y + w * z) + 2.0 * az * (x * z - w * y)
    if not isfinite(along):
        return None
    return "right" if along > 0.0 else "left"
