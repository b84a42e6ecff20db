"""Records: structs of arrays, which kernels take as one pointer."""

from collections.abc import Mapping
from functools import cache
from types import SimpleNamespace
from typing import Any, TypeVar, cast

import numpy as np

R = TypeVar("R")
Shape = int | tuple[int, ...]


def record(kind: type[R], **fields: Shape | tuple[str, Shape] | tuple[object, int] | object) -> R:
    """Allocate a struct of arrays with fixed shapes, all zero.

    Args:
        kind: A class that declares the fields; never called.
        fields: Shape of each, of float64; or data type and shape; or another record, which is copied into it; or one
            and how many of its kind there are, all zero.
    """
    types: list[tuple[str, Any] | tuple[str, Any, Any]] = []
    for name, of in fields.items():
        if isinstance(of, np.void):
            types.append((name, cast(Any, of.dtype)))
        elif isinstance(of, tuple) and isinstance(cast(Any, of)[0], np.void):
            one, count = cast(tuple[np.void, int], of)
            types.append((name, cast(Any, one.dtype), (count,)))
        elif isinstance(of, tuple) and isinstance(cast(Any, of)[0], str):
            kind_of, shape = cast(tuple[str, Shape], of)
            types.append((name, kind_of, shape if isinstance(shape, tuple) else (shape,)))
        else:
            types.append((name, "f8", cast(Any, of if isinstance(of, tuple) else (of,))))
    out = np.zeros(1, _layout(tuple(types))).view(np.recarray)[0]
    for name, of in fields.items():
        if isinstance(of, np.void):
            out[name] = of
    return cast(R, out)


@cache
def _layout(types: tuple[Any, ...]) -> np.dtype[Any]:
    """Layout of records with these fields, one object: quick to compare."""
    return np.dtype(list(types), align=True)


def filled(kind: type[R], values: Mapping[str, Any]) -> R:
    """Return a record of copies of arrays; integers and booleans keep their type."""
    types = {"i": "i8", "u": "u1", "b": "u1"}
    fields = {name: (types.get(value.dtype.kind, "f8"), value.shape) for name, value in values.items()}
    out = record(kind, **fields)
    for name, value in values.items():
        cast(Any, out)[name] = value
    return out


def fields(one: R) -> R:
    """The arrays of a record and of nested ones; numpy takes 3 us to find one."""
    found = SimpleNamespace()
    record_of = cast(Any, one)
    for name in record_of.dtype.names:
        value = record_of[name]
        setattr(found, name, fields(value) if isinstance(value, np.void) else value)
    return cast(R, found)


def boxed(one: object) -> Any:
    """The array that holds a record: passed to kernels in a fraction of the time."""
    return cast(Any, one).base
