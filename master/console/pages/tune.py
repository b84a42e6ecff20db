"""Page Tune sets cameras, marker colours and the filter of each rig.

Every change acts at once on the running slave or master, until it is saved or taken back.
"""

import colorsys
import math
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import NamedTuple, cast

from nicegui import background_tasks, ui

from common.calibration import HsvRange
from common.calibration.camera_settings import ROI_LEAST, ROI_MOST
from master.console.controls import (
    GAINS,
    CameraView,
    CommandQueue,
    FilterTuner,
    InUse,
    Problem,
    Tuner,
    colour_body,
    no_camera,
)
from master.console.state import ConsoleState

HUES = 180  # OpenCV's


class Row(NamedTuple):
    """One setting of a table.

    Attributes:
        key: Its name in `InUse.wanted`.
        low, high: Ends of the slider, in the unit shown; a number beyond may be typed.
        log: Whether the slider is logarithmic: the value spans decades.
        factor: Of the unit shown, in that of the key.
    """

    key: str
    title: str
    unit: str
    low: float
    high: float
    digits: int
    log: bool = False
    factor: float = 1.0
    hint: str = ""


# fmt: off
_CAMERA = (
    Row("exposure_us", "Exposure", "µs", 50.0, 30_000.0, 0, log=True),
    Row("analogue_gain", "Gain", "", 1.0, 16.0, 2),
    Row("red_gain", "White balance, red", "", 0.2, 4.0, 2),
    Row("blue_gain", "White balance, blue", "", 0.2, 4.0, 2),
    Row("frame_rate_hz", "Frame rate", "Hz", 5.0, 310.0, 1),
    Row("roi_margin", "Search margin", "", ROI_LEAST, ROI_MOST, 2),
)
_FILTER = (
    Row("min_cutoff_hz", "Cut-off at rest", "Hz", 0.5, 30.0, 1, log=True,
        hint="lower: calmer at rest, later to start"),
    Row("beta", "Rise with speed", "Hz per m/s", 0.0, 6000.0, 0, hint="higher: less lag in quick motion"),
    Row("d_cutoff_hz", "Cut-off of the speed", "Hz", 0.5, 30.0, 1, log=True,
        hint="how quickly the filter follows a change of speed"),
    Row("jitter_m", "Jitter left at rest", "mm", 0.02, 3.0, 2, log=True, factor=1e-3,
        hint="noisier signals are filtered more, down to this"),
)
# fmt: on


