"""Controls that the pages share.

They include a labelled slider with a number beside it, and the value that was read back.
"""

import math
from collections.abc import Callable

from nicegui import ui


class Setting:
    """Slider and number field for one value, with the value last shown.

    The slider is logarithmic where the value spans decades.

    A change by a person is passed once to `on_change`; `show` changes the controls and calls nothing.
    """

    def __init__(
        self,
        title: str,
        unit: str,
        low: float,
        high: float,
        on_change: Callable[[float], object],
        *,
        digits: int = 2,
        log: bool = False,
    ) -> None:
        """Build one row of the form.

        Args:
            title: What it is.
            unit: Its unit, may be empty.
            low, high: What the slider spans; a number beyond may be typed, and whoever gets it may refuse.
            on_change: Called with each new value.
            digits: Decimals shown.
            log: Whether the slider is logarithmic.
        """
        self._low, self._high, self._log, self._digits = low, high, log, digits
        self._on_change = on_change
        self._value: float | None = None
        label = f"{title} ({unit})" if unit else title
        with ui.element("div").classes("setting") as self._row:
            ui.label(title).classes("setting-title")
            step = 0.001 if log else 10.0**-digits
            ends = (0.0, 1.0) if log else (low, high)
            self._slider = ui.slider(min=ends[0], max=ends[1], step=step, value=ends[0])
            self._slider.props(f'aria-label="{label}"').classes("setting-slider")
            self._number = ui.number(value=None, format=f"%.{digits}f", suffix=unit or None)
            self._number.props(f'dense outlined aria-label="{label}, number"').classes("setting-number")
            self._back = ui.label("").classes("setting-back").props('role="status"')
        self._slider.on_value_change(lambda event: self._moved(event.value))
        # Typed digit by digit: only what is finished is meant.
        self._number.on("keydown.enter", lambda: self._typed())
        self._number.on("blur", lambda: self._typed())

    @property
    def value(self) -> float | None:
        """The value shown; None: none was shown yet."""
        return self._value

    def show(self, value: float, read: float | None = None) -> None:
        """Show what is wanted, and what was read back; None: it was not."""
        self._value = value
        self._slider.set_value(self._place(value))
        self._number.set_value(round(value, self._digits))
        same = read is None or math.isclose(read, value, rel_tol=0.01, abs_tol=0.6 * 10.0**-self._digits)
        self._back.set_text("" if read is None or same else f"is {read:.{self._digits}f}")

    def set_visible(self, on: bool) -> None:
        """Offer it, or not: a camera that does not know a setting has none to change."""
        self._row.set_visibility(on)

    def _moved(self, place: float | None) -> None:
        if place is None or self._value is None or place == self._place(self._value):
            return  # `show` moved it
        self._change(self._at(place), number=True)

    def _typed(self) -> None:
        value = self._number.value
        if value is None or (
            self._value is not None and math.isclose(value, self._value, abs_tol=0.5 * 10.0**-self._digits)
        ):
            return
        self._change(float(value), number=False)

    def _change(self, value: float, *, number: bool) -> None:
        self._value = value
        if number:
            self._number.set_value(value)
        else:
            self._slider.set_value(self._place(value))
        self._on_change(value)

    def _place(self, value: float) -> float:
        """Where on the slider a value is, on its steps."""
        inside = min(max(value, self._low), self._high)
        if not self._log:
            return round(inside, self._digits)
        return round(math.log(inside / self._low) / math.log(self._high / self._low), 3)

    def _at(self, place: float) -> float:
        return round(self._low * (self._high / self._low) ** place if self._log else place, self._digits)
