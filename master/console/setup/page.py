"""Set-up page: steps on the left, the panel of one step on the right."""

from collections.abc import Callable
from functools import partial

from nicegui import ui

from common.errors import PhalanxError
from master.console.controls import Problem
from master.console.setup import panel_cameras, panel_colours, panel_lens, panel_start
from master.console.setup.parts import Desk
from master.console.setup.session import Done, Step, session_of
from master.console.setup.wizards import WIZARDS
from master.console.state import ConsoleState

PANELS: dict[str, Callable[[Desk], None]] = {
    "cameras": panel_cameras.panel_cameras,
    "rig": panel_cameras.panel_rig,
    "start": panel_start.panel_start,
    "lens": panel_lens.panel_lens,
    "colours": panel_colours.panel_colours,
    "track": panel_start.panel_track,
    "more": panel_lens.panel_more,
}
_ICONS = {
    Done.DONE: ("check_circle", "positive"),
    Done.TO_DO: ("radio_button_unchecked", "grey"),
    Done.STALE: ("warning", "warning"),
}


def build(state: ConsoleState) -> None:
    """Fill the page."""
    try:
        session = session_of(state)
    except PhalanxError as error:
        ui.label(f"{error}; remove that file to begin anew").props('role="alert"').classes("setup-error")
        return
    with ui.element("div").classes("setup"):
        nav = ui.element("nav").classes("setup-steps").props('aria-label="Steps of the set-up"')
        with ui.column().classes("setup-panel"):
            desk = Desk(session, Problem().classes(replace="setup-error").props('data-testid="error"'))
            panel = ui.column().classes("setup-panel w-full")
    steps = _Steps(nav, panel, desk)
    desk.go = steps.go
    steps.go(session.here or steps.first())
    ui.timer(1.0, steps.update)


class _Steps:
    def __init__(self, nav: ui.element, panel: ui.column, desk: Desk) -> None:
        self._nav, self._panel, self._desk, self._session = nav, panel, desk, desk.session
        self._here = ""
        self._shown: object = None

    def first(self) -> str:
        """The first step that is not done; with all done, tracking."""
        return next((step.key for step in self._all() if step.state is not Done.DONE), "track")

    def go(self, key: str) -> None:
        """Open the panel of a step, or `wizard/NAME`."""
        self._here = self._session.here = key
        self._desk.problem.set_text("")
        self._panel.clear()
        with self._panel:
            if key.startswith("wizard/"):
                panel_lens.build_wizard(self._desk, WIZARDS[key.removeprefix("wizard/")])
            else:
                PANELS[key](self._desk)
        self.update()

    def update(self) -> None:
        """Show what is done now."""
        steps = self._all()
        if (steps, self._here) == self._shown:
            return
        self._shown = (steps, self._here)
        self._nav.clear()
        with self._nav:
            for number, step in enumerate(steps, 1):
                self._entry(number, step)
            more = ui.button("More calibrations", on_click=partial(self.go, "more")).props(
                'flat icon="build"'
            )
            if self._here == "more" or self._here.startswith("wizard/"):
                more.props('aria-current="step" outline')

    def _entry(self, number: int, step: Step) -> None:
        button = ui.button(on_click=partial(self.go, step.key)).props("flat no-caps")
        button.props(f'aria-label="Step {number}: {step.title}, {step.state}"')
        if step.key == self._here:
            button.props('aria-current="step" outline')
        icon, colour = _ICONS[step.state]
        with button:
            ui.icon(icon, color=colour).props("aria-hidden=true").classes("q-mr-sm")
            with ui.column().classes("gap-0"):
                ui.label(f"{number}. {step.title}")
                ui.label(f"{step.state}: {step.why}").classes("setup-step-why")

    def _all(self) -> tuple[Step, ...]:
        """The steps of the files, and between them those of what runs."""
        session = self._session
        files = session.steps()
        absent = [camera.name for camera in session.plan.cameras if camera.name not in session.state.alive]
        run = bool(session.plan.cameras) and not absent
        why = "all run" if run else f"not there: {', '.join(absent)}" if absent else "choose them first"
        started = Step("start", "Start cameras", Done.DONE if run else Done.TO_DO, why)
        posing = any(pose.tracked.any() for pose in session.state.poses.values())
        state, why = (Done.DONE, "a hand is tracked") if posing else (Done.TO_DO, "start it")
        return (*files[:2], started, *files[2:], Step("track", "Track", state, why))
