"""A laser plane is fitted through the laser's lines on boards.

**Line.** It is sought in the board's own plane, where it is straight: the difference (laser - ambient) is
laid out flat by the pose of the board. Only what lies within the board's squares counts, so that a line on
the table beside it cannot. The brightest straight line is found by consensus; then, in steps of a pixel, its
profile across is centred with a Gaussian window that moves until it rests. Profiles near the borders of
squares are rejected: there the paper, not the light, makes the slope.

**Plane.** Every view gives one straight line in space; its distance from a plane is two numbers (two points
of it with the spread of all its points). Their covariance is that of the board's pose, which all points of a
view share, and of the line's place in the image; so a thousand points of one view do not count as a thousand.
A plane is constrained by lines that are not all the same one; the covariance states how well, and what is not
known to a tenth of a degree and of a millimetre is refused.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations

import cv2
import numpy as np
import numpy.typing as npt

from common.arrays import Bool, Float, Image
from common.calibration.rig import LaserPlane
from common.errors import FitError
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import cross, transform
from master.calibrate.adjust import Normal, minimise
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


NORMAL_LIMIT_RAD = np.radians(0.1)
_WRONG_CHI2 = 22.0  # of two degrees of freedom: one in 60 000


@dataclass(frozen=True, slots=True, eq=False)
class ViewLine:
    """One view's line in space."""

    name: str
    points_m: Float  # (n, 3) [m], camera frame
    ends_m: Float  # (2, 3) two points of the line with the mean and the spread of all
    placed: BoardPose  # the board it lies on
    sigma_px: float  # standard deviation of the line's place in the image
    focal_px: float

    @classmethod
    def of(cls, name: str, line: BoardLine, placed: BoardPose, focal_px: float) -> "ViewLine":
        """Reduce a line to two points."""
        mean = line.points_m.mean(axis=0)
        _, sizes, axes = np.linalg.svd(line.points_m - mean, full_matrices=False)
        spread = sizes[0] / np.sqrt(len(line.points_m)) * axes[0]
        return cls(
            name, line.points_m, np.stack([mean - spread, mean + spread]), placed, line.sigma_px, focal_px
        )

    def covariance(self, normal: Float) -> Float:
        """(2, 2) [m^2] of the distances of both ends from a plane with this normal.

        A board that turns or shifts moves a point along its ray, with b its normal and d = X - centre:
        X' = X (1 + (b . shift + turn . (d x b)) / b . X).
        """
        facing = self.placed.T_camera_board[:3, 2]
        d = self.ends_m - self.placed.centre_m
        share = (self.ends_m @ normal) / (self.ends_m @ facing)
        board = np.broadcast_to(facing, d.shape)
        by_pose = share[:, None] * np.concatenate([cross(d, board), board], axis=1)
        own = self.sigma_px * self.ends_m[:, 2] / self.focal_px
        model_m = 1e-5  # what lens and paper add to every view that neither covariance knows
        return by_pose @ self.placed.covariance @ by_pose.T + np.diag(own**2 + model_m**2)


