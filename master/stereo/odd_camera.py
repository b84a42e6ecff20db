"""Which camera is to be left out where the rays of three or more do not meet: one was knocked, or saw something else.

All subsets with one camera less are placed. One that meets is right if no other fits nearly as well; its misfit is
held against the limit of its own degrees. Two cameras cannot tell which of them is wrong, and of three the wrong one
is not told where it is off along the epipolar line of another, so that this pair meets as well, elsewhere: of three
side by side, off sideways. What cannot be told is dropped, as it is where two cameras disagree.
"""

import numpy as np

from common.arrays import Bool, Float
from master.stereo.place import Placement
from master.stereo.rivals import CLEARLY

_FEWEST = 3  # cameras of which one may be left out


def odd_camera(place: Placement, uv: Float, sigma_px: Float, apart: Bool) -> Bool:
    """The sightings (C, M) without which the rays of a marker meet: none, or one of a marker.

    Args:
        place: Where markers are, and whether their rays meet.
        uv: (C, M, 2) [px]; NaN: not seen.
        sigma_px: (C, M).
        apart: (M,) markers whose rays do not meet.
    """
    left_out = np.zeros(uv.shape[:2], dtype=np.bool_)
    markers = np.flatnonzero(apart & (np.isfinite(uv[..., 0]).sum(axis=0) >= _FEWEST))
    if not len(markers):
        return left_out
    cameras = np.arange(len(uv))
    without = np.repeat(uv[:, markers, None], len(uv), axis=2)  # (C, K, C, 2): of K markers, without each
    without[cameras, :, cameras] = np.nan
    placed = place(without.reshape(len(uv), -1, 2), np.repeat(sigma_px[:, markers], len(uv), axis=1))
    # Without one that does not see the marker it is as before: the rays do not meet.
    meets = np.isfinite(placed.points[:, 0]) & (placed.misfit <= placed.limit)
    misfit = np.where(meets, placed.misfit, np.inf).reshape(-1, len(uv))
    least, second = np.partition(misfit, 1, axis=1)[:, :2].T
    told = np.isfinite(least) & (second > least + CLEARLY)
    left_out[misfit.argmin(axis=1)[told], markers[told]] = True
    return left_out
