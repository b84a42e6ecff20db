"""Controls of one camera on the page Tune.

They cover settings, colours, picking colours in the picture, save and revert.
"""

import asyncio
from collections.abc import Callable

from nicegui import background_tasks, ui
from nicegui.client import Client

from common.calibration.camera_settings import ROI_LEAST, ROI_MOST
from common.errors import CalibrationError, PhalanxError
from master.console.colour_panel import ColourPanel
from master.console.command_queue import CommandQueue
from master.console.controls import Setting
from master.console.elements import CameraView, full_frame_uv
from master.console.local_mirror import update_copy
from master.console.state import ConsoleState
from master.console.tuner import GAINS, InUse, Range, colour_body

# Name of the metric, title, unit, slider from, to, decimals, logarithmic.
_SETTINGS: tuple[tuple[str, str, str, float, float, int, bool], ...] = (
    ("exposure_us", "Exposure", "µs", 50.0, 30_000.0, 0, True),
    ("analogue_gain", "Gain", "", 1.0, 16.0, 2, False),
    ("red_gain", "White balance, red", "", 0.2, 4.0, 2, False),
    ("blue_gain", "White balance, blue", "", 0.2, 4.0, 2, False),
    ("frame_rate_hz", "Frame rate", "Hz", 5.0, 120.0, 0, False),
    ("roi_margin", "Search margin", "", ROI_LEAST, ROI_MOST, 2, False),
)


class CameraPanel:
    """Controls of one page for one camera, with the last answer of the slave."""

    def __init__(self, state: ConsoleState, camera: str, markers: tuple[str, ...]) -> None:
        """Build them in the present slot.

        Args:
            state: What the console knows.
            camera: Name of the camera.
            markers: Those of its rigs.
        """
        self._state, self._camera, self._markers = state, camera, markers
        self._tuner = state.tuner(camera)
        self._client: Client = ui.context.client
        self._now: InUse | None = None
        self._command_queue = CommandQueue(self._tuner.set, self._show, self._fail)
        self._settings: dict[str, Setting] = {}
        with ui.element("div").classes("tune-grid"):
            with (
                ui.element("section").classes("panel tune-picture").props(f'aria-label="Picture of {camera}"')
            ):
                self._picture()
            with (
                ui.element("section")
                .classes("panel tune-controls")
                .props(f'aria-label="Settings of {camera}"')
            ):
                self._controls()
        self._do(self._tuner.refresh)

    def _picture(self) -> None:
        view = CameraView(
            self._camera,
            f"Picture of camera {self._camera}. Arrow keys move the cross, Enter picks the colour there",
            self._picked,
        )
        ui.label("Click on a marker in the picture to take its colour.").classes("soft")
        self._colours = ColourPanel(self._markers, self._coloured, self._forget, view.tint)

    def _controls(self) -> None:
        with ui.row().classes("panel-head"):
            ui.label("Settings").classes("panel-title")
            self._spin = ui.spinner(size="sm").props('aria-label="waiting for the camera"')
        for name, title, unit, low, high, digits, log in _SETTINGS:
            change = self._changer(name)
            self._settings[name] = Setting(title, unit, low, high, change, digits=digits, log=log)
        self._error = ui.label("").classes("problem").props('role="alert"')
        self._error.set_visibility(False)
        with ui.row().classes("panel-foot"):
            ui.button("Save", icon="save", on_click=self._save).props("unelevated")
            ui.button("Revert", icon="undo", on_click=lambda: self._do(self._tuner.revert)).props("outline")
            self._state_of_file = ui.label("").classes("soft")

    def _changer(self, name: str) -> Callable[[float], None]:
        def change(value: float) -> None:
            if name in GAINS:
                pair = [self._settings[gain].value or 1.0 for gain in GAINS]
                self._command_queue.change("colour_gains", pair)
            else:
                self._command_queue.change(name, value)
            self._state_of_file.set_text("not saved")

        return change

    def _coloured(self, marker: str, colour: Range) -> None:
        self._command_queue.change("markers", colour_body(colour), part=marker)
        self._state_of_file.set_text("not saved")

    def _forget(self, marker: str) -> None:
        self._do(lambda: self._tuner.forget(marker), f"forgot the colour of {marker}", "not saved")

    def _picked(self, x: float, y: float, t_ns: int) -> None:
        marker = self._colours.marker
        if marker is None:
            return
        try:
            camera = self._state.camera(self._camera)
        except CalibrationError as error:
            self._fail(str(error))
            return
        uv = full_frame_uv(x, y, camera.width_px, camera.height_px)
        self._do(lambda: self._tuner.pick(marker, uv, t_ns), f"took the colour of {marker}", "not saved")

    def _save(self) -> None:
        self._do(self._save_both, f"saved to the camera file of {self._camera}", "saved")

    def _save_both(self) -> InUse:
        """Save the slave's file, then the copy on this machine.

        The copy is a different file where the slave is elsewhere.
        """
        saved = self._tuner.save()
        path = self._state.camera_path(self._camera)
        if path.exists():
            update_copy(path, saved)
        return saved

    def _do(self, step: Callable[[], InUse], done: str = "", state: str = "") -> None:
        """Ask on a thread, then show the answer or the error."""

        async def work() -> None:
            self._spin.set_visibility(True)
            try:
                answer = await asyncio.to_thread(step)
            except PhalanxError as error:
                self._fail(str(error))
                return
            finally:
                self._spin.set_visibility(False)
            self._show(answer)
            self._state_of_file.set_text(state)
            if done:
                with self._client:
                    ui.notify(done, type="positive")

        background_tasks.create(work(), name=f"tune {self._camera}")

    def _show(self, now: InUse) -> None:
        """Show what the camera has; what it does not know at all is not offered."""
        self._now = now
        self._error.set_visibility(False)
        self._spin.set_visibility(False)
        for name, setting in self._settings.items():
            if name in now.wanted:
                setting.show(now.wanted[name], now.read.get(name))
            setting.set_visible(name in now.wanted)
        self._colours.show(now.markers)

    def _fail(self, text: str) -> None:
        """Show the slave's error text unchanged, and the settings now in effect."""
        self._error.set_text(text)
        self._error.set_visibility(True)
        with self._client:
            ui.notify(text, type="negative", multi_line=True, close_button="OK")
        if self._now is not None:
            now, shown = self._now, text
            self._show(now)
            self._error.set_text(shown)
            self._error.set_visibility(True)
