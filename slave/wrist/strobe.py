"""Recognition of ambient, laser and LED frames by content.

The frames are joined to strobe cycles.

The strobe is that of Kim et al. 2012.

Three frames are a strobe cycle if

    1. each followed the one before by one period, by time and by counter,
    2. they show ambient, laser, LED with a margin above 0 (`illumination.evidence`),
    3. the strobe cycle before them, accepted or not, had the same phase, three periods earlier.

Each three frames are classified by themselves, so that ambient light which is switched costs the cycle that it is
switched in, and no other. The last rule is for pictures that were exchanged while their times were not: after two such
swaps A1 L1 E0 may follow one another, of the right kinds and of two poses, but not where the cycle has them. A cycle
that has slipped (a frame lost or added, unseen in the times) is known anew with its second cycle. Counting thus only
ever rejects cycles. A frame that is a copy of the one before, pixel by pixel, is dropped.
"""

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np

from common.arrays import Image
from slave.sources import Frame
from slave.wrist.illumination import NO_EVIDENCE, brighter, coarse, evidence, unlit

CYCLE = 3  # periods
EVENTS = ("cycles", "doubled", "gaps", "out_of_step", "unsure", "unlit")


@dataclass(frozen=True, slots=True, eq=False)
class StrobeCycle:
    """Three consecutive frames of one strobe cycle, each of its kind by its content."""

    ambient: Frame
    laser: Frame
    led: Frame


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """A frame and its coarse image (60, 80), and how it lies in the stream.

    `place` counts periods in which the strobe went on. `follows`: the frame before by one period. `latest`: the frame
    or its last copy.
    """

    frame: Frame
    cells: Image
    place: int
    follows: bool
    latest: Frame


class Strobe:
    """Assembler of frames to strobe cycles.

    Holds the last three frames, and where the last strobe cycle and the present cycle end.

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
        """Start with no frame and no cycle.

        Args:
            frame_rate_hz: Of the camera file: single frames per second, three per strobe cycle.
        """
        self._period_ns = 1e9 / frame_rate_hz
        self._seen: list[_Seen] = []
        self._at: int | None = None
        self._due = 0
        self.counts: Counter[str] = Counter(dict.fromkeys(EVENTS, 0))
        self.margin = np.nan

    def push(self, frame: Frame) -> StrobeCycle | None:
        """Return the strobe cycle that this frame completes, or None.

        Never looks at `frame.illumination`.
        """
        cells = coarse(frame.image)
        last = self._seen[-1] if self._seen else None
        periods = 0.0 if last is None else (frame.t_ns - last.latest.t_ns) / self._period_ns
        # periods without a frame, after which a rate 0.3 % off could have moved the cycle by a frame
        forgotten = 90
        if last is None or abs(periods) > forgotten:
            self._begin(frame, cells)
            return None
        if _copied(last, frame, cells):
            self.counts["doubled"] += 1
            self._seen[-1] = replace(last, latest=frame)  # the strobe did not go on meanwhile
            return None
        off_beat = 0.3  # periods; a frame farther from the beat of the camera has no place in the cycle
        follows = abs(periods - 1.0) <= off_beat and frame.seq == last.latest.seq + 1
        self.counts["gaps"] += not follows
        self._seen = [*self._seen[-2:], _Seen(frame, cells, last.place + round(periods), follows, frame)]
        return self._completed()

    def _begin(self, frame: Frame, cells: Image) -> None:
        """Reset the cycle position.

        The next strobe cycle is accepted, wherever it is.
        """
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
        found = evidence(*[one.cells for one in self._seen]) if whole else NO_EVIDENCE
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
        """Classify a cycle whose last frame is not lit by LEDs.

        By those of its frames that were received.
        """
        frames = [one for one in self._seen if self._due - CYCLE < one.place <= self._due]
        early = [one.cells for one in frames if one.place < self._due]
        last = [one.cells for one in frames if one.place == self._due]
        if last and early and unlit([*early, *last]):
            return "out_of_step" if self._at == self._due - CYCLE else "unlit"
        if self._at is not None and any(brighter(a, b) for a in early for b in last or early):
            return "out_of_step"
        return "unsure" if last and whole else None


def _copied(last: _Seen, frame: Frame, cells: Image) -> bool:
    return last.cells.tobytes() == cells.tobytes() and np.array_equal(last.frame.image, frame.image)
