"""Parts of messages: base, names, bounded numbers, arrays of a fixed shape.

The arrays are read-only.

Every number on the wire has bounds that stand at its field. For a plain number they are msgspec's own `ge` and `le`,
for an array, and for a number that may be NaN, `within`. They are what a sensor of this kind could measure at all, so
that whatever is computed of a message stays finite; the decoder refuses what is beyond. docs/wire.md and
docs/schema/messages.json list the bounds from here.
"""

import re
from functools import cache
from math import nan
from typing import Annotated, Any, NamedTuple

import msgspec
import numpy as np
from msgspec import Meta, Struct

from common.arrays import Float

MAX_MARKERS = 48
MAX_TAGS = 16  # in one frame: their corners fit one Ethernet packet
JOINT_COUNT = 26
FINGER_COUNT = 5
MAX_PICTURE = 16_384  # width and height of a picture [px]
MAX_COUNT = 2**63 - 1
MAX_TIME_NS = 2**61  # 73 years; sums and differences of two stay within 63 bits
MAX_NUMBER = 1e18
_LOOPED = 32  # so few elements are compared faster one by one than by numpy
_TURN = 1.001  # an element of a unit quaternion, rounded
_LENGTH = 0.1  # by how much the squared length of a quaternion may miss 1


class OutOfBoundsError(ValueError):
    """A number beyond what its field can be. The text names field, value and bounds."""


class Bounds(NamedTuple):
    """Smallest and largest value of a number, or of each element of an array."""

    low: float
    high: float


def within(low: float, high: float) -> Meta:
    """Bounds of an array, or of a number that may be NaN.

    NaN, which is "not observed", is within.
    """
    return Meta(extra={"bounds": Bounds(low, high)}, extra_json_schema={"x-minimum": low, "x-maximum": high})


# The look-ahead: in Python `$` also matches before a final line feed, and names become keys and file names.
Name = Annotated[str, Meta(min_length=1, max_length=64, pattern=r"^[A-Za-z0-9_.-]+(?!\n)$")]
# For people: printed on terminals and pages, so no control characters, no marks that turn the line's direction, no
# lone surrogates.
_UNPRINTABLE = r"\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ufeff\ud800-\udfff"
_NOT_PRINTABLE = re.compile(f"[{_UNPRINTABLE}]")
Text = Annotated[str, Meta(max_length=64, pattern=rf"^[^{_UNPRINTABLE}]*(?!\n)$")]
Sentence = Annotated[str, Meta(min_length=1, max_length=500, pattern=rf"^[^{_UNPRINTABLE}]+(?!\n)$")]

Count = Annotated[int, Meta(ge=0, le=MAX_COUNT)]
TimeNs = Annotated[int, Meta(ge=-MAX_TIME_NS, le=MAX_TIME_NS)]
TimeSigmaNs = Annotated[float, Meta(ge=0.0, le=1e10)]
Finite = Annotated[float, Meta(ge=-MAX_NUMBER, le=MAX_NUMBER)]

Numbers = Annotated[Float, within(-MAX_NUMBER, MAX_NUMBER)]
Pixels = Annotated[
    Float, within(-MAX_PICTURE, 2 * MAX_PICTURE)
]  # the largest picture, and one beside each edge
SigmaPx = Annotated[Float, within(1e-6, MAX_PICTURE)]
Metres = Annotated[Float, within(-1e4, 1e4)]
SensedMetres = Annotated[Float, within(-1e3, 1e3)]  # of a device: what is made of it stays within `Metres`
Turn = Annotated[Float, within(-_TURN, _TURN)]  # a quaternion


class Message(Struct, frozen=True, eq=False, forbid_unknown_fields=True, tag_field="type"):
    """Base of all messages: immutable, tagged with its own name, unknown fields refused."""


@cache
def bounds_of(kind: type) -> dict[str, Bounds]:
    """Field -> bounds of those fields of `kind` that state them by `within`."""
    metas = {field.name: getattr(field.type, "__metadata__", ()) for field in msgspec.structs.fields(kind)}
    extras: dict[str, list[dict[str, Any]]] = {
        name: [meta.extra for meta in found if isinstance(meta, Meta) and meta.extra]
        for name, found in metas.items()
    }
    return {name: extra[0]["bounds"] for name, extra in extras.items() if extra}


def printable(text: str) -> str:
    """Return the text with a question mark for each character that `Text` refuses."""
    return _NOT_PRINTABLE.sub("?", text)


def freeze(
    message: Message, field: str, dtype: type[np.generic], shape: tuple[int, ...], *, whole: bool = False
) -> None:
    """Check the shape and bounds of an array field, and make it read-only.

    The array is given its shape, and copied if it was writable.

    With `whole`, each of its rows is NaN in all or in no element: a point is seen or not.

    Raises:
        ValueError: Another shape, or a row that is NaN in part.
        OutOfBoundsError: An element is beyond the bounds of the field.
    """
    given = getattr(message, field)
    array = np.asarray(given, dtype=dtype)
    if array.shape != shape:
        try:
            array = array.reshape(shape)
        except ValueError as error:
            raise ValueError(f"{field}: shape {array.shape}, expected {shape}") from error
    if dtype is np.float64:
        _refuse_beyond(field, array, bounds_of(type(message))[field])
        if whole:
            _refuse_parts(field, array)
    if array.flags.writeable:
        array = array.copy()
        array.flags.writeable = False
    if array is not given:
        msgspec.structs.force_setattr(message, field, array)


def refuse_beyond(message: Message, field: str) -> None:
    """Refuse a number that is beyond the bounds of its field; NaN passes.

    Raises:
        OutOfBoundsError: It is.
    """
    value, (low, high) = getattr(message, field), bounds_of(type(message))[field]
    if value < low or value > high:
        raise _beyond(field, value, low, high)


def refuse_no_turn(message: Message, field: str) -> None:
    """Refuse a quaternion (4,) that is not of length 1; NaN passes.

    Raises:
        OutOfBoundsError: Its squared length misses 1 by more than a tenth.
    """
    w, x, y, z = getattr(message, field).tolist()
    if abs(w * w + x * x + y * y + z * z - 1.0) > _LENGTH:
        raise OutOfBoundsError(f"{field}: a quaternion of squared length {w * w + x * x + y * y + z * z:g}")


def _refuse_beyond(field: str, array: np.ndarray, bounds: Bounds) -> None:
    low, high = bounds
    if array.size <= _LOOPED:
        for value in array.ravel().tolist():
            if value < low or value > high:
                raise _beyond(field, value, low, high)
    elif ((array < low) | (array > high)).any():
        raise _beyond(field, nan, low, high)


def _refuse_parts(field: str, array: np.ndarray) -> None:
    missing = np.isnan(array) if array.ndim > 1 else np.isnan(array)[None]
    if (missing.any(axis=-1) != missing.all(axis=-1)).any():
        raise ValueError(f"{field}: NaN in a part of a row, must be in all of it or nowhere")


def _beyond(field: str, value: float, low: float, high: float) -> OutOfBoundsError:
    shown = "an element" if value != value else f"{value:g}"
    return OutOfBoundsError(f"{field}: {shown} is not within {low:g} ... {high:g}")
