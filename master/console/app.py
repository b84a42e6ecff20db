"""Console program serves its pages in their common frame, behind guards.

The frame has a header (connection, checklist, theme), the navigation and a logout. The server admits own
pages only (`serving`), then a login, or the same user of this machine (`login`).
"""

import os
import socket
import ssl
import threading
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import uvicorn
from fastapi import FastAPI
from nicegui import ui

from common.errors import PhalanxError
from master.console.controls import every
from master.console.login import LOGOUT, LoginRequired, PasswordHash, kept_password, password_from
from master.console.pages import checklist, gestures, live, outputs, plots, tune
from master.console.serving import OwnPagesOnly, console_server, names_of, same_user
from master.console.setup import page as setup_page
from master.console.sockets import serve_sockets
from master.console.state import ConsoleSettings, ConsoleState
from master.outputs.web.listening import is_loopback, page_certificate, places_of, private_folder

TITLE = "Phalanx"
_PRIMARY = "#1b6ac9"  # white on it, and itself on a dark panel, can be read
_STYLE = Path(__file__).parent / "static" / "console.css"
_THEMES: dict[str, bool | None] = {"auto": None, "light": False, "dark": True}
_THEME_ICONS = {"auto": "brightness_auto", "light": "light_mode", "dark": "dark_mode"}
# A page that is cut off because its session is over goes to the login instead of trying for ever.
_SESSION_OVER = """<script>setInterval(async () => {
  if (!window.socket || window.socket.connected) return;
  const answer = await fetch(location.pathname, { redirect: "manual" }).catch(() => null);
  if (answer?.type === "opaqueredirect") location.reload();
}, 2000);</script>"""


@dataclass(frozen=True, slots=True)
class Page:
    """One console page: its path, title, Material icon and content."""

    route: str
    title: str
    icon: str
    build: Callable[[ConsoleState], None]


@contextmanager
def shell(state: ConsoleState, pages: Sequence[Page], here: str, logout: bool = False) -> Generator[None]:
    """Build header and navigation; what is built within is the middle of the page."""
    ui.add_css(_STYLE)
    ui.colors(primary=_PRIMARY)
    with ui.header(elevated=False).classes("console-header items-center gap-2 q-px-md"):
        ui.label("Phalanx").classes("console-name gt-sm")
        with ui.element("nav").classes("console-nav").props('aria-label="Pages"'):
            for page in pages:
                _entry(page, page.route == here)
        ui.space()
        _connection(state)
        _badge(state)
        _theme()
        if logout:
            _logout()
    with ui.element("div").classes("console-main") as main:
        yield
    # What is pressed before the page is connected may be lost with a reload: it cannot be pressed until then.
    main.props("inert")
    ui.context.client.on_connect(lambda: main.props(remove="inert"))
    ui.skip_link("Skip to the page", target=main)


def _entry(page: Page, here: bool) -> None:
    link = ui.link(target=page.route).classes("console-entry" + (" here" if here else ""))
    link.props(f'aria-label="{page.title}"' + (' aria-current="page"' if here else ""))
    with link:
        ui.icon(page.icon).props("aria-hidden=true")
        ui.label(page.title).classes("console-entry-title")


def _connection(state: ConsoleState) -> None:
    with ui.element("div").classes("console-status").props('role="status"'):
        dot = ui.element("span").classes("console-dot")
        text = ui.label()
        hint = ui.tooltip("")

    def update() -> None:
        up = "master" in state.alive
        dot.classes(replace="console-dot " + ("good" if up else "warn" if state.link.up else "bad"))
        text.set_text("connected" if up else "no master" if state.link.up else "not connected")
        names = ", ".join(sorted(state.alive - {"master"})) or "no slaves"
        hint.set_text(names if state.link.up else state.link.reason)

    every(1.0, update)


def _badge(state: ConsoleState) -> None:
    link = ui.link(target="/checklist").classes("console-badge")
    with link:
        icon = ui.icon("check_circle").props("aria-hidden=true")
        text = ui.label()

    def update() -> None:
        checklist = state.checklist
        items = None if checklist is None else len(checklist.items)
        kind = "unknown" if items is None else "good" if items == 0 else "bad"
        link.classes(replace=f"console-badge {kind}")
        icon.set_name({"unknown": "help", "good": "check_circle", "bad": "error"}[kind])
        words = "no checklist" if items is None else "all well" if items == 0 else f"{items} to do"
        text.set_text(words)
        link.props(f'aria-label="Checklist: {words}"')

    every(1.0, update)


def _logout() -> None:
    ui.add_head_html(_SESSION_OVER)
    with ui.element("form").props(f'method="post" action="{LOGOUT}"'):
        button = ui.button(icon="logout").props(
            'flat round dense color=inherit type="submit" aria-label="Log out"'
        )
        with button.classes("console-theme"):
            ui.tooltip("log out")


