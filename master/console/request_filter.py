"""Filter for who may talk to the console.

Only pages that it served itself, under the name it is reached by, may do so.

A page of another site, open in the same browser, could otherwise open a web socket to this one (browsers send those
across origins), show it in a frame and steal a click, or reach it under a name of its own that it lets point here (DNS
rebinding). Where there is no login, another user of the same machine is refused as well: `same_user`.
"""

from collections.abc import Callable, Collection, MutableMapping
from ipaddress import ip_address
from typing import Any
from urllib.parse import urlsplit

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from master.outputs.web.listening import machine_names

LOOPBACK = frozenset({"127.0.0.1", "localhost", "[::1]"})
ANYWHERE = frozenset({"0.0.0.0", "::"})
Peer = tuple[str, int]
_NO = b"refused: this console answers only to its own pages\n"
_NOT_YOU = (
    b"refused: this console belongs to another user of this machine, and has no password\n"
    b"(its owner can start it with --password-file)\n"
)
_FRAMES = ((b"x-frame-options", b"DENY"), (b"x-content-type-options", b"nosniff"))
_NO_FRAMES = (b"content-security-policy", b"frame-ancestors 'none'")


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
        """Guard `app`.

        Args:
            app: What is guarded.
            allowed: Names under which it is reached.
            same_user: Whether the two ends of a connection (client, server) belong to one user; None: not asked.
        """
        self._app, self._allowed, self._same_user = app, frozenset(allowed), same_user

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or refuse it."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        words = (b"host", b"origin", b"sec-fetch-site", b"sec-fetch-mode")
        host, origin, site, mode = (_header(scope, word) for word in words)
        if refusal(host, origin, self._allowed, site, mode) is not None:
            await _refuse(scope, send, _NO)
        elif self._same_user is not None and not self._same_user(
            _peer(scope, "client"), _peer(scope, "server")
        ):
            await _refuse(scope, send, _NOT_YOU)
        else:
            await self._app(scope, receive, _unframed(send) if scope["type"] == "http" else send)


def _unframed(send: Send) -> Send:
    async def send_unframed(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = list(message.get("headers", ()))
            have = {name.lower() for name, _ in headers}
            headers += [one for one in (*_FRAMES, _NO_FRAMES) if one[0] not in have]
            message = {**message, "headers": headers}
        await send(message)

    return send_unframed


async def _refuse(scope: Scope, send: Send, why: bytes) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": 1008})
        return
    await send({"type": "http.response.start", "status": 403, "headers": [(b"content-type", b"text/plain")]})
    await send({"type": "http.response.body", "body": why})


def _is_address(name: str) -> bool:
    try:
        ip_address(name.strip("[]"))
    except ValueError:
        return False
    return True


def _peer(scope: MutableMapping[str, Any], side: str) -> Peer:
    found = scope.get(side) or ("", 0)
    return str(found[0]), int(found[1] or 0)


def _header(scope: MutableMapping[str, Any], name: bytes) -> str | None:
    found = [value for key, value in scope["headers"] if key == name]
    return found[0].decode("latin-1") if found else None
