"""Panels of lenses and of all other calibrations run wizards.

Step 4 measures lenses and places from a printed board; each other calibration is a form of its `Wizard`.
"""

import json
from typing import cast

from nicegui import ui

from common.errors import PhalanxError
from master.cli.table import CALIBRATIONS
from master.console.setup.commands import Field, Value, fields_of
from master.console.setup.job import Job
from master.console.setup.parts import Desk, heading, job_view, previews
from master.console.setup.session import LENS
from master.console.setup.wizards import FILLED, GROUPS, WIZARDS, Wizard, recording_stages


def panel_lens(desk: Desk) -> None:
    """Fill the panel."""
    heading(
        "Lenses and places",
        "Hold a printed board still before all cameras, then somewhere else, near and far, tilted every way.",
    )
    with ui.expansion("Print a board", icon="print").classes("w-full"):
        _print(desk)
    with ui.row().classes("items-end"):
        board = ui.input("Board: inner corners, columns x rows", value="9x6").classes("w-72")
        square = ui.number("Side of a square in mm, as measured on the print", value=25.0, min=2.0, max=500.0)
        square.classes("w-80")
        views = ui.number("Views to take", value=20, min=5, max=200, step=1, format="%d").classes("w-40")

    async def start() -> None:
        values: dict[str, Value] = {"board": board.value, "square_mm": square.value, "views": views.value}
        await desk.attempt(lambda: desk.session.start_lens(values))

    with ui.row():
        ui.button("Start taking views", on_click=start).props('icon="photo_camera"')
        ui.button("Next: colours", on_click=lambda: desk.go("colours")).props("flat")
    job_view(desk, lambda: desk.session.jobs.get(LENS), lambda: desk.go("colours"), words=verdict, early=True)
    previews(desk)


def _print(desk: Desk) -> None:
    paper = ui.select(["A4", "A3", "A2", "letter"], label="Paper", value="A4").classes("w-40")

    def draw() -> Job:
        return desk.session.start(WIZARDS["board"], {"paper": paper.value})

    ui.label("Print it at 100 %, measure the ruler (100 mm), glue it on something flat and stiff.").classes(
        "setup-text"
    )
    ui.button("Make the page", on_click=lambda: desk.attempt(draw)).props('icon="grid_on"')
    job_view(desk, lambda: desk.session.jobs.get("board"), lambda: None)


def verdict(job: Job) -> str:
    """What the residuals of the fit mean, and whether to do it again."""
    path = job.work / "result.json"
    return judged(cast(dict[str, object], json.loads(path.read_text()))) if path.exists() else ""


def judged(numbers: dict[str, object]) -> str:
    """The same of the figures of `calibrate cameras stereo --json`."""
    rms = float(cast(float, numbers["rms_px"]))
    pairs = cast(list[dict[str, float]], numbers["pairs"])
    off = [abs(pair["edge_sd_mm"]) / max(abs(pair["edge_mean_mm"]), 1e-9) for pair in pairs]
    cameras = cast(dict[str, dict[str, dict[str, str]]], numbers["cameras"])
    poor = [name for name, lens in cameras.items() if lens["coverage"]["advice"]]
    text = f"Corners fit to {rms:.2f} px; squares come out alike to {100 * max(off, default=0.0):.1f} %. "
    good_px, poor_px = 0.6, 1.2  # of all corners, root mean square
    squares_share = 0.01
    if rms > poor_px or max(off, default=0.0) > 5 * squares_share:
        return (
            text + "Repeat it: the board moved, is not flat, or its squares are of another size than stated."
        )
    if rms > good_px or max(off, default=0.0) > 2 * squares_share:
        return text + "Fair: usable; more views, held stiller, would make it better."
    more = f" It would gain most by more views for {', '.join(poor)}: in corners and tilted." if poor else ""
    return text + "Good: use it." + more


def panel_more(desk: Desk) -> None:
    """Fill the panel with a card for each calibration."""
    heading("More calibrations", "Each makes something better; none is needed for a first hand.")
    for group, wizards in GROUPS.items():
        ui.label(group).classes("text-subtitle1").props('role="heading" aria-level="3"')
        with ui.element("div").classes("setup-cards"):
            for wizard in wizards:
                _card(desk, wizard)


