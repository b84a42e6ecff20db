"""Output interface of the master for hands, objects, contact and gestures.

Behind it are a file, the bus, and any later output.
"""

from typing import Protocol

from common.messages import ResultMessage


class Sink(Protocol):
    """Output that takes the results of the master.

    Those of each hand and object come in the order of their time. Opened by its constructor.
    """

    def write(self, message: ResultMessage) -> None:
        """Take one message. What a sink is not for, it leaves alone.

        Raises:
            PhalanxError: The sink cannot take it (disk full, bus gone); the text names sink and fix.
        """
        ...

    def close(self) -> None:
        """Finish writing.

        What was written is complete and readable from here on. Safe to call twice.

        Raises:
            PhalanxError: The result could not be completed; nothing half written is left.
        """
        ...
