"""Controls change settings of the running rig, and tune them.

Camera views, panels, errors and texts that the pages share; `CommandQueue` sends a page's changes one at a
time, newest only. `Tuner` tries settings of a camera over the bus, `FilterTuner` the filter of a rig. These
block: never call them on the thread of the page. The master and the wizards read this machine's copy of a
camera's file: after a slave of another machine saved its own, settings and colour ranges are copied, not the
calibration (`update_copy`).
"""

import asyncio
import json
import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Generic, TypeVar, cast

import msgspec
from nicegui import background_tasks, ui
from nicegui.element import Element
from nicegui.events import GenericEventArguments

from common.calibration import CameraCalibration, HsvRange, RigCalibration, load, save
from common.calibration.camera_settings import WANTED, CameraSettings, ColourPick
from common.errors import BusError, CalibrationError, PhalanxError
from common.hand.model import FINGERS, JOINTS
from common.messages import Command, Contact, Gesture, HandPose, Health, ObjectPose, ObjectSource, Source
from common.messages.streams import MASTER
from master.calibrate.tree_files import provenance
from master.console.setup.files import keep_old

AnswerT = TypeVar("AnswerT")


def every(period_s: float, update: Callable[[], object]) -> None:
    """Update a part of the page now, and again and again while the page is open."""
    update()
    ui.timer(period_s, update)


def html(period_s: float, classes: str, text: Callable[[], str]) -> None:
    """A part of the page whose HTML is `text()`, now and again and again."""
    content = ui.html("", sanitize=False).classes(classes)
    every(period_s, lambda: content.set_content(text()))


def panel(title: str, classes: str = "") -> Element:
    """A titled section of a page, to be filled by `with`."""
    with ui.element("section").classes(f"panel {classes}").props(f'aria-label="{title}"') as section:
        ui.label(title).classes("panel-title")
    return section


def offer(select: ui.select, names: list[str]) -> None:
    """Let one of these names be chosen; what was chosen stays if it is one of them."""
    if select.options != names:
        select.set_options(names, value=select.value if select.value in names else None)


def no_camera(title: str) -> None:
    """What stands in place of a page's cameras while there is none."""
    with ui.element("div").classes("panel empty"):
        ui.label(title)
        ui.label("The Set-up page starts one.").classes("soft")


class Problem(ui.label):
    """The error of the last action of a panel; empty while there is none."""

    def __init__(self) -> None:
        super().__init__("")
        self.classes("problem").props('role="alert"')
        self._page = ui.context.client

    def show(self, text: str) -> None:
        """Show an error, here and over the page."""
        self.set_text(text)
        with self._page:
            ui.notify(text, type="negative", multi_line=True, close_button="OK")

    async def attempt(
        self, action: Callable[[], AnswerT], then: Callable[[AnswerT], object] = lambda _: None
    ) -> bool:
        """Run a slow action off the event loop, `then` show its answer; False: it failed."""
        self.set_text("")
        try:
            answer = await asyncio.to_thread(action)
        except PhalanxError as error:
            self.show(str(error))
            return False
        then(answer)
        return True


class CommandQueue(Generic[AnswerT]):
    """Queue of pending changes, merged by key, while the last one is being sent."""

    def __init__(
        self,
        send: Callable[[Mapping[str, object]], AnswerT],
        on_answer: Callable[[AnswerT], object],
        on_error: Callable[[str], object],
    ) -> None:
        """Start with an empty queue.

        `send` sends a change and waits for the answer, on a thread. `on_answer` is called with it on the
        page's loop, unless more is to be sent already; `on_error` with the error's text.
        """
        self._send, self._on_answer, self._on_error = send, on_answer, on_error
        self._waiting: dict[str, object] = {}
        self._task: asyncio.Task[None] | None = None

    @property
    def busy(self) -> bool:
        """Whether something is on its way."""
        return self._task is not None and not self._task.done()

    def change(self, key: str, value: object) -> None:
        """Send `key: value` soon, the newest; entries of a map are merged."""
        before = self._waiting.get(key)
        if isinstance(value, dict) and isinstance(before, dict):
            value = cast(dict[str, object], before) | cast(dict[str, object], value)
        self._waiting[key] = value
        if not self.busy:
            self._task = background_tasks.create(self._work(), name="commands")

    async def _work(self) -> None:
        while self._waiting:
            quiet_s = 0.12  # so long nothing more changes until the change is sent
            await asyncio.sleep(quiet_s)
            waiting, self._waiting = self._waiting, {}
            try:
                answer = await asyncio.to_thread(self._send, waiting)
            except PhalanxError as error:
                self._on_error(str(error))
            else:
                if not self._waiting:
                    self._on_answer(answer)


