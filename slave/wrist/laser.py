"""Find the laser segment of each finger and its centroid (Kim et al. 2012).

Seams part the fingers of the LED image: paths of least energy through search bands (`seams`), first the three among
index ... little, side by side, then the thumb's, which lies over them. A pixel costs little where it is dark between
brighter neighbours; of paths alike the one nearer to the middle of its band is taken.

The laser's line is short bright runs in the image's columns (`runs`). Seams assign a line; where they cut one, the
cut moves to the crease. A pixel of the laser's plane is a known place before the palm, and fingers lean little to the
side, so a line lies nearest to the axis of its own finger (`Palm.place`). A wrist that deviates by 5
degrees moves all by half a finger; where four lines lie side by side their middle is between the second and the
third. The thumb crosses the plane near its MCP or beside the palm: what lies as near to its root is its own.

The lines of thumb and its ball (thenar) run into each other; the plane that halves the angle of the MCP parts them.
Where the metacarpal stands across the laser's plane, a millimetre decides: so the centroid is taken for borders from
near to far, each as likely as the next, and their mean and spread are what is known.
"""

from dataclasses import dataclass
from typing import cast

import cv2
import numpy as np

from common.arrays import Bool, Float, Float32, Image, Int
from slave.wrist.engine import NUMPY, Engine
from slave.wrist.led_image import WristView
from slave.wrist.palm_pose import PalmPose, find_palm_pose
from slave.wrist.runs import NONE, SETTINGS, Runs
from slave.wrist.seams import DARK, STARTS, WIDTHS, SearchBands, search_bands_of
from slave.wrist.workspace import workspace_of

_TAKEN = 10.0  # energy for the thumb's seam where another seam runs
_HALF_WIDTH = 3.0  # samples of the thumb's search band: half the breadth of such a minimum
_CREASE = np.ones((5, 5), dtype=np.uint8)


@dataclass(frozen=True, slots=True, eq=False)
class Fingers:
    """Five regions of the image: thumb, index ... little.

    Attributes:
        search_bands: Where the seams were searched.
        seams: (4, S) index|middle, middle|ring, ring|little [px, along the row of each station], and the thumb's
            [rad, along the circle of each station].
        shown: Whether the LED image showed a hand; else the seams are those of geometry alone.
    """

    search_bands: SearchBands
    seams: Float
    shown: bool
    palm_pose: PalmPose

    def finger_of(self, uv: Float) -> Int:
        """Finger (N,), 0 thumb ... 4 little, of pixels (N, 2); -1 where the pixel is NaN."""
        bands = self.search_bands
        radius, angle = bands.polar(uv)
        finger: Int = np.ones(len(uv), dtype=np.int64)
        for seam in self.seams[:3]:
            at = np.asarray(np.interp(uv[:, 1], bands.rows, seam), np.float64)
            finger += bands.thumb_side * (at - uv[:, 0]) > 0.0
        finger[angle > np.interp(radius, bands.radii, self.seams[3])] = 0
        finger[np.isnan(radius)] = NONE
        return finger


