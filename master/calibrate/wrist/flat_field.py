"""The command `wrist flat-field` fits the illumination of LEDs and lens.

White squares of a board whose pose is known enter. White paper at X with normal n gets E = sum over LEDs of
cos / r^2; what a pixel has beyond that is the flat field F:

    led - ambient = k F(x, y) E

with k the paper and the gain, which nobody needs. The logarithm of k F is fitted: a power of the cosine off
the axis, as LEDs and lenses have it, times a smooth correction of third degree that is assumed to be small;
so F stays sane where there was no paper. Outliers (shine, shadow, dirt) count little. The file holds a
polynomial of sixth degree in the normalised image point, laid through this over the whole image. In the
corners of a wide lens, where F is a fifth, a polynomial follows a power of the cosine to ten per cent only;
in the middle half to two.
"""

from argparse import Namespace
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import cast

import cv2
import numpy as np

from common.arrays import Float, Image, Int
from common.calibration.rig import FlatField, terms_of
from common.errors import FitError
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import transform
from common.recording.frame_recording import Illumination
from master.calibrate.adjust import Normal, cauchy, minimise
from master.calibrate.cameras.boards import Board, board_in, grid_shape
from master.calibrate.picture import draw_flat_field
from master.calibrate.report import finish
from master.calibrate.tree_files import refusals_named
from master.calibrate.wrist.device import (
    BoardPose,
    LitView,
    board_in_views,
    board_pose,
    device_of,
    grouped_by_reason,
    lit_views,
    of_views,
    writes_key,
)

_STEEPEST = np.cos(np.radians(60.0))  # paper is no Lambertian beyond
_WITHIN = np.array([-0.22, 0.0, 0.22])  # of a square from its middle: clear of blurred borders
_DEGREE = 6
_GRID = (24, 32)
_PLACES = ["top left", "top", "top right", "left", "middle", "right", "bottom left", "bottom", "bottom right"]


@dataclass(frozen=True, slots=True, eq=False)
class WhiteSamples:
    """Light of white paper, over all views. S samples."""

    xy: Float  # (S, 2) normalised image points
    uv: Float  # (S, 2) [px]
    light: Float  # (S,) levels above ambient, divided by inverse square and cosine of the LEDs [levels m^2]
    view: Int  # (S,) number of the view


@dataclass(frozen=True, slots=True, eq=False)
class FlatFit:
    """A fitted flat field."""

    field: FlatField  # 1 on the axis
    rms: float  # relative residual of the samples, robust
    cross_validated_rms: float  # the same of views that were held out of the fit
    residual: Float  # (S,) relative residual of each sample


def white_samples(
    led: Image, ambient: Image, placed: BoardPose, board: Board, optics: CameraModel, led_m: Float
) -> tuple[Float, Float, Float]:
    """Samples of one view: xy (s, 2), uv (s, 2), light (s,) as in `WhiteSamples`.

    From frames (H, W) and LEDs at led_m (L, 3) [m].

    Raises:
        FitError: No white square is bright enough, or all are too bright; the text is the reason.
    """
    at, white = _squares(board, placed, optics, led)
    points = transform(placed.T_camera_board, at[white])
    uv = optics.project(points)
    height, width = led.shape
    inside = ((uv >= 2) & (uv <= np.array([width, height]) - 3.0)).all(axis=1)
    points, uv = points[inside], uv[inside]
    level = _at(np.asarray(cv2.blur(led.astype(np.float64) - ambient, (3, 3)), np.float64), uv)
    too_bright = _at(cast(Image, cv2.dilate(led, np.ones((3, 3), np.uint8))), uv) >= 250
    way = points[:, None] - led_m
    square = (way**2).sum(axis=2)
    cosine = (way @ placed.T_camera_board[:3, 2]) / np.sqrt(square)
    expected = (np.maximum(cosine, 0.0) / square).mean(axis=1)
    darkest = 8.0  # levels above ambient: below, noise and the byte's steps are several per cent
    good = ~too_bright & (level >= darkest) & (cosine.min(axis=1) >= _STEEPEST)
    if not good.any():
        if len(level) and too_bright.mean() > 0.5:
            raise FitError("its white squares are saturated: hold the board farther away")
        raise FitError(
            "its white squares are too dark or too steep: hold the board nearer, its face to the camera"
        )
    return points[good, :2] / points[good, 2:], uv[good], level[good] / expected[good]


