"""The seam through which a solved hand leaves the master: a file, the bus, whatever comes next."""

from typing import Protocol

from common.messages import HandPose


class Sink(Protocol):
    """Takes every pose in the order of its time. Opened by its constructor."""

    def write(self, pose: HandPose) -> None:
        """Take one pose.

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
