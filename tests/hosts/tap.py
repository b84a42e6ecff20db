"""What arrives at the master's network card, and when: the times of the data datagrams of each host."""

import bisect
import itertools
import socket
import struct
import threading
import time

ETH_P_ALL = 3
ETHERNET, UDP_HEADER, UDP = 14, 8, 17
MAGIC, DATA = b"PHLX", 8  # docs/wire.md, sections 1 and 3


class Tap:
    """Listens on one interface in a thread; holds the arrival times [s, time.monotonic] by source address."""

    def __init__(self, interface: str, port: int) -> None:
        """Begin to listen for datagrams to UDP `port`.

        Raises:
            OSError: Not root, or there is no such interface.
        """
        self._port = port
        self._times: dict[str, list[float]] = {}
        self._socket = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(ETH_P_ALL))
        self._socket.bind((interface, 0))
        self._socket.settimeout(0.2)
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    def times(self, source: str, since: float = 0.0) -> list[float]:
        """Arrival times from `since` on of the data of `source`."""
        times = self._times.get(source, [])
        return times[bisect.bisect_left(times, since) :]

    def wait(self, source: str, since: float, timeout_s: float) -> float | None:
        """Time of the first datagram from `since` on; None if none came by `since` + `timeout_s`."""
        until = since + timeout_s
        while not (times := self.times(source, since)):
            if time.monotonic() > until:
                return None
            time.sleep(0.005)
        return times[0]

    def longest_gap_s(self, source: str, since: float) -> float:
        """Longest time without a datagram from `since` until now; the open ends count."""
        edges = [since, *self.times(source, since), time.monotonic()]
        return max(later - earlier for earlier, later in itertools.pairwise(edges))

    def rate_hz(self, source: str, seconds: float) -> float:
        """Datagrams a second, watched for `seconds` from now."""
        begin = time.monotonic()
        time.sleep(seconds)
        return len(self.times(source, begin)) / (time.monotonic() - begin)

    def close(self) -> None:
        """End the thread. Safe to call twice."""
        self._over.set()
        self._thread.join()
        self._socket.close()

    def _listen(self) -> None:
        while not self._over.is_set():
            try:
                frame = self._socket.recv(65536)
            except TimeoutError:
                continue
            except OSError:  # the interface is gone, and the run with it
                return
            arrived = time.monotonic()
            if (source := data_source(frame, self._port)) is not None:
                self._times.setdefault(source, []).append(arrived)


def data_source(frame: bytes, port: int) -> str | None:
    """Address that sent this Ethernet frame if it is a data datagram to UDP `port`, else None."""
    if len(frame) < ETHERNET + 20 or frame[12:14] != b"\x08\x00" or frame[ETHERNET + 9] != UDP:
        return None
    udp = ETHERNET + 4 * (frame[ETHERNET] & 0x0F)
    body = udp + UDP_HEADER
    if len(frame) < body + 6 or struct.unpack_from("!H", frame, udp + 2)[0] != port:
        return None
    if frame[body : body + 4] != MAGIC or frame[body + 5] != DATA:
        return None
    return socket.inet_ntoa(frame[ETHERNET + 12 : ETHERNET + 16])
