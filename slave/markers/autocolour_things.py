"""Coloured things in one frame.

Connected pixels of one hue, more saturated than the desk and not of the skin's hue.
"""

from dataclasses import dataclass
from typing import cast

import cv2
import numpy as np
import numpy.typing as npt

from common.arrays import Bool, Float, Image, Int
from slave.markers.classify import HUES
from slave.markers.colours import HUE_GROW, SMALLEST, circular_median, hue_distance, hue_separation

SKIN_VALUE = 60
SKIN_HALF_WIDTH = 12  # in hue; nearer than this no marker colour can be distinguished from skin
DARK = 40  # value below which hue is noise
RING = 2, 5  # px: skin is sought outside the mixed pixels of the rim, and near


@dataclass(frozen=True, slots=True)
class Skin:
    """Measured skin: hue, and low and high saturation."""

    hue: float
    saturation: tuple[float, float]

    def mask(self, hsv: Image) -> Bool:
        """Skin pixels of (..., 3) HSV."""
        low, high = self.saturation
        near = hue_distance(hsv[..., 0], self.hue) <= SKIN_HALF_WIDTH
        return near & (hsv[..., 1] >= low) & (hsv[..., 1] <= high) & (hsv[..., 2] >= SKIN_VALUE)


@dataclass(frozen=True, slots=True, eq=False)
class Thing:
    """A connected thing of one hue in one frame.

    Attributes:
        frame: Index of the frame.
        u, v: Centroid [px].
        hue: Median hue.
        pixels: (N,) flat indices of its pixels.
        hsv: (N, 3) their colours.
        skin: Share of skin just around it.
    """

    frame: int
    u: float
    v: float
    hue: float
    pixels: Int
    hsv: Image
    skin: float

    @property
    def area(self) -> int:
        """Pixels."""
        return len(self.pixels)

    @property
    def size(self) -> float:
        """Side of a square of the same area [px]."""
        return float(np.sqrt(self.area))


@dataclass(frozen=True, slots=True, eq=False)
class Surroundings:
    """What all frames share.

    Attributes:
        skin: Its colour.
        floor: (180,) saturation above which a pixel of that hue is coloured; 256: none is.
        clutter: Coloured things that stand on the desk.
        wooden: The desk has the colour of skin, so that skin beside a thing proves nothing.
    """

    skin: Skin
    floor: Float
    clutter: tuple[Thing, ...]
    wooden: bool = False


def things_of(image: Image, frame: int, around: Surroundings, *, border: bool = False) -> list[Thing]:
    """Return the coloured things of one frame, without clutter.

    `border`: those cut by the image's border, too.
    """
    hsv = hsv_of(image)
    skin = around.skin.mask(hsv)
    mask = coloured(hsv, around).astype(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=4)
    height, width = mask.shape
    found: list[Thing] = []
    for label in range(1, count):
        x, y, w, h, area = (int(value) for value in stats[label])
        cut = x == 0 or y == 0 or x + w == width or y + h == height
        largest = 0.05  # share of the image; a larger coloured thing is a sleeve
        if area < SMALLEST or area > largest * mask.size or (cut and not border):
            continue
        piece = np.asarray(labels[y : y + h, x : x + w] == label)
        for part in _cut_by_hue(hsv[y : y + h, x : x + w, 0], piece):
            thing = _thing(hsv, skin, part, (x, y), frame)
            if not any(hides(thing, clutter) for clutter in around.clutter):
                found.append(thing)
    return found


def coloured(hsv: Image, around: Surroundings) -> Bool:
    """Return the mask (H, W) of pixels that may be marker colour.

    They are more saturated than the desk, not dark, and not of the skin's hue.
    """
    return (hsv[..., 1] >= around.floor[hsv[..., 0]]) & (hsv[..., 2] >= DARK)


def hides(thing: Thing, clutter: Thing) -> bool:
    """Whether `thing` is the clutter, or a part of it."""
    if hue_separation(thing.hue, clutter.hue) > HUE_GROW:
        return False
    inside = np.isin(thing.pixels, clutter.pixels, assume_unique=True)
    covered = 0.3  # share of a thing that lies on clutter of its hue: it is that clutter, or hidden before it
    return float(inside.mean()) > covered


def hsv_of(image: Image) -> Image:
    """OpenCV HSV of a BGR image."""
    return cast(Image, cv2.cvtColor(image, cv2.COLOR_BGR2HSV))


def _cut_by_hue(hue: npt.NDArray[np.uint8], piece: Bool) -> list[Bool]:
    """Split a piece into connected parts of one hue each.

    The most frequent hue comes first: marker colours that touch are separated.
    """
    parts: list[Bool] = []
    rest = piece.copy()
    hues_of_one = 3  # pieces into which a thing of several hues is cut at most
    for _ in range(hues_of_one):
        if int(rest.sum()) < SMALLEST:
            break
        counts = np.bincount(hue[rest], minlength=HUES)[:HUES]
        kernel = np.ones(2 * HUE_GROW + 1)
        around = np.convolve(np.concatenate([counts, counts, counts]), kernel, "same")[HUES : 2 * HUES]
        same = rest & (hue_distance(hue, float(np.argmax(around))) <= HUE_GROW)
        count, labels, stats, _ = cv2.connectedComponentsWithStats(same.astype(np.uint8), connectivity=4)
        rest &= ~same
        if count > 1:
            largest = 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
            if int(stats[largest, cv2.CC_STAT_AREA]) >= SMALLEST:
                parts.append(np.asarray(labels == largest))
    return parts


def _thing(hsv: Image, skin: Bool, part: Bool, corner: tuple[int, int], frame: int) -> Thing:
    height, width = skin.shape
    y, x = np.nonzero(part)
    y, x = y + corner[1], x + corner[0]
    top, left = max(int(y.min()) - RING[1], 0), max(int(x.min()) - RING[1], 0)
    bottom, right = min(int(y.max()) + RING[1] + 1, height), min(int(x.max()) + RING[1] + 1, width)
    own = np.zeros((bottom - top, right - left), np.uint8)
    own[y - top, x - left] = 1
    inner, outer = (cv2.dilate(own, np.ones((2 * r + 1, 2 * r + 1), np.uint8)) for r in RING)
    ring = np.asarray(outer != inner)
    share = float(skin[top:bottom, left:right][ring].mean()) if ring.any() else 0.0
    colours = hsv[y, x]
    hue = circular_median(colours[:, 0])
    return Thing(frame, float(x.mean()), float(y.mean()), hue, y * width + x, colours, share)