class CameraView(Element, component="static/camera_view.js"):
    """Live camera picture while the page is visible; `on_pick`: points can be picked."""

    def __init__(
        self,
        camera: str,
        label: str,
        on_pick: Callable[[float, float, int], object] | None = None,
        *,
        pause_ms: int = 0,
    ) -> None:
        """Show `camera`, to a screen reader as `label`, at most each `pause_ms`.

        `on_pick` gets the place in the picture, as shares (0..1) of its width and height, and its time [ns].
        """
        super().__init__()
        self._props.update(camera=camera, label=label, mask=[], picks=on_pick is not None, pause=pause_ms)
        if on_pick is not None:
            self.on("pick", lambda event: on_pick(*_place(event)))

    def tint(self, markers: Iterable[str]) -> None:
        """Tint the pixels in the ranges of these markers."""
        self._props["mask"] = list(markers)


class HandBox(Element, component="static/hand_box.js"):
    """All hands and objects in 3D, as long as the page is visible."""

    def reset(self) -> None:
        """Look from where it looked at first."""
        self.run_method("reset")


def _place(event: GenericEventArguments) -> tuple[float, float, int]:
    args = cast(dict[str, float | str], event.args)
    x, y = (min(max(float(args[key]), 0.0), 1.0) for key in ("x", "y"))
    return x, y, int(args["taken"])


def full_frame_uv(x: float, y: float, width_px: int, height_px: int) -> tuple[float, float]:
    """Convert shares of a picture to a pixel (u, v); 0: the centre of the first."""
    return x * width_px - 0.5, y * height_px - 0.5


SOURCES = {
    Source.NONE: "unknown",
    Source.MEASURED: "measured",
    Source.SOLVED: "solved",
    Source.HELD: "held",
    Source.WRIST: "wrist device",
}
_OBJECT_SOURCES = {
    ObjectSource.NONE: "not seen",
    ObjectSource.MARKERS: "by its beads",
    ObjectSource.TAGS: "by its tags",
    ObjectSource.TRACKER: "by its tracker",
    ObjectSource.HELD: "held where it was last seen",
}


def joint_states(pose: HandPose) -> list[tuple[str, str, bool]]:
    """Return (joint, state, tracked now) for all 26 joints; not valid: `unknown`."""
    return [
        (name, SOURCES[Source(int(source))] if valid else "unknown", bool(tracked))
        for name, source, valid, tracked in zip(JOINTS, pose.source, pose.valid, pose.tracked, strict=True)
    ]


def hand_line(pose: HandPose) -> str:
    """How much of a hand is known, in one line."""
    states = joint_states(pose)
    count = Counter(state for _, state, _ in states)
    tracked = sum(now for *_, now in states)
    parts = [f"{count[word]} {word}" for word in SOURCES.values() if count[word]]
    return f"{tracked} of {len(states)} joints seen now: {', '.join(parts)}"


def object_line(pose: ObjectPose, contacts: Sequence[Contact]) -> str:
    """Where an object is, and what holds or touches it."""
    if any(math.isnan(x) for x in pose.position_m):
        return f"not seen; {pose.seen} of {pose.expected} features"
    x, y, z = (1e3 * float(v) for v in pose.position_m)
    parts = [f"at {x:.0f}, {y:.0f}, {z:.0f} mm", _OBJECT_SOURCES[ObjectSource(pose.source)]]
    if pose.occluded:
        parts.append("partly hidden")
    for contact in contacts:
        fingers = [name for name, on in zip(FINGERS, contact.touching, strict=True) if on]
        if contact.held:
            parts.append(f"in the grip of {contact.hand}")
        elif fingers:
            parts.append(f"touched by {', '.join(fingers)}")
    return ", ".join(parts)


