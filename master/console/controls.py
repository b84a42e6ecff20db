"""Controls change settings of the running rig, and tune them.

Sliders, camera views and labels that the pages share; `CommandQueue` sends a page's changes one at a time,
newest only. `Tuner` tries settings of a camera over the bus; functions beside it try and save a rig's filter.
These block: never call them on the thread of the page. The master and the wizards read this machine's copy of
a camera's file: after a slave of another machine saved its own, settings and colour ranges are copied, not
the calibration (`update_copy`).
"""

import asyncio
import json
import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from math import nan
from pathlib import Path
from typing import Generic, TypeVar, cast

import msgspec
from nicegui import background_tasks, ui
from nicegui.element import Element
from nicegui.events import GenericEventArguments

from common.calibration import CameraCalibration, FilterCalibration, RigCalibration, load, save
from common.calibration.camera_settings import WANTED, CameraSettings, ColourPick
from common.errors import BusError, CalibrationError, PhalanxError
from common.hand.model import JOINTS
from common.messages import Command, Contact, Gesture, HandPose, Health, ObjectPose, ObjectSource, Source
from common.messages.streams import MASTER
from master.calibrate.tree_files import provenance


def every(period_s: float, update: Callable[[], None]) -> None:
    """Update a part of the page now, and again and again while the page is open."""
    update()
    ui.timer(period_s, update)


class Setting:
    """Slider (logarithmic where a value spans decades) and number field of one value.

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

        The slider spans `low` to `high`; a number beyond may be typed, and `on_change`, which gets each new
        value, may refuse.
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
        inside = min(max(value, self._low), self._high)
        if not self._log:
            return round(inside, self._digits)
        return round(math.log(inside / self._low) / math.log(self._high / self._low), 3)

    def _at(self, place: float) -> float:
        return round(self._low * (self._high / self._low) ** place if self._log else place, self._digits)


AnswerT = TypeVar("AnswerT")


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
        self._waiting: dict[tuple[str, str | None], object] = {}
        self._task: asyncio.Task[None] | None = None

    @property
    def busy(self) -> bool:
        """Whether something is on its way."""
        return self._task is not None and not self._task.done()

    def change(self, key: str, value: object, part: str | None = None) -> None:
        """Send `key: value` soon, the newest; with `part` one entry of the map `key`."""
        self._waiting[key, part] = value
        if not self.busy:
            self._task = background_tasks.create(self._work(), name="commands")

    async def _work(self) -> None:
        while self._waiting:
            quiet_s = 0.12  # so long nothing more changes until the change is sent
            await asyncio.sleep(quiet_s)
            waiting, self._waiting = self._waiting, {}
            try:
                answer = await asyncio.to_thread(self._send, _merged(waiting))
            except PhalanxError as error:
                self._on_error(str(error))
            else:
                if not self._waiting:
                    self._on_answer(answer)


def _merged(waiting: Mapping[tuple[str, str | None], object]) -> dict[str, object]:
    out: dict[str, object] = {key: value for (key, part), value in waiting.items() if part is None}
    for key in {key for key, part in waiting if part is not None}:
        out[key] = {
            part: value for (other, part), value in waiting.items() if other == key and part is not None
        }
    return out


class CameraView(Element, component="static/camera_view.js"):
    """Live camera picture while the page is visible; `on_pick`: points can be picked."""

    def __init__(
        self, camera: str, label: str, on_pick: Callable[[float, float, int], object] | None = None
    ) -> None:
        """Show `camera`, to a screen reader as `label`.

        `on_pick` gets the place in the picture, as shares (0..1) of its width and height, and its time [ns].
        """
        super().__init__()
        self._props["camera"] = camera
        self._props["label"] = label
        self._props["mask"] = []
        self._props["picks"] = on_pick is not None
        self.on("pick", lambda event: None if on_pick is None else on_pick(*_place(event)))

    def tint(self, markers: tuple[str, ...]) -> None:
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
FINGERS = ("thumb", "index", "middle", "ring", "little")


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
    tracked = sum(1 for *_, now in states if now)
    parts = [f"{count[word]} {word}" for word in SOURCES.values() if count[word]]
    return f"{tracked} of {len(states)} joints seen now: {', '.join(parts)}"


def object_line(pose: ObjectPose, contacts: Sequence[Contact]) -> str:
    """Where an object is, and what holds or touches it."""
    source = _OBJECT_SOURCES[ObjectSource(pose.source)]
    if any(math.isnan(x) for x in pose.position_m):
        return f"not seen; {pose.seen} of {pose.expected} features"
    x, y, z = (1e3 * float(v) for v in pose.position_m)
    parts = [f"at {x:.0f}, {y:.0f}, {z:.0f} mm", source]
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


def gesture_lines(gestures: Mapping[tuple[str, str], Gesture], hand: str) -> list[str]:
    """Return text lines for the current gestures of one hand."""
    return [gesture_line(one) for (whose, _), one in sorted(gestures.items()) if whose == hand]


MARKER = "marker."
_CHANNELS = ("h", "s", "v")
PLAIN = ("exposure_us", "analogue_gain", "frame_rate_hz", "roi_margin")
GAINS = ("red_gain", "blue_gain")


@dataclass(frozen=True, slots=True)
class Range:
    """Marker colours in OpenCV's HSV (H 0-179); low[0] > high[0] wraps through red."""

    low: tuple[int, int, int]
    high: tuple[int, int, int]


