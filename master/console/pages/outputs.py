"""The page Outputs: what goes to other programs, and recordings."""

from nicegui import ui

from master.console.output_panel import output_panel
from master.console.play_panel import play_panel
from master.console.recording_panel import recording_panel
from master.console.state import ConsoleState


def build(state: ConsoleState) -> None:
    """Fill the page."""
    with ui.element("div").classes("output-grid"):
        output_panel(state)
        with ui.element("div").classes("output-side"):
            recording_panel(state)
            play_panel(state)
