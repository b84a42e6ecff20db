"""Recognise ambient, laser and LED frames by content, and subtract the ambient.

A coarse image is judged cell by cell, by how far one frame is brighter than another *beyond* what noise, and ambient
light that swings, explain; saturated cells are not counted:

    broad      a square of 72 px fits into what is brighter: LEDs light a palm, which is wider than that
    thin       much brighter, and in its column lower than 72 px: the line of the laser
    flash      thin, and brighter than both other frames: light that was there in one frame alone

LEDs are detected by broad light; the laser by a flash on what the LEDs light, or at its edge, and nowhere else
(windows between moving fingers, shadows, passers-by); the ambient frame is nowhere brighter, as light only adds.

The strobe is that of Kim et al. 2012. Three frames are a strobe cycle if each followed the one before by one period, by
time and by counter; if they show ambient, laser, LED with a margin above 0 (`evidence`); and if the cycle before,
accepted or not, had the same phase: where pictures were exchanged while their times were not, A1 L1 E0 may follow one
another, of two poses. A cycle that has slipped is known with its second cycle. Copies of a frame are dropped.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from math import inf, log2
from typing import NamedTuple

import cv2
import numpy as np

from common.arrays import Image
from slave.sources import Frame

_Cells = cv2.typing.MatLike  # of a coarse frame
_SIZE = (80, 60)  # cells across and down: 8 x 8 px of 640 x 480


class IlluminationSettings(NamedTuple):
    """Numbers that distinguish laser, LED and ambient frames."""

    noise: int = 6  # levels: five deviations of a cell near saturation (16 px of 5 levels of shot noise)
    swing: float = 0.125  # of the ambient light: how far lamps on the mains swing between two frames
    line: int = 20  # levels beyond that: a line that a centroid can be taken of
    led_least: float = 0.08  # share of the cells that LEDs light broadly: a palm fills a sixth or more
    led_never: float = 0.04  # share up to which it is none: the halo of a laser on a near thumb, motion
    valid_least: float = 0.25  # share of the cells that are not saturated: with fewer nothing is decided


SETTINGS = IlluminationSettings()
# by the darker of two levels
_NOISE_OF_LEVEL = (SETTINGS.noise + SETTINGS.swing * np.arange(256)).astype(np.uint8)
# Neighbourhoods, (rows, columns) of cells.
_SQUARE = np.ones((9, 9), np.uint8)  # narrower than a palm, wider than a finger
_COLUMN = np.ones((9, 1), np.uint8)
_LINE_HIGH = np.ones((5, 1), np.uint8)  # a line hides so many from the LEDs
_AROUND = np.ones((5, 5), np.uint8)
_SMALL = np.ones((3, 3), np.uint8)  # narrower than a finger, wider than a window moves in one frame


@dataclass(frozen=True, slots=True)
class Evidence:
    """Evidence of ambient, laser, LED: log2 of measures over thresholds; -inf: none."""

    led: float = -inf  # the LED frame has broad light that the ambient frame has not
    laser: float = -inf  # the laser frame has a flash where the LEDs light
    alone: float = -inf  # no such lines in the ambient frame, nor as many flashes there or elsewhere
    steady: float = -inf  # nothing broad came or went with the laser, or went with the LEDs

    @property
    def margin(self) -> float:
        """The weakest of the four [octaves]; not positive: not sure."""
        return min(self.led, self.laser, self.alone, self.steady)


def coarse(image: Image) -> Image:
    """(60, 80) uint8 means over cells of a frame, by halves, which is quickest."""
    cells: _Cells = image
    while cells.shape[1] % (2 * _SIZE[0]) == 0 and cells.shape[0] % (2 * _SIZE[1]) == 0:
        cells = cv2.resize(cells, (cells.shape[1] // 2, cells.shape[0] // 2), interpolation=cv2.INTER_AREA)
    if cells.shape[1::-1] != _SIZE:
        cells = cv2.resize(cells, _SIZE, interpolation=cv2.INTER_AREA)
    return np.asarray(cells if cells.ndim == 2 else cells.max(axis=2), np.uint8)


def evidence(ambient: Image, laser: Image, led: Image) -> Evidence:
    """Evidence of three coarse frames (60, 80); -inf: not evaluated."""
    valid = _valid(cv2.min(ambient, led))
    if valid < SETTINGS.valid_least * ambient.size:
        return Evidence()
    led_gain, led_loss = _each_over(led, ambient)
    if cv2.countNonZero(led_gain) <= SETTINGS.led_least * valid:
        return Evidence()
    lit = _octaves(_broad(led_gain) / valid, SETTINGS.led_least)
    laser_gain, laser_loss = _each_over(laser, ambient)
    laser_least = 8  # cells of flash: the line on one finger
    if not lit > 0.0 or cv2.countNonZero(laser_gain) <= laser_least:
        return Evidence(lit)
    halo = 0.5  # of the light of the LEDs: what a line scatters over near skin is mostly less
    above_halo = cv2.subtract(laser_gain, cv2.convertScaleAbs(led_gain, alpha=halo))
    steady = -_octaves(
        max(_broad(over) for over in (above_halo, laser_loss, led_loss)) / valid, SETTINGS.led_never
    )
    if not steady > 0.0:
        return Evidence(lit, steady=steady)
    led_over_laser, laser_over_led = _each_over(led, laser)
    line = cv2.subtract(
        _above_column(laser_gain), cv2.convertScaleAbs(_above_column(led_gain), beta=SETTINGS.line)
    )
    flash = _thin(cv2.max(cv2.min(laser_gain, laser_over_led), line))
    if cv2.countNonZero(flash) <= laser_least:
        return Evidence(lit, steady=steady)
    near = _near(cv2.min(led_gain, led_over_laser))
    on_hand = cv2.countNonZero(cv2.bitwise_and(flash, near))
    elsewhere = cv2.countNonZero(cv2.subtract(flash, cv2.dilate(near, _AROUND)))
    own = _shared(cv2.min(laser_loss, led_loss), lambda: _near(led_over_laser))
    excess = max(_shared(loss, lambda: _inside(led_gain)) for loss in (led_loss, laser_loss))
    # How many times as many cells of flash on the hand as of flash elsewhere; of flash on the hand in the ambient
    # frame, of which another laser frame has as many; of lines within the hand that it has and another frame has not.
    rest = max(4.0 * elsewhere, 4.0 * own, 8.0 * excess)
    return Evidence(lit, _octaves(on_hand, laser_least), _octaves(on_hand, rest), steady)


def unlit(frames: Sequence[Image]) -> bool:
    """Whether no broad light comes or goes in coarse frames (60, 80): no LED, or all."""
    darkest = reduce(cv2.min, frames)
    valid = _valid(darkest)
    if valid < SETTINGS.valid_least * darkest.size:
        return False
    gain, _ = _each_over(reduce(cv2.max, frames), darkest)
    return _broad(gain, SETTINGS.led_never * valid) <= SETTINGS.led_never * valid


def brighter(frame: Image, other: Image) -> bool:
    """Whether a coarse frame has broad light the other lacks, and not vice versa."""
    valid = max(_valid(cv2.min(frame, other)), SETTINGS.valid_least * frame.size)
    gain, loss = _each_over(frame, other)
    least = SETTINGS.led_least * valid
    return _broad(gain, least) > least and _broad(loss) <= SETTINGS.led_never * valid


def _valid(darker: _Cells) -> int:
    """Count the cells that are not saturated in the darker of two frames."""
    saturated = 250  # level of a cell
    return cv2.countNonZero(cv2.threshold(darker, saturated - 1, 255, cv2.THRESH_BINARY_INV)[1])


def _each_over(first: _Cells, second: _Cells) -> tuple[_Cells, _Cells]:
    """How far each frame is brighter than the other [levels], beyond noise and swing."""
    noise = cv2.LUT(cv2.min(first, second), _NOISE_OF_LEVEL)
    one, other = cv2.subtract(first, second), cv2.subtract(second, first)
    return cv2.subtract(one, noise), cv2.subtract(other, noise)


def _lit(over: _Cells) -> _Cells:
    return cv2.threshold(over, 0, 255, cv2.THRESH_BINARY)[1]


def _near(over: _Cells) -> _Cells:
    """What the LEDs light, and a line's height above and below."""
    return cv2.dilate(cv2.morphologyEx(_lit(over), cv2.MORPH_OPEN, _SMALL), _LINE_HIGH)