class Setting:
    """Slider and number field of one row.

    A change by a person is passed once to `on_change`; `show` changes the controls and calls nothing.
    """

    def __init__(self, row: Row, on_change: Callable[[str, float], object]) -> None:
        """Build the row; `on_change` gets its key and each new value, and may refuse."""
        self._row, self._on_change = row, on_change
        self._value: float | None = None  # in the unit shown
        label = f"{row.title} ({row.unit})" if row.unit else row.title
        with ui.element("div").classes("setting") as self._line:
            ui.label(row.title).classes("setting-title")
            low, high = (0.0, 1.0) if row.log else (row.low, row.high)
            step = 0.001 if row.log else 10.0**-row.digits
            self._slider = ui.slider(min=low, max=high, step=step, value=low)
            self._slider.props(f'aria-label="{label}"').classes("setting-slider")
            self._number = ui.number(value=None, format=f"%.{row.digits}f", suffix=row.unit or None)
            self._number.props(f'dense outlined aria-label="{label}, number"').classes("setting-number")
            self._back = ui.label("").classes("setting-back").props('role="status"')
        if row.hint:
            ui.label(row.hint).classes("soft setting-hint")
        self._slider.on_value_change(lambda event: self._moved(event.value))
        # Typed digit by digit: only what is finished is meant.
        self._number.on("keydown.enter", lambda: self._typed())
        self._number.on("blur", lambda: self._typed())

    @property
    def value(self) -> float | None:
        """The value shown, in the unit of the key; None: none was shown yet."""
        return None if self._value is None else self._value * self._row.factor

    def show(self, now: InUse) -> None:
        """Show what is wanted, and what was read back; nothing where it is not known."""
        key, digits = self._row.key, self._row.digits
        self._line.set_visibility(key in now.wanted)
        if key not in now.wanted:
            return
        self._value = value = now.wanted[key] / self._row.factor
        self._slider.set_value(self._place(value))
        self._number.set_value(round(value, digits))
        read = now.read.get(key, now.wanted[key]) / self._row.factor
        same = math.isclose(read, value, rel_tol=0.01, abs_tol=0.6 * 10.0**-digits)
        self._back.set_text("" if same else f"is {read:.{digits}f}")

    def _moved(self, place: float | None) -> None:
        row = self._row
        if place is None or self._value is None or place == self._place(self._value):
            return  # `show` moved it
        self._change(round(row.low * (row.high / row.low) ** place if row.log else place, row.digits))

    def _typed(self) -> None:
        value, half = self._number.value, 0.5 * 10.0**-self._row.digits
        if value is None or (self._value is not None and math.isclose(value, self._value, abs_tol=half)):
            return
        self._change(float(value))

    def _change(self, value: float) -> None:
        self._value = value
        self._number.set_value(value)
        self._slider.set_value(self._place(value))
        self._on_change(self._row.key, value * self._row.factor)

    def _place(self, value: float) -> float:
        row = self._row
        inside = min(max(value, row.low), row.high)
        if not row.log:
            return round(inside, row.digits)
        return round(math.log(inside / row.low) / math.log(row.high / row.low), 3)


class SettingsPanel:
    """Settings of a table, each tried at once; saved, or taken back to what holds."""

    def __init__(
        self,
        title: str,
        about: str,
        tuner: Tuner | FilterTuner,
        rows: Iterable[Row],
        where: str,
        on_show: Callable[[InUse], object] = lambda _: None,
    ) -> None:
        """Build it in the present slot.

        `where` is what `tuner` saves to, for a person; `on_show` gets all that is shown.
        """
        self._client, self._tuner, self._on_show = ui.context.client, tuner, on_show
        self._queue = CommandQueue(tuner.set, self._show, self.fail)
        with ui.row().classes("panel-head"):
            ui.label(title).classes("panel-title")
            self._spin = ui.spinner(size="sm").props('aria-label="waiting for the answer"')
        if about:
            ui.label(about).classes("soft")
        self._settings = {row.key: Setting(row, self._changed) for row in rows}
        self._problem = Problem()
        with ui.row().classes("panel-foot"):
            save = ui.button("Save", icon="save").props("unelevated")
            save.on_click(lambda: self.do(tuner.save, f"saved to {where}", "saved"))
            ui.button("Revert", icon="undo", on_click=lambda: self.do(tuner.revert)).props("outline")
            self._saved = ui.label("").classes("soft")
        background_tasks.create(self.do(tuner.refresh), name=f"tune {where}")

    def change(self, key: str, value: object) -> None:
        """Try `key: value`, as `CommandQueue.change`."""
        self._queue.change(key, value)
        self._saved.set_text("not saved")

    async def do(self, step: Callable[[], InUse], done: str = "", saved: str = "") -> None:
        """Run a step of the tuner and show its answer, with `done` as a message."""
        self._spin.set_visibility(True)
        try:
            answered = await self._problem.attempt(step, self._show)
        finally:
            self._spin.set_visibility(False)
        if not answered:
            self._show_held()
            return
        self._saved.set_text(saved)
        if done:
            with self._client:
                ui.notify(done, type="positive")

    def fail(self, text: str) -> None:
        """Show an error, and what holds."""
        self._show_held()
        self._problem.show(text)

    def _changed(self, key: str, value: float) -> None:
        if key in GAINS:
            self.change("colour_gains", [self._settings[gain].value or 1.0 for gain in GAINS])
        else:
            self.change(key, value)

    def _show(self, now: InUse) -> None:
        self._problem.set_text("")
        for setting in self._settings.values():
            setting.show(now)
        self._on_show(now)

    def _show_held(self) -> None:
        if self._tuner.now.wanted:  # it has answered before
            for setting in self._settings.values():
                setting.show(self._tuner.now)
            self._on_show(self._tuner.now)


