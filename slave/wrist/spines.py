"""Where in the image each finger runs: its spine, the middle of what is lit between its seams at every row."""

from itertools import pairwise

import cv2
import numpy as np

from common.arrays import Float, Int
from slave.wrist.fingers import Fingers
from slave.wrist.led_depth import DARK, SHRINK, Float32
from slave.wrist.tip_templates import FingerTemplates

EDGE_SHARE = 0.5  # of the nearness of a row's brightest: what is darker is a gap, or skin seen edge on
MOST_SPREAD = 0.36  # tan of 20 degrees, the limit of spreading
ROOT_PX = 36.0  # half of a broad finger near its root, and the pose of the palm
LIT = 2.0 * DARK  # grey levels of a finger's middle, as of a hand stretched out far
JUMP = 5.0  # columns from row to row: that is another finger
SMOOTH = 5  # rows
MOST_LEAN = 0.5  # columns per row
MOST = 12.0  # grey levels^0.5 that count: what is nearer than a finger is the thumb
_ASIDE = np.arange(-11, 12)  # a finger that faces the camera, and its bow


def borders(fingers: Fingers, bank: tuple[FingerTemplates, ...], rows: int) -> Float:
    """Columns (4, 2, rows) of the shrunken image between which index ... little are: by their seams and their roots."""
    v: Float = (np.arange(rows, dtype=np.float64) + 0.5) * SHRINK - 0.5
    seams = [_column(line, v) for line in fingers.polylines()]
    thumb_right = fingers.corridors.thumb_side > 0.0
    beyond = np.full(rows, -1e4 if thumb_right else 1e4)
    sides = [(b, a) if thumb_right else (a, b) for a, b in pairwise([seams[3], *seams[:3], beyond])]
    roots = np.array([templates.root_uv for templates in bank])
    lean = MOST_SPREAD * np.maximum(roots[:, 1:] - v, 0.0) + ROOT_PX
    low, high = np.array(sides).transpose(1, 0, 2)
    low, high = np.maximum(low, roots[:, :1] - lean), np.minimum(high, roots[:, :1] + lean)
    return (np.stack([low, high], axis=1) - 0.5 * (SHRINK - 1)) / SHRINK


def _column(line: Float, v: Float) -> Float:
    """Where a seam (S, 2) [px] crosses rows [px]; one that turns back is taken where it first came."""
    up = line[np.argsort(-line[:, 1], kind="stable")] if line[0, 1] < line[-1, 1] else line
    row = np.minimum.accumulate(up[:, 1])
    return np.interp(v, row[::-1], up[::-1, 0])


def spines(near: Float32, border: Float) -> Float:
    """Columns (4, rows) of the fingers' middles in the shrunken image; above a finger's end as at its end.

    Args:
        near: (h, w) nearness [grey levels^0.5].
        border: (4, 2, rows) columns between which the fingers are; the first rows of the image.
    """
    rows, width = border.shape[2], near.shape[1]
    lines = _straight(near[:rows], border)
    columns = np.rint(lines).astype(np.int64)[..., None] + _ASIDE
    inside = (columns >= border[:, 0, :, None]) & (columns <= border[:, 1, :, None])
    light = near[np.arange(rows)[:, None], columns.clip(0, width - 1)] * inside
    brightest = light.max(axis=2)
    light[light <= EDGE_SHARE * brightest[..., None]] = 0.0
    light *= light
    middle = (light * columns).sum(axis=2) / np.maximum(light.sum(axis=2), np.float32(1e-6))
    ends = brightest * brightest <= LIT
    ends[:, :-1] |= np.abs(np.diff(middle, axis=1)) > JUMP
    out = np.empty(middle.shape)
    for finger in range(len(middle)):
        dark = np.flatnonzero(ends[finger])
        begin = int(dark[-1]) + 1 if dark.size else 0
        if rows - begin < SMOOTH:
            out[finger] = lines[finger]
            continue
        lit = middle[finger, begin:, None]
        out[finger, begin:] = cv2.blur(lit, (1, SMOOTH), borderType=cv2.BORDER_REPLICATE)[:, 0]
        out[finger, :begin] = out[finger, begin]
    return out


def _straight(near: Float32, border: Float) -> Float:
    """The straight lines (4, rows) that fit best what is lit between the borders."""
    rows, width = near.shape
    light = np.minimum(near, np.float32(MOST)) * (near > np.float32(np.sqrt(LIT)))
    sums = np.zeros((2, rows, width + 1))
    np.cumsum(light, axis=1, out=sums[0, :, 1:])
    np.cumsum(light * np.arange(width, dtype=np.float32), axis=1, out=sums[1, :, 1:])
    low, high = np.ceil(border.clip(0, width)).astype(np.int64).transpose(1, 0, 2)
    index: Int = np.arange(rows, dtype=np.int64)
    within: Float = sums[:, index, np.maximum(high, low)] - sums[:, index, low]
    mass, moment = within[0], within[1]
    row: Float = index.astype(np.float64)
    middle = moment / np.maximum(mass, 1e-6)
    total = np.maximum(mass.sum(axis=1, keepdims=True), 1e-6)
    at: Float = (mass @ row)[:, None] / total
    u: Float = (mass * middle).sum(axis=1, keepdims=True) / total
    about: Float = row - at
    lean: Float = (mass * about * (middle - u)).sum(axis=1)
    lean /= np.maximum((mass * about * about).sum(axis=1), 1e-6)
    return u + lean.clip(-MOST_LEAN, MOST_LEAN)[:, None] * about
