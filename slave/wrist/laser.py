"""Find the laser segment of each finger and its centroid (Kim et al. 2012).

The line runs from side to side, so each column of the image holds it as short bright runs (`slave.wrist.runs`), one
per surface. The seams assign a line; where they cut one, the cut is moved to the crease. What is left to each
finger is measured (`slave.wrist.finger_lines`).
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Float, Image
from slave.wrist.engine import NUMPY, Engine
from slave.wrist.finger_labels import finger_labels
from slave.wrist.finger_lines import NONE, FingerLines
from slave.wrist.fingers import Fingers
from slave.wrist.runs import SETTINGS
from slave.wrist.thumb_line import beyond_ball, on_ball
from slave.wrist.view import WristView
from slave.wrist.workspace import workspace_of

# Standard deviations, by what the centroids of simulated hands of several seeds are off by.
_LINE_PX = 0.6  # one whole line
_FAINT = 3.0 * SETTINGS.floor  # a line no brighter: what is left of one where the sun saturates


@dataclass(frozen=True, slots=True, eq=False)
class LaserLines:
    """One laser segment per finger, thumb ... little; NaN where none was seen.

    Attributes:
        uv: (5, 2) centroids by length [px].
        sigma_px: (5,) standard deviation per axis.
        length_px: (5,) length.
    """

    uv: Float
    sigma_px: Float
    length_px: Float


def laser_lines(laser: Image, fingers: Fingers, view: WristView, engine: Engine = NUMPY) -> LaserLines:
    """Find the segments in the difference of laser and ambient frame."""
    workspace = workspace_of(fingers.palm_pose.view).at_palm_pose(fingers.palm_pose)
    runs, on_line = engine.lines(laser, workspace.first_row)
    if not len(runs.row):
        return LaserLines(np.full((5, 2), np.nan), np.full(5, np.nan), np.full(5, np.nan))
    points: Float = np.stack([runs.column, runs.row], axis=-1, dtype=np.float64)
    finger = fingers.finger_of(points)
    finger[~on_line] = NONE
    finger = finger_labels(finger, runs, points, workspace)
    finger[~workspace.holds(finger, points)] = NONE
    finger[workspace.on_palm(points)] = NONE
    finger_lines = engine.measure(runs, finger, view.optics.width_px)
    uv, length = finger_lines.uv, finger_lines.line
    least_m = 2e-3  # of line that must be seen
    seen = length * workspace.metres_per_px(uv) >= least_m
    sigma = _sigma_px(finger_lines, shown=fingers.shown)
    if seen[0]:
        thumb = np.flatnonzero(finger == 0)
        beyond = workspace.beyond_m(points[thumb])
        off, extra_sigma = beyond_ball(runs, thumb, beyond)
        seen[0] = not (workspace.flexed and on_ball(beyond))
        uv[0] += off
        thumb_px = 1.5  # at least, of the thumb: its line runs into that of its ball
        sigma[0] = np.hypot(np.hypot(sigma[0], extra_sigma), thumb_px)
    uv[~seen], sigma[~seen], length[~seen] = np.nan, np.nan, np.nan
    return LaserLines(uv, sigma, length)


def _sigma_px(finger_lines: FingerLines, *, shown: bool) -> Float:
    """Return the standard deviations (5,) of centroids.

    Of lines that are whole, in parts, faint, doubtful, and where no seam was seen.

    Of a line in parts all but the longest may be another finger's, or what hides the middle of its own.
    """
    apart = finger_lines.apart
    # at least, of a line in parts, some of which may be another's, or of one cut by the image
    in_parts_px = 2.0
    in_parts = np.where(
        np.isnan(apart), np.where(finger_lines.cut, in_parts_px, 0.0), np.fmax(apart, in_parts_px)
    )
    faint_px = 5.0  # a line no brighter: what is left of one where the sun saturates
    in_parts = np.where(finger_lines.brightest < _FAINT, np.maximum(faint_px, in_parts), in_parts)
    unshown_px = 4.0  # no seam was seen
    unshown = 0.0 if shown else unshown_px
    return np.sqrt(_LINE_PX**2 + in_parts**2 + unshown**2)
