"""The console's door, without a browser: the password and its file, sessions, tries, and every path behind it."""

import asyncio
import os
import stat
from collections.abc import Iterable, Iterator
from http.cookies import SimpleCookie
from pathlib import Path
from urllib.parse import urlencode

import pytest
from fastapi import FastAPI, WebSocket
from hypothesis import given
from hypothesis import strategies as st
from starlette.routing import BaseRoute, Mount, WebSocketRoute
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from common.errors import PhalanxError
from master.console.app import PAGES, LoginPage, console_app, login_of, register
from master.console.login import (
    HASH_FILE,
    LONGEST_WAIT_S,
    Backoff,
    LoginRequired,
    PasswordHash,
    Sessions,
    kept_password,
    new_password,
    password_from,
)
from master.console.serving import same_user
from master.console.state import ConsoleSettings, ConsoleState
from tests.memory_bus import LoopbackBus

PASSWORD = "correct horse battery"
CHEAP = PasswordHash.of(PASSWORD, n=16)


class Time:
    """A clock that the test moves."""

    def __init__(self) -> None:
        self.s = 1000.0

    def __call__(self) -> float:
        return self.s


async def ask(
    app: ASGIApp,
    path: str,
    method: str = "GET",
    *,
    cookie: str = "",
    body: bytes = b"",
    client: str = "192.0.2.7",
    kind: str = "http",
    then: Iterable[Message] = (),
) -> list[Message]:
    """What the app answers to one request, as a server would pass it on."""
    path, _, query = path.partition("?")
    scope = {
        "type": kind,
        "method": method,
        "path": path,
        "raw_path": path.encode(),
        "query_string": query.encode(),
        "headers": [(b"host", b"127.0.0.1:8080"), *([(b"cookie", cookie.encode())] if cookie else [])],
        "client": (client, 5555),
        "server": ("127.0.0.1", 8080),
        "scheme": "http",
        "root_path": "",
        "http_version": "1.1",
    }
    messages: list[Message] = []
    first = {"type": "http.request", "body": body} if kind == "http" else {"type": "websocket.connect"}
    waiting = [first, *then]

    async def receive() -> Message:
        if waiting:
            return waiting.pop(0)
        await asyncio.Event().wait()  # the browser says nothing more
        raise AssertionError

    async def send(message: Message) -> None:
        messages.append(message)

    await app(scope, receive, send)
    return messages


def status(messages: list[Message]) -> int:
    """Of an answer; a socket that was closed before it was accepted is 403, as servers say it."""
    return 403 if messages[0]["type"] == "websocket.close" else int(messages[0]["status"])


def header(messages: list[Message], name: bytes) -> str:
    return next((value.decode() for key, value in messages[0]["headers"] if key == name), "")


def token(messages: list[Message], name: str = "phalanx-8080") -> str:
    return f"{name}={SimpleCookie(header(messages, b'set-cookie'))[name].value}"


def form(password: str) -> bytes:
    return urlencode({"password": password}).encode()


async def behind(scope: Scope, receive: Receive, send: Send) -> None:
    """What stands behind the door: it says so."""
    await send({"type": "http.response.start", "status": 299, "headers": []})
    await send({"type": "http.response.body", "body": b"secret"})


def login(time: Time | None = None, app: ASGIApp = behind, secure: bool = False) -> LoginRequired:
    return LoginRequired(app, CHEAP, "phalanx-8080", secure, ["/live"], time or Time())


# The password


def test_a_password_fits_itself_alone_and_its_hash_survives_a_file() -> None:
    kept = PasswordHash.parse(CHEAP.text(), "here")
    assert kept.fits(PASSWORD)
    assert not kept.fits(PASSWORD + " ")
    assert PASSWORD not in CHEAP.text()
    assert PasswordHash.of(PASSWORD, n=16) != CHEAP, "a salt of its own"


def test_a_password_is_made_and_said_once(tmp_path: Path) -> None:
    output: list[str] = []
    folder = tmp_path / "phalanx"
    made = kept_password(folder, output.append)
    password = output[0].split("password is ")[1].split()[0]
    assert made.fits(password)
    assert made.n >= 2**15
    assert len(set(password.replace("-", ""))) > 5
    assert stat.S_IMODE((folder / HASH_FILE).stat().st_mode) == 0o600
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert kept_password(folder, output.append) == made
    assert password not in output[1]
    assert new_password() != new_password()


