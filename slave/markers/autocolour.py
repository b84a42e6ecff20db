"""Colour ranges of one camera, found without clicks.

They come from a few seconds of a moving, painted hand.

A marker colour keeps one hue, moves with the hand, and has skin beside it. The M strongest hues of that kind are
the M marker colours; their pixels of all frames, lit and shadow side, in every place the hand went, make the ranges
by the rules of `colours`. Where the frames do not determine M colours for certain, a FitError states what is missing:
nothing here is guessed.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from common.arrays import Float, Image
from common.errors import FitError
from slave.markers.autocolour_surroundings import SETTINGS, background_of, skin_of, spread, surroundings_of
from slave.markers.autocolour_things import Surroundings, Thing, coloured, hsv_of, things_of
from slave.markers.classify import HUES
from slave.markers.colours import (
    AROUND,
    HUE_GROW,
    HUE_SEPARATION,
    PALE,
    RIM,
    ColourRow,
    circular_median,
    hue_distance,
    hue_separation,
    rows_of,
)

FRAMES_LEAST = 8
UNUSUAL = 0.55, 0.4  # of a thing's median saturation and value; below is rim or highlight, not marker colour

Notify = Callable[[str], None]
Namer = Callable[[Sequence["MarkerColour"], Float], tuple[str, ...]]
"""(M paints, centroids (F, M, 2) [px] NaN where not seen) -> their names. Raises FitError when not certain."""


@dataclass(frozen=True, slots=True, eq=False)
class MarkerColour:
    """One marker colour found in the frames.

    Its hue and its largest thing in every frame where it was seen.
    """

    hue: float
    things: tuple[Thing, ...]

    @property
    def area(self) -> float:
        """Pixels in a typical frame."""
        return float(np.median([thing.area for thing in self.things]))

    @property
    def skin(self) -> float:
        """Share of skin around it in a typical frame."""
        return float(np.median([thing.skin for thing in self.things]))

    @property
    def moved(self) -> bool:
        """Whether it went farther than noise and partial cover could shift it."""
        size = float(np.median([thing.size for thing in self.things]))
        place = np.array([(thing.u, thing.v) for thing in self.things])
        low, high = np.percentile(place, (5, 95), axis=0)
        return float(np.hypot(*(high - low))) > SETTINGS.shift_px + SETTINGS.shift_share * size


def calibrate_moving(
    images: Sequence[Image], names: tuple[str, ...], namer: Namer, notify: Notify = lambda _text: None
) -> list[ColourRow]:
    """Ranges and collisions of all markers, in the order of `names`.

    Args:
        images: (H, W, 3) BGR each, of one resting camera, over a few seconds; 30 to 60 are plenty.
        names: Markers of the rig.
        namer: Assigns the marker colours to the markers.
        notify: Receives lines about what was found.

    Raises:
        FitError: Too few frames, no motion, no skin, too few or too many marker colours, two too alike, or the
            names are not certain; the message states what to do.
    """
    if len(images) < FRAMES_LEAST:
        raise FitError(
            f"{len(images)} frames, at least {FRAMES_LEAST} are needed: record a few seconds of the moving hand"
        )
    background = background_of(images)
    around = surroundings_of(images, background, skin_of(images, background))
    notify(f"skin: hue {around.skin.hue:.0f}, saturation {around.skin.saturation[0]:.0f}.."
        f"{around.skin.saturation[1]:.0f}; {len(around.clutter)} coloured things stand still")  # fmt: skip
    things = [things_of(image, k, around) for k, image in enumerate(images)]
    colours = find_colours(things, len(names), around)
    for colour in colours:
        at_rest = "" if colour.moved else "; it rests, skin around it shows that it is paint"
        notify(f"paint of hue {colour.hue:.0f}: in {len(colour.things)} of {len(images)} frames{at_rest}")
    named = namer(colours, places(colours, len(images)))
    if sorted(named) != sorted(names):
        raise ValueError(f"the namer gave {named}, the rig has {names}")
    of = dict(zip(named, colours, strict=True))
    skin, rest, frames = _others(images, things, colours, around)
    return rows_of({name: pixels_of(of[name]) for name in names}, skin, rest, frames)


def frames_for(pixels: int) -> int:
    """Return how many frames of so many pixels are held at once.

    They are limited, though more of them would give more information.
    """
    frames_most = 60
    pixels_most = 60_000_000  # of all frames together: 180 MB
    return int(np.clip(pixels_most // pixels, FRAMES_LEAST, frames_most))


def find_colours(things: Sequence[Sequence[Thing]], count: int, around: Surroundings) -> list[MarkerColour]:
    """Find the `count` marker colours among the things of every frame, by hue.

    Raises:
        FitError: They cannot be distinguished.
    """
    frames = len(things)
    seen_share = 0.1  # of the frames in which a marker colour must be seen,
    seen_least = 4  # and at least so many
    least = max(seen_least, seen_share * frames)
    every = [colour for colour in _by_hue(things) if len(colour.things) >= least]
    near_skin = [colour for colour in every if colour.skin >= SETTINGS.skin_around]
    typical = float(np.median([colour.area for colour in near_skin])) if near_skin else 0.0
    size_share = 0.25  # of the typical area of all; a smaller thing is the fringe of another
    near_skin = [colour for colour in near_skin if colour.area >= size_share * typical]
    moving = [colour for colour in near_skin if colour.moved]
    # A colour that rested all the time looks like clutter but for the skin around it. It is taken when it is needed.
    resting = [
        colour
        for colour in near_skin
        if not colour.moved and colour.skin >= SETTINGS.resting_skin and not around.wooden
    ]
    found = sorted(moving, key=lambda colour: -len(colour.things))
    if len(found) < count:
        found += sorted(resting, key=lambda colour: -len(colour.things))
    hues = ", ".join(f"{colour.hue:.0f}" for colour in sorted(found, key=lambda colour: colour.hue)) or "none"
    if len(found) < count:
        raise FitError(
            f"{len(found)} paints move with the hand (hues {hues}), the rig has {count} markers: show the open hand, "
            f"back to the camera, all markers in view, and move it by more than its width"
            f"{_why_fewer(every, around)}"
        )
    _refuse_ambiguous(things, found[:count])
    # a further hue seen this often, relative to the rarest marker colour, makes it ambiguous
    alternative = 0.5
    if len(found) > count and len(found[count].things) >= alternative * len(found[count - 1].things):
        raise FitError(
            f"{len(found)} colours move with the hand (hues {hues}), the rig has {count} markers: take off or cover "
            f"what else is coloured (sleeve, ring, nails), or give clicks"
        )
    return sorted(found[:count], key=lambda colour: colour.hue)


def places(colours: Sequence[MarkerColour], frames: int) -> Float:
    """Return the centroids (F, M, 2) [px] of the marker colours.

    NaN where one was not seen.
    """
    uv = np.full((frames, len(colours), 2), np.nan)
    for m, colour in enumerate(colours):
        for thing in colour.things:
            uv[thing.frame, m] = thing.u, thing.v
    return uv


def pixels_of(colour: MarkerColour) -> Image:
    """Return the pixels (N, 3) HSV of a marker colour in all frames.

    Mixed rims and highlights are excluded.
    """
    chosen: list[Image] = []
    for thing in colour.things:
        saturation, value = np.median(thing.hsv[:, 1]), np.median(thing.hsv[:, 2])
        pure = hue_distance(thing.hsv[:, 0], colour.hue) <= HUE_GROW
        pure &= (thing.hsv[:, 1] >= UNUSUAL[0] * saturation) & (thing.hsv[:, 2] >= UNUSUAL[1] * value)
        chosen.append(thing.hsv[pure])
    return np.concatenate(chosen)


def _by_hue(things: Sequence[Sequence[Thing]]) -> list[MarkerColour]:
    """Group all things by the peaks of their smoothed hues.

    Of each peak the largest thing per frame is kept.
    """
    flat = [thing for row in things for thing in row]
    if not flat:
        return []
    hue = np.array([thing.hue for thing in flat])
    counts = np.bincount(hue.round().astype(int) % HUES, minlength=HUES).astype(np.float64)
    reach = np.minimum(np.arange(HUES), HUES - np.arange(HUES))
    # hues: standard deviation with which the hues of things are smoothed before peaks are sought
    smooth = 2.5
    kernel = np.exp(-0.5 * (reach / smooth) ** 2)
    density = np.real(np.fft.ifft(np.fft.fft(counts) * np.fft.fft(kernel)))
    peaks: list[int] = []
    for k in np.argsort(-density, kind="stable"):
        if density[k] < 1.0:
            break
        if all(hue_separation(k, p) >= HUE_SEPARATION for p in peaks):
            peaks.append(int(k))
    peaks = [p for p in peaks if density[p] >= max(density[p - 1], density[(p + 1) % HUES])]
    nearest = np.argmin([hue_distance(hue, p) for p in peaks], axis=0)
    colours: list[MarkerColour] = []
    for n, peak in enumerate(peaks):
        mine = [
            thing for thing, k in zip(flat, nearest, strict=True)
            if k == n and hue_separation(thing.hue, peak) <= HUE_GROW
        ]  # fmt: skip
        best: dict[int, Thing] = {}
        for thing in mine:
            if thing.frame not in best or thing.area > best[thing.frame].area:
                best[thing.frame] = thing
        if best:
            middle = circular_median(np.array([thing.hue for thing in best.values()]))
            colours.append(MarkerColour(middle, tuple(best.values())))
    return colours


def _refuse_ambiguous(things: Sequence[Sequence[Thing]], colours: Sequence[MarkerColour]) -> None:
    for colour in colours:
        double = 0
        # a second thing this large, in this share of the frames: two marker colours of one hue
        ambiguous_size, ambiguous_share = 0.3, 0.4
        for largest in colour.things:
            others = [
                t for t in things[largest.frame]
                if t is not largest and t.area > ambiguous_size * largest.area
                and hue_separation(t.hue, colour.hue) < HUE_SEPARATION
            ]  # fmt: skip
            double += bool(others)
        if double > ambiguous_share * len(colour.things):
            raise FitError(
                f"two things of hue {colour.hue:.0f} move with the hand in {double} of {len(colour.things)} frames: "
                f"two paints look the same (repaint one), or clothing has a paint's colour (cover it)"
            )


def _why_fewer(every: Sequence[MarkerColour], around: Surroundings) -> str:
    """Describe which other things might have been a marker colour.

    The text is for the error message.
    """
    reasons = ""
    if bare := [f"{colour.hue:.0f}" for colour in every if colour.skin < SETTINGS.skin_around]:
        reasons += f"; hue {', '.join(bare)} has no skin beside it"
    if still := [f"{thing.hue:.0f}" for thing in around.clutter if thing.skin >= SETTINGS.skin_around]:
        reasons += f"; what is coloured beside skin with hue {', '.join(still)} never moved"
    desk = np.flatnonzero((around.floor > PALE) & (around.floor < 256.0))
    if len(desk):
        reasons += (
            f"; the desk itself is coloured (hues {desk[0]}..{desk[-1]}): paints of these hues drown in it"
        )
    return reasons + "; red, orange and yellow paints cannot be distinguished from skin"


def _others(
    images: Sequence[Image],
    things: Sequence[Sequence[Thing]],
    colours: Sequence[MarkerColour],
    around: Surroundings,
) -> tuple[Image, Image, int]:
    """Return HSV pixels of skin near the marker colours and of the background.

    Also returns from how many frames they are.
    """
    skins: list[Image] = []
    grounds: list[Image] = []
    background_frames = 12  # from which the background's share is counted
    chosen = spread(len(images), background_frames)
    largest = max(thing.area for colour in colours for thing in colour.things)
    for k in chosen:
        hsv = hsv_of(images[k])
        colour = np.zeros(hsv.shape[:2], np.uint8)
        for thing in things[k]:
            if any(hue_separation(thing.hue, p.hue) <= HUE_GROW for p in colours):
                colour.reshape(-1)[thing.pixels] = 1
        colour |= _scraps(hsv, around, largest)
        rim, near = (
            cv2.dilate(colour, np.ones((2 * r + 1, 2 * r + 1), np.uint8)) != 0 for r in (RIM, AROUND)
        )
        skins.append(hsv[near & ~rim & around.skin.mask(hsv)])
        grounds.append(hsv[~np.asarray(rim)])
    return np.concatenate(skins), np.concatenate(grounds), len(chosen)


def _scraps(hsv: Image, around: Surroundings, largest: int) -> Image:
    """Find small coloured pieces that touch skin.

    They are marker colour nearly hidden, which is no background.
    """
    _, labels, stats, _ = cv2.connectedComponentsWithStats(
        coloured(hsv, around).astype(np.uint8), connectivity=8
    )
    skin = cv2.morphologyEx(around.skin.mask(hsv).astype(np.uint8), cv2.MORPH_OPEN, np.ones((5, 5), np.uint8))
    near_skin = np.asarray(cv2.dilate(skin, np.ones((5, 5), np.uint8)) != 0)
    for thing in around.clutter:
        labels.reshape(-1)[thing.pixels] = 0
    touching = np.bincount(labels[near_skin], minlength=len(stats)) > 0
    touching &= stats[:, cv2.CC_STAT_AREA] <= largest
    touching[0] = False
    return touching[np.asarray(labels, np.int64)].astype(np.uint8)
