"""Common frame of every console page.

It has a header with connection and checklist, navigation, and light and dark mode.
"""

from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from nicegui import ui

from master.console.login_page import LOGOUT
from master.console.state import ConsoleState

_UPDATE_S = 1.0
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
class Entry:
    """One entry of the navigation."""

    route: str
    title: str
    icon: str


@contextmanager
def shell(state: ConsoleState, entries: Sequence[Entry], here: str, logout: bool = False) -> Generator[None]:
    """Build header and navigation, and a way to log out.

    What is built within stands in the middle of the page.
    """
    ui.add_css(_STYLE)
    ui.colors(primary=_PRIMARY)
    with ui.header(elevated=False).classes("console-header items-center gap-2 q-px-md"):
        ui.label("Phalanx").classes("console-name gt-sm")
        with ui.element("nav").classes("console-nav").props('aria-label="Pages"'):
            for entry in entries:
                _entry(entry, entry.route == here)
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


def _entry(entry: Entry, here: bool) -> None:
    link = ui.link(target=entry.route).classes("console-entry" + (" here" if here else ""))
    link.props(f'aria-label="{entry.title}"' + (' aria-current="page"' if here else ""))
    with link:
        ui.icon(entry.icon).props("aria-hidden=true")
        ui.label(entry.title).classes("console-entry-title")


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

    update()
    ui.timer(_UPDATE_S, update)


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

    update()
    ui.timer(_UPDATE_S, update)


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
