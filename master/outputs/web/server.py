"""The server sends hands and pages to browsers.

The page by HTTP; hands and objects as JSON by WebSocket at /hands. One thread with one event loop, whatever
the number of clients. Each client has room for the newest text of each key (a hand, an object): who reads too
slowly skips, delays nobody, and costs no memory.

A browser lets any page of any site open a WebSocket to this machine, so a request whose `Origin` is not this
very server is refused, and so is one that calls this server by a foreign name (a site may point its own name
at 127.0.0.1). On this machine it is plain. Where other machines reach it, it wants to be shown a key, and is
encrypted by the certificate of this machine's pages unless --open is given (`RequestFilter`,
docs/security.md).
"""

import asyncio
import hmac
import logging
import os
import secrets
import socket
import ssl
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from http import HTTPStatus
from ipaddress import ip_address
from typing import Final
from urllib.parse import parse_qs, urlsplit

import msgspec
from websockets.asyncio.server import ServerConnection, serve
from websockets.datastructures import Headers, MultipleValuesError
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from common.calibration.output_settings import WebOutput
from common.errors import PhalanxError
from common.messages import HandPose, ObjectPose, ResultMessage
from master.outputs.web import object_json, static_dir, three_js_path, webxr_json
from master.outputs.web.listening import (
    is_loopback,
    is_open,
    machine_names,
    page_certificate,
    places_of,
    private_folder,
    read_private,
    write_private,
)

PATH: Final = "/hands"
CLIENTS = 16
SEND_BUFFER_BYTES = 32 * 1024  # about five poses: what lies in the system's buffer is old when it is read
OPEN_S = 5.0  # for who connects to state what is wanted; so long a sender of nothing keeps a connection
_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}
_HEADERS = {
    "Cache-Control": "no-cache",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    # The browser itself refuses whatever would leave this server.
    "Content-Security-Policy": "default-src 'self'; img-src 'self' data:; object-src 'none'; base-uri 'none'",
}


@dataclass(frozen=True, slots=True)
class RequestFilter:
    """What stands before a server that other machines reach."""

    # has to be shown, as `?key=…` or by the cookie that the page then has; None: nobody is asked
    key: str | None = None
    tls: ssl.SSLContext | None = None  # None: plain


class Mailbox:
    """What one client has not been sent yet: the newest text of each key."""

    def __init__(self) -> None:
        self.skipped = 0  # texts that a newer one of the same key replaced before they were sent
        self._newest: dict[str, bytes] = {}
        self._filled = asyncio.Event()

    def put(self, texts: dict[str, bytes]) -> None:
        """Leave these here; older ones of the same keys go."""
        self.skipped += len(self._newest.keys() & texts.keys())
        self._newest |= texts
        self._filled.set()

    async def take(self) -> list[bytes]:
        """Wait until something is here, and take it all."""
        await self._filled.wait()
        self._filled.clear()
        texts, self._newest = self._newest, {}
        return list(texts.values())


