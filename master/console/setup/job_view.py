"""View of a running calibration: progress, output, what to press, result."""

from collections.abc import Callable
from pathlib import Path

from nicegui import ui

from master.console.setup.job import Job, JobState
from master.console.setup.parts import Desk, png_url

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
    """Build the view; it follows whatever `job` returns.

    Args:
        desk: Of the window.
        job: The job to show; None: none yet.
        used: Called once its result was taken over.
        words: What its result means, for a person.
        early: Whether what runs can be ended early and still be used.
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

    follow()
    poll_s = 0.4
    ui.timer(poll_s, follow)


def _buttons(desk: Desk, row: ui.row, job: Job, *, early: bool) -> None:
    row.clear()
    if job.state is not JobState.RUNNING:
        return

    async def cancel() -> None:
        await desk.attempt(job.cancel)

    async def finish() -> None:
        await desk.attempt(job.finish)

    async def following() -> None:
        await desk.attempt(job.send)

    with row:
        if early:
            ui.button("That is enough", on_click=finish).props('flat icon="done"')
        ui.button("Next", on_click=following).props('icon="keyboard_return"').bind_visibility_from(
            job, "keyboard"
        )
        ui.button("Cancel", on_click=cancel).props('flat icon="close"')


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
