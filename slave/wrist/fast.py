"""Run the inner loops of seams and laser lines as machine code by numba.

What it makes is what `runs` and `seams` make, but for sums added up in another order.
"""

import math

import cv2
import numpy as np

from common.arrays import Bool, Float, Float32, Image, Int
from slave.markers.fast_compile import compiled
from slave.wrist import fast_tips, runs, seams
from slave.wrist.engine import Engine
from slave.wrist.runs import NO_LINES, FingerLines, Runs, RunSettings
from slave.wrist.seams import MARGIN


def lines(laser: Image, first_row: int) -> tuple[Runs, Bool]:
    """As `runs.lines`."""
    band, least, corner = runs.bright(laser, first_row)
    if not band.size:
        return NO_LINES
    most = band.size // 2 + band.shape[0] + 1
    whole = np.empty((most, 3), dtype=np.int64)
    parts = np.empty((most, 2))
    count = _scan(band, least, corner, runs.SETTINGS, whole, parts)
    if not count:
        return NO_LINES
    whole, parts = whole[:count], parts[:count]
    order, line, joins = np.empty(count, np.int64), np.empty(count, np.int64), np.empty(count, np.int64)
    number = _link(whole, parts, runs.SETTINGS.jump_px, order, line, joins)
    column, start, end = np.ascontiguousarray(whole[order].T)
    row, peak = np.ascontiguousarray(parts[order].T)
    found = Runs(column, row, start, end, peak, line[:number].copy(), joins[:number].copy())
    return found, runs.in_lines(found)


@compiled
def _scan(
    band: Image, least: Image, corner: tuple[int, int], limits: RunSettings, whole: Int, parts: Float
) -> int:
    """Scan an image on its side for runs: column, rows (N, 3); row and peak (N, 2)."""
    left, first = corner
    count = 0
    width, height = band.shape
    for x in range(width):
        y = 0
        while y < height:
            if band[x, y] <= least[x, y]:
                y += 1
                continue
            begin, peak = y, 0
            while y < height and band[x, y] > least[x, y]:
                peak = max(peak, int(band[x, y]))
                y += 1
            if y - begin > limits.thickest_px:
                continue
            flat = 0
            for k in range(begin, y):
                flat += band[x, k] > limits.top * peak
            base = (limits.of_flat if flat >= limits.flat_px else limits.of_peak) * peak
            weight = moment = 0.0
            for k in range(begin, y):
                above = max(band[x, k] - base, 0.0)
                weight += above
                moment += above * (k - begin)
            whole[count, 0], whole[count, 1], whole[count, 2] = x + left, begin + first, y + first
            parts[count, 0], parts[count, 1] = begin + first + moment / weight, peak
            count += 1
    return count


@compiled
def _link(whole: Int, parts: Float, jump: float, order: Int, line: Int, joins: Int) -> int:
    """Link runs to lines: run order, first run and joined line of each; their number."""
    count = len(whole)
    to, off = np.full(count, -1), np.full(count, math.inf)
    from_ = np.full(count, -1)
    lost = np.full(count, -1)
    low = 0  # the first run that may be of the next column, and no farther above
    for i in range(count):
        while low < count and (
            whole[low, 0] < whole[i, 0] + 1
            or (whole[low, 0] == whole[i, 0] + 1 and parts[low, 0] < parts[i, 0])
        ):
            low += 1
        for j in (low - 1, low):
            if j < count and whole[j, 0] == whole[i, 0] + 1:
                away = abs(parts[j, 0] - parts[i, 0])
                if away < off[i]:
                    off[i], to[i] = away, j
        j = to[i]
        if j < 0 or off[i] >= jump or whole[j, 1] > whole[i, 2] or whole[j, 2] < whole[i, 1]:
            to[i] = -1
        elif from_[j] >= 0 and off[from_[j]] <= off[i]:
            lost[i], to[i] = j, -1
        else:
            if from_[j] >= 0:
                lost[from_[j]], to[from_[j]] = j, -1
            from_[j] = i
    number = done = 0
    of = np.empty(count, np.int64)
    for last in range(count):  # lines in the order of their last runs
        if to[last] >= 0:
            continue
        length, k = 1, last
        while from_[k] >= 0:
            k = from_[k]
            length += 1
        line[number] = done
        k = last
        for place in range(done + length - 1, done - 1, -1):
            order[place] = k
            of[k] = number
            k = from_[k]
        done += length
        number += 1
    for n in range(number):
        joins[n] = n
    for i in range(count - 1, -1, -1):
        if lost[i] >= 0:
            joins[of[i]] = joins[of[lost[i]]]
    return number


