"""Panel of step 5 samples the colours of the markers.

A click on each marker in each camera's picture, converted to a pixel of the whole frame, has the slave sample
it.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from msgspec.structs import replace
from nicegui import events, ui

from common.calibration import CameraCalibration, HsvRange, RigCalibration, load, save
from common.errors import CalibrationError
from common.messages import Command, Health, Preview
from common.messages.picture_size import jpeg_size
from master.console.controls import InUse
from master.console.setup.files import keep_old
from master.console.setup.parts import Desk, heading, jpeg_url


def pixel_of(
    camera: CameraCalibration, preview_px: tuple[int, int], at_px: tuple[float, float]
) -> tuple[float, float]:
    """Return the full-frame pixel under a preview's; whole numbers: pixel centres."""
    scale_u, scale_v = camera.width_px / preview_px[0], camera.height_px / preview_px[1]
    u, v = (at_px[0] + 0.5) * scale_u - 0.5, (at_px[1] + 0.5) * scale_v - 0.5
    return min(max(u, 0.0), camera.width_px - 1.0), min(max(v, 0.0), camera.height_px - 1.0)


def pick(camera: str, marker: str, uv: tuple[float, float]) -> Command:
    """Return the command that samples a colour around a pixel of the newest frame."""
    return Command(camera, "pick", json.dumps({"marker": marker, "uv": [round(uv[0], 1), round(uv[1], 1)]}))


def ranges_of(health: Health) -> dict[str, HsvRange]:
    """Return the colours in use that a camera's answer reports."""
    markers = InUse.of(health).markers
    return {name: HsvRange(hsv_low=one.low, hsv_high=one.high) for name, one in markers.items()}


def keep_colours(tree: Path, camera: str, ranges: Mapping[str, HsvRange]) -> Path:
    """Write the colours that another machine's camera reports into its file here.

    Raises:
        CalibrationError: The file is missing, broken, or cannot be written.
    """
    path = tree / "cameras" / f"{camera}.json"
    file = load(path, CameraCalibration)
    markers = {**(file.markers or {}), **ranges}
    if markers != file.markers:
        keep_old(tree, path)
        save(path, replace(file, markers=markers))
    return path


_KEYS = {"ArrowLeft": (-1, 0), "ArrowRight": (1, 0), "ArrowUp": (0, -1), "ArrowDown": (0, 1)}


@dataclass(slots=True)
class _Choice:
    camera: str
    marker: str
    at: tuple[float, float] | None = None
    size: tuple[int, int] | None = None


def panel_colours(desk: Desk) -> None:
    """Fill the panel."""
    session = desk.session
    heading(
        "Colours of the markers",
        "Hold the hand still, choose a camera and a marker, and click on it in the picture. What the camera would then"
        " take for the marker is tinted: all of the marker, and nothing else. By keyboard: go to the picture with Tab,"
        " move the cross with the arrow keys (Shift: finer) and press Enter.",
    )
    try:
        rig = load(session.tree / "rigs" / f"{session.plan.rig}.json", RigCalibration)
    except CalibrationError as error:
        ui.label(f"{error}; first do the steps before").classes("setup-error")
        return
    _serve(desk)
    choice = _ColourChoice(desk, rig)
    with ui.row().classes("items-end"):
        ui.label("Camera").props('id="setup-camera"')
        camera = ui.toggle(list(rig.cameras), value=rig.cameras[0]).props('aria-labelledby="setup-camera"')
    with ui.row().classes("items-end"):
        ui.label("Marker").props('id="setup-marker"')
        marker = ui.toggle(list(rig.markers), value=rig.markers[0]).props(
            'aria-labelledby="setup-marker" no-caps'
        )
    camera.on_value_change(lambda event: choice.choose(str(event.value), rig.markers[0], marker))
    marker.on_value_change(lambda event: choice.aim(str(event.value)))
    choice.build(marker)


def _serve(desk: Desk) -> None:
    """Offer to hold the simulated hand still."""
    session = desk.session
    if session.plan.simulated and session.view != "still":

        async def hold() -> None:
            if await desk.attempt(lambda: session.show("still") or True):
                button.set_visibility(False)

        button = ui.button("Let the simulated hand be held still", on_click=hold).props('icon="pan_tool"')


def _known(desk: Desk, camera: str) -> set[str]:
    path = desk.session.tree / "cameras" / f"{camera}.json"
    try:
        return set(load(path, CameraCalibration).markers or {})
    except CalibrationError:
        return set()  # the first step reports what is wrong with it


