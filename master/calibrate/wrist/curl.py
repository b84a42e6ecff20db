"""Line of each finger's laser point, from a guided curl.

Outliers are rejected, then the principal axis is taken.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float
from common.calibration.wrist import FingerLine
from common.errors import FitError
from common.hand.model import FINGERS
from master.estimator.finger_lines import principal_line

MIN_POINTS = 20  # two thirds of a second of strobe cycles


@dataclass(frozen=True, slots=True, eq=False)
class FingerCurl:
    """One finger's curl.

    Attributes:
        finger: Its name.
        points_m: (N, 3) the points that count [m], camera frame.
        seen: Points seen in all.
        line: Its line; None: not determined.
        reason: Why not.
    """

    finger: str
    points_m: Float
    seen: int
    line: FingerLine | None
    reason: str = ""


def fit_curls(laser_m: Float) -> tuple[FingerCurl, ...]:
    """The lines of the five fingers.

    Args:
        laser_m: (T, 5, 3) laser points [m], camera frame; NaN: not seen.

    Raises:
        FitError: No finger determines a line; the text states for each finger why.
    """
    curls = tuple(_curl(name, laser_m[:, f]) for f, name in enumerate(FINGERS))
    if all(curl.line is None for curl in curls):
        reasons = "; ".join(f"{curl.finger}: {curl.reason}" for curl in curls)
        raise FitError(f"no finger curled before the laser: {reasons}")
    return curls


def _curl(finger: str, laser_m: Float) -> FingerCurl:
    seen = laser_m[np.isfinite(laser_m).all(axis=1)]
    if len(seen) < MIN_POINTS:
        return FingerCurl(
            finger, seen, len(seen), None, f"{len(seen)} points, at least {MIN_POINTS} are needed"
        )
    points = seen[_together(seen)]
    axis = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][0]
    moved = float(np.ptp(points @ axis))
    # of 60 to 100 mm: below it was no curl, and a short line's direction is that of the noise
    min_motion_m = 0.015
    if len(points) < MIN_POINTS or moved < min_motion_m:
        return FingerCurl(
            finger,
            points,
            len(seen),
            None,
            f"moved by {1e3 * moved:.1f} mm, at least {1e3 * min_motion_m:.0f} are needed: bend it to a fist",
        )
    try:
        return FingerCurl(finger, points, len(seen), principal_line(points))
    except FitError as error:
        return FingerCurl(finger, points, len(seen), None, str(error))


def _together(points: Float) -> Bool:
    """Select the points (N,) that lie along the line that most of them share.

    The points of another finger do not.
    """
    rng = np.random.default_rng(0)
    pairs = 300
    a, b = points[rng.integers(0, len(points), (2, pairs))]
    way = b - a
    length = np.linalg.norm(way, axis=1)
    # Neighbours constrain no direction.
    far = length > np.quantile(length, 0.5)
    if not far.any():  # all in one place
        return np.ones(len(points), dtype=np.bool_)
    a, way = a[far], way[far] / length[far, None]
    arm = points[:, None] - a
    off = np.linalg.norm(arm - np.vecdot(arm, way)[..., None] * way, axis=2)
    outlier_m = 3e-3  # from the line: it is a little bent, and the finger goes aside by a millimetre
    near = off < outlier_m
    best = int(np.argmax(near.sum(axis=0) - 0.1 * np.minimum(off, outlier_m).sum(axis=0) / outlier_m))
    along = (points - a[best]) @ way[best]
    low, high = np.quantile(along[near[:, best]], [0.01, 0.99])
    alone_m = 3e-3  # beyond all but one per cent of the points along the line
    return near[:, best] & (along > low - alone_m) & (along < high + alone_m)
