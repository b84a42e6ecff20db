"""JSON schema of the messages on the bus, for external decoders.

docs/schema/messages.json, by `make schema`.

On the wire a message is a msgpack map, and JSON schema has no word for two things there: bytes, and an array of
numbers, sent as the bytes of its elements, little-endian and row by row. Both have `"x-msgpack": "bin"`, and an array
what its elements are: `"x-dtype"` is "<f8" (64-bit floats), "<u2", "u1" (unsigned integers) or "?" (truth values, a
byte each), and `"x-minimum"`, `"x-maximum"` their bounds. Shapes stand in the descriptions and in docs/wire.md; a NaN
in an array or a number is "not known", and within all bounds.
"""

import inspect
from collections.abc import Sequence
from math import isnan
from typing import Any, get_args

import msgspec
import numpy as np

from common.arrays import Bool, Code, Float, Ids
from common.link.handshake import Handshake
from common.messages import WIRE_VERSION, AnyMessage, Backlog, Message
from common.messages.parts import MAX_COUNT, MAX_NUMBER, MAX_PICTURE, MAX_TIME_NS, array_type, bounds_of
from common.messages.streams import ALIVE_KEY, STREAMS, Path

_DTYPES: dict[object, str] = {Float: "<f8", Bool: "?", Code: "u1", Ids: "<u2"}
_REF = "#/$defs/{name}"


def bus_schema() -> bytes:
    """Schema of streams, keys and messages, the same bytes on every Python version."""
    kinds = sorted(
        {row.message for row in STREAMS.values()} - {Message} | {Backlog}, key=lambda kind: kind.__name__
    )
    parts = _parts(kinds)
    streams = {
        name: {
            "key": row.key,
            "message": (
                [{"$ref": _REF.format(name=kind)} for kind in [Backlog.__name__, *datagrams()]]
                if row.message is Message
                else {"$ref": _REF.format(name=row.message.__name__)}
            ),
        }
        for name, row in STREAMS.items()
        if row.path is Path.ZENOH
    }
    content = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "What is on the bus of Phalanx",
        "description": inspect.cleandoc(__doc__ or ""),
        "x-wire-version": WIRE_VERSION,
        "x-alive-key": ALIVE_KEY,
        "x-streams": streams,
        "$defs": parts,
    }
    return msgspec.json.format(msgspec.json.encode(content), indent=1)


def message_schema(kind: type[Message]) -> bytes:
    """The schema of one message, with its docstring: what its fields mean."""
    return msgspec.json.encode({"$ref": _REF.format(name=kind.__name__), "$defs": _parts([kind])})


def datagrams() -> list[str]:
    """Names of the messages that come as datagrams, which the stream `taken` shows."""
    return sorted({row.message.__name__ for row in STREAMS.values() if row.path is Path.DATAGRAM})


def _parts(kinds: Sequence[type[Message]]) -> dict[str, Any]:
    """Name -> schema of these messages and of what they are made of."""
    _, parts = msgspec.json.schema_components(kinds, schema_hook=_array, ref_template=_REF)
    for part in parts.values():
        # Python 3.13 takes the indentation out of docstrings when it compiles them, earlier ones do not.
        part["description"] = inspect.cleandoc(part["description"])
    for kind in kinds:
        fields = parts[kind.__name__]["properties"]
        for field in msgspec.structs.fields(kind):
            array = array_type(field.type)
            if array in _DTYPES:
                limits = _limits(kind, field.name)
                fields[field.encode_name] = {"x-msgpack": "bin", "x-dtype": _DTYPES[array]} | limits
            elif fields[field.encode_name].pop("contentEncoding", None):  # how msgspec writes bytes in JSON
                fields[field.encode_name] = {"x-msgpack": "bin"}
            elif isinstance(field.default, float) and isnan(field.default):  # for which JSON has no word
                del fields[field.encode_name]["default"]
    return parts


def _limits(kind: type[Message], field: str) -> dict[str, float]:
    """What each element of an array is within, where its field states it."""
    bounds = bounds_of(kind).get(field)
    return {} if bounds is None else {"x-minimum": bounds.low, "x-maximum": bounds.high}


def _array(kind: type) -> dict[str, Any]:
    """Schema of an array type, whose field states the content."""
    if kind is not np.ndarray:
        raise NotImplementedError(f"{kind}")
    return {"x-msgpack": "bin"}


def bounds_table() -> str:
    """Markdown rows: each message, and what its numbers are within."""
    kinds = sorted(get_args(AnyMessage), key=lambda kind: kind.__name__)
    bodies = sorted(Handshake.__subclasses__(), key=lambda kind: kind.__name__)
    parts = _parts(kinds) | msgspec.json.schema_components(bodies)[1]
    rows = ["| message | each number of its fields is within |", "|---|---|"]
    for name in [kind.__name__ for kind in (*kinds, *bodies)]:
        fields: dict[str, list[str]] = {}
        for field, rule in parts[name]["properties"].items():
            if bounds := _bounds_text(rule.get("additionalProperties") or rule):
                fields.setdefault(bounds, []).append(f"`{field}`")
        if fields:
            rows.append(f"| {name} | {'; '.join(' '.join((', '.join(of), b)) for b, of in fields.items())} |")
    return "\n".join(rows) + "\n"


def _bounds_text(rule: dict[str, Any]) -> str:
    """The bounds of a number in words; empty: it is none."""
    limits: list[float] = [rule[key] for key in _LIMITS if key in rule]
    if len(limits) < 2:
        return ""
    low, high = (_POWERS.get(abs(value), f"{abs(value):,.7g}") for value in limits)
    if limits[0] >= 0.0:
        return f"{low} … {high}"
    return f"±{high}" if low == high else f"−{low} … {high}"


_LIMITS = ("minimum", "x-minimum", "maximum", "x-maximum")
_POWERS: dict[float, str] = {
    MAX_COUNT: "2⁶³ − 1",
    MAX_TIME_NS: "2⁶¹",
    MAX_NUMBER: "10¹⁸",
    MAX_PICTURE**2: "16,384²",
}