def _inside(over: _Cells) -> _Cells:
    """What lies within what the LEDs light, a line's height bridged."""
    return cv2.erode(cv2.morphologyEx(_lit(over), cv2.MORPH_CLOSE, _LINE_HIGH), _SMALL)


def _broad(over: _Cells, least: float = 0.0) -> int:
    """Count the cells that are broadly brighter; 0: no more than `least` are at all."""
    if cv2.countNonZero(over) <= least:
        return 0
    return cv2.countNonZero(cv2.morphologyEx(_lit(over), cv2.MORPH_OPEN, _SQUARE))


def _shared(over: _Cells, where: Callable[[], _Cells]) -> int:
    """Count the cells of thin lines there; `where` is called if there can be any."""
    if cv2.minMaxLoc(over)[1] <= SETTINGS.line:
        return 0
    return cv2.countNonZero(cv2.bitwise_and(_thin(over), where()))


def _thin(over: _Cells) -> _Cells:
    bright = cv2.threshold(over, SETTINGS.line, 255, cv2.THRESH_BINARY)[1]
    high = cv2.morphologyEx(bright, cv2.MORPH_OPEN, _COLUMN)
    return cv2.subtract(bright, high)


def _above_column(over: _Cells) -> _Cells:
    """How far cells are brighter than what is about as bright above or below them."""
    return cv2.morphologyEx(over, cv2.MORPH_TOPHAT, _COLUMN)