def _squares(board: Board, placed: BoardPose, optics: CameraModel, led: Image) -> tuple[Float, Int]:
    """Positions (n, 3) on the board's whole squares, and numbers of the white ones."""
    rows, columns = grid_shape(board)
    j, i = np.mgrid[0 : rows - 1, 0 : columns - 1] + 0.5
    middles = np.stack([i.ravel(), j.ravel()], axis=1)
    spots = np.stack(np.meshgrid(_WITHIN, _WITHIN), axis=-1).reshape(-1, 2)
    at = (middles[:, None] + spots).reshape(-1, 2) * board.square_m
    at = np.concatenate([at, np.zeros((len(at), 1))], axis=1)
    odd = np.repeat((np.floor(middles).sum(axis=1) % 2).astype(np.int64), len(spots))
    level = _at(led, optics.project(transform(placed.T_camera_board, at)))
    light = [float(np.nanmedian(level[odd == k])) for k in (0, 1)]
    return at, np.flatnonzero(odd == int(np.argmax(light))).astype(np.int64)


def _at(image: Float | Image, uv: Float) -> Float:
    """Values (n,) of the nearest pixels; NaN outside."""
    height, width = image.shape
    u, v = np.rint(uv).T
    inside = (u >= 0) & (v >= 0) & (u < width) & (v < height)
    found = np.full(len(uv), np.nan)
    found[inside] = image[v[inside].astype(int), u[inside].astype(int)]
    return found


def fit_flat_field(samples: WhiteSamples, optics: CameraModel) -> FlatFit:
    """Fit the flat-field polynomial to the samples of five views or more.

    Raises:
        FitError: A part of the image without white paper (named), too few views, or light that follows no
            such law.
    """
    views = int(samples.view.max(initial=-1)) + 1
    folds = 5
    if views < folds:
        raise FitError(f"{views} views with white squares; at least {folds} are needed (better 20)")
    _refuse_uncovered(samples, (optics.width_px, optics.height_px))
    v, u = (np.indices(_GRID) + 0.5) * np.array([optics.height_px, optics.width_px])[:, None, None]
    pixels = np.stack([u / _GRID[1], v / _GRID[0]], axis=-1).reshape(-1, 2)
    grid = optics.undistort(pixels - 0.5)
    held_out = np.full(len(samples.light), np.nan)
    for fold in range(folds):
        out = samples.view % folds == fold
        fitted = _polynomial(_law(samples.xy[~out], samples.light[~out]), grid)
        held_out[out] = samples.light[out] / (terms_of(samples.xy[out], _DEGREE) @ fitted) - 1.0
    coefficients = _polynomial(_law(samples.xy, samples.light), grid)
    residual = samples.light / (terms_of(samples.xy, _DEGREE) @ coefficients) - 1.0
    relative = tuple(round(float(c / coefficients[0]), 7) for c in coefficients)
    fit = FlatFit(FlatField(coefficients=relative), _spread(residual), _spread(held_out), residual)
    worst_rms = 0.05
    if fit.cross_validated_rms > worst_rms:
        raise FitError(
            f"the light of the white squares deviates {100 * fit.cross_validated_rms:.1f} % from any flat field (limit"
            f" {100 * worst_rms:.0f} %): matt paper, nothing else in the light, LED positions as in the rig's `led`?"
        )
    return fit


def _law(xy: Float, light: Float) -> Float:
    """Coefficients of the logarithm of k F, by a robust fit."""
    terms, wanted = _law_terms(xy), np.log(light)
    start = np.asarray(np.linalg.lstsq(terms, wanted, rcond=None)[0], np.float64)
    # Of paper (a view's samples err alike, so more than of one alone), and of a coefficient where the tangent is 1.
    sigma, correction_sigma = 0.02, 0.15
    prior = np.r_[np.inf, np.inf, np.full(terms.shape[1] - 2, correction_sigma)]

    def equations(law: Float) -> Normal:
        out = Normal(len(law))
        out.add(((terms @ law - wanted) / sigma)[:, None], terms[:, None] / sigma, loss=cauchy(2.5))
        out.add_prior(law, prior)
        return out

    return minimise(equations, lambda law, step, _: law + step, start).x


