"""Which finger a pixel of the LED image belongs to: seams between neighbouring fingers, which never cross (D4).

The palm stands still in the image (`slave.wrist.view`), so what the fingers of this hand can do says in which corridor
each of the four seams runs (`slave.wrist.corridors`). Along the stations of a corridor a seam is the path of least
energy, found by dynamic programming: first the three among index ... little, side by side, then the thumb's, which
lies over them where they meet. A pixel costs little where it is a valley, dark between brighter neighbours: a crease
between touching fingers as well as the open gap between spread ones, near the LEDs and far from them. The skin of a
finger costs so much that no seam crosses one. Of paths alike the one nearer to the middle of its corridor is taken: in
an image that shows nothing the seams are those of the hand's geometry alone.
"""

from dataclasses import dataclass
from typing import cast

import cv2
import numpy as np

from common.arrays import Bool, Float, Image, Int
from slave.wrist.corridors import LATERAL, MARGIN, SHRINK, STATION_PX, Corridors, Float32, corridors_of
from slave.wrist.view import WristView

NONE = -1  # no finger
_DARK = 6.0  # grey levels: what the noise of a difference of two frames leaves
_SHOWN = 24  # grey levels that the palm of a lit hand exceeds, or what hides it; the sun leaves less
_SKIN = 20.0  # energy of a bright, even surface: no seam crosses a finger
_OPEN = 1.0  # energy in the dark beside one finger only
_BEYOND_THUMB = 0.2  # energy in the dark beyond the thumb's tip
_ASIDE = 3.0  # energy at the edge of a corridor
_TAKEN = 10.0  # energy for the thumb's seam where another seam runs
_ONE_VALLEY = 0.35  # of the distance of two corridors, and of the rows of the hand
_VALLEY = 3.0  # samples of the thumb's corridor: half the breadth of such a valley
_ACROSS = 0.3  # energy where the thumb would lie across all fingers
_TURN = 0.02  # energy of a step aside between stations
_FENCE = 1e6
_WIDTHS = tuple(n + 2 * MARGIN for n in LATERAL)
_STARTS = np.cumsum([0, *_WIDTHS[:-1]]).tolist()
_ENDS = np.cumsum(_WIDTHS).tolist()
_PRIOR = np.concatenate(
    [np.pad(_ASIDE * np.linspace(-1.0, 1.0, n) ** 2, MARGIN, constant_values=_FENCE) for n in LATERAL[:3]]
    + [np.pad(_ACROSS * np.linspace(1.0, 0.0, LATERAL[3]), MARGIN, constant_values=_FENCE)]
).astype(np.float32)
_AROUND = np.ones((1, 7), dtype=np.uint8)
_CREASE = np.ones((5, 5), dtype=np.uint8)
_STEPS = np.array([2.0, 1.0, 0.0, 1.0, 2.0], dtype=np.float32) * np.float32(_TURN)
_BESIDE = np.ones((1, MARGIN), dtype=np.uint8)


@dataclass(frozen=True, slots=True, eq=False)
class Fingers:
    """Five regions of the image: thumb, index ... little.

    Attributes:
        corridors: Where the seams were searched.
        seams: (4, S) index|middle, middle|ring, ring|little [px, along the row of each station], and the thumb's
            [rad, along the circle of each station].
        shown: Whether the LED image showed a hand; else the seams are those of geometry alone.
    """

    corridors: Corridors
    seams: Float
    shown: bool

    def finger_of(self, uv: Float) -> Int:
        """Finger (N,), 0 thumb ... 4 little, of pixels (N, 2); -1 where the pixel is NaN."""
        corridors = self.corridors
        radius, angle = corridors.polar(uv)
        thumb = angle > _at(self.seams[3:], radius / STATION_PX - corridors.radius / STATION_PX)[0]
        across = _at(self.seams[:3], (uv[:, 1] - corridors.row) / STATION_PX)
        beyond = corridors.thumb_side * (across - uv[:, 0]) > 0.0
        finger = np.where(thumb, 0, 1 + beyond.sum(axis=0))
        return np.where(np.isnan(uv).any(axis=1), NONE, finger)

    def polylines(self) -> list[Float]:
        """The four seams as pixels (S, 2), for pictures."""
        return [self.corridors.pixels(seam, self.seams[seam]) for seam in range(4)]


