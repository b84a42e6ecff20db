"""Calibrate the HSV range of every marker from clicks on an image.

A tight range fails under the next lamp, so each range is as broad as its neighbours allow: in hue half-way to the
next marker or to the skin, at most `hue_margin`; in saturation down to `saturation_share` of the marker's, where a
rim pixel is about half marker, but above what the background shows in that hue; in value from the shadow side to a
highlight.

`calibrate` takes all clicks in one picture. `SampledColours` takes one click at a time on a running camera and makes
the ranges of all picked markers anew together, so that six picks give what six clicks in one picture give. Ranges of
the camera file stay, but for hues that a picked one needs. Where colours follow the light, the picture is seen as
under the light of calibration, so that old and new colours agree.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import cast

import cv2
import numpy as np
from msgspec.structs import replace

from common.arrays import Bool, Float, Image
from common.calibration import HsvRange
from common.errors import FitError
from common.geometry.srgb import to_linear
from slave.markers.classify import HUES, SKIN, hue_distance, hue_span, in_range
from slave.markers.illuminant import undone
from slave.markers.white_balance import hsv as hsv_of_light

HUE_GROW = 10  # how far the hue of one marker varies between its lit and its shadow side
HUE_SEPARATION = 8  # two marker colours nearer than this look the same
VALUE_LEAST = 25  # below, hue is noise
PALE = 60  # saturation below which no marker colour can be distinguished from a grey desk
AROUND = 25  # px around the markers in which skin is sampled
RIM = 4  # px around a marker that are partly marker colour
SMALLEST = 6  # px of marker colour


@dataclass(frozen=True, slots=True)
class ColourRow:
    """What the range of one marker catches; shares are 0..1."""

    name: str
    range: HsvRange
    pixels: int  # of the marker colour grown from the click
    own: float  # share of them inside the range
    others: dict[str, float]  # other markers -> share of their pixels inside the range, if above 0
    skin: float  # share of the skin pixels inside the range
    background: float  # share of the background pixels inside the range
    background_px: float = 0.0  # how many that is in one frame


def calibrate(image: Image, clicks: Mapping[str, tuple[float, float]]) -> list[ColourRow]:
    """Ranges and collisions of the clicked markers, in the order of `clicks`.

    `image`: (H, W, 3) BGR. `clicks`: Marker -> (u, v) [px], a pixel on its colour. Raises FitError: A click is
    outside the image or not on a marker colour, or two colours have the same hue.
    """
    hsv = hsv_of(image)
    paint = {name: grow(hsv, name, uv) for name, uv in clicks.items()}
    skin, background = surroundings(hsv, paint)
    return rows_of({name: hsv[mask] for name, mask in paint.items()}, hsv[skin], hsv[background])


def rows_of(paint: Mapping[str, Image], skin: Image, background: Image, frames: int = 1) -> list[ColourRow]:
    """Return ranges and collisions of known marker pixels, in the order of `paint`.

    `paint`: marker -> (N, 3) HSV of its pixels; `skin`: (K, 3) HSV, may be empty; `background`: (B, 3) HSV of all
    that is neither marker colour nor its rim, from so many `frames`. Raises FitError: two marker colours have the
    same hue.
    """
    hue = {name: circular_median(pixels[:, 0]) for name, pixels in paint.items()}
    _refuse_ambiguous(hue)
    skin_hue = circular_median(skin[:, 0]) if len(skin) else None
    rows: list[ColourRow] = []
    for name, pixels in paint.items():
        colour = _range(pixels, hue[name], _limits(name, hue, skin_hue), background, frames)
        caught = _share(background, colour)
        rows.append(
            ColourRow(
                name=name,
                range=colour,
                pixels=len(pixels),
                own=_share(pixels, colour),
                others={o: s for o in paint if o != name and (s := _share(paint[o], colour)) > 0.0},
                skin=_share(skin, colour),
                background=caught,
                background_px=caught * len(background) / frames,
            )
        )
    return rows


def report(rows: list[ColourRow]) -> str:
    """The collision report as a table for people."""
    head = f"{'marker':<10}{'H':>9}{'S':>9}{'V':>9}{'paint px':>10}{'caught':>8}{'skin':>8}{'backgr.':>9}"
    lines = [f"{head}  other markers"]
    for row in rows:
        low, high = row.range.hsv_low, row.range.hsv_high
        spans = "".join(f"{f'{a}-{b}':>9}" for a, b in zip(low, high, strict=True))
        others = ", ".join(f"{name} {share:.1%}" for name, share in row.others.items()) or "-"
        lines.append(
            f"{row.name:<10}{spans}{row.pixels:>10}{row.own:>8.1%}{row.skin:>8.2%}{row.background:>9.3%}  {others}"
        )
    bad = [r.name for r in rows if r.others or r.skin > 0.001 or r.background > 0.001]
    advice = "take another paint, or remove what has this colour from the picture"
    lines.append(f"collisions: {', '.join(bad)}: {advice}" if bad else "no collisions")
    visible_px = 24  # background pixels inside a range that may look like a marker; fewer are a speck
    lines += [
        f"warning: {r.name}: {r.background_px:.0f} background pixels per frame are inside its range"
        for r in rows
        if r.background_px >= visible_px
    ]
    return "\n".join(lines)


def grow(hsv: Image, name: str, click: tuple[float, float]) -> Bool:
    """Region (H, W) of the hue at a click; FitError: outside, no paint, or too small."""
    u, v = round(click[0]), round(click[1])
    height, width = hsv.shape[:2]
    if not (0 <= u < width and 0 <= v < height):
        raise FitError(f"clicks.{name}: ({u}, {v}) is outside the {width}x{height} image")
    _refuse_no_paint(f"clicks.{name}: ({u}, {v})", _around(hsv, click))
    mask = _region(hsv, click)
    if mask is None:
        raise FitError(
            f"clicks.{name}: ({u}, {v}) is on a spot of fewer than {SMALLEST} pixels of one colour"
        )
    return mask


def _region(hsv: Image, uv: tuple[float, float]) -> Bool | None:
    """Region (H, W) of the hue at (u, v); None: of fewer than `SMALLEST` pixels."""
    clicked = _around(hsv, uv)
    near = like(hsv, circular_median(clicked[:, 0]), clicked)
    _, labels = cv2.connectedComponents(near.astype(np.uint8), connectivity=4)
    label = labels[round(uv[1]), round(uv[0])]
    mask = labels == label
    return None if label == 0 or int(mask.sum()) < SMALLEST else mask


def _around(hsv: Image, uv: tuple[float, float]) -> Image:
    """Pixels (N, 3) at (u, v) and beside it."""
    u, v = round(uv[0]), round(uv[1])
    return hsv[max(v - 1, 0) : v + 2, max(u - 1, 0) : u + 2].reshape(-1, 3)


def _refuse_no_paint(where: str, pixels: Image) -> None:
    """Refuse pixels (N, 3) that no marker colour can have.

    `where` begins the message. Grey, white and near black have no hue. Skin is refused by hue alone, however
    saturated: a red or orange paint that shines, or lies in shadow, has the colours of skin.

    Raises:
        FitError: With what to do.
    """
    saturation, value = np.median(pixels[:, 1]), np.median(pixels[:, 2])
    if saturation < PALE or value < VALUE_LEAST:
        raise FitError(
            f"{where} is not on a paint: saturation {saturation:.0f} of 255, brightness {value:.0f}: click on the"
            " paint; if it looks so grey, dark or white, set exposure and white balance first"
        )
    if _like_skin(circular_median(pixels[:, 0])):
        raise FitError(
            f"{where} is skin, or looks like it: click on the paint; paints that are red, orange or yellow cannot be"
            " distinguished from skin, so take another colour"
        )


def _like_skin(hue: Float | Image | float) -> Bool:
    """Which hues are those of skin, on both sides of 0."""
    first, last = SKIN.hsv_low[0], SKIN.hsv_high[0]
    return np.asarray((np.asarray(hue, np.float64) - first) % HUES <= (last - first) % HUES)


def hsv_of(image: Image) -> Image:
    """OpenCV HSV of a BGR image."""
    return cast(Image, cv2.cvtColor(image, cv2.COLOR_BGR2HSV))


def like(hsv: Image, hue: float, sample: Image) -> Bool:
    """Pixels (...) of a hue, but rims and highlights of a thing like `sample` (N, 3)."""
    saturation, value = np.median(sample[:, 1]), np.median(sample[:, 2])
    pure = (hsv[..., 1] >= 0.55 * saturation) & (hsv[..., 2] >= 0.4 * value)
    return pure & (hue_distance(hsv[..., 0], hue) <= HUE_GROW)


def dilated(mask: Image, px: int) -> Bool:
    """Mask (H, W) of 0 and 1, wider by so many pixels in rows and columns."""
    return np.asarray(cv2.dilate(mask, np.ones((2 * px + 1, 2 * px + 1), np.uint8))) != 0


def circular_median(hues: Image) -> float:
    """Median of hues 0-179 on the circle: taken around their mean direction."""
    angle = hues.astype(np.float64) * (2.0 * np.pi / HUES)
    mean = np.arctan2(np.sin(angle).mean(), np.cos(angle).mean())
    offset = (angle - mean + np.pi) % (2.0 * np.pi) - np.pi
    return float((mean + np.median(offset)) * HUES / (2.0 * np.pi) % HUES)


def _refuse_ambiguous(hue: Mapping[str, float]) -> None:
    names = sorted(hue, key=lambda name: hue[name])
    for a, b in zip(names, names[1:] + names[:1], strict=True):
        if a != b and hue_distance(hue[a], hue[b]) < HUE_SEPARATION:
            raise FitError(
                f"markers {a} and {b} have nearly the same hue ({hue[a]:.0f}, {hue[b]:.0f}): repaint one"
            )


def surroundings(hsv: Image, paint: Mapping[str, Bool]) -> tuple[Bool, Bool]:
    """Masks of skin near the markers, and of all but marker colour and its rim."""
    union = np.any(list(paint.values()), axis=0).astype(np.uint8)
    rim, near = dilated(union, RIM), dilated(union, AROUND)
    skin_like = (hue_distance(hsv[..., 0], 12.0) <= 12.0) & (hsv[..., 1] >= PALE) & (hsv[..., 1] <= 190)
    return near & ~rim & skin_like, ~rim


def _limits(name: str, hue: Mapping[str, float], skin_hue: float | None) -> tuple[int, int]:
    """How far below and above its hue the range of a marker may go."""
    obstacles = [h for other, h in hue.items() if other != name] + ([] if skin_hue is None else [skin_hue])
    below = min((((hue[name] - h) % HUES) / 2.0 for h in obstacles), default=HUES)
    above = min((((h - hue[name]) % HUES) / 2.0 for h in obstacles), default=HUES)
    hue_margin = 14  # widest half range; other marker colours and skin narrow it
    # One hue between two ranges belongs to neither: ranges that touch would both claim it after rounding.
    return int(min(hue_margin, below - 0.5)), int(min(hue_margin, above - 0.5))


def _range(paint: Image, hue: float, limits: tuple[int, int], background: Image, frames: int) -> HsvRange:
    middle = round(hue)
    low, high = (middle - limits[0]) % HUES, (middle + limits[1]) % HUES
    saturation_share = 0.45  # of the marker's median: a rim pixel is about half marker
    saturation_least = 50
    saturation = max(saturation_least, saturation_share * float(np.median(paint[:, 1])))
    value_share = 0.3  # of the marker's median: the shadow side belongs to the cap
    value = max(VALUE_LEAST, value_share * float(np.median(paint[:, 2])))
    same_hue = in_range(background, HsvRange(hsv_low=(low, 0, 0), hsv_high=(high, 255, 255)))
    seen = background[same_hue][:, 1]
    if seen.size > 1000 * frames:  # a desk of that tint, not an object
        background_tail = 99.9  # percentile of the background's saturation that a range stays above
        floor = float(np.percentile(seen, background_tail)) + 5.0
        saturation = max(saturation, min(floor, 0.7 * float(np.median(paint[:, 1]))))
    return HsvRange(
        hsv_low=(low, round(saturation), round(value)),
        hsv_high=(high, 255, 255),
        reference_bgr_linear=_mean_light(paint),
    )


def _mean_light(paint: Image) -> tuple[float, float, float]:
    """Return the mean of (N, 3) HSV pixels in linear light, blue first."""
    bgr = np.asarray(cv2.cvtColor(paint[None], cv2.COLOR_HSV2BGR))[0]
    blue, green, red = np.maximum(to_linear(bgr / 255.0).mean(axis=0), 1e-5).round(5).tolist()
    return blue, green, red


def _share(pixels: Image, colour: HsvRange) -> float:
    return float(in_range(pixels, colour).mean()) if len(pixels) else 0.0


class SampledColours:
    """Pixels of the marker colours picked since the start, and the ranges made.

    As under the light of calibration. A range that was changed since counts as one of the file.
    """

    def __init__(self) -> None:
        """Nothing was picked yet."""
        self._samples: dict[str, Image] = {}
        self._made: dict[str, HsvRange] = {}

    def sample(
        self,
        image: Image,
        log_gains: Float,
        marker: str,
        uv: tuple[float, float],
        ranges: Mapping[str, HsvRange],
    ) -> tuple[dict[str, HsvRange], ColourRow]:
        """Make the range of a marker from a pixel (u, v) on or near it [px].

        `image`: (H, W, 3) BGR; `log_gains`: (3,) of the light against calibration, blue first; `ranges`: of the
        markers that have one. Returns the ranges of all now, and what the new one catches. Raises FitError: no area
        of one colour, or one like skin, like another marker's, or too large for a marker; the message states what to
        do.
        """
        hsv = hsv_of(undone(image, log_gains))
        mask = colour_region(hsv, marker, uv)
        pixels = hsv[mask]
        picked = {name: self._samples[name] for name, made in self._made.items() if ranges.get(name) == made}
        picked[marker] = pixels
        samples = {
            name: picked[name] if name in picked else _sample_of(ranges[name]) for name in (*ranges, marker)
        }
        _refuse_like(marker, samples)
        masks = {name: in_range(hsv, colour) & ~mask for name, colour in ranges.items()} | {marker: mask}
        skin, background = surroundings(hsv, masks)
        rows = {row.name: row for row in rows_of(samples, hsv[skin], hsv[background])}
        _refuse_poor(rows[marker])
        made = {name: rows[name].range for name in picked}
        kept = {
            name: _without_hues_of(colour, circular_median(samples[name][:, 0]), made)
            for name, colour in ranges.items()
            if name not in picked
        }
        pixels_most = 4000  # of one marker colour that are kept
        picked[marker] = pixels[:: max(len(pixels) // pixels_most, 1)]
        self._samples, self._made = picked, made
        return kept | made, rows[marker]


def colour_region(hsv: Image, marker: str, uv: tuple[float, float]) -> Bool:
    """Region (H, W) of marker colour at or near (u, v) [px]; FitError as `sample`."""
    where = f"pick {marker}: ({uv[0]:.0f}, {uv[1]:.0f})"
    height, width = hsv.shape[:2]
    if not (0 <= round(uv[0]) < width and 0 <= round(uv[1]) < height):
        raise FitError(f"{where} is outside the {width}x{height} image")
    spot = _core(hsv, uv)
    if spot is None:
        _refuse_no_paint(where, _around(hsv, uv))
    mask = None if spot is None else _region(hsv, spot)
    if mask is None:
        raise FitError(
            f"{where} is on a spot of fewer than {SMALLEST} pixels of one colour: bring the marker nearer, and click "
            "on its middle"
        )
    _refuse_no_paint(where, hsv[mask])
    hues = hsv[..., 0][mask]
    largest_share = 0.1  # of the image; a larger patch is no marker
    if (share := float(mask.mean())) > largest_share:
        raise FitError(
            f"{where}: what has this colour covers {share:.0%} of the picture, which is no marker: click on the "
            "paint, or take away what has its colour"
        )
    # hues: the 95th percentile of the distance from the median, of one marker colour in one light less
    if (uneven := float(np.percentile(hue_distance(hues, circular_median(hues)), 95))) > 7.0:
        raise FitError(
            f"{where} is not of one colour (hues {uneven:.0f} apart): repaint it evenly, or light it evenly"
        )
    return mask


def _core(hsv: Image, uv: tuple[float, float]) -> tuple[float, float] | None:
    """Return the pixel deepest inside the coloured region at or beside a click."""
    width = hsv.shape[1]
    near_share = 0.02  # of the image width: a click as far beside a marker is meant for it
    near = near_share * width
    reach = int(near + 8)
    u0, v0 = max(round(uv[0]) - reach, 0), max(round(uv[1]) - reach, 0)
    window = hsv[v0 : round(uv[1]) + reach + 1, u0 : round(uv[0]) + reach + 1]
    coloured = (window[..., 1] >= PALE) & (window[..., 2] >= VALUE_LEAST) & ~_like_skin(window[..., 0])
    # no single pixels
    inside = np.asarray(cv2.erode(coloured.astype(np.uint8), np.ones((2, 2), np.uint8))) != 0
    v, u = np.indices(coloured.shape)
    away = np.hypot(u + u0 - uv[0], v + v0 - uv[1])
    nearest = float(np.min(away, where=inside, initial=np.inf))
    if nearest > near:
        return None
    depth = cv2.distanceTransform(coloured.astype(np.uint8), cv2.DIST_L2, 3)
    slip_px = 4.0  # a click on the rim of a marker is meant for what lies so far inside
    allowed = inside & (away <= nearest + slip_px)
    best = int(np.argmax(np.where(allowed, depth - 0.25 * away, -np.inf)))
    row, column = divmod(best, coloured.shape[1])
    return float(column + u0), float(row + v0)


def _sample_of(colour: HsvRange) -> Image:
    """Return one HSV pixel (1, 3) for a marker colour known only by its range."""
    if colour.reference_bgr_linear is not None:
        return np.rint(hsv_of_light(np.array([colour.reference_bgr_linear]))).astype(np.uint8)
    low, high = colour.hsv_low, colour.hsv_high
    return np.array([[hue_span(colour)[0], (low[1] + high[1]) // 2, (low[2] + high[2]) // 2]]).astype(
        np.uint8
    )


def _refuse_like(marker: str, samples: Mapping[str, Image]) -> None:
    hue = circular_median(samples[marker][:, 0])
    for name, pixels in samples.items():
        other = circular_median(pixels[:, 0])
        if name != marker and hue_distance(hue, other) < HUE_SEPARATION:
            raise FitError(
                f"pick {marker}: its paint has nearly the hue of marker {name} ({hue:.0f}, {other:.0f}): if this is "
                f"the paint of {name}, click on that of {marker}; if {name} was picked wrongly, forget its colour "
                f"first; else repaint one"
            )


def _refuse_poor(row: ColourRow) -> None:
    own_least = 0.8  # share of the marker's pixels that its range must hold
    if row.own < own_least:
        raise FitError(
            f"pick {row.name}: between its neighbours' hues its range {row.range.hsv_low}-{row.range.hsv_high} would "
            f"hold only {row.own:.0%} of its paint: repaint it in a colour farther from the others"
        )
    skin_most = 0.1  # share of the skin around that it may hold
    if row.skin > skin_most:
        raise FitError(
            f"pick {row.name}: its range would hold {row.skin:.0%} of the skin around: repaint it in a colour that is "
            "farther from skin (not red, orange or yellow)"
        )


def _without_hues_of(colour: HsvRange, hue: float, made: Mapping[str, HsvRange]) -> HsvRange:
    """Return a range without the hues of the picked colours, about its own hue."""
    low, high = colour.hsv_low[0], colour.hsv_high[0]
    middle = round(hue) % HUES
    below, above = (middle - low) % HUES, (high - middle) % HUES
    for other in made.values():
        start, stop = other.hsv_low[0], other.hsv_high[0]
        if (stop - start) % HUES >= (middle - start) % HUES:
            continue  # they share the very hue, which `rows_of` has refused
        above = min(above, (start - middle) % HUES - 1)
        below = min(below, (middle - stop) % HUES - 1)
    return replace(
        colour,
        hsv_low=((middle - below) % HUES, *colour.hsv_low[1:]),
        hsv_high=((middle + above) % HUES, *colour.hsv_high[1:]),
    )
