"""What messages are made of: their base, bounds of names and numbers, arrays of a shape and read-only."""

from math import inf
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta, Struct

MAX_MARKERS = 48
MAX_TAGS = 16  # in one frame: their corners fit one Ethernet packet
JOINT_COUNT = 26
FINGER_COUNT = 5

# The look-ahead: in Python `$` also matches before a final line feed, and names become keys and file names.
Name = Annotated[str, Meta(min_length=1, max_length=64, pattern=r"^[A-Za-z0-9_.-]+(?!\n)$")]
Count = Annotated[int, Meta(ge=0, le=2**63 - 1)]
TimeNs = Annotated[int, Meta(ge=-(2**63), le=2**63 - 1)]
Finite = Annotated[float, Meta(ge=-1e18, le=1e18)]

_INFINITE = np.array(inf).tobytes(), np.array(-inf).tobytes()  # there is one of each sign, unlike NaN


class Message(Struct, frozen=True, eq=False, forbid_unknown_fields=True, tag_field="type"):
    """Base of all messages: immutable, tagged with its own name, unknown fields refused."""


def freeze(message: Message, field: str, dtype: type[np.generic], shape: tuple[int, ...]) -> None:
    """Give `field` its shape, refuse an infinity, and make it read-only (copied if it was not)."""
    given = getattr(message, field)
    array = np.asarray(given, dtype=dtype)
    if array.shape != shape:
        try:
            array = array.reshape(shape)
        except ValueError as error:
            raise ValueError(f"{field}: shape {array.shape}, expected {shape}") from error
    if dtype is np.float64 and _infinite(array):
        raise ValueError(f"{field}: infinite value")
    if array.flags.writeable:
        array = array.copy()
        array.flags.writeable = False
    if array is not given:
        msgspec.structs.force_setattr(message, field, array)


def _infinite(array: np.ndarray) -> bool:
    """Whether there is an infinity; its bytes are looked for first, for that takes a tenth of the time."""
    raw = array.tobytes()
    return any(sign in raw for sign in _INFINITE) and bool(np.isinf(array).any())