@dataclass(frozen=True, slots=True)
class InUse:
    """Settings and colours in use, as a slave's answer reports them.

    Attributes:
        wanted: Setting -> what its camera file in use states, by the names of metrics.
        read: Setting -> what was read back from the camera; absent where it does not report it.
        markers: Marker -> its colours in use; absent: it has none.
    """

    wanted: Mapping[str, float] = field(default_factory=dict[str, float])
    read: Mapping[str, float] = field(default_factory=dict[str, float])
    markers: Mapping[str, Range] = field(default_factory=dict[str, Range])

    @classmethod
    def of(cls, health: Health) -> "InUse":
        """Read an answer."""
        names = (*PLAIN, *GAINS)
        metrics = health.metrics
        read = {name: metrics[name] for name in names if name in metrics}
        wanted = {name: metrics.get(WANTED + name, metrics.get(name, nan)) for name in names}
        markers: dict[str, Range] = {}
        for metric in metrics:
            name = metric.removeprefix(MARKER).removesuffix(".h_low")
            if metric == f"{MARKER}{name}.h_low":
                markers[name] = _range(metrics, name)
        known = {name: value for name, value in wanted.items() if value == value}
        return cls(known, read, markers)

    def body(self) -> dict[str, object]:
        """The body of the command "set" that brings all this back."""
        out: dict[str, object] = {name: self.wanted[name] for name in PLAIN if name in self.wanted}
        if all(name in self.wanted for name in GAINS):
            out["colour_gains"] = [self.wanted[name] for name in GAINS]
        if self.markers:
            out["markers"] = markers_over(self, ())
        return out


def markers_over(used: InUse, known: Iterable[str]) -> dict[str, object]:
    """Return `markers` of the command "set": those of `used`, no other of `known`."""
    out: dict[str, object] = {}
    out.update(dict.fromkeys(sorted(set(known) - used.markers.keys())))
    out.update({name: colour_body(colour) for name, colour in used.markers.items()})
    return out


def colour_body(colour: Range) -> dict[str, list[int]]:
    """A colour as the command "set" has it."""
    return {"hsv_low": list(colour.low), "hsv_high": list(colour.high)}


class Tuner:
    """Tuner of one camera; holds what was in use when it began or was saved last.

    Each method asks the slave, waits, and raises a BusError if it does not answer or refuses.
    """

    def __init__(self, camera: str, ask: Callable[[Command], Health]) -> None:
        self.camera = camera
        self._ask = ask
        self._begun: InUse | None = None

    @property
    def begun(self) -> InUse | None:
        """What `revert` goes back to; None: the slave has never answered."""
        return self._begun

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
        """Write what is in use to the slave's own camera file."""
        self._begun = self._send("save", "")
        return self._begun

    def revert(self) -> InUse:
        """Use again what was in use when the tuning began, or was saved last."""
        if self._begun is None:
            raise BusError(f"{self.camera!r} has not answered yet: there is nothing to go back to")
        markers = markers_over(self._begun, self.refresh().markers)
        return self._send("set", json.dumps(self._begun.body() | {"markers": markers}))

    def _begin(self) -> None:
        if self._begun is None:
            self.refresh()

    def _send(self, verb: str, body: str) -> InUse:
        return InUse.of(self._ask(Command(self.camera, verb, body)))


def _range(metrics: Mapping[str, float], name: str) -> Range:
    low, high = (
        tuple(round(metrics.get(f"{MARKER}{name}.{channel}_{end}", 0.0)) for channel in _CHANNELS)
        for end in ("low", "high")
    )
    return Range((low[0], low[1], low[2]), (high[0], high[1], high[2]))


def update_copy(path: Path, saved: InUse) -> bool:
    """Bring the file to what the slave saved. Whether anything differed.

    Raises:
        CalibrationError: The file is missing, broken or read-only, or the slave has what a file must not
            contain.
    """
    camera = load(path, CameraCalibration)
    body = saved.body() | {"markers": markers_over(saved, camera.markers or {})}
    try:
        new = msgspec.convert(body, CameraSettings).over(camera)
    except msgspec.ValidationError as error:
        raise CalibrationError(f"{path}: what {camera.name} saved cannot be copied: {error}") from error
    if new == camera:
        return False
    made = provenance("console", (), {}, "as the slave saved it")
    save(path, msgspec.structs.replace(new, provenance=camera.provenance | {"markers": made}))
    return True


def saved_filter(rig_path: Path) -> FilterCalibration:
    """Return the filter settings stored in the rig's file.

    Raises:
        CalibrationError: It is missing or broken.
    """
    return load(rig_path, RigCalibration).filter


def try_filter(ask: Callable[[Command], Health], rig: str, values: Mapping[str, float]) -> None:
    """Let the master use other parameters at once; its file stays as it is.

    Raises:
        BusError: No master answers, or it refuses.
    """
    ask(Command(MASTER, "filter", json.dumps({"rig": rig, "filter": dict(values)})))


def save_filter(rig_path: Path, values: Mapping[str, float]) -> None:
    """Write the filter settings to the rig's file, which a running master follows.

    Raises:
        CalibrationError: The file is missing, broken or read-only, or a value is out of range.
    """
    rig = load(rig_path, RigCalibration)
    new = msgspec.structs.replace(rig.filter, **values)
    made = provenance("console", (), {}, "tuned by hand")
    save(rig_path, msgspec.structs.replace(rig, filter=new, provenance=rig.provenance | {"filter": made}))
