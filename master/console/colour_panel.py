"""Colours of a camera's markers on the page.

It shows which one is being tuned, its hue, saturation and value, and what is tinted.
"""

import colorsys
from collections.abc import Callable, Mapping
from typing import cast

from nicegui import ui

from master.console.tuner import Range

HUES = 180  # OpenCV's


class ColourPanel:
    """Holds the controls, and the colours that they show."""

    def __init__(
        self,
        markers: tuple[str, ...],
        on_change: Callable[[str, Range], object],
        on_forget: Callable[[str], object],
        tint: Callable[[tuple[str, ...]], object],
    ) -> None:
        """Build them in the present slot.

        Args:
            markers: Names; the first is chosen.
            on_change: Called with each new colour of a marker.
            on_forget: Called with the marker whose colour is to be forgotten.
            tint: Called with whose pixels are to be tinted in the picture.
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
    """The colour in the middle of a range, as CSS."""
    low, high = colour.low, colour.high
    span = (high[0] - low[0]) % HUES
    hue = (low[0] + span / 2.0) % HUES
    r, g, b = colorsys.hsv_to_rgb(hue / HUES, (low[1] + high[1]) / 510.0, (low[2] + high[2]) / 510.0)
    return f"rgb({255 * r:.0f}, {255 * g:.0f}, {255 * b:.0f})"
