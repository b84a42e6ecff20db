"""Search for fingertips as machine code by numba.

What it makes is what `fingertips.candidates` makes, but for sums added up in another order.
"""

import math
from typing import NamedTuple

import numpy as np

from common.arrays import Float, Float32, Image, Int
from slave.markers.fast_compile import compiled
from slave.wrist import fingertips, led_image, postures
from slave.wrist.fingertips import Ends, FingertipSettings, LedImage, light_scale, on_plane
from slave.wrist.led_image import Circles, OutlineSettings, WristView
from slave.wrist.postures import Postures, postures_of

_COLUMNS = 11  # of what is found of a finger


class _Found(NamedTuple):
    """N hypotheses, as `fingertips.Hypotheses`; `at`: middle and end of tips (N, 4)."""

    row: Float
    abduction: Float
    aside: Float
    cost: Float
    at: Float


def candidates(led: Image, image: LedImage, laser_uv: Float, view: WristView) -> Ends | None:
    """As `fingertips.candidates`."""
    laser_m = view.on_plane(laser_uv)
    gain = light_scale(image, laser_uv, laser_m)
    if gain is None:
        return None
    out = np.full((5, _COLUMNS), np.nan)
    table = postures_of(view)
    _search(led, image, on_plane(laser_m, view), gain, table, fingertips.SETTINGS, led_image.SETTINGS, out)
    finger = np.flatnonzero(np.isfinite(out[:, 0]))
    if not len(finger):
        return None
    x, y, radius, sigma, shown, residual, *ends = out[finger].T
    circle = Circles(np.stack([x, y], axis=-1), radius, sigma, shown)
    return Ends(finger, circle, residual, np.stack(ends[:2], axis=-1), *ends[2:])


def prepare() -> None:
    """Compile the search, on an image that shows nothing."""
    some = np.zeros((1, 3, postures.SAMPLES, 2), np.float32)
    near, laser = np.zeros((1, postures.APEX), np.float32), np.zeros((3, 2, 4, 0), np.float32)
    whole = some[:, :, 0].copy(), near, np.zeros((2, 1), np.float32), laser
    ends = (np.zeros((1, of), np.float32) for of in (postures.DIRECTIONS, 3, 5))
    table = Postures(1, some, *whole, *ends)
    image = LedImage.of(np.zeros((1, 1), np.float32), np.zeros((1, 1), np.bool_))
    out, plane = np.empty((5, _COLUMNS)), np.full((5, 2), np.nan, np.float32)
    _search(
        np.zeros((1, 1), np.uint8), image, plane, 1.0, table, fingertips.SETTINGS, led_image.SETTINGS, out
    )


@compiled
def _search(
    led: Image,
    image: LedImage,
    plane: Float32,
    gain: float,
    table: Postures,
    limits: FingertipSettings,
    edges: OutlineSettings,
    out: Float,
) -> None:
    """Search each fingertip: outline, residual, `Ends`; NaN: no posture fits."""
    length = table.laser.shape[3]
    variants = 3  # abductions of a row
    most = variants * length
    found = _Found(np.empty(most), np.empty(most), np.empty(most), np.empty(most), np.empty((most, 4)))
    circle, best = np.empty(5), np.empty(5)
    which = np.empty(limits.modes, np.int64)
    open_ = np.empty(table.open.shape[1], np.float32)
    for finger in range(5):
        if finger == 0:
            count = _thumbs(image, plane, gain, table, limits, found)
        else:
            count = _postures(image, plane, gain, table, limits, finger, found)
        least = np.inf
        for mode in range(_modes(found, count, table, limits, which)):
            k = which[mode]
            row = int(found.row[k])
            circle[0], circle[1] = found.at[k, 0], found.at[k, 1]
            circle[2] = table.end[row, 0]
            _open(image, gain, table, row, float(found.abduction[k]), limits, open_)
            for _ in range(2):
                _fit(led, circle, open_, edges)
            residual = found.cost[k] + limits.unseen_cost * (1.0 - circle[4])
            residual += _outline_cost(found, k, table, limits, circle)
            if residual < least:
                least = residual
                best[:] = circle
        if least < np.inf:
            out[finger, :5], out[finger, 5] = best, least
            _ends(found, count, table, limits, best, out[finger, 6:])


