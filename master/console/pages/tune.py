"""Page Tune sets cameras, marker colours and the filter of each rig.

Every change acts at once on the running slave or master, until it is saved or taken back.
"""

import asyncio
import colorsys
from collections.abc import Callable, Mapping
from typing import cast

import msgspec
from nicegui import background_tasks, ui
from nicegui.client import Client

from common.calibration import FilterCalibration
from common.calibration.camera_settings import ROI_LEAST, ROI_MOST
from common.errors import CalibrationError, PhalanxError
from master.console.controls import (
    GAINS,
    CameraView,
    CommandQueue,
    InUse,
    Range,
    Setting,
    colour_body,
    full_frame_uv,
    save_filter,
    saved_filter,
    try_filter,
    update_copy,
)
from master.console.state import ConsoleState

HUES = 180  # OpenCV's


class ColourPanel:
    """Controls of the markers' hue, saturation and value, and what is tinted."""

    def __init__(
        self,
        markers: tuple[str, ...],
        on_change: Callable[[str, Range], object],
        on_forget: Callable[[str], object],
        tint: Callable[[tuple[str, ...]], object],
    ) -> None:
        """Build them in the present slot.

        `on_change` gets each new colour of a marker, `on_forget` the marker whose colour is to be forgotten,
        `tint` the markers whose pixels are to be tinted in the picture.
        """
        self._markers, self._on_change, self._tint = markers, on_change, tint
        self._colours: dict[str, Range] = {}
        self._showing = False
        self._chosen = markers[0] if markers else None
        options = {name: name for name in markers}
        with ui.row().classes("marker-choice items-center"):
            self._which = ui.toggle(options, value=self._chosen, on_change=lambda: self._choose())
            self._which.props('no-caps dense unelevated toggle-color=primary aria-label="Marker"')
        with ui.row().classes("items-center gap-2"):
            self._swatch = ui.element("span").classes("swatch").props('role="img"')
            self._words = ui.label("").classes("soft")
            ui.space()
            self._tints = ui.select(
                {"none": "nothing tinted", "one": "this marker tinted", "all": "all markers tinted"},
                value="one",
                on_change=lambda: self._retint(),
            ).props('dense outlined aria-label="What is tinted in the picture"')
        self._rows = ui.column().classes("w-full gap-0")
        with self._rows:
            self._hue = _range("Hue", 0, HUES - 1, self._changed)
            with ui.row().classes("wrap-row"):
                self._wraps = ui.switch(
                    "through red (the hue wraps around)", on_change=lambda: self._changed()
                )
            self._saturation = _range("Saturation", 0, 255, self._changed)
            self._value = _range("Value", 0, 255, self._changed)
            forget = ui.button("Forget this colour", icon="delete").props("flat dense")
            forget.on_click(lambda: None if self._chosen is None else on_forget(self._chosen))
        self._choose()

    @property
    def marker(self) -> str | None:
        """The marker that is being tuned."""
        return self._chosen

    def show(self, colours: Mapping[str, Range]) -> None:
        """Show what is in use."""
        self._colours = dict(colours)
        self._display()

    def _choose(self) -> None:
        self._chosen = cast(str | None, self._which.value)
        self._display()
        self._retint()

    def _retint(self) -> None:
        chosen = (self._chosen,) if self._chosen is not None else ()
        self._tint({"none": (), "one": chosen, "all": self._markers}[str(self._tints.value)])

    def _display(self) -> None:
        colour = None if self._chosen is None else self._colours.get(self._chosen)
        self._rows.set_visibility(colour is not None)
        if colour is None:
            self._words.set_text("no colour yet: click on the marker in the picture")
            self._swatch.style("background: transparent")
            return
        self._showing = True
        low, high = colour.low, colour.high
        wraps = low[0] > high[0]
        self._wraps.set_value(wraps)
        self._hue.set_value({"min": min(low[0], high[0]), "max": max(low[0], high[0])})
        self._saturation.set_value({"min": low[1], "max": high[1]})
        self._value.set_value({"min": low[2], "max": high[2]})
        self._showing = False
        self._describe(colour)

    def _describe(self, colour: Range) -> None:
        middle = _middle(colour)
        self._swatch.style(f"background: {middle}")
        self._swatch.props(f'aria-label="{self._chosen}: about {middle}"')
        low, high = colour.low, colour.high
        self._words.set_text(f"H {low[0]}–{high[0]}, S {low[1]}–{high[1]}, V {low[2]}–{high[2]}")

    def _changed(self) -> None:
        if self._showing or self._chosen is None:
            return
        hue, saturation, value = (_ends(one) for one in (self._hue, self._saturation, self._value))
        if self._wraps.value:
            hue = hue[::-1]
        colour = Range((hue[0], saturation[0], value[0]), (hue[1], saturation[1], value[1]))
        if colour == self._colours.get(self._chosen):
            return
        self._colours[self._chosen] = colour
        self._describe(colour)
        self._on_change(self._chosen, colour)


