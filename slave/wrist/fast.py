"""Seams between fingers as machine code by numba.

And the whole of the engine of that name.

What it makes is what `valleys` and `paths` make, but for sums added up in another order. Dozens of calls for a few
hundred numbers each become one.
"""

import cv2
import numpy as np

from common.arrays import Image, Int
from slave.markers.fast_compile import compiled
from slave.wrist import cost_map, fast_tips, seams
from slave.wrist.engine import Engine
from slave.wrist.fast_lines import lines, measure
from slave.wrist.search_bands import MARGIN, Float32


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
    """As `cost_map.energy`."""
    before = np.asarray(cv2.dilate(straightened, cost_map.SIDE_KERNEL, anchor=(MARGIN - 1, 0)), np.uint8)
    behind = np.asarray(cv2.dilate(straightened, cost_map.SIDE_KERNEL, anchor=(0, 0)), np.uint8)
    around = np.asarray(cv2.dilate(straightened, cost_map.AROUND), np.uint8)
    out = np.empty(straightened.shape, dtype=np.float32)
    limits = (cost_map.DARK, cost_map.SURFACE, cost_map.OPEN, cost_map.BEYOND_THUMB)
    _energy(straightened, before, behind, around, cost_map.PRIOR, cost_map.STARTS[3], crossed, limits, out)
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
    """Compile everything, on a synthetic line.

    A first hand must not find a slave that compiles.

    Some ten seconds on a desktop processor the first time a version runs; half a second later, from the cache.
    """
    drawn = np.zeros((64, 640), np.uint8)
    drawn[40:43, 100:400] = 200
    runs, _ = lines(drawn, 0)
    measure(runs, np.zeros(len(runs.column), np.int64), drawn.shape[1])
    straightened = np.zeros((2, len(cost_map.PRIOR)), np.uint8)
    minimum_cost_paths(energy(straightened, 0), (len(cost_map.PRIOR),))
    fast_tips.prepare()


NUMBA = Engine(energy, minimum_cost_paths, lines, measure, fast_tips.candidates)
