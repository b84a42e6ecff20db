"""What a master makes of all that its senders say, behind one push: hands, objects, contact and gestures.

In this order, because the hand is what is waited for: first the poses that a message completes, of every hand, then
those of objects, then what the hands do. `push` is a generator: what it gave is out before the next is worked out.
"""

from collections import Counter
from collections.abc import Iterator, Sequence

from common.messages import ImuSample, MarkerDetections, WristDetections
from master.app import Solved
from master.hands import Hands, Line
from master.link import Taken
from master.rig import RigSetup


class World:
    """Push machine over all that comes. Holds the hands."""

    def __init__(self, setups: Sequence[RigSetup], lines: Sequence[Line]) -> None:
        """Join each hand's setup with the line that solves it."""
        self._hands = Hands(setups, lines)

    @property
    def counts(self) -> Counter[str]:
        """Events since the start; those of a hand, where there are several, under its name."""
        return self._hands.counts

    def push(self, message: Taken) -> Iterator[Solved]:
        """Take one message; give what it completes, of each hand and object oldest first."""
        if isinstance(message, ImuSample):
            self._hands.push_sample(message)
        elif isinstance(message, MarkerDetections | WristDetections):
            yield from self._hands.push(message)

    def flush(self) -> Iterator[Solved]:
        """At the end of a recording: what still waits for something."""
        yield from self._hands.flush()
