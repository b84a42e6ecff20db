"""Web server of the console: uvicorn with limits on connections.

The limits apply to whoever connects and does not, or not yet, send requests like a browser.

uvicorn by itself waits for ever for a request that never comes or never ends, keeps headers however many there are, and
gives TLS a minute. An unknown sender would hold every place, or all memory, without a password.
"""

import asyncio
import functools
import socket
import ssl
from typing import Any, cast

import uvicorn
from fastapi import FastAPI
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

MOST_CONNECTIONS = 256  # a page has about ten; whoever opens more finds a 503, and takes no more of us
MOST_OF_ONE = 128  # of one address: the other half is left for others
OPEN_S = 5.0  # from a connection, or the first byte of a request, to the end of its headers; and for TLS before that
MOST_HEAD_BYTES = 64 * 1024  # of the address that is asked for, and all headers


class BoundedHttp(HttpToolsProtocol):
    """One connection, with a deadline and the size of the request head so far.

    It holds these besides what uvicorn holds.
    """

    _deadline: asyncio.TimerHandle | None = None
    _head_bytes = 0

    def connection_made(self, transport: asyncio.Transport) -> None:
        """Start to wait for a request.

        A connection is aborted if its address already has half of all places.
        """
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