class WebServer:
    """Serves until it is closed."""

    def __init__(
        self, host: str, port: int, *, clients: int = CLIENTS, request_filter: RequestFilter | None = None
    ) -> None:
        """Listen at once, behind the filter; `port` 0 takes any that is free.

        Raises:
            PhalanxError: The address cannot be had, or three.js is not installed.
        """
        self._files = _files()
        self._clients, self._request_filter = clients, request_filter or RequestFilter()
        self._mailboxes: dict[ServerConnection, Mailbox] = {}
        names = machine_names() | {host.lower()}
        self._names = frozenset(name for name in names if name and not _is_address(name))
        self._lock = threading.Lock()
        self._newest: dict[str, bytes] = {}
        self._skipped = 0
        self._socket = _listening(host, port)
        self._loop = asyncio.new_event_loop()
        self._stopping = asyncio.Event()
        self._thread = threading.Thread(
            target=lambda: self._loop.run_until_complete(self._serve()), name="web", daemon=True
        )
        self._thread.start()

    @property
    def port(self) -> int:
        """The port it listens at."""
        return int(self._socket.getsockname()[1])

    @property
    def clients(self) -> int:
        """How many are connected."""
        return len(self._mailboxes)

    @property
    def skipped(self) -> int:
        """Texts that were not sent to some client because a newer one had come."""
        return self._skipped + sum(mailbox.skipped for mailbox in list(self._mailboxes.values()))

    def offer(self, key: str, text: bytes) -> None:
        """Send JSON to every client without waiting; a newer text of `key` replaces it.

        Raises:
            PhalanxError: The server has ended.
        """
        with self._lock:
            first = not self._newest
            self._newest[key] = text
        if not first:
            return  # the loop has been notified already, and takes this one with it
        try:
            self._loop.call_soon_threadsafe(self._deliver)
        except RuntimeError as error:
            raise PhalanxError("the web server has ended") from error

    def close(self) -> None:
        """End all connections and the thread, and free the port. Safe to call twice."""
        if self._loop.is_closed():
            return
        self._loop.call_soon_threadsafe(self._stopping.set)
        join_s = 3.0
        self._thread.join(join_s)
        if not self._thread.is_alive():
            self._socket.close()
            self._loop.close()

    async def _serve(self) -> None:
        quiet = logging.getLogger(f"{__name__}.connections")
        quiet.setLevel(logging.CRITICAL)  # junk from a port scan is no news
        # the longest text of a client; one that begins with "ping" comes back, the rest is ignored
        echo_bytes = 256
        ping_s, silent_s = 10.0, 20.0
        async with serve(
            self._client,
            sock=self._socket,
            ssl=self._request_filter.tls,
            ssl_handshake_timeout=None if self._request_filter.tls is None else OPEN_S,
            open_timeout=OPEN_S,
            process_request=self._answer,
            compression=None,  # it costs more than it saves on the machine itself
            max_size=echo_bytes,
            write_limit=SEND_BUFFER_BYTES,
            ping_interval=ping_s,
            ping_timeout=silent_s,
            close_timeout=1.0,
            server_header=None,
            logger=quiet,
        ):
            await self._stopping.wait()

    def _deliver(self) -> None:
        """On the loop: put what was offered into every mailbox."""
        with self._lock:
            texts, self._newest = self._newest, {}
        for mailbox in self._mailboxes.values():
            mailbox.put(texts)

    async def _client(self, connection: ServerConnection) -> None:
        """Serve one client until it disconnects; disconnect it where there is no room."""
        if len(self._mailboxes) >= self._clients:
            await connection.close(1013, f"{self._clients} clients are connected already")
            return
        mailbox = self._mailboxes[connection] = Mailbox()
        sending = asyncio.create_task(_send(connection, mailbox))
        try:
            async for text in connection:
                if isinstance(text, str) and text.startswith("ping"):
                    await connection.send(msgspec.json.encode({"type": "pong", "ping": text}), text=True)
        except ConnectionClosed:
            pass
        finally:
            sending.cancel()
            del self._mailboxes[connection]
            self._skipped += mailbox.skipped

    def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """The HTTP answer, or None where the request opens a WebSocket that is welcome."""
        path = urlsplit(request.path).path
        if (trouble := foreign(request.headers, self._names)) is not None:
            return _refusal(HTTPStatus.FORBIDDEN, trouble)
        if not self._knows(request):
            return _refusal(
                HTTPStatus.UNAUTHORIZED, "open the address with ?key= that `phalanx send` printed"
            )
        if path in self._files:
            kind, body = self._files[path]
            answer = _response(HTTPStatus.OK, kind, body)
            if self._request_filter.key is not None:
                cookie_s = 30 * 24 * 3600
                answer.headers["Set-Cookie"] = (
                    f"{self._name()}={self._request_filter.key}; Path=/; Max-Age={cookie_s}; HttpOnly; SameSite=Strict"
                    f"{'' if self._request_filter.tls is None else '; Secure'}"
                )
            return answer
        if path != PATH:
            return _refusal(HTTPStatus.NOT_FOUND, f"{path}: there are {', '.join([*self._files, PATH])}")
        if len(self._mailboxes) >= self._clients:
            return _refusal(HTTPStatus.SERVICE_UNAVAILABLE, f"{self._clients} clients are connected already")
        return None

    def _knows(self, request: Request) -> bool:
        """Whether the request shows the key, where there is one."""
        if self._request_filter.key is None:
            return True
        shown = parse_qs(urlsplit(request.path).query).get("key", [])
        for value in request.headers.get_all("Cookie"):
            shown += [
                one.partition("=")[2] for one in value.split("; ") if one.startswith(f"{self._name()}=")
            ]
        return any(hmac.compare_digest(one.encode(), self._request_filter.key.encode()) for one in shown)

    def _name(self) -> str:
        return f"phalanx-hands-{self.port}"  # cookies know no port


