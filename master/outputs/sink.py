"""The seam through which hands, objects, contact and gestures leave the master: a file, the bus, what comes next."""

from typing import Protocol

from common.messages import ResultMessage


class Sink(Protocol):
    """Takes what the master tells, of each hand and object in the order of its time. Opened by its constructor."""

    def write(self, message: ResultMessage) -> None:
        """Take one message. What a sink is not for, it leaves alone.

        Raises:
            PhalanxError: The sink cannot take it (disk full, bus gone); the text names sink and fix.
        """
        ...

    def close(self) -> None:
        """Finish: what was written is complete and readable from here on. Safe to call twice.

        Raises:
            PhalanxError: The result could not be completed; nothing half written is left.
        """
        ...