def _card(desk: Desk, wizard: Wizard) -> None:
    with ui.card():
        ui.label(wizard.title).classes("text-subtitle2")
        ui.label(wizard.purpose).classes("text-caption")
        open_ = ui.button("Open", on_click=lambda: desk.go(f"wizard/{wizard.command}")).props("flat")
        open_.props(f'aria-label="Open: {wizard.title}"')


def build_wizard(desk: Desk, wizard: Wizard) -> None:
    """Fill the panel with one wizard."""
    ui.button("All calibrations", on_click=lambda: desk.go("more")).props('flat icon="arrow_back"')
    heading(wizard.title, wizard.purpose)
    ui.label(f"Needed: {wizard.needs}").classes("setup-text")
    with ui.element("ol"):
        for step in wizard.steps:
            with ui.element("li"):
                ui.label(step).classes("setup-text")
    form = _Form(wizard)
    form.build()

    async def start(*, record: bool) -> None:
        values = form.values()
        await desk.attempt(lambda: desk.session.start(wizard, values, record=record))

    with ui.row():
        if (reason := _cannot_record(desk, wizard)) == "" and wizard.prepared:
            ui.button(f"Record {wizard.seconds:.0f} s and start", on_click=lambda: start(record=True)).props(
                'icon="fiber_manual_record"'
            )
        ui.button("Start", on_click=lambda: start(record=False)).props('icon="play_arrow"')
    if reason and wizard.prepared:
        ui.label(reason).classes("setup-text")
    job_view(
        desk, lambda: desk.session.jobs.get(wizard.command), lambda: None, early=wizard.command == "capture"
    )
    if wizard.master != "none":
        previews(desk)


def _cannot_record(desk: Desk, wizard: Wizard) -> str:
    """Return why the page cannot make the recording itself, or ""."""
    if not wizard.prepared:
        return ""
    try:
        recording_stages(desk.session.commands, wizard, {}, desk.session.tree)
    except PhalanxError as error:
        return str(error)
    return ""


class _Form:
    def __init__(self, wizard: Wizard) -> None:
        self._wizard = wizard
        fields = {
            field.name: field for field in fields_of(CALIBRATIONS[wizard.command]) if field.name not in FILLED
        }
        self._first = [fields.pop(name) for name in wizard.first if name in fields]
        page = {"board", "cube"} & {wizard.command}
        self._rest = [field for field in fields.values() if not (page and field.name == "out")]
        self._values: dict[str, Value] = {
            field.name: wizard.defaults.get(field.name, field.default)
            for field in [*self._first, *self._rest]
        }

    def build(self) -> None:
        """Show them."""
        for field in self._first:
            self._show(field)
        if self._rest:
            with ui.expansion("More options", icon="tune").classes("w-full"):
                for field in self._rest:
                    self._show(field)

    def values(self) -> dict[str, Value]:
        """What was entered, by field."""
        return dict(self._values)

    def _put(self, name: str, value: object) -> None:
        self._values[name] = value if isinstance(value, (str, int, float, bool)) else None

    def _show(self, field: Field) -> None:
        value, label = self._values[field.name], field.label + " *" * field.required
        with ui.column().classes("gap-0 w-full max-w-xl"):
            if field.shape == "flag":
                box = ui.checkbox(label, value=bool(value))
                box.on_value_change(lambda event: self._put(field.name, event.value))
            elif field.shape == "choice":
                select = ui.select(
                    list(field.choices), label=label, value=value, clearable=not field.required
                )
                select.on_value_change(lambda event: self._put(field.name, event.value)).classes("w-full")
            elif field.shape in ("number", "whole") and not isinstance(value, str):
                number = ui.number(label, value=value, min=field.low, max=field.high).classes("w-full")
                number.on_value_change(lambda event: self._put(field.name, event.value))
            else:
                text = ui.input(label, value="" if value is None else str(value)).classes("w-full")
                text.on_value_change(lambda event: self._put(field.name, event.value))
            ui.label(field.help).classes("text-caption")
