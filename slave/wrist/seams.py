"""Find minimum-energy seams between the fingers, inside their search bands.

A search band is a middle and a half width at each station, from a sweep of the hand model through the ranges of its
joints, made once. The three seams among index ... little have rows of the image as stations [px], the thumb's has
circles about the thumb's root (CMC) [rad]. The energy is low in a minimum, high on the skin of a finger.

Paths are found by dynamic programming from both ends: the two halves of every band lie side by side in one array, so
that one loop over half of the stations serves all; the way back only reads which way each sample was reached.
"""

from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate, pairwise

import cv2
import numpy as np

from common.arrays import Float, Float32, Image, Int
from common.hand.model import CHAINS, METACARPALS
from common.hand.profiles import ABDUCTION
from slave.wrist.led_image import (
    NEAREST_M,
    PER_BONE,
    WristView,
    along_bones,
    finger_postures,
    in_image,
    thumb_postures,
    unseen,
)

FENCE = 1e6  # energy of samples between search bands, two or more: no path leaves its own
STEP_COST = np.float32(0.02)  # energy of a step aside between stations
# samples aside, and what they cost
_MOVES = ((-1, STEP_COST), (1, STEP_COST), (-2, 2 * STEP_COST), (2, 2 * STEP_COST))


def minimum_cost_paths(energy: Float32, widths: tuple[int, ...]) -> Int:
    """Return the path (C, S) of least energy through each search band.

    As its sample at every station; at most two aside a step. `energy`: (S, K), the search bands of so many samples
    (`widths`) side by side, `FENCE` at both ends of each.
    """
    stations, whole = energy.shape
    half = (stations + 1) // 2
    # where stations are odd, the lower half begins with a free one
    cost = np.zeros((half, 2 * whole), dtype=np.float32)
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


def _cheapest(cost: Float32) -> Float32:
    """Return the least cost (N - 4,) of reaching each inner sample of `cost` (N,)."""
    best = np.minimum(cost[:-4], cost[4:])
    best += STEP_COST
    np.minimum(best, cost[1:-3], out=best)
    np.minimum(best, cost[3:-1], out=best)
    best += STEP_COST
    np.minimum(best, cost[2:-2], out=best)
    return best


def _moves(cost: Float32) -> list[memoryview]:
    """Return how far aside each sample was reached from, row by row but the first."""
    best = cost[:-1, 2:-2].copy()
    moves = np.zeros((len(best), cost.shape[1]), dtype=np.int8)
    inner = moves[:, 2:-2]
    for aside, price in _MOVES:
        other = cost[:-1, 2 + aside : cost.shape[1] - 2 + aside] + price
        np.putmask(inner, other < best, aside)
        np.minimum(best, other, out=best)
    return [row.data for row in moves]


def _back(moves: list[memoryview], k: int) -> list[int]:
    """Trace the path that ends at sample k of the last row, back to the first (R,)."""
    out = [k]
    for row in reversed(moves):
        k += row[k]
        out.append(k)
    return out


STATION_PX = 10.0
_FIRST_RADIUS_PX = 80.0  # nearer to its root the thumb has no seam
LATERAL = (25, 25, 25, 61)  # samples across: index|middle, middle|ring, ring|little, thumb
MARGIN = 12  # samples beyond either edge of a search band: about a finger's breadth


