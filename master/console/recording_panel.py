"""Recording on the page: start, stop and progress.

The recorder is a process of its own; files lie in one folder.
"""

import asyncio
import re
import sys
from datetime import datetime
from pathlib import Path

from nicegui import ui

from common.errors import PhalanxError
from common.messages import Health
from master.console.state import ConsoleState

PROCESS = "record"
RECORDER = "recorder"  # its name on the bus
_NAME = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9_.-]{0,62}")


def recordings_folder(state: ConsoleState) -> Path:
    """Where the page records to and plays from: beside the calibration tree."""
    return state.settings.calibration.resolve().parent / "recordings"


def recording_path(state: ConsoleState, name: str) -> Path:
    """The file of a recording called `name`.

    Raises:
        PhalanxError: That is no plain name: the page never names a folder.
    """
    if not _NAME.fullmatch(name):
        raise PhalanxError(f"{name!r}: a recording is called by letters, digits, - and _ only")
    return recordings_folder(state) / f"{name}.mcap"


def start_recording(state: ConsoleState, name: str, previews: bool) -> Path:
    """Start to record what the master receives and publishes.

    Raises:
        PhalanxError: The name is none, is taken, or the recorder cannot be started.
    """
    path = recording_path(state, name)
    if path.exists():
        raise PhalanxError(f"{path} is there already: take another name")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise PhalanxError(f"{path.parent}: cannot be made: {error.strerror}") from error
    rigs = [word for rig in state.rig_names for word in ("--rig", rig)]
    tree = ["--calibration", str(state.settings.calibration), "--bus", state.settings.bus]
    words = ["record", str(path), *rigs, *tree, *(["--previews"] if previews else [])]
    state.local.start(PROCESS, [sys.executable, "-m", "master", *words], {})
    return path


def progress_words(report: Health | None) -> str:
    """How far the recorder is, by its report."""
    if report is None:
        return ""
    metrics = report.metrics
    seconds, size = metrics.get("recorder.seconds", 0.0), metrics.get("recorder.megabytes", 0.0)
    words = f"{seconds:.0f} s, {size:.1f} MB, {metrics.get('recorder.free_gb', 0.0):.0f} GB free"
    lost = report.counts.get("lost", 0) + report.counts.get("dropped", 0)
    return words + (f", {lost} lost" if lost else ", nothing lost")


def recording_panel(state: ConsoleState) -> None:
    """Build the panel."""
    with ui.element("section").classes("panel").props('aria-label="Recording"'):
        ui.label("Recording").classes("panel-title")
        with ui.row().classes("items-center gap-3"):
            name = ui.input("Name", value=_new_name()).props("dense outlined")
            previews = ui.switch("with small pictures").props("dense")
            button = ui.button("Record", icon="fiber_manual_record").props("unelevated color=negative")
        status = ui.label("").classes("record-status").props('role="status"')
        error = ui.label("").classes("problem").props('role="alert"')

    async def toggle() -> None:
        error.set_text("")
        button.disable()
        try:
            if PROCESS in state.local.running():
                await asyncio.to_thread(state.local.stop, PROCESS)
                name.set_value(_new_name())
            else:
                await asyncio.to_thread(start_recording, state, str(name.value or ""), bool(previews.value))
        except PhalanxError as problem:
            error.set_text(str(problem))
        finally:
            button.enable()

    button.on_click(toggle)

    def update() -> None:
        running = PROCESS in state.local.running()
        button.set_text("Stop recording" if running else "Record")
        button.set_icon("stop" if running else "fiber_manual_record")
        process = state.local.get(PROCESS)
        words = progress_words(state.health.get(RECORDER))
        if words or process is None:
            status.set_text(words and f"recording: {words}")
        else:
            status.set_text("\n".join(process.tail(3)) or ("starting …" if running else ""))

    update()
    update_s = 0.5
    ui.timer(update_s, update)


def _new_name() -> str:
    return datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
