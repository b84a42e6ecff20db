"""Compile numeric functions to machine code; one source, which runs as plain Python where NUMBA_DISABLE_JIT=1."""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
import numpy as np

F = TypeVar("F", bound=Callable[..., Any])

_OPTIONS = {
    "cache": True,
    "nogil": True,
    "error_model": "numpy",
}  # a division by 0 gives infinity, as in numpy


def kernel(function: F) -> F:
    """Compile `function` at its first call with arguments of new types; later starts load it from the cache.

    Machine code is kept beside the source, or in the user's cache folder where that is read-only. The interpreter's
    lock is released while it runs.
    """
    return cast(F, cast(Any, numba).njit(**_OPTIONS)(function))


def inner(function: F) -> F:
    """As `kernel`, for a function that only kernels call: it compiles in half the time, and Python cannot call it."""
    alone = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    return cast(F, cast(Any, numba).njit(**_OPTIONS, **alone)(function))


def constant(number: int) -> int:
    """A whole number that kernels pass on: numba's type of it is not "literally this", for which it compiles anew."""
    return cast(int, np.int64(number))
