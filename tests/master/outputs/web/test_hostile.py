"""Strangers at the port of the page: what they say, how long they stay, and how many come; who reads poses has them."""

import socket
import struct
import threading
import time
from contextlib import ExitStack, suppress

import pytest
from websockets.sync.client import connect

from master.outputs.web import server as web_server
from master.outputs.web.server import CLIENTS, WebServer
from tests.hostile_datagrams import assault

WAIT_S = 60.0
RATE_HZ = 50.0
UPGRADE = (
    b"GET /hands HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
)
MASK = b"\x01\x02\x03\x04"
FRAMES = [
    b"\x81\xff" + struct.pack("!Q", 1 << 62) + MASK,  # a text of exabytes is announced
    b"\x81\xfe" + struct.pack("!H", 60_000) + MASK + bytes(60_000),
    b"\x81\x85hello",  # never whole
    b"\x81\x05hello",  # not masked
    b"\xff" * 2000,
    b"\x89\xff" + struct.pack("!Q", 1 << 40) + MASK,  # a ping that may have 125 bytes
    b"\x01\x81" + MASK + b"a" + (b"\x00\x81" + MASK + b"a") * 2000,  # one text in 2000 pieces
]
CLOSE = b"\x88"  # as no pose and no head of HTTP has it
ENDED = (0, 1, 3, 4, 5)  # of these: the server says so, and closes


class StreamSubscriber:
    """Offers poses to a server, as the sender does. Holds how many it offered, and a thread."""

    def __init__(self, server: WebServer) -> None:
        self.offered = 0
        self._server, self._stop = server, threading.Event()
        self._thread = threading.Thread(target=self._offer, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        self._thread.join()

    def _offer(self) -> None:
        while not self._stop.wait(1.0 / RATE_HZ):
            self.offered += 1
            self._server.offer("hand a", b"%d" % self.offered)


def spoken(port: int, frame: bytes, wait_s: float) -> bytes:
    """Open a WebSocket, say this, and return all that is said until the server says the end, or in so many seconds."""
    output, deadline = b"", time.monotonic() + wait_s
    with socket.create_connection(("127.0.0.1", port), timeout=WAIT_S) as one, suppress(OSError):
        one.sendall(UPGRADE)
        while b"\r\n\r\n" not in output:
            output += one.recv(4096)
        one.sendall(frame)
        one.settimeout(wait_s)
        while (piece := one.recv(65_536)) and time.monotonic() < deadline:
            output += piece
            if CLOSE in piece:
                break
    return output


def test_three_hundred_strangers_and_broken_frames_leave_the_reader_its_poses() -> None:
    server = WebServer("127.0.0.1", 0)
    feed = StreamSubscriber(server)
    try:
        with connect(f"ws://127.0.0.1:{server.port}/hands", open_timeout=WAIT_S) as reader:
            unknown_peer = threading.Thread(target=assault, args=(("127.0.0.1", server.port), 300, 100, 3.0))
            unknown_peer.start()
            read: list[int] = []
            answers: list[bytes] = []
            while unknown_peer.is_alive() or len(answers) < len(FRAMES):
                if len(answers) < len(FRAMES):
                    frame = len(answers)
                    answers.append(spoken(server.port, FRAMES[frame], WAIT_S if frame in ENDED else 0.5))
                read.append(int(reader.recv(WAIT_S)))
            unknown_peer.join()
            last = feed.offered
            while read[-1] < last:  # what it reads is new again at once: nothing waited for the strangers
                read.append(int(reader.recv(WAIT_S)))
        assert all(answer.startswith(b"HTTP/1.1 101") for answer in answers)
        assert all(CLOSE in answers[frame] for frame in ENDED)
        assert read == sorted(set(read))
        assert len(read) > 100
    finally:
        feed.close()
        server.close()


def test_of_many_that_come_at_once_no_more_are_served_than_there_is_room_for() -> None:
    server = WebServer("127.0.0.1", 0)
    try:
        with ExitStack() as stack:
            many = [
                stack.enter_context(socket.create_connection(("127.0.0.1", server.port), timeout=WAIT_S))
                for _ in range(60)
            ]
            for one in many:
                one.sendall(UPGRADE)
            for one in many:
                assert one.recv(12).startswith(b"HTTP/1.1 ")
            assert server.clients <= CLIENTS
        deadline = time.monotonic() + WAIT_S
        while server.clients and time.monotonic() < deadline:
            time.sleep(0.01)
        assert server.clients == 0
    finally:
        server.close()


def test_who_connects_and_says_nothing_is_sent_away(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(web_server, "OPEN_S", 0.3)
    server = WebServer("127.0.0.1", 0)
    try:
        with socket.create_connection(("127.0.0.1", server.port), timeout=WAIT_S) as silent:
            silent.sendall(b"GET /hands HT")
            assert not any(iter(lambda: silent.recv(4096), b""))  # ended, in time, without a word
    finally:
        server.close()