def measure(runs_: Runs, finger: Int, width_px: int) -> FingerLines:
    """As `runs.measure`."""
    out = np.zeros((6, 5))
    _measure(runs_.column, runs_.row, runs_.peak, runs_.first, finger, width_px, runs.SETTINGS, out)
    line, u, v, split_px, cut, brightest = out
    return FingerLines(line, np.stack([u, v], axis=-1), split_px, cut > 0.0, brightest)


@compiled
def _measure(
    column: Int,
    row: Float,
    peak: Float,
    first: Int,
    finger: Int,
    width_px: int,
    limits: RunSettings,
    out: Float,
) -> None:
    """Over the parts of lines: sums, then centroids."""
    longest = np.zeros(5)
    mean, middle, columns = np.zeros((5, 2)), np.zeros((5, 2)), np.zeros(5)
    parts = np.zeros(5)
    for n in range(len(first)):
        stop = first[n + 1] if n + 1 < len(first) else len(row)
        left = first[n]
        while left < stop:
            of, right = int(finger[left]), left
            if of < 0:
                left += 1
                continue
            while right + 1 < stop and finger[right + 1] == of:
                right += 1
            count = right - left + 1
            u = v = 0.0
            for k in range(left, right + 1):
                u += column[k]
                v += row[k]
                out[5, of] = max(out[5, of], peak[k])
                if column[k] < 1 or column[k] > width_px - 2:
                    out[4, of] = 1.0
            parts[of] += 1
            columns[of] += count
            mean[of, 0] += u
            mean[of, 1] += v
            if count > longest[of]:
                longest[of] = count
                middle[of, 0], middle[of, 1] = u / count, v / count
            _part(column, row, left, right, of, limits, out)
            left = right + 1
    for of in range(5):
        out[1, of], out[2, of] = out[1, of] / out[0, of], out[2, of] / out[0, of]
        out[3, of] = np.nan
        if parts[of] > 1:
            du = mean[of, 0] / columns[of] - middle[of, 0]
            dv = mean[of, 1] / columns[of] - middle[of, 1]
            out[3, of] = 0.5 * math.hypot(du, dv)


@compiled
def _part(column: Int, row: Float, left: int, right: int, of: int, limits: RunSettings, out: Float) -> None:
    """Add the pieces of one part, from its left end to its right one."""
    inner = 2 if right - left >= limits.long else 0
    for k in range(left - 1, right + 1):
        if k < left or k == right:  # beyond the last run
            end, aside = (left, 1) if k < left else (right, -1)
            at = end + inner * aside
            steepness = 0.0
            if inner:
                steepness = (row[end + limits.long * aside] - row[at]) / (math.sqrt(5.5) - math.sqrt(2.5))
                steepness = min(max(steepness, 0.0), limits.steepest)
            u, v = column[end] - 0.5 * aside, row[at] - steepness * math.sqrt(2.5)
            du, dv = u - column[at], v - row[at]
            u, v = (u + column[at]) / 2.0, (v + row[at]) / 2.0
        else:
            if k < left + inner or k >= right - inner:
                continue
            du, dv = 1.0, row[k + 1] - row[k]
            u, v = column[k] + 0.5, (row[k] + row[k + 1]) / 2.0
        segment = math.hypot(du, dv)
        out[0, of] += segment
        out[1, of] += segment * u
        out[2, of] += segment * v


