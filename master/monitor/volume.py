"""Test volume of a rig.

The box, stated by the rig and in the rig frame, in which its accuracy was tested.

Outside it a hand is tracked as well as the cameras see it, but how well is unknown. So a joint reports whether it lies
inside; that it does not, alone makes no pose invalid.
"""

import numpy as np

from common.arrays import Bool, Float
from common.calibration import Volume

_EDGES = tuple((a, a | 1 << axis) for a in range(8) for axis in range(3) if not a >> axis & 1)


def inside(volume: Volume | None, points_m: Float) -> Bool:
    """Return which of the points lie in the volume.

    Points (..., 3) [m] in the rig frame; the result is (...). The faces belong to the volume.

    All do where the rig states none. A point that is NaN lies nowhere.
    """
    if volume is None:
        return np.ones(points_m.shape[:-1], np.bool_)
    low, high = np.array(volume.low_m), np.array(volume.high_m)
    return np.asarray(((points_m >= low) & (points_m <= high)).all(axis=-1), np.bool_)


def corners(volume: Volume) -> Float:
    """The eight corners (8, 3) [m]; bit 0, 1, 2 of the row: high along x, y, z."""
    ends = np.array([volume.low_m, volume.high_m])
    return np.array([[ends[row >> axis & 1, axis] for axis in range(3)] for row in range(8)])


def edges(volume: Volume) -> Float:
    """The twelve edges (12, 2, 3) [m], to be drawn."""
    return corners(volume)[np.array(_EDGES)]
