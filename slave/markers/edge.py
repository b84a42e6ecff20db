"""Centre of a partly occluded marker cap from its visible edge.

Something in front of the cap covers it in part; only the edge that is still the cap's own is used.

What is left of the cap has its centroid elsewhere: 15 % hidden moves it by an eighth of the radius. The shape that
the cap had before is known (an ellipse with the second moments of its shares), so only its place is sought: rays
from a point inside meet the visible edge at some distance, the ellipse at another; the difference of the two along
all rays that see the cap's own edge gives the shift by least squares. Rays on which the cap ends too early see the
edge of the thing in front; they are identified by their residual and rejected, one side only, until nothing changes.
Where too little is left, or the rest does not fit the ellipse, there is no answer.
"""

import math
from typing import NamedTuple, TypeAlias, cast

import cv2
import numpy as np
import numpy.typing as npt

from common.arrays import Float

Float32: TypeAlias = npt.NDArray[np.float32]

RAYS = 48
KEEP = (RAYS // 2, RAYS * 11 // 20)  # rays that the first rounds trust
_ANGLES = np.arange(RAYS, dtype=np.float64) * (2.0 * math.pi / RAYS)
DIRECTIONS: Float = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1).astype(np.float64)

# Segments of a unit disc behind a straight edge: share of the area, and the way of the rest's centroid.
_CHORD: Float = np.linspace(0.999, 0.0, 200)
_SHARE: Float = (np.arccos(_CHORD) - _CHORD * np.sqrt(1.0 - _CHORD**2)) / math.pi
_WAY: Float = 2.0 / 3.0 * (1.0 - _CHORD**2) ** 1.5 / (math.pi * (1.0 - _SHARE))


class Ellipse(NamedTuple):
    """Second central moments [px^2] of a filled ellipse.

    Its edge is at x' C^-1 x = 4.
    """

    xx: float
    xy: float
    yy: float


class Centre(NamedTuple):
    """Centre of a cap (u, v) [px] and RMS of its edge about it [px].

    The centre is in the frame of the cap's window.
    """

    u: float
    v: float
    rms: float


def centre_of(share: Float32, shape: Ellipse, u: float, v: float) -> Centre | None:
    """Centre of a partly covered cap.

    Args:
        share: (H, W) share of marker colour of every pixel of a window, 0..1.
        shape: The cap's shape when it was whole.
        u, v: A point inside what is visible [px], in the window: its centroid.

    Returns:
        The centre, or None where the visible edge does not determine it.
    """
    determinant = shape.xx * shape.yy - shape.xy**2
    if determinant <= 0.0:
        return None
    inverse: Float = np.array([[shape.yy, -shape.xy], [-shape.xy, shape.xx]]) / determinant
    longest = 2.0 * math.sqrt(0.5 * (shape.xx + shape.yy) + math.hypot(0.5 * (shape.xx - shape.yy), shape.xy))
    seen: Float = _edge(share, np.array([u, v]), 2.0 * longest + 2.0)
    points: Float = np.array([u, v]) + seen[:, None] * DIRECTIONS
    centre: Float = np.array([u, v])
    own = np.ones(RAYS, np.bool_)
    residual: Float = np.zeros(RAYS)
    rounds = 6
    for iteration in range(rounds):
        away = points - centre
        inner = away @ inverse
        level = np.sqrt(np.maximum((away * inner).sum(axis=1), 1e-9))  # 2 on the ellipse
        slope: Float = inner / level[:, None]
        length = np.sqrt(np.maximum((slope * slope).sum(axis=1), 1e-9))
        residual = (level - 2.0) / length  # distance from the ellipse, outwards positive
        short_px = 0.6  # a ray that ends so much before the ellipse sees something else
        # At first the centre is off by a part of the radius, and the own edge is where the distances are largest.
        least = -short_px if iteration >= len(KEEP) else float(np.sort(residual)[RAYS - KEEP[iteration]])
        kept = residual >= least
        left = 0.45  # share of the rays that must be left
        if kept.sum() < left * RAYS:
            return None
        normal: Float = slope[kept] / length[kept, None]
        try:
            shift: Float = np.linalg.solve(normal.T @ normal, normal.T @ residual[kept]).astype(np.float64)
        except np.linalg.LinAlgError:
            return None  # no edge about the centroid: that of a thin crescent lies beside its pixels
        centre += shift
        done_px = 0.06  # a shift that changes nothing
        if iteration >= len(KEEP) and float(np.abs(shift).max()) < done_px:
            break
        own = kept
    rms = float(np.sqrt(np.mean(np.square(residual[own]))))
    fit_px = 0.35  # RMS of their residuals
    if rms > fit_px or float(np.hypot(*(centre - (u, v)))) > longest:
        return None
    return Centre(float(centre[0]), float(centre[1]), rms)


def fits_occlusion(hidden: float, shape: Ellipse, du: float, dv: float) -> bool:
    """Return whether an occlusion can have moved the centroid by (du, dv) [px].

    The centroid is that of the visible rest of a cap of which this share is hidden.

    Of all parts of one area the segment behind a straight edge lies farthest out, so nothing moves the centroid more:
    in a unit disc whose edge is at d by 2/3 (1 - d^2)^1.5 / (pi (1 - h)). An ellipse is such a disc, stretched.
    """
    determinant = shape.xx * shape.yy - shape.xy**2
    if determinant <= 0.0:
        return False
    squared = (du * du * shape.yy - 2.0 * du * dv * shape.xy + dv * dv * shape.xx) / determinant
    radius = 2.0 * math.sqrt(math.sqrt(determinant))  # of a disc of the same area
    unsure = 0.05  # by so much the hidden share may be larger than estimated from the areas,
    unsure_px = 0.3  # and a centre off: two standard deviations
    return 0.5 * math.sqrt(squared) <= float(np.interp(hidden + unsure, _SHARE, _WAY)) + unsure_px / radius


def _edge(share: Float32, start: Float, reach: float) -> Float:
    """Return the distance (RAYS,) [px] from `start` to the edge along each ray.

    The edge is where the shares fall to a half: the marker colour on each ray is added up.
    """
    step_px = 0.5
    steps = (np.arange(math.ceil(reach / step_px)) + 0.5) * step_px
    x = (start[0] + DIRECTIONS[:, :1] * steps).astype(np.float32)
    y = (start[1] + DIRECTIONS[:, 1:] * steps).astype(np.float32)
    along = cast(Float32, cv2.remap(share, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT))
    # Marker pixels beyond a gap are not on this ray's stretch: only what comes before the first empty step counts.
    gone = np.maximum.accumulate(along < 0.1, axis=1)
    return np.where(gone, 0.0, along).sum(axis=1) * step_px
