"""The server of the page, read by clients that are not ours: the `websockets` client, http.client, bare sockets."""

import base64
import http.client
import json
import os
import re
import socket
from collections.abc import Generator

import pytest
from websockets.datastructures import Headers
from websockets.exceptions import InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin

from common.calibration.output_settings import WebOutput
from common.errors import PhalanxError
from common.messages import Gesture
from master.outputs.web import static_dir, three_js_path
from master.outputs.web.server import SEND_BUFFER_BYTES, WebServer, WebSink, foreign
from tests.master.outputs.network.hands import hand_pose
from tests.network_helpers import until

WAIT_S = 60.0


@pytest.fixture
def server() -> Generator[WebServer]:
    serving = WebServer("127.0.0.1", 0)
    yield serving
    serving.close()


def joined(server: WebServer, origin: str | None = None) -> ClientConnection:
    """A client that the server has taken in."""
    before = server.clients
    where = Origin(origin) if origin is not None else None
    client = connect(f"ws://127.0.0.1:{server.port}/hands", open_timeout=WAIT_S, origin=where)
    assert until(lambda: server.clients > before)
    return client


def got(server: WebServer, path: str, host: str | None = None) -> http.client.HTTPResponse:
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=WAIT_S)
    connection.putrequest("GET", path, skip_host=host is not None)
    if host is not None:
        connection.putheader("Host", host)
    connection.endheaders()
    return connection.getresponse()


def test_a_client_receives_every_pose_that_the_sink_was_given() -> None:
    sink = WebSink(WebOutput(host="127.0.0.1", port=0))
    sink.write(hand_pose("left"))  # nobody is there: it costs nothing, and nobody is sent the past later
    with joined(sink.server) as client:
        for k in range(5):
            pose = hand_pose("right", place_m=(0.01 * k, 0.0, 0.4), t_ns=k)
            sink.write(pose)
            text = client.recv(WAIT_S)
            assert isinstance(text, str)
            message = json.loads(text)
            assert (message["hand"], message["t_ns"]) == ("my-right", k)
            assert message["joints"][0]["position"] == pytest.approx([0.01 * k, 0.0, -0.4], abs=1e-6)
        client.send("ping 12.5")
        assert json.loads(client.recv(WAIT_S)) == {"type": "pong", "ping": "ping 12.5"}
    assert until(lambda: sink.server.clients == 0)  # forgotten
    sink.close()
    sink.close()
    with pytest.raises(PhalanxError, match="ended"):
        sink.server.offer("x", b"{}")


def test_what_is_not_for_pages_is_left_alone() -> None:
    sink = WebSink(WebOutput(host="127.0.0.1", port=0))
    with joined(sink.server) as client:
        sink.write(Gesture("my-right", 1, "pose", "open_palm", "begin", 1, 1.0))
        sink.write(hand_pose("right"))
        assert json.loads(client.recv(WAIT_S))["type"] == "hand"
    sink.close()


def stalled(server: WebServer) -> socket.socket:
    """A client that shakes hands and then reads nothing."""
    client = socket.socket()
    client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    client.settimeout(WAIT_S)
    client.connect(("127.0.0.1", server.port))
    key = base64.b64encode(os.urandom(16)).decode()
    client.sendall(
        f"GET /hands HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        f"Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n\r\n".encode()
    )
    answer = b""
    while b"\r\n\r\n" not in answer:
        answer += client.recv(1)
    assert answer.startswith(b"HTTP/1.1 101 ")
    return client


def test_a_client_that_stalls_delays_nobody_and_is_then_sent_the_newest(server: WebServer) -> None:
    slow = stalled(server)
    assert until(lambda: server.clients == 1)
    size, count = 20_000, 200  # 4 MB, far more than the buffers between
    with joined(server) as quick:
        for k in range(count):
            server.offer("hand a", f"{k:05d}{'.' * size}".encode())
            assert str(quick.recv(WAIT_S)).startswith(f"{k:05d}")
        assert server.skipped > count / 2
        for connection in list(server._mailboxes):
            assert connection.transport.get_write_buffer_size() < 2 * SEND_BUFFER_BYTES + size
    read = b""
    while f"{count - 1:05d}".encode() not in read:
        piece = slow.recv(65536)
        assert piece, "closed"
        read += piece
    numbers = [int(number) for number in re.findall(rb"(\d{5})\.", read)]
    assert numbers == sorted(numbers)
    assert len(numbers) < count / 2
    slow.close()


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "http://127.0.0.1:1", "https://localhost"])
def test_a_page_of_another_server_is_refused(server: WebServer, origin: str) -> None:
    with pytest.raises(InvalidStatus) as refused:
        connect(f"ws://127.0.0.1:{server.port}/hands", origin=Origin(origin), open_timeout=WAIT_S)
    assert refused.value.response.status_code == 403
    assert server.clients == 0