def _theme() -> None:
    request = ui.context.client.request
    now = request.cookies.get("theme", "auto")
    now = now if now in _THEMES else "auto"
    dark = ui.dark_mode(_THEMES[now])
    names = list(_THEMES)

    def next_theme() -> None:
        nonlocal now
        now = names[(names.index(now) + 1) % len(names)]
        dark.set_value(_THEMES[now])
        ui.run_javascript(f'document.cookie = "theme={now}; path=/; max-age=31536000; samesite=strict"')
        show()

    button = ui.button(on_click=next_theme).props("flat round dense color=inherit").classes("console-theme")
    with button:
        hint = ui.tooltip("")

    def show() -> None:
        button.set_icon(_THEME_ICONS[now])
        button.props(f'aria-label="Theme: {now}. Change"')
        hint.set_text(f"theme: {now}")

    show()


PAGES: tuple[Page, ...] = (
    Page("/live", "Live", "visibility", live.build),
    Page("/tune", "Tune", "tune", tune.build),
    Page("/plots", "Plots", "show_chart", plots.build),
    Page("/gestures", "Gestures", "back_hand", gestures.build),
    Page("/outputs", "Outputs", "cast", outputs.build),
    Page("/checklist", "Checklist", "checklist", checklist.build),
    Page("/setup", "Set up", "construction", setup_page.build),
)


def start_page(state: ConsoleState) -> str:
    """Return the page on which the console opens: set-up while no rig can be used."""
    return PAGES[0].route if state.rigs() else "/setup"


def register(state: ConsoleState, logout: bool = False) -> None:
    """Register every page with NiceGUI, once in a process; `logout`: with its button."""

    def add(page: Page) -> None:
        def show() -> None:
            with shell(state, PAGES, page.route, logout=logout):
                page.build(state)

        ui.page(page.route, title=f"{page.title} · {TITLE}", response_timeout=20.0)(show)

    for page in PAGES:
        add(page)

    @ui.page("/", title=TITLE)
    def start() -> None:
        ui.navigate.to(start_page(state))


@dataclass(frozen=True, slots=True)
class LoginPage:
    """What stands before the pages; no password: same user here; no TLS: plain."""

    password: PasswordHash | None = None
    tls: ssl.SSLContext | None = None


def login_of(settings: ConsoleSettings, folder: Path, notify: Callable[[str], None]) -> LoginPage:
    """Return the login of a console.

    On this machine alone there is none; elsewhere it has a password, and TLS unless it is to be open. Both
    are kept in `folder`; `notify` gets the password when it is made, and how to know the certificate.

    Raises:
        PhalanxError: A file of the password or of the certificate cannot be used.
    """
    here = is_loopback(settings.host)
    if settings.password_file is not None:
        password = password_from(settings.password_file)
    else:
        password = None if here else kept_password(folder, notify)
    if here:
        return LoginPage(password)
    if settings.open_links:
        notify(
            "console: WARNING: --open: the page is not encrypted; whoever listens to the network reads the password"
        )
        return LoginPage(password)
    certificate = page_certificate(folder, settings.host)
    notify(
        "console: the browser asks once whether to trust this page: compare what it shows with SHA-256"
        f" {certificate.fingerprint}"
    )
    return LoginPage(password, certificate.context)


def run_console(settings: ConsoleSettings, stop: threading.Event, notify: Callable[[str], None]) -> None:
    """Serve the console until `stop` is set.

    Raises:
        PhalanxError: The address cannot be bound, or its password or certificate cannot be used.
    """
    login = login_of(settings, private_folder(os.environ), notify)
    listening = _listen(settings.host, settings.port)
    host, port = listening.getsockname()[:2]
    state = ConsoleState(settings)
    try:
        register(state, logout=login.password is not None)
        server = console_server(console_app(state, settings.host, port, login), login.tls)
        threading.Thread(target=_end_with, args=(stop, server), name="console stop", daemon=True).start()
        scheme = "http" if login.tls is None else "https"
        notify("console: " + " ".join(f"{scheme}://{place}:{port}/" for place in places_of(host)))
        server.run(sockets=[listening])
    finally:
        stop.set()
        state.close()
        listening.close()


def console_app(state: ConsoleState, host: str, port: int, login: LoginPage) -> FastAPI:
    """Return the application behind its guards: own pages only, login or same user."""
    app = FastAPI(openapi_url=None)
    serve_sockets(app, state)
    away_s = 30.0  # a page that sent nothing for so long, as on a busy machine, goes on where it was
    ui.run_with(
        app,
        title=TITLE,
        dark=None,
        favicon="🖐",
        language="en-US",
        show_welcome_message=False,
        reconnect_timeout=away_s,
    )
    if login.password is not None:
        app.add_middleware(
            LoginRequired,
            password=login.password,
            cookie=f"phalanx-{port}",
            secure=login.tls is not None,
            pages=[page.route for page in PAGES],
        )
    neighbours = same_user if login.password is None else None
    app.add_middleware(OwnPagesOnly, allowed=names_of(host), same_user=neighbours)  # the outermost
    return app


def _end_with(stop: threading.Event, server: uvicorn.Server) -> None:
    stop.wait()
    server.should_exit = True


def _listen(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listening = socket.socket(family, socket.SOCK_STREAM)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind((host, port))
    except OSError as error:
        listening.close()
        raise PhalanxError(
            f"console: cannot listen on {host}:{port}: {error.strerror}. Is another console open? Take another --port"
        ) from error
    return listening