@dataclass(frozen=True, slots=True, eq=False)
class SearchBands:
    """Search bands of the four seams, in the order of `LATERAL`; S stations.

    Attributes:
        rows: (S,) stations of the three finger seams [px].
        radii: (S,) stations of the thumb's seam [px].
        root: (2,) the thumb's root in the image [px]; angles are about it.
        up: (2,) image direction of angle 0, from the root to the middle finger's knuckle.
        thumb_side: +1.0 where the thumb is to the right in the image, -1.0 to the left.
        middle: (4, S) middle of each search band: u [px], or angle [rad].
        half: (4, S) half width.
        weight: (S, sum of the first three LATERAL + 2 MARGIN each) of what the image shows there: little on the palm,
            whose skin every seam must cross, and one farther aside less of it than one between fingers.
        thumb_crosses: How many of the circles the thumb crosses however it is held.
        map_x, map_y: (S, sum of LATERAL + 2 MARGIN each) where to read the image, float32; the search bands side
            by side, each with its margins.
        palm: (P, 2) columns and rows of the image where the palm is; none where the image does not show it.
    """

    rows: Float
    radii: Float
    root: Float
    up: Float
    thumb_side: float
    middle: Float
    half: Float
    weight: Float32
    thumb_crosses: int
    map_x: Float32
    map_y: Float32
    palm: Int

    def polar(self, uv: Float) -> tuple[Float, Float]:
        """Radius [px], angle [rad] to the thumb's side of pixels (N, 2) about its root."""
        return _polar(uv, self.root, self.up, self.thumb_side)

    def across(self, seams: slice, path: Int) -> Float:
        """Return the lateral positions (M, S) of samples (M, S) of some search bands."""
        count = np.array(LATERAL[seams])[:, None] - 1
        return self.middle[seams] + self.half[seams] * (2.0 * (path - MARGIN) / count - 1.0)

    def sample(self, seam: int, lateral: Float) -> Float:
        """Samples (..., S), with fractions, at lateral positions: inverse of `across`."""
        share = (lateral - self.middle[seam]) / self.half[seam]
        return (share + 1.0) * (LATERAL[seam] - 1) / 2.0 + MARGIN


def _polar(uv: Float, root: Float, up: Float, thumb_side: float) -> tuple[Float, Float]:
    x, y = uv[:, 0] - root[0], uv[:, 1] - root[1]
    return np.hypot(x, y), np.arctan2(thumb_side * (y * up[0] - x * up[1]), x * up[0] + y * up[1])


