"""Which frame is which: ambient, laser or LED, told from what the frames show, and joined to triples (row D2).

Each frame gets its kind from what was switched since the frame before (`kinds`). Three frames make a triple when

    1. each followed the one before by one period, by time and by counter,
    2. their kinds, one by one, are ambient, laser, LED,
    3. the three together show it with a margin above 0 (`kinds.evidence`),
    4. they lie in the cycle as the triples before did, or the frames before them were in order for long enough.

The last rule is for pictures that were exchanged while their times were not: after two such swaps A1 L1 E0 may follow
one another, of the right kinds and of two poses, but not where the cycle has them. A cycle that was shifted (a frame
lost or added that no time tells of) is believed anew after `IN_ORDER` frames. No kind is ever told by counting.

A frame that is a copy of the one before, pixel by pixel, is left out. Where nothing is lit, nothing is told.
"""

from collections import Counter
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from common.arrays import Image
from common.frame_recording import Illumination
from slave.cameras.source import Frame
from slave.wrist.kinds import ORDER, Change, change, coarse, evidence, kinds

IN_ORDER = 4  # frames in order, one after another, that make a cycle believed: the triple's two last and two before it
OFF_BEAT = 0.3  # periods; a frame farther from the beat of the camera has no place in the cycle
FORGOTTEN = 90  # periods without a frame, after which a rate 0.3 % off could have moved the cycle by a frame
DARK_AFTER = 3  # frames in which nothing is lit: a whole cycle
EVENTS = ("triples", "doubled", "gaps", "out_of_step", "unsure", "unconfirmed", "dark")


class StrobeState(StrEnum):
    """What is known of the stream now: `DARK`, nothing is lit, so that nothing can be told (there is no hand)."""

    SEARCHING = "searching"
    IN_STEP = "in_step"
    DARK = "dark"


@dataclass(frozen=True, slots=True, eq=False)
class Triple:
    """Three consecutive frames of one strobe cycle, each of its kind by its content."""

    ambient: Frame
    laser: Frame
    led: Frame


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """A frame, its coarse image, what changed since the frame before, its kind and its place in the stream.

    `kind` is None where it could not be told. `place` counts periods; its remainder by three is the phase in the cycle.
    `follows`: the frame before by one period. `latest`: the frame or its last copy.
    """

    frame: Frame
    cells: Image
    since: Change | None
    kind: Illumination | None
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
            out_of_step: frames whose kind is known and not what follows the kind before.
            unsure: frames whose kind could not be told, and triples whose margin is not above 0.
            unconfirmed: triples in order, but elsewhere in the cycle than before, not yet believed.
            dark: frames in which, as in those of a cycle before, nothing is lit.
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
        self._phase: int | None = None
        self._same = 0
        self.counts: Counter[str] = Counter(dict.fromkeys(EVENTS, 0))
        self.state = StrobeState.SEARCHING
        self.margin = np.nan

    def push(self, frame: Frame) -> Triple | None:
        """The triple that this frame completes, or None. Never looks at `frame.illumination`."""
        cells = coarse(frame.image)
        if not self._seen:
            self._begin(frame, cells)
            return None
        if _copied(self._seen[-1], frame, cells):
            self.counts["doubled"] += 1
            self._leave_out(frame)
            return None
        self._take(frame, cells)
        if len(self._seen) < 3 or tuple(seen.kind for seen in self._seen) != ORDER:
            return None
        ambient, laser, led = self._seen
        return self._judge(ambient, laser, led) if laser.follows and led.follows else None

    def _begin(self, frame: Frame, cells: Image) -> None:
        """Forget how the cycle lies: the next triple is believed unless something is out of order before it."""
        self._seen = [_Seen(frame, cells, None, None, 0, follows=False, latest=frame)]
        self._in_order = IN_ORDER
        self._phase = None
        self._same = 0

    def _take(self, frame: Frame, cells: Image) -> None:
        """Find the kind of a frame and how it fits behind the last one."""
        last = self._seen[-1]
        step, on_beat = self._step(last.latest, frame)
        if abs(step) > FORGOTTEN:
            self.counts["gaps"] += 1
            self._begin(frame, cells)
            return
        follows = on_beat and step == 1 and frame.seq == last.latest.seq + 1
        since = change(last.cells, cells)
        before, kind = kinds(since)
        nothing = kind is Illumination.NONE
        self._same = self._same + 1 if nothing else 0
        if nothing:
            kind = last.kind if self._same < DARK_AFTER else None
        elif before is not None and (last.kind is None or not last.follows):
            last = self._seen[-1] = replace(last, kind=before)
        elif before is not None and before is not last.kind:
            kind = None
        seen = _Seen(frame, cells, since, kind, last.place + step, follows, frame)
        self._count(last, seen, in_time=on_beat and step > 0)
        self._seen = [*self._seen[-2:], seen]

    def _count(self, last: _Seen, seen: _Seen, *, in_time: bool) -> None:
        """Whether the cycle goes on."""
        self.counts["gaps"] += not seen.follows
        if self._same >= DARK_AFTER:
            self.counts["dark"] += 1
            self.state = StrobeState.DARK
        elif seen.kind is None:
            self.counts["unsure"] += 1
        elif last.kind is None:
            return
        elif in_time and (_turn(seen.kind) - _turn(last.kind) - seen.place + last.place) % 3 == 0:
            self._in_order += 1
            return
        else:
            self.counts["out_of_step"] += 1
        self._in_order = 0
        if self.state is StrobeState.IN_STEP:
            self.state = StrobeState.SEARCHING

    def _step(self, last: Frame, frame: Frame) -> tuple[int, bool]:
        """How many periods later a frame is, and whether it is on the beat."""
        periods = (frame.t_ns - last.t_ns) / self._period_ns
        return round(periods), abs(periods - round(periods)) <= OFF_BEAT

    def _leave_out(self, copy: Frame) -> None:
        """What comes next follows the copy."""
        last = self._seen[-1]
        step, _ = self._step(last.latest, copy)
        self._seen[-1] = replace(last, place=last.place + step, latest=copy)

    def _judge(self, ambient: _Seen, laser: _Seen, led: _Seen) -> Triple | None:
        """A triple of three frames in order, where they are sure enough."""
        assert laser.since is not None
        self.margin = evidence(laser.since, change(ambient.cells, led.cells)).margin
        if not self.margin > 0.0:
            self.counts["unsure"] += 1
            return None
        phase = ambient.place % 3
        if self._in_order >= IN_ORDER:
            self._phase = phase
        elif phase != self._phase:
            self.counts["unconfirmed"] += 1
            return None
        self.counts["triples"] += 1
        self.state = StrobeState.IN_STEP
        return Triple(ambient.frame, laser.frame, led.frame)


def _copied(last: _Seen, frame: Frame, cells: Image) -> bool:
    return np.array_equal(last.cells, cells) and np.array_equal(last.frame.image, frame.image)


def _turn(kind: Illumination) -> int:
    return ORDER.index(kind)
