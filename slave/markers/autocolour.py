"""Find the marker colours of a moving hand without clicks, and name them.

Some seconds of frames of one camera in; HSV ranges out. A marker colour keeps one hue, moves with the hand, and has
skin beside it; the M strongest such hues are the marker colours. Their pixels of all frames make the ranges
(`colours`).

Names come from the shape of the open hand seen from its back: each frame fits all orders of names by a similarity
without reflection (least squares in the complex plane) and votes for an order that fits clearly best. Or they come
from the hues of an older camera file (another lamp keeps their order on the circle), or from clicks. Nothing is
guessed: what the frames do not determine is a FitError that states what is missing.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations

import cv2
import numpy as np
import numpy.typing as npt

from common.arrays import Float, Image, Int
from common.calibration import HandProfile, HsvRange
from common.errors import CalibrationError, FitError
from common.hand.model import HandModel
from slave.markers.autocolour_things import (
    RESTING_SKIN,
    SKIN_AROUND,
    Surroundings,
    Thing,
    background_of,
    coloured,
    least_shift_px,
    skin_of,
    spread,
    surroundings_of,
    things_of,
)
from slave.markers.classify import HUES, hue_distance, hue_span
from slave.markers.colours import (
    AROUND,
    HUE_GROW,
    HUE_SEPARATION,
    PALE,
    RIM,
    ColourRow,
    circular_median,
    dilated,
    hsv_of,
    like,
    rows_of,
)

FRAMES_LEAST = 8

Notify = Callable[[str], None]
Namer = Callable[[Sequence["MarkerColour"], Float], tuple[str, ...]]
"""(M paints, centroids (F, M, 2) [px] NaN where not seen) -> their names. Raises FitError when not certain."""


@dataclass(frozen=True, slots=True, eq=False)
class MarkerColour:
    """A marker colour: its hue, and its largest thing in every frame that shows it."""

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
        low, high = np.percentile([(thing.u, thing.v) for thing in self.things], (5, 95), axis=0)
        return float(np.hypot(*(high - low))) > least_shift_px(size)


def calibrate_moving(
    images: Sequence[Image], names: tuple[str, ...], namer: Namer, notify: Notify = lambda _text: None
) -> list[ColourRow]:
    """Ranges and collisions of all markers, in the order of `names`.

    `images`: (H, W, 3) BGR each, of one resting camera, over a few seconds; 30 to 60 are plenty.

    Raises:
        FitError: Too few frames, no motion, no skin, too few or too many marker colours, two too alike, or names
            that are not certain; the message states what to do.
    """
    if len(images) < FRAMES_LEAST:
        raise FitError(
            f"{len(images)} frames, at least {FRAMES_LEAST} are needed: record a few seconds of the moving hand"
        )
    background = background_of(images)
    around = surroundings_of(images, background, skin_of(images, background))
    low, high = around.skin.saturation
    notify(
        f"skin: hue {around.skin.hue:.0f}, saturation {low:.0f}..{high:.0f}; "
        f"{len(around.clutter)} coloured things stand still"
    )
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
    """Return how many frames of so many pixels are held at once."""
    frames_most = 60
    pixels_most = 60_000_000  # of all frames together: 180 MB
    return int(np.clip(pixels_most // pixels, FRAMES_LEAST, frames_most))


def find_colours(things: Sequence[Sequence[Thing]], count: int, around: Surroundings) -> list[MarkerColour]:
    """Find the `count` marker colours among all things by hue, or raise FitError."""
    frames = len(things)
    seen_share = 0.1  # of the frames in which a marker colour must be seen,
    seen_least = 4  # and at least so many
    least = max(seen_least, seen_share * frames)
    every = [colour for colour in _by_hue(things) if len(colour.things) >= least]
    near_skin = [colour for colour in every if colour.skin >= SKIN_AROUND]
    typical = float(np.median([colour.area for colour in near_skin])) if near_skin else 0.0
    size_share = 0.25  # of the typical area of all; a smaller thing is the fringe of another
    near_skin = [colour for colour in near_skin if colour.area >= size_share * typical]
    moving = [colour for colour in near_skin if colour.moved]
    # A colour that rested all the time looks like clutter but for the skin around it. It is taken when it is needed.
    resting = [colour for colour in near_skin if colour not in moving and colour.skin >= RESTING_SKIN]
    found = sorted(moving, key=lambda colour: -len(colour.things))
    if len(found) < count and not around.wooden:
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
    """Return the centroids (F, M, 2) [px] of the marker colours; NaN: not seen."""
    uv = np.full((frames, len(colours), 2), np.nan)
    for m, colour in enumerate(colours):
        for thing in colour.things:
            uv[thing.frame, m] = thing.u, thing.v
    return uv


def pixels_of(colour: MarkerColour) -> Image:
    """Return a colour's pixels (N, 3) HSV in all frames, less rims and highlights."""
    return np.concatenate([thing.hsv[like(thing.hsv, colour.hue, thing.hsv)] for thing in colour.things])


