"""UDP sockets of this project.

One blocking reader each, senders that never wait.
"""

import errno
import socket
import struct

from common.errors import BusError
from common.link.datagram import MAX_DATAGRAM, Address

READ_TIMEOUT_S = 0.01  # the grid of everything that a reading thread repeats in between


class UdpSocket:
    """One bound UDP socket. `receive` belongs to one thread, `send` to any.

    `would_block` counts datagrams that the kernel had no room for, `failed` those it refused (no
    route, no such interface): both are lost like any other datagram.
    """

    def __init__(
        self, bind: Address, shared: bool = False, broadcast: bool = False, timeout_s: float = READ_TIMEOUT_S
    ) -> None:
        """Bind the socket.

        `shared` lets several processes receive the same broadcasts.

        Raises:
            BusError: The address is taken or not of this machine.
        """
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        if shared:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if broadcast:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        receive_buffer = 1 << 20
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer)
        # The kernel's own receive timeout: `settimeout` would make `send` wait as well.
        timeout = struct.pack("ll", 0, round(timeout_s * 1e6))
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, timeout)
        try:
            self._socket.bind(bind)
        except OSError as error:
            self._socket.close()
            taken = error.errno == errno.EADDRINUSE
            why = "another program has it, perhaps another master" if taken else error.strerror
            raise BusError(f"cannot bind UDP {bind[0]}:{bind[1]}: {why}") from error
        self.address: Address = self._socket.getsockname()
        self.would_block = 0
        self.failed = 0

    def receive(self) -> tuple[bytes, Address] | None:
        """Return the next datagram and its source, or None after the timeout or an error.

        One that is too long comes cut to one byte more than allowed, so that it is seen to be.
        """
        return self._receive(0)

    def receive_waiting(self) -> tuple[bytes, Address] | None:
        """As `receive`, of what has come already: None at once where nothing has."""
        return self._receive(socket.MSG_DONTWAIT)

    def _receive(self, flags: int) -> tuple[bytes, Address] | None:
        try:
            return self._socket.recvfrom(MAX_DATAGRAM + 1, flags)
        except (BlockingIOError, InterruptedError):
            return None
        except OSError as error:
            if error.errno in (errno.EBADF, errno.ENOTSOCK):
                raise
            return None  # a delayed ICMP complaint about an earlier send: not our concern

    def send(self, datagram: bytes, to: Address) -> bool:
        """Send now or not at all; whether the kernel took it."""
        try:
            self._socket.sendto(datagram, socket.MSG_DONTWAIT, to)
        except BlockingIOError:
            self.would_block += 1
        except OSError:
            self.failed += 1
        else:
            return True
        return False

    def close(self) -> None:
        """Give the address back."""
        self._socket.close()