@dataclass(frozen=True, slots=True, eq=False)
class PlaneFit:
    """A measured laser plane."""

    plane: LaserPlane  # normal . X = offset, offset positive
    covariance: Float  # (4, 4) of normal and offset [m]; of the normal only across itself
    rms_m: float  # distance of the used points from the plane
    used: Bool  # (views,) the views it is from
    off_m: Float  # (views,) rms distance of each view's points

    @property
    def normal_sigma_rad(self) -> float:
        """Largest standard deviation of the normal [rad], in its least certain direction."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[:3, :3])[-1]))

    @property
    def offset_sigma_m(self) -> float:
        """Standard deviation of the offset [m]."""
        return float(np.sqrt(self.covariance[3, 3]))


def fit_plane(views: Sequence[ViewLine]) -> PlaneFit:
    """The plane through the lines of at least three views.

    Raises:
        FitError: Too few views, too few agree, or their lines constrain no plane, or too weakly; the text
            states what to do.
    """
    min_views = 3
    if len(views) < min_views:
        raise FitError(
            f"the line is seen on the board in {len(views)} views, at least {min_views} are needed (better 10), each"
            " with the board at another distance and tilt"
        )
    normal, offset = _consensus(views)
    used, cov = np.zeros(len(views), dtype=np.bool_), np.eye(4)
    for _ in range(6):
        good = _agreeing(views, normal, offset)
        if (good == used).all():
            break
        used = good
        if used.sum() < max(min_views, (len(views) + 1) // 2):
            raise FitError(
                f"only {int(used.sum())} of {len(views)} views agree on one plane: is the laser fixed to the camera,"
                " and the board flat? Views with the line on something else than the board must be taken anew"
            )
        normal, offset, cov = _least_squares([v for v, own in zip(views, used, strict=True) if own], normal)
    cov = cov * max(1.0, _reduced(views, used, normal, offset))
    off = np.array([_off(view, normal, offset) for view in views])
    points = np.concatenate([view.points_m for view, own in zip(views, used, strict=True) if own])
    rms = float(np.sqrt(np.mean((points @ normal - offset) ** 2)))
    fit = PlaneFit(LaserPlane(normal=_vector(normal), offset_m=round(float(offset), 9)), cov, rms, used, off)
    _refuse_unsure(fit, points)
    return fit


def _consensus(views: Sequence[ViewLine]) -> tuple[Float, float]:
    """Normal and offset of the plane through two lines that most others agree with."""
    pairs: list[tuple[int, int]] = list(combinations(range(len(views)), 2))
    most_pairs = 300
    if len(pairs) > most_pairs:
        chosen = np.random.default_rng(0).choice(len(pairs), most_pairs, replace=False)
        pairs = [pairs[int(i)] for i in chosen]
    best, cost = (np.array([0.0, 1.0, 0.0]), 0.0), np.inf
    for i, j in pairs:
        normal, offset = _through(np.concatenate([views[i].ends_m, views[j].ends_m]))
        own = sum(min(_chi2(view, normal, offset), _WRONG_CHI2) for view in views)
        if own < cost:
            best, cost = (normal, offset), own
    return best


def _through(points: Float) -> tuple[Float, float]:
    """Plane of least squares through points (n, 3); offset positive."""
    mean = points.mean(axis=0)
    normal = np.linalg.svd(points - mean)[2][2]
    normal = normal * (1.0 if normal @ mean >= 0 else -1.0)
    return normal, float(normal @ mean)


def _chi2(view: ViewLine, normal: Float, offset: float) -> float:
    off = view.ends_m @ normal - offset
    return float(off @ np.linalg.solve(view.covariance(normal), off))


def _off(view: ViewLine, normal: Float, offset: float) -> float:
    return float(np.sqrt(np.mean((view.points_m @ normal - offset) ** 2)))


def _agreeing(views: Sequence[ViewLine], normal: Float, offset: float) -> Bool:
    """Which views (V,) agree with a plane."""
    chi2 = np.array([_chi2(view, normal, offset) for view in views])
    off = np.array([_off(view, normal, offset) for view in views])
    # The covariances may be small by a common factor: a wrong view is one whose residual is larger than most.
    times = max(1.0, float(np.median(chi2)) / 1.386)
    wrong_m = 1.5e-4  # a view that is less off than this is not wrong, however sure it claims to be
    return (chi2 < _WRONG_CHI2 * times) | (off < wrong_m)


def _reduced(views: Sequence[ViewLine], used: Bool, normal: Float, offset: float) -> float:
    """Chi square per degree of freedom."""
    total = sum(_chi2(view, normal, offset) for view, own in zip(views, used, strict=True) if own)
    return total / max(2.0 * float(used.sum()) - 3.0, 1.0)


def _least_squares(views: Sequence[ViewLine], normal: Float) -> tuple[Float, float, Float]:
    """Normal, offset, covariance (4, 4), from a first normal."""
    middle = np.concatenate([view.ends_m for view in views]).mean(axis=0)
    # By turn of the normal and distance from the middle, which hardly depend on each other.
    found = minimise(partial(_equations, views, middle), _stepped, np.append(normal, 0.0), steps=20)
    normal, tangents = found.x[:3], _tangents(found.x[:3])
    offset = float(normal @ middle + found.x[3])
    to4 = np.zeros((4, 3))
    to4[:3, :2] = tangents
    to4[3] = np.append(middle @ tangents, 1.0)
    sign = -1.0 if offset < 0.0 else 1.0
    return sign * normal, sign * offset, to4 @ found.normal.covariance() @ to4.T


def _equations(views: Sequence[ViewLine], middle: Float, plane: Float) -> Normal:
    """Normal equations of a plane (normal, distance from the middle)."""
    out, normal, tangents = Normal(3), plane[:3], _tangents(plane[:3])
    for view in views:
        whiten, arm = np.linalg.inv(np.linalg.cholesky(view.covariance(normal))), view.ends_m - middle
        by = np.concatenate([arm @ tangents, -np.ones((2, 1))], axis=1)
        out.add((whiten @ (arm @ normal - plane[3]))[None], (whiten @ by)[None])
    return out


def _stepped(plane: Float, step: Float, _own: Float) -> Float:
    normal = plane[:3] + _tangents(plane[:3]) @ step[:2]
    return np.append(normal / np.linalg.norm(normal), plane[3] + step[2])


def _tangents(normal: Float) -> Float:
    """Two directions (3, 2) in a plane."""
    return np.linalg.svd(normal[None])[2][1:].T


def _refuse_unsure(fit: PlaneFit, points: Float) -> None:
    """Refuse points on one line, and a plane that is too uncertain."""
    offset_limit_m = 1e-4
    if fit.normal_sigma_rad <= NORMAL_LIMIT_RAD and fit.offset_sigma_m <= offset_limit_m:
        return
    wide = np.linalg.svd(points - points.mean(axis=0), compute_uv=False) / np.sqrt(len(points))
    if wide[1] < max(5.0 * fit.rms_m, 0.1 * wide[0]):
        raise FitError(_collinear(wide[1]))
    raise FitError(
        f"the plane is known to {np.degrees(fit.normal_sigma_rad):.2f} deg and {1e3 * fit.offset_sigma_m:.2f} mm only"
        f" (limits {np.degrees(NORMAL_LIMIT_RAD):.1f} deg, {1e3 * offset_limit_m:.1f} mm): show the board in more"
        " views, nearer and farther, so large that it fills a third of the image"
    )


def _collinear(wide_m: float) -> str:
    return (
        f"all points of the laser lie on one line (they spread {1e3 * wide_m:.1f} mm across it): they define no plane;"
        " hold the board at other distances too, and turn it, so that the line falls elsewhere"
    )


def _vector(value: Float) -> tuple[float, float, float]:
    x, y, z = (round(float(number), 9) for number in value)
    return x, y, z
