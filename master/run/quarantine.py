"""Silence senders for a while whose messages made the solver fail.

Each failure is counted, and logged once with its cause.

Bounds keep out what cannot be (`common.messages`, `master.run.admission`). What passes them and still makes
something raise
is a fault of this program; it costs the sender a pause, and the others nothing. The pause doubles with each fault from
`FIRST_NS` to `LONGEST_NS`, and begins anew after a sender was well for `LONGEST_NS`.
"""

import logging
import traceback
from collections import Counter
from dataclasses import dataclass

FIRST_NS = 1_000_000_000
LONGEST_NS = 60_000_000_000
MAX_CAUSES = 256  # that are remembered: later ones are counted, not logged
_LOG = logging.getLogger(__name__)


@dataclass(slots=True)
class _Silence:
    until_ns: int
    length_ns: int


class Quarantine:
    """Push machine over faults.

    Holds how often each sender's message failed, and until when it is silenced.

    `fault` and `holds` may be called on several threads.
    """

    def __init__(self) -> None:
        """Nobody is silenced."""
        self._silences: dict[str, _Silence] = {}
        self._causes: set[tuple[str, str]] = set()
        self.faults: Counter[str] = Counter()

    def fault(self, sender: str, error: Exception, t_ns: int) -> None:
        """A message of `sender` made something raise `error` at `t_ns` [ns]."""
        before = self._silences.get(sender)
        again = before is not None and t_ns < before.until_ns + LONGEST_NS
        length_ns = min(2 * before.length_ns, LONGEST_NS) if before is not None and again else FIRST_NS
        self._silences[sender] = _Silence(t_ns + length_ns, length_ns)
        self.note(sender, error)

    def note(self, sender: str, error: Exception) -> None:
        """Count a fault, and log it if its cause is news; nobody is silenced."""
        self.faults[sender] += 1
        cause = sender, _place(error)
        if cause not in self._causes and len(self._causes) < MAX_CAUSES:
            self._causes.add(cause)
            _LOG.error("a message of %s could not be used: %r", sender, error, exc_info=error)

    def release(self, sender: str) -> None:
        """It was another one: forget that `sender` was silenced."""
        self._silences.pop(sender, None)

    def holds(self, sender: str, t_ns: int) -> bool:
        """Whether `sender` is silenced at `t_ns` [ns]."""
        silence = self._silences.get(sender)
        return silence is not None and t_ns < silence.until_ns


def _place(error: Exception) -> str:
    """Kind and place of an error, by which a fault is known.

    The same fault again is not news, whatever numbers its text has.
    """
    frames = traceback.extract_tb(error.__traceback__)
    return (
        f"{type(error).__name__} {frames[-1].filename}:{frames[-1].lineno}" if frames else repr(type(error))
    )
