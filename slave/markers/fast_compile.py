"""Compilation of a function to machine code with numba (the `fast` extra).

Machine code is kept beside the source (or in the user's cache folder where that is read-only), so only the first
start of a version compiles. The cache does not know the constants of other modules: what may change there is passed
as an argument.
"""

import importlib
from collections.abc import Callable
from typing import Any, TypeVar, cast

from common.errors import PhalanxError

INSTALL = "install it with `pip install 'phalanx-hand[fast]'`, or use --engine numpy"
F = TypeVar("F", bound=Callable[..., object])


def compiled(function: F) -> F:
    """Return `function` as machine code, compiled at the first call with new types.

    It releases the interpreter's lock. Sums may be added up in another order (`reassoc`, `contract`); NaN and
    infinity keep their meaning. Raises PhalanxError: no numba that fits numpy is installed.
    """
    try:
        numba = cast(Any, importlib.import_module("numba"))
    except ImportError as error:
        raise PhalanxError(f"--engine numba: numba cannot be used ({error}); {INSTALL}") from error
    # A division by 0 gives infinity, as in numpy: a check of each one would keep loops from being vectorised.
    fast = {"reassoc", "contract", "nsz"}
    return cast(F, numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=fast)(function))
