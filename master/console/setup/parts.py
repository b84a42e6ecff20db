"""Panels share these parts and the view of a running calibration."""

import base64
from collections.abc import Callable
from dataclasses import dataclass

from nicegui import ui

from master.console.controls import CameraView, Problem, every
from master.console.setup.job import Job, JobState
from master.console.setup.session import Session


@dataclass(slots=True)
class Desk:
    """One window of the set-up page; `go` shows the panel of a step."""

    session: Session
    problem: Problem
    go: Callable[[str], None] = lambda _: None

    async def attempt(self, action: Callable[[], object], then: str = "") -> bool:
        """As `Problem.attempt`; the panel `then` follows where it succeeds."""
        succeeded = await self.problem.attempt(action)
        if succeeded and then:
            self.go(then)
        return succeeded


def heading(title: str, text: str) -> None:
    """Title of a panel and a sentence about it."""
    ui.label(title).classes("text-h6").props('role="heading" aria-level="2"')
    ui.label(text).classes("setup-text")


def command_line(about: str, text: str) -> None:
    """A command to run elsewhere, with a button that copies it."""
    ui.label(about).classes("setup-text")
    with ui.row().classes("items-center no-wrap w-full"):
        ui.label(text).classes("setup-command").props('tabindex=0 role="textbox" aria-readonly="true"')
        copy = ui.button(icon="content_copy", on_click=lambda: ui.clipboard.write(text)).props("flat round")
        copy.props(f'aria-label="Copy: {about}"')


def previews(desk: Desk) -> None:
    """What all cameras see now, side by side, while the panel is open."""
    state, shown = desk.session.state, dict[str, ui.label]()
    with ui.row().classes("setup-previews"):
        for camera in desk.session.plan.cameras:
            with ui.column().classes("setup-preview"):
                CameraView(camera.name, f"what {camera.name} sees")
                shown[camera.name] = ui.label().props('aria-live="polite"')

    def update() -> None:
        for name, text in shown.items():
            words = "live" if state.preview(name) else "there" if name in state.alive else "waiting for it"
            text.set_text(f"{name}: {words}")

    every(0.5, update)


_HEAD = {
    JobState.RUNNING: "running",
    JobState.DONE: "done",
    JobState.FAILED: "failed",
    JobState.CANCELLED: "cancelled; nothing was changed",
}


def job_view(
    desk: Desk, key: str, *, words: Callable[[Job], str] = lambda _: "", early: bool = False, then: str = ""
) -> None:
    """Build the view of progress, output, buttons and result of the job `key`.

    `words` states what its result means, for a person; `early`: what runs can be ended early and still be
    used; the panel `then` follows once the result was taken over.
    """
    shown: tuple[int, JobState] | None = None
    with ui.column().classes("w-full") as box:
        stage = ui.label().props('role="status"')
        bar = ui.linear_progress(value=0.0, show_value=False).props('aria-label="progress"').classes("w-full")
        last = ui.label().classes("text-h6 setup-text").props('aria-live="polite" data-testid="last-line"')
        buttons = ui.row()
        lines = ui.label().classes("setup-lines").props('tabindex=0 role="log" aria-label="All output"')
    result = ui.column().classes("w-full")

    def follow() -> None:
        nonlocal shown
        job = desk.session.jobs.get(key)
        box.set_visibility(job is not None)
        if job is None:
            return
        text = [line for line in job.text if line.strip()]
        running = job.state is JobState.RUNNING
        stage.set_text(f"{job.title}: {job.stage if running and job.stage else _HEAD[job.state]}")
        share = job.share
        bar.props("indeterminate" if share is None and running else "", remove="indeterminate")
        bar.set_value(share or 0.0)
        last.set_text(text[-1] if running and text else "")
        lines.set_text("\n".join(text[-60:]))
        lines.set_visibility(bool(text))
        if (id(job), job.state) == shown:
            return
        shown = (id(job), job.state)
        buttons.clear()
        result.clear()
        if running:
            with buttons:
                _buttons(desk, job, early=early)
        else:
            with result:
                _result(desk, job, words, then)

    every(0.4, follow)


def _buttons(desk: Desk, job: Job, *, early: bool) -> None:
    if early:
        ui.button("That is enough", on_click=lambda: desk.attempt(job.finish)).props('flat icon="done"')
    following = ui.button("Next", on_click=lambda: desk.attempt(job.send)).props('icon="keyboard_return"')
    following.bind_visibility_from(job, "keyboard")
    ui.button("Cancel", on_click=lambda: desk.attempt(job.cancel)).props('flat icon="close"')


def _result(desk: Desk, job: Job, words: Callable[[Job], str], then: str) -> None:
    if job.state is JobState.FAILED:
        ui.label(job.error).classes("setup-error").props('role="alert"')
    if job.state is not JobState.DONE:
        return
    if text := words(job):
        ui.label(text).classes("text-subtitle1 setup-text").props('role="status" data-testid="verdict"')
    if (picture := job.picture) is not None:
        png = base64.b64encode(picture.read_bytes()).decode("ascii")
        image = ui.image(f"data:image/png;base64,{png}").classes("setup-result")
        image.props(f'alt="Result of {job.title}: what was seen, and what is left of it" fit=contain')
    if (page := job.page) is not None:
        download = ui.button(f"Download {page.name}").props('icon="download"')
        download.on_click(lambda: ui.download.content(page.read_bytes(), page.name))
    if not (results := job.results()):
        return
    names = ", ".join(str(path.relative_to(job.work / "tree")) for path in results)
    ui.label(f"New: {names}. The files before are kept under {job.tree / 'old'}.").classes("setup-text")

    async def use() -> None:
        if await desk.attempt(lambda: desk.session.use(job)):
            button.disable()
            ui.notify("In use", type="positive")
            if then:
                desk.go(then)

    button = ui.button("Use it", on_click=use).props('icon="check"')
    if job.used:
        button.disable()
