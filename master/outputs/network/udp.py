"""UDP socket towards one receiver, who may be absent.

Whoever listens receives.
"""

import socket

from common.errors import PhalanxError


class UdpSender:
    """Holds the socket and the address, looked up once. Safe to close twice."""

    def __init__(self, host: str, port: int, key: str) -> None:
        """Open the socket.

        `key` is where the settings state the address, for errors.

        Raises:
            PhalanxError: The host is unknown.
        """
        self._fix = f"{key}.host, {key}.port of the output settings"
        try:
            family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        except OSError as error:
            raise PhalanxError(f"{host}:{port}: no such host: {error.strerror}; see {self._fix}") from error
        self._where = f"{host}:{port}"
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)  # several receivers by one address
        try:
            self._socket.connect(address)  # so that the kernel takes nothing in from anybody else
        except OSError as error:
            self._socket.close()
            raise PhalanxError(
                f"{host}:{port}: cannot send: {error.strerror or error}; see {self._fix}"
            ) from error

    def send(self, packet: bytes) -> None:
        """Send one datagram.

        Raises:
            PhalanxError: This machine cannot: no route, no permission.
        """
        try:
            try:
                self._socket.send(packet)
            except ConnectionRefusedError:  # of an earlier one, to which nobody listened
                self._socket.send(packet)
        except ConnectionRefusedError:
            return
        except OSError as error:
            raise PhalanxError(
                f"{self._where}: cannot send: {error.strerror or error}; see {self._fix}"
            ) from error

    def close(self) -> None:
        """Give the socket back."""
        self._socket.close()
