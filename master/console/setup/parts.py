"""Panels share these parts and the view of a running calibration."""

import base64
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from nicegui import run, ui

from common.errors import PhalanxError
from master.console.controls import every
from master.console.setup.job import Job, JobState
from master.console.setup.session import Session

T = TypeVar("T")
_EMPTY = "data:image/gif;base64,R0lGODlhAQABAIAAAAAAAP///ywAAAAAAQABAAACAUwAOw=="


@dataclass(slots=True)
class Desk:
    """One window of the set-up page.

    `go` shows the panel of a step; `complain` shows an error until the next action, or none if empty.
    """

    session: Session
    go: Callable[[str], None]
    complain: Callable[[str], None]

    async def attempt(self, action: Callable[[], T]) -> T | None:
        """Run a slow action off the event loop; an error is shown, and None is returned."""
        self.complain("")
        try:
            return await run.io_bound(action)
        except PhalanxError as error:
            self.complain(str(error))
            return None


def jpeg_url(jpeg: bytes) -> str:
    """A JPEG as the address of an image."""
    return "data:image/jpeg;base64," + base64.b64encode(jpeg).decode("ascii")


def png_url(png: bytes) -> str:
    """A PNG as the address of an image."""
    return "data:image/png;base64," + base64.b64encode(png).decode("ascii")


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
    state = desk.session.state
    with ui.row().classes("setup-previews"):
        shown = {camera.name: _preview(camera.name) for camera in desk.session.plan.cameras}

    def update() -> None:
        for name, (image, text) in shown.items():
            state.look(name)
            picture = state.preview(name)
            if picture is not None:
                image.set_source(jpeg_url(picture.jpeg))
            there = name in state.alive
            text.set_text(f"{name}: {'live' if picture else 'there' if there else 'waiting for it'}")

    ui.timer(0.2, update)


def _preview(name: str) -> tuple[ui.image, ui.label]:
    with ui.column().classes("setup-preview"):
        image = (
            ui.image(_EMPTY).props(f'alt="what {name} sees" no-spinner no-transition').classes("setup-image")
        )
        text = ui.label().props('aria-live="polite"')
    return image, text


CSS = """
.setup { display: grid; grid-template-columns: 15rem minmax(0, 1fr); gap: 1.5rem; align-items: start; width: 100% }
.setup-steps { display: flex; flex-direction: column; gap: .25rem; width: 100% }
.setup-steps .q-btn__content { justify-content: flex-start; text-align: left; flex-wrap: nowrap; width: 100% }
.setup-steps .q-btn { text-transform: none; width: 100% }
.setup-step-why { font-size: .75rem; opacity: .75; line-height: 1.2; white-space: normal }
.setup-panel { display: flex; flex-direction: column; gap: .75rem; min-width: 0 }
.setup-text { max-width: 46rem; white-space: pre-line }
.setup-error { color: var(--q-negative); font-weight: 600; white-space: pre-line }
.setup-command { font-family: monospace; padding: .5rem; border: 1px solid currentColor; border-radius: 4px;
  overflow-x: auto; white-space: pre; flex: 1; min-width: 0 }
.setup-previews { gap: 1rem; width: 100% }
.setup-preview { gap: .25rem; flex: 1 1 16rem; max-width: 26rem }
.setup-image { width: 100%; min-height: 8rem; background: #8882 }
.setup-lines { font-family: monospace; font-size: .8rem; white-space: pre-wrap; max-height: 16rem; overflow-y: auto;
  width: 100%; padding: .5rem; background: #8882 }
.setup-result { max-width: 100%; width: 52rem }
.setup-cards { display: grid; grid-template-columns: repeat(auto-fill, minmax(15rem, 1fr)); gap: .75rem; width: 100% }
.setup-cards .q-btn { text-transform: none }
.body--dark .setup .q-btn--flat, .body--dark .setup .q-btn--outline { --q-primary: #8ab4f8 }
.setup ol { list-style: decimal; padding-left: 1.5rem }
.body--dark .setup-error { color: #ff8a80 }
@media (max-width: 800px) { .setup { grid-template-columns: minmax(0, 1fr) } }
"""


_HEAD = {
    JobState.RUNNING: "running",
    JobState.DONE: "done",
    JobState.FAILED: "failed",
    JobState.CANCELLED: "cancelled; nothing was changed",
}


def job_view(
    desk: Desk,
    job: Callable[[], Job | None],
    used: Callable[[], None],
    *,
    words: Callable[[Job], str] = lambda _job: "",
    early: bool = False,
) -> None:
    """Build the view of progress, output, buttons and result of what `job` returns.

    `used` is called once its result was taken over; `words` states what it means, for a person; `early`: what
    runs can be ended early and still be used.
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
        now = job()
        box.set_visibility(now is not None)
        if now is None:
            return
        text = [line for line in now.text if line.strip()]
        running = now.state is JobState.RUNNING
        stage.set_text(f"{now.title}: {now.stage if running and now.stage else _HEAD[now.state]}")
        share = now.share
        bar.props(f"{'' if share is not None or not running else 'indeterminate'}", remove="indeterminate")
        bar.set_value(0.0 if share is None else share)
        last.set_text(text[-1] if running and text else "")
        # shown
        lines.set_text("\n".join(text[-60:]))
        lines.set_visibility(bool(text))
        if (id(now), now.state) != shown:
            shown = (id(now), now.state)
            _buttons(desk, buttons, now, early=early)
            result.clear()
            with result:
                if not running:
                    _result(desk, now, used, words)

    every(0.4, follow)


def _buttons(desk: Desk, row: ui.row, job: Job, *, early: bool) -> None:
    row.clear()
    if job.state is not JobState.RUNNING:
        return

    with row:
        if early:
            ui.button("That is enough", on_click=lambda: desk.attempt(job.finish)).props('flat icon="done"')
        ui.button("Next", on_click=lambda: desk.attempt(job.send)).props(
            'icon="keyboard_return"'
        ).bind_visibility_from(job, "keyboard")
        ui.button("Cancel", on_click=lambda: desk.attempt(job.cancel)).props('flat icon="close"')


def _result(desk: Desk, job: Job, used: Callable[[], None], words: Callable[[Job], str]) -> None:
    if job.state is JobState.FAILED:
        ui.label(job.error).classes("setup-error").props('role="alert"')
        return
    if job.state is not JobState.DONE:
        return
    if text := words(job):
        ui.label(text).classes("text-subtitle1 setup-text").props('role="status" data-testid="verdict"')
    if (picture := job.picture) is not None:
        image = ui.image(png_url(picture.read_bytes())).classes("setup-result")
        image.props(f'alt="Result of {job.title}: what was seen, and what is left of it" fit=contain')
    if (page := job.page) is not None:
        ui.button(f"Download {page.name}", on_click=lambda: _download(page)).props('icon="download"')
    if not job.results():
        return
    names = ", ".join(str(path.relative_to(job.work / "tree")) for path in job.results())
    ui.label(f"New: {names}. The files before are kept under {job.tree / 'old'}.").classes("setup-text")

    async def use() -> None:
        if await desk.attempt(lambda: desk.session.use(job)):
            button.disable()
            ui.notify("In use", type="positive")
            used()

    button = ui.button("Use it", on_click=use).props('icon="check"')
    if job.used:
        button.disable()


def _download(page: Path) -> None:
    ui.download.content(page.read_bytes(), page.name)
