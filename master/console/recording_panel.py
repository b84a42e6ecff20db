"""Panels start, stop and play recordings.

The recorder and the player are processes of their own; recordings lie in one folder beside the calibration
tree. What is played takes the place of a master; pause, seek and speed go to whichever player runs.
"""

import json
import re
import time
from collections.abc import Callable, Mapping
from datetime import datetime
from pathlib import Path
from typing import cast

from nicegui import ui
from nicegui.events import GenericEventArguments

from common.errors import PhalanxError
from common.messages import Command, Health
from common.messages.streams import MASTER
from master.console.controls import CommandQueue, Problem, every, offer, panel
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
    state.start(PROCESS, "record", str(path), *rigs, *tree, *(["--previews"] if previews else []))
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
    with panel("Recording"):
        with ui.row().classes("items-center gap-3"):
            name = ui.input("Name", value=_new_name()).props("dense outlined")
            previews = ui.switch("with small pictures").props("dense")
            button = ui.button().props("unelevated color=negative")
        status = ui.label("").classes("record-status").props('role="status"')
        problem = Problem()

    async def toggle() -> None:
        wanted, small = str(name.value or ""), bool(previews.value)
        if await _toggle(state, PROCESS, lambda: start_recording(state, wanted, small), button, problem):
            name.set_value(_new_name())

    button.on_click(toggle)

    def update() -> None:
        running = PROCESS in state.local.running()
        button.set_text("Stop recording" if running else "Record")
        button.set_icon("stop" if running else "fiber_manual_record")
        words = progress_words(state.health.get(RECORDER))
        last = state.local.tail(PROCESS, 3) or "starting …" * running
        status.set_text(f"recording: {words}" if words else last)

    every(0.5, update)


async def _toggle(
    state: ConsoleState, process: str, start: Callable[[], object], button: ui.button, problem: Problem
) -> bool:
    """Stop a process that runs, else start it, and return whether it was stopped."""
    button.disable()
    runs = process in state.local.running()
    try:
        return await problem.attempt((lambda: state.local.stop(process)) if runs else start) and runs
    finally:
        button.enable()


def _new_name() -> str:
    return datetime.now().strftime("%Y-%m-%d_%H-%M-%S")


PLAYBACK = "play"
_SPEEDS = {0.25: "¼ ×", 0.5: "½ ×", 1.0: "1 ×", 2.0: "2 ×", 4.0: "4 ×", 0.0: "as fast as it goes"}
_JUMP_S = 5.0


def recordings(state: ConsoleState) -> list[str]:
    """Names of the recordings in the page's folder, newest first."""
    folder = recordings_folder(state)
    if not folder.is_dir():
        return []
    files = sorted(folder.glob("*.mcap"), key=lambda path: path.stat().st_mtime, reverse=True)
    return [path.stem for path in files[:200]]


def start_playing(state: ConsoleState, name: str) -> None:
    """Play a recording of the page's folder to the bus, in place of a master.

    Raises:
        PhalanxError: There is none of that name, or a master runs already.
    """
    if name not in recordings(state):
        raise PhalanxError("choose a recording")
    if MASTER in state.alive and PLAYBACK not in state.local.running():
        raise PhalanxError(
            "a master runs: end it on the Set-up page first, a recording is played in its place"
        )
    file = recordings_folder(state) / f"{name}.mcap"
    state.start(PLAYBACK, "play", str(file), "--bus", state.settings.bus)