def separate(led: Image, view: WristView) -> Fingers:
    """Find the seams in the difference of LED and ambient frame."""
    corridors = corridors_of(view)
    size = (led.shape[1] // SHRINK, led.shape[0] // SHRINK)
    small = cv2.resize(cv2.erode(led, _CREASE), size, interpolation=cv2.INTER_NEAREST)
    palm = small[corridors.palm[:, 1], corridors.palm[:, 0]] if len(corridors.palm) else small
    shown = bool(np.median(palm) > _SHOWN)
    strips = cv2.remap(
        small, corridors.map_x, corridors.map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    energy = _energy(cast(Image, strips), corridors.thumb_crosses) + _PRIOR
    thumb = _STARTS[3]
    seams = np.empty_like(corridors.middle)
    paths = _least_paths(energy[:, :thumb], 3)
    lit = strips[:, :thumb].max(axis=1) > _DARK
    for seam in range(2):
        _part(seam, paths, lit, energy, corridors)
    seams[:3] = corridors.across(slice(0, 3), paths)
    # Towards the little finger, each seam stays on its own side of the one before it.
    order = corridors.thumb_side
    seams[:3] = order * np.minimum.accumulate(order * seams[:3], axis=0)
    energy[:, thumb:] += _TAKEN * _near(corridors, seams[:3])
    seams[3:] = corridors.across(slice(3, 4), _least_paths(energy[:, thumb:], 1))
    return Fingers(corridors, seams, shown)


def _part(seam: int, paths: Int, lit: Bool, energy: Float32, corridors: Corridors) -> None:
    """Where a seam and the next one lie in one valley, send the one that is farther out of its corridor to another.

    `paths` (3, S) and `energy` are changed.
    """
    across = corridors.across(slice(seam, seam + 2), paths[seam : seam + 2])
    apart = np.abs(np.diff(corridors.middle[seam : seam + 2], axis=0))[0]
    same = lit & (np.abs(across[1] - across[0]) < _ONE_VALLEY * apart)
    if same.sum() < _ONE_VALLEY * lit.sum():
        return
    off = np.abs(paths[seam : seam + 2] - (_WIDTHS[seam] - 1) / 2.0)[:, lit].sum(axis=1)
    loser = seam + int(off[1] > off[0])
    start = _STARTS[loser]
    of_winner = across[0] if loser == seam + 1 else across[1]
    at = ((of_winner - corridors.middle[loser]) / corridors.half[loser] + 1.0) * (
        LATERAL[loser] - 1
    ) / 2.0 + MARGIN
    strip = energy[:, start : start + _WIDTHS[loser]]
    strip += _TAKEN * (np.abs(np.arange(_WIDTHS[loser]) - at[:, None]) < _VALLEY)
    paths[loser] = _least_paths(strip, 1)[0]


def _near(corridors: Corridors, seams: Float) -> Bool:
    """Which samples of the thumb's corridor (S, K) lie in the valley of one of three seams (3, S)."""
    count = seams.shape[1]
    stations = corridors.radius + STATION_PX * np.arange(count, dtype=np.float64)
    rows = np.broadcast_to(corridors.row + STATION_PX * np.arange(count, dtype=np.float64), seams.shape)
    radius, angle = corridors.polar(np.stack([seams.ravel(), rows.ravel()], axis=-1))
    upward = np.concatenate(
        [
            np.interp(stations, radius[k : k + count][::-1], angle[k : k + count][::-1])
            for k in (0, count, 2 * count)
        ]
    )
    at = (upward.reshape(3, count, 1) - corridors.middle[3, 0]) / corridors.half[3, 0] + 1.0
    at = at * (LATERAL[3] - 1) / 2.0 + MARGIN
    return (np.abs(np.arange(_WIDTHS[3]) - at) < _VALLEY).any(axis=0)


def _energy(strips: Image, crossed: int) -> Float32:
    """Energy of the straightened corridors (S, K), from 0 in a black valley to `_SKIN` on a finger.

    A pixel is as much of a valley as it lies below the darker of its two sides, and below what is brightest right
    beside it. The thumb's seam has the thumb on one side, and on the other perhaps nothing near: only the thumb's side
    counts. Where nothing is lit beside a pixel it is open, except for the thumb's seam on the first `crossed` circles:
    no thumb at all beyond it would mean that the seam lies outside of the thumb.
    """
    before = cv2.dilate(strips, _BESIDE, anchor=(MARGIN - 1, 0))
    behind = cv2.dilate(strips, _BESIDE, anchor=(0, 0))
    thumb = _STARTS[3]
    side = cv2.min(before, behind)
    side[:, thumb:] = behind[:, thumb:]
    level = np.divide(strips, cv2.dilate(strips, _AROUND) + np.float32(_DARK), dtype=np.float32)
    above = 1.0 - cv2.subtract(side, strips) / (side + np.float32(_DARK))
    energy = np.maximum(above, level)
    energy *= energy * energy
    energy *= _SKIN * energy  # the sixth power
    bare = side <= _DARK
    energy[:, :thumb][bare[:, :thumb]] = _OPEN
    energy[crossed:, thumb:][bare[crossed:, thumb:]] = _BEYOND_THUMB
    return energy


def _least_paths(energy: Float32, count: int) -> Int:
    """Path (count, S) of least energy through each corridor, as its sample at every station; at most two aside a step.

    Args:
        energy: (S, K), the corridors side by side, fences between them.
    """
    stations, width = energy.shape
    cost = np.empty_like(energy)
    cost[0] = energy[0]
    best = np.empty(width - 4, dtype=energy.dtype)
    aside = np.empty_like(best)
    cost[:, :2] = cost[:, -2:] = _FENCE
    for s in range(1, stations):
        before = cost[s - 1]
        np.minimum(before[:-4], before[4:], out=best)
        np.add(best, _TURN, out=best)
        np.minimum(before[1:-3], before[3:-1], out=aside)
        np.minimum(best, aside, out=best)
        np.add(best, _TURN, out=best)
        np.minimum(best, before[2:-2], out=best)
        np.add(energy[s, 2:-2], best, out=cost[s, 2:-2])
    path = np.empty((count, stations), dtype=np.int64)
    of_each = width // count
    for seam in range(count):
        start, end = seam * of_each, (seam + 1) * of_each
        k = int(cost[-1, start:end].argmin()) + start
        path[seam, -1] = k - start
        for s in range(stations - 2, -1, -1):
            from_here = cost[s, k - 2 : k + 3] + _STEPS
            k += int(from_here.argmin()) - 2
            path[seam, s] = k - start
    return path


def _at(seams: Float, station: Float) -> Float:
    """Lateral positions (M, N) of seams (M, S) at fractional stations (N,), held beyond the ends; NaN: the first's."""
    station = np.nan_to_num(np.clip(station, 0.0, seams.shape[1] - 1.001))
    k = station.astype(np.int64)
    part = station - k
    return (1.0 - part) * seams[:, k] + part * seams[:, k + 1]
