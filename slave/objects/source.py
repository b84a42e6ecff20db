"""The seam between the slave and any device that tracks itself: nothing behind it can tell which system it is of."""

from typing import Protocol

from common.messages import TrackerPose


class TrackerSource(Protocol):
    """A device that tracks itself. Opened by its constructor."""

    def read(self) -> TrackerPose | None:
        """Block until the next pose, or return None at the end of the stream.

        `t_ns` is on the slave's clock and rises, `seq` counts poses. While the device does not know where it is, or is
        switched off, poses of NaN come, a few in a second. `session` is 0: whoever sends it fills that in.

        Raises:
            TrackerError: The tracking system is gone. Never replaced by a fake one.
            TrackerChoiceError: Several devices are there, and nobody said which one is meant.
        """
        ...

    def close(self) -> None:
        """Give the system back. Safe to call twice."""
        ...