class Controls:
    """Pause, position and speed of whichever player is on the bus."""

    def __init__(self, state: ConsoleState, problem: Problem) -> None:
        """Build the controls; `problem` shows why a command was refused."""
        self._state, self._problem = state, problem
        self._answer: Health | None = None
        self._at, self._speed, self._paused = 0.0, 1.0, False
        self._wanted_s: float | None = None
        self._until_s = 0.0
        with ui.column().classes("w-full gap-1") as self._all:
            with ui.row().classes("items-center gap-2 w-full no-wrap"):
                self._pause = ui.button(icon="pause").props('flat round aria-label="Pause"')
                self._slider = ui.slider(min=0, max=1, step=0.1, value=0)
                self._slider.props('aria-label="Position in seconds"')
                self._words = ui.label("").classes("mono play-at")
            self._speeds = ui.select(_SPEEDS, value=1.0, label="Speed").props("dense outlined")
            self._speeds.classes("known-poses")
        self._command_queue = CommandQueue(self._send, self._on_answer, problem.show)
        self._pause.on_click(lambda: self._command_queue.change("resume" if self._paused else "pause", None))
        self._slider.on_value_change(self._dragged)
        self._slider.on("change", self._sought)  # when it is let go, or its key
        self._speeds.on_value_change(self._sped)

    def update(self) -> None:
        """Show the player's last reported state."""
        now = self._newest()
        position = None if now is None else now.metrics.get("play.position_s")
        self._all.set_visibility(position is not None)
        if now is None or position is None or self._command_queue.busy:
            return
        if self._wanted_s is not None:
            # A jump may take so long; so near to where it went it has arrived; so long a hand rests between two steps.
            near_s, rest_s = 2.0, 1.5
            there = abs(position - self._wanted_s) < near_s
            left_s = self._until_s - time.monotonic()
            if left_s > (_JUMP_S - rest_s if there else 0.0):
                return  # still being moved by hand, or on its way
            self._wanted_s = None
        length = now.metrics.get("play.length_s", 0.0)
        self._paused, self._at = bool(now.metrics.get("play.paused")), round(position, 1)
        self._speed = now.metrics.get("play.speed", 1.0)
        self._slider.props(f"max={max(length, 0.1):.1f}")
        self._slider.set_value(self._at)
        self._words.set_text(f"{position:.1f} of {length:.1f} s")
        self._pause.set_icon("play_arrow" if self._paused else "pause")
        self._pause.props(f'aria-label="{"Resume" if self._paused else "Pause"}"')
        if self._speed in _SPEEDS:
            self._speeds.set_value(self._speed)

    def _newest(self) -> Health | None:
        """The report of the master, or what it answered since."""
        report, answer = self._state.health.get(MASTER), self._answer
        if report is None or answer is None or answer.session != report.session:
            return report
        return max(report, answer, key=lambda one: one.t_ns)

    def _send(self, change: Mapping[str, object]) -> Health | None:
        answer: Health | None = None
        for verb, body in change.items():
            answer = self._state.link.ask(Command(MASTER, verb, "" if body is None else json.dumps(body)))
        return answer

    def _on_answer(self, answer: Health | None) -> None:
        self._answer = answer
        self._problem.set_text("")

    def _dragged(self) -> None:
        value = self._slider.value
        if value is not None and value != self._at:
            self._wanted_s, self._until_s = float(value), time.monotonic() + _JUMP_S
            self._words.set_text(f"to {value:.1f} s")

    def _sought(self, event: GenericEventArguments) -> None:
        """The event has the value: `value` follows a moment later while a hand is quick."""
        self._wanted_s, self._until_s = float(cast(float, event.args)), time.monotonic() + _JUMP_S
        self._command_queue.change("seek", {"t_s": round(self._wanted_s, 1)})

    def _sped(self) -> None:
        factor = float(self._speeds.value or 0.0)
        if factor != self._speed:
            self._speed = factor
            self._command_queue.change("speed", {"factor": factor})


def play_panel(state: ConsoleState) -> None:
    """Build the panel."""
    with panel("Playing"):
        with ui.row().classes("items-center gap-3"):
            which = ui.select(recordings(state), label="Recording").props("dense outlined")
            which.classes("known-poses")
            button = ui.button().props("unelevated")
        problem = Problem()
        controls = Controls(state, problem)
        log = ui.label("").classes("mono").props('role="log" aria-label="Messages of the player"')

    async def toggle() -> None:
        wanted = str(which.value or "")
        await _toggle(state, PLAYBACK, lambda: start_playing(state, wanted), button, problem)

    button.on_click(toggle)

    def update() -> None:
        running = PLAYBACK in state.local.running()
        button.set_text("Stop" if running else "Play")
        button.set_icon("stop" if running else "play_circle")
        offer(which, recordings(state))
        controls.update()
        log.set_text(state.local.tail(PLAYBACK, 3) or "starting …" * running)

    every(0.5, update)
