"""Login checks the password, keeps sessions and limits failed tries.

It is needed wherever the page can be reached from another machine (docs/security.md). The password is kept as
its scrypt hash, slow and large on purpose (a thief of the file tries a dozen passwords a second, not
millions), and compared in constant time. Sessions and failed tries have bounded memory, and receive the time
as an argument. `LoginRequired` stands before everything that the console serves; only the page of the login
is open.
"""

import asyncio
import base64
import hashlib
import hmac
import html
import secrets
import time
from collections import OrderedDict
from collections.abc import Callable, Collection
from contextlib import suppress
from dataclasses import dataclass, field
from ipaddress import IPv6Address, ip_network
from pathlib import Path
from string import Template
from urllib.parse import parse_qs, quote

from starlette.requests import ClientDisconnect, HTTPConnection, Request
from starlette.responses import HTMLResponse, PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from common.errors import PhalanxError
from master.console.serving import plain_address
from master.outputs.web.listening import read_private, write_private

HASH_FILE = "console.password"
MOST_BYTES = 1024
_ALPHABET = "abcdefghijkmnpqrstuvwxyz23456789"  # 32 that are not taken for one another: 5 bits each
_BYTES = 32


@dataclass(frozen=True, slots=True)
class PasswordHash:
    """What is kept of a password: `scrypt`, its cost n, r, p, salt and hash."""

    n: int
    r: int
    p: int
    salt: bytes
    digest: bytes

    @classmethod
    def of(cls, password: str, n: int = 2**15) -> "PasswordHash":
        """Hash a password with a new salt; by default n costs 32 MiB and about 0.1 s."""
        salt = secrets.token_bytes(16)
        r, p = 8, 1
        return cls(n, r, p, salt, _scrypt(password, salt, n, r, p))

    @classmethod
    def parse(cls, text: str, where: str) -> "PasswordHash":
        """Read what `text` wrote.

        Raises:
            PhalanxError: It is something else.
        """
        try:
            kind, n, r, p, salt, digest = text.strip().split("$")
            found = cls(int(n), int(r), int(p), bytes.fromhex(salt), bytes.fromhex(digest))
            if kind != "scrypt" or not 2 <= found.n <= 2**20 or len(found.digest) != _BYTES:
                raise ValueError("another kind of hash")
        except ValueError as error:
            raise PhalanxError(
                f"{where}: not the hash of a password; delete it, and a new one is made"
            ) from error
        return found

    def text(self) -> str:
        """One line for a file."""
        return f"scrypt${self.n}${self.r}${self.p}${self.salt.hex()}${self.digest.hex()}\n"

    def fits(self, password: str) -> bool:
        """Whether this is the password; takes as long for a wrong one."""
        return hmac.compare_digest(_scrypt(password, self.salt, self.n, self.r, self.p), self.digest)


def new_password() -> str:
    """A password of 100 random bits, in groups that can be read aloud."""
    groups, group = 4, 5  # 100 bits
    return "-".join("".join(secrets.choice(_ALPHABET) for _ in range(group)) for _ in range(groups))


def password_from(file: Path) -> PasswordHash:
    """Return the hash of the password in the first line of a file.

    Raises:
        PhalanxError: It cannot be read, others can read it, or the password is too short.
    """
    text = _text(file)
    password = text.splitlines()[0].strip() if text.strip() else ""
    least_characters = 12
    if len(password) < least_characters:
        raise PhalanxError(
            f"{file}: the password needs at least {least_characters} characters in the first line"
        )
    return PasswordHash.of(password)


def kept_password(folder: Path, notify: Callable[[str], None]) -> PasswordHash:
    """Return the hash of the password in a folder; at first made, and printed once.

    Raises:
        PhalanxError: The file is there and cannot be used, or it cannot be written.
    """
    path = folder / HASH_FILE
    if path.exists():
        notify(
            f"console: the password is the one that was printed when {path} was made; forgotten: delete that file"
        )
        return PasswordHash.parse(_text(path), str(path))
    password = new_password()
    kept = PasswordHash.of(password)
    write_private(path, kept.text().encode())
    notify(f"console: the password is {password}   (shown only now; its hash is kept in {path})")
    return kept


def _text(path: Path) -> str:
    try:
        return read_private(path).decode()
    except UnicodeDecodeError as error:
        raise PhalanxError(f"{path}: not a text") from error


def _scrypt(password: str, salt: bytes, n: int, r: int, p: int) -> bytes:
    memory = 2 * 128 * n * r  # what it needs, twice: OpenSSL counts a little more than that
    return hashlib.scrypt(password.encode(), salt=salt, n=n, r=r, p=p, dklen=_BYTES, maxmem=memory)