def _octaves(value: float, threshold: float) -> float:
    if value <= 0.0:
        return -inf
    return log2(value / threshold) if threshold > 0.0 else inf


CYCLE = 3  # periods


@dataclass(frozen=True, slots=True, eq=False)
class StrobeCycle:
    """Three consecutive frames of one strobe cycle, each of its kind by its content."""

    ambient: Frame
    laser: Frame
    led: Frame


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """A frame and its coarse image (60, 80), and how it lies in the stream."""

    frame: Frame
    cells: Image
    place: int  # periods in which the strobe went on
    follows: bool  # the frame before by one period
    latest: Frame  # the frame or its last copy


class Strobe:
    """Assembler of frames to strobe cycles.

    Attributes:
        counts: Event -> how often since the start.
            cycles: accepted.
            doubled: frames that are copies of the frame before, dropped.
            gaps: frames that do not follow the one before by one period.
            out_of_step: cycles of another phase than the one before, not accepted; cycles with the LEDs on in
                another frame than the last, or, after a strobe cycle, in none.
            unsure: other groups of three frames that are no strobe cycle.
            unlit: cycles more in which the LEDs light nothing: there is no hand.
        margin: Of the last strobe cycle, accepted or not [octaves]; NaN: none yet.
    """

    def __init__(self, frame_rate_hz: float) -> None:
        """Start with no frame; `frame_rate_hz`: single frames, three per strobe cycle."""
        self._period_ns = 1e9 / frame_rate_hz
        self._seen: list[_Seen] = []
        self._at: int | None = None
        self._due = 0
        self.counts = Counter(
            {"cycles": 0, "doubled": 0, "gaps": 0, "out_of_step": 0, "unsure": 0, "unlit": 0}
        )
        self.margin = np.nan

    def push(self, frame: Frame) -> StrobeCycle | None:
        """The strobe cycle that this frame completes, or None, by content alone."""
        cells = coarse(frame.image)
        last = self._seen[-1] if self._seen else None
        periods = 0.0 if last is None else (frame.t_ns - last.latest.t_ns) / self._period_ns
        # periods without a frame, after which a rate 0.3 % off could have moved the cycle by a frame
        forgotten = 90
        if last is None or abs(periods) > forgotten:
            self._begin(frame, cells)
            return None
        if last.cells.tobytes() == cells.tobytes() and np.array_equal(last.frame.image, frame.image):
            self.counts["doubled"] += 1
            self._seen[-1] = replace(last, latest=frame)  # the strobe did not go on meanwhile
            return None
        off_beat = 0.3  # periods; a frame farther from the beat of the camera has no place in the cycle
        follows = abs(periods - 1.0) <= off_beat and frame.seq == last.latest.seq + 1
        self.counts["gaps"] += not follows
        self._seen = [*self._seen[-2:], _Seen(frame, cells, last.place + round(periods), follows, frame)]
        return self._completed()

    def _begin(self, frame: Frame, cells: Image) -> None:
        """Reset the phase: the next strobe cycle is accepted, wherever it is."""
        self.counts["gaps"] += bool(self._seen)
        self._seen = [_Seen(frame, cells, 0, follows=False, latest=frame)]
        self._at = None
        self._due = CYCLE + 1  # of a stream in order, which begins anywhere, one is complete by then

    def _completed(self) -> StrobeCycle | None:
        """The last three frames, where they are one. No frame is in two."""
        place, before = self._seen[-1].place, self._at
        if before is not None and 0 < place - before < CYCLE:
            return None
        whole = len(self._seen) == CYCLE and self._seen[1].follows and self._seen[2].follows
        found = evidence(*[one.cells for one in self._seen]) if whole else Evidence()
        if not found.margin > 0.0:
            if place >= self._due:
                lit = place == self._due and found.led > 0.0
                event = "unsure" if lit else self._instead(whole=whole)
                if event is not None:
                    self.counts[event] += 1
                self._due = place + CYCLE - (place - self._due) % CYCLE
            return None
        in_step = before is None or (place - before) % CYCLE == 0
        self.margin, self._at, self._due = found.margin, place, place + CYCLE
        self.counts["cycles" if in_step else "out_of_step"] += 1
        return StrobeCycle(*(one.frame for one in self._seen)) if in_step else None

    def _instead(self, *, whole: bool) -> str | None:
        """Classify a cycle whose last frame is not lit by LEDs, by its frames received."""
        frames = [one for one in self._seen if self._due - CYCLE < one.place <= self._due]
        early = [one.cells for one in frames if one.place < self._due]
        last = [one.cells for one in frames if one.place == self._due]
        if last and early and unlit([*early, *last]):
            return "out_of_step" if self._at == self._due - CYCLE else "unlit"
        if self._at is not None and any(brighter(a, b) for a in early for b in last or early):
            return "out_of_step"
        return "unsure" if last and whole else None


