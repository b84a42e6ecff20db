"""The JSON schema of what is on the bus, for whoever decodes it elsewhere: docs/schema/messages.json, by `make schema`.

On the wire a message is a msgpack map, and JSON schema has no word for two things there: bytes, and an array of
numbers, which travels as the bytes of its elements, little-endian and row by row. Both say `"x-msgpack": "bin"`, and an
array what its elements are: `"x-dtype"` is "<f8" (64-bit floats), "<u2", "u1" (unsigned integers) or "?" (truth values,
a byte each). Shapes stand in the descriptions and in docs/wire.md; a NaN in an array or a number is "not known".
"""

import inspect
from collections.abc import Sequence
from math import isnan
from typing import Any

import msgspec
import numpy as np

from common.arrays import Bool, Code, Float, Ids
from common.messages import WIRE_VERSION, Backlog, Message
from common.streams import ALIVE_KEY, STREAMS, Path

_DTYPES: dict[object, str] = {Float: "<f8", Bool: "?", Code: "u1", Ids: "<u2"}
_REF = "#/$defs/{name}"


def bus_schema() -> bytes:
    """Streams of the bus with their keys, and the messages they carry; the same bytes on every Python version."""
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
            if field.type in _DTYPES:
                fields[field.encode_name] = {"x-msgpack": "bin", "x-dtype": _DTYPES[field.type]}
            elif fields[field.encode_name].pop("contentEncoding", None):  # how msgspec writes bytes in JSON
                fields[field.encode_name] = {"x-msgpack": "bin"}
            elif isinstance(field.default, float) and isnan(field.default):  # for which JSON has no word
                del fields[field.encode_name]["default"]
    return parts


def _array(kind: type) -> dict[str, Any]:
    """An array type as such; of what, its field says.

    Raises:
        NotImplementedError: It is none.
    """
    if kind is not np.ndarray:
        raise NotImplementedError(f"{kind}")
    return {"x-msgpack": "bin"}
