"""Window of one marker in machine code: masks, shares and their moments.

The formulas are those of `centroid`, pixel by pixel. The masks of a window lie in flat arrays of rows of `stride`,
`EDGE` of nothing around them, so that no neighbourhood leaves them: pixel (x, y) is at (y + EDGE) * stride + EDGE +
x. `classes` holds what the colour table makes of a pixel, `kinds` what its neighbourhood does.

All in one file: the cache of compiled code looks for changes only in the file of the function that is called, so code
taken in from another file could be old.
"""

import math
from typing import NamedTuple, TypeAlias

import numpy as np

from common.arrays import Float, Float32, Image, Int
from slave.markers.classify import Codes, Places
from slave.markers.fast_compile import compiled

Three: TypeAlias = tuple[float, float, float]

EDGE = 4  # px
OWN, OTHER = 1, 2  # classes
CORE, INNER, NEAR, SOLID = 1, 2, 4, 8  # kinds
SHIFTS = tuple(np.uint64(n) for n in (3, 5, 10))  # of one type with what they shift
# Columns of what is asked for, and of what is answered.
ASKED, ANSWERED = 7, 14
LEFT, TOP, RIGHT, BOTTOM, BIT, ALONE, START = range(ASKED)
FOUND, U, V, AREA, CONTRAST, BLUE, GREEN, RED, CUT, THIN, FOREIGN, XX, XY, YY = range(ANSWERED)


class Rules(NamedTuple):
    """The constants of `centroid`, as arguments of machine code."""

    pad: int
    reach: int
    core: int
    deep: int
    hole: int
    least: int
    grid: int
    every: int
    white: float
    darkest: float
    shaded: float
    noise: float
    stiff_level: float
    stiff_slope: float


class Frame(NamedTuple):
    """Part of a window [px], with the memory layout and coordinates of its pixels."""

    x0: int
    y0: int
    x1: int  # x1, y1: exclusive
    y1: int
    stride: int  # length of a row
    x_middle: int  # x_middle, y_middle: the pixel from which coordinates are counted
    y_middle: int


@compiled
def measure_windows(
    image: Image,
    table: Codes,
    places: Places,
    cells: Codes,
    skin: Codes,
    curve: Float32,
    asked: Int,
    rules: Rules,
    answers: Float,
    windows: Float32,
) -> None:
    """Every window of `asked`, into a row of `answers` and its part of `windows`."""
    largest = 0
    for k in range(len(asked)):
        height = asked[k, BOTTOM] - asked[k, TOP] + 2 * rules.pad
        width = asked[k, RIGHT] - asked[k, LEFT] + 2 * rules.pad
        largest = max(largest, (height + 2 * EDGE) * (width + 2 * EDGE))
    scratch = np.empty(6 * largest, np.uint8)
    levels = np.empty(3 * largest, np.float32)
    ramp = np.arange(largest).astype(np.float32)
    if _ask_ahead(image, asked, rules.pad) > 255:
        return
    for k in range(len(asked)):
        _measure_window(
            image,
            table,
            places,
            cells,
            skin,
            curve,
            asked[k],
            rules,
            answers[k],
            windows,
            scratch,
            levels,
            ramp,
        )


