"""Confinement of a library's sockets to this machine.

The library listens on every network, and has no setting to do otherwise.

Linux gives a socket that is bound to a device only what comes through that device. The loopback device carries all that
a machine sends to itself, under each of its addresses, and nothing else.
"""

import os
import socket
import sys
from collections.abc import Collection, Iterable, Iterator
from contextlib import suppress
from pathlib import Path

_LOOPBACK = b"lo\0"
_ANYWHERE = frozenset({"0.0.0.0", "::"})
_FOLDER = Path("/proc/self/fd")
Socket = tuple[int, str]


def sockets() -> frozenset[Socket]:
    """Return the descriptors of all sockets of this process.

    Each with its own name in the kernel, as another one may have the number later; none where the system does not
    report them.
    """
    found: set[Socket] = set()
    if _FOLDER.is_dir():
        for entry in _FOLDER.iterdir():
            with suppress(OSError):  # closed meanwhile
                if (name := str(entry.readlink())).startswith("socket:"):
                    found.add((int(entry.name), name))
    return frozenset(found)


def keep_here(before: Collection[Socket], ports: range) -> bool:
    """Bind new sockets that listen everywhere to the loopback device.

    Those at one of the ports that were not there before.

    Args:
        before: `sockets` before the library opened its own.
        ports: Where it may listen.

    Returns:
        Whether each is bound; False: there is one that is not, or the system cannot determine it, or do it.
    """
    bound = [
        _bound(one) for one in _listening((number for number, _ in sockets() - frozenset(before)), ports)
    ]
    return bool(bound) and all(bound)


def _listening(descriptors: Iterable[int], ports: range) -> Iterator[socket.socket]:
    """Copies of those sockets that listen everywhere at one of the ports."""
    for descriptor in descriptors:
        with suppress(OSError), socket.socket(fileno=os.dup(descriptor)) as one:
            if one.family not in (socket.AF_INET, socket.AF_INET6):
                continue
            address, port = one.getsockname()[:2]
            if address in _ANYWHERE and port in ports:
                yield one


def _bound(one: socket.socket) -> bool:
    if sys.platform != "linux":
        return False
    try:
        one.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, _LOOPBACK)
    except OSError:  # before Linux 5.7 only root may
        return False
    return True
