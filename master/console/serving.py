"""Web server limits connections and refuses requests of other sites.

uvicorn by itself waits for ever for a request that never comes or never ends, keeps headers however many
there are, and gives TLS a minute: an unknown sender would hold every place, or all memory, without a
password. A page of another site, open in the same browser, could open a web socket to this one (browsers send
those across origins), show it in a frame and steal a click, or reach it under a name of its own that it lets
point here (DNS rebinding). Where there is no login, another user of the same machine is refused as well:
`same_user`, by /proc/net.
"""

import asyncio
import functools
import os
import socket
import ssl
import sys
from collections.abc import Callable, Collection, MutableMapping
from ipaddress import IPv4Address, IPv6Address, ip_address
from pathlib import Path
from typing import Any, cast
from urllib.parse import urlsplit

import uvicorn
from fastapi import FastAPI
from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocketClose
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from master.outputs.web.listening import machine_names

MOST_CONNECTIONS = 256  # a page has about ten; whoever opens more finds a 503, and takes no more of us
MOST_OF_ONE = 128  # of one address: the other half is left for others
OPEN_S = 5.0  # from a connection, or the first byte of a request, to the end of its headers; and for TLS before that
MOST_HEAD_BYTES = 64 * 1024  # of the address that is asked for, and all headers


class BoundedHttp(HttpToolsProtocol):
    """One connection of uvicorn, with a deadline and a size limit for request heads."""

    _deadline: asyncio.TimerHandle | None = None
    _head_bytes = 0

    def connection_made(self, transport: asyncio.Transport) -> None:
        """Wait for a request; aborted if its address already has half of all places."""
        super().connection_made(transport)
        host = self._host(self)
        if sum(self._host(one) == host for one in self.connections) > MOST_OF_ONE:
            transport.abort()
        else:
            self._await_head()

    def connection_lost(self, exc: Exception | None) -> None:
        """Wait no more."""
        self._head_came()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Parse what came, unless it is the head of a request that grows without an end."""
        if not self._in_head and getattr(self.cycle, "response_complete", True):
            self._await_head()
        if self._in_head:  # what comes behind the head, together with it, counts as none of it
            capacity = MOST_HEAD_BYTES - self._head_bytes
            head, data = data[:capacity], data[capacity:]
            self._head_bytes += len(head)
            super().data_received(head)
            if not data or self.transport.is_closing():
                return
            if self._in_head:
                self.transport.abort()
                return
        super().data_received(data)

    def on_headers_complete(self) -> None:
        """A whole head came: all that follows is for who answers it."""
        self._head_came()
        super().on_headers_complete()

    @property
    def _in_head(self) -> bool:
        return self._deadline is not None

    def _await_head(self) -> None:
        self._head_bytes = 0
        self._deadline = self.loop.call_later(OPEN_S, self.transport.abort)

    def _head_came(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None

    @staticmethod
    def _host(one: object) -> str:
        """Address of a connection, also where it is a web socket by now."""
        return str((getattr(one, "client", None) or ("",))[0])


class ConsoleServer(uvicorn.Server):
    """uvicorn that gives TLS no more time than a request."""

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Listen."""
        loop = asyncio.get_running_loop()
        if self.config.ssl is None:
            await super().startup(sockets)
            return
        create = loop.create_server
        hurried = functools.partial(cast(Any, create), ssl_handshake_timeout=OPEN_S)
        setattr(loop, "create_server", hurried)  # noqa: B010  uvicorn has no option for it
        try:
            await super().startup(sockets)
        finally:
            setattr(loop, "create_server", create)  # noqa: B010


def console_server(app: FastAPI, tls: ssl.SSLContext | None) -> ConsoleServer:
    """The server of `app`, not yet running; plain where there is no `tls`."""
    most_message_bytes = 1 << 20  # of a web socket: pages send words, not files
    leave_s = 2  # pages that are open do not keep the console from ending
    config = uvicorn.Config(
        app,
        http=BoundedHttp,
        log_level="error",  # junk of a port scan is no news, and must not fill the disk
        timeout_graceful_shutdown=leave_s,
        access_log=False,
        lifespan="on",
        limit_concurrency=MOST_CONNECTIONS,
        ws_max_size=most_message_bytes,
        proxy_headers=False,  # who asks is who is connected, whatever a header states
    )
    config.load()
    config.ssl = tls
    return ConsoleServer(config)


LOOPBACK = frozenset({"127.0.0.1", "localhost", "[::1]"})
ANYWHERE = frozenset({"0.0.0.0", "::"})
Peer = tuple[str, int]
_NO = "refused: this console answers only to its own pages\n"
_NOT_YOU = (
    "refused: this console belongs to another user of this machine, and has no password\n"
    "(its owner can start it with --password-file)\n"
)
_HEADERS = {
    "x-frame-options": "DENY",
    "x-content-type-options": "nosniff",
    "content-security-policy": "frame-ancestors 'none'",
}