def gesture_line(gesture: Gesture) -> str:
    """One gesture: what, how much, how sure."""
    sure = f"{100 * gesture.confidence:.0f} %"
    match gesture.kind:
        case "pose":
            return f"pose {readable(gesture.name)} ({sure})"
        case "pinch":
            return f"pinch with the {gesture.name} finger, {1e3 * gesture.distance_m:.0f} mm apart ({sure})"
        case "dial":
            return f"dial turned by {math.degrees(gesture.angle_rad):+.0f}° ({sure})"
        case "tap":
            return f"tap on key {gesture.name} ({sure})"
        case "point":
            return f"points ({sure})"


def readable(name: str) -> str:
    """A name of ours as words."""
    return name.replace("_", " ")


MARKER = "marker."
PLAIN = ("exposure_us", "analogue_gain", "frame_rate_hz", "roi_margin")
GAINS = ("red_gain", "blue_gain")


@dataclass(frozen=True, slots=True)
class InUse:
    """Settings and colours in use, as a slave's answer reports them.

    Attributes:
        wanted: Setting -> what the file in use states, by the names of metrics.
        read: Setting -> what was read back from the camera; absent where it does not report it.
        markers: Marker -> its colours in use; absent: it has none.
    """

    wanted: Mapping[str, float] = field(default_factory=dict[str, float])
    read: Mapping[str, float] = field(default_factory=dict[str, float])
    markers: Mapping[str, HsvRange] = field(default_factory=dict[str, HsvRange])

    @classmethod
    def of(cls, health: Health) -> "InUse":
        """Read an answer."""
        metrics = health.metrics
        read = {name: metrics[name] for name in (*PLAIN, *GAINS) if name in metrics}
        wanted = read | {
            name: metrics[WANTED + name] for name in (*PLAIN, *GAINS) if WANTED + name in metrics
        }
        first = ".h_low"
        names = [
            metric[len(MARKER) : -len(first)]
            for metric in metrics
            if metric.startswith(MARKER) and metric.endswith(first)
        ]
        return cls(wanted, read, {name: _range(metrics, name) for name in names})

    def body(self, known: Iterable[str]) -> dict[str, object]:
        """Body of the command "set" that brings all this back, and no other of `known`."""
        out: dict[str, object] = {name: self.wanted[name] for name in PLAIN if name in self.wanted}
        if all(name in self.wanted for name in GAINS):
            out["colour_gains"] = [self.wanted[name] for name in GAINS]
        markers: dict[str, object] = {name: None for name in sorted(set(known) - self.markers.keys())}  # noqa: C420
        markers |= {name: colour_body(colour) for name, colour in self.markers.items()}
        return out | {"markers": markers}


def colour_body(colour: HsvRange) -> dict[str, list[int]]:
    """A colour as the command "set" has it."""
    return {"hsv_low": list(colour.hsv_low), "hsv_high": list(colour.hsv_high)}


