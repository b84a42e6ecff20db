"""Principal axis of the motion of a finger's laser point (Kim et al. 2012).

The laser draws its points on a plane, and a finger that bends moves its point along a nearly straight line in it,
towards the device; the thumb's runs diagonally. A guided curl measures this line and how far the points go. Along it a
new point is normalised, and what deviates from it is abduction: the printed law (`master.estimator.cubic`) needs both.

The model of a hand does not: it knows the line by its bones. It is not stretched to the measured range either, because
where the point of a straight finger lies shows how straight it was held, 3 mm for each degree. On simulated hands with
skin wrong by 10 % and a palm by 1 degree and 1 mm, stretching turned a PIP good to 4 degrees (median of eight hands)
into one good to 13 where curls ended anywhere, and to 5 where all were full.
"""

import numpy as np

from common.arrays import Float
from common.calibration.wrist import FingerLine
from common.errors import FitError


def principal_line(points_m: Float) -> FingerLine:
    """Fit the line through the laser points of one finger.

    It follows the principal component of their scatter.

    Args:
        points_m: (N, 3) [m], camera frame, in any order; NaN rows are rejected.

    Returns:
        The line, its origin at the point of the straightest finger, range (0, length).

    Raises:
        FitError: Fewer than five points, less than 5 mm of motion, or points on no line.
    """
    points = points_m[np.isfinite(points_m).all(axis=1)]
    min_points = 5
    if len(points) < min_points:
        raise FitError(f"finger line: {len(points)} points of the laser, at least {min_points} are needed")
    mean = points.mean(axis=0)
    direction = np.linalg.svd(points - mean, full_matrices=False)[2][0]
    along = (points - mean) @ direction
    ends = mean + np.array([[along.min()], [along.max()]]) * direction
    distance = np.linalg.norm(ends, axis=1)
    if distance[0] < distance[1]:  # a bending finger's point comes nearer to the camera
        direction, along = -direction, -along
    residual = float(
        np.sqrt(
            (((points - mean) - ((points - mean) @ direction)[:, None] * direction) ** 2).sum(axis=1).mean()
        )
    )
    low, high = float(along.min()), float(along.max())
    min_range_m = 5e-3  # below this the direction is that of the noise
    if high - low < min_range_m:
        raise FitError(
            f"finger line: the laser's point moved by {1e3 * (high - low):.1f} mm only: bend the finger fully"
        )
    straight = 0.25  # residual per range above which it is a cloud and no line
    if residual > straight * (high - low):
        raise FitError(
            f"finger line: the points deviate {1e3 * residual:.1f} mm from a line of {1e3 * (high - low):.1f} mm:"
            " only this finger should move"
        )
    origin = mean + low * direction
    return FingerLine(
        origin_m=_vector(origin), direction=_vector(direction), range_m=(0.0, high - low), residual_m=residual
    )


def on_line(points_m: Float, line: FingerLine) -> tuple[Float, Float]:
    """Return normalised positions along the line, and deviations from it.

    Points (..., 3) give positions (...), from 0 straight to 1 most flexed, and deviations (..., 3) [m].
    """
    offset = points_m - np.array(line.origin_m)
    direction = np.array(line.direction)
    along = offset @ direction
    low, high = line.range_m
    return (along - low) / (high - low), offset - along[..., None] * direction


def _vector(value: Float) -> tuple[float, float, float]:
    x, y, z = (float(number) for number in value)
    return x, y, z
