"""Page Outputs shows what goes to other programs, and recordings.

The page changes the settings file; a process of its own follows it and sends. File and process functions
block.
"""

import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Literal, get_args, get_origin

import msgspec
from nicegui import ui

from common.calibration import parse, save
from common.calibration.output_settings import OutputSettings
from common.errors import PhalanxError
from common.messages import Health
from common.messages.streams import MASTER
from master.console.controls import Problem, every, panel
from master.console.recording_panel import play_panel, recording_panel
from master.console.state import ConsoleState
from master.outputs.network.outputs import OUTPUTS, switched_on
from master.outputs.network.sender import NAME, settings_of

SENDING = "send"


def outputs_path(state: ConsoleState) -> Path:
    """The settings file that the page edits."""
    return state.settings.calibration / "outputs" / "default.json"


def change_output(state: ConsoleState, name: str, change: dict[str, object]) -> None:
    """Change one output in the settings file, whole or not at all, and `follow` it.

    Raises:
        CalibrationError: The file is broken or read-only, or a value is none; the text names the key.
        PhalanxError: The process cannot be started.
    """
    path = outputs_path(state)
    settings = settings_of(path)
    part = msgspec.structs.replace(OUTPUTS[name].part(settings), **change)
    new = msgspec.structs.replace(settings, **{name: part})
    new = parse(msgspec.json.encode(new), OutputSettings, f"{path}: {name}")
    path.parent.mkdir(parents=True, exist_ok=True)
    save(path, new)
    follow(state)


def follow(state: ConsoleState) -> None:
    """Run the output process exactly while some output is on, unless another's runs.

    Raises:
        CalibrationError: The settings file is broken.
        PhalanxError: It cannot be started.
    """
    wanted = any(switched_on(settings_of(outputs_path(state))).values())
    ours = SENDING in state.local.running()
    if wanted and not ours and not _of_others(state):
        tree = ("--calibration", str(state.settings.calibration), "--bus", state.settings.bus)
        state.start(SENDING, "send", *tree)
    elif not wanted and ours:
        state.local.stop(SENDING)


def _of_others(state: ConsoleState) -> bool:
    """Return whether another output process runs, once ours has left the bus."""
    gone_s = 3.0  # so long one that has ended is still seen on the bus
    until = time.monotonic() + (gone_s if state.local.get(SENDING) is not None else 0.0)
    while NAME in state.alive and time.monotonic() < until:
        time.sleep(0.1)
    return NAME in state.alive


_TITLES = {
    "osc": ("OSC", "Open Sound Control: hands, objects, contact and gestures over UDP"),
    "vmc": ("VMC", "Virtual Motion Capture: the fingers of a VRM avatar"),
    "ros2": ("ROS 2", "topics by a zenoh router, without ROS on this machine"),
    "lsl": ("LSL", "Lab Streaming Layer: a stream for each hand"),
    "web": ("WebSocket", "JSON in the joint order of WebXR, and a page with the hand"),
}


def output_panel(state: ConsoleState) -> None:
    """Build the panel."""
    with panel("Live outputs"):
        ui.label("A process of their own sends them; tracking never waits for it.").classes("soft")
        problem = Problem()
        try:
            settings = settings_of(outputs_path(state))
        except PhalanxError as error:
            problem.set_text(str(error))
            return

        async def change(name: str, values: dict[str, object]) -> None:
            await problem.attempt(lambda: change_output(state, name, values))

        rows = {name: _row(name, settings, change) for name in OUTPUTS}
        start = ui.button("Start sending", icon="play_arrow").props("outline").classes("q-mt-sm")
        start.on_click(lambda: problem.attempt(lambda: follow(state)))
        log = ui.label("").classes("mono").props('role="log" aria-label="Output of the sending process"')

    def update() -> None:
        report = state.health.get(NAME)
        running = SENDING in state.local.running()
        for name, (switch, label) in rows.items():
            words = status_words(name, report)
            label.set_text(words or (waiting_words(state, running, report) if switch.value else ""))
        idle = any(switch.value for switch, _ in rows.values()) and not running and NAME not in state.alive
        start.set_visibility(idle)
        log.set_text(state.local.tail(SENDING, 4))

    every(1.0, update)


def status_words(name: str, report: Health | None) -> str:
    """How an output does, by the report of the sending process."""
    if report is None or not report.metrics.get(f"on.{name}"):
        return ""
    sent, failed, dropped = (report.counts.get(f"{what}.{name}", 0) for what in ("sent", "failed", "dropped"))
    words = f"{'open' if report.metrics.get(f'open.{name}') else 'not open'}, {sent} sent"
    return words + (f", {failed} failed" if failed else "") + (f", {dropped} dropped" if dropped else "")


def waiting_words(state: ConsoleState, running: bool, report: Health | None) -> str:
    """Return why an output that is switched on sends nothing yet."""
    if report is not None:
        return "a moment …"  # the process looks at its file once a second
    if not running and NAME not in state.alive:
        return "nobody sends it"
    return "starting …" if MASTER in state.alive else "waiting for a master"


def _row(
    name: str, settings: OutputSettings, change: Callable[[str, dict[str, object]], Awaitable[None]]
) -> tuple[ui.switch, ui.label]:
    title, what = _TITLES[name]
    part = OUTPUTS[name].part(settings)
    with ui.element("div").classes("output"):
        switch = ui.switch(
            title, value=part.on, on_change=lambda event: change(name, {"on": bool(event.value)})
        )
        switch.props(f'aria-label="{title}: {what}"').classes("output-switch")
        status = ui.label("").classes("soft output-status").props('role="status"')
        ui.label(what).classes("soft output-what")
        with ui.row().classes("gap-2 output-fields"):
            for field in msgspec.structs.fields(part):
                key, value = field.name, getattr(part, field.name)
                if get_origin(field.type) is Literal:
                    box = ui.select([str(one) for one in get_args(field.type)], value=value, label=key)
                    box.on_value_change(lambda event, key=key: change(name, {key: str(event.value)}))
                elif key != "on" and isinstance(value, str | int):
                    box = _field(key, value, lambda entered, key=key: change(name, {key: entered}))
                else:
                    continue
                box.props(f'dense outlined aria-label="{name} {key}"').classes("output-field")
    return switch, status


def _field(key: str, value: str | int, change: Callable[[str | int], Awaitable[None]]) -> ui.input:
    box = ui.input(key.replace("_", " "), value=str(value))
    last = str(value)

    async def done() -> None:
        nonlocal last
        text = str(box.value or "").strip()
        if text != last:
            last = text
            await change(int(text) if isinstance(value, int) and text.isdigit() else text)

    box.on("blur", done)
    box.on("keydown.enter", done)
    return box


def build(state: ConsoleState) -> None:
    """Fill the page."""
    with ui.element("div").classes("output-grid"):
        output_panel(state)
        with ui.element("div").classes("output-side"):
            recording_panel(state)
            play_panel(state)
