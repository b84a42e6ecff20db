"""Log why a device or a frame failed, and go on.

At most one line is written in ten seconds.

A `PhalanxError` is logged by its own message. Whatever else a driver or a detector raises is a fault in a program:
it is counted, and logged with its traceback.
"""

import logging
from collections.abc import Callable, Mapping
from typing import TypeVar

from common.clock import now_ns
from common.errors import PhalanxError

LOG_EVERY_NS = 10_000_000_000
_LOG = logging.getLogger(__name__)

ValueT = TypeVar("ValueT", int, float)


class Failures:
    """Counts and logs the errors of one device or loop.

    Holds how many were none of ours, when the last line was logged, how many were not logged, and if any is open.
    """

    def __init__(self, of: str, clock: Callable[[], int] = now_ns) -> None:
        """Nothing failed yet.

        Args:
            of: Whose failures, as the lines begin.
            clock: The time [ns].
        """
        self._of, self._clock = of, clock
        self._logged_ns: int | None = None
        self._silent = 0
        self._open = False  # a failure was logged, and not yet that it is over
        self.raised = 0

    def log(self, event: str, error: Exception) -> str:
        """Count an error, and log `event` with it; return the error in words.

        Nothing is logged where a line is younger than ten seconds.
        """
        ours = isinstance(error, PhalanxError)
        why = str(error) if ours else f"{type(error).__name__}: {error}"
        self.raised += not ours
        if self._is_due():
            more = f" ({self._silent} more since the last such line)" if self._silent else ""
            _LOG.warning("%s: %s: %s%s", self._of, event, why, more, exc_info=None if ours else error)
            self._silent, self._open = 0, True
        else:
            self._silent += 1
        return why

    def ask(self, query: Callable[[], Mapping[str, ValueT]]) -> dict[str, ValueT]:
        """Query a driver for its state.

        Nothing where it raises, so that the reports go on.
        """
        try:
            return dict(query())
        except Exception as error:  # noqa: BLE001 - whatever a driver raises is its device's failure
            self.log("does not report its state", error)
            return {}

    def close(self, close: Callable[[], None]) -> None:
        """Close a driver; one that cannot be closed is opened again nevertheless."""
        try:
            close()
        except Exception as error:  # noqa: BLE001 - as above
            self.log("could not be given back", error)

    def over(self, event: str) -> None:
        """Log that all is well again, unless the failure itself was not logged, too."""
        if self._open:
            _LOG.warning("%s: %s", self._of, event)
        self._open = False

    def _is_due(self) -> bool:
        t_ns = self._clock()
        if self._logged_ns is not None and t_ns - self._logged_ns < LOG_EVERY_NS:
            return False
        self._logged_ns = t_ns
        return True
