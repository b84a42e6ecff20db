"""Compile numeric functions as kernels.

They take arrays and records (`common.records`). NUMBA_DISABLE_JIT=1 leaves them plain. Compiling takes two minutes
on a version's first start, which is logged.
"""

import logging
import os
import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager
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
    """As `inner`, for a small function in a hot loop: it is inlined into its callers."""
    return cast(F, cast(Any, numba).njit(**_OPTIONS, **_INNER, forceinline=True)(function))


def constant(number: int) -> int:
    """A whole number for kernels to pass on.

    Python's own would be a literal, a type of its own, and numba compiles what is called anew for every literal.
    """
    return cast(int, np.int64(number))


def bound(function: F, *arguments: Any) -> F:
    """Return a kernel bound to these argument types, without slow type dispatch."""
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
    """A cheap key of the kernel type of an argument, for which numba takes ms."""
    if isinstance(one, np.ndarray):
        array = cast(Any, one)
        flags = array.flags
        layout = flags.c_contiguous, flags.f_contiguous, flags.writeable, flags.aligned
        return cast(object, (array.dtype, array.ndim, *layout))
    if isinstance(one, tuple):
        each = cast(tuple[Any, ...], one)
        return cast(Any, type(each)), tuple(_alike(part) for part in each)
    return cast(object, type(one))


_LOG = logging.getLogger(__name__)


@contextmanager
def log_if_slow() -> Generator[None]:
    """Log that kernels are compiled, where that takes longer than loading them does."""
    slow_s = 1.5  # from the cache it takes half a second
    timer = threading.Timer(
        slow_s, _LOG.warning, ("compiling kernels, once for each version: about two minutes in all ...",)
    )
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
