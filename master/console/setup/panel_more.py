"""All calibrations as wizards, made of one form each.

A form states what it is for, what is needed, what to do, fields and result.
"""

from nicegui import ui

from common.errors import PhalanxError
from master.cli.table import CALIBRATIONS
from master.console.setup.commands import Field, Value, fields_of
from master.console.setup.parts import Desk, heading, job_view, previews
from master.console.setup.wizards import FILLED, GROUPS, Wizard, recording_stages


def build(desk: Desk) -> None:
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
        desk,
        lambda: desk.session.jobs.get(wizard.command),
        lambda: None,
        early=wizard.command == "capture",
    )
    if wizard.master != "none":
        previews(desk)


def _cannot_record(desk: Desk, wizard: Wizard) -> str:
    """Return why the page cannot make the recording itself.

    Empty where it can, or where none is needed.
    """
    if not wizard.prepared:
        return ""
    try:
        recording_stages(desk.session.commands, wizard, {}, desk.session.tree)
    except PhalanxError as error:
        return str(error)
    return ""


class _Form:
    """The fields of one wizard. Holds what was entered."""

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
