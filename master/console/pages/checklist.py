"""Page Checklist: what is not as it should be, each with what to do."""

from nicegui import ui

from common.messages import CheckItem, Checklist
from master.console.controls import every, readable
from master.console.state import ConsoleState


def build(state: ConsoleState) -> None:
    """Fill the page."""
    shown: list[tuple[CheckItem, ...] | str] = []
    box = ui.element("section").classes("checks").props('aria-label="Checklist" aria-live="polite"')

    def update() -> None:
        checklist = state.checklist
        now = _why_none(state) if checklist is None else checklist.items
        if shown == [now]:
            return  # what is read, or focused, is not torn away
        shown[:] = [now]
        box.clear()
        with box:
            _fill(checklist, now if isinstance(now, str) else "")

    every(0.5, update)


def _fill(checklist: Checklist | None, why: str) -> None:
    if checklist is None:
        _banner("help", "unknown", "Nobody checks", why)
        return
    if not checklist.items:
        text = "Cameras, colours, calibration, clocks and network are right."
        _banner("check_circle", "good", "All is well", text)
        return
    count = len(checklist.items)
    _banner("error", "bad", f"{count} {'thing needs' if count == 1 else 'things need'} you", "")
    with ui.element("ul").classes("check-list"):
        for item in checklist.items:
            _item(item)


def _banner(icon: str, kind: str, title: str, text: str) -> None:
    with ui.element("div").classes(f"panel banner {kind}"):
        ui.icon(icon).props("aria-hidden=true")
        with ui.element("div"):
            ui.label(title).classes("banner-title")
            if text:
                ui.label(text).classes("soft")


def _item(item: CheckItem) -> None:
    with ui.element("li").classes("panel check"):
        with ui.element("div").classes("check-head"):
            ui.label(readable(item.code)).classes("check-code")
            ui.label(item.subject).classes("check-subject")
        ui.label(item.sentence)
        with ui.element("div").classes("check-fix"):
            ui.icon("build").props("aria-hidden=true")
            ui.label(item.fix)


def _why_none(state: ConsoleState) -> str:
    if not state.link.up:
        return state.link.reason
    if "master" not in state.alive:
        return "No master runs: the Set-up page starts one."
    return "The master that runs sends no checklist; one that plays a recording has nothing to check."