def _law_terms(xy: Float) -> Float:
    """Terms (S, 11): 1, the logarithm of the cosine off the axis, and x ... y^3."""
    cosine = -0.5 * np.log1p((xy**2).sum(axis=1))
    return np.concatenate([np.ones((len(xy), 1)), cosine[:, None], terms_of(xy, 3)[:, 1:]], axis=1)


def _polynomial(law: Float, grid: Float) -> Float:
    """Coefficients (T,) of k F, from the law at `grid` (G, 2); dark corners less."""
    wanted = np.exp(_law_terms(grid) @ law)
    root = 1.0 / np.sqrt(wanted)
    terms = terms_of(grid, _DEGREE) * root[:, None]
    return np.asarray(np.linalg.lstsq(terms, wanted * root, rcond=None)[0], np.float64)


def _spread(off: Float) -> float:
    """Rms of residuals, those beyond five robust standard deviations cut."""
    limit = 5.0 * 1.4826 * float(np.median(np.abs(off)))
    return float(np.sqrt(np.mean(np.clip(off, -limit, limit) ** 2)))


def _refuse_uncovered(samples: WhiteSamples, size_px: tuple[int, int]) -> None:
    edges = [np.linspace(-0.5, size - 0.5, 4) for size in size_px]
    count = np.asarray(np.histogram2d(*samples.uv.T, bins=edges)[0].T, np.int64)
    missing = [name for name, own in zip(_PLACES, count.ravel().tolist(), strict=True) if own < 6]  # samples
    if missing:
        raise FitError(
            f"no white squares at the {', '.join(missing)} of the image: a flat field is needed there too;"
            " show the board there"
        )


def flat_field(options: Namespace) -> None:
    """Measure the flat field of a device's LEDs, from twenty views of a board."""
    device = device_of(options.source, options.rig, options.calibration, options.out)
    views = lit_views(options.source, device.camera.name, Illumination.LED)
    leds = np.array(device.rig.led) if device.rig.led else np.zeros((1, 3))
    with refusals_named(options.source):
        board = board_in_views(views, board_in(options))
    samples, refused = white_of(views, board, device.optics, leds)
    reasons, used = grouped_by_reason(refused), len(views) - len(refused)
    with refusals_named(options.source, reasons):
        fit = fit_flat_field(samples, device.optics)
    residual = {"rms_percent": 100 * fit.rms, "cross_validated_rms_percent": 100 * fit.cross_validated_rms}
    report: dict[str, object] = {
        "coefficients": list(fit.field.coefficients),
        **{name: round(value, 4) for name, value in residual.items()},
        "samples": len(samples.light),
        "views": used,
        "refused": refused,
    }
    lines = [
        f"flat field from {len(samples.light)} samples in {used} of {len(views)} views",
        f"  residual {100 * fit.rms:.2f} % rms; of views left out of the fit {100 * fit.cross_validated_rms:.2f} %",
    ]
    if not device.rig.led:
        lines.append("  the rig has no `led`: the LEDs were taken to be at the lens")
    if refused:
        lines += [f"left out ({len(refused)}):", *(f"  {reason}" for reason in reasons)]
    note = f"{len(samples.light)} samples of white squares in {used} views"
    write = writes_key(device, "flat-field", "flat_field", fit.field, residual, note)
    draw = partial(draw_flat_field, fit=fit, samples=samples, optics=device.optics)
    finish(options, lines, report, draw, write)


def white_of(
    lit: Sequence[LitView], board: Board, optics: CameraModel, led_m: Float
) -> tuple[WhiteSamples, dict[str, str]]:
    """White squares of every view, and why others show none.

    Raises:
        RecordingError: An image cannot be read.
    """

    def of(view: LitView) -> tuple[Float, Float, Float]:
        led, ambient = view.load(Illumination.LED), view.load(Illumination.AMBIENT)
        assert led is not None  # `lit_views` gives whole ones
        assert ambient is not None
        return white_samples(led, ambient, board_pose(view, board, optics), board, optics, led_m)

    found, refused = of_views(lit, of)
    views = list(found.values()) or [(np.empty((0, 2)), np.empty((0, 2)), np.empty(0))]
    xy, uv, light = (np.concatenate(part) for part in zip(*views, strict=True))
    number = np.repeat(np.arange(len(views)), [len(view[2]) for view in views]).astype(np.int64)
    return WhiteSamples(xy, uv, light, number), refused
