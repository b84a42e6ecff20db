"""Fingertips in the LED image, by analysis and synthesis.

The laser gives a point of each finger's skin in space, and with it the abduction and one of the flexions: of the
finger's table (`postures`) few rows are left. Each predicts its samples' brightness; the scale of brightness comes
from the laser points too, whose distance is known. The best ones are where the end of the finger may be, and its
outline, measured at full resolution (`led_image`), determines which it is and where exactly.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import exp
from typing import NamedTuple, Self, TypeAlias

import cv2
import numpy as np

from common.arrays import Bool, Float, Float32, Image, Int
from slave.wrist.led_image import SETTINGS as OUTLINE
from slave.wrist.led_image import (
    SHRINK,
    Circles,
    WristView,
    circle_of,
    depth_about,
    fitted,
    led_optics,
    nearness,
    shrink,
)
from slave.wrist.postures import (
    ABOVE,
    APEX,
    BONES,
    DIRECTIONS,
    END,
    HIGHEST,
    Postures,
    plane_axes,
    postures_of,
)


class FingertipSettings(NamedTuple):
    """Numbers of the search for fingertips in the LED image."""

    least_near: float = 1.5  # roots of grey levels: noise
    most_abduction: float = 1.7  # of the outer two of the table
    # How far a posture may meet the laser from where it was seen: skin is off its cones.
    within_m: float = 4e-3
    sigma_m: float = 2.5e-3
    # where no posture is as near as that
    most_off_m: float = 15e-3
    spread_m: float = 3e-3
    # standard deviation across the fingers, and deviations allowed
    aside_m: float = 2.5e-3
    most_aside: float = 3.0
    far: int = 3  # of the samples above a finger: from there on they are far
    upwards: int = 6  # of directions
    unsure: float = 0.18  # of the outer abductions: less is one
    variant: float = 1.2  # deviations of the other two
    most_off: float = 0.35  # of the logarithm of a fingertip's nearness
    thumb_within_m: float = 12e-3
    thumb_sigma_m: float = 5e-3
    abduction_sigma: float = 0.5  # of the outer two
    own_sigma: float = 0.1  # of the logarithm of nearness on the finger
    own_most: float = 9.0  # squares of deviations that count
    scale_sigma: float = 0.12  # of that which all samples of a finger share
    # of a finger's nearness: what is beyond its end costs nothing, costs all
    darker: float = 0.65
    as_bright: float = 0.95
    # and of the root of that where the image is saturated
    above_most: float = 9.0
    above_unknown: float = 0.33
    # Above a folded finger, the same: what is lit there may be an object that hides the rest of an extended one.
    folded_darker: float = 0.15
    folded_as_bright: float = 0.35
    unknown_cost: float = 1.0  # of a sample outside of the image, saturated, or hidden by something
    hidden: float = -0.6  # logarithm of nearness of what hides skin
    hides: float = 8.0  # cost of such a thing before a finger: the thumb is before all that a hand grips
    side: float = 0.35  # cosine between outline and hidden skin, seen from the end: no outline shows there
    modes: int = 8  # places of a finger whose outlines are looked at
    mode_within: float = 24.0  # what they may cost more than the best
    separation: float = 0.4  # of the radius of a fingertip: places that differ
    unseen_cost: float = 30.0  # what an outline that is not seen at all costs
    # of the radius: how far a posture's outline may be from the seen one
    at_sigma: float = 0.35
    size_sigma: float = 0.12
    # how well an outline is seen, of the radius, and a laser point
    at_sure: float = 0.1
    laser_sure_m: float = 8e-4
    twist_sigma: float = 0.05  # rad: of the hinges of real fingers
    ends_within: float = 40.0  # of the best posture's cost: those whose ends are averaged
    correlated: float = 2.5  # samples that differ for one reason
    # Standard deviations: edges; of the radius, how far skin is off its cones, and where on its disk an end is
    # that faces the camera; and the residual at which they are twice as large.
    pixel: float = 0.7
    surface: float = 0.05
    pulp: float = 0.08
    cost_scale: float = 20.0
    # What is of other modules or follows from the above: the cache of machine code only knows its arguments.
    least_ratio: float = exp(-most_off)
    most_ratio: float = exp(most_off)
    end: int = END
    bones: int = BONES.stop
    highest: int = HIGHEST
    above: int = ABOVE.start
    apex: int = APEX
    shrink: int = SHRINK


SETTINGS = FingertipSettings()


@dataclass(frozen=True, slots=True, eq=False)
class Fingertips:
    """Of one LED image; NaN where no end of a finger is seen for sure."""

    uv: Float  # (5, 2) [px] ends of thumb, index ... little in the (distorted) image
    sigma_px: Float  # (5,) standard deviation
    depth: Float  # (5,) along the optical axis, in units of one constant for all five


NO_TIPS = Fingertips(np.full((5, 2), np.nan), np.full(5, np.nan), np.full(5, np.nan))


class LedImage(NamedTuple):
    """What samples are compared with, of the shrunken image."""

    near: Float32  # (h, w) nearness
    clipped: Bool  # (h, w) where it is a lower bound
    over: Float32  # (h, w) the most within `over_px` above

    @classmethod
    def of(cls, near: Float32, clipped: Bool) -> Self:
        """Of nearness and bound."""
        over_px = 100  # above a folded finger: how far a fingertip may be seen again beyond such an object
        rows = over_px // SHRINK
        column = np.ones((rows, 1), np.uint8)
        over = cv2.dilate(near, column, anchor=(0, rows - 1), borderType=cv2.BORDER_REPLICATE)
        return cls(near, clipped, np.asarray(over, np.float32))

    def at(self, uv: Float32) -> tuple[Float32, Bool, Bool]:
        """Nearness, bound and whether it is outside of the image, at pixels (..., 2)."""
        height, width = self.near.shape
        cell = ((uv + np.float32(0.5)) * np.float32(1.0 / SHRINK)).astype(np.int32)
        column, row = cell[..., 0], cell[..., 1]
        inside_column, inside_row = (
            np.minimum(np.maximum(column, 0), width - 1),
            np.minimum(np.maximum(row, 0), height - 1),
        )
        outside = (inside_column != column) | (inside_row != row)
        at = inside_row * width + inside_column
        return self.near.ravel()[at], self.clipped.ravel()[at], outside


@dataclass(frozen=True, slots=True, eq=False)
class Hypotheses:
    """N postures, finger by finger."""

    table: Postures
    rows: Int  # (N,) of the table
    finger: Int  # (N,)
    abduction: Float32  # (N,) by ABDUCTION_RAD
    aside: Float32  # (N,) how far the laser's point is beside where the posture has it [m]
    uv: Float32  # (N, SAMPLES, 2) [px]
    cost: Float32  # (N,) of the laser measurement


def allowed(table: Postures, plane: Float32) -> tuple[Int, Float32, Float32, Float32]:
    """Return the table rows that meet the laser about where each finger does.

    `plane`: the fingers' points (5, 2) [m]. Returns also the `abduction`, `aside` and `cost` of the rows. The
    abduction is by Bayes' rule: of a finger that is bent up at its knuckle the laser measures little, and rows come
    in three abductions.
    """
    x, z = plane[1:, :1], plane[1:, 1:]
    (x0, z0), (x1, z1), (x2, z2) = table.laser
    gain = x1 * np.float32(1.0 / SETTINGS.aside_m**2)
    known = gain * x1
    known += np.float32(1.0 / SETTINGS.abduction_sigma**2)
    gain /= known
    aside = x - x0
    share = aside * gain
    share = (aside - x2 * share * share) * gain
    off = np.abs(z0 + share * (z1 + share * z2) - z)
    aside -= share * (x1 + share * x2)
    aside *= np.float32(1.0 / SETTINGS.aside_m)
    off[~((np.abs(share) < SETTINGS.most_abduction) & (np.abs(aside) < SETTINGS.most_aside))] = np.inf
    least = np.fmin.reduce(off, axis=1, keepdims=True, initial=np.inf)
    least[~(least < SETTINGS.most_off_m)] = -np.inf  # nothing is as near as that
    rows = np.flatnonzero(off < np.maximum(SETTINGS.within_m, least + SETTINGS.spread_m) * (least >= 0.0))
    share, aside = share.ravel()[rows], aside.ravel()[rows]
    off = (off - least).ravel()[rows] * np.float32(1.0 / SETTINGS.sigma_m)
    cost = off * off + (share * np.float32(1.0 / SETTINGS.abduction_sigma)) ** 2 + aside * aside
    spread = np.float32(SETTINGS.variant) / np.sqrt(known.ravel()[rows])
    wide = np.flatnonzero(spread > SETTINGS.variant * SETTINGS.unsure)
    more = cost[wide] + np.float32(SETTINGS.variant**2)
    spread = spread[wide]
    aside *= np.float32(SETTINGS.aside_m)
    moved = spread * x1.ravel()[rows[wide]]
    off = table.thumb_laser - plane[0, :, None]
    square = off[0] ** 2 + off[1] ** 2
    thumb = np.flatnonzero(square < SETTINGS.thumb_within_m**2)
    rows += table.thumb
    return (
        np.concatenate([thumb, rows, rows[wide], rows[wide]]),
        np.concatenate([np.zeros(len(thumb), np.float32), share, share[wide] + spread, share[wide] - spread]),
        np.concatenate([np.zeros(len(thumb), np.float32), aside, aside[wide] - moved, aside[wide] + moved]),
        np.concatenate([square[thumb] * np.float32(1.0 / SETTINGS.thumb_sigma_m**2), cost, more, more]),
    )


def on_plane(laser_m: Float, view: WristView) -> Float32:
    """Laser points (5, 3) [m] in the coordinates of the laser's plane (5, 2) [m]."""
    return (laser_m @ plane_axes(view).T).astype(np.float32)


