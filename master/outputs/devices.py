"""Publisher of tracker poses on the master's clock.

For registering a tracker: `phalanx calibrate tracker --live`.

A tracker's poses come as datagrams, to the master alone, and mean nothing in the rig until it is registered. So that
the registration can see them beside the objects' poses without being a master itself, they go on the bus as they came.
"""

from typing import Generic, Protocol, TypeVar

from common.bus.bus import Bus
from common.messages import TrackerPose

ReceivedT = TypeVar("ReceivedT")
TakenT_co = TypeVar("TakenT_co", covariant=True)


class Taking(Protocol[TakenT_co]):
    """Where messages come from; an `Ingest`."""

    def get(self, timeout_s: float) -> TakenT_co | None:
        """The next message, or None when none came in time."""
        ...


class DevicePoses(Generic[ReceivedT]):
    """Message source that publishes tracker poses as they pass.

    The bus belongs to the caller.
    """

    def __init__(self, source: Taking[ReceivedT], bus: Bus) -> None:
        """Stand between a source and who reads it."""
        self._source, self._bus = source, bus

    def get(self, timeout_s: float) -> ReceivedT | None:
        """The next message; one of a tracker is on the bus, too, stream `device`.

        Raises:
            BusError: The bus is closed.
        """
        message = self._source.get(timeout_s)
        if isinstance(message, TrackerPose):
            self._bus.publish("device", message.source, message)
        return message
