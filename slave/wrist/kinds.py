"""What frames of a strobed camera are, by what they show: LEDs on or off between two; ambient, laser, LED of three.

All is judged on a coarse image, cell by cell, by how far one frame is brighter than another *beyond* what noise, and
ambient light that swings, explain:

    broad      a square of 72 px fits into what is brighter: LEDs light a palm, which is wider than that
    thin       much brighter, and in its column lower than 72 px: the line of the laser
    flash      thin, and brighter than both other frames: light that was there in one frame alone

LEDs are told by broad light. The laser is told by a flash on what the LEDs light, or at its edge, and nowhere else: a
window between moving fingers, a shadow, somebody who walks by are thin at times, or near, or there for one frame, and
hardly ever all at once. Of three frames the ambient one is nowhere brighter, as light only adds.
Where both frames are saturated neither is brighter: such cells tell nothing and are not counted.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from math import inf, log2

import cv2
import numpy as np

from common.arrays import Image

_SIZE = (80, 60)  # cells across and down: 8 x 8 px of 640 x 480
_NOISE = 6  # levels: five standard deviations of a cell near saturation (16 px of 5 levels of shot noise)
_SWING = 0.125  # of the ambient light: how far lamps on the mains swing between two frames
_EXPLAINED = (_NOISE + _SWING * np.arange(256)).astype(np.uint8)  # by the darker of two levels
_LINE = 20  # levels beyond that: a line that a centroid can be taken of
_SATURATED = 250  # level of a cell
# Neighbourhoods, (rows, columns) of cells.
_SQUARE = np.ones((9, 9), np.uint8)  # narrower than a palm, wider than a finger
_COLUMN = np.ones((9, 1), np.uint8)
_LINE_HIGH = np.ones((5, 1), np.uint8)  # a line hides so many from the LEDs
_AROUND = np.ones((5, 5), np.uint8)
_SMALL = np.ones((3, 3), np.uint8)  # narrower than a finger, wider than a window moves in one frame

LED_LEAST = 0.08  # share of the cells that LEDs light broadly: a palm fills a sixth of the picture or more
LED_NEVER = 0.04  # share up to which it is none: the halo of a laser on a near thumb, a hand that moved
LASER_LEAST = 8  # cells of flash: the line on one finger
# How many times as many cells of flash on the hand as there are
LASER_OF_ELSEWHERE = 2.0  # of flash elsewhere
LASER_OF_OWN = 4.0  # of flash on the hand in the ambient frame: another laser frame has as many
LASER_OF_EXCESS = 8.0  # of lines within the hand that the ambient frame has and another has not
VALID_LEAST = 0.25  # share of the cells that are not saturated: with fewer nothing is told


class Led(Enum):
    """What became of the LEDs from one frame to another."""

    ON = "on"
    OFF = "off"
    SAME = "same"
    UNSURE = "unsure"


@dataclass(frozen=True, slots=True)
class Evidence:
    """How sure it is that three frames are ambient, laser, LED: base-2 logarithms of measures over their thresholds.

    Attributes:
        led: The LED frame has broad light that the ambient frame has not.
        laser: The laser frame has a flash where the LEDs light.
        alone: There are no such lines in the ambient frame, nor as many flashes there or elsewhere.
        steady: Nothing broad came or went with the laser, or went with the LEDs.
    """

    led: float
    laser: float
    alone: float
    steady: float

    @property
    def margin(self) -> float:
        """The weakest of the four [octaves]; not positive: not sure."""
        return min(self.led, self.laser, self.alone, self.steady)


def coarse(image: Image) -> Image:
    """(60, 80) uint8 means over cells of a frame (H, W) or (H, W, 3).

    By halves as far as that goes: means of two by two are what a processor is quickest at.
    """
    cells: cv2.typing.MatLike = image
    while cells.shape[1] % (2 * _SIZE[0]) == 0 and cells.shape[0] % (2 * _SIZE[1]) == 0:
        cells = cv2.resize(cells, (cells.shape[1] // 2, cells.shape[0] // 2), interpolation=cv2.INTER_AREA)
    if cells.shape[1::-1] != _SIZE:
        cells = cv2.resize(cells, _SIZE, interpolation=cv2.INTER_AREA)
    return np.asarray(cells if cells.ndim == 2 else cells.max(axis=2), np.uint8)


def led_change(before: Image, after: Image) -> Led:
    """What became of the LEDs between two coarse frames (60, 80)."""
    valid = _valid(before, after)
    if valid < VALID_LEAST * before.size:
        return Led.UNSURE
    on, off = (_broad(over, LED_NEVER * valid) / valid for over in _each_over(after, before))
    if max(on, off) <= LED_NEVER:
        return Led.SAME
    if on >= LED_LEAST and off <= LED_NEVER:
        return Led.ON
    if off >= LED_LEAST and on <= LED_NEVER:
        return Led.OFF
    return Led.UNSURE


def evidence(ambient: Image, laser: Image, led: Image) -> Evidence:
    """Of three coarse frames (60, 80), each as what it should be."""
    valid = _valid(ambient, led)
    if valid < VALID_LEAST * ambient.size:
        return Evidence(-inf, -inf, -inf, -inf)
    (led_gain, led_loss), (laser_gain, laser_loss) = _each_over(led, ambient), _each_over(laser, ambient)
    led_over_laser, laser_over_led = _each_over(led, laser)
    near = _near(np.minimum(led_gain, led_over_laser))
    flash = _thin(np.minimum(laser_gain, laser_over_led))
    on_hand = cv2.countNonZero(cv2.bitwise_and(flash, near))
    elsewhere = cv2.countNonZero(cv2.subtract(flash, cv2.dilate(near, _AROUND)))
    own = _shared(np.minimum(laser_loss, led_loss), lambda: _near(led_over_laser))
    excess = max(_shared(loss, lambda: _inside(led_gain)) for loss in (led_loss, laser_loss))
    rest = max(LASER_OF_ELSEWHERE * elsewhere, LASER_OF_OWN * own, LASER_OF_EXCESS * excess)
    came_or_went = max(_broad(laser_gain), _broad(laser_loss), _broad(led_loss)) / valid
    return Evidence(
        _octaves(_broad(led_gain) / valid, LED_LEAST),
        _octaves(on_hand, LASER_LEAST),
        _octaves(on_hand, rest),
        -_octaves(came_or_went, LED_NEVER),
    )


def _valid(first: Image, second: Image) -> int:
    """Number of cells in which one of the frames may be brighter than the other."""
    return cv2.countNonZero(
        cv2.threshold(cv2.min(first, second), _SATURATED - 1, 255, cv2.THRESH_BINARY_INV)[1]
    )


def _each_over(first: Image, second: Image) -> tuple[Image, Image]:
    """How far each frame is brighter than the other beyond what noise and a swing of ambient light explain [levels]."""
    explained = cv2.LUT(cv2.min(first, second), _EXPLAINED)
    pairs = ((first, second), (second, first))
    one, other = (cv2.subtract(cv2.subtract(bright, dark), explained) for bright, dark in pairs)
    return np.asarray(one, np.uint8), np.asarray(other, np.uint8)


def _lit(over: Image) -> cv2.typing.MatLike:
    return cv2.threshold(over, 0, 255, cv2.THRESH_BINARY)[1]


def _near(over: Image) -> cv2.typing.MatLike:
    """What the LEDs light, and a line's height above and below."""
    return cv2.dilate(cv2.morphologyEx(_lit(over), cv2.MORPH_OPEN, _SMALL), _LINE_HIGH)