@compiled
def _postures(
    image: LedImage,
    plane: Float32,
    gain: float,
    table: Postures,
    limits: FingertipSettings,
    finger: int,
    found: _Found,
) -> int:
    """Collect postures of index ... little that match laser and brightness."""
    length = table.laser.shape[3]
    off, share, lateral, known = np.empty(length), np.empty(length), np.empty(length), np.empty(length)
    sure, typical, per_m = limits.aside_m**-2, limits.abduction_sigma**-2, 1.0 / limits.aside_m
    least = np.inf
    laser = table.laser[:, :, finger - 1]
    for k in range(length):
        x1, x2 = laser[1, 0, k], laser[2, 0, k]
        x, z = plane[finger, 0] - laser[0, 0, k], plane[finger, 1] - laser[0, 1, k]
        known[k] = x1 * x1 * sure + typical
        to = x1 * sure / known[k]
        by = x * to
        by = (x - x2 * by * by) * to
        share[k] = by
        lateral[k] = (x - by * (x1 + by * x2)) * per_m
        off[k] = np.inf
        if abs(by) < limits.most_abduction and abs(lateral[k]) < limits.most_aside:
            off[k] = abs(by * (laser[1, 1, k] + by * laser[2, 1, k]) - z)
            if off[k] < least:
                least = off[k]
    count = 0
    if not least < limits.most_off_m:
        return count
    within = max(limits.within_m, least + limits.spread_m)
    first = table.thumb + (finger - 1) * length
    for k in range(length):
        if not off[k] < within:
            continue
        cost = (
            ((off[k] - least) / limits.sigma_m) ** 2
            + (share[k] / limits.abduction_sigma) ** 2
            + lateral[k] ** 2
        )
        aside = lateral[k] * limits.aside_m
        count = _take(image, gain, table, limits, first + k, share[k], aside, cost, found, count)
        spread = limits.variant / math.sqrt(known[k])
        if spread > limits.variant * limits.unsure:
            cost += limits.variant**2
            moved = spread * laser[1, 0, k]
            count = _take(
                image, gain, table, limits, first + k, share[k] + spread, aside - moved, cost, found, count
            )
            count = _take(
                image, gain, table, limits, first + k, share[k] - spread, aside + moved, cost, found, count
            )
    return count


@compiled
def _thumbs(
    image: LedImage, plane: Float32, gain: float, table: Postures, limits: FingertipSettings, found: _Found
) -> int:
    count = 0
    for row in range(table.thumb):
        x, z = table.thumb_laser[0, row] - plane[0, 0], table.thumb_laser[1, row] - plane[0, 1]
        square = x * x + z * z
        if square < limits.thumb_within_m**2:
            cost = square / limits.thumb_sigma_m**2
            count = _take(image, gain, table, limits, row, 0.0, 0.0, cost, found, count)
    return count


@compiled
def _along(parabola: Float32, by: float) -> tuple[float, float]:
    """A pixel by its parabola (3, 2) in the abduction."""
    return (
        parabola[0, 0] + by * (parabola[1, 0] + by * parabola[2, 0]),
        parabola[0, 1] + by * (parabola[1, 1] + by * parabola[2, 1]),
    )


@compiled
def _cell(image: LedImage, u: float, v: float, shrink: int) -> tuple[int, int, bool]:
    """Row and column of a pixel, and whether it is outside of the image."""
    height, width = image.near.shape
    column, row = int((u + 0.5) / shrink), int((v + 0.5) / shrink)
    x, y = min(max(column, 0), width - 1), min(max(row, 0), height - 1)
    return y, x, x != column or y != row


@compiled
def _take(
    image: LedImage,
    gain: float,
    table: Postures,
    limits: FingertipSettings,
    row: int,
    abduction: float,
    aside: float,
    cost: float,
    found: _Found,
    count: int,
) -> int:
    """Add a posture where its tip is about as bright as it should be; their count."""
    if count == len(found.row):
        return count
    middle, near = table.middle[row], table.near[row]
    u, v = _along(middle, abduction)
    y, x, outside = _cell(image, u, v, limits.shrink)
    ratio = max(image.near[y, x], limits.least_near) / max(near[limits.end] * gain, 0.1)
    if image.clipped[y, x]:
        ratio = max(ratio, 1.0)
    if outside or not limits.least_ratio < ratio < limits.most_ratio:
        return count
    uv = table.uv[row]
    folded = table.open[row, limits.upwards] == 0.0
    found.row[count], found.abduction[count], found.aside[count] = row, abduction, aside
    found.cost[count] = cost + _cost(image, gain, uv, near, abduction, folded, row >= table.thumb, limits)
    found.at[count, 0], found.at[count, 1] = u, v
    found.at[count, 2], found.at[count, 3] = _along(uv[:, limits.apex], abduction)
    return count + 1


