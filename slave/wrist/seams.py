"""Minimum-energy paths through several straight search bands at once.

By dynamic programming from both of their ends.

The two halves of every search band lie side by side in one array, so that one loop over half of the stations serves
all. Which way each sample was reached is then worked out for the whole array in a few passes, and going back along a
path only reads it.
"""

from itertools import accumulate, pairwise

import numpy as np
import numpy.typing as npt

from common.arrays import Int

FENCE = 1e6  # energy of samples between search bands, two or more: no path leaves its own
STEP_COST = np.float32(0.02)  # energy of a step aside between stations
_MOVES = (
    (-1, STEP_COST),
    (1, STEP_COST),
    (-2, 2 * STEP_COST),
    (2, 2 * STEP_COST),
)  # samples aside, and what they cost
_Float32 = npt.NDArray[np.float32]


def minimum_cost_paths(energy: _Float32, widths: tuple[int, ...]) -> Int:
    """Return the path (C, S) of least energy through each search band.

    As its sample at every station; at most two aside a step.

    Args:
        energy: (S, K), the search bands side by side, `FENCE` at both ends of each.
        widths: Samples of each of the C search bands, K in all.
    """
    stations, whole = energy.shape
    half = (stations + 1) // 2
    cost = np.zeros(
        (half, 2 * whole), dtype=np.float32
    )  # where stations are odd, the lower half begins with a free one
    cost[:, :whole] = energy[:half]
    cost[2 * half - stations :, whole:] = energy[: half - 1 : -1]
    for before, here in pairwise(cost):
        here[2:-2] += _cheapest(before)
    upper, lower = cost[-1, :whole], cost[-1, whole:]
    joined = upper[2:-2] + _cheapest(lower)
    moves = _moves(cost)
    out = np.empty((len(widths), 2 * half), dtype=np.int64)
    for path, end, width in zip(out, accumulate(widths), widths, strict=True):
        start = end - width
        k = start + 2 + int(joined[start : end - 4].argmin())
        move = min((float(lower[k + aside]) + float(price), aside) for aside, price in ((0, 0.0), *_MOVES))[1]
        path[:half] = _back(moves, k)[::-1]
        path[half:] = _back(moves, whole + k + move)
        path[half:] -= whole
        path -= start
    return out[:, :stations]


def _cheapest(cost: _Float32) -> _Float32:
    """Return the least cost (N - 4,) of reaching each sample.

    For each sample but the outer two of `cost` (N,), step included.
    """
    best = np.minimum(cost[:-4], cost[4:])
    best += STEP_COST
    np.minimum(best, cost[1:-3], out=best)
    np.minimum(best, cost[3:-1], out=best)
    best += STEP_COST
    np.minimum(best, cost[2:-2], out=best)
    return best


def _moves(cost: _Float32) -> list[memoryview]:
    """Return how far aside in the row before each sample was reached from.

    For each row of costs (R, N) but the first.
    """
    best = cost[:-1, 2:-2].copy()
    moves = np.zeros((len(best), cost.shape[1]), dtype=np.int8)
    inner = moves[:, 2:-2]
    for aside, price in _MOVES:
        other = cost[:-1, 2 + aside : cost.shape[1] - 2 + aside] + price
        np.putmask(inner, other < best, aside)
        np.minimum(best, other, out=best)
    return [row.data for row in moves]


def _back(moves: list[memoryview], k: int) -> list[int]:
    """Trace the path that ends at sample k of the last row.

    Returns its samples (R,) from there to the first.
    """
    out = [k]
    for row in reversed(moves):
        k += row[k]
        out.append(k)
    return out