def _by_hue(things: Sequence[Sequence[Thing]]) -> list[MarkerColour]:
    """Group things by the peaks of their smoothed hues, the largest of each frame."""
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
        if all(hue_distance(k, p) >= HUE_SEPARATION for p in peaks):
            peaks.append(int(k))
    peaks = [p for p in peaks if density[p] >= max(density[p - 1], density[(p + 1) % HUES])]
    nearest = np.argmin([hue_distance(hue, p) for p in peaks], axis=0)
    colours: list[MarkerColour] = []
    for n, peak in enumerate(peaks):
        best: dict[int, Thing] = {}
        for k in np.flatnonzero((nearest == n) & (hue_distance(hue, peak) <= HUE_GROW)):
            thing = flat[k]
            if thing.frame not in best or thing.area > best[thing.frame].area:
                best[thing.frame] = thing
        if best:
            middle = circular_median(np.array([thing.hue for thing in best.values()]))
            colours.append(MarkerColour(middle, tuple(best.values())))
    return colours


def _refuse_ambiguous(things: Sequence[Sequence[Thing]], colours: Sequence[MarkerColour]) -> None:
    # a second thing this large, in this share of the frames: two marker colours of one hue
    ambiguous_size, ambiguous_share = 0.3, 0.4
    for colour in colours:
        double = sum(
            any(
                other is not largest
                and other.area > ambiguous_size * largest.area
                and hue_distance(other.hue, colour.hue) < HUE_SEPARATION
                for other in things[largest.frame]
            )
            for largest in colour.things
        )
        if double > ambiguous_share * len(colour.things):
            raise FitError(
                f"two things of hue {colour.hue:.0f} move with the hand in {double} of {len(colour.things)} frames: "
                f"two paints look the same (repaint one), or clothing has a paint's colour (cover it)"
            )


def _why_fewer(every: Sequence[MarkerColour], around: Surroundings) -> str:
    """Describe, for the error message, what else might have been a marker colour."""
    reasons = ""
    if bare := [f"{colour.hue:.0f}" for colour in every if colour.skin < SKIN_AROUND]:
        reasons += f"; hue {', '.join(bare)} has no skin beside it"
    if still := [f"{thing.hue:.0f}" for thing in around.clutter if thing.skin >= SKIN_AROUND]:
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
    """HSV pixels of skin near the marker colours, of background; number of frames."""
    skins: list[Image] = []
    grounds: list[Image] = []
    background_frames = 12  # from which the background's share is counted
    chosen = spread(len(images), background_frames)
    largest = max(thing.area for colour in colours for thing in colour.things)
    for k in chosen:
        hsv = hsv_of(images[k])
        colour = np.zeros(hsv.shape[:2], np.uint8)
        for thing in things[k]:
            if any(hue_distance(thing.hue, p.hue) <= HUE_GROW for p in colours):
                colour.reshape(-1)[thing.pixels] = 1
        colour |= _scraps(hsv, around, largest)
        rim = dilated(colour, RIM)
        skins.append(hsv[dilated(colour, AROUND) & ~rim & around.skin.mask(hsv)])
        grounds.append(hsv[~rim])
    return np.concatenate(skins), np.concatenate(grounds), len(chosen)


