"""Page Gestures: current gestures of each hand, recent ones, and custom poses."""

import math
import re
import time
from html import escape

from nicegui import ui

from common.calibration import load
from common.calibration.gesture_settings import GestureSettings, default_gestures
from common.errors import CalibrationError
from common.messages import Gesture
from master.console.controls import Problem, every, gesture_line, html, offer, panel, readable
from master.console.state import ConsoleState

_NAME = re.compile(r"[A-Za-z0-9_.-]{1,64}")
_RECORD_TEMPLATE = "teach a pose"


def build(state: ConsoleState) -> None:
    """Fill the page."""
    with ui.element("div").classes("gesture-grid"):
        with panel("Now"):
            html(0.2, "gesture-now", lambda: _now(state))
        with panel("Last gestures"):
            html(1.0, "gesture-said", lambda: _events(state))
        _poses(state)


def _now(state: ConsoleState) -> str:
    gestures = state.gestures
    hands = sorted(state.poses) or sorted({hand for hand, _ in gestures})
    return (
        "".join(
            hand_html(hand, {kind: one for (whose, kind), one in gestures.items() if whose == hand})
            for hand in hands
        )
        or "<p class='soft'>No hand is seen.</p>"
    )


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
    parts.append(_dial(math.nan if dial is None else dial.angle_rad))
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


def _dial(angle_rad: float) -> str:
    degrees = math.degrees(angle_rad)
    words, needle = "none", ""
    if not math.isnan(angle_rad):
        words = f"{degrees:+.0f}°"
        needle = f"<path class='needle' d='M0 8V-36' transform='rotate({degrees:.1f})'/>"
    ticks = "".join(f"<path d='M0 -44V-38' transform='rotate({30 * k})'/>" for k in range(12))
    return (
        f"<div class='dial-row'><span>Dial</span><svg viewBox='-50 -50 100 100' role='img' aria-label='Dial: {words}'>"
        f"<circle r='46'/>{ticks}{needle}</svg><strong>{words}</strong></div>"
    )


def _events(state: ConsoleState) -> str:
    now_s = time.monotonic()
    lines = "".join(
        f"<li><span class='soft'>{now_s - received_s:.0f} s ago</span>"
        f" {escape(readable(one.hand))}: {escape(_phase(one))}</li>"
        for received_s, one in state.received_gestures.events()[:14]
    )
    return f"<ul>{lines}</ul>" if lines else "<p class='soft'>Nothing yet.</p>"


def _phase(gesture: Gesture) -> str:
    line = gesture_line(gesture)
    if gesture.kind == "tap":
        return line
    return f"{line} begins" if gesture.phase == "begin" else f"{line.partition(' (')[0]} ends"


def _poses(state: ConsoleState) -> None:
    """Build the controls for the user's own poses, with the terminal's commands."""
    with panel("Poses of your own", "wide"):
        ui.label(
            "Name a pose, press Teach, and show it a few times before the sensors, with another pose between."
            " The running master knows it at once."
        ).classes("soft")
        with ui.row().classes("items-center gap-3"):
            name = ui.input("Name of the pose", placeholder="thumbs_up").props("dense outlined")
            ui.button("Teach", icon="school", on_click=lambda: teach()).props("unelevated")
            known = ui.select([], label="Known poses").props("dense outlined").classes("known-poses")
            ui.button("Forget", icon="delete", on_click=lambda: forget()).props("outline")
        problem = Problem()
        progress = ui.label("").classes("mono").props('role="log" aria-label="Output of the teaching"')

    async def start(*words: str) -> None:
        tree = ("--calibration", str(state.settings.calibration))
        await problem.attempt(lambda: state.start(_RECORD_TEMPLATE, "gestures", *words, *tree))

    async def teach() -> None:
        wanted = (name.value or "").strip()
        if _NAME.fullmatch(wanted):
            await start("--teach", wanted, "--bus", state.settings.bus)
        else:
            problem.show("A name has letters, digits, - and _ only, for example thumbs_up")

    async def forget() -> None:
        if known.value:
            await start("--forget", str(known.value))

    def update() -> None:
        offer(known, list(poses_of(state)))
        progress.set_text(state.local.tail(_RECORD_TEMPLATE, 8))

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
