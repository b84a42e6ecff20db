"""Who may talk to the console: pages that it served itself, under the name it is reached by. Nobody else's.

A page of another site, open in the same browser, could otherwise open a web socket to this one (browsers send those
across origins), or reach it under a name of its own that it lets point here (DNS rebinding).
"""

from collections.abc import Collection, MutableMapping
from typing import Any
from urllib.parse import urlsplit

from starlette.types import ASGIApp, Receive, Scope, Send

LOOPBACK = frozenset({"127.0.0.1", "localhost", "[::1]"})
ANYWHERE = frozenset({"0.0.0.0", "::"})
_NO = b"refused: this console answers only to its own pages\n"


def refusal(host: str | None, origin: str | None, allowed: Collection[str]) -> str | None:
    """Why a request is refused, or None.

    Args:
        host: Header Host.
        origin: Header Origin; browsers send it with every web socket and whatever changes something.
        allowed: Names under which the console is reached; empty: any.
    """
    if host is None:
        return "no Host header"
    name = host.rsplit(":", 1)[0] if not host.endswith("]") else host
    if allowed and name.lower() not in allowed:
        return f"reached as {name}"
    if origin is not None and urlsplit(origin).netloc.lower() != host.lower():
        return f"asked for by a page of {origin}"
    return None


def names_of(host: str) -> frozenset[str]:
    """Names under which a console that listens on `host` is reached; empty: any, as it listens everywhere."""
    if host in ANYWHERE:
        return frozenset()
    return LOOPBACK | {f"[{host}]" if ":" in host else host.lower()}


class OwnPagesOnly:
    """ASGI middleware that lets only requests through which `refusal` finds nothing against."""

    def __init__(self, app: ASGIApp, allowed: Collection[str]) -> None:
        """Guard `app`, which is reached under the names `allowed`."""
        self._app, self._allowed = app, frozenset(allowed)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or refuse it."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        if refusal(_header(scope, b"host"), _header(scope, b"origin"), self._allowed) is None:
            await self._app(scope, receive, send)
        elif scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008})
        else:
            await send(
                {"type": "http.response.start", "status": 403, "headers": [(b"content-type", b"text/plain")]}
            )
            await send({"type": "http.response.body", "body": _NO})


def _header(scope: MutableMapping[str, Any], name: bytes) -> str | None:
    found = [value for key, value in scope["headers"] if key == name]
    return found[0].decode("latin-1") if found else None
