"""Notice that kernels are being compiled: two minutes on a version's first start."""

import logging
import threading
from collections.abc import Generator
from contextlib import contextmanager

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
