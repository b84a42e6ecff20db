"""A laser's line is found on a board, in pictures.

It is sought in the board's own plane, where it is straight: the difference (laser - ambient) is laid out flat
by the pose of the board. Only what lies within the board's squares counts, so that a line on the table beside it
cannot. The brightest straight line is found by consensus; then, in steps of a pixel, its profile across is
centred with a Gaussian window that moves until it rests. Profiles near the borders of squares are rejected: there
the paper, not the light, makes the slope.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from common.arrays import Float, Image
from common.errors import FitError
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import transform
from master.calibrate.cameras.boards import Board, grid_shape
from master.calibrate.wrist.device import BoardPose

Grey = npt.NDArray[np.float32]

_NOISE_TIMES = 6.0
_MIN_PROFILES = 12
_TOO_SHORT = "the laser line is seen on less than a square of the board: let it cross the board's middle"


@dataclass(frozen=True, slots=True, eq=False)
class BoardLine:
    """The line of one view."""

    points_m: Float  # (n, 3) on the board, camera frame [m]
    uv: Float  # (n, 2) [px] the same in the image
    sigma_px: float  # standard deviation of the whole line's place, across it
    rms_px: float  # rms distance of single points from it


def line_on_board(
    laser: Image, ambient: Image, placed: BoardPose, board: Board, optics: CameraModel
) -> BoardLine:
    """Points of the laser's line on the board, from frames (H, W).

    Raises:
        FitError: There is no line across the board; the text is the reason.
    """
    difference = np.asarray(laser, np.float32) - np.asarray(ambient, np.float32)
    pixel_m = float(placed.centre_m[2]) / float(np.sqrt(optics.matrix[0, 0] * optics.matrix[1, 1]))
    flat, at, texel_m = _laid_flat(difference, placed.T_camera_board, board, pixel_m, optics)
    background = float(np.median(flat))
    noise = 1.4826 * float(np.median(np.abs(flat - background))) + 0.5
    point, along = _brightest_line(flat - background, at, noise, 1.5 * texel_m)
    coarse = _profiles(difference, point, along, pixel_m, noise, placed, board, optics)
    found = _profiles(difference, coarse.point, coarse.along, pixel_m, noise, placed, board, optics)
    return BoardLine(found.points_m, optics.project(found.points_m), found.sigma_px, found.rms_px)


def _laid_flat(
    difference: Grey, T: Float, board: Board, pixel_m: float, optics: CameraModel
) -> tuple[Float, Float, float]:
    """Values (n,), places (n, 2) [m] on the board's plane, and a texel's side [m]."""
    rows, columns = grid_shape(board)
    side = board.square_m
    texel_px = 0.6
    most_texels = 900  # per side
    texel = max(texel_px * pixel_m, max(columns + 1, rows + 1) * side / most_texels)
    x, y = np.meshgrid(np.arange(-side, columns * side, texel), np.arange(-side, rows * side, texel))
    uv = optics.project(transform(T, np.stack([x, y, np.zeros_like(x)], axis=-1)))
    values = _sampled(difference, uv)
    known = np.isfinite(values)
    if not known.any():
        raise FitError("the board is outside the image")
    return values[known], np.stack([x[known], y[known]], axis=1), texel


def _brightest_line(values: Float, at: Float, noise: float, within_m: float) -> tuple[Float, Float]:
    """Point and direction (2,) of the line with most light, by consensus of pairs."""
    bright = values > max(_NOISE_TIMES * noise, 0.3 * float(np.percentile(values, 99.8)))
    if bright.sum() < _MIN_PROFILES:
        raise FitError("no laser line on the board: let the line cross it, in a room that is not too bright")
    places, weights = at[bright], values[bright]
    rng = np.random.default_rng(0)
    if len(places) > 2000:
        few = rng.choice(len(places), 2000, replace=False)
        places, weights = places[few], weights[few]
    pairs = 300
    a, b = places[rng.integers(0, len(places), (2, pairs))]
    way = b - a
    length = np.linalg.norm(way, axis=1)
    a, way, length = a[length > 0], way[length > 0], length[length > 0]
    across = np.stack([-way[:, 1], way[:, 0]], axis=1) / length[:, None]
    off = np.abs(places @ across.T - (a * across).sum(axis=1))
    best = int(np.argmax(weights @ (off < within_m)))
    own = off[:, best] < within_m
    middle = np.average(places[own], axis=0, weights=weights[own])
    spread = (places[own] - middle) * np.sqrt(weights[own])[:, None]
    return middle, np.linalg.svd(spread, full_matrices=False)[2][0]


@dataclass(frozen=True, slots=True, eq=False)
class _Centred:
    """Line on the board: point and direction (2,), points (n, 3) [m], uncertainty."""

    point: Float
    along: Float
    points_m: Float
    sigma_px: float
    rms_px: float


def _profiles(
    difference: Grey,
    point: Float,
    along: Float,
    pixel_m: float,
    noise: float,
    placed: BoardPose,
    board: Board,
    optics: CameraModel,
) -> _Centred:
    """Centre the line in profiles a pixel apart, and fit a straight line to that."""
    rows, columns = grid_shape(board)
    side = board.square_m
    across = np.array([-along[1], along[0]])
    reach = np.hypot(columns + 1, rows + 1) * side
    s = np.arange(-reach, reach, pixel_m)
    base = point + s[:, None] * along
    inside = ((base > -side) & (base < np.array([columns, rows]) * side)).all(axis=1)
    # Distance from the nearest border of squares, in both directions of the board.
    from_border = np.abs(base / side - np.rint(base / side)).min(axis=1) * side
    border_px = 3.0  # kept from the borders of squares ...
    border = 0.3  # ... but never more of a square than this
    clear = from_border > min(border_px * pixel_m, border * side)
    s, base = s[inside & clear], base[inside & clear]
    if len(s) < _MIN_PROFILES:  # such as a line along the border of two rows
        raise FitError(_TOO_SHORT)
    reach_px = 8.0  # of a profile to both sides
    step_px = 0.25
    d = np.arange(-reach_px, reach_px + 0.5 * step_px, step_px)
    places = base[:, None] + (d[:, None] * pixel_m) * across
    flat = np.concatenate([places, np.zeros((*places.shape[:2], 1))], axis=-1)
    profile = _sampled(difference, optics.project(transform(placed.T_camera_board, flat)))
    whole = np.isfinite(profile).all(axis=1)
    s, profile = s[whole], profile[whole]
    light = profile - np.median(profile[:, np.abs(d) > 0.6 * reach_px], axis=1)[:, None]
    # Wider than what is brighter than half of it: on the flat top of a saturated line a narrow one would rest anywhere.
    half = 0.5 * step_px * (light > 0.5 * light.max(axis=1, initial=0.0)[:, None]).sum(axis=1)
    window_px = 1.6  # standard deviation of the window: a little wider than the line ...
    # ... that is, than the half of it that is brighter than its half
    window = np.maximum(window_px, 1.2 * half)[:, None]
    centre = np.zeros(len(s))
    for _ in range(8):
        weight = light * np.exp(-0.5 * ((d - centre[:, None]) / window) ** 2)
        total = weight.sum(axis=1)
        centre = np.where(total > 0, (weight * d).sum(axis=1) / np.where(total > 0, total, 1.0), np.nan)
    height = light[np.arange(len(s)), np.abs(d - np.nan_to_num(centre)[:, None]).argmin(axis=1)]
    # A line stands out from what is beside it; an even light, as that of the LEDs, does not.
    flank = np.abs(light[:, np.abs(d) > 0.6 * reach_px]).max(axis=1, initial=0.0)
    good = (np.abs(centre) < 0.5 * reach_px) & (height > _NOISE_TIMES * noise) & (height > 3.0 * flank)
    s, centre = s[good], centre[good]
    if len(s) < _MIN_PROFILES or np.ptp(s) < side:
        raise FitError(_TOO_SHORT)
    kept = np.ones(len(s), dtype=np.bool_)
    slope = level = 0.0
    off = centre
    for _ in range(4):
        slope, level = np.polyfit(s[kept], centre[kept], 1)
        off = centre - (slope * s + level)
        scatter = max(1.4826 * float(np.median(np.abs(off[kept]))), 0.03)
        kept = np.abs(off) < 3.0 * scatter
    if kept.sum() < max(_MIN_PROFILES, 0.5 * len(s)):
        raise FitError("what is bright on the board is no straight line")
    rms = float(np.sqrt(np.mean(off[kept] ** 2)))
    xy = point + s[kept, None] * along + (centre[kept, None] * pixel_m) * across
    points = transform(placed.T_camera_board, np.concatenate([xy, np.zeros((len(xy), 1))], axis=1))
    tilted = along + slope * pixel_m * across
    line_floor_px = 0.015  # of a line's place: speckle and paper that no number of profiles averages out
    sigma = float(np.hypot(rms / np.sqrt(kept.sum()), line_floor_px))
    return _Centred(point + level * pixel_m * across, tilted / np.linalg.norm(tilted), points, sigma, rms)


def _sampled(image: Grey, uv: Float) -> Float:
    """Values (...) of a float image (H, W) at uv (..., 2), interpolated; NaN outside."""
    height, width = image.shape
    u, v = np.moveaxis(uv.astype(np.float32), -1, 0)
    inside = (u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1)
    u, v = np.atleast_2d(np.where(inside, u, 0.0)), np.atleast_2d(np.where(inside, v, 0.0))
    found = cv2.remap(image, u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR)
    return np.where(inside, np.asarray(found, np.float64).reshape(inside.shape), np.nan)