class Tuner:
    """Tuner of one camera; holds what was in use when it began or was saved last.

    Each method asks the slave, waits, and raises a BusError if it does not answer or refuses.
    """

    def __init__(self, camera: str, ask: Callable[[Command], Health], copy: Path | None = None) -> None:
        """Tune `camera`; `copy`: its file on this machine, which follows what is saved."""
        self.camera = camera
        self.now = InUse()  # by the newest answer
        self._ask, self._copy = ask, copy
        self._begun: InUse | None = None

    def refresh(self) -> InUse:
        """What is in use now."""
        now = self._send("settings", "")
        if self._begun is None:
            self._begun = now
        return now

    def set(self, change: Mapping[str, object]) -> InUse:
        """Use other settings at once: keys and units of the command "set"."""
        self._begin()
        return self._send("set", json.dumps(change))

    def pick(self, marker: str, uv: Sequence[float], t_ns: int | None = None) -> InUse:
        """Sample a marker's colour around a full-frame pixel, taken at `t_ns` if known."""
        self._begin()
        pick = ColourPick(marker=marker, uv=(round(float(uv[0]), 2), round(float(uv[1]), 2)), t_ns=t_ns)
        return self._send("pick", msgspec.json.encode(pick).decode())

    def forget(self, marker: str) -> InUse:
        """Use no colour for a marker: it is looked for no more."""
        return self.set({"markers": {marker: None}})

    def save(self) -> InUse:
        """Write what is in use to the slave's own camera file, then to the copy.

        Raises:
            CalibrationError: As of `update_copy`.
        """
        self._begun = self._send("save", "")
        if self._copy is not None and self._copy.exists():
            update_copy(self._copy, self._begun)
        return self._begun

    def revert(self) -> InUse:
        """Use again what was in use when the tuning began, or was saved last."""
        if self._begun is None:
            raise BusError(f"{self.camera!r} has not answered yet: there is nothing to go back to")
        return self._send("set", json.dumps(self._begun.body(self.refresh().markers)))

    def _begin(self) -> None:
        if self._begun is None:
            self.refresh()

    def _send(self, verb: str, body: str) -> InUse:
        self.now = InUse.of(self._ask(Command(self.camera, verb, body)))
        return self.now


def _range(metrics: Mapping[str, float], name: str) -> HsvRange:
    low, high = (
        tuple(round(metrics.get(f"{MARKER}{name}.{channel}_{end}", 0.0)) for channel in "hsv")
        for end in ("low", "high")
    )
    return HsvRange(hsv_low=(low[0], low[1], low[2]), hsv_high=(high[0], high[1], high[2]))


def update_copy(path: Path, saved: InUse) -> bool:
    """Bring the file to what the slave saved. Whether anything differed.

    Raises:
        CalibrationError: The file is missing, broken or read-only, or the slave has what a file must not
            contain.
    """
    camera = load(path, CameraCalibration)
    try:
        new = msgspec.convert(saved.body(camera.markers or {}), CameraSettings).over(camera)
    except msgspec.ValidationError as error:
        raise CalibrationError(f"{path}: what {camera.name} saved cannot be copied: {error}") from error
    if new == camera:
        return False
    keep_old(path.parents[1], path)
    made = provenance("console", (), {}, "as the slave saved it")
    save(path, msgspec.structs.replace(new, provenance=camera.provenance | {"markers": made}))
    return True


class FilterTuner:
    """Tuner of a rig's filter: the master tries it at once, the rig's file keeps it.

    Each method raises a BusError where no master answers or it refuses, a CalibrationError where the file is
    missing, broken or read-only, or a value is out of range.
    """

    def __init__(self, rig: str, path: Path, ask: Callable[[Command], Health]) -> None:
        """Tune the filter of `rig`, whose file is `path`."""
        self.now = InUse()  # what is tried; also while no master runs: it can be saved
        self._rig, self._path, self._ask = rig, path, ask

    def refresh(self) -> InUse:
        """What the rig's file states."""
        filter_ = load(self._path, RigCalibration).filter
        self.now = InUse({name: float(value) for name, value in msgspec.structs.asdict(filter_).items()})
        return self.now

    def set(self, change: Mapping[str, object]) -> InUse:
        """Let the master use other parameters at once; its file stays as it is."""
        self.now = InUse({**self.now.wanted, **cast(Mapping[str, float], change)})
        self._ask(Command(MASTER, "filter", json.dumps({"rig": self._rig, "filter": self.now.wanted})))
        return self.now

    def save(self) -> InUse:
        """Write what is tried to the rig's file, which a running master follows."""
        rig = load(self._path, RigCalibration)
        new = msgspec.structs.replace(rig.filter, **self.now.wanted)
        made = rig.provenance | {"filter": provenance("console", (), {}, "tuned by hand")}
        save(self._path, msgspec.structs.replace(rig, filter=new, provenance=made))
        return self.refresh()

    def revert(self) -> InUse:
        """Try again what the file states."""
        return self.set(self.refresh().wanted)