class ColourPanel:
    """Controls of the markers' hue, saturation and value, and what is tinted."""

    def __init__(
        self,
        markers: tuple[str, ...],
        on_change: Callable[[str, HsvRange], object],
        on_forget: Callable[[str], object],
        tint: Callable[[tuple[str, ...]], object],
    ) -> None:
        """Build them in the present slot.

        `on_change` gets each new colour of a marker, `on_forget` the marker whose colour is to be forgotten,
        `tint` the markers whose pixels are to be tinted in the picture.
        """
        self._markers, self._on_change, self._tint = markers, on_change, tint
        self._colours: dict[str, HsvRange] = {}
        self._showing = False
        with ui.row().classes("marker-choice items-center"):
            first = markers[0] if markers else None
            self._which = ui.toggle(list(markers), value=first, on_change=self._choose)
            self._which.props('no-caps dense unelevated toggle-color=primary aria-label="Marker"')
        with ui.row().classes("items-center gap-2"):
            self._swatch = ui.element("span").classes("swatch").props('role="img"')
            self._words = ui.label("").classes("soft")
            ui.space()
            self._tints = ui.select(
                {"none": "nothing tinted", "one": "this marker tinted", "all": "all markers tinted"},
                value="one",
                on_change=self._retint,
            ).props('dense outlined aria-label="What is tinted in the picture"')
        with ui.column().classes("w-full gap-0") as self._rows:
            hue = self._range("Hue", HUES - 1).classes("hue")
            with ui.row().classes("wrap-row"):
                self._wraps = ui.switch("through red (the hue wraps around)", on_change=self._changed)
            self._channels = (hue, self._range("Saturation", 255), self._range("Value", 255))
            forget = ui.button("Forget this colour", icon="delete").props("flat dense")
            forget.on_click(lambda: None if self.marker is None else on_forget(self.marker))
        self._choose()

    @property
    def marker(self) -> str | None:
        """The marker that is being tuned."""
        return cast(str | None, self._which.value)

    def show(self, colours: Mapping[str, HsvRange]) -> None:
        """Show what is in use."""
        self._colours = dict(colours)
        self._display()

    def _range(self, title: str, high: int) -> ui.range:
        with ui.element("div").classes("setting range"):
            ui.label(title).classes("setting-title")
            made = ui.range(min=0, max=high, step=1, on_change=self._changed)
            return made.props(f'label aria-label="{title}, lowest and highest"').classes("setting-slider")

    def _choose(self) -> None:
        self._display()
        self._retint()

    def _retint(self) -> None:
        chosen = (self.marker,) if self.marker is not None else ()
        self._tint({"none": (), "one": chosen, "all": self._markers}[str(self._tints.value)])

    def _display(self) -> None:
        colour = None if self.marker is None else self._colours.get(self.marker)
        self._rows.set_visibility(colour is not None)
        if colour is None:
            self._words.set_text("no colour yet: click on the marker in the picture")
            self._swatch.style("background: transparent")
            return
        self._showing = True
        self._wraps.set_value(colour.hsv_low[0] > colour.hsv_high[0])
        for channel, low, high in zip(self._channels, colour.hsv_low, colour.hsv_high, strict=True):
            channel.set_value({"min": min(low, high), "max": max(low, high)})
        self._showing = False
        self._describe(colour)

    def _describe(self, colour: HsvRange) -> None:
        middle = _middle(colour)
        self._swatch.style(f"background: {middle}")
        self._swatch.props(f'aria-label="{self.marker}: about {middle}"')
        ends = zip("HSV", colour.hsv_low, colour.hsv_high, strict=True)
        self._words.set_text(", ".join(f"{channel} {low}–{high}" for channel, low, high in ends))

    def _changed(self) -> None:
        if self._showing or self.marker is None:
            return
        ends = [cast(dict[str, float], channel.value) for channel in self._channels]
        hue, saturation, value = ((round(one["min"]), round(one["max"])) for one in ends)
        if self._wraps.value:
            hue = hue[::-1]
        low, high = zip(hue, saturation, value, strict=True)
        colour = HsvRange(hsv_low=low, hsv_high=high)
        if colour == self._colours.get(self.marker):
            return
        self._colours[self.marker] = colour
        self._describe(colour)
        self._on_change(self.marker, colour)


