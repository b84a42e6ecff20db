"""Set-up page: steps on the left, the panel of one step on the right."""

from collections.abc import Callable
from functools import partial

from nicegui import ui

from common.errors import PhalanxError
from master.console.setup import panel_cameras, panel_colours, panel_lens, panel_start
from master.console.setup.parts import CSS, Desk
from master.console.setup.session import Done, Session, Step, session_of, wizard_named
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
_ICONS = {Done.DONE: "check_circle", Done.TO_DO: "radio_button_unchecked", Done.STALE: "warning"}
_COLOURS = {Done.DONE: "positive", Done.TO_DO: "grey", Done.STALE: "warning"}


def build(state: ConsoleState) -> None:
    """Fill the page."""
    ui.add_css(CSS)
    try:
        session = session_of(state)
    except PhalanxError as error:
        ui.label(f"{error}; remove that file to begin anew").props('role="alert"').classes("setup-error")
        return
    with ui.element("div").classes("setup"):
        nav = ui.element("nav").classes("setup-steps").props('aria-label="Steps of the set-up"')
        with ui.column().classes("setup-panel"):
            error = ui.label().classes("setup-error").props('role="alert" data-testid="error"')
            panel = ui.column().classes("setup-panel w-full")

    def complain(text: str) -> None:
        error.set_text(text)

    desk = Desk(session, lambda _key: None, complain)
    steps = _Steps(session, nav, panel, desk)
    desk.go = steps.go
    steps.go(session.here or steps.first())
    ui.timer(1.0, steps.update)


class _Steps:
    def __init__(self, session: Session, nav: ui.element, panel: ui.column, desk: Desk) -> None:
        self._session, self._nav, self._panel, self._desk = session, nav, panel, desk
        self._here = ""
        self._shown: object = None

    def first(self) -> str:
        """The first step that is not done; with all done, tracking."""
        for step in self._all():
            if step.state is not Done.DONE and step.key in PANELS:
                return step.key
        return "track"

    def go(self, key: str) -> None:
        """Open the panel of a step, or `wizard/COMMAND`."""
        self._here = self._session.here = key
        self._desk.complain("")
        self._panel.clear()
        with self._panel:
            if key.startswith("wizard/"):
                panel_lens.build_wizard(self._desk, wizard_named(key.removeprefix("wizard/")))
            else:
                PANELS[key](self._desk)
        self.update()

    def update(self) -> None:
        """Show what is done now."""
        steps = self._all()
        now = (steps, self._here)
        if now == self._shown:
            return
        self._shown = now
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
        with button:
            ui.icon(_ICONS[step.state], color=_COLOURS[step.state]).props("aria-hidden=true").classes(
                "q-mr-sm"
            )
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
        tracked = Step(
            "track", "Track", *((Done.DONE, "a hand is tracked") if posing else (Done.TO_DO, "start it"))
        )
        return (*files[:2], started, *files[2:], tracked)
