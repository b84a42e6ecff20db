"""Filter of one rig on the page Tune.

It is tried on the running master at once, then saved or taken back.
"""

import asyncio
from collections.abc import Callable, Mapping

import msgspec
from nicegui import background_tasks, ui

from common.calibration import FilterCalibration
from common.errors import PhalanxError
from master.console.command_queue import CommandQueue
from master.console.controls import Setting
from master.console.filter_trial import save_filter, saved_filter, try_filter
from master.console.state import ConsoleState

# Name of the key, title, unit, factor to the key's unit, slider from, to, decimals, logarithmic, what it does.
_PARAMETERS: tuple[tuple[str, str, str, float, float, float, int, bool, str], ...] = (
    (
        "min_cutoff_hz",
        "Cut-off at rest",
        "Hz",
        1.0,
        0.5,
        30.0,
        1,
        True,
        "lower: calmer at rest, later to start",
    ),
    ("beta", "Rise with speed", "Hz per m/s", 1.0, 0.0, 6000.0, 0, False, "higher: less lag in quick motion"),
    (
        "d_cutoff_hz",
        "Cut-off of the speed",
        "Hz",
        1.0,
        0.5,
        30.0,
        1,
        True,
        "how quickly the filter follows a change of speed",
    ),
    (
        "jitter_m",
        "Jitter left at rest",
        "mm",
        1e-3,
        0.02,
        3.0,
        2,
        True,
        "noisier signals are filtered more, down to this",
    ),
)


def filter_panel(state: ConsoleState, rig: str) -> None:
    """Build the controls of the filter of `rig`."""
    client = ui.context.client
    settings: dict[str, Setting] = {}
    path = state.rig_path(rig)

    def values() -> dict[str, float]:
        return {name: (settings[name].value or 0.0) * factor for name, _, _, factor, *_ in _PARAMETERS}

    def tried(_: object) -> None:
        error.set_visibility(False)
        status.set_text("in use, not saved")

    def fail(text: str) -> None:
        error.set_text(text)
        error.set_visibility(True)
        with client:
            ui.notify(text, type="negative", multi_line=True, close_button="OK")

    def apply(change: Mapping[str, object]) -> None:
        try_filter(state.link.ask, rig, values())

    command_queue: CommandQueue[None] = CommandQueue(apply, tried, fail)

    def show(now: FilterCalibration) -> None:
        for name, _, _, factor, *_ in _PARAMETERS:
            settings[name].show(float(msgspec.structs.asdict(now)[name]) / factor)

    def do(step: Callable[[], None], text: str) -> None:
        async def work() -> None:
            try:
                await asyncio.to_thread(step)
                now = await asyncio.to_thread(saved_filter, path)
            except PhalanxError as problem:
                fail(str(problem))
                return
            show(now)
            error.set_visibility(False)
            status.set_text(text)

        background_tasks.create(work(), name=f"filter {rig}")

    with ui.element("section").classes("panel filter-panel").props(f'aria-label="Filter of {rig}"'):
        ui.label(f"The 1 € filter of {rig}").classes("panel-title")
        ui.label(
            "Every change acts on the running master at once; save writes it to the rig's file."
        ).classes("soft")
        for name, title, unit, _, low, high, digits, log, does in _PARAMETERS:
            settings[name] = Setting(
                title,
                unit,
                low,
                high,
                lambda _value: command_queue.change("filter", True),
                digits=digits,
                log=log,
            )
            ui.label(does).classes("soft setting-hint")
        error = ui.label("").classes("problem").props('role="alert"')
        error.set_visibility(False)
        with ui.row().classes("panel-foot"):
            ui.button(
                "Save", icon="save", on_click=lambda: do(lambda: save_filter(path, values()), "saved")
            ).props("unelevated")

            def back() -> None:
                now = saved_filter(path)
                try_filter(state.link.ask, rig, msgspec.structs.asdict(now))

            ui.button("Revert", icon="undo", on_click=lambda: do(back, "as saved")).props("outline")
            status = ui.label("").classes("soft")
    do(lambda: None, "")
