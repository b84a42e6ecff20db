"""Supervise all threads of a process: one that fails ends the process.

Whoever started the process starts it again.

A thread that dies leaves a process that looks alive and does half of its work. So no exception of any thread is lost:
the process is asked to end as by a stop of the system (SIGTERM), which closes files and devices, and ends with
`EXIT_CODE`; where that takes too long, or nobody waits for that signal, it ends at once.
"""

import logging
import os
import signal
import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager

EXIT_CODE = 70  # EX_SOFTWARE of sysexits.h
_LOG = logging.getLogger(__name__)


class ThreadEndedError(Exception):
    """Error for a thread that returned before it was asked to stop."""


class ThreadSupervisor:
    """Supervisor that is notified of every thread that fails.

    It holds the name of the first.
    """

    def __init__(self) -> None:
        """Nothing failed yet."""
        self.failed: str | None = None

    def thread_failed(self, args: threading.ExceptHookArgs) -> None:
        """Log what ended a thread, and end the process; a `threading.excepthook`."""
        if args.exc_type is SystemExit:
            return
        name = "?" if args.thread is None else args.thread.name
        error = args.exc_value or args.exc_type()
        _LOG.critical("thread %r failed, the process ends: %r", name, error, exc_info=error)
        if self.failed is not None:
            return
        self.failed = name
        if signal.getsignal(signal.SIGTERM) is signal.SIG_DFL:
            os._exit(EXIT_CODE)
        grace_s = 1.0  # to close files and devices: the next process is to be there within two seconds
        last = threading.Timer(grace_s, os._exit, (EXIT_CODE,))
        last.daemon = True
        last.start()
        os.kill(os.getpid(), signal.SIGTERM)


@contextmanager
def supervised_threads() -> Generator[ThreadSupervisor, None, None]:
    """Supervise every thread of this process for as long as the block runs.

    Raises:
        SystemExit: At the end of the block, with `EXIT_CODE`, if a thread failed, or the block itself.
    """
    supervisor, before = ThreadSupervisor(), threading.excepthook
    threading.excepthook = supervisor.thread_failed
    try:
        yield supervisor
    except Exception as error:  # the main thread is one of them
        _LOG.critical("the process ends by a fault: %r", error, exc_info=error)
        raise SystemExit(EXIT_CODE) from error
    finally:
        threading.excepthook = before
        if supervisor.failed is not None:
            raise SystemExit(EXIT_CODE)


def until(stopped: Callable[[], bool], work: Callable[[], None]) -> Callable[[], None]:
    """Make `work` a thread's work that fails when it returns too early.

    To return is to fail unless `stopped` reports that it was asked to.
    """

    def run() -> None:
        work()
        if not stopped():
            raise ThreadEndedError("it returned before it was asked to stop")

    return run
