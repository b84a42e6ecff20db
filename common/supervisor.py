"""A supervisor ends a process whose thread fails and notifies its manager.

A thread that dies leaves a process that looks alive and does half of its work. So no exception of any thread is lost:
the process is asked to end as by a stop of the system (SIGTERM), which closes files and devices, and ends with
`EXIT_CODE`; where that takes too long, or nobody waits for that signal, it ends at once. Whoever started it starts it
again. The service manager (sd_notify(3)) gets datagrams of `NAME=VALUE` lines at the socket in `NOTIFY_SOCKET`; without
that variable nothing is sent.
"""

import logging
import os
import signal
import socket
import subprocess
import threading
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager

EXIT_CODE = 70  # EX_SOFTWARE of sysexits.h
# Beside `start_new_session` for Popen: Ctrl-C is for us, and we end the child in good order.
NEW_GROUP: int = getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0)  # of Windows, which has no sessions
_LOG = logging.getLogger(__name__)


class ThreadEndedError(Exception):
    """Error for a thread that returned before it was asked to stop."""


class ThreadSupervisor:
    """Supervisor that is notified of every thread that fails; holds the first name."""

    def __init__(self) -> None:
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
    """Make `work` a thread's work that fails if it returns before `stopped`."""

    def run() -> None:
        work()
        if not stopped():
            raise ThreadEndedError("it returned before it was asked to stop")

    return run


_UNIX: int = getattr(socket, "AF_UNIX", 0)  # Windows has neither these nor such managers
MAIN, WATCHDOG, WATCHDOG_PID = "NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID"


class ServiceManager:
    """Manager of this process, if it has one.

    Attributes:
        listens: Whether it has.
        watchdog_us: How long it waits for a sign of life [us]; 0: for ever.
    """

    def __init__(self, environment: Mapping[str, str]) -> None:
        """Find out who listens, from the environment of the process; nothing is sent yet."""
        self._address = _address(environment.get(MAIN, "")) if _UNIX else None
        self.listens = self._address is not None
        self.watchdog_us = _watchdog_us(environment) if self.listens else 0

    def send(self, text: str, wait: bool = False) -> bool:
        """Send lines of `NAME=VALUE`, and return whether that could be done.

        `wait`: until the manager has room, where a loss would matter.
        """
        if self._address is None:
            return True
        try:
            with socket.socket(_UNIX, socket.SOCK_DGRAM) as to:
                to.setblocking(wait)
                to.sendto(text.encode(), self._address)
        except OSError as error:
            if wait:
                _LOG.warning("%s: cannot reach the service manager: %s", MAIN, error)
            return False
        return True


def one_line(text: str) -> str:
    """One line, not too long for `systemctl status`."""
    return " ".join(text.split())[:200]


def _address(text: str) -> str | None:
    """The address of a socket, a path or `@name` (without a file), or None."""
    if not text:
        return None
    if text[0] == "@":
        return "\0" + text[1:]
    if text[0] != "/":
        _LOG.warning("%s=%s: neither a path nor @name; nothing is sent", MAIN, text)
        return None
    return text


def _watchdog_us(environment: Mapping[str, str]) -> int:
    """The period of the watchdog [us]; 0: none, or that of another process."""
    period, pid = environment.get(WATCHDOG, ""), environment.get(WATCHDOG_PID, "")
    mine = not pid or pid == str(os.getpid())
    return int(period) if mine and period.isdecimal() else 0
