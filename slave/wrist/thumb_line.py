"""Separate the thumb's laser line from that of its ball (thenar).

The two run into each other; the plane that halves the angle of the MCP parts them. When the metacarpal stands
across the laser's plane, a millimetre decides whether all of the line is the thumb's or none: so the centroid is taken
for borders from near to far, each as likely as the next, and their mean and spread are what is known.
"""

import numpy as np

from common.arrays import Float, Int
from slave.wrist.runs import Runs

# Where the border lies, beyond where the skin over the MCP of a straight thumb is: bending it by 50 degrees takes the
# plane that halves its angle back by half a radius on the palm's side, and nowhere at its side. It is known no better
# than its bone (8 %, 3 mm), the device's shift (1 mm along the thumb) and turn (2.5 degrees at 6 cm).
_BORDER_M, _BORDER_SIGMA_M = -1.5e-3, 4e-3
# Middles of nine parts, alike in probability, of Student's t with three degrees of freedom: some hands are far off.
_T3 = np.array([-2.23, -1.15, -0.66, -0.31, 0.0, 0.31, 0.66, 1.15, 2.23])
_BORDERS_M: Float = _BORDER_M + _BORDER_SIGMA_M * _T3


def on_ball(beyond_m: Float) -> bool:
    """Return whether a line (N,) is rather on the ball than on the thumb.

    The line is so far beyond the MCP's skin [m].

    Where the wrist is straight the thumb stands across the plane; a bent one can bring the ball there alone.
    """
    return float(np.median(beyond_m)) < _BORDER_M


def beyond_ball(runs: Runs, of_thumb: Int, beyond_m: Float) -> tuple[Float, float]:
    """Return the centroid offset of the thumb's part of a line (2,).

    It is how much this centroid lies beside that of the whole line; also its deviation [px].

    Args:
        runs: The runs.
        of_thumb: (N,) which of them are on the thumb or its ball.
        beyond_m: (N,) how far each is beyond the MCP's skin [m], from the thumb's root.
    """
    points: Float = np.stack([runs.column[of_thumb], runs.row[of_thumb]], axis=-1, dtype=np.float64)
    length = np.ones(len(points))
    least_px = 4.0  # of line, for a centroid
    if len(points) > 2:
        down = np.minimum(np.abs(np.diff(points[:, 1])), least_px)
        step = np.sqrt(1.0 + down * down)
        length[1:-1] = 0.5 * (step[1:] + step[:-1])
    weights = (beyond_m > _BORDERS_M[:, None]) * length
    total = weights.sum(axis=1)
    seen = total >= least_px
    # Sums, not products of matrices, and no hypot: they are the same bits on every processor.
    whole = (length[:, None] * points).sum(axis=0) / length.sum()
    if (
        not seen.any()
    ):  # all of it on the ball: nearest to the thumb is where it is seen farthest from the root
        return points[int(beyond_m.argmax())] - whole, float(np.ptp(points[:, 0]))
    off = (weights[seen, :, None] * points).sum(axis=1) / total[seen, None] - whole
    mean = off.mean(axis=0)
    # centroids lump at the whole line and at its end: 1.96 deviations of that hold less than 95 %
    tails = 1.5
    return mean, tails * float(np.sqrt(((off - mean) ** 2).mean(axis=0).max()))
