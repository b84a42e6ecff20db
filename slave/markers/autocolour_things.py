"""Find the coloured things of a frame, and what all frames of a hand share.

A thing is a set of connected pixels of one hue, more saturated than the desk and not of the skin's hue.

background   median over the frames: what stands still for most of the time
skin         hue and saturation of what moves and has a skin's hue; a lamp shifts both, so they are measured
floor        saturation per hue that the desk itself has, noise included; marker colours have more
clutter      things of the background that stay whole in one place while the hand moves: a mug, a pen
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from common.arrays import Bool, Float, Image, Int
from common.errors import FitError
from slave.markers.classify import HUES, hue_distance
from slave.markers.colours import HUE_GROW, PALE, SMALLEST, circular_median, dilated, hsv_of, like

SKIN_VALUE = 60
SKIN_HALF_WIDTH = 12  # in hue; nearer than this no marker colour can be distinguished from skin
RING = 2, 5  # px: skin is sought outside the mixed pixels of the rim, and near
DARK = 40  # value below which hue is noise


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
    """A connected thing of one hue in one frame, with its centroid (u, v) [px]."""

    frame: int  # index
    u: float
    v: float
    hue: float  # median
    pixels: Int  # (N,) flat indices
    hsv: Image  # (N, 3) their colours
    skin: float  # share of skin just around it

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
    """What all frames share."""

    skin: Skin
    floor: Float  # (180,) saturation above which a pixel of that hue is coloured; 256: none is
    clutter: tuple[Thing, ...]  # coloured things that stand on the desk
    wooden: bool = False  # the desk has the colour of skin: skin beside a thing proves nothing


def things_of(image: Image, frame: int, around: Surroundings, *, border: bool = False) -> list[Thing]:
    """Coloured things of a frame, no clutter; `border`: also those cut by the border."""
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
    """Return the mask (H, W) of pixels that may be marker colour."""
    return (hsv[..., 1] >= around.floor[hsv[..., 0]]) & (hsv[..., 2] >= DARK)


def hides(thing: Thing, clutter: Thing) -> bool:
    """Whether `thing` is the clutter, or a part of it."""
    if hue_distance(thing.hue, clutter.hue) > HUE_GROW:
        return False
    inside = np.isin(thing.pixels, clutter.pixels, assume_unique=True)
    covered = 0.3  # share of a thing that lies on clutter of its hue: it is that clutter, or hidden before it
    return float(inside.mean()) > covered


def _cut_by_hue(hue: Image, piece: Bool) -> list[Bool]:
    """Split a piece into connected parts of one hue each, the most frequent first."""
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
    ring = _ring(own)
    share = float(skin[top:bottom, left:right][ring].mean()) if ring.any() else 0.0
    colours = hsv[y, x]
    hue = circular_median(colours[:, 0])
    return Thing(frame, float(x.mean()), float(y.mean()), hue, y * width + x, colours, share)


def _ring(thing: Image) -> Bool:
    """What lies just around a mask (H, W) of 0 and 1."""
    return dilated(thing, RING[1]) & ~dilated(thing, RING[0])


def least_shift_px(size: float) -> float:
    """How far a thing of this size [px] goes at least if it has moved."""
    return 2.0 + 0.05 * size


MEDIAN_FRAMES = 25  # enough for a median; more only cost memory
DIFFERENT = 25  # grey levels that no noise reaches, in any channel
MOVED_FRAMES = 3
SKIN_AROUND = 0.08  # share of skin around a marker colour in a typical frame; painted caps have 0.12 and more
RESTING_SKIN = 0.5  # share of skin around a thing that never moved, from which it is painted on the hand
SKIN_HUES = 165, 30  # from magenta-red to yellow: skin of every tone under every lamp, wrapping through 0
SKIN_SATURATION = 30, 210


def background_of(images: Sequence[Image]) -> Image:
    """Median over some of the frames, evenly taken; (H, W, 3)."""
    chosen = [images[k] for k in spread(len(images), MEDIAN_FRAMES)]
    rows = [np.median([image[v] for image in chosen], axis=0) for v in range(chosen[0].shape[0])]
    return np.stack(rows).astype(np.uint8)


def spread(count: int, most: int) -> list[int]:
    """Return at most `most` indices below `count`, evenly spread, with both ends."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int)).tolist()


def skin_of(images: Sequence[Image], background: Image) -> Skin:
    """Skin: what moves and has a skin's hue; FitError: nothing moves, or no skin."""
    samples: list[Image] = []
    moving = 0.0
    chosen = spread(len(images), MEDIAN_FRAMES)
    for k in chosen:
        differs = np.asarray(cv2.absdiff(images[k], background)).max(axis=2) > DIFFERENT
        moving += float(differs.mean()) / len(chosen)
        hsv = hsv_of(images[k])[differs]
        hue, saturation = hsv[:, 0], hsv[:, 1]
        skin = (hue >= SKIN_HUES[0]) | (hue <= SKIN_HUES[1])
        skin &= (saturation >= SKIN_SATURATION[0]) & (saturation <= SKIN_SATURATION[1])
        samples.append(hsv[skin & (hsv[:, 2] >= SKIN_VALUE)])
    moving_least = 0.002  # share of the image that must differ from the background in a typical frame
    if moving < moving_least:
        raise FitError(
            f"nothing moves in these frames ({moving:.2%} of the image on average): record a few seconds of the open, "
            f"painted hand, back to the camera, moving about by more than its width"
        )
    pixels = np.concatenate(samples)
    if len(pixels) < moving_least * moving * background.shape[0] * background.shape[1] * len(chosen):
        raise FitError("what moves in these frames has no skin: record the bare, painted hand")
    hue, saturation = circular_median(pixels[:, 0]), float(np.median(pixels[:, 1]))
    return Skin(hue, (max(0.5 * saturation, SKIN_SATURATION[0] * 0.8), 1.6 * saturation))


