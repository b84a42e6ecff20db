"""Page Plots: the last minute of latency, rates, loss, clocks and temperature."""

from collections.abc import Sequence
from dataclasses import dataclass

from nicegui import ui

from master.console.controls import every, panel
from master.console.state import SPAN_S, ConsoleState, History

_GREY = "#7d8590"  # readable on light and on dark
_COLOURS = ("#2f81f7", "#e3702f", "#2da44e", "#bf4b8a", "#9a6700", "#0e9aa7", "#8250df", "#cf222e")


@dataclass(frozen=True, slots=True)
class Plot:
    """One plot: title with unit, and how the names of its series begin."""

    title: str
    starts: tuple[str, ...]
    from_zero: bool = True


PLOTS = (
    Plot("Latency (ms)", ("latency_p50_ms", "latency_p99_ms")),
    Plot("Poses per second", ("poses_per_s",)),
    Plot("Rate of each camera (frames/s)", ("rate_hz.",)),
    Plot("Lost on the way (messages/s)", ("lost_per_s.",)),
    Plot("Clock against the master's (ms)", ("offset_ms.",), from_zero=False),
    Plot("Uncertainty of the clock (µs)", ("offset_sigma_us.",)),
    Plot("Temperature (°C)", ("celsius.",), from_zero=False),
)
_NAMES = {"latency_p50_ms": "median", "latency_p99_ms": "99 of 100", "poses_per_s": "poses"}


def build(state: ConsoleState) -> None:
    """Fill the page."""
    with ui.element("div").classes("plots"):
        charts = [_chart(plot) for plot in PLOTS]

    def update() -> None:
        for plot, (chart, words) in zip(PLOTS, charts, strict=True):
            names = [name for start in plot.starts for name in state.history.names(start)]
            chart.options["series"] = [
                line(name, state.history, _COLOURS[k % len(_COLOURS)]) for k, name in enumerate(names)
            ]
            chart.update()
            words.set_text(latest_words(names, state.history))

    every(1.0, update)


def line(name: str, history: History, colour: str) -> dict[str, object]:
    """One series as the chart wants it."""
    points = [[round(age, 1), round(value, 4)] for age, value in history.series(name)]
    return {
        "name": label(name),
        "type": "line",
        "data": points,
        "showSymbol": False,
        "animation": False,
        "lineStyle": {"width": 2},
        "color": colour,
    }


def label(name: str) -> str:
    """How a series is called."""
    return _NAMES.get(name, name.split(".", 1)[-1])


def latest_words(names: Sequence[str], history: History) -> str:
    """The newest values as text, which is also what a screen reader finds."""
    values = [(label(name), history.latest(name)) for name in names]
    return ", ".join(f"{who} {value:.4g}" for who, value in values if value is not None) or "nothing yet"


def _chart(plot: Plot) -> tuple[ui.echart, ui.label]:
    grey = {"color": _GREY}
    with panel(plot.title, "plot"):
        words = ui.label("").classes("soft plot-words")
        chart = ui.echart(
            {
                "animation": False,
                "textStyle": {"fontFamily": "inherit"},
                "grid": {"left": 48, "right": 12, "top": 28, "bottom": 24},
                "legend": {"show": True, "top": 0, "right": 0, "textStyle": grey, "type": "scroll"},
                "xAxis": {
                    "type": "value",
                    "min": -SPAN_S,
                    "max": 0,
                    "axisLabel": {"color": _GREY, "formatter": "{value} s"},
                    "splitLine": {"show": False},
                    "axisLine": {"lineStyle": grey},
                },
                "yAxis": {
                    "type": "value",
                    "scale": not plot.from_zero,
                    "min": 0 if plot.from_zero else None,
                    "axisLabel": grey,
                    "splitLine": {"lineStyle": {"color": _GREY, "opacity": 0.25}},
                },
                "series": [],
            }
        ).classes("chart")
        chart.props("aria-hidden=true")
    return chart, words