def lit_line(frame: Image, ambient: Image) -> Image:
    """Return the image (H, W) of the laser's line, as `lit` does.

    White where the light that was added made the frame white: in the sun a line has less room up to white the
    brighter the skin is, and what is left of it does not measure the line.
    """
    out = lit(frame, ambient)
    # grey levels of a frame: as bright or brighter
    white = cv2.threshold(frame, 250 - 1, 255, cv2.THRESH_BINARY)[1]
    least = 16  # grey levels that were added: less is noise beside what is white anyway
    added = cv2.threshold(out, least, 255, cv2.THRESH_BINARY)[1]
    return np.asarray(cv2.max(out, cv2.bitwise_and(white, added)), np.uint8)


def lit(frame: Image, ambient: Image) -> Image:
    """Subtract the ambient frame; the difference saturates at 0 (Kim et al. 2012).

    The black level cancels. Where the ambient frame is saturated the light that was added cannot be measured,
    and the difference is 0 there by itself. Frames (H, W) uint8 of the same strobe cycle. Raises ValueError:
    the two are not of one size.
    """
    if frame.shape != ambient.shape:
        raise ValueError(f"frame of {frame.shape} and ambient frame of {ambient.shape} are not of one size")
    return np.asarray(cv2.subtract(frame, ambient), np.uint8)
