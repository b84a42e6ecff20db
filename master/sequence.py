"""Counts what becomes of one camera's frames on the way: received, lost, skipped, late, duplicate, reordered.

A frame is *lost* when it was sent and never came, *skipped* when nothing was sent under its number: numbers
alone cannot tell, so `Sequence` counts both as lost and `MasterLink.counts_of` parts them. It is *late* when it
came after a newer one, and is dropped then, because the newer one was used already. So received + lost + skipped
+ late is the number of frames between the first and the last. A restarted slave is a new sequence.

The camera of a wrist device sends one message for three frames, numbered by its laser frame. There all of this counts
triples: numbers three apart miss nothing, and one more or less, after a frame that slipped, neither.
"""

from dataclasses import dataclass, replace

REMEMBERED = 1024
TRIPLE = 3  # frames that become one message of a wrist device


@dataclass(frozen=True, slots=True)
class CameraCounts:
    """Counters of one camera since the master began.

    Attributes:
        received: Frames taken.
        lost: Frames sent and not come so far; in a `Sequence` all frame numbers not come so far.
        skipped: Frames that the camera or the slave had no time for: nothing was sent. 0 in a `Sequence`.
        late: Frames that came after a newer one, dropped.
        duplicate: Datagrams that came twice, dropped.
        reordered: Datagrams of any kind that came after a later one of their session.
    """

    received: int = 0
    lost: int = 0
    skipped: int = 0
    late: int = 0
    duplicate: int = 0
    reordered: int = 0


class Sequence:
    """Push machine over frame numbers. Holds the last one, and the newest skipped ones (<= 1024)."""

    def __init__(self, step: int = 1) -> None:
        """Begin with nothing received; `step` is how much the number rises from one message to the next."""
        self.counts = CameraCounts()
        self._step, self._slip = step, step // 2
        self._session: int | None = None
        self._last = -1
        self._missing: dict[int, None] = {}

    def take(self, session: int, seq: int) -> bool:
        """Count frame `seq` of the slave process `session`; whether it is to be used."""
        counts = self.counts
        if session != self._session:
            self._session = session
            self._missing.clear()
        elif seq <= self._last:
            near = range(seq - self._slip, seq + self._slip + 1)
            found = next((number for number in near if number in self._missing), None)
            if found is not None:
                del self._missing[found]
            self.counts = replace(counts, late=counts.late + 1, lost=counts.lost - (found is not None))
            return False
        else:
            skipped = range(self._last + self._step, seq - self._slip, self._step)
            counts = replace(counts, lost=counts.lost + len(skipped))
            self._missing.update(dict.fromkeys(skipped[-REMEMBERED:]))
            while len(self._missing) > REMEMBERED:
                del self._missing[next(iter(self._missing))]
        self._last = seq
        self.counts = replace(counts, received=counts.received + 1)
        return True

    def duplicate(self) -> None:
        """Count a datagram that came twice."""
        self.counts = replace(self.counts, duplicate=self.counts.duplicate + 1)

    def reordered(self) -> None:
        """Count a datagram that came after a later one."""
        self.counts = replace(self.counts, reordered=self.counts.reordered + 1)
