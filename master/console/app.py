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
from functools import partial
from pathlib import Path

from fastapi import FastAPI
from nicegui import ui

from common.errors import PhalanxError
from common.messages.streams import MASTER
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
_THEMES: dict[str, tuple[bool | None, str]] = {  # dark?, icon
    "auto": (None, "brightness_auto"),
    "light": (False, "light_mode"),
    "dark": (True, "dark_mode"),
}
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
                link = ui.link(target=page.route).classes("console-entry").props(f'aria-label="{page.title}"')
                if page.route == here:
                    link.classes("here").props('aria-current="page"')
                with link:
                    ui.icon(page.icon).props("aria-hidden=true")
                    ui.label(page.title).classes("console-entry-title")
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


def _connection(state: ConsoleState) -> None:
    with ui.element("div").classes("console-status").props('role="status"'):
        dot = ui.element("span").classes("console-dot")
        text = ui.label()
        hint = ui.tooltip("")

    def update() -> None:
        if not state.link.up:
            kind, words, more = "bad", "not connected", state.link.reason
        else:
            kind, words = ("good", "connected") if MASTER in state.alive else ("warn", "no master")
            more = ", ".join(sorted(state.alive - {MASTER})) or "no slaves"
        dot.classes(replace=f"console-dot {kind}")
        text.set_text(words)
        hint.set_text(more)

    every(1.0, update)


def _badge(state: ConsoleState) -> None:
    with ui.link(target="/checklist").classes("console-badge") as link:
        icon = ui.icon("check_circle").props("aria-hidden=true")
        text = ui.label()

    def update() -> None:
        if state.checklist is None:
            kind, name, words = "unknown", "help", "no checklist"
        elif items := state.checklist.items:
            kind, name, words = "bad", "error", f"{len(items)} to do"
        else:
            kind, name, words = "good", "check_circle", "all well"
        link.classes(replace=f"console-badge {kind}").props(f'aria-label="Checklist: {words}"')
        icon.set_name(name)
        text.set_text(words)

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
    names = list(_THEMES)
    now = ui.context.client.request.cookies.get("theme", "auto")
    now = now if now in _THEMES else "auto"
    dark = ui.dark_mode()
    button = ui.button().props("flat round dense color=inherit").classes("console-theme")
    with button:
        hint = ui.tooltip("")

    def show() -> None:
        value, icon = _THEMES[now]
        dark.set_value(value)
        button.set_icon(icon)
        button.props(f'aria-label="Theme: {now}. Change"')
        hint.set_text(f"theme: {now}")

    def next_theme() -> None:
        nonlocal now
        now = names[(names.index(now) + 1) % len(names)]
        ui.run_javascript(f'document.cookie = "theme={now}; path=/; max-age=31536000; samesite=strict"')
        show()

    button.on_click(next_theme)
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


def register(state: ConsoleState, logout: bool = False) -> None:
    """Register every page with NiceGUI, once in a process; `logout`: with its button."""

    def show(page: Page) -> None:
        with shell(state, PAGES, page.route, logout=logout):
            page.build(state)

    for page in PAGES:
        title = f"{page.title} · {TITLE}"
        ui.page(page.route, title=title, response_timeout=20.0)(partial(show, page))

    @ui.page("/", title=TITLE)
    def start() -> None:
        """The console opens on the set-up while no rig can be used."""
        ui.navigate.to(PAGES[0].route if state.rigs() else "/setup")


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
    here, password = is_loopback(settings.host), None
    if settings.password_file is not None:
        password = password_from(settings.password_file)
    elif not here:
        password = kept_password(folder, notify)
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

        def end() -> None:
            stop.wait()
            server.should_exit = True

        threading.Thread(target=end, name="console stop", daemon=True).start()
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
    silent_s = 30.0  # a page that sent nothing for so long, as on a busy machine, goes on where it was
    ui.run_with(
        app,
        title=TITLE,
        dark=None,
        favicon="🖐",
        language="en-US",
        show_welcome_message=False,
        reconnect_timeout=silent_s,
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


def _listen(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listening = socket.socket(family, socket.SOCK_STREAM)
    if os.name != "nt":  # there it would share the port with another console
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind((host, port))
    except OSError as error:
        listening.close()
        raise PhalanxError(
            f"console: cannot listen on {host}:{port}: {error.strerror}. Is another console open? Take another --port"
        ) from error
    return listening
