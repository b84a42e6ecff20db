"""Where each finger runs: its spine, the middle of what is lit between its seams at every station of its strip."""

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import cv2
import numpy as np

from common.arrays import Bool, Float, Int
from slave.wrist.corridors import STATION_PX
from slave.wrist.fingers import Fingers
from slave.wrist.led_depth import DARK, SHRINK, Float32
from slave.wrist.strips import ROW_PX, THUMB, strips_of, thumb_border
from slave.wrist.tip_templates import templates_of
from slave.wrist.view import WristView

EDGE_SHARE = np.float32(
    0.5
)  # of the nearness of a row's brightest: what is darker is a gap, or skin seen edge on
MOST_SPREAD = 0.36  # tan of 20 degrees, the limit of spreading
ROOT_PX = 36.0  # half of a broad finger near its root, and the pose of the palm
LIT = 2.0 * DARK  # grey levels of a finger's middle, as of a hand stretched out far
JUMP = 8.0  # columns from station to station: that is another finger
SMOOTH = 3  # stations
MOST_LEAN = 0.5 * ROW_PX / SHRINK  # columns per station
MOST = np.float32(12.0)  # grey levels^0.5 that count: what is nearer than a finger is the thumb
SLACK = np.float32(1.0)
_NEAR_LIT = np.float32(np.sqrt(LIT))
_TINY = np.float32(1e-6)
_ASIDE = np.arange(-11, 12, dtype=np.int32)  # a finger that faces the camera, and its bow
_COLUMN = _ASIDE.astype(np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class Fans:
    """Where the fingers of one hand can be: R stations.

    Attributes:
        low, high: (4, R) u between which index ... little can be.
        end: u where the thumb's strip ends.
        station: (R,) the station of the seams before each row; share (R,): how far it is to the next.
    """

    low: Float
    high: Float
    end: float
    station: Int
    share: Float


@lru_cache(maxsize=8)
def fans_of(view: WristView) -> Fans:
    """Those of one wrist rig and hand; made once."""
    bank, strips = templates_of(view), strips_of(view)
    corridors, v = strips.corridors, strips.v
    lean = MOST_SPREAD * np.maximum(bank.root_uv[:, 1:] - v, 0.0) + ROOT_PX
    last = corridors.middle.shape[1] - 1
    at: Float = ((v - corridors.row) / STATION_PX).clip(0.0, last - 1e-9)
    station: Int = at.astype(np.int64)
    end = strips.first_u + SHRINK * strips.map_x.shape[1]
    return Fans(bank.root_uv[:, :1] - lean, bank.root_uv[:, :1] + lean, end, station, np.mod(at, 1.0))


def borders(fingers: Fingers, view: WristView) -> Float32:
    """Columns (5, 2, R) of the strips between which thumb, index ... little are: by their seams and their roots."""
    fans, strips, corridors, seams = fans_of(view), strips_of(view), fingers.corridors, fingers.seams
    out = np.empty((5, 2, len(strips.v)))
    out[THUMB] = thumb_border(seams[3], strips), np.full(len(strips.v), fans.end)
    between = seams[:3, fans.station] * (1.0 - fans.share) + seams[:3, fans.station + 1] * fans.share
    beside = _column(corridors.pixels(3, seams[3]), strips.v)
    out[1:, 0], out[1:, 1] = fans.low, fans.high
    right = int(corridors.thumb_side > 0.0)
    near, far = out[1:, right], out[1:, 1 - right]
    nearer, farther = (np.minimum, np.maximum) if right else (np.maximum, np.minimum)
    nearer(near[0], beside, out=near[0])
    nearer(near[1:], between, out=near[1:])
    farther(far[:3], between, out=far[:3])
    return ((out - 0.5 * (SHRINK - 1)) / SHRINK).astype(np.float32)


def _column(line: Float, v: Float) -> Float:
    """Where a seam (S, 2) [px] crosses rows [px]; one that turns back is taken where it first came."""
    up = line[::-1] if line[0, 1] < line[-1, 1] else line
    row = np.minimum.accumulate(up[:, 1])
    return np.interp(v, row[::-1], up[::-1, 0])


def spines(near: Float32, border: Float32, rows: int) -> Float:
    """Columns (5, R) of the fingers' middles in the strips; beyond a finger's ends as at its ends.

    Args:
        near: (h, w) nearness of the strips [grey levels^0.5].
        border: (5, 2, h) columns between which the fingers are.
        rows: R, the first stations.
    """
    width = near.shape[1]
    near, border = near[:rows], border[..., :rows]
    lines = _straight(near, border)
    columns = np.rint(lines).astype(np.int32)[..., None] + _ASIDE
    at = columns.clip(0, width - 1)
    at += (np.arange(rows, dtype=np.int32) * np.int32(width))[:, None]
    light = near.ravel().take(at)
    light *= (columns >= border[:, 0, :, None] - SLACK) & (columns <= border[:, 1, :, None] + SLACK)
    brightest = light.max(axis=2)
    light *= light > (EDGE_SHARE * brightest)[..., None]
    light *= light
    middle = columns[..., len(_ASIDE) // 2] + (light @ _COLUMN) / np.maximum(light.sum(axis=2), _TINY)
    dark = brightest <= _NEAR_LIT
    cut = dark.copy()
    cut[:, :-1] |= np.abs(np.diff(middle, axis=1)) > JUMP
    for finger, line in enumerate(middle):
        run = _run(cut[finger], brightest[finger])
        if run is None:
            line[:] = lines[finger]
            continue
        line[: run.start] = line[run.start]
        line[run.stop :] = line[run.stop - 1]
    return np.asarray(cv2.blur(middle, (SMOOTH, 1), borderType=cv2.BORDER_REPLICATE), dtype=np.float64)


def _run(cut: Bool, brightest: Float32) -> slice | None:
    """The stations of a finger: between those dark or at a leap, where most light is; None: too few."""
    ends = [-1, *cut.nonzero()[0].tolist(), len(cut)]
    sums = [0.0, *brightest.cumsum().tolist()]
    _, a, b = max((sums[b] - sums[a + 1], a + 1, b) for a, b in pairwise(ends))
    return slice(a, b) if b - a >= SMOOTH else None


def _straight(near: Float32, border: Float32) -> Float32:
    """The straight lines (5, R) that fit best what is lit between the borders."""
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
