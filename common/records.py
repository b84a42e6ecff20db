"""Records: structs of arrays, which kernels take as one pointer."""

from collections.abc import Mapping
from functools import cache
from types import SimpleNamespace
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np

R = TypeVar("R")


class _Field(NamedTuple):
    kind: Any  # data type of numpy, or class of a record
    shape: tuple[int | str, ...]


def array(*shape: int | str, kind: str = "f8") -> Any:
    """Declare an array of a record, its shape in numbers and in names of sizes.

    Args:
        shape: A name may have a factor or an offset: "3M" is three times the size M, "6+n" six more than n.
        kind: Data type of numpy.
    """
    return _Field(kind, shape)


def part(kind: type, *count: int) -> Any:
    """Declare a field that is a record itself, or so many of them."""
    return _Field(kind, count)


def record(kind: type[R], **sizes: int) -> R:
    """Allocate a struct of arrays, all zero.

    Args:
        kind: A class that declares the fields; never called.
        sizes: Of the names in their shapes, those of nested records included.
    """
    return cast(R, np.zeros(1, _layout(kind, tuple(sizes.items()))).view(np.recarray)[0])


@cache
def _layout(kind: type, sizes: tuple[tuple[str, int], ...]) -> np.dtype[Any]:
    """Layout of a record, one object: quick to compare."""
    size_of, layout = dict(sizes), list[Any]()
    for name, field in vars(kind).items():
        if isinstance(field, _Field):
            shape = tuple(_size(one, size_of) if isinstance(one, str) else one for one in field.shape)
            nested = isinstance(field.kind, type)
            layout.append((name, (np.record, _layout(field.kind, sizes)) if nested else field.kind, shape))
    return np.dtype(layout, align=True)


def _size(name: str, size_of: Mapping[str, int]) -> int:
    offset, _, product = name.rpartition("+")
    symbol = product.lstrip("0123456789")
    return int(offset or 0) + int(product.removesuffix(symbol) or 1) * size_of[symbol]


def filled(one: R, **values: Any) -> R:
    """Copy arrays, or one number for all, into the fields of a record; return it."""
    for name, value in values.items():
        cast(Any, one)[name] = value
    return one


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
