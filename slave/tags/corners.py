"""Find dark quadrilaterals, and refine their corners to hundredths of a pixel.

A side is an edge between black print and white paper, blurred by lens, pixel and motion: across it the light follows
a cumulative normal distribution. Its place, slope, width and both levels are fitted to what is seen along the side
(Gauss-Newton, all sides of all tags at once); a corner is where two lines meet, and is as sure as their residuals
show:

- It is done in linear light. On the bytes the middle of an edge lies in the white, by a third of its width, and every
  tag seems smaller.
- A side is straight on the paper. Under a lens that is known it is followed as it is curved.
- Behind the border, one cell further in, begins the code. Where that is white it is blurred into the border, which
  moves the edge of a small tag by a tenth of a pixel; once it is known what the code is, that is part of the law.
- The light may rise along a side.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from common.arrays import Float, Image
from common.geometry.camera_model import CameraModel
from common.geometry.srgb import to_linear

LIGHT = to_linear(np.arange(256) / 255.0)  # of a byte
ALONG, ACROSS = 18, 9  # samples of a side: places on it, and steps from black to white
WIDEST_PX = 4.0  # an edge
RIDGE = 1e-9 * np.eye(6)
LARGEST_STEP = np.array([1.0, 1.0, 1.5, 1.5, 0.3, 0.7])
SQRT_2_PI = np.sqrt(2.0 * np.pi)


@dataclass(frozen=True, slots=True)
class Corners:
    """Corners of N tags."""

    uv: Float  # (N, 4, 2) [px], in the order of the corners that were begun with
    sigma_px: Float  # (N,) standard deviation per axis; NaN: a side could not be followed
    contrast: Float  # (N,) linear light of white less black, of the side that has least
    width_px: Float  # (N,) standard deviation of what blurs an edge


def refine(
    grey: Image, corners: Float, cells: int, lens: CameraModel | None, inner: Float | None = None
) -> Corners:
    """Fit lines along the sides of tags.

    Args:
        grey: (H, W) bytes.
        corners: (N, 4, 2) [px] to a pixel or two, clockwise; the first is that of the print where `inner` is given.
        cells: Along a side, the black border included.
        lens: Of the whole image; None: sides are taken as straight.
        inner: (N, 4, cells) whether the cells behind the border are white, along the sides; None: not known.
    """
    uv = np.asarray(corners, np.float64)
    if not len(uv):
        return Corners(uv, np.zeros(0), np.zeros(0), np.zeros(0))
    room = 6  # px about the tags that are looked at
    left, top = np.maximum(np.floor(uv.min(axis=(0, 1))).astype(int) - room, 0)
    right, bottom = np.maximum(np.ceil(uv.max(axis=(0, 1))).astype(int) + room, 1)
    light = LIGHT[grey[top:bottom, left:right]]
    if not light.size:
        nothing = np.full(len(uv), np.nan)
        return Corners(uv, nothing, nothing, nothing)
    shift = np.array([left, top], np.float64)
    coarse = _fit(light, shift, uv, cells, lens, inner)
    return _fit(light, shift, coarse.uv, cells, lens, inner)


def _fit(
    light: Float, shift: Float, uv: Float, cells: int, lens: CameraModel | None, inner: Float | None
) -> Corners:
    along, length, outward = _along(uv)  # side k: from corner k to the next, clockwise
    cell = 0.5 * np.abs(_twice_area(uv))[:, None] / length / cells
    reach_px = 3.5  # to either side of the edge, at most
    # of the border's width that is looked at
    least_reach_px = 1.2
    reach = np.clip(0.55 * cell, least_reach_px, reach_px)
    ends_px = 1.6  # of a side that are not sampled at either end: there the next side begins
    margin = np.clip(ends_px / length, 0.02, 0.3)
    place = margin[..., None] + (1.0 - 2.0 * margin[..., None]) * (np.arange(ALONG) + 0.5) / ALONG
    across = reach[..., None] * np.linspace(-1.0, 1.0, ACROSS)
    on = _on_side(uv, along, place, lens) - shift
    at = on[..., :, None, :] + across[..., None, :, None] * outward[..., None, None, :]
    n = len(uv)
    sides = _Sides(
        _sampled(light, at).reshape(4 * n, ALONG, ACROSS),
        place.reshape(4 * n, ALONG),
        across.reshape(4 * n, ACROSS),
        cell.ravel(),
        (length / cells).ravel(),
        None if inner is None else inner.reshape(4 * n, cells),
    )
    density = ALONG * ACROSS / (length * (1.0 - 2.0 * margin) * 2.0 * reach)  # samples per square pixel
    # of the contrast: an edge that departs more from the law has something on it,
    coarse_residual = 0.4  # or is that of a small tag whose code is not known yet
    most_residual = coarse_residual if inner is None else 0.15
    return _met(uv, outward, reach, density, most_residual, *_edges(sides))


def _along(corners: Float) -> tuple[Float, Float, Float]:
    """Vectors (N, 4, 2) along the sides of quads, lengths (N, 4), normals outward."""
    along = np.roll(corners, -1, axis=1) - corners
    length = np.maximum(np.linalg.norm(along, axis=-1), 1e-3)
    return along, length, np.stack([along[..., 1], -along[..., 0]], axis=-1) / length[..., None]


def _twice_area(corners: Float) -> Float:
    """Twice the areas (N,) of quads, positive where they run clockwise."""
    x, y = corners[..., 0], corners[..., 1]
    return (x * np.roll(y, -1, axis=1) - np.roll(x, -1, axis=1) * y).sum(axis=1)


def _on_side(begin: Float, along: Float, place: Float, lens: CameraModel | None) -> Float:
    """Points (N, 4, ALONG, 2) [px] at shares `place` (N, 4, ALONG) of the sides."""
    if lens is None:
        return begin[..., None, :] + place[..., None] * along[..., None, :]
    begin = lens.undistort(begin)
    return lens.distort(begin[..., None, :] + place[..., None] * _along(begin)[0][..., None, :])


def _sampled(light: Float, at: Float) -> Float:
    """Interpolate the light at points (N, 4, ALONG, ACROSS, 2) [px]."""
    flat = np.ascontiguousarray(at.reshape(-1, ALONG * ACROSS, 2), np.float32)
    x, y = flat[..., 0], flat[..., 1]
    found = cv2.remap(light.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return found.astype(np.float64)


@dataclass(frozen=True, slots=True)
class _Sides:
    """Samples of S sides."""

    seen: Float  # light (S, ALONG, ACROSS)
    place: Float  # (S, ALONG) along, 0..1
    across: Float  # (S, ACROSS) [px]
    cell: Float  # (S,) how deep a cell is [px]
    cell_along: Float  # (S,) how long it is [px]
    inner: Float | None  # (S, cells) whether those behind the border are white


def _edges(sides: _Sides) -> tuple[Float, Float, Float]:
    """Fit S edges: parameters (S, 6) of `_law`, variances of offsets, residuals.

    Variances (S, 2) are per variance of a sample; residuals (S,) are mean squares.
    """
    seen, s = sides.seen, len(sides.seen)
    dark, bright = seen[..., :2].mean(axis=(1, 2)), seen[..., -2:].mean(axis=(1, 2))
    p: Float = np.stack([dark, bright, *np.zeros((3, s)), np.full(s, np.log(0.8))], axis=1)
    reach = sides.across[:, -1]
    normal = np.zeros((s, 6, 6))
    residual = np.zeros((s, ALONG * ACROSS))
    for _ in range(3):
        jacobian, model = _law(p, sides)
        residual = (seen - model).reshape(s, -1)
        transposed = jacobian.transpose(0, 2, 1)
        normal = transposed @ jacobian + RIDGE
        step = np.linalg.solve(normal, transposed @ residual[..., None])[..., 0]
        p += np.clip(step, -LARGEST_STEP, LARGEST_STEP)
        p[:, 2:4] = np.clip(p[:, 2:4], -reach[:, None], reach[:, None])
        p[:, 4] = np.clip(p[:, 4], -0.8, 0.8)
        sharpest_px = 0.25  # an edge
        p[:, 5] = np.clip(p[:, 5], np.log(sharpest_px), np.log(WIDEST_PX))
    variance = np.asarray(np.linalg.inv(normal), np.float64)[:, (2, 3), (2, 3)]
    return p, variance, (residual**2).mean(axis=1)


def _law(p: Float, sides: _Sides) -> tuple[Float, Float]:
    """Return Jacobian (S, ALONG * ACROSS, 6) and light (S, ALONG, ACROSS) of edges.

    Parameters (S, 6): light of the black and of the white, offsets at begin and end, by what share the light rises
    along the side, log of the width.
    """
    dark, bright, first, last, rise, width = p.T[:, :, None, None]
    width = np.exp(width)
    t = sides.place[:, :, None]
    d = sides.across[:, None, :] - first * (1.0 - t) - last * t
    z = d / width
    share, shade = normal_law(z), 1.0 + rise * (t - 0.5)
    height = shade * (bright - dark) * np.exp(-0.5 * z * z) / SQRT_2_PI
    moved = -height / width
    if sides.inner is not None:
        share = share + _white(sides, p[:, 5])[:, :, None] * normal_law(
            -(d + sides.cell[:, None, None]) / width
        )
    plain = dark + (bright - dark) * share
    levels, offsets = (shade * (1.0 - share), shade * share), (moved * (1.0 - t), moved * t)
    parts = *levels, *offsets, plain * (t - 0.5), -height * z
    return np.stack(parts, axis=-1).reshape(len(p), -1, 6), shade * plain


def _white(sides: _Sides, log_width: Float) -> Float:
    """How white it is (S, ALONG) behind the border, blurred along the side."""
    assert sides.inner is not None
    cells = sides.inner.shape[1]
    scale: Float = sides.cell_along / np.exp(log_width)
    edges = np.arange(cells + 1, dtype=np.float64)
    at = (sides.place[..., None] * cells - edges) * scale[:, None, None]
    begun = normal_law(at)
    return ((begun[..., :-1] - begun[..., 1:]) * sides.inner[:, None, :]).sum(axis=-1)


def normal_law(z: Float) -> Float:
    """Cumulative normal distribution to 3e-4 (Page, Applied Statistics 26, 1977)."""
    return 0.5 * (1.0 + np.tanh(0.7978845608 * z * (1.0 + 0.044715 * z * z)))


def _met(
    uv: Float,
    outward: Float,
    reach: Float,
    density: Float,
    most_residual: float,
    edges: Float,
    variance: Float,
    mean_square: Float,
) -> Corners:
    """Where the lines of neighbouring sides meet, and how sure; the last as `_edges`."""
    dark, bright, *offsets, _, log_width = np.moveaxis(edges.reshape(-1, 4, 6), -1, 0)
    offset, contrast, width = np.stack(offsets, axis=-1), bright - dark, np.exp(log_width)
    mean_square = mean_square.reshape(-1, 4)
    bilinear = 9.0 / 4.0  # variance of a pixel against that of what is read between pixels
    noise = mean_square * np.maximum(bilinear * density, 1.0)
    floor_px = 0.01  # what is left where there is no noise: pixels are squares, sampled by straight lines
    # an edge that is wider is off by so much of what it is wider: motion has its own law
    clear_px, blurred = 0.8, 0.05
    floor = floor_px**2 + (blurred * np.maximum(width - clear_px, 0.0)) ** 2
    variance = noise[..., None] * variance.reshape(-1, 4, 2) + floor[..., None]
    # Corner k ends side k - 1 and begins side k. Each line measures how far it moved across itself, there.
    normals = np.stack([np.roll(outward, 1, axis=1), outward], axis=-2)
    moved = np.stack([np.roll(offset[..., 1], 1, axis=1), offset[..., 0]], axis=-1)
    edge_variance = np.stack([np.roll(variance[..., 1], 1, axis=1), variance[..., 0]], axis=-1)
    slimmest = 0.1  # sine of the angle between two sides
    meet = np.abs(np.linalg.det(normals)) > slimmest
    inverse = np.linalg.inv(np.where(meet[..., None, None], normals, np.eye(2)))
    met = uv + np.einsum("nkij,nkj->nki", inverse, moved)
    spread = np.einsum("nkij,nkj->nk", inverse**2, edge_variance)
    least_contrast = 0.008  # in linear light, white is 1
    good = meet & (np.abs(offset).max(axis=-1) < reach)
    good &= (contrast > least_contrast) & (width < 0.99 * WIDEST_PX)
    good &= mean_square < (most_residual * contrast) ** 2
    sigma = np.sqrt(spread.mean(axis=1) / 2.0)
    return Corners(met, np.where(good.all(axis=1), sigma, np.nan), contrast.min(axis=1), width.mean(axis=1))


PROBES = np.array([0.2, 0.35, 0.5, 0.65, 0.8])  # of a side


def quads(grey: Image) -> Float:
    """Corners (N, 4, 2) [px], clockwise, to a pixel or two."""
    window = 23  # px of the local mean that a tag's border is darker than
    if min(grey.shape) < window:
        return np.zeros((0, 4, 2))
    darker = 6.0  # bytes
    dark = cv2.adaptiveThreshold(grey, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV, window, darker)
    outlines, _ = cv2.findContours(dark, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    found: list[tuple[float, Float]] = []  # area, corners
    for outline in outlines:
        least_outline, most_outline = 36, 1600  # px
        if least_outline <= len(outline) <= most_outline:
            straight = 0.06  # of the outline: by how much it may leave the four lines
            corners = cv2.approxPolyDP(outline, straight * len(outline), True).reshape(-1, 2)
            if len(corners) == 4 and cv2.isContourConvex(corners):
                sides = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1)
                area = cv2.contourArea(corners)
                least_side_px = 7.0
                least_fill = 0.4  # of the bounding box of the turned patch
                if sides.min() >= least_side_px and area >= least_fill * sides.max() * sides.min():
                    found.append((area, corners.astype(np.float64)))
    if not found:
        return np.zeros((0, 4, 2))
    largest = [corners for _, corners in sorted(found, key=lambda quad: -quad[0])]
    most = 16  # quads of one search that are looked at
    return _with_margin(_dark_inside(grey, _clockwise(np.array(largest)))[:most])


def _with_margin(corners: Float) -> Float:
    """Move the sides outward: an outline runs through the middles of dark pixels."""
    along, length, _ = _along(corners)
    along = along / length[..., None]
    before = np.roll(along, 1, axis=1)
    sine = before[..., 0] * along[..., 1] - before[..., 1] * along[..., 0]
    margin_px = 0.7
    return corners + margin_px * (before - along) / np.maximum(sine, 0.3)[..., None]


def _clockwise(corners: Float) -> Float:
    return np.where(_twice_area(corners)[:, None, None] < 0.0, corners[:, ::-1], corners)


def _dark_inside(grey: Image, corners: Float) -> Float:
    """Those that are darker than what is about them, along all of their sides."""
    along, _, outward = _along(corners)
    on = corners[:, :, None] + PROBES[:, None] * along[:, :, None]
    probe_px = 2.0  # from the edge
    at = np.stack([on + probe_px * outward[:, :, None], on - 0.5 * probe_px * outward[:, :, None]])
    place = np.rint(at).astype(int)
    height, width = grey.shape
    seen = grey[place[..., 1].clip(0, height - 1), place[..., 0].clip(0, width - 1)].astype(int)
    brighter = 12.0  # bytes, outside
    share = (seen[0] > seen[1] + brighter).reshape(len(corners), -1).mean(axis=1)
    agreeing = 0.8  # share of the probes
    return corners[share >= agreeing]