def minimum_cost_paths(energy: Float32, widths: tuple[int, ...]) -> Int:
    """As `seams.minimum_cost_paths`; of paths of one energy it may take another."""
    out = np.empty((len(widths), len(energy)), dtype=np.int64)
    _minimum_cost_paths(np.ascontiguousarray(energy), np.array(widths), seams.STEP_COST, out)
    return out


@compiled
def _minimum_cost_paths(energy: Float32, widths: Int, step_cost: np.float32, out: Int) -> None:
    stations = len(energy)
    begin = 0
    for band in range(len(widths)):
        width = widths[band]
        cost = energy[:, begin : begin + width].copy()
        for s in range(1, stations):
            before, here = cost[s - 1], cost[s]
            for k in range(2, width - 2):
                near = min(before[k - 1], before[k + 1]) + step_cost
                far = min(before[k - 2], before[k + 2]) + step_cost + step_cost
                here[k] += min(before[k], min(near, far))
        k = 2
        for j in range(2, width - 2):
            if cost[stations - 1, j] < cost[stations - 1, k]:
                k = j
        out[band, stations - 1] = k
        for s in range(stations - 2, -1, -1):
            best, to = cost[s, k], k
            for aside in (-1, 1, -2, 2):
                other = cost[s, k + aside] + abs(aside) * step_cost
                if other < best:
                    best, to = other, k + aside
            k = to
            out[band, s] = k
        begin += width


def energy(straightened: Image, crossed: int) -> Float32:
    """As `seams.energy`."""
    before = np.asarray(cv2.dilate(straightened, seams.SIDE_KERNEL, anchor=(MARGIN - 1, 0)), np.uint8)
    behind = np.asarray(cv2.dilate(straightened, seams.SIDE_KERNEL, anchor=(0, 0)), np.uint8)
    around = np.asarray(cv2.dilate(straightened, seams.AROUND), np.uint8)
    out = np.empty(straightened.shape, dtype=np.float32)
    limits = (seams.DARK, seams.SURFACE, seams.OPEN, seams.BEYOND_THUMB)
    _energy(straightened, before, behind, around, seams.PRIOR, seams.STARTS[3], crossed, limits, out)
    return out


@compiled
def _energy(
    straightened: Image,
    before: Image,
    behind: Image,
    around: Image,
    prior: Float32,
    thumb: int,
    crossed: int,
    limits: tuple[float, float, float, float],
    out: Float32,
) -> None:
    dark, surface = np.float32(limits[0]), np.float32(limits[1])
    open_, beyond_thumb = np.float32(limits[2]), np.float32(limits[3])
    stations, width = straightened.shape
    for s in range(stations):
        for k in range(width):
            of_thumb = k >= thumb
            level = np.float32(straightened[s, k])
            side = np.float32(behind[s, k] if of_thumb else min(before[s, k], behind[s, k]))
            if side <= dark and not (of_thumb and s < crossed):
                found = beyond_thumb if of_thumb else open_
            else:
                above = np.float32(1.0) - max(side - level, np.float32(0.0)) / (side + dark)
                share = max(above, level / (np.float32(around[s, k]) + dark))
                cube = share * share * share
                found = surface * cube * cube
            out[s, k] = found + prior[k]


def prepare() -> None:
    """Compile everything, on a synthetic line, before a first hand comes.

    Some ten seconds on a desktop processor the first time a version runs; half a second later, from the cache.
    """
    drawn = np.zeros((64, 640), np.uint8)
    drawn[40:43, 100:400] = 200
    found, _ = lines(drawn, 0)
    measure(found, np.zeros(len(found.column), np.int64), drawn.shape[1])
    straightened = np.zeros((2, len(seams.PRIOR)), np.uint8)
    minimum_cost_paths(energy(straightened, 0), (len(seams.PRIOR),))
    fast_tips.prepare()


NUMBA = Engine(energy, minimum_cost_paths, lines, measure, fast_tips.candidates)