async def _send(connection: ServerConnection, mailbox: Mailbox) -> None:
    """Send a mailbox, which keeps the newest text while the client does not read."""
    try:
        while True:
            for text in await mailbox.take():
                await connection.send(text, text=True)
    except ConnectionClosed:
        return


def foreign(headers: Headers, own_names: frozenset[str]) -> str | None:
    """Return why a request comes from a foreign web page; None: it does not."""
    try:
        host, origin = headers.get("Host", ""), headers.get("Origin")
    except MultipleValuesError:
        return "Host or Origin: given twice"
    name = urlsplit(f"//{host}").hostname or ""
    if not (name in own_names or _is_address(name)):
        return f"Host {host!r}: call this server by its address or one of {', '.join(sorted(own_names))}"
    if origin is not None and origin.lower() not in (f"http://{host}".lower(), f"https://{host}".lower()):
        return f"Origin {origin!r}: pages of other servers may not read hands from here"
    return None


def _is_address(name: str) -> bool:
    try:
        ip_address(name)
    except ValueError:
        return False
    return True


def _listening(host: str, port: int) -> socket.socket:
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listening = socket.create_server(address[:2], family=family)
    except OSError as error:
        raise PhalanxError(
            f"web: cannot listen at {host}:{port}: {error.strerror}; is another program there?"
            " Choose another `web.port` or `web.host` in the outputs file"
        ) from error
    # Connections inherit it: a client that stalls is not sent seconds of the past when it reads on.
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
    return listening


def _files() -> dict[str, tuple[str, bytes]]:
    """Path -> type and content of every file of the page."""
    files = {
        f"/{path.name}": (_TYPES[path.suffix], path.read_bytes())
        for path in sorted(static_dir().iterdir())
        if path.suffix in _TYPES
    }
    files["/three.js"] = (_TYPES[".js"], three_js_path().read_bytes())
    files["/"] = files["/index.html"]
    return files


def _response(status: HTTPStatus, kind: str, body: bytes) -> Response:
    headers = Headers(
        {"Content-Type": kind, "Content-Length": str(len(body)), "Connection": "close"} | _HEADERS
    )
    return Response(status.value, status.phrase, headers, body)


def _refusal(status: HTTPStatus, why: str) -> Response:
    return _response(status, "text/plain; charset=utf-8", f"{why}\n".encode())


KEY_FILE = "web.key"


def request_filter_of(settings: WebOutput, environment: Mapping[str, str]) -> RequestFilter:
    """Filter of a page: none on this machine, key and TLS elsewhere; PhalanxError."""
    if is_loopback(settings.host):
        return RequestFilter()
    folder = private_folder(environment)
    key_bytes = 10  # 80 bits: who guesses has to ask us each time
    if not (folder / KEY_FILE).exists():
        write_private(folder / KEY_FILE, secrets.token_hex(key_bytes).encode())
    key = read_private(folder / KEY_FILE).decode("ascii", "replace").strip()
    if len(key) < 2 * key_bytes or not key.isalnum():
        raise PhalanxError(f"{folder / KEY_FILE}: not a key; delete it, and a new one is made")
    tls = None if is_open(environment) else page_certificate(folder, settings.host).context
    return RequestFilter(key, tls)


def address_of(settings: WebOutput, environment: Mapping[str, str]) -> str:
    """What to open in a browser, by blanks: with the key, where one is needed."""
    request_filter = request_filter_of(settings, environment)
    asked = "" if request_filter.key is None else f"?key={request_filter.key}"
    scheme = "http" if request_filter.tls is None else "https"
    return " ".join(f"{scheme}://{place}:{settings.port}/{asked}" for place in places_of(settings.host))


class WebSink:
    """A `Sink` for browsers."""

    def __init__(self, settings: WebOutput, environment: Mapping[str, str] | None = None) -> None:
        """Listen at the address of the settings; PhalanxError as `WebServer`."""
        request_filter = request_filter_of(settings, os.environ if environment is None else environment)
        self.server = WebServer(settings.host, settings.port, request_filter=request_filter)

    def write(self, message: ResultMessage) -> None:
        """Offer a hand or an object to every client; other messages are ignored."""
        if self.server.clients == 0:
            return
        if isinstance(message, HandPose):
            self.server.offer(f"hand {message.hand}", webxr_json(message))
        elif isinstance(message, ObjectPose):
            self.server.offer(f"object {message.object}", object_json(message))

    def close(self) -> None:
        """End all connections and free the port. Safe to call twice."""
        self.server.close()