def hypotheses(laser_m: Float, image: LedImage, gain: float, view: WristView) -> Hypotheses | None:
    """Postures that the laser points (5, 3) [m] and the tips' brightness allow."""
    table = postures_of(view)
    rows, share, aside, cost = allowed(table, on_plane(laser_m, view))
    seen, bound, outside = image.at(_at(table.middle[rows], share))
    off = _logarithm(seen, table.near[rows, END] * np.float32(gain), bound)
    kept = np.flatnonzero((np.abs(off) < SETTINGS.most_off) & ~outside)
    if not len(kept):
        return None
    kept = kept[np.argsort(rows[kept], kind="stable")]
    rows, share = rows[kept], share[kept]
    finger = np.maximum((rows - table.thumb) // table.laser.shape[-1] + 1, 0)
    return Hypotheses(table, rows, finger, share, aside[kept], _at(table.uv[rows], share), cost[kept])


def _at(parabola: Float32, share: Float32) -> Float32:
    """Values (N, ...) of parabolas (N, 3, ...) at abductions (N,)."""
    by = share.reshape(-1, *[1] * (parabola.ndim - 2))
    out = parabola[:, 2] * by
    out += parabola[:, 1]
    out *= by
    out += parabola[:, 0]
    return out


def _logarithm(seen: Float32, predicted: Float32, bound: Bool) -> Float32:
    """Return the logarithm of seen over predicted nearness, 0 or more at a `bound`."""
    off = np.log(np.maximum(seen, SETTINGS.least_near) / np.maximum(predicted, np.float32(0.1)))
    np.maximum(off, 0.0, out=off, where=bound)
    return off


def costs(some: Hypotheses, image: LedImage, gain: float) -> Float32:
    """Return minus twice the log likelihood (N,) of hypotheses by laser and samples."""
    seen, bound, outside = image.at(some.uv[:, :APEX])
    predicted = some.table.near[some.rows] * np.float32(gain)
    off = _logarithm(seen[:, BONES], predicted[:, BONES], bound[:, BONES])
    unknown = bound[:, BONES] | outside[:, BONES]
    hidden = (off < SETTINGS.hidden) & ~unknown & (some.finger > 0)[:, None]
    off[hidden] = 0.0
    most = np.float32(3.0 * SETTINGS.own_sigma + SETTINGS.scale_sigma)
    count = off.shape[1]
    weight = np.float32(1.0 / (count + (SETTINGS.own_sigma / SETTINGS.scale_sigma) ** 2))
    scale = weight * np.minimum(np.maximum(off, -most), most).sum(axis=1)
    square = ((off - scale[:, None]) * np.float32(1.0 / SETTINGS.own_sigma)) ** 2
    np.minimum(square, SETTINGS.own_most, out=square)
    np.maximum(square, SETTINGS.unknown_cost, out=square, where=bound[:, BONES])
    square[outside[:, BONES] | hidden] = SETTINGS.unknown_cost
    cost = some.cost + square.sum(axis=1) + (scale * np.float32(1.0 / SETTINGS.scale_sigma)) ** 2
    cost += np.float32(SETTINGS.hides) * hidden.any(axis=1)
    # Above the finger.
    folded = some.table.open[some.rows, SETTINGS.upwards] == 0.0
    seen, bound, outside = seen[:, ABOVE], bound[:, ABOVE], outside[:, ABOVE]
    over = image._replace(near=image.over)
    seen[folded, SETTINGS.far :] = over.at(some.uv[folded, ABOVE][:, SETTINGS.far :])[0]
    darker, as_bright = (
        np.where(folded, np.float32(a), np.float32(b))[:, None]
        for a, b in (
            (SETTINGS.folded_darker, SETTINGS.darker),
            (SETTINGS.folded_as_bright, SETTINGS.as_bright),
        )
    )
    bright = seen / np.maximum(predicted[:, HIGHEST, None], np.float32(0.1))
    bright = np.minimum(np.maximum((bright - darker) / (as_bright - darker), 0.0), 1.0)
    bright[bound] = SETTINGS.above_unknown
    bright[outside | (predicted[:, ABOVE] > 0.0)] = 0.0
    return cost + np.float32(SETTINGS.above_most) * (bright * bright).sum(axis=1)


def modes(some: Hypotheses, cost: Float32) -> Int:
    """The best hypotheses (M,) of each finger at places that differ, best first."""
    first = np.flatnonzero(np.diff(some.finger, prepend=-1))
    least = np.repeat(np.minimum.reduceat(cost, first), np.diff(first, append=len(cost)))
    more = cost - least
    good = np.flatnonzero(more < SETTINGS.mode_within)
    order = good[np.argsort(more[good])]
    u, v = some.uv[order, END].T.tolist()
    near = (SETTINGS.separation * some.table.end[some.rows[order], 0]).tolist()
    out: list[int] = []
    kept: tuple[list[tuple[float, float, float]], ...] = ([], [], [], [], [])
    for k, finger, x, y, r in zip(order.tolist(), some.finger[order].tolist(), u, v, near, strict=True):
        others = kept[int(finger)]
        if len(others) == SETTINGS.modes:
            continue
        if all((x - a) ** 2 + (y - b) ** 2 >= least for a, b, least in others):
            others.append((x, y, r * r))
            out.append(k)
    return np.array(out, np.int64)


class Ends(NamedTuple):
    """The most likely end of each of K fingers."""

    finger: Int  # (K,)
    circle: Circles  # the outline about it
    residual: Float  # (K,) minus twice the logarithm of its likelihood, by samples and outline
    towards: Float  # (K, 2) from the middle of the outline, in radii
    spread: Float  # (K,) in radii
    facing: Float  # (K,) how much it faces the camera
    seen: Float  # (K,) probability that the finger itself leaves it to be seen


Search: TypeAlias = Callable[[Image, LedImage, Float, WristView], Ends | None]


def candidates(led: Image, image: LedImage, laser_uv: Float, view: WristView) -> Ends | None:
    """Most likely end of each finger whose laser point is known; None: of none."""
    laser_m = view.on_plane(laser_uv)
    gain = light_scale(image, laser_uv, laser_m)
    if gain is None or (some := hypotheses(laser_m, image, gain, view)) is None:
        return None
    cost = costs(some, image, gain)
    best = modes(some, cost)
    finger, rows = some.finger[best], some.rows[best]
    outline = np.repeat(_open(some, best, image, gain), OUTLINE.directions // DIRECTIONS, axis=1)
    circle = fitted(led, some.uv[best, END], some.table.end[rows, 0], outline)
    circle = fitted(led, circle.middle, circle.radius, outline)
    residual = cost[best] + SETTINGS.unseen_cost * (1.0 - circle.shown)
    residual += _outline_cost(some.uv[best, END], some.table.end[rows, 0], circle.middle, circle.radius)
    order = np.lexsort((residual, finger))
    chosen = order[np.append(True, finger[order[1:]] != finger[order[:-1]])]
    circle, finger = Circles(*(each[chosen] for each in circle)), finger[chosen]
    return Ends(finger, circle, residual[chosen], *_mean_ends(some, cost, finger, circle))


def _open(some: Hypotheses, which: Int, image: LedImage, gain: float) -> Float32:
    """Return `open` (M, DIRECTIONS), cleared where something hides the finger there."""
    open_, uv = some.table.open[some.rows[which]], some.uv[which]
    seen, bound, outside = image.at(uv[:, BONES])
    off = _logarithm(seen, some.table.near[some.rows[which], BONES] * np.float32(gain), bound)
    hidden = (off < SETTINGS.hidden) & ~bound & ~outside
    way = uv[:, BONES] - uv[:, END, None]
    along = way @ circle_of(DIRECTIONS).T
    towards = hidden[..., None] & (along > SETTINGS.side * np.linalg.norm(way, axis=-1)[..., None])
    return np.where(towards.any(axis=1), np.float32(0.0), open_)


def _outline_cost(at: Float32, size: Float32, middle: Float, radius: Float) -> Float:
    """Return the cost of circles (N, 2), (N,) [px] that differ from the postures."""
    off = (middle - at) / (SETTINGS.at_sigma * radius)[:, None]
    return np.vecdot(off, off) + (np.log(size / radius) * (1.0 / SETTINGS.size_sigma)) ** 2


def _mean_ends(
    some: Hypotheses, cost: Float32, finger: Int, circle: Circles
) -> tuple[Float, Float, Float, Float]:
    """The last four of `Ends`: means by likelihood, given the circles."""
    least = np.full(5, np.inf)
    first = np.flatnonzero(np.diff(some.finger, prepend=-1))
    least[some.finger[first]] = np.minimum.reduceat(cost, first)
    near = np.flatnonzero(cost < least[some.finger] + SETTINGS.ends_within)
    row = np.zeros(5, np.int64)
    row[finger] = np.arange(len(finger))
    of = row[some.finger[near]]
    end, uv, radius = some.table.end[some.rows[near]], some.uv[near], circle.radius[of]
    square = cost[near] + _outline_cost(uv[:, END], end[:, 0], circle.middle[of], radius)
    sigma = SETTINGS.at_sure + circle.sigma_px / circle.radius
    first = np.searchsorted(of, np.arange(len(finger)))
    weight = np.exp((np.minimum.reduceat(square, first)[of] - square) * (0.5 / SETTINGS.correlated))
    what = np.empty((len(of), 6))
    what[:, 0] = 1.0
    rotated = _rotated(some, near, (circle.middle[of] - uv[:, END]) / radius[:, None], sigma[of])
    what[:, 1:3] = way = (uv[:, APEX] - uv[:, END]) / end[:, :1] + rotated
    what[:, 3] = way[:, 0] ** 2 + way[:, 1] ** 2
    what[:, 4:] = end[:, 1:]
    sums = np.add.reduceat(what * weight[:, None], first)
    mean = sums[:, 1:] / sums[:, :1]
    variance = mean[:, 2] - mean[:, 0] ** 2 - mean[:, 1] ** 2
    return mean[:, :2], np.sqrt(np.maximum(0.5 * variance, 0.0)), mean[:, 3], mean[:, 4]


def _rotated(some: Hypotheses, which: Int, off: Float, sigma: Float) -> Float:
    """Return the rotation of ends (M, 2) about the middles of outlines.

    The outlines lie `off` (M, 2) by `sigma` (M,), in radii: for abduction, which the laser measures, or a twist.
    """
    table, rows, by = some.table, some.rows[which], some.abduction[which]
    radius = table.end[rows, :1].astype(np.float64)
    uv, laser = table.uv[rows], np.zeros((2, len(rows)))
    finger = rows >= table.thumb
    across = table.laser[:, 0].reshape(3, -1)[:, rows[finger] - table.thumb]
    laser[0, finger] = across[1] + 2.0 * by[finger] * across[2]
    laser[1] = table.twist[rows, 4]
    laser *= 1.0 / SETTINGS.laser_sure_m
    moved = uv[:, 1] + (2.0 * by)[:, None, None] * uv[:, 2]
    at = np.stack([moved[:, END], table.twist[rows, :2]]) / radius
    tip = np.stack([moved[:, APEX], table.twist[rows, 2:4]]) / radius
    sure = sigma**-2
    a = sure * np.vecdot(at[0], at[0]) + laser[0] ** 2 + SETTINGS.abduction_sigma**-2
    b = sure * np.vecdot(at[0], at[1]) + laser[0] * laser[1]
    c = sure * np.vecdot(at[1], at[1]) + laser[1] ** 2 + SETTINGS.twist_sigma**-2
    aside = some.aside[which] * (1.0 / SETTINGS.laser_sure_m)
    p = sure * np.vecdot(at[0], off) + laser[0] * aside - by * SETTINGS.abduction_sigma**-2
    q = sure * np.vecdot(at[1], off) + laser[1] * aside
    scale = 1.0 / (a * c - b * b)
    abduction, twist = (c * p - b * q) * scale, (a * q - b * p) * scale
    return abduction[:, None] * (tip[0] - at[0]) + twist[:, None] * (tip[1] - at[1])


def light_scale(image: LedImage, laser_uv: Float, laser_m: Float) -> float | None:
    """Nearness at 1 m facing the camera [grey levels^0.5], by laser points, or None."""
    known = np.isfinite(laser_m[:, 0])
    near, clipped, outside = image.at(laser_uv[known].astype(np.float32))
    good = ~clipped & ~outside & (near > SETTINGS.least_near)
    if not good.any():
        return None
    distance = np.sqrt((laser_m[known][good] ** 2).sum(axis=1))
    shade = 0.96  # of the light of skin that faces the camera: what a finger returns at its laser point
    return float(np.median(near[good] * distance)) / shade


def fingertips(
    led: Image, frame: Image, laser_uv: Float, view: WristView, search: Search = candidates
) -> Fingertips:
    """Find them in one LED image.

    `led`: (H, W) less the ambient frame; `frame`: the LED frame itself, which shows where it is saturated;
    `laser_uv`: (5, 2) where the laser meets the fingers [px], NaN: not seen, then no tip is sought; `view`: the wrist
    is straight.
    """
    optics = led_optics(view)
    near = nearness(shrink(led), optics)
    clipped = 247  # grey levels of the LED frame, from which a sample may be brighter than it looks
    image = LedImage.of(near, frame[1::SHRINK, 1::SHRINK] > clipped)
    ends = search(led, image, laser_uv, view)
    if ends is None:
        return NO_TIPS
    circle, residual = ends.circle, ends.residual
    uv = circle.middle + ends.towards * circle.radius[:, None]
    of_spread = 0.6  # postures that are possible differ by more than the mean of them is off
    surface = circle.radius * np.sqrt(
        SETTINGS.surface**2
        + (SETTINGS.pulp * np.maximum(ends.facing, 0.0)) ** 2
        + (of_spread * ends.spread) ** 2
    )
    sigma = np.sqrt(SETTINGS.pixel**2 + surface**2 + circle.sigma_px**2) * (
        1.0 + residual / SETTINGS.cost_scale
    )
    least_shown = np.where(ends.finger == 0, 0.75, 0.6)  # the thumb's four angles are searched less finely
    most_residual, likely = 32.0, 0.4  # of one that is less likely to be seen in proportion
    good = (circle.shown > least_shown) & (residual < most_residual * np.minimum(ends.seen / likely, 1.0))
    out = Fingertips(np.full((5, 2), np.nan), np.full(5, np.nan), np.full(5, np.nan))
    for k in np.flatnonzero(good).tolist():
        finger = int(ends.finger[k])
        u, v = map(float, uv[k])
        depth = depth_about(near, optics, u, v, float(circle.radius[k]))
        if np.isfinite(depth):
            out.uv[finger], out.sigma_px[finger], out.depth[finger] = uv[k], sigma[k], depth
    return out
