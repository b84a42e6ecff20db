"""Fingertips in the LED image: templates of bent fingers against what is seen along each finger (D15).

The profile of nearness along each finger (`spines`) is compared with those of all its bends (`tip_bends`). From that
comes where the end of the finger lies between the edges that are seen, the contour above and the step below, whose
places are then measured at full resolution (`tip_ends`); and how likely that end is seen at all. A finger that points
away ends behind its own horizon, one that is folded shows its back: no tip is reported. Nor is one of a bent wrist,
which turns fingers before the camera in ways that no template has.

The thumb is one more finger, read along its own way (`strips`). It shows its end where it is raised off the palm. Where
a seam runs over skin and not through a crease, it cuts a finger, mostly the thumb before others: what lies beside it
there is a part of something, and no finger is given its end.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float, Image
from slave.wrist.fingers import Fingers
from slave.wrist.half_spheres import half_spheres
from slave.wrist.led_depth import SHRINK, Float32, LedOptics, depth_about, led_optics, nearness, shrink
from slave.wrist.spines import borders, spines
from slave.wrist.strips import ROW_PX, THUMB, Strips, strips_of
from slave.wrist.tip_bends import Bend, bends_of, palm_gain, profiles
from slave.wrist.tip_ends import LEAST_FACING, End, edges, full_profile, through_end
from slave.wrist.tip_templates import templates_of
from slave.wrist.view import WristView

LEAST_SEEN = 0.65  # probability that the end of the finger is seen
# Of thumb and fingers: where nothing is before it, the thumb is broad and plain; a finger behind another or behind the
# thumb looks like none of the templates.
LEAST_LIKENESS = 0.995, 0.985
MOST_SIGMA = 0.5  # of a fingertip's radius
VALLEY = 0.85  # of the nearness of a finger: a crease beside it is darker
LAST_BONE = 1.0, 3.5  # of a fingertip's radius above its end and below: where its sides are looked at
CUT = (
    2,
    4,
)  # stations of thumb and finger there with skin at a side: a cut, not a spot where two fingers touch


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
    uv, sigma, depth = np.full((5, 2), np.nan), np.full(5, np.nan), np.full(5, np.nan)
    if not fingers.turn.straight:
        return Fingertips(uv, sigma, depth)
    optics, bank, strips = led_optics(view), templates_of(view), strips_of(view)
    near = nearness(shrink(led), optics)
    gain = palm_gain(near, bank)
    if gain is None:
        return Fingertips(uv, sigma, depth)
    border, strip = borders(fingers, view), strips.beside(near)
    lines = spines(strip, border, bank.unit.shape[2])
    seen = profiles(strip, lines, border, bank)
    bends = bends_of(seen, bank, gain)
    skin = over_skin(strip, border, seen, strips)
    ends: list[End] = []
    for k, bend in enumerate(bends):
        if bend is None or bend.seen < LEAST_SEEN or bend.likeness < LEAST_LIKENESS[min(k, 1)]:
            continue
        line = through_end(lines[k, : int(bank.rows[k])], bend)
        ends += edges(k, *full_profile(led, line, k, strips), bend)
    for end, middle in zip(ends, _middles(ends, near, optics, strips), strict=True):
        at, spread = end.place(middle)
        k, radius = end.finger, end.bend.radius_px
        low, high = border[k, :, min(max(int(at[1]) // ROW_PX, 0), border.shape[2] - 1)].tolist()
        if spread > MOST_SIGMA * radius or not low <= (at[0] - 0.5 * (SHRINK - 1)) / SHRINK <= high:
            continue
        last = _last_bone(end.bend, at[1])
        if not seen[k, last].any() or np.count_nonzero(skin[k, last]) >= CUT[min(k, 1)]:
            continue
        found = strips.to_image(k, np.array(at))
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


def _last_bone(bend: Bend, v: float) -> slice:
    """The stations of a finger's last bone, whose end is at row v."""
    above, below = (LAST_BONE[1], 0.0) if bend.down else LAST_BONE
    first, last = (max(int((v + x * bend.radius_px) / ROW_PX), 0) for x in (-above, below))
    return slice(first, last + 1)


def over_skin(strip: Float32, border: Float32, seen: Float32, strips: Strips) -> Bool:
    """At which stations (5, R) a finger is as near at one of its borders as in its middle.

    Args:
        strip: (R or more, columns) nearness of the strips.
        border: (5, 2, R or more) columns between which the fingers are.
        seen: (5, R) their profiles.
        strips: Whose.
    """
    rows, width, first = seen.shape[1], strip.shape[1], int(strips.first_u) // SHRINK
    low, high = np.full((5, 1, 1), 1), np.full((5, 1, 1), first - 2)
    low[THUMB], high[THUMB] = first + 1, width - 2
    column = np.rint(border[..., :rows]).astype(np.int64)
    inside = (column >= low) & (column <= high)
    at = column.clip(low, high) + np.arange(rows, dtype=np.int64) * width
    flat = strip.ravel()
    beside = np.minimum(np.minimum(flat[at - 1], flat[at]), flat[at + 1])
    skin: Bool = (beside > VALLEY * seen[:, None]) & inside & (seen[:, None] > 0.0)
    return skin[:, 0] | skin[:, 1]