def refusal(
    host: str | None,
    origin: str | None,
    allowed: Collection[str],
    site: str | None = None,
    mode: str | None = None,
) -> str | None:
    """Why a request is refused, or None.

    Args:
        host: Header Host.
        origin: Header Origin; browsers send it with every web socket and whatever changes something.
        allowed: Names under which the console is reached; with one of `ANYWHERE` also every address.
        site: Header Sec-Fetch-Site: whose page asks.
        mode: Header Sec-Fetch-Mode: what for.
    """
    if host is None:
        return "no Host header"
    name = host.rsplit(":", 1)[0] if not host.endswith("]") else host
    if name.lower() not in allowed and not (ANYWHERE & set(allowed) and _is_address(name)):
        return f"reached as {name}"
    if origin is not None and urlsplit(origin).netloc.lower() != host.lower():
        return f"asked for by a page of {origin}"
    if site in ("cross-site", "same-site") and mode != "navigate":
        return "asked for by a page of another server"
    return None


def names_of(host: str) -> frozenset[str]:
    """Names under which a console that listens on `host` is reached."""
    if host in ANYWHERE:
        return LOOPBACK | machine_names() | {host}
    return LOOPBACK | {f"[{host}]" if ":" in host else host.lower()}


class OwnPagesOnly:
    """ASGI middleware that passes only requests to which `refusal` has no objection."""

    def __init__(
        self, app: ASGIApp, allowed: Collection[str], same_user: Callable[[Peer, Peer], bool] | None = None
    ) -> None:
        """Guard `app`, which is reached under the names `allowed`.

        `same_user`: whether the two ends of a connection (client, server) belong to one user; None: not
        asked.
        """
        self._app, self._allowed, self._same_user = app, frozenset(allowed), same_user

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or refuse it."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = Headers(raw=list(scope["headers"]))
        names = ("host", "origin", "sec-fetch-site", "sec-fetch-mode")
        host, origin, site, mode = (headers.get(name) for name in names)
        if refusal(host, origin, self._allowed, site, mode) is not None:
            await _refuse(scope, receive, send, _NO)
        elif self._same_user is not None and not self._same_user(
            _peer(scope, "client"), _peer(scope, "server")
        ):
            await _refuse(scope, receive, send, _NOT_YOU)
        else:
            await self._app(scope, receive, _unframed(send) if scope["type"] == "http" else send)


def _unframed(send: Send) -> Send:
    async def send_unframed(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(raw=list(message.get("headers", ())))
            for name, value in _HEADERS.items():
                headers.setdefault(name, value)
            message = {**message, "headers": headers.raw}
        await send(message)

    return send_unframed


async def _refuse(scope: Scope, receive: Receive, send: Send, why: str) -> None:
    http = scope["type"] == "http"
    answer = PlainTextResponse(why, 403) if http else WebSocketClose(1008)
    await answer(scope, receive, send)


def _is_address(name: str) -> bool:
    try:
        ip_address(name.strip("[]"))
    except ValueError:
        return False
    return True


def _peer(scope: MutableMapping[str, Any], side: str) -> Peer:
    found = scope.get(side) or ("", 0)
    return str(found[0]), int(found[1] or 0)


_WORD = 8  # hexadecimal digits of 32 bits, which the kernel writes in the machine's own byte order


def same_user(client: Peer, server: Peer, net: Path = Path("/proc/net")) -> bool:
    """Return whether the client belongs to this process's user, or to root.

    Both ends as the server sees them; `net` has the kernel's tables of sockets. True where the system has
    none.
    """
    tables = [path for name in ("tcp", "tcp6") if (path := net / name).exists()]
    if not tables:
        return True  # no Linux
    wanted = (_plain(client), _plain(server))
    ports = f":{client[1]:04X} ", f":{server[1]:04X} "  # thousands of lines are looked at quickly by these
    for path in tables:
        for line in path.read_text(encoding="ascii").splitlines()[1:]:
            if ports[0] not in line or ports[1] not in line:
                continue
            fields = line.split()
            if (_socket(fields[1]), _socket(fields[2])) == wanted:
                root = 0
                return int(fields[7]) in (os.getuid(), root)
    return False


def plain_address(text: str) -> IPv4Address | IPv6Address:
    """An address without its zone; one of IPv4 that is mapped into IPv6 as it is.

    Raises:
        ValueError: It is none.
    """
    address = ip_address(text.split("%", 1)[0])
    return (isinstance(address, IPv6Address) and address.ipv4_mapped) or address


def _plain(peer: Peer) -> Peer:
    return str(plain_address(peer[0])), peer[1]


def _socket(text: str) -> Peer:
    """ADDRESS:PORT as the kernel writes it."""
    digits, _, port = text.partition(":")
    words = (digits[k : k + _WORD] for k in range(0, len(digits), _WORD))
    packed = b"".join(int(word, 16).to_bytes(4, sys.byteorder) for word in words)
    return _plain((str(ip_address(packed)), int(port, 16)))
