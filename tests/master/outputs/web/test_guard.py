"""The server where other machines reach it: encrypted, and silent to whoever does not show the key."""

import http.client
import json
import socket
import ssl
import stat
import time
from datetime import UTC, datetime, timedelta
from http.cookies import SimpleCookie
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import serialization
from websockets.exceptions import InvalidMessage, InvalidStatus
from websockets.sync.client import connect

from common.calibration.output_settings import LslOutput, OscOutput, OutputSettings, WebOutput
from common.errors import PhalanxError
from master.outputs.network.outputs import who_reads
from master.outputs.web.listening import is_loopback, page_certificate
from master.outputs.web.server import KEY_FILE, WebSink, address_of, request_filter_of
from tests.master.outputs.network.hands import hand_pose

WAIT_S = 60.0
EVERYWHERE = WebOutput(host="0.0.0.0", port=0)


def trusting(folder: Path) -> ssl.SSLContext:
    """A client that trusts the page's certificate and nothing else, and checks the name."""
    pem = x509.load_pem_x509_certificate((folder / "page.pem").read_bytes())
    return ssl.create_default_context(cadata=pem.public_bytes(_PEM).decode())


_PEM = serialization.Encoding.PEM


def test_who_shows_the_key_is_served_by_tls_and_nobody_else(tmp_path: Path) -> None:
    environment = {"XDG_CONFIG_HOME": str(tmp_path)}
    sink = WebSink(EVERYWHERE, environment)
    folder, port = tmp_path / "phalanx", sink.server.port
    address = address_of(EVERYWHERE, environment)
    key = (folder / KEY_FILE).read_text()
    assert address.split()[-1] == f"https://127.0.0.1:0/?key={key}"
    assert "0.0.0.0" not in address  # which no browser opens
    assert request_filter_of(EVERYWHERE, environment).key == key, "the same after a restart"
    assert stat.S_IMODE((folder / KEY_FILE).stat().st_mode) == 0o600
    tls = trusting(folder)

    def got(path: str, cookie: str = "") -> http.client.HTTPResponse:
        connection = http.client.HTTPSConnection("127.0.0.1", port, timeout=WAIT_S, context=tls)
        connection.request("GET", path, headers={"Cookie": cookie} if cookie else {})
        return connection.getresponse()

    try:
        for path in (
            "/",
            "/page.js",
            "/three.js",
            "/nowhere",
            "/hands",
            "/?key=",
            "/?key=0",
            f"/?key={key[:-1]}",
            "/?key=%C3%A9",
        ):
            assert got(path).status == 401, path
        opened = got(f"/?key={key}")
        assert opened.status == 200
        output = opened.headers["Set-Cookie"]
        assert {"HttpOnly", "Secure", "SameSite=Strict"} <= set(output.split("; "))
        ((name, morsel),) = SimpleCookie(output).items()
        assert got("/page.js", f"a=b; {name}={morsel.value}").status == 200
        assert got("/page.js", f"{name}=x").status == 401
        # The server hangs up behind its 401, which a client that is slow to read may lose.
        with pytest.raises((InvalidStatus, InvalidMessage), match=r"401|did not receive"):
            connect(f"wss://127.0.0.1:{port}/hands", ssl=tls, open_timeout=WAIT_S)
        with connect(f"wss://127.0.0.1:{port}/hands?key={key}", ssl=tls, open_timeout=WAIT_S) as client:
            while sink.server.clients == 0:
                time.sleep(0.005)
            sink.write(hand_pose("right"))
            assert json.loads(client.recv(WAIT_S))["hand"] == "my-right"
        with socket.create_connection(("127.0.0.1", port), timeout=WAIT_S) as plain:
            plain.sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
            assert b"Phalanx" not in plain.recv(4096), "without encryption there is no answer"
    finally:
        sink.close()


def test_here_nobody_is_asked_and_open_asks_for_the_key_alone(tmp_path: Path) -> None:
    environment = {"XDG_CONFIG_HOME": str(tmp_path)}
    assert address_of(WebOutput(), environment) == "http://127.0.0.1:8765/"
    assert not (tmp_path / "phalanx").exists()
    plain = request_filter_of(EVERYWHERE, environment | {"PHALANX_OPEN": "1"})
    assert plain.tls is None
    assert plain.key is not None


@pytest.mark.parametrize("text", ["", "abc", "0123456789abcdef0123\r\nSet-Cookie: x"])
def test_a_broken_key_opens_nothing(tmp_path: Path, text: str) -> None:
    folder = tmp_path / "phalanx"
    folder.mkdir()
    (folder / KEY_FILE).touch(mode=0o600)
    (folder / KEY_FILE).write_text(text)
    with pytest.raises(PhalanxError, match="not a key"):
        request_filter_of(EVERYWHERE, {"XDG_CONFIG_HOME": str(tmp_path)})


def test_a_certificate_is_kept_until_it_ends_or_another_address_is_served(tmp_path: Path) -> None:
    now = datetime(2026, 1, 1, tzinfo=UTC)
    first = page_certificate(tmp_path, "0.0.0.0", now).fingerprint
    assert page_certificate(tmp_path, "0.0.0.0", now + timedelta(days=300)).fingerprint == first
    other = page_certificate(tmp_path, "192.0.2.1", now).fingerprint
    assert other != first
    assert page_certificate(tmp_path, "0.0.0.0", now).fingerprint == other
    assert page_certificate(tmp_path, "0.0.0.0", now + timedelta(days=390)).fingerprint != other
    path = tmp_path / "page.pem"
    made = x509.load_pem_x509_certificate(path.read_bytes())
    assert not made.extensions.get_extension_for_class(x509.BasicConstraints).value.ca, "it signs nobody"
    path.chmod(0o644)
    with pytest.raises(PhalanxError, match="others can read"):
        page_certificate(tmp_path, "0.0.0.0", now)
    path.chmod(0o600)
    path.write_text("junk")
    with pytest.raises(PhalanxError, match="delete it"):
        page_certificate(tmp_path, "0.0.0.0", now)


@pytest.mark.parametrize(
    ("host", "here"),
    [("127.0.0.1", True), ("127.3.2.1", True), ("::1", True), ("localhost", True), ("0.0.0.0", False), ("::", False),
     ("192.168.1.2", False), ("localhost.evil.example", False), ("", False)],
)  # fmt: skip
def test_only_loopback_stays_on_this_machine(host: str, here: bool) -> None:
    assert is_loopback(host) == here


def test_what_leaves_the_machine_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("PHALANX_OPEN", raising=False)
    here = OutputSettings(version=1, name="x")
    assert [who_reads(name, here) for name in ("osc", "vmc", "ros2", "lsl", "web")] == [None] * 5
    away = OutputSettings(
        version=1,
        name="x",
        osc=OscOutput(host="192.0.2.1"),
        lsl=LslOutput(scope="network"),
        web=WebOutput(host="0.0.0.0"),
    )
    assert "unencrypted" in (who_reads("osc", away) or "")
    assert "unencrypted" in (who_reads("lsl", away) or "")
    assert "whoever has the key" in (who_reads("web", away) or "")
    monkeypatch.setenv("PHALANX_OPEN", "1")
    assert "--open" in (who_reads("web", away) or "")
