"""Counts the parts of the detector where they are called: every function and method of `slave.markers` in use.

No part is named here, so a detector that is cut into other parts is counted in those.
"""

import functools
import inspect
import sys
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from types import FunctionType

PACKAGE = "slave.markers."
WHOLE = {"__init__", "push", "fresh"}  # not parts


@contextmanager
def counted_parts(mark: Callable[[str], None], wanted: bool = True) -> Generator[None, None, None]:
    """While it lasts, calls of the detector's parts are marked: `+name` before, `-name` after.

    First a part that does nothing is called ten times, so that the cost of the marks is known.
    """
    if not wanted:
        yield
        return
    nothing = _marked(mark, "nothing", lambda: None)
    for _ in range(10):
        nothing()
    places = list(_parts())
    for owner, name, function in places:
        setattr(owner, name, _marked(mark, function.__qualname__, function))
    try:
        yield
    finally:
        for owner, name, function in places:
            setattr(owner, name, function)


def _parts() -> Iterator[tuple[object, str, Callable[..., object]]]:
    """(Where it is looked up, under which name, function) of every part that is loaded."""
    for module in [module for name, module in sys.modules.items() if name.startswith(PACKAGE)]:
        for name, value in list(vars(module).items()):
            if isinstance(value, FunctionType) and value.__module__.startswith(PACKAGE):
                yield module, name, value
            elif inspect.isclass(value) and value.__module__ == module.__name__:
                for method, function in list(vars(value).items()):
                    if isinstance(function, FunctionType) and method not in WHOLE and method[:2] != "__":
                        yield value, method, function


def _marked(mark: Callable[[str], None], name: str, function: Callable[..., object]) -> Callable[..., object]:
    @functools.wraps(function)
    def marked(*args: object, **kwargs: object) -> object:
        mark(f"+{name}")
        try:
            return function(*args, **kwargs)
        finally:
            mark(f"-{name}")

    return marked
