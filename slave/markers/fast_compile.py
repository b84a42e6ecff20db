"""Compilation of a function to machine code with numba.

numba is the package of the `fast` extra; a clear error is raised where it is missing.

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
    """Return `function` as machine code.

    It is compiled at the first call with arguments of new types.

    It releases the interpreter's lock. Sums may be added up in another order (`reassoc`, `contract`); NaN and
    infinity keep their meaning.

    Raises:
        PhalanxError: numba is not installed, or does not fit the installed numpy.
    """
    try:
        numba = cast(Any, importlib.import_module("numba"))
    except ImportError as error:
        raise PhalanxError(f"--engine numba: numba cannot be used ({error}); {INSTALL}") from error
    # A division by 0 gives infinity, as in numpy: a check of each one would keep loops from being vectorised.
    options = {
        "cache": True,
        "nogil": True,
        "error_model": "numpy",
        "fastmath": {"reassoc", "contract", "nsz"},
    }
    return cast(F, numba.njit(**options)(function))
