"""Values of calibration files from their types: within the bounds, at them, and hostile ones anywhere.

What a type gets in future is drawn by itself. Strategies and edits work on plain documents, as JSON has them.
"""

from collections.abc import Iterator
from typing import Any

import msgspec
from hypothesis import strategies as st
from msgspec import inspect

Path = tuple[str | int, ...]

HOSTILE: list[Any] = [
    0, -0.0, -1, 1e-300, -1e-300, 1e300, -1e300, 1e-9, 1e9, 2**63, -(2**63), 2**64, 10**400, 0.1, 1,
    "NaN", "", "1", "\x1b[2J", None, True, [], {}, [[]], [1e300] * 3, [[[[0]]]], {"a": {"a": 1}},
]  # fmt: skip


def leaves(document: Any, path: Path = ()) -> Iterator[Path]:
    """Paths of everything in a document, itself left out."""
    items = document.items() if isinstance(document, dict) else enumerate(document)
    for key, value in items:
        yield (*path, key)
        if isinstance(value, dict | list):
            yield from leaves(value, (*path, key))


def edited(document: Any, path: Path, value: Any) -> Any:
    """A copy with the value at `path` replaced, added, or, with `...`, removed."""
    copy = msgspec.json.decode(msgspec.json.encode(document))
    inner = copy
    for key in path[:-1]:
        inner = inner[key]
    if value is ...:
        del inner[path[-1]]
    else:
        inner[path[-1]] = value
    return copy


def bounds_of(document: Any, kind: type[msgspec.Struct]) -> list[tuple[Path, float, float]]:
    """Every number of `document` with the low and high that its type allows."""
    return list(_bounds(document, inspect.type_info(kind), ()))


def _bounds(value: Any, info: inspect.Type, path: Path) -> Iterator[tuple[Path, float, float]]:
    match info:
        case inspect.UnionType(types=types):
            for one in types:
                yield from _bounds(value, one, path)
        case inspect.FloatType(ge=low, le=high) | inspect.IntType(ge=low, le=high) if type(value) in (
            int,
            float,
        ):
            if low is not None and high is not None:
                yield path, low, high
        case inspect.StructType() if isinstance(value, dict) and info.tag in (None, value.get("kind")):
            for field in info.fields:
                if field.encode_name in value:
                    yield from _bounds(value[field.encode_name], field.type, (*path, field.encode_name))
        case inspect.DictType() if isinstance(value, dict):
            for key, inner in value.items():
                yield from _bounds(inner, info.value_type, (*path, key))
        case inspect.TupleType() if isinstance(value, list):
            for i, inner in enumerate(value):
                yield from _bounds(inner, info.item_types[i], (*path, i))
        case inspect.VarTupleType() if isinstance(value, list):
            for i, inner in enumerate(value):
                yield from _bounds(inner, info.item_type, (*path, i))
        case _:
            pass


def numbers_without_bounds(info: inspect.Type, path: str = "$") -> Iterator[str]:
    """Every number of a type that has no lower or no upper bound."""
    match info:
        case inspect.FloatType() | inspect.IntType():
            if info.ge is None or info.le is None:
                yield path
        case inspect.UnionType(types=types):
            for one in types:
                yield from numbers_without_bounds(one, path)
        case inspect.StructType(fields=fields):
            for field in fields:
                yield from numbers_without_bounds(field.type, f"{path}.{field.encode_name}")
        case inspect.DictType(value_type=inner) | inspect.VarTupleType(item_type=inner):
            yield from numbers_without_bounds(inner, f"{path}[]")
        case inspect.TupleType(item_types=parts):
            for part in parts:
                yield from numbers_without_bounds(part, f"{path}[]")
        case _:
            pass


def edits(document: Any) -> st.SearchStrategy[tuple[Path, Any]]:
    """A hostile value, or nothing at all, at some place of a document."""
    return st.tuples(
        st.sampled_from(sorted(leaves(document), key=repr)),
        st.sampled_from(HOSTILE) | st.just(...) | st.floats(allow_nan=False, allow_infinity=False),
    )