@pytest.mark.parametrize(
    ("text", "mode", "why"),
    [
        ("short\n", 0o600, "at least 12 characters"),
        ("", 0o600, "at least 12 characters"),
        (PASSWORD, 0o640, "others can read"),
    ],
)
def test_a_password_file_that_protects_nothing_is_refused(
    tmp_path: Path, text: str, mode: int, why: str
) -> None:
    path = tmp_path / "password"
    path.write_text(text)
    path.chmod(mode)
    with pytest.raises(PhalanxError, match=why):
        password_from(path)


@pytest.mark.parametrize(
    "text", ["", "scrypt$16$8$1$00$00", "md5$16$8$1$00$" + "0" * 64, "scrypt$99999999999$8$1$00$" + "0" * 64]
)
def test_a_broken_hash_lets_nobody_in(tmp_path: Path, text: str) -> None:
    (tmp_path / HASH_FILE).touch(mode=0o600)
    (tmp_path / HASH_FILE).write_text(text)
    with pytest.raises(PhalanxError, match="delete it"):
        kept_password(tmp_path, lambda _: None)


# Sessions and tries


def test_a_session_ends_by_itself_by_logout_and_when_there_are_too_many() -> None:
    sessions = Sessions(life_s=10.0, most=2)
    first = sessions.begin(0.0)
    assert sessions.find(first, 9.9) is not None
    assert sessions.find(first, 10.0) is None
    second, third, fourth = (sessions.begin(20.0) for _ in range(3))
    assert [sessions.find(one, 20.0) is not None for one in (second, third, fourth)] == [False, True, True]
    kept = sessions.find(third, 20.0)
    assert kept is not None
    sessions.end(third)
    assert kept.ended.is_set()
    assert sessions.find("", 20.0) is None


def test_wrong_tries_wait_longer_each_time_and_only_theirs() -> None:
    tries, now_s = Backoff(), 0.0
    waits: list[float] = []
    for _ in range(14):
        tries.failed("192.0.2.7", now_s)
        waits.append(tries.wait_s("192.0.2.7", now_s))
        now_s += waits[-1]
    assert waits[:6] == [0.0, 0.0, 1.0, 2.0, 4.0, 8.0]
    assert waits[-1] == LONGEST_WAIT_S
    assert tries.wait_s("192.0.2.8", 0.0) == 0.0
    tries.passed("192.0.2.7")
    assert tries.wait_s("192.0.2.7", 0.0) == 0.0


def test_one_machine_is_one_address_whatever_it_calls_itself() -> None:
    tries = Backoff()
    for k in range(4):
        tries.failed(f"2001:db8:1:2::{k}", 0.0)
        tries.failed("::ffff:192.0.2.7", 0.0)
    assert tries.wait_s("2001:db8:1:2:ffff::1", 0.0) > 0.0
    assert tries.wait_s("2001:db8:1:3::1", 0.0) == 0.0
    assert tries.wait_s("192.0.2.7", 0.0) > 0.0


@given(st.lists(st.text(max_size=20), max_size=40))
def test_tries_take_a_bounded_memory_and_any_address(addresses: list[str]) -> None:
    tries = Backoff(most=8)
    for address in addresses:
        tries.failed(address, 0.0)
        tries.wait_s(address, 0.0)
    assert len(tries) <= 8


# The door


def test_the_right_password_opens_and_logout_closes() -> None:
    async def story() -> None:
        app = login()
        assert status(await ask(app, "/live")) == 303
        assert header(await ask(app, "/live"), b"location") == "/login?next=/live"
        assert status(await ask(app, "/login", "POST", body=form("wrong"))) == 403
        opened = await ask(app, "/login?next=/live", "POST", body=form(PASSWORD))
        assert (status(opened), header(opened, b"location")) == (303, "/live")
        output = header(opened, b"set-cookie").lower()
        assert "httponly" in output
        assert "samesite=strict" in output
        cookie = token(opened)
        assert status(await ask(app, "/live", cookie=cookie)) == 299
        assert status(await ask(app, "/live", cookie=f"a=b; {cookie}; c=d")) == 299
        assert status(await ask(app, "/live", cookie=cookie[:-1])) == 303
        assert status(await ask(app, "/logout", cookie=cookie)) == 405, "a link cannot log out"
        assert status(await ask(app, "/live", cookie=cookie)) == 299
        assert status(await ask(app, "/logout", "POST", cookie=cookie)) == 303
        assert status(await ask(app, "/live", cookie=cookie)) == 303

    asyncio.run(story())


