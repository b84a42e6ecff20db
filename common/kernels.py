"""Kernels compile numeric functions and take records, structs of arrays.

Compile numeric functions; plain Python where NUMBA_DISABLE_JIT=1.

Structs of arrays with fixed shapes, which kernels take as one pointer.
"""

import os
from collections.abc import Callable, Mapping
from functools import cache
from types import SimpleNamespace
from typing import Any, TypeVar, cast

import numba
import numpy as np

# Kernels are straight code over small arrays: what LLVM finds beyond its first level takes three times as long to
# compile, and makes them no faster. numba reads this when it is imported.
for _name, _value in (("NUMBA_OPT", "1"), ("NUMBA_LOOP_VECTORIZE", "0"), ("NUMBA_SLP_VECTORIZE", "0")):
    os.environ[_name] = os.environ.get(_name, _value)

F = TypeVar("F", bound=Callable[..., Any])

# A division by 0 gives infinity, as in numpy.
_OPTIONS = {"cache": True, "nogil": True, "error_model": "numpy"}
# Without reference counts, of which a call with many arrays has as many; so nothing may be allocated.
_INNER = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True, "_nrt": False}


def kernel(function: F) -> F:
    """Compile `function` at its first call with arguments of new types, or load it.

    Machine code is kept beside the source, or in the user's cache folder where that is read-only. The interpreter's
    lock is released while it runs.
    """
    return cast(F, cast(Any, numba).njit(**_OPTIONS)(function))


def inner(function: F) -> F:
    """As `kernel`, for a function that only kernels call and that allocates nothing."""
    return cast(F, cast(Any, numba).njit(**_OPTIONS, **_INNER)(function))


def inlined(function: F) -> F:
    """Compile like `inner`, for a small function in a hot loop.

    It is inlined into its callers.
    """
    return cast(F, cast(Any, numba).njit(**_OPTIONS, **_INNER, forceinline=True)(function))


def constant(number: int) -> int:
    """A whole number for kernels to pass on.

    Python's own would be a literal, a type of its own, and numba compiles what is called anew for every literal.
    """
    return cast(int, np.int64(number))


def bound(function: F, *arguments: Any) -> F:
    """Return a kernel bound to exactly these argument types.

    It skips type dispatch, which takes longer than the call.
    """
    if not hasattr(function, "compile"):  # NUMBA_DISABLE_JIT
        return function
    alike = function, tuple(_alike(one) for one in arguments)
    if alike not in _BOUND:
        compiled = cast(Any, function)
        types = tuple(cast(Any, numba).typeof(one) for one in arguments)
        compiled.compile(types)
        _BOUND[alike] = compiled.overloads[types].entry_point
    return cast(F, _BOUND[alike])


_BOUND: dict[tuple[object, ...], Any] = {}


def _alike(one: Any) -> object:
    """Return a cheap key that is equal for arguments of the same kernel type.

    numba takes milliseconds to determine the type.
    """
    if isinstance(one, np.ndarray):
        array = cast(Any, one)
        flags = array.flags
        layout = flags.c_contiguous, flags.f_contiguous, flags.writeable, flags.aligned
        return cast(object, (array.dtype, array.ndim, *layout))
    if isinstance(one, tuple):
        each = cast(tuple[Any, ...], one)
        return cast(Any, type(each)), tuple(_alike(part) for part in each)
    return cast(object, type(one))


R = TypeVar("R")
Shape = int | tuple[int, ...]


def record(kind: type[R], **fields: Shape | tuple[str, Shape] | tuple[object, int] | object) -> R:
    """Allocate a struct of arrays with fixed shapes, all zero.

    Kernels take it as one pointer.

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
    """Return the layout of records with these fields.

    One object for all alike, which makes them quick to compare.
    """
    return np.dtype(list(types), align=True)


def filled(kind: type[R], values: Mapping[str, Any]) -> R:
    """Return a record of copies of arrays.

    Integers and booleans keep their type, all else is float64.
    """
    types = {"i": "i8", "u": "u1", "b": "u1"}
    fields = {name: (types.get(value.dtype.kind, "f8"), value.shape) for name, value in values.items()}
    out = record(kind, **fields)
    for name, value in values.items():
        cast(Any, out)[name] = value
    return out


def fields(one: R) -> R:
    """Return the arrays of a record and of its nested records, looked up once.

    numpy takes 3 us to find one by name.
    """
    found = SimpleNamespace()
    record_of = cast(Any, one)
    for name in record_of.dtype.names:
        value = record_of[name]
        setattr(found, name, fields(value) if isinstance(value, np.void) else value)
    return cast(R, found)


def boxed(one: object) -> Any:
    """Return the array that holds a record.

    It is passed to kernels in a fraction of the time.
    """
    return cast(Any, one).base
