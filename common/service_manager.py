"""Notify the system's service manager of a process (sd_notify(3)).

That it is ready, that it is alive, and what it does.

Datagrams of `NAME=VALUE` lines go to the socket in `NOTIFY_SOCKET`. Without that variable nobody listens, nothing is
sent, and a process on a terminal runs as ever.
"""

import logging
import os
import socket
from collections.abc import Mapping

MAIN, WATCHDOG, WATCHDOG_PID = "NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID"
_LOG = logging.getLogger(__name__)


class ServiceManager:
    """Who started this process, if it wants to know how it is.

    Attributes:
        listens: Whether it does.
        watchdog_us: How long it waits for a sign of life [us]; 0: for ever.
    """

    def __init__(self, environment: Mapping[str, str]) -> None:
        """Find out who listens, from the environment of the process; nothing is sent yet."""
        self._address = _address(environment.get(MAIN, ""))
        self.listens = self._address is not None
        self.watchdog_us = _watchdog_us(environment) if self.listens else 0

    def send(self, text: str, wait: bool = False) -> bool:
        """Send lines, and return whether that could be done.

        Args:
            text: Lines of `NAME=VALUE`.
            wait: Wait until the manager has room for it, where a loss would matter.
        """
        if self._address is None:
            return True
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as to:
                to.sendto(text.encode(), 0 if wait else socket.MSG_DONTWAIT, self._address)
        except OSError as error:
            if wait:
                _LOG.warning("%s: cannot reach the service manager: %s", MAIN, error)
            return False
        return True


def one_line(text: str) -> str:
    """One line, not too long for `systemctl status`."""
    return " ".join(text.split())[:200]


def _address(text: str) -> str | None:
    """The address of a socket: a path, or `@name` for one without a file.

    None: nobody listens.
    """
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