def surroundings_of(images: Sequence[Image], background: Image, skin: Skin) -> Surroundings:
    """Desk and clutter: what of the background is coloured."""
    empty = Surroundings(skin, _floor(images, background, skin), ())
    standing = things_of(background, 0, empty, border=True)
    # share of the background that has the colour of skin, from which skin proves nothing: wood
    skin_desk = 0.2
    wooden = float(skin.mask(hsv_of(background)).mean()) > skin_desk

    def resting(thing: Thing) -> bool:
        return thing.skin >= RESTING_SKIN or (
            thing.skin >= SKIN_AROUND and _uncovered(thing, images, background, skin)
        )

    clutter = [thing for thing in standing if not _moved(thing, images) and (wooden or not resting(thing))]
    return Surroundings(skin, empty.floor, tuple(clutter), wooden)


def _floor(images: Sequence[Image], background: Image, skin: Skin) -> Float:
    """Return the saturation (180,) above which a pixel of that hue is coloured."""
    height, width = background.shape[:2]
    samples: list[Image] = []
    side = 8  # tiles in a row and in a column of the image
    tiles = np.zeros((HUES, side * side))
    rows, columns = np.arange(height, dtype=np.int64)[:, None], np.arange(width, dtype=np.int64)
    tile = rows * side // height * side + columns * side // width
    desk_frames = 3  # from which the saturation of the desk is measured, noise included
    for k in spread(len(images), desk_frames):
        hsv = hsv_of(images[k])
        desk = np.asarray(cv2.absdiff(images[k], background)).max(axis=2) <= DIFFERENT
        desk &= (hsv[..., 1] >= PALE) & (hsv[..., 2] >= DARK)
        samples.append(hsv[desk])
        desk_tile = 100.0  # where one pixel in so many has it
        np.add.at(tiles, (hsv[desk][:, 0], tile[desk]), desk_tile / desk_frames)
    hue_near = 3  # hues of one tint
    # A hue belongs to the desk where it and its neighbours are seen all over it.
    around = np.stack(
        [
            tiles.take(range(h - hue_near, h + hue_near + 1), axis=0, mode="wrap").sum(axis=0)
            for h in range(HUES)
        ]
    )
    desk_share = 0.2  # a hue that is seen in this share of the tiles is the desk's, not a thing's,
    everywhere = (around >= height * width / side**2).mean(axis=1) >= desk_share
    floor = np.full(HUES, float(PALE))
    pixels = np.concatenate(samples)
    for hue in np.flatnonzero(everywhere):
        near = pixels[hue_distance(pixels[:, 0], float(hue)) <= hue_near, 1]
        desk_tail = 99.9  # percentile of the desk's saturation that a marker colour must exceed
        floor[hue] = float(np.percentile(near, desk_tail))
    floor[hue_distance(np.arange(HUES), skin.hue) <= SKIN_HALF_WIDTH] = 256.0
    return floor


def _moved(thing: Thing, images: Sequence[Image]) -> bool:
    """Whether a thing is seen whole elsewhere; clutter only gets covered."""
    height, width = images[0].shape[:2]
    rows, columns = np.divmod(thing.pixels, width)
    reach = round(2.0 * thing.size) + 8  # it is searched for where it could still touch its place
    top, bottom = max(int(rows.min()) - reach, 0), min(int(rows.max()) + reach + 1, height)
    left, right = max(int(columns.min()) - reach, 0), min(int(columns.max()) + reach + 1, width)
    place = np.zeros((bottom - top, right - left), np.bool_)
    place[rows - top, columns - left] = True
    seen: list[tuple[float, float, float]] = []  # area and centroid of what touches its place, per frame
    for image in images:
        same = like(hsv_of(image[top:bottom, left:right]), thing.hue, thing.hsv)
        count, labels, stats, centres = cv2.connectedComponentsWithStats(
            same.astype(np.uint8), connectivity=4
        )
        overlap = np.bincount(labels[place], minlength=count)
        overlap[0] = 0
        best = int(np.argmax(overlap))
        if overlap[best]:
            seen.append((float(stats[best, cv2.CC_STAT_AREA]), *centres[best].tolist()))
    if len(seen) < MOVED_FRAMES:
        return False
    area, u, v = np.array(seen).T
    whole = 0.95  # of the area: a thing half covered shifts its centroid, but gets smaller
    moved = (area >= whole * np.median(area)) & (area <= np.median(area) / whole)
    moved &= np.hypot(u - np.median(u), v - np.median(v)) > least_shift_px(thing.size)
    return int(moved.sum()) >= MOVED_FRAMES


def _uncovered(thing: Thing, images: Sequence[Image], background: Image, skin: Skin) -> bool:
    """Whether the desk around it appeared in its place: a finger tip flexed away."""
    height, width = background.shape[:2]
    place = np.zeros(height * width, np.uint8)
    place[thing.pixels] = 1
    ring = background[_ring(place.reshape(height, width))]
    desk = ring[~skin.mask(hsv_of(ring[None]))[0]]
    if len(desk) == 0:
        return False
    colour = np.median(desk, axis=0)
    seen = (np.abs(image.reshape(-1, 3)[thing.pixels] - colour).max(axis=1) for image in images)
    return sum(bool((away <= DIFFERENT).mean() > 0.5) for away in seen) >= MOVED_FRAMES
