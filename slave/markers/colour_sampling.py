"""Colour of a marker from one click on the image of a running camera.

The colours that other markers have are taken into account.

The colour under the click is grown as for `phalanx-slave colours`; the ranges of all markers picked so far are made
anew together, since how far each may reach depends on its neighbours: six picks give what six clicks in one picture
give. Ranges that came from the camera file stay, but for hues that a picked one needs. Where colours follow the light
the picture is seen as under the light of their calibration, so that old and new colours agree.
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
from common.geometry.srgb import gain_tables
from slave.markers.classify import HUES, SKIN, in_range
from slave.markers.colour_monitor import hsv as hsv_of_light
from slave.markers.colours import (
    HUE_SEPARATION,
    PALE,
    SMALLEST,
    VALUE_LEAST,
    ColourRow,
    circular_median,
    grow,
    hue_distance,
    hue_separation,
    rows_of,
    surroundings,
)


@dataclass(frozen=True, slots=True)
class ColourSample:
    """What came of one click.

    Attributes:
        ranges: The ranges of all markers that have one now.
        row: What the new range catches, in the picture that was clicked on.
    """

    ranges: dict[str, HsvRange]
    row: ColourRow


class SampledColours:
    """Pixels of the marker colours picked since the start, and the ranges made.

    The pixels are as under the light of calibration. A range that was changed since counts as one of the file.
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
    ) -> ColourSample:
        """Make the range of a marker.

        Args:
            image: (H, W, 3) BGR.
            log_gains: (3,) of the light against calibration, blue first.
            marker: Whose colour it is.
            uv: A pixel on or near it [px].
            ranges: Of the markers that have one.

        Raises:
            FitError: There is no area of one colour, or one like skin, like another marker's, or as large as no
                marker; the message states what to do.
        """
        hsv = undone(image, log_gains)
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
            name: _apart(colour, circular_median(samples[name][:, 0]), made)
            for name, colour in ranges.items()
            if name not in picked
        }
        pixels_most = 4000  # of one marker colour that are kept
        picked[marker] = pixels[:: max(len(pixels) // pixels_most, 1)]
        self._samples, self._made = picked, made
        return ColourSample(kept | made, rows[marker])


def undone(image: Image, log_gains: Float) -> Image:
    """HSV (H, W, 3) of a picture as it would be under the light of calibration."""
    if np.any(log_gains):
        image = np.asarray(cv2.LUT(image, gain_tables(np.exp(-log_gains)).T[None]), np.uint8)
    return cast(Image, cv2.cvtColor(image, cv2.COLOR_BGR2HSV))


def colour_region(hsv: Image, marker: str, uv: tuple[float, float]) -> Bool:
    """Return the marker-coloured region (H, W) at or near a pixel (u, v) [px].

    Raises:
        FitError: As `SampledColours.sample`.
    """
    where = f"pick {marker}: ({uv[0]:.0f}, {uv[1]:.0f})"
    height, width = hsv.shape[:2]
    if not (0 <= round(uv[0]) < width and 0 <= round(uv[1]) < height):
        raise FitError(f"{where} is outside the {width}x{height} image")
    spot = _core(hsv, uv)
    if spot is None:
        u, v = round(uv[0]), round(uv[1])
        around = hsv[max(v - 1, 0) : v + 2, max(u - 1, 0) : u + 2].reshape(-1, 3)
        if in_range(np.asarray(np.median(around, axis=0).round(), np.uint8), SKIN):
            raise FitError(
                f"{where} is skin, or looks like it: click on the paint; paints that are red, orange or yellow cannot "
                "be distinguished from skin, so take another colour"
            )
        raise FitError(
            f"{where} is not on a paint: saturation {np.median(around[:, 1]):.0f} of 255, brightness "
            f"{np.median(around[:, 2]):.0f}: click on the paint; if it looks so grey, dark or white, set exposure and "
            "white balance first"
        )
    try:
        mask = grow(hsv, marker, spot)
    except FitError as error:
        raise FitError(
            f"{where} is on a spot of fewer than {SMALLEST} pixels of one colour: bring the marker nearer, and click "
            "on its middle"
        ) from error
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
    """Return the pixel deepest inside the coloured region at a click or beside it.

    None: there is no coloured region.
    """
    width = hsv.shape[1]
    near_share = 0.02  # of the image width: a click as far beside a marker is meant for it
    near = near_share * width
    reach = int(near + 8)
    u0, v0 = max(round(uv[0]) - reach, 0), max(round(uv[1]) - reach, 0)
    window = hsv[v0 : round(uv[1]) + reach + 1, u0 : round(uv[0]) + reach + 1]
    coloured = (window[..., 1] >= PALE) & (window[..., 2] >= VALUE_LEAST) & ~in_range(window, SKIN)
    inside = (
        np.asarray(cv2.erode(coloured.astype(np.uint8), np.ones((2, 2), np.uint8))) != 0
    )  # no single pixels
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
    hue = (low[0] + (high[0] - low[0]) % HUES // 2) % HUES
    return np.array([[hue, (low[1] + high[1]) // 2, (low[2] + high[2]) // 2]], np.uint8)


def _refuse_like(marker: str, samples: Mapping[str, Image]) -> None:
    hue = circular_median(samples[marker][:, 0])
    for name, pixels in samples.items():
        other = circular_median(pixels[:, 0])
        if name != marker and hue_separation(hue, other) < HUE_SEPARATION:
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


def _apart(colour: HsvRange, hue: float, made: Mapping[str, HsvRange]) -> HsvRange:
    """Return a range without the hues of the picked colours.

    It keeps the part about its own hue.
    """
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
