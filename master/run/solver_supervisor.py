"""Guard the solver: a message that makes it raise does not end the master.

It costs its sender a pause.

A message that gets past all bounds and still makes something raise is a fault of this program. Then

- the sender of the message is silenced for a while (`master.run.quarantine`), and the master goes on with
the next message;
- the solvers that it feeds are replaced by new ones, for their state may be broken;
- the last messages are solved again, on a thread beside, without those of each sender in turn: the sender without whom
  nothing raises is to blame, and is silenced instead. So a camera is not punished for being the one whose frame
  completed what another one broke.

While that goes on, further faults are counted and nobody else is silenced.
"""

import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Protocol

from common.clock import Clock
from common.messages.streams import sender_of
from master.run.app import Solved
from master.run.link_senders import SensorMessage
from master.run.quarantine import Quarantine


class Solving(Protocol):
    """What messages are pushed into."""

    def push(self, message: SensorMessage, /) -> Iterator[Solved]:
        """Take one message; give what it completes."""
        ...


class Replayed(Solving, Protocol):
    """A fresh solver, to solve messages again."""

    def flush(self) -> Iterator[Solved]:
        """Give what still waits for something."""
        ...


class SolverSupervisor:
    """Push machine before a solver.

    Holds the last messages, and the thread that replaces what is broken.
    """

    def __init__(
        self,
        solver: Solving,
        quarantine: Quarantine,
        clock: Clock,
        renew: Callable[[str], None],
        fresh: Callable[[str], Replayed],
    ) -> None:
        """Guard `solver`.

        Args:
            solver: What messages are pushed into.
            quarantine: Who is silenced.
            clock: The master's.
            renew: Lets new solvers take over from those that a sender feeds; may take its time.
            fresh: Builds a solver of what a sender feeds, in its first state.
        """
        self._solver, self._quarantine, self._clock = solver, quarantine, clock
        self._renew, self._fresh = renew, fresh
        recent = 64  # messages that are solved again: about ten frames of each camera of a usual rig
        self._recent: deque[SensorMessage] = deque(maxlen=recent)
        self._repair: threading.Thread | None = None

    def push(self, message: SensorMessage) -> Iterator[Solved]:
        """Take one message; give what it completes.

        That is nothing where its sender is silenced or it cannot be used.
        """
        sender = sender_of(message)
        if self._quarantine.holds(sender, self._clock.now_ns()):
            return
        self._recent.append(message)
        try:
            yield from self._solver.push(message)
        except Exception as error:  # noqa: BLE001
            # Anything at all: the tracking of all others depends on it that none gets through.
            self._failed(sender, error)

    def _failed(self, sender: str, error: Exception) -> None:
        if self._repair is not None and self._repair.is_alive():
            self._quarantine.note(sender, error)
            return
        self._quarantine.fault(sender, error, self._clock.now_ns())
        messages = list(self._recent)
        self._recent.clear()
        self._repair = threading.Thread(
            target=self._mend, args=(messages, sender, error), name="solver repair", daemon=True
        )
        self._repair.start()

    def _mend(self, messages: Sequence[SensorMessage], sender: str, error: Exception) -> None:
        try:
            self._renew(sender)
            found = culprit(messages, lambda: self._fresh(sender))
        except Exception as second:  # noqa: BLE001
            self._quarantine.note(sender, second)  # and the next fault tries again
            return
        if found not in (None, sender):
            self._quarantine.release(sender)
            self._quarantine.fault(found, error, self._clock.now_ns())


def culprit(messages: Sequence[SensorMessage], fresh: Callable[[], Replayed]) -> str | None:
    """The sender without whose messages nothing raises.

    None: there is no such one, or more than one.
    """
    senders = dict.fromkeys(sender_of(message) for message in messages)
    if len(senders) < 2 or not _raises(messages, fresh()):
        return None
    found = [
        sender
        for sender in senders
        if not _raises([one for one in messages if sender_of(one) != sender], fresh())
    ]
    return found[0] if len(found) == 1 else None


def _raises(messages: Sequence[SensorMessage], solver: Replayed) -> bool:
    try:
        for message in messages:
            for _ in solver.push(message):
                pass
        for _ in solver.flush():
            pass
    except Exception:  # noqa: BLE001
        return True  # whatever it is: it is looked for who causes it
    return False