def separate(led: Image, view: WristView, engine: Engine = NUMPY) -> Fingers:
    """Find the seams in the difference of LED and ambient frame."""
    palm_pose = find_palm_pose(led, view)
    search_bands = search_bands_of(palm_pose.view)
    dark = cv2.erode(led, _CREASE)
    palm = dark[search_bands.palm[:, 1], search_bands.palm[:, 0]] if len(search_bands.palm) else dark
    # grey levels that the palm of a lit hand exceeds, or what hides it; the sun leaves less
    shown = bool(2 * np.count_nonzero(palm > 24) > palm.size)
    where = search_bands.map_x, search_bands.map_y
    straightened = cast(Image, cv2.remap(dark, *where, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
    energy = engine.energy(straightened, search_bands.thumb_crosses)
    energy[:, : STARTS[3]] *= search_bands.weight
    paths = engine.minimum_cost_paths(energy, WIDTHS)
    _part(paths[:3], straightened, energy, search_bands, engine)
    seams = search_bands.across(slice(0, 4), paths)
    # Towards the little finger, each seam stays on its own side of the one before it.
    order = search_bands.thumb_side
    np.minimum.accumulate(order * seams[:3], axis=0, out=seams[:3])
    seams[:3] *= order
    taken = _in_thumbs(search_bands, seams[:3])
    if (np.abs(paths[3] - taken) < _HALF_WIDTH).any():  # else it would pay nothing for what is taken
        thumb = energy[:, STARTS[3] :]
        thumb += _TAKEN * (np.abs(np.arange(WIDTHS[3]) - taken[..., None]) < _HALF_WIDTH).any(axis=0)
        seams[3:] = search_bands.across(slice(3, 4), engine.minimum_cost_paths(thumb, WIDTHS[3:]))
    return Fingers(search_bands, seams, shown, palm_pose)


def _part(
    paths: Int, straightened: Image, energy: Float32, search_bands: SearchBands, engine: Engine
) -> None:
    """Send the outer one of two seams in one minimum to another; changes both arrays."""
    lit = straightened[:, : STARTS[3]].max(axis=1) > DARK
    same_minimum = 0.35  # of the distance of two search bands, and of the rows of the hand
    near = same_minimum * np.abs(np.diff(search_bands.middle[:3], axis=0))
    most = same_minimum * np.count_nonzero(lit)
    for seam in range(2):
        across = search_bands.across(slice(0, 3), paths)
        same = (np.abs(np.diff(across, axis=0)) < near) & lit
        if not (same.sum(axis=1) >= most)[seam:].any():
            return
        if np.count_nonzero(same[seam]) < most:
            continue
        off = np.abs(paths[seam : seam + 2] - (WIDTHS[seam] - 1) / 2.0)[:, lit].sum(axis=1)
        loser = seam + int(off[1] > off[0])
        winner = 2 * seam + 1 - loser
        start = STARTS[loser]
        band_energy = energy[:, start : start + WIDTHS[loser]]
        at = search_bands.sample(loser, across[winner])
        band_energy += _TAKEN * (np.abs(np.arange(WIDTHS[loser]) - at[:, None]) < _HALF_WIDTH)
        paths[loser] = engine.minimum_cost_paths(band_energy, WIDTHS[loser : loser + 1])[0]


def _in_thumbs(search_bands: SearchBands, seams: Float) -> Float:
    """Return the sample (3, S) of the thumb's search band that each seam crosses."""
    rows = np.broadcast_to(search_bands.rows, seams.shape)
    radius, angle = search_bands.polar(np.stack([seams.ravel(), rows.ravel()], axis=-1))
    upward = radius.reshape(seams.shape)[:, ::-1], angle.reshape(seams.shape)[:, ::-1]
    rows_upward: list[tuple[Float, Float]] = list(zip(*upward, strict=True))
    on_circles: list[Float] = [np.interp(search_bands.radii, r, a) for r, a in rows_upward]
    return search_bands.sample(3, np.array(on_circles))


# Where `Palm.place` is a finger's, thumb ... little: half a spacing, and the palm's error. Folded
# fingers point to the root of the thumb, the little one a quarter of a spacing towards it.
_FROM: Float = np.array([-np.inf, -np.inf, 1.35, 2.3, 3.1])
_TO: Float = np.array([np.inf, 1.65, 2.65, 3.65, np.inf])
_ALL = (3.2, 4.4)  # place: from the outside of the index to that of the little finger
_ASIDE = (0.3, 0.7)  # place: by less it is folded fingers; farther the palm has not turned unseen


# Beyond the skin over the thumb's MCP, from its root. A thumb that is bent before the palm meets the plane at its MCP,
# half a centimetre either way as device and bones are known; a finger folded to the palm does so a centimetre beyond.
_THUMBS_M, _NO_THUMBS_M = 4e-3, 10e-3


def finger_labels(finger: Int, runs: Runs, beyond: Float, place: Float, *, flexed: bool) -> Int:
    """Fingers (N,) of runs, from the labels (N,) of the seams.

    `beyond`: `Palm.beyond_m` (N,) [m]; `place`: `Palm.place` (N,); `flexed`: whether the wrist is.
    """
    thumb, index = 0, 1
    out = np.where((finger != NONE) & (beyond < _THUMBS_M) & (place < 1.5), thumb, finger)
    place = place - _shift(place[out > thumb])
    out = _at_creases(out, runs)
    ends = out[1:] != out[:-1]
    ends[runs.first[1:] - 1] = True
    first = np.concatenate([[0], np.flatnonzero(ends) + 1])
    count = np.diff(np.append(first, len(out)))
    middle = np.add.reduceat(place, first) / count
    of = out[first]
    nearest = np.clip(np.rint(middle), 1, 4).astype(np.int64)
    outside_index = (
        0.5  # place: beyond the palm; there is the thumb of a bent wrist where the index is in its own
    )
    no_thumb = (
        (of == thumb) & (np.add.reduceat(beyond, first) / count > _NO_THUMBS_M) & (middle > outside_index)
    )
    aside = (of > thumb) & ((middle < _FROM[of]) | (middle > _TO[of]))
    aside &= _room(of, nearest, aside | no_thumb)
    of = np.where(no_thumb | aside, nearest, of)
    if flexed:
        beyond_index = (of == index) & (middle < outside_index)
        if ((of == index) & ~beyond_index).any():
            of = np.where(beyond_index, thumb, of)
    return np.repeat(of, count)


def _shift(place: Float) -> float:
    """By how much all four lie beside their axes, from `place` (N,) of runs, or 0."""
    if not len(place):
        return 0.0
    across = np.sort(place)
    steps, wide = np.diff(across), float(across[-1] - across[0])
    off = 0.5 * float(across[0] + across[-1]) - 2.5
    gap = 0.08  # place: a larger step is no line
    # share of that way that the lines of four fingers side by side fill, at least
    full = float(steps[steps < gap].sum()) > 0.72 * wide
    return off if full and _ALL[0] < wide < _ALL[1] and _ASIDE[0] < abs(off) < _ASIDE[1] else 0.0


def _room(of: Int, nearest: Int, moving: Bool) -> Bool:
    """Which parts (N,) may go to `nearest`: not all of a line if that has its own."""
    unmoved = np.zeros(6, np.bool_)
    unmoved[of[~moving]] = True  # those of no finger come last
    return unmoved[of] | ~unmoved[nearest]


def _at_creases(finger: Int, runs: Runs) -> Int:
    """Move each change of finger along a line to the crease near by.

    A line bends away at the sides of every finger: between two that touch its uppermost point in the image is the
    crease; where none is near, the line ends and is one finger's.
    """
    out = finger.copy()
    change = finger[1:] != finger[:-1]
    change &= (finger[1:] >= 0) & (finger[:-1] >= 0)
    change[runs.first[1:] - 1] = False
    for i in np.flatnonzero(change).tolist():
        of_line = int(np.searchsorted(runs.first, i, side="right"))
        end = int(runs.first[of_line]) if of_line < len(runs.first) else len(finger)
        begin = _climb(i, range(i - 1, int(runs.first[of_line - 1]) - 1, -1), runs.row, out == out[i])
        stop = _climb(i + 1, range(i + 2, end), runs.row, finger == finger[i + 1]) + 1
        top = begin + int(runs.row[begin:stop].argmin())
        if stop - top < SETTINGS.short:
            top = stop
        elif top - begin < SETTINGS.short:
            top = begin
        out[begin:top], out[top:stop] = out[i], finger[i + 1]
    return out


def _climb(start: int, along: range, row: Float, same: Bool) -> int:
    """Last run of a finger along a line: some columns, farther while it rises."""
    last = start
    for count, k in enumerate(along, 1):
        crease_px = 20  # columns on either side of a seam in which the crease may be
        if not (same[k] and (count < crease_px or row[k] < row[last])):
            break
        last = k
    return last


# Where the border lies, beyond where the skin over the MCP of a straight thumb is: bending it by 50 degrees takes the
# plane that halves its angle back by half a radius on the palm's side, and nowhere at its side. It is known no better
# than its bone (8 %, 3 mm), the device's shift (1 mm along the thumb) and turn (2.5 degrees at 6 cm).
_BORDER_M, _BORDER_SIGMA_M = -1.5e-3, 4e-3
# Middles of nine parts, alike in probability, of Student's t with three degrees of freedom: some hands are far off.
_T3 = np.array([-2.23, -1.15, -0.66, -0.31, 0.0, 0.31, 0.66, 1.15, 2.23])
_BORDERS_M: Float = _BORDER_M + _BORDER_SIGMA_M * _T3


def beyond_ball(runs: Runs, of_thumb: Int, beyond_m: Float) -> tuple[Float, float]:
    """Centroid offset (2,) of the thumb's part of a line, and its deviation [px].

    `of_thumb` (N,): runs on the thumb or its ball; `beyond_m` (N,): how far each is beyond the MCP's skin [m], from
    the thumb's root.
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
    if not seen.any():  # all of it on the ball: the thumb is nearest to what is farthest from the root
        return points[int(beyond_m.argmax())] - whole, float(np.ptp(points[:, 0]))
    off = (weights[seen, :, None] * points).sum(axis=1) / total[seen, None] - whole
    mean = off.mean(axis=0)
    # centroids lump at the whole line and at its end: 1.96 deviations of that hold less than 95 %
    tails = 1.5
    return mean, tails * float(np.sqrt(((off - mean) ** 2).mean(axis=0).max()))


# Standard deviations, by what the centroids of simulated hands of several seeds are off by.
_LINE_PX = 0.6  # one whole line
# a line no brighter: what is left of one where the sun saturates
_FAINT, _FAINT_PX = 3.0 * SETTINGS.floor, 5.0


@dataclass(frozen=True, slots=True, eq=False)
class LaserLines:
    """One laser segment per finger, thumb ... little; NaN where none was seen."""

    uv: Float  # (5, 2) centroids by length [px]
    sigma_px: Float  # (5,) standard deviation per axis
    length_px: Float  # (5,)


def laser_lines(laser: Image, fingers: Fingers, view: WristView, engine: Engine = NUMPY) -> LaserLines:
    """Find the segments in the difference of laser and ambient frame."""
    pose, flexed = fingers.palm_pose, not fingers.palm_pose.straight
    workspace = workspace_of(pose.view)
    runs, on_line = engine.lines(laser, workspace.first_row)
    if not len(runs.row):
        return LaserLines(np.full((5, 2), np.nan), np.full(5, np.nan), np.full(5, np.nan))
    points: Float = np.stack([runs.column, runs.row], axis=-1, dtype=np.float64)
    finger = fingers.finger_of(points)
    finger[~on_line] = NONE
    palm, palm_points = workspace.palm, workspace.before_palm(points, pose.T_camera_palm)
    beyond, place = palm.beyond_m(palm_points), palm.place(palm_points)
    finger = finger_labels(finger, runs, beyond, place, flexed=flexed)
    ball_m = -3e-3  # nearer there is no finger but the thumb
    finger[~(workspace.holds(finger, points) & ((finger == 0) | (beyond > ball_m)))] = NONE
    if flexed:  # then the palm may come into the plane
        finger[palm.surface(palm_points, place)] = NONE
    finger_lines = engine.measure(runs, finger, view.optics.width_px)
    uv, length = finger_lines.uv, finger_lines.line
    least_m = 2e-3  # of line that must be seen
    seen = length * workspace.metres_per_px(uv) >= least_m
    # at least, of a line in parts, some of which may be another's, or of one cut by the image
    in_parts_px = 2.0
    in_parts = np.where(
        np.isnan(finger_lines.split_px),
        np.where(finger_lines.cut, in_parts_px, 0.0),
        np.fmax(finger_lines.split_px, in_parts_px),
    )
    in_parts = np.where(finger_lines.brightest < _FAINT, np.maximum(_FAINT_PX, in_parts), in_parts)
    unshown_px = 0.0 if fingers.shown else 4.0  # no seam was seen
    sigma = np.sqrt(_LINE_PX**2 + in_parts**2 + unshown_px**2)
    if seen[0]:
        thumb = np.flatnonzero(finger == 0)
        off, extra_sigma = beyond_ball(runs, thumb, beyond[thumb])
        # Where the wrist is straight the thumb stands across the plane; a bent one can bring the ball there alone.
        seen[0] = not (flexed and float(np.median(beyond[thumb])) < _BORDER_M)
        uv[0] += off
        thumb_px = 1.5  # at least, of the thumb: its line runs into that of its ball
        sigma[0] = np.hypot(np.hypot(sigma[0], extra_sigma), thumb_px)
    uv[~seen], sigma[~seen], length[~seen] = np.nan, np.nan, np.nan
    return LaserLines(uv, sigma, length)
