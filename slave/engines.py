"""Engines of the inner loops.

OpenCV and numpy, or machine code that does the same. The engine is chosen by name alone.
"""

from collections.abc import Callable
from typing import TypeVar

ENGINES = ("numpy", "numba")
_Engine = TypeVar("_Engine")


def engine_of(name: str, numpy: _Engine, numba: Callable[[], _Engine]) -> _Engine:
    """The engine of a name of `ENGINES`.

    Args:
        name: What the user chose.
        numpy: The engine that is always there.
        numba: Loads the other one: an optional package, which only who asks for it loads.

    Raises:
        PhalanxError: numba is asked for and not installed; the message states how to install it.
        ValueError: No such name.
    """
    if name == "numpy":
        return numpy
    if name == "numba":
        return numba()
    raise ValueError(f"engine {name!r}, not one of {', '.join(ENGINES)}")
