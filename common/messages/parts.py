"""Parts of messages: base, names, bounded numbers, arrays of a fixed shape.

Arrays are read-only. Every number on the wire has bounds that stand at its field: msgspec's own `ge` and `le`, or
`within` for an array and a number that may be NaN. They are what a sensor of this kind could measure at all, so that
whatever is computed of a message stays finite; the decoder refuses what is beyond. docs/wire.md and
docs/schema/messages.json list the bounds from here.
"""

import re
from collections.abc import Mapping
from functools import cache
from math import prod
from typing import Annotated, Any, NamedTuple, get_args, get_origin

import msgspec
import numpy as np
from msgspec import Meta, Struct
from msgspec.structs import force_setattr

from common.arrays import Bool, Code, Float, Ids

_FLOAT = np.dtype(np.float64)
# Elements of each type of array; on the wire the same, little-endian, as all machines of ours are.
DTYPES: dict[object, np.dtype[Any]] = {
    Float: _FLOAT,
    Bool: np.dtype(np.bool_),
    Code: np.dtype(np.uint8),
    Ids: np.dtype(np.uint16),
}
MAX_MARKERS = 48
MAX_TAGS = 16  # in one frame: their corners fit one Ethernet packet
JOINT_COUNT = 26
FINGER_COUNT = 5
MAX_PICTURE = 16_384  # width and height of a picture [px]
MAX_COUNT = 2**63 - 1
MAX_TIME_NS = 2**61  # 73 years; sums and differences of two stay within 63 bits
MAX_NUMBER = 1e18
_UNIT = 1.001  # an element of a unit quaternion, rounded


class OutOfBoundsError(ValueError):
    """A number beyond what its field can be. The text names field, value and bounds."""


class Bounds(NamedTuple):
    """Smallest and largest value of a number, or of each element of an array."""

    low: float
    high: float


def within(low: float, high: float) -> Meta:
    """Bounds of an array or number; NaN ("not observed") is within."""
    return Meta(extra={"bounds": Bounds(low, high)}, extra_json_schema={"x-minimum": low, "x-maximum": high})


# The look-ahead: in Python `$` also matches before a final line feed, and names become keys and file names.
MAX_NAME_CHARACTERS = 64
Name = Annotated[str, Meta(min_length=1, max_length=MAX_NAME_CHARACTERS, pattern=r"^[A-Za-z0-9_.-]+(?!\n)$")]
# For people: printed on terminals and pages, so no control characters, no marks that turn the line's direction, no
# lone surrogates.
_UNPRINTABLE = r"\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ufeff\ud800-\udfff"
_NOT_PRINTABLE = re.compile(f"[{_UNPRINTABLE}]")
Text = Annotated[str, Meta(max_length=MAX_NAME_CHARACTERS, pattern=rf"^[^{_UNPRINTABLE}]*(?!\n)$")]
Sentence = Annotated[str, Meta(min_length=1, max_length=500, pattern=rf"^[^{_UNPRINTABLE}]+(?!\n)$")]

Count = Annotated[int, Meta(ge=0, le=MAX_COUNT)]
TimeNs = Annotated[int, Meta(ge=-MAX_TIME_NS, le=MAX_TIME_NS)]
TimeSigmaNs = Annotated[float, Meta(ge=0.0, le=1e10)]
Finite = Annotated[float, Meta(ge=-MAX_NUMBER, le=MAX_NUMBER)]

Numbers = Annotated[Float, within(-MAX_NUMBER, MAX_NUMBER)]
# the largest picture, and one beside each edge
Pixels = Annotated[Float, within(-MAX_PICTURE, 2 * MAX_PICTURE)]
SigmaPx = Annotated[Float, within(1e-6, MAX_PICTURE)]
Metres = Annotated[Float, within(-1e4, 1e4)]
SensedMetres = Annotated[Float, within(-1e3, 1e3)]  # of a device: what is made of it stays within `Metres`
UnitQuaternion = Annotated[Float, within(-_UNIT, _UNIT)]  # a quaternion


class Message(Struct, frozen=True, eq=False, forbid_unknown_fields=True, tag_field="type"):
    """Base of all messages: immutable, tagged with its own name, no unknown fields."""


@cache
def bounds_of(kind: type) -> dict[str, Bounds]:
    """Field -> bounds of those fields of `kind` that state them by `within`."""
    metas = {field.name: getattr(field.type, "__metadata__", ()) for field in msgspec.structs.fields(kind)}
    extras: dict[str, list[dict[str, Any]]] = {
        name: [meta.extra for meta in found if isinstance(meta, Meta) and meta.extra]
        for name, found in metas.items()
    }
    return {name: extra[0]["bounds"] for name, extra in extras.items() if extra}


def array_type(of: object) -> object:
    """The type of a field without its bounds."""
    return get_args(of)[0] if get_origin(of) is Annotated else of


