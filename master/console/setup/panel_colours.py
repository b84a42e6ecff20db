"""Panel of step 5 samples the colours of the markers.

A click on each marker in each camera's picture has the slave sample it.
"""

from collections.abc import Callable

from nicegui import ui

from common.calibration import RigCalibration, load
from common.errors import CalibrationError
from master.console.controls import CameraView
from master.console.setup.parts import Desk, heading


def panel_colours(desk: Desk) -> None:
    """Fill the panel."""
    session = desk.session
    heading(
        "Colours of the markers",
        "Hold the hand still, choose a camera and a marker, and click on it in the picture. What the camera would then"
        " take for the marker is tinted: all of the marker, and nothing else. By keyboard: go to the picture with Tab,"
        " move the cross with the arrow keys (Shift: further) and press Enter.",
    )
    try:
        rig = load(session.state.rig_path(session.plan.rig), RigCalibration)
    except CalibrationError as error:
        ui.label(f"{error}; first do the steps before").classes("setup-error")
        return
    if session.plan.simulated and session.view != "still":
        still = ui.button("Let the simulated hand be held still").props('icon="pan_tool"')

        async def hold() -> None:
            if await desk.attempt(lambda: session.show("still")):
                still.set_visibility(False)

        still.on_click(hold)
    _ColourChoice(desk, rig)


def _known(desk: Desk, camera: str) -> set[str]:
    try:
        return set(desk.session.state.camera(camera).markers or {})
    except CalibrationError:
        return set()  # the first step reports what is wrong with it


class _ColourChoice:
    """Picture to click on, what is being picked, and which markers each camera knows."""

    def __init__(self, desk: Desk, rig: RigCalibration) -> None:
        self._desk, self._rig = desk, rig
        self._known = {name: _known(desk, name) & set(rig.markers) for name in rig.cameras}
        self._picked: set[str] = set()
        self._cameras = _toggle("Camera", rig.cameras, self._show_camera)
        self._markers = _toggle("Marker", rig.markers, self._show_state)
        self._status = ui.label().classes("text-subtitle1").props('role="status" data-testid="picked"')
        self._box = ui.element("div").classes("w-full max-w-2xl")
        with ui.row():
            ui.button("Save colours", on_click=self._save).props('icon="save"')
            ui.button("Next: track", on_click=lambda: desk.go("track")).props("flat")
        self._show_camera()

    @property
    def _camera(self) -> str:
        return str(self._cameras.value)

    def _show_camera(self) -> None:
        self._box.clear()
        with self._box:
            label = "Picture of the camera: click on the marker"
            # Nothing moves here: few pictures leave the machine to the cameras, which it may be that runs them.
            self._view = CameraView(self._camera, label, self._pick, pause_ms=250)
        self._markers.set_value(self._rig.markers[0])
        self._show_state()

    def _show_state(self) -> None:
        camera, marker, known = self._camera, str(self._markers.value), self._known[self._camera]
        self._view.tint((marker,) if marker in known else sorted(known))
        missing = [name for name in self._rig.markers if name not in known]
        done = "save them" if camera in self._picked else "click on one to take it anew"
        todo = f"click on {missing[0]}" if missing else f"all markers are known; {done}"
        self._status.set_text(f"{camera}: {len(known)} of {len(self._rig.markers)} markers known; {todo}")

    async def _pick(self, x: float, y: float, t_ns: int) -> None:
        camera, marker, state = self._camera, str(self._markers.value), self._desk.session.state
        if not await self._desk.attempt(lambda: state.pick(camera, marker, x, y, t_ns)):
            return
        known = self._known[camera]
        known.update(state.tuner(camera).now.markers)  # `|=` with the keys of a dict would make another set
        self._picked.add(camera)
        ui.notify(f"{camera}: {marker} is known", type="positive")
        if missing := [name for name in self._rig.markers if name not in known]:
            self._markers.set_value(missing[0])
        self._show_state()

    async def _save(self) -> None:
        names = [name for name in self._rig.cameras if name in self._picked]
        if not names:
            self._desk.problem.show("no marker was clicked on yet")
            return
        tuners = [self._desk.session.state.tuner(name) for name in names]
        if await self._desk.attempt(lambda: [tuner.save() for tuner in tuners]):
            ui.notify(f"saved: {', '.join(names)}", type="positive")
            self._status.set_text(f"saved: {', '.join(names)}")


def _toggle(title: str, options: tuple[str, ...], on_change: Callable[[], None]) -> ui.toggle:
    key = f"setup-{title.lower()}"
    with ui.row().classes("items-end"):
        ui.label(title).props(f'id="{key}"')
        toggle = ui.toggle(list(options), value=options[0], on_change=on_change)
        return toggle.props(f'aria-labelledby="{key}" no-caps')
