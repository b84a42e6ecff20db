"""Controls, camera views and labels serve all pages of the console.

Controls that the pages share.

They include a labelled slider with a number beside it, and the value that was read back.

Queue that sends a page's changes to a process, one at a time, newest only.

Dragging a slider therefore floods nobody.

Elements of the console's pages that NiceGUI does not have.

They are a camera's picture and the hand in 3D.

Plain-text labels for the state of hands, objects and gestures.

Pure: messages in, text out.
"""

import asyncio
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Generic, TypeVar, cast

from nicegui import background_tasks, ui
from nicegui.element import Element
from nicegui.events import GenericEventArguments

from common.errors import PhalanxError
from common.hand.model import JOINTS
from common.messages import Contact, Gesture, HandPose, ObjectPose, ObjectSource, Source


class Setting:
    """Slider and number field for one value, with the value last shown.

    The slider is logarithmic where the value spans decades.

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

        Args:
            title: What it is.
            unit: Its unit, may be empty.
            low, high: What the slider spans; a number beyond may be typed, and whoever gets it may refuse.
            on_change: Called with each new value.
            digits: Decimals shown.
            log: Whether the slider is logarithmic.
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
        """Where on the slider a value is, on its steps."""
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

        Args:
            send: Sends a change and waits for the answer, on a thread.
            on_answer: Called with the answer, on the page's loop, unless more is to be sent already.
            on_error: Called with the error's text as it is.
        """
        self._send, self._on_answer, self._on_error = send, on_answer, on_error
        self._waiting: dict[tuple[str, str | None], object] = {}
        self._task: asyncio.Task[None] | None = None

    @property
    def busy(self) -> bool:
        """Whether something is on its way."""
        return self._task is not None and not self._task.done()

    def change(self, key: str, value: object, part: str | None = None) -> None:
        """Send `key: value` soon.

        With `part`, only one entry of the map `key` is sent. The newest value of each counts.
        """
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
    """Keys and values; the parts of one key as a map."""
    out: dict[str, object] = {key: value for (key, part), value in waiting.items() if part is None}
    for key in {key for key, part in waiting if part is not None}:
        out[key] = {
            part: value for (other, part), value in waiting.items() if other == key and part is not None
        }
    return out


class CameraView(Element, component="static/camera_view.js"):
    """Live camera picture, shown as long as the page is visible.

    With `on_pick`, a click, or a cross moved by keys, picks a point.
    """

    def __init__(
        self, camera: str, label: str, on_pick: Callable[[float, float, int], object] | None = None
    ) -> None:
        """Show `camera`.

        Args:
            camera: Its name.
            label: What a screen reader reads.
            on_pick: Called with the place in the picture, as shares (0..1) of its width and height, and its time [ns].
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
    """Convert shares of a picture to a pixel of the whole frame.

    (0, 0) is the centre of the top-left pixel.
    """
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
    """Return (joint, state, tracked now) for all 26 joints.

    The state is `unknown` where the joint is not valid.
    """
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
