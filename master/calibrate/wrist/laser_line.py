"""A laser's line is found on a board, in pictures.

It is sought in the board's own plane, where it is straight: the difference (laser - ambient) is laid out flat
by the pose of the board. Where there is no ambient frame, the squares' own light, a plane through the levels of
each, is taken off instead. Only what lies within the board's squares counts, so that a line on the table beside it
cannot. The brightest straight line is found by consensus; then, in steps of a pixel, its profile across is
centred with a Gaussian window that moves until it rests. Profiles near the borders of squares are rejected: there
the paper, not the light, makes the slope.
"""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.ndimage import map_coordinates  # pyright: ignore[reportUnknownVariableType]

from common.arrays import Bool, Float, Image, Int
from common.errors import FitError
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import transform
from master.calibrate.cameras.boards import Board, CircleGrid, grid_shape
from master.calibrate.wrist.device import BoardPose

Grey = npt.NDArray[np.float32]

_NOISE_TIMES = 6.0
_MIN_PROFILES = 12
_ON_BORDER = (
    "the laser line runs along the border of two rows of squares: shift the board, so that it crosses them"
)
_TOO_SHORT = "the laser line is seen on less than a square of the board: let it cross the board's middle"


@dataclass(frozen=True, slots=True, eq=False)
class BoardLine:
    """The line of one view."""

    points_m: Float  # (n, 3) on the board, camera frame [m]
    uv: Float  # (n, 2) [px] the same in the image
    sigma_px: float  # standard deviation of the whole line's place, across it
    rms_px: float  # rms distance of single points from it


def line_on_board(
    laser: Image, ambient: Image | None, placed: BoardPose, board: Board, optics: CameraModel
) -> BoardLine:
    """Points of the laser's line on the board, from frames (H, W) or (H, W, 3).

    Without an ambient frame the board may be lit in the laser's own.

    Raises:
        FitError: There is no line across the board; the text is the reason.
    """
    image = np.asarray(laser, np.float32) - (0.0 if ambient is None else np.asarray(ambient, np.float32))
    pixel_m = float(placed.centre_m[2]) / float(np.sqrt(optics.matrix[0, 0] * optics.matrix[1, 1]))
    if image.ndim == 3:  # all colours alike: a grey picture hardly has the light of a blue laser
        image = image.mean(axis=2)
    light = _BoardLight(image, placed.T_camera_board, board, optics)
    at, texel_m = _texels(board, pixel_m)
    if ambient is None:
        light = light.without_squares(at, pixel_m)
    flat = light(at)
    known = np.isfinite(flat)
    if not known.any():
        raise FitError(
            "the board is outside the image" if ambient is not None else "its squares are saturated"
        )
    flat, at = flat[known], at[known]
    background = float(np.median(flat))
    noise = 1.4826 * float(np.median(np.abs(flat - background))) + 0.5
    point, along = _brightest_line(flat - background, at, noise, 1.5 * texel_m)
    # Of a profile to both sides: beyond the light of a broad line as well.
    reach_px = max(8.0, 4.0 * _half_width_px(flat - background, at, point, along, pixel_m))
    point, along, _ = _profiles(light, point, along, pixel_m, noise, placed, reach_px)
    return _profiles(light, point, along, pixel_m, noise, placed, reach_px)[2]


def _texels(board: Board, pixel_m: float) -> tuple[Float, float]:
    """Places (n, 2) [m] on the board's plane, and a texel's side [m]."""
    rows, columns = grid_shape(board)
    side = board.square_m
    texel_px = 0.6
    most_texels = 900  # per side
    texel = max(texel_px * pixel_m, max(columns + 1, rows + 1) * side / most_texels)
    x, y = np.meshgrid(np.arange(-side, columns * side, texel), np.arange(-side, rows * side, texel))
    return np.stack([x.ravel(), y.ravel()], axis=1), texel