def test_our_own_page_and_programs_are_welcome(server: WebServer) -> None:
    with joined(server, f"http://127.0.0.1:{server.port}"), joined(server):
        assert server.clients == 2


@pytest.mark.parametrize(
    ("host", "origin", "welcome"),
    [
        ("127.0.0.1:8765", None, True),
        ("localhost:8765", "http://localhost:8765", True),
        ("[::1]:8765", "http://[::1]:8765", True),
        ("192.168.1.7:8765", "http://192.168.1.7:8765", True),
        ("evil.example:8765", "http://evil.example:8765", False),  # its own name, pointed at this machine
        ("evil.example:8765", None, False),
        ("localhost:8765", "http://localhost:3000", False),
        ("", None, False),
    ],
)
def test_who_is_foreign(host: str, origin: str | None, welcome: bool) -> None:
    headers = Headers({"Host": host})
    if origin is not None:
        headers["Origin"] = origin
    assert (foreign(headers, frozenset({"localhost"})) is None) is welcome


def test_two_origins_are_none() -> None:
    headers = Headers(
        [("Host", "localhost"), ("Origin", "http://localhost"), ("Origin", "http://evil.example")]
    )
    assert "twice" in (foreign(headers, frozenset({"localhost"})) or "")


def test_no_more_clients_than_there_is_room_for() -> None:
    server = WebServer("127.0.0.1", 0, clients=1)
    with joined(server):
        with pytest.raises(InvalidStatus) as refused:
            connect(f"ws://127.0.0.1:{server.port}/hands", open_timeout=WAIT_S)
        assert refused.value.response.status_code == 503
    server.close()


def test_junk_ends_its_own_connection_only(server: WebServer) -> None:
    with joined(server) as client:
        with socket.create_connection(("127.0.0.1", server.port), timeout=WAIT_S) as junk:
            junk.sendall(os.urandom(300) + b"\r\n\r\n")
            while junk.recv(4096):
                pass
        server.offer("hand a", b"{}")
        assert client.recv(WAIT_S) == "{}"


def test_files_come_with_their_type_and_a_policy_that_lets_nothing_out(server: WebServer) -> None:
    for path in static_dir().iterdir():
        answer = got(server, f"/{path.name}")
        assert (answer.status, answer.read()) == (200, path.read_bytes())
        assert "default-src 'self'" in answer.headers["Content-Security-Policy"]
    page = got(server, "/")
    assert page.headers["Content-Type"] == "text/html; charset=utf-8"
    assert page.read() == (static_dir() / "index.html").read_bytes()
    assert got(server, "/hand.js").headers["Content-Type"].startswith("text/javascript")
    assert got(server, "/three.js").read() == three_js_path().read_bytes()
    for path in ("/server.py", "/../server.py", "/..%2fserver.py", "/static/hand.js"):
        assert got(server, path).status == 404
    assert got(server, "/", host="evil.example").status == 403


def test_three_js_has_what_the_hand_imports() -> None:
    text = three_js_path().read_text()
    exported = text[text.rindex("export{") :]
    for name in ("THREE", "OrbitControls"):
        assert re.search(rf"\b{name}\b", exported)


def test_an_address_that_is_taken_is_reported_with_the_key_to_change(server: WebServer) -> None:
    with pytest.raises(PhalanxError, match=r"web\.port"):
        WebServer("127.0.0.1", server.port)


def test_without_nicegui_it_says_so(monkeypatch: pytest.MonkeyPatch) -> None:

    def nowhere(name: str) -> None:
        return None

    monkeypatch.setattr("master.outputs.web.find_spec", nowhere)
    with pytest.raises(PhalanxError, match="NiceGUI, which is not installed"):
        WebServer("127.0.0.1", 0)