@compiled
def _ask_ahead(image: Image, asked: Int, pad: int) -> int:
    """Prefetch the windows' cache lines: memory is slow, but answers many at once."""
    touched = 0
    for k in range(len(asked)):
        x0, x1 = max(asked[k, LEFT] - pad, 0), min(asked[k, RIGHT] + pad, image.shape[1])
        for y in range(max(asked[k, TOP] - pad, 0), min(asked[k, BOTTOM] + pad, image.shape[0])):
            row = image[y, x0:x1]
            cache_line = 64  # bytes
            for x in range(0, len(row), cache_line // 3):
                touched |= row[x, 0]
    return touched


@compiled
def _measure_window(
    image: Image,
    table: Codes,
    places: Places,
    cells: Codes,
    skin: Codes,
    curve: Float32,
    ask: Int,
    rules: Rules,
    answer: Float,
    windows: Float32,
    scratch: Image,
    levels: Float32,
    ramp: Float32,
) -> None:
    """Measure one marker.

    Args:
        table: (2^24,) codes.
        places: (3, 256) what each byte of blue, green and red adds to the place in the table.
        cells: (32^3,) codes of cells; skin: (1,) the bit that indicates that a cell has none (`fast.Cells`).
        curve: (256,) byte -> linear light.
        ask: (7,) box, bit, whether alone, where its window starts in `windows`.
        answer: (14,) zeros; stays so where nothing is found.
        windows: Shares of all windows, flat, zeros.
        scratch, levels: For the masks and the light of the largest window, (6 N,) and (3 N,).
    """
    left, top = ask[LEFT] - rules.pad, ask[TOP] - rules.pad
    width, height = ask[RIGHT] + rules.pad - left, ask[BOTTOM] + rules.pad - top
    stride = width + 2 * EDGE
    size = stride * (height + 2 * EDGE)
    # As arrays of their own: the rows of a part of an array could not be vectorised.
    masks, light = scratch[: 6 * size].reshape(6, size), levels[: 3 * size].reshape(3, size)
    classes, kinds, scratch = masks[4], masks[5], masks[:4]
    classes[:] = 0
    kinds[:] = 0
    light[:] = 0.0
    x_middle, y_middle = width // 2, height // 2
    # What of the window is in the image.
    x0, y0 = max(0, -left), max(0, -top)
    x1, y1 = min(width, image.shape[1] - left), min(height, image.shape[0] - top)
    whole = Frame(x0, y0, x1, y1, stride, x_middle, y_middle)
    _classify(image, table, places, cells, skin, curve, ask[BIT], left, top, whole, classes, light)
    if ask[ALONE] == 0:
        _keep_parts_inside(rules.pad + rules.grid - 1, width, height, stride, classes)
    own, u0, v0, u1, v1 = _box_of_own(whole, classes, scratch)
    if own == 0:
        return
    r = rules.reach
    part = Frame(
        max(u0 - r, x0), max(v0 - r, y0), min(u1 + r, x1), min(v1 + r, y1), stride, x_middle, y_middle
    )
    _look_around(part, rules, classes, kinds, scratch)
    ring = _sums_of_ring(whole, rules.every, classes, kinds, light)
    _drop_thick_others(part, classes, kinds, scratch)
    core = _light_over(kinds, CORE, part, light)
    sums = _sums_over(kinds, INNER, part, light, ramp)
    thin = sums[0] < rules.least
    if core[0] < rules.least:
        if thin:
            sums = _sums_over(classes, OWN, part, light, ramp)
        core = sums[0], sums[6], sums[7], sums[8]
    number = max(core[0], 1.0)
    mean = core[1] / number, core[2] / number, core[3] / number
    w, zero, power = _discriminant(ring, mean, rules)
    level = _shading(sums, w, zero, rules)
    into = windows[ask[START] : ask[START] + height * width]
    moments = _share_out(kinds, light, w, zero, level, rules, part, width, into, ramp)
    area = moments[0]
    if thin:
        if own < rules.least or area < 1.0:
            return
        answer[THIN] = 1.0
        answer[FOREIGN] = _foreign(
            max(u0 - 1, 0), max(v0 - 1, 0), min(u1 + 1, width), min(v1 + 1, height), stride, classes
        )
    answer[FOUND] = 1.0
    n = max(area, 1.0)
    x, y = moments[1] / n, moments[2] / n
    answer[U], answer[V], answer[AREA], answer[CONTRAST] = left + x, top + y, area, math.sqrt(power)
    answer[BLUE], answer[GREEN], answer[RED] = (
        mean[0] / rules.white,
        mean[1] / rules.white,
        mean[2] / rules.white,
    )
    answer[XX], answer[XY], answer[YY] = (
        moments[3] / n - x * x,
        moments[4] / n - x * y,
        moments[5] / n - y * y,
    )
    if left + u0 <= 0 or top + v0 <= 0 or left + u1 >= image.shape[1] or top + v1 >= image.shape[0]:
        answer[CUT] = 1.0


@compiled
def _classify(
    image: Image,
    table: Codes,
    places: Places,
    cells: Codes,
    skin: Codes,
    curve: Float32,
    bit: int,
    left: int,
    top: int,
    whole: Frame,
    classes: Image,
    light: Float32,
) -> None:
    count = whole.x1 - whole.x0
    for y in range(whole.y0, whole.y1):
        row = image[top + y, left + whole.x0 : left + whole.x1]
        start = (y + EDGE) * whole.stride + EDGE + whole.x0
        into, first, second, third = (
            classes[start : start + count],
            light[0, start : start + count],
            light[1, start : start + count],
            light[2, start : start + count],
        )
        for x in range(count):
            blue, green, red = np.uint64(row[x, 0]), np.uint64(row[x, 1]), np.uint64(row[x, 2])
            code = cells[blue >> SHIFTS[0] | green >> SHIFTS[0] << SHIFTS[1] | red >> SHIFTS[0] << SHIFTS[2]]
            if code & skin[0]:
                code = table[places[0, blue] | places[1, green] | places[2, red]] & ~skin[0]
            into[x] = OWN if np.int64(code) & bit else (OTHER if code else 0)
            first[x], second[x], third[x] = curve[blue], curve[green], curve[red]


@compiled
def _keep_parts_inside(inset: int, width: int, height: int, stride: int, classes: Image) -> None:
    """Give mask parts without a pixel `inset` inside the window to another marker."""
    kept = 4  # a class of its own while it grows
    stack = np.empty(width * height, np.int64)
    for y in range(inset, max(height - inset, inset + 1)):
        for x in range(inset, max(width - inset, inset + 1)):
            p = (y + EDGE) * stride + EDGE + x
            if classes[p] != OWN:
                continue
            classes[p] = kept
            stack[0] = p
            depth = 1
            while depth > 0:
                depth -= 1
                q = stack[depth]
                for dy in range(-stride, stride + 1, stride):
                    for dx in range(-1, 2):
                        if classes[q + dy + dx] == OWN:
                            classes[q + dy + dx] = kept
                            stack[depth] = q + dy + dx
                            depth += 1
    for p in range(stride * (height + 2 * EDGE)):
        if classes[p] == OWN:
            classes[p] = OTHER
        elif classes[p] == kept:
            classes[p] = OWN


@compiled
def _box_of_own(whole: Frame, classes: Image, scratch: Image) -> tuple[int, int, int, int, int]:
    """Pixels of the mask, and their box: left, top, right, bottom, exclusive."""
    count, v0, v1 = 0, whole.y1, whole.y0
    width = whole.x1 - whole.x0
    columns = scratch[0][: max(width, 0)]
    columns[:] = 0
    for y in range(whole.y0, whole.y1):
        start = (y + EDGE) * whole.stride + EDGE + whole.x0
        row = classes[start : start + width]
        number = 0
        for x in range(width):
            own = row[x] & OWN
            columns[x] |= own
            number += own
        if number > 0:
            count += number
            v0, v1 = min(v0, y), y + 1
    u0, u1 = 0, width
    while u0 < width and columns[u0] == 0:
        u0 += 1
    while u1 > u0 and columns[u1 - 1] == 0:
        u1 -= 1
    return count, whole.x0 + u0, v0, whole.x0 + u1, v1


@compiled
def _look_around(part: Frame, rules: Rules, classes: Image, kinds: Image, scratch: Image) -> None:
    """Fill `kinds` from how full of the mask the neighbourhood of 7 x 7 is.

    Row by row without a break, over the gaps between rows too: one long loop, and its result in a gap is not used.
    """
    stride = part.stride
    begin, end = (part.y0 + EDGE) * stride, (part.y1 + EDGE) * stride
    own, half, columns = scratch[0], scratch[1], scratch[2]
    for p in range(len(classes)):
        own[p] = classes[p] & OWN
    _add(own, half, stride, stride, len(classes) - stride)
    _add_around(half, own, columns, 2 * stride, begin - EDGE, end + EDGE)
    _add(columns, half, 1, begin - EDGE + 1, end + EDGE - 1)
    full = scratch[3]
    _add_around(half, columns, full, 2, begin, end)
    core, deep, hole = np.uint8(rules.core), np.uint8(rules.deep), np.uint8(rules.hole)
    middle, west, east = own[begin:end], own[begin - 1 : end - 1], own[begin + 1 : end + 1]
    north, south = own[begin - stride : end - stride], own[begin + stride : end + stride]
    fullness, into = full[begin:end], kinds[begin:end]
    for p in range(end - begin):
        inside = middle[p]
        near = np.uint8(fullness[p] != 0)
        heart = np.uint8(fullness[p] >= core) & inside
        solid = (np.uint8(fullness[p] >= deep) & inside) | (np.uint8(fullness[p] >= hole) & ~inside)
        inner = inside & west[p] & east[p] & north[p] & south[p]
        into[p] = CORE * heart | INNER * inner | NEAR * near | SOLID * solid


@compiled
def _add(a: Image, into: Image, step: int, begin: int, end: int) -> None:
    """Sum of a pixel and its two neighbours at `step`."""
    n = end - begin
    before, here, after, out = a[begin - step :], a[begin:], a[begin + step :], into[begin:]
    for p in range(n):
        out[p] = before[p] + here[p] + after[p]


@compiled
def _add_around(threes: Image, a: Image, into: Image, step: int, begin: int, end: int) -> None:
    """Add a pixel and the sums of three at `step` before and behind: seven pixels."""
    n = end - begin
    before, here, after, out = threes[begin - step :], a[begin:], threes[begin + step :], into[begin:]
    for p in range(n):
        out[p] = before[p] + here[p] + after[p]


@compiled
def _sums_of_ring(
    whole: Frame, every: int, classes: Image, kinds: Image, light: Float32
) -> tuple[float, ...]:
    """Number, sums, sums of products of the ring's light, one of `every` columns."""
    n, b, g, r, bb, bg, br, gg, gr, rr = 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    first = -(-whole.x0 // every) * every
    for y in range(whole.y0, whole.y1):
        start = (y + EDGE) * whole.stride + EDGE
        for x in range(first, whole.x1, every):
            p = start + x
            if classes[p] != 0 or kinds[p] & NEAR:
                continue
            blue, green, red = np.float64(light[0, p]), np.float64(light[1, p]), np.float64(light[2, p])
            n += 1
            b += blue
            g += green
            r += red
            bb += blue * blue
            bg += blue * green
            br += blue * red
            gg += green * green
            gr += green * red
            rr += red * red
    return np.float64(n), b, g, r, bb, bg, br, gg, gr, rr


@compiled
def _drop_thick_others(part: Frame, classes: Image, kinds: Image, scratch: Image) -> None:
    """Clear the near mark where 3 x 3 pixels of others fit: a fringe is thinner."""
    stride = part.stride
    begin, end = (part.y0 + EDGE) * stride, (part.y1 + EDGE) * stride
    a, b = scratch[0], scratch[1]
    count = 0
    for p in range(len(classes)):
        a[p] = classes[p] >> 1
        count += a[p]
    if count < 9:
        return
    _add(a, b, 1, 1, len(classes) - 1)
    _add(b, a, stride, begin - 2 * stride, end + 2 * stride)
    for p in range(begin - 2 * stride, end + 2 * stride):
        a[p] = 1 if a[p] == 9 else 0
    _add(a, b, 1, begin - stride, end + stride)
    _add(b, a, stride, begin, end)
    for p in range(begin, end):
        if a[p] != 0:
            kinds[p] &= ~NEAR & 0xFF


@compiled
def _sums_over(mask: Image, bit: int, part: Frame, light: Float32, ramp: Float32) -> tuple[float, ...]:
    """Sums where `bit`: number, x, y, xx, xy, yy, light (3), that times x, times y."""
    n, sx, sy, sxx, sxy, syy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    b, g, r, bx, gx, rx, by, gy, ry = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    count, middle = part.x1 - part.x0, np.float64(part.x_middle - part.x0)
    for row in range(part.y0, part.y1):
        start = (row + EDGE) * part.stride + EDGE + part.x0
        here = mask[start : start + count]
        blue, green, red = (
            light[0, start : start + count],
            light[1, start : start + count],
            light[2, start : start + count],
        )
        y = np.float64(row - part.y_middle)
        k, x1, x2, b0, g0, r0, b1, g1, r1 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for p in range(count):
            one = 1.0 if here[p] & bit else 0.0
            x = (np.float64(ramp[p]) - middle) * one
            k += one
            x1 += x
            x2 += x * x
            b0 += blue[p] * one
            g0 += green[p] * one
            r0 += red[p] * one
            b1 += blue[p] * x
            g1 += green[p] * x
            r1 += red[p] * x
        n, sx, sy, sxx, sxy, syy = n + k, sx + x1, sy + k * y, sxx + x2, sxy + x1 * y, syy + k * y * y
        b, g, r, bx, gx, rx = b + b0, g + g0, r + r0, bx + b1, gx + g1, rx + r1
        by, gy, ry = by + b0 * y, gy + g0 * y, ry + r0 * y
    return n, sx, sy, sxx, sxy, syy, b, g, r, bx, gx, rx, by, gy, ry


@compiled
def _light_over(mask: Image, bit: int, part: Frame, light: Float32) -> tuple[float, float, float, float]:
    """Over the pixels with `bit`: number, light of 3 channels."""
    n, b, g, r = 0.0, 0.0, 0.0, 0.0
    begin, end = (part.y0 + EDGE) * part.stride, (part.y1 + EDGE) * part.stride
    here, blue, green, red = mask[begin:end], light[0, begin:end], light[1, begin:end], light[2, begin:end]
    for p in range(end - begin):  # the gaps between rows are in no mask, and their light is 0
        one = 1.0 if here[p] & bit else 0.0
        n += one
        b += blue[p] * one
        g += green[p] * one
        r += red[p] * one
    return n, b, g, r


@compiled
def _discriminant(ring: tuple[float, ...], mean: Three, rules: Rules) -> tuple[Three, float, float]:
    """Direction of the marker colour in light, its ring's coordinate, step's power."""
    n = max(ring[0], 1.0)
    b, g, r = ring[1] / n, ring[2] / n, ring[3] / n
    q = rules.shaded
    step = mean[0] - b, mean[1] - g, mean[2] - r
    w = _solve(
        ring[4] / n - b * b + q * mean[0] * mean[0] + rules.noise,
        ring[5] / n - b * g + q * mean[0] * mean[1],
        ring[6] / n - b * r + q * mean[0] * mean[2],
        ring[7] / n - g * g + q * mean[1] * mean[1] + rules.noise,
        ring[8] / n - g * r + q * mean[1] * mean[2],
        ring[9] / n - r * r + q * mean[2] * mean[2] + rules.noise,
        step,
    )
    power = max(step[0] * w[0] + step[1] * w[1] + step[2] * w[2], 1e-9)
    w = w[0] / power, w[1] / power, w[2] / power
    return w, w[0] * b + w[1] * g + w[2] * r, power


@compiled
def _shading(sums: tuple[float, ...], w: Three, zero: float, rules: Rules) -> Three:
    """Fit the plane a + b x + c y of the marker colour's brightness along `w`."""
    n, x, y, xx, xy, yy, b, g, r, bx, gx, rx, by, gy, ry = sums
    stiff = max(n, 1.0)
    right = (
        w[0] * b + w[1] * g + w[2] * r - zero * n,
        w[0] * bx + w[1] * gx + w[2] * rx - zero * x,
        w[0] * by + w[1] * gy + w[2] * ry - zero * y,
    )
    slope = stiff * rules.stiff_slope
    return _solve(n + stiff * rules.stiff_level, x, y, xx + slope, xy, yy + slope, right)


@compiled
def _solve(a: float, b: float, c: float, d: float, e: float, f: float, right: Three) -> Three:
    """Solution of [[a, b, c], [b, d, e], [c, e, f]] x = right, by cofactors."""
    c00, c01, c02 = d * f - e * e, c * e - b * f, b * e - c * d
    c11, c12, c22 = a * f - c * c, b * c - a * e, a * d - b * b
    scale = 1.0 / (a * c00 + b * c01 + c * c02)
    x, y, z = right
    return (
        (c00 * x + c01 * y + c02 * z) * scale,
        (c01 * x + c11 * y + c12 * z) * scale,
        (c02 * x + c12 * y + c22 * z) * scale,
    )


@compiled
def _share_out(
    kinds: Image,
    light: Float32,
    w: Three,
    zero: float,
    level: Three,
    rules: Rules,
    part: Frame,
    width: int,
    into: Float32,
    ramp: Float32,
) -> tuple[float, ...]:
    """Fill in the shares; return moments 1, x, y, xx, xy, yy in window pixels."""
    w0, w1, w2, at_zero = np.float32(w[0]), np.float32(w[1]), np.float32(w[2]), np.float32(zero)
    slope, darkest = np.float32(level[1]), np.float32(rules.darkest)
    nothing, all_inside = np.float32(0.0), np.float32(1.0)
    n, sx, sy, sxx, sxy, syy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    count, first = part.x1 - part.x0, np.float64(part.x0)
    for y in range(part.y0, part.y1):
        start = (y + EDGE) * part.stride + EDGE + part.x0
        kind, blue, green, red, out = (
            kinds[start : start + count],
            light[0, start : start + count],
            light[1, start : start + count],
            light[2, start : start + count],
            into[y * width + part.x0 : y * width + part.x1],
        )
        row = np.float32(level[0] + level[1] * (part.x0 - part.x_middle) + level[2] * (y - part.y_middle))
        for p in range(count):
            bright = row + slope * ramp[p]
            bright = bright if bright > darkest else darkest
            share = (w0 * blue[p] + w1 * green[p] + w2 * red[p] - at_zero) / bright
            share = share if share > nothing else nothing
            share = share if share < all_inside else all_inside
            share = share if kind[p] & NEAR else nothing
            out[p] = all_inside if kind[p] & SOLID else share
        k, x1, x2 = 0.0, 0.0, 0.0
        for p in range(count):
            here, x = np.float64(out[p]), np.float64(ramp[p])
            k += here
            x1 += here * x
            x2 += here * x * x
        v = np.float64(y)
        x2 += 2.0 * first * x1 + first * first * k
        x1 += first * k
        n, sx, sy, sxx, sxy, syy = n + k, sx + x1, sy + k * v, sxx + x2, sxy + x1 * v, syy + k * v * v
    return n, sx, sy, sxx, sxy, syy


@compiled
def _foreign(x0: int, y0: int, x1: int, y1: int, stride: int, classes: Image) -> float:
    """Share of the mask's neighbours in a part that have another marker's colour."""
    rim, others = 0, 0
    for y in range(y0, y1):
        for x in range(x0, x1):
            p = (y + EDGE) * stride + EDGE + x
            if classes[p] == OWN:
                continue
            touches_own = False
            for row in range(p - stride, p + stride + 1, stride):
                for q in range(row - 1, row + 2):
                    touches_own |= classes[q] == OWN
            rim += touches_own
            others += touches_own & (classes[p] == OTHER)
    return others / max(rim, 1)