def test_over_tls_the_cookie_never_leaves_without_it() -> None:
    opened = asyncio.run(ask(login(secure=True), "/login", "POST", body=form(PASSWORD)))
    assert token(opened, "__Host-phalanx-8080")
    assert "; secure" in header(opened, b"set-cookie").lower()


def test_a_session_is_over_after_half_a_day() -> None:
    async def story() -> None:
        time = Time()
        app = login(time)
        cookie = token(await ask(app, "/login", "POST", body=form(PASSWORD)))
        time.s += 11.9 * 3600
        assert status(await ask(app, "/live", cookie=cookie)) == 299
        time.s += 0.2 * 3600
        assert status(await ask(app, "/live", cookie=cookie)) == 303

    asyncio.run(story())


@pytest.mark.parametrize("goal", ["//evil.example", "https://evil.example", "/login", "/..//evil", "live"])
def test_after_the_login_one_stays_here(goal: str) -> None:
    opened = asyncio.run(ask(login(), f"/login?{urlencode({'next': goal})}", "POST", body=form(PASSWORD)))
    assert header(opened, b"location") == "/"


@pytest.mark.parametrize(
    "body", [b"", b"password", b"\xff\xfe", b"x=1", b"password=" + b"a" * 2000, b"&" * 900]
)
def test_a_form_of_junk_is_answered_and_costs_no_try(body: bytes) -> None:
    async def story() -> None:
        app = login()
        for _ in range(5):
            assert status(await ask(app, "/login", "POST", body=body)) == 400
        assert status(await ask(app, "/login", "POST", body=form(PASSWORD))) == 303

    asyncio.run(story())


def test_guessing_is_slowed_down_also_when_it_comes_at_once() -> None:
    async def story() -> None:
        time = Time()
        app = login(time)
        guesses = (ask(app, "/login", "POST", body=form(f"guess {k}")) for k in range(50))
        messages = [status(one) for one in await asyncio.gather(*guesses)]
        assert messages.count(403) == 3
        assert messages.count(429) == 47
        right = await ask(app, "/login", "POST", body=form(PASSWORD))
        assert status(right) == 429, "nor is the right one looked at before its time"
        assert int(header(right, b"retry-after")) >= 1
        assert status(await ask(app, "/login", "POST", body=form(PASSWORD), client="192.0.2.8")) == 303
        time.s += 2.0
        assert status(await ask(app, "/login", "POST", body=form(PASSWORD))) == 303

    asyncio.run(story())


def test_a_socket_ends_with_its_session() -> None:
    received: list[Message] = []
    app = FastAPI(openapi_url=None)

    async def echo(socket: WebSocket) -> None:
        await socket.accept()
        while (message := await socket.receive())["type"] != "websocket.disconnect":
            received.append(message)

    app.add_api_websocket_route("/echo", echo)

    async def story() -> None:
        guarded = login(app=app)
        assert status(await ask(guarded, "/echo", kind="websocket")) == 403
        cookie = token(await ask(guarded, "/login", "POST", body=form(PASSWORD)))
        output = [{"type": "websocket.receive", "text": "hello"}]
        open_socket = asyncio.create_task(ask(guarded, "/echo", kind="websocket", cookie=cookie, then=output))
        while not received:
            await asyncio.sleep(0.001)
        await ask(guarded, "/logout", "POST", cookie=cookie)
        messages = await asyncio.wait_for(open_socket, 30.0)
        assert [one["type"] for one in messages] == ["websocket.accept", "websocket.close"]

    asyncio.run(story())


# Every path


