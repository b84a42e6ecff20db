"""The wrist device's inner loops as machine code: seams of least energy, and the runs of a laser line, by numba.

What they make is what `valleys`, `paths` and `runs` make, but for sums added up in another order. Dozens of calls for
a few hundred numbers each become one.
"""

import math

import cv2
import numpy as np

from common.arrays import Bool, Float, Image, Int
from slave.markers.fast_compile import compiled
from slave.wrist import paths, runs, valleys
from slave.wrist.corridors import MARGIN, Float32
from slave.wrist.engine import Engine
from slave.wrist.runs import NO_RUNS, Runs


def least_paths(energy: Float32, widths: tuple[int, ...]) -> Int:
    """As `paths.least_paths`; of paths of one energy it may take another."""
    out = np.empty((len(widths), len(energy)), dtype=np.int64)
    _least_paths(np.ascontiguousarray(energy), np.array(widths), paths.TURN, out)
    return out


@compiled
def _least_paths(energy: Float32, widths: Int, turn: np.float32, out: Int) -> None:
    stations = len(energy)
    begin = 0
    for corridor in range(len(widths)):
        width = widths[corridor]
        cost = energy[:, begin : begin + width].copy()
        for s in range(1, stations):
            before, here = cost[s - 1], cost[s]
            for k in range(2, width - 2):
                near = min(before[k - 1], before[k + 1]) + turn
                far = min(before[k - 2], before[k + 2]) + turn + turn
                here[k] += min(before[k], min(near, far))
        k = 2
        for j in range(2, width - 2):
            if cost[stations - 1, j] < cost[stations - 1, k]:
                k = j
        out[corridor, stations - 1] = k
        for s in range(stations - 2, -1, -1):
            best, to = cost[s, k], k
            for aside in (-1, 1, -2, 2):
                other = cost[s, k + aside] + abs(aside) * turn
                if other < best:
                    best, to = other, k + aside
            k = to
            out[corridor, s] = k
        begin += width


def energy(strips: Image, crossed: int) -> Float32:
    """As `valleys.energy`."""
    before = np.asarray(cv2.dilate(strips, valleys.BESIDE, anchor=(MARGIN - 1, 0)), np.uint8)
    behind = np.asarray(cv2.dilate(strips, valleys.BESIDE, anchor=(0, 0)), np.uint8)
    around = np.asarray(cv2.dilate(strips, valleys.AROUND), np.uint8)
    out = np.empty(strips.shape, dtype=np.float32)
    limits = (valleys.DARK, valleys.SKIN, valleys.OPEN, valleys.BEYOND_THUMB)
    _energy(strips, before, behind, around, valleys.PRIOR, valleys.STARTS[3], crossed, limits, out)
    return out


@compiled
def _energy(
    strips: Image,
    before: Image,
    behind: Image,
    around: Image,
    prior: Float32,
    thumb: int,
    crossed: int,
    limits: tuple[float, float, float, float],
    out: Float32,
) -> None:
    dark, skin = np.float32(limits[0]), np.float32(limits[1])
    open_, beyond_thumb = np.float32(limits[2]), np.float32(limits[3])
    stations, width = strips.shape
    for s in range(stations):
        for k in range(width):
            of_thumb = k >= thumb
            level = np.float32(strips[s, k])
            side = np.float32(behind[s, k] if of_thumb else min(before[s, k], behind[s, k]))
            if side <= dark and not (of_thumb and s < crossed):
                found = beyond_thumb if of_thumb else open_
            else:
                above = np.float32(1.0) - max(side - level, np.float32(0.0)) / (side + dark)
                share = max(above, level / (np.float32(around[s, k]) + dark))
                cube = share * share * share
                found = skin * cube * cube
            out[s, k] = found + prior[k]


def lines(laser: Image, first_row: int) -> tuple[Runs, Bool]:
    """As `runs.lines`."""
    band, least, corner = runs.bright(laser, first_row)
    if not band.size:
        return NO_RUNS, np.empty(0, dtype=np.bool_)
    most = band.size // 2 + band.shape[0] + 1
    whole = np.empty((most, 3), dtype=np.int64)
    parts = np.empty((most, 2))
    limits = (runs.THICKEST_PX, runs.FLAT_PX, runs.TOP, runs.OF_PEAK, runs.OF_FLAT)
    count = _scan(np.asarray(band, np.uint8), np.asarray(least, np.uint8), corner, limits, whole, parts)
    if not count:
        return NO_RUNS, np.empty(0, dtype=np.bool_)
    whole, parts = whole[:count], parts[:count]
    order, line, joins = np.empty(count, np.int64), np.empty(count, np.int64), np.empty(count, np.int64)
    number = _link(whole, parts, runs.JUMP_PX, order, line, joins)
    column, start, end = np.ascontiguousarray(whole[order].T)
    row, peak = np.ascontiguousarray(parts[order].T)
    found = Runs(column, row, start, end, peak, line[:number].copy(), joins[:number].copy())
    return found, runs.in_lines(found)


@compiled
def _scan(
    band: Image,
    least: Image,
    corner: tuple[int, int],
    limits: tuple[int, int, float, float, float],
    whole: Int,
    parts: Float,
) -> int:
    """Column, first row and the one after the last (N, 3), sub-pixel row and peak (N, 2), of an image on its side."""
    thickest, flat_px, top, of_peak, of_flat = limits
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
            if y - begin > thickest:
                continue
            flat = 0
            for k in range(begin, y):
                flat += band[x, k] > top * peak
            base = (of_flat if flat >= flat_px else of_peak) * peak
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
    """Order of runs line by line, first run of each line, and which line it joins; their number."""
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


NUMBA = Engine(energy, least_paths, lines)
