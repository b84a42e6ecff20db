"""Messages between processes: bytes enter, checked messages leave, and back.

Arrays are read-only; NaN means "not seen". On the wire a message is one msgpack map, an array its little-endian
bytes: NaN travels as itself, and a message costs no Python loop. Alternatives of markers are rare, and none at all
travel as no bytes: so the detections of 24 markers fit one Ethernet packet. `decode` is the only way in: whatever it
returns has the right shapes, and each number is within the bounds of its field. docs/wire.md describes every field.
"""

from copy import copy
from typing import TypeAlias, TypeVar, cast

import msgspec
import numpy as np

from common.errors import BoundsError, MessageError
from common.messages.parts import (
    DTYPES,
    FINGER_COUNT,
    JOINT_COUNT,
    MAX_MARKERS,
    MAX_TAGS,
    Count,
    Finite,
    Message,
    Name,
    OutOfBoundsError,
    TimeNs,
)
from common.messages.results import (
    Contact,
    Gesture,
    GestureKind,
    HandPose,
    ObjectPose,
    ObjectSource,
    Phase,
    ResultMessage,
    SolverMode,
    Source,
)
from common.messages.sensed import (
    Detections,
    ImuSample,
    MarkerDetections,
    TagDetections,
    TrackerPose,
    WristDetections,
)
from common.messages.state import (
    MAX_BODY_CHARACTERS,
    MAX_CHECKS,
    MAX_PREVIEW_BYTES,
    MAX_STILL_BYTES,
    Backlog,
    CheckCode,
    CheckItem,
    Checklist,
    Command,
    Health,
    Preview,
    Still,
)

__all__ = [
    "FINGER_COUNT",
    "JOINT_COUNT",
    "MAX_BODY_CHARACTERS",
    "MAX_CHECKS",
    "MAX_MARKERS",
    "MAX_PREVIEW_BYTES",
    "MAX_STILL_BYTES",
    "MAX_TAGS",
    "WIRE_VERSION",
    "AnyMessage",
    "Backlog",
    "CheckCode",
    "CheckItem",
    "Checklist",
    "Command",
    "Contact",
    "Count",
    "Detections",
    "Finite",
    "Gesture",
    "GestureKind",
    "HandPose",
    "Health",
    "ImuSample",
    "MarkerDetections",
    "Message",
    "MessageT",
    "Name",
    "ObjectPose",
    "ObjectSource",
    "Phase",
    "Preview",
    "ResultMessage",
    "SolverMode",
    "Source",
    "Still",
    "TagDetections",
    "TimeNs",
    "TrackerPose",
    "WristDetections",
    "decode",
    "encode",
    "restamped",
]

WIRE_VERSION = 13

AnyMessage: TypeAlias = (
    MarkerDetections
    | WristDetections
    | TagDetections
    | TrackerPose
    | ImuSample
    | HandPose
    | ObjectPose
    | Contact
    | Gesture
    | Health
    | Checklist
    | Command
    | Backlog
    | Preview
    | Still
)

MessageT = TypeVar("MessageT", bound=Message)

# How msgspec begins its report of a number beyond the `ge` or `le` of its field.
_BEYOND = tuple(f"Expected `{kind}` {sign}=" for kind in ("int", "float") for sign in "<>")
_NONE = np.empty((0, 2))


def _to_bytes(array: object) -> bytes:
    if not isinstance(array, np.ndarray):
        raise NotImplementedError(f"cannot encode {type(array)}")
    return array.tobytes()  # row by row, however it lies


def _from_bytes(kind: type, raw: object) -> object:
    if not isinstance(raw, bytes):
        raise ValueError("array is not bytes")
    dtype = DTYPES[kind]
    if len(raw) % dtype.itemsize:
        raise ValueError("array is cut")
    if dtype.kind == "b" and raw.translate(None, b"\0\1"):
        raise ValueError("truth value is neither 0 nor 1")
    return np.frombuffer(raw, dtype)


_ENCODER = msgspec.msgpack.Encoder(enc_hook=_to_bytes)
_DECODER = msgspec.msgpack.Decoder(AnyMessage, dec_hook=_from_bytes)


def encode(message: Message) -> bytes:
    """Return the message as msgpack bytes."""
    if isinstance(message, MarkerDetections) and not message.has_alternatives:
        message = copy(message)
        msgspec.structs.force_setattr(message, "alt_uv", _NONE)
    return _ENCODER.encode(message)


def decode(data: bytes | memoryview) -> AnyMessage:
    """Return the message in `data`.

    Raises:
        BoundsError: It is a message, but a number in it is out of bounds.
        MessageError: The bytes are not exactly one message of ours: broken msgpack,
            unknown type or field, wrong shape.
    """
    try:
        return cast(AnyMessage, _DECODER.decode(data))
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        if isinstance(error.__cause__, OutOfBoundsError) or str(error).startswith(_BEYOND):
            raise BoundsError(f"out of bounds: {error}") from error
        raise MessageError(f"not a message: {error}") from error


def restamped(message: MessageT, **numbers: float) -> MessageT:
    """Return the message with other numbers in fields, such as times, unchecked.

    `msgspec.structs.replace` looks at every array once more, which costs more than all else that becomes of a message
    on its way in.
    """
    message = copy(message)
    for name, number in numbers.items():
        msgspec.structs.force_setattr(message, name, number)
    return message