@compiled
def _cost(
    image: LedImage,
    gain: float,
    uv: Float32,
    near: Float32,
    abduction: float,
    folded: bool,
    of_finger: bool,
    limits: FingertipSettings,
) -> float:
    """Return the cost of a posture, as `fingertips.costs`, without the laser."""
    bones = limits.bones
    off = np.empty(bones)
    known = np.empty(bones, np.int64)
    most = 3.0 * limits.own_sigma + limits.scale_sigma
    scale = above = hides = 0.0
    highest = max(near[limits.highest] * gain, 0.1)
    hidden = limits.hidden if of_finger else -np.inf
    darker = limits.folded_darker if folded else limits.darker
    as_bright = limits.folded_as_bright if folded else limits.as_bright
    for k in range(limits.apex):
        if k == limits.highest:
            continue
        u, v = _along(uv[:, k], abduction)
        y, x, outside = _cell(image, u, v, limits.shrink)
        if k < bones:
            off[k] = math.log(max(image.near[y, x], limits.least_near) / max(near[k] * gain, 0.1))
            known[k] = 2
            if outside:
                known[k] = 0
            elif image.clipped[y, x]:
                known[k] = 1
            elif off[k] < hidden:
                known[k], off[k], hides = 0, 0.0, limits.hides
            if image.clipped[y, x]:
                off[k] = max(off[k], 0.0)
            scale += min(max(off[k], -most), most)
        elif not outside and not near[k] > 0.0:
            bright = limits.above_unknown
            if not image.clipped[y, x]:
                seen = image.over[y, x] if folded and k >= limits.above + limits.far else image.near[y, x]
                bright = min(max((seen / highest - darker) / (as_bright - darker), 0.0), 1.0)
            above += bright * bright
    scale /= bones + (limits.own_sigma / limits.scale_sigma) ** 2
    cost = limits.above_most * above + (scale / limits.scale_sigma) ** 2 + hides
    for k in range(bones):
        square = min(((off[k] - scale) / limits.own_sigma) ** 2, limits.own_most)
        if known[k] == 0:
            square = limits.unknown_cost
        elif known[k] == 1:
            square = max(square, limits.unknown_cost)
        cost += square
    return cost


@compiled
def _open(
    image: LedImage,
    gain: float,
    table: Postures,
    row: int,
    abduction: float,
    limits: FingertipSettings,
    out: Float32,
) -> None:
    """As `fingertips._open`, of one hypothesis."""
    uv, near, end = table.uv[row], table.near[row], limits.end
    out[:] = table.open[row]
    end_u, end_v = _along(uv[:, end], abduction)
    for k in range(limits.bones):
        u, v = _along(uv[:, k], abduction)
        y, x, outside = _cell(image, u, v, limits.shrink)
        if outside or image.clipped[y, x]:
            continue
        if math.log(max(image.near[y, x], limits.least_near) / max(near[k] * gain, 0.1)) < limits.hidden:
            u, v = u - end_u, v - end_v
            least = limits.side * math.hypot(u, v)
            for way in range(len(out)):
                angle = way * (2.0 * math.pi / len(out))
                if math.cos(angle) * u + math.sin(angle) * v > least:
                    out[way] = 0.0


@compiled
def _modes(found: _Found, count: int, table: Postures, limits: FingertipSettings, out: Int) -> int:
    """As `fingertips.modes`, of one finger: how many."""
    if count == 0:
        return 0
    cost = found.cost[:count]
    good = np.flatnonzero(cost < cost.min() + limits.mode_within)
    number = 0
    for k in good[np.argsort(cost[good])]:
        separate = True
        for of in range(number):
            other = out[of]
            x, y = found.at[k, 0] - found.at[other, 0], found.at[k, 1] - found.at[other, 1]
            far = limits.separation * table.end[int(found.row[other]), 0]
            separate = separate and x * x + y * y >= far * far
        if separate:
            out[number] = k
            number += 1
            if number == limits.modes:
                break
    return number


