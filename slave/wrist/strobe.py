"""Which frame is which: ambient, laser or LED, told from what the frames show, and joined to triples (row D2)."""

from collections import Counter
from dataclasses import dataclass
from enum import StrEnum

from slave.cameras.source import Frame


class StrobeState(StrEnum):
    """What is known of the stream: `DARK`, nothing is lit, so that nothing can be told (there is no hand)."""

    SEARCHING = "searching"
    IN_STEP = "in_step"
    DARK = "dark"


@dataclass(frozen=True, slots=True, eq=False)
class Triple:
    """Three consecutive frames of one strobe cycle, each of its kind by its content."""

    ambient: Frame
    laser: Frame
    led: Frame


class Strobe:
    """Joins frames to triples. Holds the last frames and how the cycle of the strobe lies in time.

    Attributes:
        counts: Event -> how often since the start.
        state: What is known of the stream now.
    """

    def __init__(self, frame_rate_hz: float) -> None:
        """Start out of step.

        Args:
            frame_rate_hz: Of the camera file: single frames per second, three per triple.
        """
        self._period_ns = 1e9 / frame_rate_hz
        self.counts: Counter[str] = Counter()
        self.state = StrobeState.SEARCHING

    def push(self, frame: Frame) -> Triple | None:
        """The triple that this frame completes, or None. Never looks at `frame.illumination`."""
        raise NotImplementedError
