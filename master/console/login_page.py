"""Login page of the console.

Nothing behind it is answered before somebody has logged in, and everything ends with the session.

It stands before everything that the console serves: pages, NiceGUI's own socket and files, our sockets, downloads. Only
the page of the login itself is open. A socket ends when its session does, also while nothing is sent on it.
"""

import asyncio
import base64
import hashlib
import html
import time
from collections.abc import Callable, Collection
from contextlib import suppress
from pathlib import Path
from string import Template
from urllib.parse import parse_qs, quote

from starlette.requests import ClientDisconnect, HTTPConnection, Request
from starlette.responses import HTMLResponse, PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from master.console.login import MOST_BYTES, PasswordHash
from master.console.login_sessions import Backoff, Session, Sessions

LOGIN, LOGOUT = "/login", "/logout"
_FOLDER = Path(__file__).parent / "static"
_HEADERS = {
    "Cache-Control": "no-store",
    "Referrer-Policy": "same-origin",
    "X-Content-Type-Options": "nosniff",
}


class LoginRequired:
    """ASGI middleware that admits only logged-in browsers.

    It holds sessions and failed tries.
    """

    def __init__(
        self,
        app: ASGIApp,
        password: PasswordHash,
        cookie: str,
        secure: bool,
        pages: Collection[str] = (),
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Stand before `app`.

        Args:
            app: What is behind the door.
            password: Who knows it may come in.
            cookie: Name of the session's cookie. Cookies know no port: two consoles of a machine need two names.
            secure: Whether the page is served by TLS: the cookie then never leaves without it.
            pages: Paths that one may be led to after the login; others lead to the first page.
            clock: Seconds.
        """
        self._app, self._password, self._clock = app, password, clock
        self._cookie = f"__Host-{cookie}" if secure else cookie
        self._secure, self._pages = secure, frozenset(pages)
        self._sessions, self._backoff = Sessions(), Backoff()
        self._checking, self._waiting = asyncio.Lock(), 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer the door, or pass on what belongs to a session."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        token = HTTPConnection(scope).cookies.get(self._cookie, "")
        session = self._sessions.find(token, self._clock()) if token else None
        if scope["type"] == "websocket":
            if session is None:
                await send({"type": "websocket.close", "code": 1008})
            else:
                await self._socket(session, scope, receive, send)
        elif scope["path"] in (LOGIN, LOGOUT) or session is None:
            answer = await self._login(Request(scope, receive), token, session)
            await answer(scope, receive, send)
        else:
            await self._app(scope, receive, send)

    async def _login(self, request: Request, token: str, session: Session | None) -> Response:
        path, method = request.url.path, request.method
        if path == LOGIN and method == "POST":
            return await self._try(request)
        if path == LOGIN and method in ("GET", "HEAD"):
            return login_page(self._next(request)) if session is None else _to(self._next(request))
        if path == LOGOUT and method == "POST":
            self._sessions.end(token)
            answer = _to(LOGIN)
            answer.delete_cookie(self._cookie, secure=self._secure, httponly=True, samesite="strict")
            return answer
        if path in (LOGIN, LOGOUT):
            return PlainTextResponse("POST it\n", 405, _HEADERS)
        if method == "GET" and (path in self._pages or path == "/"):
            return _to(LOGIN if path == "/" else f"{LOGIN}?next={quote(path, safe='/')}")
        return PlainTextResponse("log in first\n", 401, _HEADERS)

    async def _try(self, request: Request) -> Response:
        address = request.client.host if request.client is not None else ""
        goal = self._next(request)
        password = await _password(request)
        if password is None:
            return login_page(goal, "That was no password.", 400)
        if (wait_s := self._backoff.wait_s(address, self._clock())) > 0.0:
            return _later(goal, wait_s)
        busy = 4  # passwords that wait to be checked; one is at a time, as each takes 32 MiB
        if self._waiting >= busy:
            return _later(goal, 1.0)
        self._waiting += 1
        try:
            async with self._checking:
                # Tries that came at once are counted one after the other.
                if (wait_s := self._backoff.wait_s(address, self._clock())) > 0.0:
                    return _later(goal, wait_s)
                fits = await asyncio.to_thread(self._password.fits, password)
                if not fits:
                    self._backoff.failed(address, self._clock())
                    return login_page(goal, "This is not the password.", 403)
        finally:
            self._waiting -= 1
        self._backoff.passed(address)
        answer = _to(goal)
        answer.set_cookie(
            self._cookie,
            self._sessions.begin(self._clock()),
            httponly=True,
            samesite="strict",
            secure=self._secure,
            path="/",
        )
        return answer

    async def _socket(self, session: Session, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a socket on until its session ends.

        The handler then receives a disconnect, as if the browser had gone.
        """
        ended = asyncio.ensure_future(_end(session, self._clock()))

        async def receive_or_end() -> Message:
            receiving = asyncio.ensure_future(receive())
            try:
                await asyncio.wait((receiving, ended), return_when=asyncio.FIRST_COMPLETED)
                if ended.done():
                    return {"type": "websocket.disconnect", "code": 1008}
                return receiving.result()
            finally:
                receiving.cancel()

        try:
            await self._app(scope, receive_or_end, send)
            if ended.done():
                with suppress(RuntimeError, OSError):  # closed already
                    await send({"type": "websocket.close", "code": 1008})
        finally:
            ended.cancel()

    def _next(self, request: Request) -> str:
        """Where to after the login: a page of ours by its path, nothing else."""
        wanted = request.query_params.get("next", "/")
        return wanted if wanted in self._pages else "/"


async def _end(session: Session, now_s: float) -> None:
    with suppress(TimeoutError):
        async with asyncio.timeout(max(0.0, session.until_s - now_s)):
            await session.ended.wait()


async def _password(request: Request) -> str | None:
    """Return the password from the form, or None.

    None means that the form holds nothing, too much, something else, or arrives too slowly.
    """
    body = b""
    try:
        body_s = 10.0
        async with asyncio.timeout(body_s):
            async for part in request.stream():
                body += part
                if len(body) > MOST_BYTES:
                    return None
        return parse_qs(body.decode("ascii"), strict_parsing=True, max_num_fields=2)["password"][0]
    except (TimeoutError, ClientDisconnect, ValueError, KeyError):
        return None


def login_page(goal: str, trouble: str = "", status: int = 200) -> HTMLResponse:
    """The page with its form, which leads to `goal`; one file, without a script."""
    style = (_FOLDER / "login.css").read_text(encoding="utf-8")
    fields = {
        "style": style,
        "action": html.escape(LOGIN if goal == "/" else f"{LOGIN}?next={quote(goal, safe='/')}"),
        "trouble": html.escape(trouble),
        "invalid": ' aria-invalid="true" aria-describedby="trouble"' if trouble else "",
    }
    # Only this very style may be used, and the form leads nowhere else.
    digest = base64.b64encode(hashlib.sha256(style.encode()).digest()).decode()
    policy = f"default-src 'none'; style-src 'sha256-{digest}'; form-action 'self'"
    policy += "; frame-ancestors 'none'; base-uri 'none'"
    text = Template((_FOLDER / "login.html").read_text(encoding="utf-8")).substitute(fields)
    return HTMLResponse(text, status, _HEADERS | {"Content-Security-Policy": policy})


def _later(goal: str, wait_s: float) -> Response:
    seconds = max(1, round(wait_s + 0.5))
    answer = login_page(goal, f"Too many wrong passwords. Try again in {seconds} s.", 429)
    answer.headers["Retry-After"] = str(seconds)
    return answer


def _to(path: str) -> Response:
    return RedirectResponse(path, 303, _HEADERS)
