"""Page Gestures: current gestures of each hand, recent ones, and custom poses."""

import asyncio
import math
import re
import sys
import time
from html import escape

from nicegui import background_tasks, ui

from common.calibration import load
from common.calibration.gesture_settings import GestureSettings, default_gestures
from common.errors import CalibrationError, PhalanxError
from common.messages import Gesture
from master.console.controls import every, gesture_line, readable
from master.console.state import ConsoleState

_NAME = re.compile(r"[A-Za-z0-9_.-]{1,64}")
_RECORD_TEMPLATE = "teach a pose"


def build(state: ConsoleState) -> None:
    """Fill the page."""
    with ui.element("div").classes("gesture-grid"):
        _now(state)
        _show_events(state)
        _poses(state)


def _now(state: ConsoleState) -> None:
    with ui.element("section").classes("panel").props('aria-label="Now"'):
        ui.label("Now").classes("panel-title")
        content = ui.html("", sanitize=False).classes("gesture-now")

    def update() -> None:
        hands = sorted(state.poses) or sorted({hand for hand, _ in state.gestures})
        content.set_content(
            "".join(
                hand_html(hand, {k: g for (h, k), g in state.gestures.items() if h == hand}) for hand in hands
            )
            or "<p class='soft'>No hand is seen.</p>"
        )

    every(0.2, update)


def hand_html(hand: str, now: dict[str, Gesture]) -> str:
    """Return one hand's gestures as HTML: pose in words, pinch a bar, dial a gauge."""
    pose, pinch, dial, point = (now.get(kind) for kind in ("pose", "pinch", "dial", "point"))
    parts = [f"<h2>{escape(readable(hand))}</h2>"]
    name = "no pose" if pose is None else readable(pose.name)
    parts.append(_bar("Pose", name, 0.0 if pose is None else pose.confidence, "sure"))
    if pinch is None or math.isnan(pinch.strength):
        parts.append(_bar("Pinch", "none", 0.0, "closed"))
    else:
        gap = f"{readable(pinch.name)}, {1e3 * pinch.distance_m:.0f} mm"
        parts.append(_bar("Pinch", gap, pinch.strength, "closed"))
    parts.append(_dial(None if dial is None else dial.angle_rad))
    parts.append(f"<p>Pointing: {'yes' if point is not None else 'no'}</p>")
    return f"<div class='hand-says'>{''.join(parts)}</div>"


def _bar(title: str, words: str, share: float, of: str) -> str:
    percent = round(100 * min(max(share, 0.0), 1.0))
    return (
        f"<div class='bar-row'><span>{title}</span><strong>{escape(words)}</strong>"
        f"<div class='bar' role='meter' aria-label='{title}: {escape(words)}' aria-valuemin='0' aria-valuemax='100'"
        f" aria-valuenow='{percent}'><div style='width:{percent}%'></div></div>"
        f"<span class='soft'>{percent} % {of}</span></div>"
    )


def _dial(angle_rad: float | None) -> str:
    known = angle_rad is not None and not math.isnan(angle_rad)
    degrees = math.degrees(angle_rad) if angle_rad is not None and known else 0.0
    words = f"{degrees:+.0f}°" if known else "none"
    ticks = "".join(f"<path d='M0 -44V-38' transform='rotate({30 * k})'/>" for k in range(12))
    needle = f"<path class='needle' d='M0 8V-36' transform='rotate({degrees:.1f})'/>" if known else ""
    return (
        f"<div class='dial-row'><span>Dial</span><svg viewBox='-50 -50 100 100' role='img' aria-label='Dial: {words}'>"
        f"<circle r='46'/>{ticks}{needle}</svg><strong>{words}</strong></div>"
    )


def _show_events(state: ConsoleState) -> None:
    with ui.element("section").classes("panel").props('aria-label="Last gestures"'):
        ui.label("Last gestures").classes("panel-title")
        content = ui.html("", sanitize=False).classes("gesture-said")

    def update() -> None:
        now_s = time.monotonic()
        lines = [
            f"<li><span class='soft'>{now_s - received.received_s:.0f} s ago</span>"
            f" {escape(readable(received.gesture.hand))}: {escape(_phase(received.gesture))}</li>"
            for received in state.received_gestures.events()[:14]
        ]
        content.set_content(
            "<ul>" + "".join(lines) + "</ul>" if lines else "<p class='soft'>Nothing yet.</p>"
        )

    every(1.0, update)


def _phase(gesture: Gesture) -> str:
    line = gesture_line(gesture)
    if gesture.kind == "tap":
        return line
    return f"{line} begins" if gesture.phase == "begin" else f"{line.partition(' (')[0]} ends"


def _poses(state: ConsoleState) -> None:
    """Build the controls for the user's own poses, with the terminal's commands."""
    with ui.element("section").classes("panel wide").props('aria-label="Poses of your own"'):
        ui.label("Poses of your own").classes("panel-title")
        ui.label(
            "Name a pose, press Teach, and show it a few times before the sensors, with another pose between."
            " The running master knows it at once."
        ).classes("soft")
        with ui.row().classes("items-center gap-3"):
            name = ui.input("Name of the pose", placeholder="thumbs_up").props("dense outlined")
            ui.button("Teach", icon="school", on_click=lambda: teach()).props("unelevated")
            known = ui.select([], label="Known poses").props("dense outlined").classes("known-poses")
            ui.button("Forget", icon="delete", on_click=lambda: forget()).props("outline")
        progress = ui.label("").classes("mono").props('role="log" aria-label="Output of the teaching"')

    def command(*words: str) -> list[str]:
        tree = ["--calibration", str(state.settings.calibration)]
        return [sys.executable, "-m", "master", "gestures", *words, *tree]

    def start(words: list[str]) -> None:
        async def work() -> None:
            try:
                await asyncio.to_thread(state.local.start, _RECORD_TEMPLATE, words, {})
            except PhalanxError as error:
                progress.set_text(str(error))

        background_tasks.create(work(), name=_RECORD_TEMPLATE)

    def teach() -> None:
        wanted = (name.value or "").strip()
        if not _NAME.fullmatch(wanted):
            ui.notify("A name has letters, digits, - and _ only, for example thumbs_up", type="negative")
            return
        start(command("--teach", wanted, "--bus", state.settings.bus))

    def forget() -> None:
        if known.value:
            start(command("--forget", str(known.value)))

    def update() -> None:
        names = list(poses_of(state))
        if known.options != names:
            known.set_options(names, value=known.value if known.value in names else None)
        process = state.local.get(_RECORD_TEMPLATE)
        if process is not None:
            progress.set_text("\n".join(process.tail(8)))

    every(1.0, update)


def poses_of(state: ConsoleState) -> tuple[str, ...]:
    """Names of the poses that the settings file knows."""
    path = state.settings.calibration / "gestures" / "default.json"
    if not path.exists():
        return tuple(default_gestures().poses)
    try:
        return tuple(load(path, GestureSettings).poses)
    except CalibrationError:
        return ()