def printable(text: str) -> str:
    """Return the text with a question mark for each character that `Text` refuses."""
    return _NOT_PRINTABLE.sub("?", text)


_NOTHING = None, None


class Layout:
    """Array fields of one message type: type, shape, and bounds of each element.

    The bounds stand one after the other in two vectors, so that all numbers of a message are compared at once.
    """

    def __init__(self, kind: type[Message], **shapes: tuple[int, ...]) -> None:
        """Fields of `kind` with these shapes, in this order."""
        types = {field.name: field.type for field in msgspec.structs.fields(kind)}
        self.arrays = tuple((name, DTYPES[array_type(types[name])], shape) for name, shape in shapes.items())
        self._expected = {name: (dtype, shape) for name, dtype, shape in self.arrays}
        bounds = bounds_of(kind)
        self._numbers = [
            (name, prod(shape), bounds[name]) for name, shape in shapes.items() if name in bounds
        ]
        each = [of for _, size, of in self._numbers for _ in range(size)]
        self._low, self._high = np.array(each).reshape(-1, 2).T.copy()

    def freeze(self, message: Message) -> None:
        """Check all arrays of a new message, shape them, and make them read-only.

        An array that was writable is copied.

        Raises:
            ValueError: Another shape.
            OutOfBoundsError: An element is beyond the bounds of its field.
        """
        numbers: list[np.ndarray] = []
        for name, dtype, shape in self.arrays:
            given = getattr(message, name)
            array = np.asarray(given, dtype)
            if array.shape != shape:
                try:
                    array = array.reshape(shape)
                except ValueError as error:
                    raise ValueError(f"{name}: shape {array.shape}, expected {shape}") from error
            if array.flags.writeable:
                array = array.copy()
                array.setflags(write=False)
            if array is not given:
                force_setattr(message, name, array)
            if dtype is _FLOAT:
                numbers.append(array)
        every = np.concatenate(numbers, axis=None)
        # NaN, which is "not observed", is neither less nor greater.
        if np.count_nonzero(every < self._low) or np.count_nonzero(every > self._high):
            self._refuse(every.tolist())

    def adopt(self, message: Message, arrays: Mapping[str, np.ndarray]) -> None:
        """Give a message arrays known to be valid: read-only from here on, unchecked.

        Raises:
            ValueError: Another name, shape or type: the maker is wrong.
        """
        for name, array in arrays.items():
            dtype, shape = self._expected.get(name, _NOTHING)
            if array.shape != shape or (array.dtype is not dtype and array.dtype != dtype):
                raise ValueError(f"{name}: {array.dtype} {array.shape}, expected {dtype} {shape}")
            array.setflags(write=False)
            force_setattr(message, name, array)

    def _refuse(self, every: list[float]) -> None:
        """Name the first number that is beyond its bounds."""
        begin = 0
        for name, size, (low, high) in self._numbers:
            for value in every[begin : begin + size]:
                if value < low or value > high:
                    raise _beyond(name, value, low, high)
            begin += size


def refuse_parts(message: Message, field: str) -> None:
    """Refuse points (..., D) with NaN in only a part of a row (ValueError)."""
    points: Float = getattr(message, field)
    for row in points.reshape(-1, points.shape[-1]).tolist():
        missing = row[0] != row[0]
        for value in row:
            if (value != value) is not missing:
                raise _in_part(field)


def refuse_sigma(message: Message, sigma: str, uv: str) -> None:
    """Refuse partly seen points (N, 2) or sigmas (N,) not where seen (ValueError)."""
    points: Float = getattr(message, uv)
    for (u, v), value in zip(points.tolist(), getattr(message, sigma).tolist(), strict=True):
        missing = u != u
        if (v != v) is not missing:
            raise _in_part(uv)
        if (value != value) is not missing:
            raise ValueError(f"{sigma}: must be positive where {uv} is seen and NaN elsewhere")


def _in_part(field: str) -> ValueError:
    return ValueError(f"{field}: NaN in a part of a row, must be in all of it or nowhere")


def refuse_beyond(message: Message, field: str) -> None:
    """Refuse a number beyond the bounds of its field (OutOfBoundsError); NaN passes."""
    value, (low, high) = getattr(message, field), bounds_of(type(message))[field]
    if value < low or value > high:
        raise _beyond(field, value, low, high)


def refuse_bad_quaternion(message: Message, field: str) -> None:
    """Refuse squared lengths off 1 by over 0.1 (OutOfBoundsError); NaN passes."""
    w, x, y, z = getattr(message, field).tolist()
    length = 0.1  # by how much the squared length of a quaternion may miss 1
    if abs(w * w + x * x + y * y + z * z - 1.0) > length:
        raise OutOfBoundsError(f"{field}: a quaternion of squared length {w * w + x * x + y * y + z * z:g}")


def _beyond(field: str, value: float, low: float, high: float) -> OutOfBoundsError:
    return OutOfBoundsError(f"{field}: {value:g} is not within {low:g} ... {high:g}")