@dataclass(frozen=True, slots=True, eq=False)
class _BoardLight:
    """Levels on the board's plane, of an image (H, W)."""

    image: Grey
    T_camera_board: Float
    board: Board
    optics: CameraModel
    squares: Float | None = None  # (rows + 1, columns + 1, 3) level of each, and its slopes; NaN: not usable
    border_m: float = 0.0  # what is nearer to a border of squares is not known

    def __call__(self, xy: Float) -> Float:
        """Levels (...) at places (..., 2) [m]; NaN: outside, or not known."""
        flat = np.concatenate([xy, np.zeros((*xy.shape[:-1], 1))], axis=-1)
        u, v = np.moveaxis(self.optics.project(transform(self.T_camera_board, flat)), -1, 0)
        grey = self.image
        values = np.asarray(
            map_coordinates(grey, [v, u], order=1, cval=np.nan, output=np.float64), np.float64
        )
        if self.squares is None:
            return values
        cell, terms, clear = self._in_squares(xy)
        return np.where(
            clear, values - (self.squares[cell[..., 1], cell[..., 0]] * terms).sum(axis=-1), np.nan
        )

    def _in_squares(self, xy: Float) -> tuple[Int, Float, Bool]:
        """Numbers (..., 2) of squares, terms (..., 3) of their levels, clear of borders."""
        side = self.board.square_m
        cell = np.floor(xy / side).astype(np.int64)
        within = xy / side - cell - 0.5
        rows, columns = grid_shape(self.board)
        clear = _from_border_m(self.board, xy) > self.border_m
        if isinstance(self.board, CircleGrid):  # paper alone
            clear &= np.hypot(*np.moveaxis(0.5 - np.abs(within), -1, 0)) > 0.5 * self.board.circle_m / side
        clear &= ((cell >= -1) & (cell < [columns, rows])).all(axis=-1)
        cell = np.clip(cell + 1, 0, [columns, rows])
        return cell, np.concatenate([np.ones_like(within[..., :1]), within], axis=-1), clear

    def without_squares(self, at: Float, pixel_m: float) -> "_BoardLight":
        """The same less the board's own light, which is measured at places (n, 2).

        A square is left out where it is saturated, or has a print of its own, such as a marker.
        """
        border_px = 2.0  # of the lens and of the pose, which blur borders
        near = replace(self, squares=None, border_m=border_px * pixel_m)
        values = self(at)
        cell, terms, clear = near._in_squares(at)
        clear &= np.isfinite(values)
        rows, columns = grid_shape(self.board)
        squares, spread = (
            np.full((rows + 1, columns + 1, 3), np.nan),
            np.full((rows + 1, columns + 1), np.nan),
        )
        for j, i in np.ndindex(rows + 1, columns + 1):
            own = clear & (cell == [i, j]).all(axis=1)
            brightest = 250.0  # levels: what is saturated shows no line
            if own.sum() < 30 or np.median(values[own]) >= brightest:
                continue
            squares[j, i], spread[j, i] = _level_plane(terms[own], values[own])
        printed = (
            spread > 3.0 * np.nanquantile(spread, 0.25) + 2.0 if np.isfinite(spread).any() else spread > 0
        )
        squares[printed] = np.nan
        return replace(near, squares=squares)


def _from_border_m(board: Board, xy: Float) -> Float:
    """Distance (...) of places (..., 2) [m] from the nearest border of the print."""
    off = np.abs(xy / board.square_m - np.rint(xy / board.square_m)) * board.square_m
    if isinstance(board, CircleGrid):
        return np.abs(np.hypot(off[..., 0], off[..., 1]) - 0.5 * board.circle_m)
    return off.min(axis=-1)


def _level_plane(terms: Float, values: Float) -> tuple[Float, float]:
    """Level and slopes (3,) of a square, whose line is an outlier, and robust spread."""
    found, limit = np.array([np.median(values), 0.0, 0.0]), np.inf
    for _ in range(4):
        off = np.abs(values - terms @ found)
        limit = 1.4826 * float(np.median(off)) + 0.3
        own = off < 3.0 * limit
        found = np.asarray(np.linalg.lstsq(terms[own], values[own], rcond=None)[0], np.float64)
    return found, limit


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