@compiled
def _fit(led: Image, circle: Float, open_: Float32, edges: OutlineSettings) -> None:
    """As `led_image.fitted`, of one circle (x, y, radius, sigma, shown), in place."""
    directions = len(edges.way)
    off, firm, weight = np.empty(directions), np.zeros(directions), np.zeros(directions)
    x, y, radius = circle[0], circle[1], circle[2]
    log = np.empty(len(edges.share), np.float32)
    wanted = 0.0
    for k in range(directions):
        off[k], drop, inside = _edge(led, x, y, radius, edges.way[k], log, edges)
        if inside:
            want = open_[k * len(open_) // directions]
            wanted += want
            firm[k] = want * min(max((drop - edges.least_drop) / edges.firm_drop, 0.0), 1.0)
        weight[k] = firm[k]
    square = edges.edge_sigma**2
    at, size = square / edges.middle_sigma**2, square / edges.radius_sigma**2
    a = b = c = d = e = f = dx = dy = dr = scale = 0.0
    for width in edges.widths:
        a, b, c, d, e, f = at, 0.0, 0.0, at, 0.0, size
        p = q = r = 0.0
        for k in range(directions):
            w, s, t = weight[k], edges.way[k, 0], edges.way[k, 1]
            a, b, c = a + w * s * s, b + w * s * t, c + w * s
            d, e, f = d + w * t * t, e + w * t, f + w
            p, q, r = p + w * off[k] * s, q + w * off[k] * t, r + w * off[k]
        # Cramer's rule on [[a, b, c], [b, d, e], [c, e, f]].
        scale = 1.0 / (a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d))
        dx = scale * (p * (d * f - e * e) + q * (c * e - b * f) + r * (b * e - c * d))
        dy = scale * (p * (c * e - b * f) + q * (a * f - c * c) + r * (b * c - a * e))
        dr = scale * (p * (b * e - c * d) + q * (b * c - a * e) + r * (a * d - b * b))
        shown = 0.0
        for k in range(directions):
            rest = (off[k] - dx * edges.way[k, 0] - dy * edges.way[k, 1] - dr) / width
            weight[k] = firm[k] / (1.0 + rest * rest) ** 2
            if abs(rest) < 1.0:
                shown += firm[k]
        circle[4] = shown / max(wanted, 1e-6)
    variance = 0.5 * square * scale * ((d * f - e * e) + (a * f - c * c))
    circle[0], circle[1] = x + radius * dx, y + radius * dy
    circle[2], circle[3] = radius * (1.0 + dr), radius * math.sqrt(variance)


@compiled
def _edge(
    led: Image, x: float, y: float, radius: float, way: Float, log: Float32, edges: OutlineSettings
) -> tuple[float, float, bool]:
    """As `led_image._edges`, of one circle and direction."""
    height, width = led.shape
    steps = len(edges.share)
    for k in range(steps):
        u, v = x + radius * edges.share[k] * way[0], y + radius * edges.share[k] * way[1]
        log[k] = edges.log[_light(led, u, v)]
    u, v = x + radius * edges.share[steps - 1] * way[0], y + radius * edges.share[steps - 1] * way[1]
    inside = u > 0 and v > 0 and u < width - 1 and v < height - 1
    best, most = 0, -np.inf
    for k in range(steps - edges.width):
        drop = (log[k] - log[k + edges.width]) * edges.weight[k]
        if drop > most:
            best, most = k, drop
    last = steps - edges.width - 1
    low, high = max(best - 1, 0), min(best + 1, last)
    before, here = log[low] - log[low + edges.width], log[best] - log[best + edges.width]
    behind = log[high] - log[high + edges.width]
    part = 0.5 * (behind - before) / max(2.0 * here - before - behind, 1e-6)
    off = edges.rim - 1.0 + edges.middles[best] + edges.step * min(max(part, -0.5), 0.5)
    return off, here, inside


@compiled
def _light(led: Image, u: float, v: float) -> int:
    """Grey level between pixels; 0 outside."""
    height, width = led.shape
    column, row = int(u), int(v)  # of what is not outside, the floor
    if u < 0.0 or v < 0.0 or column >= width - 1 or row >= height - 1:
        return 0
    x, y = u - column, v - row
    upper = (1.0 - x) * led[row, column] + x * led[row, column + 1]
    lower = (1.0 - x) * led[row + 1, column] + x * led[row + 1, column + 1]
    return int((1.0 - y) * upper + y * lower + 0.5)


