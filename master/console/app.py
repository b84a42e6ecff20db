"""The console as a program: its pages, the shell around them, and the server on 127.0.0.1."""

import socket
import threading
from collections.abc import Callable
from dataclasses import dataclass

import uvicorn
from fastapi import FastAPI
from nicegui import ui

from common.errors import PhalanxError
from master.console.guard import OwnPagesOnly, names_of
from master.console.pages import checklist, gestures, live, outputs, plots, tune
from master.console.setup import page as setup_page
from master.console.shell import Entry, shell
from master.console.sockets import serve_sockets
from master.console.state import ConsoleSettings, ConsoleState

TITLE = "Phalanx"
_AWAY_S = 30.0  # a page that was not heard for so long, as on a busy machine, goes on where it was
_LEAVE_S = 2  # pages that are open do not keep the console from ending


@dataclass(frozen=True, slots=True)
class Page:
    """One page: where it is, how it is called, its icon (a name of the Material font), and what fills it."""

    route: str
    title: str
    icon: str
    build: Callable[[ConsoleState], None]


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
    """Where somebody who opens the console begins: the set-up while no rig can be used."""
    return PAGES[0].route if state.rigs() else "/setup"


def register(state: ConsoleState) -> None:
    """Make every page known to NiceGUI. Once in a process."""
    entries = tuple(Entry(page.route, page.title, page.icon) for page in PAGES)

    def add(page: Page) -> None:
        def show() -> None:
            with shell(state, entries, page.route):
                page.build(state)

        ui.page(page.route, title=f"{page.title} · {TITLE}", response_timeout=20.0)(show)

    for page in PAGES:
        add(page)

    @ui.page("/", title=TITLE)
    def start() -> None:
        ui.navigate.to(start_page(state))


def run_console(settings: ConsoleSettings, stop: threading.Event, say: Callable[[str], None]) -> None:
    """Serve the console until `stop` is set.

    Raises:
        PhalanxError: The address cannot be bound.
    """
    listening = _listen(settings.host, settings.port)
    host, port = listening.getsockname()[:2]
    state = ConsoleState(settings)
    try:
        register(state)
        server = _server(state, settings)
        threading.Thread(target=_end_with, args=(stop, server), name="console stop", daemon=True).start()
        say(f"console: http://{f'[{host}]' if ':' in host else host}:{port}/")
        server.run(sockets=[listening])
    finally:
        stop.set()
        state.close()
        listening.close()


def _server(state: ConsoleState, settings: ConsoleSettings) -> uvicorn.Server:
    app = FastAPI(openapi_url=None)
    app.add_middleware(OwnPagesOnly, allowed=names_of(settings.host))
    serve_sockets(app, state)
    ui.run_with(
        app,
        title=TITLE,
        dark=None,
        favicon="🖐",
        language="en-US",
        show_welcome_message=False,
        reconnect_timeout=_AWAY_S,
    )
    config = uvicorn.Config(
        app, log_level="warning", timeout_graceful_shutdown=_LEAVE_S, access_log=False, lifespan="on"
    )
    return uvicorn.Server(config)


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
