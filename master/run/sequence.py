"""Frame counts of one camera, by frame numbers and counters of datagrams.

A frame is *lost* when it was sent and never came, *skipped* when nothing was sent under its number: numbers
alone cannot distinguish, so `Sequence` counts both as lost and `Losses` parts them by counters of the
datagrams. It is *late* when it came after a newer one, and is dropped then, because the newer one was used
already. So received + lost + skipped + late is the number of frames between the first and the last. A
restarted slave is a new sequence.

The camera of a wrist device sends one message for three frames, numbered by its laser frame. There all of
this counts strobe cycles: numbers three apart miss nothing, and one more or less, after a slipped frame,
neither. Tags are looked for in some frames only: their numbers rise as they like, and nothing is missing
between two.
"""

from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass

REMEMBERED = 1024
SEQ_JUMP, SEQ_PER_S = 100_000, 10_000.0  # numbers rise by no more: at once, and with time besides
CYCLE_FRAMES = 3  # frames that become one message of a wrist device


@dataclass(slots=True)
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
    """Push machine that counts frame numbers; holds the newest 1024 missing ones.

    Attributes:
        counts: What was counted so far.
        last: The newest number; -1: none came.
    """

    def __init__(self, step: int | None = 1) -> None:
        """Start with nothing received.

        `step` is how much the number rises from one message to the next; None: as it likes, and nothing is
        ever missing.
        """
        self.counts = CameraCounts()
        self._regular, self._step = step is not None, step or 1
        self._slip = self._step // 2
        self._session: int | None = None
        self.last = -1
        self._missing: OrderedDict[int, None] = OrderedDict()

    def follows(self, session: int) -> bool:
        """Whether the last message was of the same slave process."""
        return session == self._session

    def restart(self) -> None:
        """The next number follows none: nothing between is missing."""
        self._session = None

    def take(self, session: int, seq: int) -> bool:
        """Count frame `seq` of the slave process `session`; whether it is to be used."""
        if session != self._session:
            self._session = session
            self._missing.clear()
        elif seq <= self.last:
            near = range(seq - self._slip, seq + self._slip + 1)
            found = next((number for number in near if number in self._missing), None)
            if found is not None:
                del self._missing[found]
                self.counts.lost -= 1
            self.counts.late += 1
            return False
        elif self._regular and seq != self.last + self._step:
            skipped = range(self.last + self._step, seq - self._slip, self._step)
            self.counts.lost += len(skipped)
            self._missing.update(OrderedDict.fromkeys(skipped[-REMEMBERED:]))
            while len(self._missing) > REMEMBERED:
                self._missing.popitem(last=False)
        self.last = seq
        self.counts.received += 1
        return True


@dataclass(slots=True)
class _Gap:
    """Gap of datagrams that did not come between `after` and `before`."""

    after: int
    before: int
    numbers: int
    datagrams: int

    @property
    def lost(self) -> int:
        """As many messages were lost as datagrams can have carried them."""
        return min(self.numbers, self.datagrams)


class Losses:
    """Count of messages lost on the way, separate from those never sent.

    A message that was lost left a hole in the counters of its session between the messages around it. So a
    lost tag or echo is no lost frame, unless a frame was never sent in the same gap. Holds the newest gaps of
    the session (<= 1024), since what is late fills them, and the sum.
    """

    def __init__(self) -> None:
        self.lost = 0
        self._gaps: deque[_Gap] = deque(maxlen=REMEMBERED)

    def gap(self, after: int, before: int, numbers: int, datagrams: int) -> None:
        """Record how many numbers and datagrams are missing between `after` and `before`."""
        self._gaps.append(new := _Gap(after, before, numbers, datagrams))
        self.lost += new.lost

    def late(self, counter: int, numbers: int) -> None:
        """Record a datagram that came late: `numbers` (1 or 0) of those that were missed."""
        for gap in reversed(self._gaps):
            if gap.after < counter < gap.before:
                was = gap.lost
                gap.datagrams -= 1
                gap.numbers -= numbers
                self.lost += gap.lost - was
                return

    def begin_session(self) -> None:
        """Counters begin again: what was missing before stays so."""
        self._gaps.clear()


class Counted:
    """One kind of message of a sender: its `sequence`, and its `losses`.

    Attributes:
        newest_ns: Time of the newest message that is used in this session of the link [ns], master's clock.
    """

    def __init__(self, sequence: Sequence) -> None:
        self.sequence, self.losses = sequence, Losses()
        self.newest_ns: int | None = None
        self._counter = 0
        self._came_ns = 0
        self._rise = float(SEQ_JUMP)
        self._begins = True  # no message of this session of the link came yet

    def plausible(self, session: int, seq: int, t_ns: int) -> bool:
        """Whether a sender can have got to message `seq` when it came at `t_ns` [ns].

        The first of a session may have any number: while this machine slept its clock stood still, and the
        sender went on. Nothing is counted as missing then.
        """
        begins, self._begins = self._begins, False
        most = min(self._rise, SEQ_JUMP) + SEQ_PER_S * (t_ns - self._came_ns) * 1e-9
        rise = max(seq - self.sequence.last, 0) if self.sequence.follows(session) else 0
        if rise > most:
            if not begins:
                return False
            self.sequence.restart()
            rise = 0
        self._came_ns, self._rise = t_ns, most - rise
        return True

    def take(self, session: int, seq: int, counter: int, missing: Callable[[int, int], int]) -> bool:
        """Count message `seq` of `session` from datagram `counter`; whether to use it.

        `missing`: how many datagrams between two that came did not (`Opener.missing_between`).
        """
        before = self.sequence.counts.lost
        used = self.sequence.take(session, seq)
        missed = self.sequence.counts.lost - before
        if not used:
            self.losses.late(counter, -missed)
            return False
        if missed:
            self.losses.gap(self._counter, counter, missed, missing(self._counter, counter))
        self._counter = counter
        return True

    def begin_session(self) -> None:
        """The counters of the datagrams begin again."""
        self.losses.begin_session()
        self._counter = 0
        self._begins = True
        self.newest_ns = None