@lru_cache(maxsize=128)  # one for each way the palm may lie
def search_bands_of(view: WristView) -> SearchBands:
    """Search bands of a wrist rig and hand; CalibrationError: no finger can be seen."""
    knuckles = in_image(view, view.model.rest_position_m[[7, 12, 22]])[0]
    thumb_side = 1.0 if knuckles[0, 0] > knuckles[2, 0] else -1.0
    root = in_image(view, view.model.rest_position_m[2])[0]
    up = (knuckles[1] - root) / np.linalg.norm(knuckles[1] - root)
    unused_px = 80.0  # rows not used: the fingers end below the upper edge of the image
    stations = int((view.optics.height_px - unused_px) // STATION_PX)
    steps = STATION_PX * np.arange(stations, dtype=np.float64)
    rows, radii = view.optics.height_px - STATION_PX * stations + steps, _FIRST_RADIUS_PX + steps
    *of_thumb, crossed = _thumb_workspace(view, root, up, thumb_side, stations)
    middle, half = (
        np.vstack([three, np.full(stations, thumb)])
        for three, thumb in zip(_between_fingers(view, rows), of_thumb, strict=True)
    )
    u: list[Float] = []
    v: list[Float] = []
    for seam, count in enumerate(LATERAL):
        share = np.arange(-MARGIN, count + MARGIN, dtype=np.float64) / (count - 1) * 2.0 - 1.0
        lateral = middle[seam, :, None] + half[seam, :, None] * share
        if seam < 3:
            u.append(lateral)
            v.append(np.broadcast_to(rows[:, None], lateral.shape))
        else:
            along, across = radii[:, None] * np.cos(lateral), thumb_side * radii[:, None] * np.sin(lateral)
            u.append(root[0] + (along * up[0] - across * up[1]))
            v.append(root[1] + (along * up[1] + across * up[0]))
    map_x, map_y = (np.concatenate(each, axis=1).astype(np.float32) for each in (u, v))
    weight, palm = _weight(view, rows), _palm(view)
    return SearchBands(rows, radii, root, up, thumb_side, middle, half, weight, crossed, map_x, map_y, palm)


def _palm(view: WristView) -> Int:
    """Pixels (P, 2) along the outer half of the metacarpals of index ... little."""
    rest = view.model.rest_position_m
    roots, ends = rest[list(METACARPALS)], rest[CHAINS[1:, 0]]
    uv = in_image(view, np.concatenate([roots + share * (ends - roots) for share in (0.5, 0.75, 1.0)]))[0]
    cells = uv.astype(np.int64)
    inside = (cells >= 0).all(axis=1) & (cells[:, 0] < view.optics.width_px)
    return cells[inside & (cells[:, 1] < view.optics.height_px)]


def _between_fingers(view: WristView, rows: Float) -> tuple[Float, Float]:
    """Middle and half width (3, S) [px] of the bands among index ... little at rows."""
    limits = view.model.limits_rad
    points = along_bones(view, finger_postures(view, 1, 8, 8))
    focal = view.optics.matrix[0, 0]
    out = np.empty((2, 3, len(rows)))
    for seam in range(3):
        a, b = points[:, seam + 1], points[:, seam + 2]
        mid = (a + b) / 2.0
        uv, depth = in_image(view, mid)
        scale = focal / np.maximum(depth, NEAREST_M)
        spacing = scale * np.linalg.norm(a[:, :1] - b[:, :1], axis=-1)
        of_spread = 0.75  # share of the abduction range that two neighbours are taken to lean the same way
        lean = np.abs(limits[seam + 1 : seam + 3, ABDUCTION]).max() * of_spread
        free = scale * np.linalg.norm((mid - mid[:, :1])[..., ::2], axis=-1) * np.sin(lean)
        least_of_spacing = 0.25
        most_of_spacing = 0.7  # half width of a search band, in spacings of fingers: beyond lies another seam
        free = np.minimum(np.maximum(free, least_of_spacing * spacing), most_of_spacing * spacing)
        seen = (depth > NEAREST_M) & np.isfinite(uv).all(axis=-1)
        out[:, seam] = _band(uv[..., 1][seen], (uv[..., 0] - free)[seen], (uv[..., 0] + free)[seen], rows)
    return out[0], out[1]


def _weight(view: WristView, rows: Float) -> Float32:
    """`SearchBands.weight` of stations at the given rows (S,)."""
    knuckles, ends = (view.model.rest_position_m[CHAINS[1:, k]] for k in (0, 1))
    along = ends - knuckles
    web = 0.4  # of the proximal phalanx: where the webs between the fingers end, and the palm begins
    web_off_m = 4e-3  # how far the palm may lie from where it is thought to: 3 degrees at the knuckles
    off = web + web_off_m / np.linalg.norm(along, axis=1, keepdims=True)
    webs = in_image(view, knuckles + off * along)[0][:, 1]
    columns = [np.full(n + 2 * MARGIN, 0.5 * (webs[k] + webs[k + 1])) for k, n in enumerate(LATERAL[:3])]
    of_palm = 0.05  # weight of what the palm shows, against fingers
    return np.where(rows[:, None] < np.concatenate(columns), 1.0, of_palm).astype(np.float32)


def _band(at: Float, low: Float, high: Float, stations: Float) -> tuple[Float, Float]:
    """Return the middle and half width (S,) of intervals low ... high (N,) near each."""
    near = np.abs(at[None] - stations[:, None]) <= STATION_PX
    known = near.any(axis=1)
    if not known.any():
        raise unseen("fingers")
    lows = np.array([np.quantile(low[row], 0.1) for row in near[known]])
    highs = np.array([np.quantile(high[row], 0.9) for row in near[known]])
    ends = [np.interp(stations, stations[known], end) for end in (lows, highs)]
    lows, highs = (np.convolve(np.pad(end, 2, mode="edge"), np.full(5, 0.2), mode="valid") for end in ends)
    return (lows + highs) / 2.0, (highs - lows) / 2.0


def _thumb_workspace(
    view: WristView, root: Float, up: Float, thumb_side: float, stations: int
) -> tuple[float, float, int]:
    """Middle, half width [rad] of the thumb's band; stations that it always crosses."""
    points = along_bones(view, thumb_postures(view, 7, 7, 3, 3))[:, 0, PER_BONE:]  # beyond the metacarpal
    uv, depth = in_image(view, points)
    radius, angle = _polar(uv.reshape(-1, 2), root, up, thumb_side)
    scale = view.optics.matrix[0, 0] / np.maximum(depth, NEAREST_M).ravel()
    breadth = np.arcsin(np.minimum(scale * view.model.radius_m[4] / np.maximum(radius, 1.0), 0.9))
    seen = (depth > NEAREST_M).ravel()
    ends = depth[:, -1] > NEAREST_M
    if not ends.any():
        raise unseen("thumb")
    rare = 0.02  # share of the postures of a sweep rejected at either end
    low, high = np.quantile((angle - breadth)[seen], (rare, 1.0 - rare))
    tips = radius.reshape(len(points), -1)[:, -1]
    crossed = (np.quantile(tips[ends], rare) - _FIRST_RADIUS_PX) / STATION_PX
    return (low + high) / 2.0, (high - low) / 2.0, int(np.clip(crossed, 0, stations))


DARK = 6.0  # grey levels: what the noise of a difference of two frames leaves
SURFACE = 20.0  # energy of a bright, even surface: no seam crosses a finger
OPEN = 1.0  # energy in the dark beside one finger only
BEYOND_THUMB = 0.2  # energy in the dark beyond the thumb's tip
ASIDE = 3.0  # energy at the edge of a search band
ACROSS = 0.3  # energy where the thumb would lie across all fingers
WIDTHS = tuple(n + 2 * MARGIN for n in LATERAL)
STARTS = np.cumsum([0, *WIDTHS[:-1]]).tolist()
PRIOR = np.concatenate(
    [np.pad(ASIDE * np.linspace(-1.0, 1.0, n) ** 2, MARGIN, constant_values=FENCE) for n in LATERAL[:3]]
    + [np.pad(ACROSS * np.linspace(1.0, 0.0, LATERAL[3]), MARGIN, constant_values=FENCE)]
).astype(np.float32)
AROUND = np.ones((1, 7), dtype=np.uint8)
SIDE_KERNEL = np.ones((1, MARGIN), dtype=np.uint8)


def energy(straightened: Image, crossed: int) -> Float32:
    """Return the energy of the straightened search bands (S, K).

    From 0 in a black minimum to `SURFACE` on a finger, and `PRIOR`. A pixel is as much of a minimum as it lies below
    the darker of its two sides, and below what is brightest right beside it. The thumb's seam has the thumb on one
    side, and on the other perhaps nothing near: only the thumb's side counts. Where nothing is lit beside a pixel it
    is open, except for the thumb's seam on the first `crossed` circles: else the seam would lie outside of the thumb.
    """
    before = cv2.dilate(straightened, SIDE_KERNEL, anchor=(MARGIN - 1, 0))
    behind = cv2.dilate(straightened, SIDE_KERNEL, anchor=(0, 0))
    thumb = STARTS[3]
    side = cv2.min(before, behind)
    side[:, thumb:] = behind[:, thumb:]
    level = np.divide(straightened, cv2.dilate(straightened, AROUND) + np.float32(DARK), dtype=np.float32)
    above = 1.0 - cv2.subtract(side, straightened) / (side + np.float32(DARK))
    out = np.maximum(above, level)
    out *= out * out
    out *= SURFACE * out  # the sixth power
    bare = side <= DARK
    np.putmask(out[:, :thumb], bare[:, :thumb], OPEN)
    np.putmask(out[crossed:, thumb:], bare[crossed:, thumb:], BEYOND_THUMB)
    out += PRIOR
    return out
