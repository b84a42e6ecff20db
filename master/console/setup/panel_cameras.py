"""Panels of steps 1 and 2 choose cameras, markers and hand.

Step 2 also makes the rig key, which keeps unknown senders out.
"""

import re
from pathlib import Path

from msgspec.structs import replace
from nicegui import ui

from common.errors import CalibrationError
from master.console.setup.files import (
    KEY_FILE,
    KINDS,
    MARKER_SETS,
    WORLDS,
    CameraPlan,
    Kind,
    Plan,
    modes_of,
    project_tree,
)
from master.console.setup.parts import Desk, heading

NAMES = ("left", "right", "left2", "right2", "camera5", "camera6", "camera7", "camera8")
_TALK = {"usb": "Device, such as /dev/v4l/by-id/…", "pi": "Host of the Pi, such as pi@left.local"}


def panel_cameras(desk: Desk) -> None:
    """Fill the panel."""
    heading("Choose cameras", "Two or more. Lenses, places and colours are measured by the next steps.")
    rows = _Rows(desk.session.plan)
    with ui.row().classes("items-end"):
        kind = ui.select(KINDS, label="Kind of cameras", value=rows.kind).classes("w-72")
        count = ui.select(rows.counts(), label="How many cameras", value=rows.count).classes("w-48")
    table = ui.column().classes("w-full")

    def show() -> None:
        table.clear()
        with table:
            rows.show()

    def change() -> None:
        try:
            rows.choose(kind.value or "simulated", int(count.value or 2))
        except CalibrationError as error:
            desk.problem.show(str(error))
            return
        count.set_options(rows.counts(), value=rows.count)
        show()

    kind.on_value_change(change)
    count.on_value_change(change)
    show()

    async def write() -> None:
        try:
            plan = rows.plan()
        except CalibrationError as error:
            desk.problem.show(str(error))
        else:
            await desk.attempt(lambda: desk.session.choose_cameras(plan), then="rig")

    ui.button("Write camera files", on_click=write).props('icon="save"')


class _Rows:
    """The cameras as they are entered."""

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self._cameras = list(plan.cameras)
        self._truth = plan.truth
        self.kind: Kind = self._cameras[0].kind if self._cameras else "simulated"
        self.count = len(self._cameras) or 2
        self.choose(self.kind, self.count)

    def counts(self) -> list[int]:
        return list(WORLDS) if self.kind == "simulated" else list(range(2, len(NAMES) + 1))

    def choose(self, kind: Kind, count: int) -> None:
        """Take another kind for all, or another number."""
        if kind != self.kind:
            self._cameras = []
        self.kind = kind
        self.count = count if count in self.counts() else 2
        mode = next(iter(modes_of(kind)))
        more = [
            CameraPlan(name=name, kind=kind, mode=mode) for name in NAMES[len(self._cameras) : self.count]
        ]
        self._cameras = [*self._cameras[: self.count], *more]

    def show(self) -> None:
        for place in range(len(self._cameras)):
            self._row(place)
        if self.kind != "simulated":
            return
        if not self._truth:
            try:
                self._truth = str(project_tree())
            except CalibrationError as error:
                ui.label(str(error)).classes("setup-error")
        truth = ui.input("Folder of the simulated world", value=self._truth).classes("w-full max-w-xl")
        truth.on_value_change(lambda event: setattr(self, "_truth", event.value or ""))
        ui.label(
            "Simulated cameras see a drawn hand. Their calibration is measured from their pictures, as with"
            " real ones; only the paints and lenses of that world stand in its folder."
        ).classes("setup-text")

    def plan(self) -> Plan:
        """What was entered.

        Raises:
            CalibrationError: A name or a mode is missing.
        """
        for camera in self._cameras:
            if not camera.name.strip() or camera.mode not in modes_of(camera.kind):
                raise CalibrationError("each camera needs a name, a sensor and a mode")
        truth = str(Path(self._truth).resolve()) if self.kind == "simulated" else ""
        return replace(self._plan, cameras=tuple(self._cameras), truth=truth)

    def _row(self, place: int) -> None:
        camera, number = self._cameras[place], place + 1

        def put(key: str, value: object) -> None:
            self._cameras[place] = replace(self._cameras[place], **{key: str(value or "").strip()})

        with ui.row().classes("items-end w-full"):
            name = ui.input(f"Name of camera {number}", value=camera.name).classes("w-40")
            name.on_value_change(lambda event: put("name", event.value))
            modes = modes_of(camera.kind)
            label = f"Sensor and mode of camera {number}"
            mode = ui.select(modes, label=label, value=camera.mode if camera.mode in modes else None)
            mode.classes("w-96").on_value_change(lambda event: put("mode", event.value))
            if camera.kind == "simulated":
                name.props("readonly")
                return
            device = ui.input(f"{_TALK[camera.kind]} ({number})", value=camera.device).classes("w-80")
            device.on_value_change(lambda event: put("device", event.value))
            options = ui.input(f"More options of its slave ({number})", value=camera.options).classes("w-80")
            options.on_value_change(lambda event: put("options", event.value))


def panel_rig(desk: Desk) -> None:
    """Fill the panel."""
    plan = desk.session.plan
    heading("Markers and hand", "Which markers are painted, on whose hand. A measured hand can follow later.")
    plain = re.compile(r"[A-Za-z0-9_-]{1,32}")
    name = ui.input(
        "Name of the rig",
        value=plan.rig,
        validation={"letters, digits and - only": lambda text: plain.fullmatch(text) is not None},
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
    about = "Length of the hand: {:.0f} mm, from the crease of the wrist to the end of the middle finger"
    status.bind_text_from(length, "value", about.format)
    key = desk.session.tree / KEY_FILE
    ui.label(
        f"Key: {key} {'is there' if key.exists() else 'will be made'}; it is the secret that all cameras of"
        " the rig and the master share. Only its owner can read it."
    ).classes("setup-text")

    async def write() -> None:
        new = replace(
            plan,
            rig=name.value,
            marker_set=markers.value,
            side=side.value,
            length_mm=float(length.value or plan.length_mm),
        )
        if name.validate():
            await desk.attempt(lambda: desk.session.choose_rig(new), then="start")

    ui.button("Write rig and hand", on_click=write).props('icon="save"')
