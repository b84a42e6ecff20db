"""Single table of streams: content, transport path, key and recording."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from operator import attrgetter
from typing import Any, get_args

from common.messages import (
    AnyMessage,
    Checklist,
    Command,
    Contact,
    Gesture,
    HandPose,
    Health,
    ImuSample,
    MarkerDetections,
    Message,
    ObjectPose,
    Preview,
    Still,
    TagDetections,
    TrackerPose,
    WristDetections,
)


class Path(StrEnum):
    """How a stream travels."""

    DATAGRAM = "datagram"  # sealed UDP: a lost message never delays the next
    ZENOH = "zenoh"  # reliable link: control and outputs


@dataclass(frozen=True, slots=True)
class Stream:
    """One row of the table.

    Attributes:
        message: Type that travels.
        key: Key on the zenoh bus, with {name} for the sender or target; None for datagrams.
        recorded: Whether the message recorder keeps it.
        most_hz: Of those streams that devices send on the bus: what is accepted of one sender per second.
    """

    message: type[Message]
    path: Path
    key: str | None
    recorded: bool
    most_hz: float | None = None


STREAMS = {
    "markers": Stream(MarkerDetections, Path.DATAGRAM, None, True),
    "wrist": Stream(WristDetections, Path.DATAGRAM, None, True),
    "tags": Stream(TagDetections, Path.DATAGRAM, None, True),
    "tracker": Stream(TrackerPose, Path.DATAGRAM, None, True),
    "imu": Stream(ImuSample, Path.DATAGRAM, None, True),
    "hand": Stream(HandPose, Path.ZENOH, "phalanx/hand/{name}", True),
    "device": Stream(TrackerPose, Path.ZENOH, "phalanx/device/{name}", False),  # on the master's clock
    "object": Stream(ObjectPose, Path.ZENOH, "phalanx/object/{name}", True),
    "contact": Stream(Contact, Path.ZENOH, "phalanx/contact/{name}", True),
    "gesture": Stream(Gesture, Path.ZENOH, "phalanx/gesture/{name}", True),
    "health": Stream(Health, Path.ZENOH, "phalanx/health/{name}", True, 20.0),
    "checklist": Stream(Checklist, Path.ZENOH, "phalanx/checklist/{name}", True),
    # What came as datagrams, in the order and with the times in which the master solves it, while somebody records;
    # before it a `Backlog` where the master falls behind or has caught up.
    "taken": Stream(Message, Path.ZENOH, "phalanx/taken/{name}", False),
    "preview": Stream(Preview, Path.ZENOH, "phalanx/preview/{name}", False, 60.0),
    "still": Stream(Still, Path.ZENOH, "phalanx/still/{name}", False, 60.0),
    "command": Stream(Command, Path.ZENOH, "phalanx/command/{name}", False),
}

ALIVE_KEY = "phalanx/alive/{name}"
MASTER = "master"  # its name on the bus


def key_of(stream: str, name: str) -> str:
    """Return the zenoh key of `stream` for `name`; raises ValueError for datagrams."""
    key = STREAMS[stream].key
    if key is None:
        raise ValueError(f"stream {stream!r} travels as datagrams, it has no key")
    return key.format(name=name)


_NAMED_BY = ("hand", "object", "target", "camera", "source")
_SENDER: dict[type[Message], Callable[[Any], str]] = {
    kind: attrgetter(next(field for field in _NAMED_BY if field in kind.__struct_fields__))
    for kind in get_args(AnyMessage)
}


def sender_of(message: Message) -> str:
    """Name under which a message travels: camera, sensor, hand, object or process."""
    return _SENDER[type(message)](message)
