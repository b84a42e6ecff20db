"""Bus output of hands, objects, contact and gestures.

For the viewer and for any program of the user.
"""

from common.bus.bus import Bus
from common.messages import Contact, Gesture, HandPose, ResultMessage

_STREAM = {HandPose: "hand", Contact: "contact", Gesture: "gesture"}


class BusSink:
    """A `Sink` that publishes each message on the bus.

    On the stream of its type, under the name of its hand or object.

    The bus belongs to the caller.
    """

    def __init__(self, bus: Bus) -> None:
        self._bus = bus

    def write(self, message: ResultMessage) -> None:
        """Publish the message; a slow or absent reader never delays the master.

        Raises:
            BusError: The bus is closed.
        """
        if isinstance(message, HandPose | Contact | Gesture):
            self._bus.publish(_STREAM[type(message)], message.hand, message)
        else:
            self._bus.publish("object", message.object, message)

    def close(self) -> None:
        """Nothing to finish: the bus is closed by whoever opened it."""
