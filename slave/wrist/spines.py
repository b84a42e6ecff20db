"""Where in the image each finger runs: its spine, the middle of what is lit between its seams at every row."""

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import cv2
import numpy as np

from common.arrays import Bool, Float, Int
from slave.wrist.corridors import STATION_PX, corridors_of
from slave.wrist.fingers import Fingers
from slave.wrist.led_depth import DARK, SHRINK, Float32, image_rows
from slave.wrist.tip_templates import templates_of
from slave.wrist.view import WristView

EDGE_SHARE = np.float32(
    0.5
)  # of the nearness of a row's brightest: what is darker is a gap, or skin seen edge on
MOST_SPREAD = 0.36  # tan of 20 degrees, the limit of spreading
ROOT_PX = 36.0  # half of a broad finger near its root, and the pose of the palm
LIT = 2.0 * DARK  # grey levels of a finger's middle, as of a hand stretched out far
JUMP = 5.0  # columns from row to row: that is another finger
SMOOTH = 5  # rows
MOST_LEAN = 0.5  # columns per row
MOST = np.float32(12.0)  # grey levels^0.5 that count: what is nearer than a finger is the thumb
_NEAR_LIT = np.float32(np.sqrt(LIT))
_TINY = np.float32(1e-6)
_ASIDE = np.arange(-11, 12, dtype=np.int32)  # a finger that faces the camera, and its bow


@dataclass(frozen=True, slots=True, eq=False)
class Fans:
    """Where the fingers of one hand can be: R rows of the shrunken image.

    Attributes:
        low, high: (4, R) columns of the full image between which index ... little can be.
        v: (R,) rows of the full image [px].
        station: (R,) the station of the seams before each row; share (R,): how far it is to the next.
    """

    low: Float
    high: Float
    v: Float
    station: Int
    share: Float


@lru_cache(maxsize=8)
def fans_of(view: WristView) -> Fans:
    """Those of one wrist rig and hand; made once."""
    bank, corridors = templates_of(view), corridors_of(view)
    v = image_rows(view)[: bank.all_rows]
    lean = MOST_SPREAD * np.maximum(bank.root_uv[:, 1:] - v, 0.0) + ROOT_PX
    last = corridors.middle.shape[1] - 1
    at: Float = ((v - corridors.row) / STATION_PX).clip(0.0, last - 1e-9)
    station: Int = at.astype(np.int64)
    return Fans(bank.root_uv[:, :1] - lean, bank.root_uv[:, :1] + lean, v, station, np.mod(at, 1.0))


def borders(fingers: Fingers, view: WristView) -> Float32:
    """Columns (4, 2, R) of the shrunken image between which index ... little are: by their seams and their roots."""
    fans, corridors, seams = fans_of(view), fingers.corridors, fingers.seams
    between = seams[:3, fans.station] * (1.0 - fans.share) + seams[:3, fans.station + 1] * fans.share
    thumb = _column(corridors.pixels(3, seams[3]), fans.v)
    low, high = fans.low.copy(), fans.high.copy()
    near, far = (high, low) if corridors.thumb_side > 0.0 else (low, high)
    nearer, farther = (np.minimum, np.maximum) if corridors.thumb_side > 0.0 else (np.maximum, np.minimum)
    nearer(near[0], thumb, out=near[0])
    nearer(near[1:], between, out=near[1:])
    farther(far[:3], between, out=far[:3])
    return ((np.stack([low, high], axis=1) - 0.5 * (SHRINK - 1)) / SHRINK).astype(np.float32)


def _column(line: Float, v: Float) -> Float:
    """Where a seam (S, 2) [px] crosses rows [px]; one that turns back is taken where it first came."""
    up = line[::-1] if line[0, 1] < line[-1, 1] else line
    row = np.minimum.accumulate(up[:, 1])
    return np.interp(v, row[::-1], up[::-1, 0])


def spines(near: Float32, border: Float32, rows: int) -> Float:
    """Columns (4, R) of the fingers' middles in the shrunken image; beyond a finger's ends as at its ends.

    Args:
        near: (h, w) nearness [grey levels^0.5].
        border: (4, 2, R) columns between which the fingers are; the first rows of the image.
    """
    width = near.shape[1]
    lines = _straight(near, border)[:, :rows]
    columns = np.rint(lines).astype(np.int32)[..., None] + _ASIDE
    at = columns.clip(0, width - 1)
    at += (np.arange(rows, dtype=np.int32) * np.int32(width))[:, None]
    light = near.ravel()[at]
    light *= (columns >= border[:, 0, :rows, None]) & (columns <= border[:, 1, :rows, None])
    brightest = light.max(axis=2)
    light *= light > (EDGE_SHARE * brightest)[..., None]
    light *= light
    aside = (light @ _ASIDE.astype(np.float32)) / np.maximum(light.sum(axis=2), _TINY)
    middle = columns[..., len(_ASIDE) // 2] + aside
    dark = brightest <= _NEAR_LIT
    for finger in range(len(middle)):
        run = _run(dark[finger], middle[finger], brightest[finger])
        if run is None:
            middle[finger] = lines[finger]
            continue
        middle[finger, : run.start] = middle[finger, run.start]
        middle[finger, run.stop :] = middle[finger, run.stop - 1]
    return np.asarray(cv2.blur(middle, (SMOOTH, 1), borderType=cv2.BORDER_REPLICATE), dtype=np.float64)


def _run(dark: Bool, middle: Float32, brightest: Float32) -> slice | None:
    """The rows of a finger: between those that are dark or begin another one, where most light is; None: too few."""
    cut = dark.copy()
    cut[:-1] |= np.abs(np.diff(middle)) > JUMP
    ends = [-1, *np.flatnonzero(cut).tolist(), len(cut)]
    sums = [0.0, *np.cumsum(brightest).tolist()]
    _, a, b = max((sums[b] - sums[a + 1], a + 1, b) for a, b in pairwise(ends))
    return slice(a, b) if b - a >= SMOOTH else None


def _straight(near: Float32, border: Float32) -> Float32:
    """The straight lines (4, R) that fit best what is lit between the borders."""
    light = np.minimum(near, MOST)
    light *= light > _NEAR_LIT
    rows, width = light.shape
    sums = np.zeros((2, rows, width + 1), dtype=np.float32)
    np.cumsum(light, axis=1, out=sums[0, :, 1:])
    np.cumsum(light * np.arange(width, dtype=np.float32), axis=1, out=sums[1, :, 1:])
    edge = np.ceil(border).clip(0, width).astype(np.int64)
    edge[:, 1] = np.maximum(edge[:, 1], edge[:, 0])
    edge += np.arange(rows, dtype=np.int64) * (width + 1)
    flat = sums.reshape(2, -1)
    mass, moment = flat[:, edge[:, 1]] - flat[:, edge[:, 0]]
    row = np.arange(rows, dtype=np.float32)
    total = np.maximum(mass.sum(axis=1, keepdims=True), _TINY)
    at, u = (mass @ row)[:, None] / total, moment.sum(axis=1, keepdims=True) / total
    about = row - at
    lean = (about * (moment - mass * u)).sum(axis=1) / np.maximum((mass * about * about).sum(axis=1), _TINY)
    return u + lean.clip(-MOST_LEAN, MOST_LEAN)[:, None] * about
