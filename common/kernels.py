"""Compile numeric functions; plain Python where NUMBA_DISABLE_JIT=1."""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
import numpy as np

F = TypeVar("F", bound=Callable[..., Any])

# A division by 0 gives infinity, as in numpy.
_OPTIONS = {"cache": True, "nogil": True, "error_model": "numpy"}


def kernel(function: F) -> F:
    """Compile `function` at its first call with arguments of new types, or load it.

    Machine code is kept beside the source, or in the user's cache folder where that is read-only. The interpreter's
    lock is released while it runs.
    """
    return cast(F, cast(Any, numba).njit(**_OPTIONS)(function))


def inner(function: F) -> F:
    """As `kernel`, for a function that only kernels call; compiles in half the time."""
    alone = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    return cast(F, cast(Any, numba).njit(**_OPTIONS, **alone)(function))


def constant(number: int) -> int:
    """A whole number for kernels to pass on.

    Python's own would be a literal, a type of its own, and numba compiles what is called anew for every literal.
    """
    return cast(int, np.int64(number))
