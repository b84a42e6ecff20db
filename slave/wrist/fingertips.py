"""Fingertips in the LED image: templates of bent fingers against what is seen along each finger (D15).

The profile of nearness along each finger (`spines`) is compared with those of all its bends (`tip_bends`). From that
comes where the end of the finger lies between the edges that are seen, the contour above and the step below, whose
places are then measured at full resolution (`tip_ends`); and how likely that end is seen at all. A finger that points
away ends behind its own horizon, one that is folded shows its back: no tip is reported.

The thumb is one more finger, read along its own way (`strips`). It shows its end where it is raised off the palm. Where
its seam cuts it, neither half has an end that could be told from a finger's.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Float, Image
from slave.wrist.fingers import Fingers
from slave.wrist.half_spheres import half_spheres
from slave.wrist.led_depth import SHRINK, Float32, LedOptics, depth_about, led_optics, nearness, shrink
from slave.wrist.spines import borders, spines
from slave.wrist.strips import ROW_PX, THUMB, Strips, strips_of
from slave.wrist.tip_bends import Bend, bends_of, palm_gain, profiles
from slave.wrist.tip_ends import BEFORE_END, LEAST_FACING, End, edges, full_profile, through_end
from slave.wrist.tip_templates import templates_of
from slave.wrist.view import WristView

LEAST_SEEN = 0.6  # probability that the end of the finger is seen
FOLDED_SEEN = 0.8  # where it points at the palm: nails differ more than pads, and hide it or do not
THUMB_SEEN = 0.65  # of the thumb: its side is before the camera, its end mostly just beyond the horizon
THUMB_LIKENESS = 0.995  # where nothing is before it, it is broad and plain
MOST_SIGMA = 0.5  # of a fingertip's radius
LEAST_LIKENESS = 0.985  # a finger behind another or behind the thumb looks like none of the templates
LEAST = (THUMB_SEEN, THUMB_LIKENESS), (LEAST_SEEN, LEAST_LIKENESS)
VALLEY = 0.85  # of the nearness of the thumb: a seam beside it is darker
SAME_SKIN = 0.85  # of the nearness of the thumb: as near as its rest
LAST_BONE = 4.5  # of the thumb's radius: how far its end can be from where a seam cuts it at the last joint


@dataclass(frozen=True, slots=True, eq=False)
class Fingertips:
    """Of one LED image; NaN where no end of a finger is seen for sure.

    Attributes:
        uv: (5, 2) [px] where the ends of thumb, index ... little are in the (distorted) image.
        sigma_px: (5,) standard deviation.
        depth: (5,) relative depth along the optical axis, in units of one constant for all five.
    """

    uv: Float
    sigma_px: Float
    depth: Float


def fingertips(led: Image, fingers: Fingers, view: WristView) -> Fingertips:
    """Find them in the difference of LED and ambient frame (H, W)."""
    optics, bank, strips = led_optics(view), templates_of(view), strips_of(view)
    near = nearness(shrink(led), optics)
    uv, sigma, depth = np.full((5, 2), np.nan), np.full(5, np.nan), np.full(5, np.nan)
    gain = palm_gain(near, bank)
    if gain is None:
        return Fingertips(uv, sigma, depth)
    border, strip = borders(fingers, view), strips.beside(near)
    lines = spines(strip, border, bank.unit.shape[2])
    seen = profiles(strip, lines, border, bank)
    bends = bends_of(seen, bank, gain)
    thumb = bends[THUMB]
    cut = None if thumb is None else cut_off(strip, lines[THUMB], border[THUMB, 0], strips, thumb)
    ends: list[End] = []
    for k, bend in enumerate(bends):
        least_seen, least_likeness = LEAST[min(k, 1)]
        if bend is not None and bend.down:
            least_seen = FOLDED_SEEN
        if bend is None or bend.seen < least_seen or bend.likeness < least_likeness:
            continue
        if k != THUMB or cut is None:
            line = through_end(lines[k, : int(bank.rows[k])], bend)
            ends += edges(k, *full_profile(led, line, k, strips), bend)
    for end, middle in zip(ends, _middles(ends, near, optics, strips), strict=True):
        at, spread = end.place(middle)
        k, radius = end.finger, end.bend.radius_px
        low, high = border[k, :, min(max(int(at[1]) // ROW_PX, 0), border.shape[2] - 1)].tolist()
        if spread > MOST_SIGMA * radius or not low <= (at[0] - 0.5 * (SHRINK - 1)) / SHRINK <= high:
            continue
        found = strips.to_image(k, np.array(at))
        if thumb is not None and cut is not None:
            beside = float(np.hypot(*(found - cut))) < LAST_BONE * thumb.radius_px
            if beside and float(seen[k].max()) > SAME_SKIN * float(seen[THUMB].max()):
                continue
        uv[k], sigma[k] = found, spread
        depth[k] = depth_about(near, optics, float(found[0]), float(found[1]), radius)
    return Fingertips(uv, sigma, depth)


def _middles(ends: list["End"], near: Float32, optics: LedOptics, strips: Strips) -> list[Float | None]:
    """The middles (2,) of those fingertips that are seen whole, in their strips; None of the others."""
    out: list[Float | None] = [None] * len(ends)
    facing = [k for k, end in enumerate(ends) if end.bend.facing > LEAST_FACING]
    if facing:
        guess = np.array([strips.to_image(ends[k].finger, np.array(ends[k].middle)) for k in facing])
        centres = half_spheres(near, optics, guess, np.array([ends[k].bend.radius_px for k in facing]))
        for k, centre in zip(facing, centres, strict=True):
            if np.isfinite(centre[0]):
                out[k] = strips.of_image(ends[k].finger, centre)
    return out


def cut_off(strip: Float32, line: Float, seam: Float32, strips: Strips, bend: Bend) -> Float | None:
    """Where (2,) [px] the thumb ends if its seam runs over bright skin there: its rest lies with other fingers."""
    rows = [int((bend.top_v + share * bend.radius_px) / ROW_PX) for share in BEFORE_END]
    low, high = (min(max(row, 0), len(line) - 1) for row in rows)
    first, last = int(strips.first_u) // SHRINK, strip.shape[1] - 1
    column = np.rint(seam[low : high + 1]).astype(np.int64)
    light, row = strip[low : high + 1], np.arange(high + 1 - low)
    across = np.minimum(light[row, column.clip(first, last)], light[row, (column - 1).clip(first, last)])
    bright = across > VALLEY * light[:, first:].max(axis=1)
    if not (bright & (column > first) & (column <= last)).any():
        return None
    return strips.to_image(THUMB, np.array([line[low] * SHRINK, low * ROW_PX]))
