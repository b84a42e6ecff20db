"""Execution of jobs that take longer than a frame.

In a thread pool on a live slave, in the caller where runs must be equal.
"""

from collections.abc import Callable
from concurrent.futures import Future
from typing import Protocol, TypeVar

T = TypeVar("T")


class Workers(Protocol):
    """Takes jobs; a `concurrent.futures.ThreadPoolExecutor` is one."""

    def submit(self, fn: Callable[[], T], /) -> Future[T]:
        """Do `fn` now or later; the future has its result."""
        ...


class Inline:
    """Worker that does every job at once, in the caller's thread.

    The same input gives the same output.
    """

    def submit(self, fn: Callable[[], T], /) -> Future[T]:
        """Do it; the future is done."""
        done: Future[T] = Future()
        done.set_result(fn())
        return done
