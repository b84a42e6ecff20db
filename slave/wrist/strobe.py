"""Which frame is which: ambient, laser or LED, told from what the frames show, and joined to triples (row D2).

The LEDs are seen to go on and off from frame to frame (`kinds.led_change`). Where they have come on, the last three
frames make a triple if

    1. each followed the one before by one period, by time and by counter, and only in the last one the LEDs were on,
    2. the three together show ambient, laser, LED with a margin above 0 (`kinds.evidence`),
    3. the LEDs had come on where the strobe's order has them for longer than this triple, or did so in the cycle of the
       triples before: `IN_ORDER`.

The last rule is for pictures that were exchanged while their times were not: after two such swaps A1 L1 E0 may follow
one another, of the right kinds and of two poses, but not where the cycle has them. A cycle that was shifted (a frame
lost or added that no time tells of) is believed anew with its second LED frame. Counting thus only ever takes triples
away. A frame that is a copy of the one before, pixel by pixel, is left out.
"""

from collections import Counter
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from common.arrays import Image
from slave.cameras.source import Frame
from slave.wrist.kinds import Led, coarse, evidence, led_change

IN_ORDER = 4  # frames as expected, one after another, that reach back to the LED frame before this triple's
OFF_BEAT = 0.3  # periods; a frame farther from the beat of the camera has no place in the cycle
FORGOTTEN = 90  # periods without a frame, after which a rate 0.3 % off could have moved the cycle by a frame
UNLIT_AFTER = 3  # changes in which the LEDs went neither on nor off: a whole cycle
EVENTS = ("triples", "doubled", "gaps", "out_of_step", "unsure", "unconfirmed", "unlit")


class StrobeState(StrEnum):
    """What is known of the stream now.

    `UNLIT`: nothing that the strobe lights is seen: there is no hand, or light that drowns the LEDs.
    """

    SEARCHING = "searching"
    IN_STEP = "in_step"
    UNLIT = "unlit"


@dataclass(frozen=True, slots=True, eq=False)
class Triple:
    """Three consecutive frames of one strobe cycle, each of its kind by its content."""

    ambient: Frame
    laser: Frame
    led: Frame


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """A frame and its coarse image (60, 80), and how it lies in the stream.

    `led`: whether the LEDs were on; None: could not be told. `place` counts periods. `follows`: the frame before by
    one period. `latest`: the frame or its last copy.
    """

    frame: Frame
    cells: Image
    led: bool | None
    place: int
    follows: bool
    latest: Frame


class Strobe:
    """Joins frames to triples. Holds the last three frames and how the cycle lies in time.

    Attributes:
        counts: Event -> how often since the start.
            triples: given.
            doubled: frames that are copies of the frame before, left out.
            gaps: frames that do not follow the one before by one period.
            out_of_step: frames in which the LEDs are on or off and, by the LED frame before, should not be.
            unsure: frames of which not even that can be told; three frames whose margin is not above 0.
            unconfirmed: triples elsewhere in the cycle than those before, not yet believed.
            unlit: frames of a cycle or more in which the LEDs went neither on nor off.
        state: What is known of the stream now.
        margin: Of the last three frames that were judged as a triple, given or not [octaves]; NaN: none yet.
    """

    def __init__(self, frame_rate_hz: float) -> None:
        """Start out of step.

        Args:
            frame_rate_hz: Of the camera file: single frames per second, three per triple.
        """
        self._period_ns = 1e9 / frame_rate_hz
        self._seen: list[_Seen] = []
        self._in_order = IN_ORDER
        self._led_place: int | None = None
        self._phase: int | None = None
        self._same = 0
        self.counts: Counter[str] = Counter(dict.fromkeys(EVENTS, 0))
        self.state = StrobeState.SEARCHING
        self.margin = np.nan

    def push(self, frame: Frame) -> Triple | None:
        """The triple that this frame completes, or None. Never looks at `frame.illumination`."""
        cells = coarse(frame.image)
        last = self._seen[-1] if self._seen else None
        if last is None or abs(self._step(last.latest, frame)[0]) > FORGOTTEN:
            self._begin(frame, cells)
            return None
        step, on_beat = self._step(last.latest, frame)
        if _copied(last, frame, cells):
            self.counts["doubled"] += 1
            self._seen[-1] = replace(last, place=last.place + step, latest=frame)
            if self._led_place is not None:
                self._led_place += step  # the strobe did not go on meanwhile
            return None
        follows = on_beat and step == 1 and frame.seq == last.latest.seq + 1
        became = led_change(last.cells, cells)
        self._same = self._same + 1 if became is Led.SAME and follows else 0
        seen = _Seen(frame, cells, self._led(became, last), last.place + step, follows, frame)
        self._count(seen, became, in_time=on_beat and step > 0)
        self._seen = [*self._seen[-2:], seen]
        return self._triple() if seen.led and follows else None

    def _begin(self, frame: Frame, cells: Image) -> None:
        """Know of no cycle: the next triple is believed unless something is out of order before it."""
        self.counts["gaps"] += bool(self._seen)
        self._seen = [_Seen(frame, cells, None, 0, follows=False, latest=frame)]
        self._in_order = IN_ORDER
        self._led_place = None
        self._phase = None
        self._same = 0

    def _step(self, last: Frame, frame: Frame) -> tuple[int, bool]:
        """How many periods later a frame is, and whether it is on the beat."""
        periods = (frame.t_ns - last.t_ns) / self._period_ns
        return round(periods), abs(periods - round(periods)) <= OFF_BEAT

    def _led(self, became: Led, last: _Seen) -> bool | None:
        """Whether the LEDs are on, by what became of them since the last frame."""
        if became is Led.SAME:
            return last.led if self._same < UNLIT_AFTER else None
        return None if became is Led.UNSURE else became is Led.ON

    def _count(self, seen: _Seen, became: Led, *, in_time: bool) -> None:
        """Whether the cycle goes on."""
        self.counts["gaps"] += not seen.follows
        known = self._led_place
        if seen.led:
            self._led_place = seen.place
        if self._same >= UNLIT_AFTER:
            self.counts["unlit"] += 1
            self.state = StrobeState.UNLIT
        elif became is Led.UNSURE:
            self.counts["unsure"] += 1
        elif seen.led is None:
            return  # not known since the frame before; that one was counted, or is the first
        elif in_time and (known is None or seen.led == ((seen.place - known) % 3 == 0)):
            self._in_order += 1
            return
        else:
            self.counts["out_of_step"] += 1
        self._in_order = 0
        if self.state is StrobeState.IN_STEP:
            self.state = StrobeState.SEARCHING

    def _triple(self) -> Triple | None:
        """The last three frames, where they are one."""
        if len(self._seen) < 3:
            return None
        ambient, laser, led = self._seen
        if not laser.follows or ambient.led or laser.led:
            return None
        self.margin = evidence(ambient.cells, laser.cells, led.cells).margin
        if not self.margin > 0.0:
            self.counts["unsure"] += 1
            return None
        phase = led.place % 3
        if self._in_order >= IN_ORDER:
            self._phase = phase
        elif phase != self._phase or self._in_order < 3:
            self.counts["unconfirmed"] += 1
            return None
        self.counts["triples"] += 1
        self.state = StrobeState.IN_STEP
        return Triple(ambient.frame, laser.frame, led.frame)


def _copied(last: _Seen, frame: Frame, cells: Image) -> bool:
    return last.cells.tobytes() == cells.tobytes() and np.array_equal(last.frame.image, frame.image)
