"""Panel of step 2: which markers, whose hand, and the rig key.

The key keeps unknown senders out.
"""

import re

from msgspec.structs import replace
from nicegui import ui

from master.console.setup.files import KEY_FILE, MARKER_SETS
from master.console.setup.parts import Desk, heading


def _is_name(text: str) -> bool:
    return re.fullmatch(r"[A-Za-z0-9_-]{1,32}", text) is not None


def build(desk: Desk) -> None:
    """Fill the panel."""
    plan = desk.session.plan
    heading("Markers and hand", "Which markers are painted, on whose hand. A measured hand can follow later.")
    name = ui.input(
        "Name of the rig",
        value=plan.rig,
        validation={"letters, digits and - only": _is_name},
    ).classes("w-72")
    ui.label("Markers").props('id="setup-markers"')
    markers = ui.radio({key: title for key, (title, _) in MARKER_SETS.items()}, value=plan.marker_set)
    markers.props('aria-labelledby="setup-markers"')
    ui.label("Hand").props('id="setup-side"')
    side = ui.radio({"right": "Right hand", "left": "Left hand"}, value=plan.side)
    side.props('inline aria-labelledby="setup-side"')
    status = ui.label()
    length = ui.slider(min=140, max=230, step=1, value=plan.length_mm).classes("w-96")
    length.props('aria-label="Length of the hand in millimetres" label')

    def show_scale() -> None:
        status.set_text(
            f"Length of the hand: {length.value or 190:.0f} mm, from the crease of the wrist to the end of"
            " the middle finger"
        )

    show_scale()
    length.on_value_change(show_scale)
    key = desk.session.tree / KEY_FILE
    ui.label(
        f"Key: {key} {'is there' if key.exists() else 'will be made'}; it is the secret that all cameras of"
        " the rig and the master share. Only its owner can read it."
    ).classes("setup-text")

    async def write() -> None:
        new = replace(
            plan,
            rig=str(name.value or "desk"),
            marker_set=str(markers.value),
            side="left" if side.value == "left" else "right",
            length_mm=float(length.value or 190.0),
        )
        if not name.validate():
            return
        if await desk.attempt(lambda: desk.session.choose_rig(new) or True):
            desk.go("start")

    ui.button("Write rig and hand", on_click=write).props('icon="save"')