def _range(title: str, low: int, high: int, changed: Callable[[], None]) -> ui.range:
    with ui.element("div").classes("setting range"):
        ui.label(title).classes("setting-title")
        made = ui.range(min=low, max=high, step=1, on_change=lambda: changed())
        made.props(f'label aria-label="{title}, lowest and highest"').classes("setting-slider")
        if title == "Hue":
            made.classes("hue")
    return made


def _ends(control: ui.range) -> tuple[int, int]:
    value = control.value or {"min": 0.0, "max": 0.0}
    return round(value["min"]), round(value["max"])


def _middle(colour: Range) -> str:
    low, high = colour.low, colour.high
    span = (high[0] - low[0]) % HUES
    hue = (low[0] + span / 2.0) % HUES
    r, g, b = colorsys.hsv_to_rgb(hue / HUES, (low[1] + high[1]) / 510.0, (low[2] + high[2]) / 510.0)
    return f"rgb({255 * r:.0f}, {255 * g:.0f}, {255 * b:.0f})"


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
        """Build them in the present slot; `markers` are those of its rigs."""
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
        """Save the slave's file, then this machine's copy where the slave is elsewhere."""
        saved = self._tuner.save()
        path = self._state.camera_path(self._camera)
        if path.exists():
            update_copy(path, saved)
        return saved

    def _do(self, step: Callable[[], InUse], done: str = "", state: str = "") -> None:
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
        self._now = now
        self._error.set_visibility(False)
        self._spin.set_visibility(False)
        for name, setting in self._settings.items():
            if name in now.wanted:
                setting.show(now.wanted[name], now.read.get(name))
            setting.set_visible(name in now.wanted)
        self._colours.show(now.markers)

    def _fail(self, text: str) -> None:
        with self._client:
            ui.notify(text, type="negative", multi_line=True, close_button="OK")
        if self._now is not None:
            self._show(self._now)  # which hides the error
        self._error.set_text(text)
        self._error.set_visibility(True)


# Name of the key, title, unit, factor to the key's unit, slider from, to, decimals, logarithmic, what it does.
# fmt: off
_PARAMETERS: tuple[tuple[str, str, str, float, float, float, int, bool, str], ...] = (
    ("min_cutoff_hz", "Cut-off at rest", "Hz", 1.0, 0.5, 30.0, 1, True, "lower: calmer at rest, later to start"),
    ("beta", "Rise with speed", "Hz per m/s", 1.0, 0.0, 6000.0, 0, False, "higher: less lag in quick motion"),
    ("d_cutoff_hz", "Cut-off of the speed", "Hz", 1.0, 0.5, 30.0, 1, True,
     "how quickly the filter follows a change of speed"),
    ("jitter_m", "Jitter left at rest", "mm", 1e-3, 0.02, 3.0, 2, True,
     "noisier signals are filtered more, down to this"),
)
# fmt: on


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


def build(state: ConsoleState) -> None:
    """Fill the page."""
    cameras = state.cameras()
    rigs = state.rigs()
    if not cameras:
        with ui.element("div").classes("panel empty"):
            ui.label("No camera to tune yet")
            ui.label("The Set-up page starts one.").classes("soft")
        return
    filtered = [name for name, rig in rigs.items() if rig.kind == "markers"]
    names = [*cameras, *(f"filter of {rig}" for rig in filtered)]
    with (
        ui.tabs().classes("tune-tabs").props("dense no-caps align=left outside-arrows mobile-arrows") as tabs
    ):
        for name in names:
            ui.tab(name, icon="videocam" if name in cameras else "filter_alt").props("inline-label")
    with ui.tab_panels(tabs, value=names[0], animated=False).classes("tune-panels").props("keep-alive=false"):
        for camera in cameras:
            markers = tuple(name for rig in rigs.values() if camera in rig.cameras for name in rig.markers)
            with ui.tab_panel(camera):
                CameraPanel(state, camera, markers)
        for rig in filtered:
            with ui.tab_panel(f"filter of {rig}"):
                filter_panel(state, rig)
