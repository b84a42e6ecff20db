"""Publishes every solved hand on the bus, for the viewer and for any program of the user."""

from common.bus import Bus
from common.messages import HandPose


class BusSink:
    """A `Sink` that publishes stream "hand" under the name of the hand. The bus belongs to the caller."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus

    def write(self, pose: HandPose) -> None:
        """Publish the pose; a slow or absent reader never delays the master.

        Raises:
            BusError: The bus is closed.
        """
        self._bus.publish("hand", pose.hand, pose)

    def close(self) -> None:
        """Nothing to finish: the bus is closed by whoever opened it."""