def _scraps(hsv: Image, around: Surroundings, largest: int) -> Image:
    """Small coloured pieces that touch skin: marker colour nearly hidden."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(
        coloured(hsv, around).astype(np.uint8), connectivity=8
    )
    skin = cv2.morphologyEx(around.skin.mask(hsv).astype(np.uint8), cv2.MORPH_OPEN, np.ones((5, 5), np.uint8))
    for thing in around.clutter:
        labels.reshape(-1)[thing.pixels] = 0
    touching = np.bincount(labels[dilated(np.asarray(skin, np.uint8), 2)], minlength=len(stats)) > 0
    touching &= stats[:, cv2.CC_STAT_AREA] <= largest
    touching[0] = False
    return touching[np.asarray(labels, np.int64)].astype(np.uint8)


Complex = npt.NDArray[np.complex128]

LEAST = 5  # fewer than five have no shape to go by
_OPEN = (
    "show the open hand, fingers spread, its back to the camera, for a second or more; or give clicks, or --like with "
    "a camera file whose colours are named"
)


def by_hand(profile: HandProfile, names: tuple[str, ...], notify: Notify = lambda _text: None) -> Namer:
    """Names by the picture of an open hand's back; CalibrationError: no such marker."""
    if len(names) == 1:
        return lambda colours, uv: names
    pattern = pattern_of(profile, names)

    def name(colours: Sequence[MarkerColour], uv: Float) -> tuple[str, ...]:
        most = 7  # colours whose orders are tried: 5040 at most
        if not LEAST <= len(names) <= most:
            raise FitError(
                f"{len(names)} markers cannot be named from the shape of the hand, only {LEAST} to {most}: give "
                f"clicks, or --like with a camera file whose colours are named"
            )
        orders = np.array(list(permutations(range(len(names)))))
        votes, mirrored = votes_of(uv, pattern, orders)
        if mirrored > len(votes):
            raise FitError(
                f"in {mirrored} of {len(uv)} frames the hand is the mirror image of {profile.name!r} "
                f"({profile.side}): show the back of the hand, or choose the profile of the other side (rig.hand)"
            )
        votes_least = 5
        if len(votes) < votes_least:
            raise FitError(
                f"only {len(votes)} of {len(uv)} frames look like the open hand of {profile.name!r}: {_OPEN}"
            )
        best, count = Counter(votes).most_common(1)[0]
        share = count / len(votes)
        votes_share = 0.8  # of all votes
        if share < votes_share:
            raise FitError(
                f"the frames disagree about the names ({share:.0%} of {len(votes)} votes for the best order): {_OPEN}"
            )
        notify(f"names by the shape of the hand: {share:.0%} of {len(votes)} votes")
        return tuple(names[int(k)] for k in orders[best])

    return name


def pattern_of(profile: HandProfile, names: tuple[str, ...]) -> Float:
    """Return the markers (M, 2) of the flat hand as a camera sees its back.

    u to the right, v down, fingers up [m]. Raises CalibrationError where the profile lacks a marker.
    """
    model = HandModel.of(profile)
    points = model.marker_points(model.forward(np.eye(4), np.zeros((5, 4))), names)
    # The palm frame has +z to the fingers and +y out of the back; whoever looks along -y has x to the left.
    return -points[:, [0, 2]]


def votes_of(uv: Float, pattern: Float, orders: Int) -> tuple[list[int], int]:
    """Count the votes of the frames that show all marker colours, or all but one.

    `uv` (F, M, 2): centroids [px], NaN where not seen; `pattern` (M, 2): the flat hand; `orders` (P, M): row of
    the pattern of each marker colour. Returns the order that each voting frame is for, and how many frames see the
    mirrored hand better.
    """
    votes: list[int] = []
    mirrored = 0
    p = pattern[:, 0] + 1j * pattern[:, 1]
    for frame in uv[..., 0] + 1j * uv[..., 1]:
        seen = np.isfinite(frame)
        if seen.sum() < max(LEAST, len(p) - 1):
            continue
        z = _unit(frame[seen])
        ideal = _unit(p[orders[:, seen]])
        # |z - a p|^2 at the best a is 1 - |<p, z>|^2 for unit vectors.
        residual = np.sqrt(np.maximum(0.0, 1.0 - np.abs(ideal.conj() @ z) ** 2))
        reflected = np.sqrt(max(0.0, 1.0 - float(np.max(np.abs(ideal @ z))) ** 2))
        first, second = np.argpartition(residual, 1)[:2]
        most_residual = 0.25  # relative; a fist, or a hand from the side, has more
        clearer = 0.75  # of the runner-up's residual
        if reflected < clearer * residual[first] and reflected < most_residual:
            mirrored += 1
        elif residual[first] < most_residual and residual[first] < clearer * min(residual[second], reflected):
            votes.append(int(first))
    return votes, mirrored