def _half_width_px(values: Float, at: Float, point: Float, along: Float, pixel_m: float) -> float:
    """How far from a line its light falls to a half, by levels (n,) at (n, 2)."""
    most_px = 40
    off = np.abs((at - point) @ [-along[1], along[0]]) / pixel_m
    near = off < most_px
    bins = off[near].astype(np.int64)
    mean = np.bincount(bins, values[near], most_px) / np.maximum(np.bincount(bins, minlength=most_px), 1)
    low = mean < 0.5 * mean[0]
    return float(np.argmax(low)) if low.any() else float(most_px)


def _profiles(
    light: _BoardLight,
    point: Float,
    along: Float,
    pixel_m: float,
    noise: float,
    placed: BoardPose,
    reach_px: float,
) -> tuple[Float, Float, BoardLine]:
    """Centre the line in profiles a pixel apart, and fit a straight line to that.

    Returns a point and direction (2,) of it on the board, and the line.
    """
    board = light.board
    rows, columns = grid_shape(board)
    side = board.square_m
    across = np.array([-along[1], along[0]])
    reach = np.hypot(columns + 1, rows + 1) * side
    s = np.arange(-reach, reach, pixel_m)
    base = point + s[:, None] * along
    inside = ((base > -side) & (base < np.array([columns, rows]) * side)).all(axis=1)
    from_border = _from_border_m(board, base)
    border_px = 3.0  # kept from the borders of squares ...
    border = 0.3  # ... but never more of a square than this
    clear = from_border > min(border_px * pixel_m, border * side)
    s, base = s[inside & clear], base[inside & clear]
    reason = _TOO_SHORT if 2 * len(s) > inside.sum() else _ON_BORDER
    if len(s) < _MIN_PROFILES:
        raise FitError(reason)
    step_px = 0.25
    d = np.arange(-reach_px, reach_px + 0.5 * step_px, step_px)
    places = base[:, None] + (d[:, None] * pixel_m) * across
    profile = light(places)
    beside = np.abs(d) > 0.6 * reach_px
    if light.squares is None:
        whole = np.isfinite(profile).all(axis=1)
    else:  # a border of squares beside the line is not known
        known = np.isfinite(profile)
        whole = known[:, ~beside].all(axis=1) & (known[:, beside].mean(axis=1) > 0.3)
    s, profile = s[whole], profile[whole]
    if not len(s):
        raise FitError(reason)
    level = np.nan_to_num(profile - np.nanmedian(profile[:, beside], axis=1)[:, None])
    # Wider than what is brighter than half of it: on the flat top of a saturated line a narrow one would rest anywhere.
    half = 0.5 * step_px * (level > 0.5 * level.max(axis=1, initial=0.0)[:, None]).sum(axis=1)
    window_px = 1.6  # standard deviation of the window: a little wider than the line ...
    # ... that is, than the half of it that is brighter than its half
    window = np.maximum(window_px, 1.2 * half)[:, None]
    centre = np.zeros(len(s))
    for _ in range(8):
        weight = level * np.exp(-0.5 * ((d - centre[:, None]) / window) ** 2)
        total = weight.sum(axis=1)
        centre = np.where(total > 0, (weight * d).sum(axis=1) / np.where(total > 0, total, 1.0), np.nan)
    height = level[np.arange(len(s)), np.abs(d - np.nan_to_num(centre)[:, None]).argmin(axis=1)]
    # A line stands out from what is beside it; an even light, as that of the LEDs, does not.
    flank = np.abs(level[:, beside]).max(axis=1, initial=0.0)
    good = (np.abs(centre) < 0.5 * reach_px) & (height > _NOISE_TIMES * noise) & (height > 3.0 * flank)
    s, centre = s[good], centre[good]
    if len(s) < _MIN_PROFILES or np.ptp(s) < side:
        raise FitError(reason)
    kept = np.ones(len(s), dtype=np.bool_)
    slope = shift = 0.0
    off = centre
    for _ in range(4):
        slope, shift = np.polyfit(s[kept], centre[kept], 1)
        off = centre - (slope * s + shift)
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
    line = BoardLine(points, light.optics.project(points), sigma, rms)
    return point + shift * pixel_m * across, tilted / np.linalg.norm(tilted), line
