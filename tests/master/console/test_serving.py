"""Who connects to the console and does not ask, or never ends: a place for others stays, and memory is bounded."""

import socket
import ssl
import threading
import urllib.request
from collections.abc import Generator
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest
from fastapi import FastAPI, Request

from master.console import serving
from master.console.serving import MOST_CONNECTIONS, MOST_HEAD_BYTES, MOST_OF_ONE, console_server
from master.outputs.web.listening import page_certificate
from tests.network_helpers import until

OPEN_S, WAIT_S = 0.4, 30.0


def hello() -> FastAPI:
    """A console with one word."""
    app = FastAPI(openapi_url=None)
    app.add_api_route("/", lambda: "hello")

    async def length(request: Request) -> int:
        return len(await request.body())

    app.add_api_route("/length", length, methods=["POST"])
    return app


class Console:
    """A server on a thread."""

    def __init__(self, tls: ssl.SSLContext | None) -> None:
        listening = socket.create_server(("127.0.0.1", 0), backlog=1024)
        self.address: tuple[str, int] = listening.getsockname()
        self._server = console_server(hello(), tls)
        self._thread = threading.Thread(target=self._server.run, args=([listening],))
        self._thread.start()
        assert until(lambda: self._server.started)

    @property
    def connections(self) -> int:
        return len(self._server.server_state.connections)

    def close(self) -> None:
        self._server.should_exit = True
        self._thread.join(WAIT_S)
        assert not self._thread.is_alive()

    def connect(self, source: str = "127.0.0.1") -> socket.socket:
        return socket.create_connection(self.address, WAIT_S, (source, 0))

    def answers(self, source: str = "127.0.0.1") -> bool:
        """Whether somebody who asks properly is answered."""
        with self.connect(source) as one:
            one.sendall(b"GET / HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n")
            return b" 200 OK" in one.makefile("rb").readline()


@pytest.fixture
def plain(monkeypatch: pytest.MonkeyPatch) -> Generator[Console]:
    monkeypatch.setattr(serving, "OPEN_S", OPEN_S)
    console = Console(None)
    yield console
    console.close()


def sent_away(one: socket.socket) -> bool:
    """Whether the other end closes before we lose patience."""
    try:
        return one.recv(1 << 16) == b""
    except TimeoutError:
        return False
    except ConnectionError:
        return True


@pytest.mark.parametrize("output", [b"", b"GET / HT", b"GET / HTTP/1.1\r\nHost: x\r\nX: y"])
def test_who_does_not_finish_a_question_is_sent_away(plain: Console, output: bytes) -> None:
    with plain.connect() as one:
        one.sendall(output)
        assert sent_away(one)
    assert plain.answers()


def test_so_is_who_begins_a_second_question_and_does_not_finish_it(plain: Console) -> None:
    with plain.connect() as one:
        one.sendall(b"GET / HTTP/1.1\r\nHost: x\r\n\r\n")
        answer = b""
        while b'"hello"' not in answer:
            answer += one.recv(4096)
        one.sendall(b"GET /")
        assert sent_away(one)


def output(one: socket.socket, line: bytes, most: int) -> int:
    """How much of it is taken before the other end closes."""
    taken = 0
    with suppress(ConnectionError):
        while taken < most:
            one.sendall(line)
            taken += len(line)
    return taken


@pytest.mark.parametrize("line", [b"X: " + b"y" * 1000 + b"\r\n", b"y" * 1000])
def test_headers_do_not_grow_without_an_end(
    plain: Console, line: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(serving, "OPEN_S", WAIT_S)
    most = 500 * MOST_HEAD_BYTES  # the sockets' buffers swallow a part
    with plain.connect() as one:
        one.sendall(b"GET /" + (b" HTTP/1.1\r\n" if line.endswith(b"\n") else b""))
        assert output(one, line, most) < most


def test_what_comes_together_with_the_headers_is_no_part_of_them(plain: Console) -> None:
    size = 2 * MOST_HEAD_BYTES
    asked = b"POST /length HTTP/1.1\r\nHost: x\r\nConnection: close\r\nContent-Length: %d\r\n\r\n" % size
    with plain.connect() as one:
        one.sendall(asked + bytes(size))
        assert one.makefile("rb").read().endswith(b"\r\n\r\n%d" % size)


def test_one_address_takes_half_of_all_places_at_most(
    plain: Console, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(serving, "OPEN_S", WAIT_S)
    with ExitStack() as stack:
        for _ in range(2 * MOST_CONNECTIONS):
            stack.enter_context(plain.connect("127.0.0.2"))
        assert until(lambda: plain.connections == MOST_OF_ONE)
        assert plain.answers("127.0.0.3")
    assert until(lambda: plain.connections == 0)


def test_who_is_silent_before_tls_is_sent_away(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serving, "OPEN_S", OPEN_S)
    console = Console(page_certificate(tmp_path, "127.0.0.1").context)
    try:
        with console.connect() as one:
            assert sent_away(one)
        context = ssl.create_default_context(cafile=tmp_path / "page.pem")
        page = f"https://127.0.0.1:{console.address[1]}/"
        with urllib.request.urlopen(page, timeout=WAIT_S, context=context) as answer:
            assert answer.read() == b'"hello"'
    finally:
        console.close()