def _inside(over: Image) -> cv2.typing.MatLike:
    """What lies within what the LEDs light, a line's height bridged."""
    return cv2.erode(cv2.morphologyEx(_lit(over), cv2.MORPH_CLOSE, _LINE_HIGH), _SMALL)


def _broad(over: Image, least: float = 0.0) -> int:
    """How many cells are broadly brighter; 0 where no more than `least` are brighter at all."""
    if cv2.countNonZero(over) <= least:
        return 0
    return cv2.countNonZero(cv2.morphologyEx(_lit(over), cv2.MORPH_OPEN, _SQUARE))


def _shared(over: Image, where: Callable[[], cv2.typing.MatLike]) -> int:
    """How many cells of thin lines lie there; `where` is asked only if there can be any."""
    if cv2.minMaxLoc(over)[1] <= _LINE:
        return 0
    return cv2.countNonZero(cv2.bitwise_and(_thin(over), where()))


def _thin(over: Image) -> cv2.typing.MatLike:
    bright = cv2.threshold(over, _LINE, 255, cv2.THRESH_BINARY)[1]
    high = cv2.morphologyEx(bright, cv2.MORPH_OPEN, _COLUMN)
    return cv2.subtract(bright, high)


def _octaves(value: float, threshold: float) -> float:
    if value <= 0.0:
        return -inf
    return log2(value / threshold) if threshold > 0.0 else inf