LONGEST_WAIT_S = 300.0


@dataclass(eq=False, slots=True)
class Session:
    """One browser that is logged in, until then [s]; `ended` is set when it logs out."""

    until_s: float
    ended: asyncio.Event = field(default_factory=asyncio.Event)


class Sessions:
    """Sessions by the hash of their token: a lookup reveals nothing about tokens."""

    def __init__(self, life_s: float = 12 * 3600.0, most: int = 64) -> None:
        """Nobody is logged in; beyond `most` sessions the oldest is logged out."""
        self._life_s, self._most = life_s, most
        self._by_hash: OrderedDict[bytes, Session] = OrderedDict()

    def begin(self, now_s: float) -> str:
        """Log in; the token is for the browser alone."""
        token = secrets.token_urlsafe(32)
        while len(self._by_hash) >= self._most:
            self._by_hash.popitem(last=False)[1].ended.set()
        self._by_hash[_hash(token)] = Session(now_s + self._life_s)
        return token

    def find(self, token: str, now_s: float) -> Session | None:
        """The session of a token, unless it is over."""
        session = self._by_hash.get(_hash(token))
        if session is None or now_s < session.until_s:
            return session
        self.end(token)
        return None

    def end(self, token: str) -> None:
        """Log out; nothing happens where there is no such session."""
        if (session := self._by_hash.pop(_hash(token), None)) is not None:
            session.ended.set()


class Backoff:
    """Failed logins per address, with the time until which each must wait.

    The address that was quiet for longest is forgotten first.
    """

    def __init__(self, most: int = 1024) -> None:
        self._most = most
        self._failures: OrderedDict[str, tuple[int, float]] = OrderedDict()

    def wait_s(self, address: str, now_s: float) -> float:
        """How long this address has to wait before it may try; 0: it may now."""
        _, until_s = self._failures.get(_network(address), (0, now_s))
        return max(0.0, until_s - now_s)

    def failed(self, address: str, now_s: float) -> None:
        """Record a wrong password; after three, the wait doubles, to five minutes."""
        key = _network(address)
        count = self._failures.pop(key, (0, 0.0))[0] + 1
        free_tries = 3
        first_wait_s = 1.0
        wait_s = min(LONGEST_WAIT_S, first_wait_s * 2.0 ** min(count - free_tries, 30))
        self._failures[key] = (count, now_s + (wait_s if count >= free_tries else 0.0))
        while len(self._failures) > self._most:
            self._failures.popitem(last=False)

    def passed(self, address: str) -> None:
        """It gave the right one."""
        self._failures.pop(_network(address), None)

    def __len__(self) -> int:
        return len(self._failures)


def _hash(token: str) -> bytes:
    return hashlib.sha256(token.encode("utf-8", "surrogatepass")).digest()


def _network(address: str) -> str:
    """Return the network whose tries count as one: an IPv4 address, or an IPv6 /64."""
    try:
        found = plain_address(address)
    except ValueError:
        return address
    return str(ip_network((found, 64), strict=False) if isinstance(found, IPv6Address) else found)


LOGIN, LOGOUT = "/login", "/logout"
_FOLDER = Path(__file__).parent / "static"
_HEADERS = {
    "Cache-Control": "no-store",
    "Referrer-Policy": "same-origin",
    "X-Content-Type-Options": "nosniff",
}


class LoginRequired:
    """ASGI middleware that admits only logged-in browsers."""

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

        `cookie` names the session's cookie: cookies know no port, so two consoles of a machine need two
        names. `secure`: the page is served by TLS; the cookie then never leaves without it. The login leads
        only to one of `pages`, or the first page.
        """
        self._app, self._password, self._clock = app, password, clock
        self._cookie = f"__Host-{cookie}" if secure else cookie
        self._secure, self._pages = secure, frozenset(pages)
        self._sessions, self._backoff = Sessions(), Backoff()
        self._checking, self._waiting = asyncio.Lock(), 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or refuse it."""
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
        """Pass a socket on until its session ends, then disconnect its handler."""
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
        """Where to after the login: one of our pages, nothing else."""
        wanted = request.query_params.get("next", "/")
        return wanted if wanted in self._pages else "/"


async def _end(session: Session, now_s: float) -> None:
    with suppress(TimeoutError):
        async with asyncio.timeout(max(0.0, session.until_s - now_s)):
            await session.ended.wait()


async def _password(request: Request) -> str | None:
    """Return the password from the form; None: none, too long, malformed, too slow."""
    body = b""
    try:
        async with asyncio.timeout(10.0):
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