def _unit(z: Complex) -> Complex:
    """Points (..., M) of the complex plane, centred, of unit norm."""
    z = z - z.mean(axis=-1, keepdims=True)
    return z / np.linalg.norm(z, axis=-1, keepdims=True)


def by_hues(
    markers: Mapping[str, HsvRange] | None,
    names: tuple[str, ...],
    where: str,
    notify: Notify = lambda _text: None,
) -> Namer:
    """Names by a camera file of another camera or lamp; CalibrationError: no range."""
    missing = [name for name in names if name not in (markers or {})]
    if missing or markers is None:
        raise CalibrationError(
            f"{where}: markers: no range for {', '.join(missing)}: no names can be taken from it"
        )
    middle = {name: hue_span(markers[name])[0] for name in names}
    around = sorted(names, key=lambda name: middle[name])

    def name(colours: Sequence[MarkerColour], uv: Float) -> tuple[str, ...]:
        del uv
        order = sorted(range(len(colours)), key=lambda k: colours[k].hue)
        old = np.array([middle[name] for name in around])
        new = np.array([colours[k].hue for k in order])
        shifts = [(np.roll(old, s) - new + HUES / 2) % HUES - HUES / 2 for s in range(len(old))]
        residual = np.array([float(np.square(shift).sum()) for shift in shifts])
        best = int(np.argmin(residual))
        worst = float(np.abs(shifts[best]).max())
        hue_clearer = 0.25  # of the runner-up's sum of squares
        if len(old) > 1 and residual[best] > hue_clearer * float(np.sort(residual)[1]):
            raise FitError(
                f"{where}: its hues fit in two orders alike: the light is too different; give clicks, or leave the "
                f"names to the shape of the hand"
            )
        notify(f"names by the hues of {where}: the farthest is {worst:.0f} away")
        named = dict(zip(order, np.roll(np.array(around), best).tolist(), strict=True))
        return tuple(str(named[k]) for k in range(len(colours)))

    return name


def checked(namer: Namer, shape: Namer, notify: Notify = lambda _text: None) -> Namer:
    """Names of `namer`; FitError where the shape of the hand is certain of others."""

    def name(colours: Sequence[MarkerColour], uv: Float) -> tuple[str, ...]:
        named = namer(colours, uv)
        try:
            shaped = shape(colours, uv)
        except FitError as error:
            notify(f"names not checked by the shape of the hand: {error}")
            return named
        if named != shaped:
            wrong = ", ".join(
                f"hue {p.hue:.0f}: {a} or {b}"
                for p, a, b in zip(colours, named, shaped, strict=True)
                if a != b
            )
            raise FitError(
                f"the names contradict the shape of the hand ({wrong}): another paint, clothing, or another hand? "
                f"Give clicks, or the right --like or --hand"
            )
        return named

    return name


def by_clicks(clicks: Mapping[str, tuple[float, float]], names: tuple[str, ...], width: int) -> Namer:
    """Names from one click (u, v) [px] on each marker in the first frame."""

    def name(colours: Sequence[MarkerColour], uv: Float) -> tuple[str, ...]:
        del uv
        of: dict[int, str] = {}
        for marker in names:
            distances: list[float] = []
            for colour in colours:
                first = [thing.pixels for thing in colour.things if thing.frame == 0]
                v, u = np.divmod(first[0], width) if first else (np.array([np.inf]), np.array([np.inf]))
                distances.append(float(np.hypot(u - clicks[marker][0], v - clicks[marker][1]).min()))
            best = int(np.argmin(distances))
            click_reach = 6.0  # px between a click and the nearest pixel of its marker colour
            if distances[best] > click_reach:
                raise FitError(f"clicks.{marker}: no moving paint at {clicks[marker]} in the first frame")
            if best in of:
                raise FitError(f"clicks.{marker}: on the same paint as clicks.{of[best]}")
            of[best] = marker
        return tuple(of[k] for k in range(len(colours)))

    return name
