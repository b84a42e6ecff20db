"""What was switched between two frames of a strobed camera, and whether three of them are ambient, laser and LED.

Everything is judged on a coarse image by signed differences, cell by cell:

    gained     brighter than what ambient light, noise and flicker explain
    broad      the part of it that a square of 72 px fits into: LEDs light the whole palm, nothing else does
    thin       bright, and in its column lower than 72 px: the line of the laser

Light only adds, so of three frames the ambient one is nowhere brighter than the others; and the laser lights what is
near, so that its line lies where the LEDs light. A shadow or a window that moves through the picture does one of the
two at most. Where both frames are saturated neither gains: such cells are not counted.
"""

from dataclasses import dataclass
from math import inf, log2

import cv2
import numpy as np

from common.arrays import Image
from common.frame_recording import Illumination

AMBIENT, LASER, LED = Illumination.AMBIENT, Illumination.LASER, Illumination.LED
ORDER = (AMBIENT, LASER, LED)

_SIZE = (80, 60)  # cells across and down: 8 x 8 px of 640 x 480
_ROWS = 4  # every how manieth row is looked at
_NOISE = 6  # levels: five standard deviations of a cell near saturation (16 px of 5 levels of shot noise)
_FLICKER = (
    3  # right shift: lamps on the mains swing by an eighth between two frames (an incandescent one by 10 %)
)
_STRIPE = 20  # levels beyond that: a line that a centroid can be taken of
_SATURATED = 250  # level of a cell
_SQUARE = cv2.getStructuringElement(cv2.MORPH_RECT, (9, 9))  # narrower than a palm, wider than a finger
_COLUMN = cv2.getStructuringElement(cv2.MORPH_RECT, (1, 9))

LED_LEAST = 0.08  # share of the cells that LEDs light broadly: a palm fills a sixth of the picture or more
LED_NEVER = 0.04  # share up to which it is none: the halo of a laser on a near thumb, a hand that moved
LASER_LEAST = 8  # cells: the line of one finger
VALID_LEAST = 0.25  # share of the cells that are not saturated: with fewer nothing is told


@dataclass(frozen=True, slots=True, eq=False)
class Gain:
    """Where one coarse frame is brighter than another.

    Attributes:
        broad: Share of the valid cells.
        lit: (60, 80) 255 where brighter at all.
        thin: (60, 80) 255 on thin bright lines.
        lines: Number of cells of `thin`.
    """

    broad: float
    lit: Image
    thin: Image
    lines: int


@dataclass(frozen=True, slots=True, eq=False)
class Change:
    """From one frame to another: what was gained and what was lost; `valid`: share of cells that are not saturated."""

    gained: Gain
    lost: Gain
    valid: float


def coarse(image: Image) -> Image:
    """(60, 80) uint8 means over cells of a frame (H, W) or (H, W, 3)."""
    cells = cv2.resize(image[::_ROWS], _SIZE, interpolation=cv2.INTER_AREA)
    return np.asarray(cells if cells.ndim == 2 else cells.max(axis=2), np.uint8)


def change(before: Image, after: Image) -> Change:
    """Compare two coarse frames (60, 80)."""
    darker = np.minimum(before, after)
    valid = int(np.count_nonzero(darker < _SATURATED))
    explained = np.asarray(np.right_shift(darker, _FLICKER) + np.uint8(_NOISE), np.uint8)
    return Change(
        _gain(before, after, explained, valid), _gain(after, before, explained, valid), valid / darker.size
    )


def _gain(before: Image, after: Image, explained: Image, valid: int) -> Gain:
    gained = np.asarray(cv2.subtract(cv2.subtract(after, before), explained), np.uint8)
    lit = _above(gained, 0)
    broad = cv2.countNonZero(cv2.morphologyEx(lit, cv2.MORPH_OPEN, _SQUARE))
    bright = _above(gained, _STRIPE)
    thin = np.asarray(cv2.subtract(bright, cv2.morphologyEx(bright, cv2.MORPH_OPEN, _COLUMN)), np.uint8)
    return Gain(broad / max(valid, 1), lit, thin, cv2.countNonZero(thin))


def _above(cells: Image, level: int) -> Image:
    return np.asarray(cv2.threshold(cells, level, 255, cv2.THRESH_BINARY)[1], np.uint8)


def kinds(of: Change) -> tuple[Illumination | None, Illumination | None]:
    """What two successive frames are by what was switched between them; None where it does not tell.

    `NONE` for both: nothing was switched, whatever they are.
    """
    on, off = of.gained.broad, of.lost.broad
    doubtful = any(LED_NEVER < share < LED_LEAST for share in (on, off))
    if of.valid < VALID_LEAST or doubtful or min(on, off) >= LED_LEAST:
        return None, None
    brighter, darker = of.gained.lines >= LASER_LEAST, of.lost.lines >= LASER_LEAST
    if on >= LED_LEAST:
        return LASER if darker else None, LED
    if off >= LED_LEAST:
        return LED, LASER if brighter else AMBIENT
    if brighter and darker:
        return None, None
    if brighter:
        return AMBIENT, LASER
    if darker:
        return LASER, AMBIENT
    return Illumination.NONE, Illumination.NONE


@dataclass(frozen=True, slots=True)
class Evidence:
    """How sure it is that three frames are ambient, laser, LED: base-2 logarithms of each share over its threshold.

    Attributes:
        led: Broad light in the LED frame.
        laser: Thin light of the laser frame where the LEDs light.
        ambient: The ambient frame is the darkest: what it has in excess, against the laser's light.
        other: Nothing broad came or went with the laser.
    """

    led: float
    laser: float
    ambient: float
    other: float

    @property
    def margin(self) -> float:
        """The weakest of the four [octaves]; not positive: not sure."""
        return min(self.led, self.laser, self.ambient, self.other)


def evidence(ambient_laser: Change, ambient_led: Change) -> Evidence:
    """Of three frames, from the changes from the one that should be ambient to the two others."""
    if min(ambient_laser.valid, ambient_led.valid) < VALID_LEAST:
        return Evidence(-inf, -inf, -inf, -inf)
    near = ambient_led.gained.lit
    laser = cv2.countNonZero(cv2.bitwise_and(ambient_laser.gained.thin, near))
    excess = [
        cv2.countNonZero(cv2.bitwise_and(thin, near))
        for thin in (ambient_laser.lost.thin, ambient_led.lost.thin)
    ]
    other = max(ambient_laser.gained.broad, ambient_laser.lost.broad, ambient_led.lost.broad)
    return Evidence(
        _octaves(ambient_led.gained.broad, LED_LEAST),
        _octaves(laser, LASER_LEAST),
        _octaves(laser, 2.0 * max(excess)),
        -_octaves(other, LED_NEVER),
    )


def _octaves(value: float, threshold: float) -> float:
    if value <= 0.0:
        return -inf
    return log2(value / threshold) if threshold > 0.0 else inf