@compiled
def _outline_cost(found: _Found, k: int, table: Postures, limits: FingertipSettings, circle: Float) -> float:
    """As `fingertips._outline_cost`, of one hypothesis."""
    x, y, radius = circle[0] - found.at[k, 0], circle[1] - found.at[k, 1], circle[2]
    larger = math.log(table.end[int(found.row[k]), 0] / radius) / limits.size_sigma
    return (x * x + y * y) / (limits.at_sigma * radius) ** 2 + larger * larger


@compiled
def _ends(
    found: _Found, count: int, table: Postures, limits: FingertipSettings, circle: Float, out: Float
) -> None:
    """As `fingertips.Ends`, of one finger whose outline is that circle."""
    square = np.full(count, np.inf)
    within = found.cost[:count].min() + limits.ends_within
    x, y, radius = circle[0], circle[1], circle[2]
    least = np.inf
    for k in range(count):
        if found.cost[k] < within:
            square[k] = found.cost[k] + _outline_cost(found, k, table, limits, circle)
            least = min(least, square[k])
    sure = (limits.at_sure + circle[3] / radius) ** -2
    total = ways = 0.0
    out[:] = 0.0
    for k in range(count):
        if not square[k] < np.inf:
            continue
        weight = math.exp((least - square[k]) * (0.5 / limits.correlated))
        row = int(found.row[k])
        size = table.end[row, 0]
        u, v = (x - found.at[k, 0]) / radius, (y - found.at[k, 1]) / radius
        rotated = _rotated(found, k, table, limits, u, v, sure)
        u = (found.at[k, 2] - found.at[k, 0]) / size + rotated[0]
        v = (found.at[k, 3] - found.at[k, 1]) / size + rotated[1]
        total += weight
        out[0] += weight * u
        out[1] += weight * v
        ways += weight * (u * u + v * v)
        out[3] += weight * table.end[row, 1]
        out[4] += weight * table.end[row, 2]
    out /= total
    out[2] = math.sqrt(max(0.5 * (ways / total - out[0] ** 2 - out[1] ** 2), 0.0))


@compiled
def _rotated(
    found: _Found, k: int, table: Postures, limits: FingertipSettings, u: float, v: float, sure: float
) -> tuple[float, float]:
    """As `fingertips._rotated`, of one hypothesis."""
    row, by = int(found.row[k]), found.abduction[k]
    size, uv, twist = table.end[row, 0], table.uv[row], table.twist[row]
    end, apex = limits.end, limits.apex
    across = 0.0
    if row >= table.thumb:
        length = table.laser.shape[3]
        finger, posture = (row - table.thumb) // length, (row - table.thumb) % length
        across = table.laser[1, 0, finger, posture] + 2.0 * by * table.laser[2, 0, finger, posture]
    across, along = across / limits.laser_sure_m, twist[4] / limits.laser_sure_m
    at_u, at_v = (
        (uv[1, end, 0] + 2.0 * by * uv[2, end, 0]) / size,
        (uv[1, end, 1] + 2.0 * by * uv[2, end, 1]) / size,
    )
    tip_u = (uv[1, apex, 0] + 2.0 * by * uv[2, apex, 0]) / size
    tip_v = (uv[1, apex, 1] + 2.0 * by * uv[2, apex, 1]) / size
    at_tu, at_tv, tip_tu, tip_tv = twist[0] / size, twist[1] / size, twist[2] / size, twist[3] / size
    a = sure * (at_u * at_u + at_v * at_v) + across * across + 1.0 / limits.abduction_sigma**2
    b = sure * (at_u * at_tu + at_v * at_tv) + across * along
    c = sure * (at_tu * at_tu + at_tv * at_tv) + along * along + 1.0 / limits.twist_sigma**2
    aside = found.aside[k] / limits.laser_sure_m
    p = sure * (at_u * u + at_v * v) + across * aside - by / limits.abduction_sigma**2
    q = sure * (at_tu * u + at_tv * v) + along * aside
    scale = 1.0 / (a * c - b * b)
    abduction, twisted = (c * p - b * q) * scale, (a * q - b * p) * scale
    return (
        abduction * (tip_u - at_u) + twisted * (tip_tu - at_tu),
        abduction * (tip_v - at_v) + twisted * (tip_tv - at_tv),
    )