def _middle(colour: HsvRange) -> str:
    low, high = colour.hsv_low, colour.hsv_high
    hue = (low[0] + ((high[0] - low[0]) % HUES) / 2.0) % HUES
    r, g, b = colorsys.hsv_to_rgb(hue / HUES, (low[1] + high[1]) / 510.0, (low[2] + high[2]) / 510.0)
    return f"rgb({255 * r:.0f}, {255 * g:.0f}, {255 * b:.0f})"


def camera_panel(state: ConsoleState, camera: str) -> None:
    """Build the controls of one camera and its rigs' markers."""
    tuner = state.tuner(camera)

    async def picked(x: float, y: float, t_ns: int) -> None:
        marker = colours.marker
        if marker is not None:
            await settings.do(
                lambda: state.pick(camera, marker, x, y, t_ns), f"took the colour of {marker}", "not saved"
            )

    def change(marker: str, colour: HsvRange) -> object:
        return settings.change("markers", {marker: colour_body(colour)})

    async def forget(marker: str) -> None:
        await settings.do(lambda: tuner.forget(marker), f"forgot the colour of {marker}", "not saved")

    with ui.element("div").classes("tune-grid"):
        with ui.element("section").classes("panel tune-picture").props(f'aria-label="Picture of {camera}"'):
            keys = "Arrow keys move the cross, Enter picks the colour there"
            view = CameraView(camera, f"Picture of camera {camera}. {keys}", picked)
            ui.label("Click on a marker in the picture to take its colour.").classes("soft")
            colours = ColourPanel(
                state.markers_of(camera),
                change,
                forget,
                view.tint,
            )
        with ui.element("section").classes("panel tune-controls").props(f'aria-label="Settings of {camera}"'):
            where = f"the camera file of {camera}"
            settings = SettingsPanel(
                "Settings", "", tuner, _CAMERA, where, lambda now: colours.show(now.markers)
            )


def filter_panel(state: ConsoleState, rig: str) -> None:
    """Build the controls of the filter of `rig`."""
    with ui.element("section").classes("panel filter-panel").props(f'aria-label="Filter of {rig}"'):
        about = "Every change acts on the running master at once; save writes it to the rig's file."
        tuner = FilterTuner(rig, state.rig_path(rig), state.link.ask)
        SettingsPanel(f"The 1 € filter of {rig}", about, tuner, _FILTER, f"the file of rig {rig}")


def build(state: ConsoleState) -> None:
    """Fill the page."""
    tabs: dict[str, tuple[str, Callable[[], None]]] = {}
    for camera in state.cameras():
        tabs[camera] = "videocam", partial(camera_panel, state, camera)
    if not tabs:
        no_camera("No camera to tune yet")
        return
    for name, rig in state.rigs().items():
        if rig.kind == "markers":
            tabs[f"filter of {name}"] = "filter_alt", partial(filter_panel, state, name)
    with ui.tabs().classes("tune-tabs").props("dense no-caps align=left outside-arrows mobile-arrows") as bar:
        for name, (icon, _) in tabs.items():
            ui.tab(name, icon=icon).props("inline-label")
    with (
        ui.tab_panels(bar, value=next(iter(tabs)), animated=False)
        .classes("tune-panels")
        .props("keep-alive=false")
    ):
        for name, (_, fill) in tabs.items():
            with ui.tab_panel(name):
                fill()
