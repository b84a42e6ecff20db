"""What arrives at the master's network card, and when: the times of the data datagrams of each host."""

import bisect
import itertools
import socket
import struct
import threading
import time
from pathlib import Path
from typing import NamedTuple

ETH_P_ALL = 3
ETHERNET, UDP_HEADER, UDP, TCP = 14, 8, 17, 6
PCAP_HEADER, PCAP_RECORD = 24, 16
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


class Packet(NamedTuple):
    """A UDP datagram or a segment of TCP."""

    protocol: int
    source: str
    ports: tuple[int, int]
    payload: bytes


def packet_of(frame: bytes) -> Packet | None:
    """What an Ethernet frame brings; None if it is neither UDP nor TCP over IPv4."""
    if len(frame) < ETHERNET + 20 or frame[12:14] != b"\x08\x00" or frame[ETHERNET + 9] not in (UDP, TCP):
        return None
    protocol, length = frame[ETHERNET + 9], struct.unpack_from("!H", frame, ETHERNET + 2)[0]
    begin, end = ETHERNET + 4 * (frame[ETHERNET] & 0x0F), ETHERNET + length
    if len(frame) < begin + UDP_HEADER:
        return None
    header = UDP_HEADER if protocol == UDP else 4 * (frame[begin + 12] >> 4)
    source = socket.inet_ntoa(frame[ETHERNET + 12 : ETHERNET + 16])
    return Packet(protocol, source, struct.unpack_from("!HH", frame, begin), frame[begin + header : end])


def captured(file: Path) -> list[Packet]:
    """The UDP and TCP of a capture of tcpdump (pcap, Ethernet, as this machine's byte order has it)."""
    content, packets, at = file.read_bytes(), list[Packet](), PCAP_HEADER
    assert struct.unpack_from("=I", content)[0] in (0xA1B2C3D4, 0xA1B23C4D), f"{file}: no pcap"
    while at + PCAP_RECORD <= len(content):
        length = struct.unpack_from("=I", content, at + 8)[0]
        frame = content[at + PCAP_RECORD : at + PCAP_RECORD + length]
        if (packet := packet_of(frame)) is not None:
            packets.append(packet)
        at += PCAP_RECORD + length
    return packets


def data_source(frame: bytes, port: int) -> str | None:
    """Address that sent this Ethernet frame if it is a data datagram to UDP `port`, else None."""
    packet = packet_of(frame)
    if packet is None or packet.protocol != UDP or packet.ports[1] != port:
        return None
    return packet.source if packet.payload[:4] == MAGIC and packet.payload[5:6] == bytes([DATA]) else None