def paths(routes: Iterable[BaseRoute], before: str = "") -> Iterator[tuple[str, str]]:
    """Kind and path of all that an application answers."""
    for route in routes:
        path = before + getattr(route, "path", "")
        if isinstance(route, Mount):
            inner = list(paths(route.routes, path))
            yield from inner or [("http", f"{path}/x"), ("websocket", f"{path}/x")]
        else:
            yield ("websocket" if isinstance(route, WebSocketRoute) else "http"), path


def open_to_anybody(app: ASGIApp, found: Iterable[tuple[str, str]]) -> set[str]:
    """Paths that answer somebody who did not log in with anything but a refusal or the way to the login."""

    async def process_noise() -> set[str]:
        wrong: set[str] = set()
        for kind, path in found:
            for method in ("GET", "POST") if kind == "http" else ("GET",):
                messages = await ask(app, path, method, kind=kind)
                way = header(messages, b"location") if kind == "http" else ""
                if status(messages) not in (401, 403) and not way.startswith("/login"):
                    wrong.add(f"{method} {path} {status(messages)}")
        return wrong

    return asyncio.run(process_noise())


@pytest.fixture(scope="module")
def state(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ConsoleState]:
    settings = ConsoleSettings(tmp_path_factory.mktemp("calibration"), host="0.0.0.0")
    made = ConsoleState(settings, open_bus=LoopbackBus)
    register(made)
    yield made
    made.close()


def test_nothing_is_reached_without_the_login(state: ConsoleState) -> None:
    app = console_app(state, "0.0.0.0", 8080, LoginPage(CHEAP))
    found = list(paths(app.routes))
    known = {path for _, path in found}
    assert {page.route for page in PAGES} | {"/console/hands", "/console/camera/{camera}"} <= known
    assert any(path.startswith("/_nicegui_ws") for path in known)
    assert sum("/_nicegui/" in path for path in known) >= 5
    assert open_to_anybody(app, [*found, ("http", "/nowhere"), ("http", "/openapi.json")]) == set()
    assert open_to_anybody(app, [("http", "/login")]) == {"GET /login 200", "POST /login 400"}
    assert status(asyncio.run(ask(app, "/logout", "POST"))) == 303


def test_the_walk_sees_a_path_that_is_open() -> None:
    app = FastAPI(openapi_url=None)
    app.add_api_route("/leak", lambda: "secret")
    assert open_to_anybody(app, paths(app.routes)) == {"GET /leak 200", "POST /leak 405"}


# What the door is


def test_elsewhere_there_is_a_password_and_tls_unless_it_is_open(tmp_path: Path) -> None:
    output: list[str] = []
    here = login_of(ConsoleSettings(tmp_path), tmp_path, output.append)
    assert (here, output) == (LoginPage(), [])
    elsewhere = login_of(ConsoleSettings(tmp_path, host="192.0.2.1"), tmp_path, output.append)
    assert elsewhere.password is not None
    assert elsewhere.tls is not None
    assert "SHA-256" in output[-1]
    plain = login_of(ConsoleSettings(tmp_path, host="0.0.0.0", open_links=True), tmp_path, output.append)
    assert plain.password is not None
    assert plain.tls is None
    assert "WARNING" in output[-1]


def test_only_the_own_user_is_answered_without_a_password(tmp_path: Path) -> None:
    line = " 0: {}:C001 0100007F:1F90 01 00000000:00000000 00:00000000 00000000 {:5d} 0 1 1\n"
    net = tmp_path / "net"
    net.mkdir()
    client, server = ("127.0.0.1", 0xC001), ("127.0.0.1", 8080)
    assert same_user(client, server, net), "a system that does not tell"
    for uid, own in ((os.getuid(), True), (0, True), (os.getuid() + 4711, False)):
        (net / "tcp").write_text("head\n" + line.format("0100007F", uid))
        assert same_user(client, server, net) == own
    assert not same_user(("127.0.0.1", 1), server, net), "a connection that is not there"
    mapped = "0000000000000000FFFF00000100007F"
    (net / "tcp").write_text("head\n")
    six = line.format(mapped, os.getuid()).replace("0100007F:1F90", f"{mapped}:1F90")
    (net / "tcp6").write_text("head\n" + six)
    assert same_user(client, server, net)