class _ColourChoice:
    """Picture to click on, what is being picked, and which markers each camera knows."""

    def __init__(self, desk: Desk, rig: RigCalibration) -> None:
        self._desk, self._rig = desk, rig
        self._choice = _Choice(rig.cameras[0], rig.markers[0])
        self._known = {name: _known(desk, name) & set(rig.markers) for name in rig.cameras}
        self._picked: set[str] = set()
        self._newest: Preview | None = None

    def choose(self, camera: str, marker: str, toggle: ui.toggle) -> None:
        """Go on with another camera."""
        self._choice = _Choice(camera, marker)
        self._newest = None
        toggle.set_value(marker)

    def aim(self, marker: str) -> None:
        """Pick another marker next."""
        self._choice.marker = marker

    def build(self, toggle: ui.toggle) -> None:
        """Picture, what is known, and what to do with it."""
        self._toggle = toggle
        self._status = ui.label().classes("text-subtitle1").props('role="status" data-testid="picked"')
        self._image = ui.interactive_image(on_mouse=self._click, events=["click"], cross=True)
        self._image.classes("w-full max-w-2xl setup-image").props(
            'tabindex=0 role="application" aria-label="Picture of the camera: click on the marker"'
        )
        self._image.on("keydown", self._key, args=["key", "shiftKey"])
        with ui.row():
            ui.button("Save colours", on_click=self._save).props('icon="save"')
            ui.button("Next: track", on_click=lambda: self._desk.go("track")).props("flat")
        ui.timer(0.2, self._show)
        self._show_state()

    async def _click(self, event: events.MouseEventArguments) -> None:
        self._choice.at = (event.image_x, event.image_y)
        await self._pick()

    async def _key(self, event: events.GenericEventArguments) -> None:
        size, key = self._choice.size, str(event.args.get("key"))
        if size is None:
            return
        if key == "Enter":
            await self._pick()
        elif key in _KEYS:
            step_px, fine_px = 8.0, 1.0
            step = fine_px if event.args.get("shiftKey") else step_px
            u, v = self._choice.at or (size[0] / 2, size[1] / 2)
            du, dv = _KEYS[key]
            self._choice.at = (
                min(max(u + step * du, 0.0), size[0] - 1.0),
                min(max(v + step * dv, 0.0), size[1] - 1.0),
            )
            self._draw()

    async def _pick(self) -> None:
        choice, session = self._choice, self._desk.session
        if choice.at is None or choice.size is None:
            self._desk.complain(f"{choice.camera}: there is no picture yet; start the cameras (step 3)")
            return
        size, at = choice.size, choice.at

        def ask() -> dict[str, object]:
            file = load(session.tree / "cameras" / f"{choice.camera}.json", CameraCalibration)
            answer = session.state.link.ask(pick(choice.camera, choice.marker, pixel_of(file, size, at)))
            return dict(ranges_of(answer))

        found = await self._desk.attempt(ask)
        self._draw()
        if found is not None:
            self._known[choice.camera] |= set(found)
            self._picked.add(choice.camera)
            ui.notify(f"{choice.camera}: {choice.marker} is known", type="positive")
            missing = [name for name in self._rig.markers if name not in self._known[choice.camera]]
            if missing:
                self._toggle.set_value(missing[0])
            self._show_state()

    async def _save(self) -> None:
        session = self._desk.session
        kinds = {camera.name: camera.kind for camera in session.plan.cameras}
        names = [name for name in self._rig.cameras if name in self._picked]
        if not names:
            self._desk.complain("no marker was clicked on yet")
            return

        def save() -> bool:
            for name in names:
                answer = session.state.link.ask(Command(name, "save"))
                if kinds.get(name) == "pi":  # the camera's own file is on its Pi
                    keep_colours(session.tree, name, ranges_of(answer))
            return True

        if await self._desk.attempt(save):
            ui.notify(f"saved: {', '.join(names)}", type="positive")
            self._status.set_text(f"saved: {', '.join(names)}")

    def _show(self) -> None:
        choice, state = self._choice, self._desk.session.state
        mask = (choice.marker,) if choice.marker in self._known[choice.camera] else ()
        shown = mask or tuple(sorted(self._known[choice.camera]))
        state.look(choice.camera, shown)
        preview = state.preview(choice.camera)
        if preview is None:
            if choice.size is None:
                self._status.set_text(
                    f"{choice.camera}: {state.preview_error(choice.camera) or 'waiting for its picture'}"
                )
            return
        if preview is self._newest:
            return
        if choice.size is None:
            choice.size = jpeg_size(preview.jpeg)
            self._show_state()
        self._newest = preview
        self._image.set_source(jpeg_url(preview.jpeg))

    def _draw(self) -> None:
        if self._choice.at is None:
            return
        u, v = self._choice.at
        arms = "".join(
            f'<line x1="{u - 9 * dx}" y1="{v - 9 * dy}" x2="{u + 9 * dx}" y2="{v + 9 * dy}" stroke="{stroke}"'
            f' stroke-width="{width}"/>'
            for dx, dy in ((1, 0), (0, 1))
            for stroke, width in (("black", 2.5), ("white", 1))
        )
        self._image.set_content(arms)

    def _show_state(self) -> None:
        known = self._known[self._choice.camera]
        missing = [name for name in self._rig.markers if name not in known]
        picked = self._choice.camera in self._picked
        done = "save them" if picked else "click on one to take it anew"
        todo = f"click on {missing[0]}" if missing else f"all markers are known; {done}"
        self._status.set_text(
            f"{self._choice.camera}: {len(known)} of {len(self._rig.markers)} markers known; {todo}"
        )
