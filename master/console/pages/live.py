"""Page Live: camera pictures, the hand in 3D, its tracking state and gestures."""

from html import escape

from nicegui import ui

from common.messages import HandPose
from master.console.controls import (
    CameraView,
    HandBox,
    every,
    gesture_line,
    hand_line,
    html,
    joint_states,
    no_camera,
    object_line,
    readable,
)
from master.console.state import ConsoleState

_UPDATE_S = 0.5
_FIGURES = (
    ("poses_per_s", "poses per second", "{:.0f}"),
    ("latency_p50_ms", "latency, median", "{:.1f} ms"),
    ("latency_p99_ms", "latency, 99 of 100", "{:.1f} ms"),
)


def build(state: ConsoleState) -> None:
    """Fill the page."""
    with ui.element("div").classes("live-grid"):
        with ui.element("section").classes("live-hand panel").props('aria-label="Hand in 3D"'):
            with ui.row().classes("panel-head"):
                ui.label("Hand").classes("panel-title")
                ui.space()
                box_button = ui.button(icon="center_focus_strong").props("flat round dense")
                box_button.props('aria-label="Look at the hand from the front again"')
                box_button.tooltip("view from the front")
            box = HandBox()
            box_button.on_click(box.reset)
            _figures(state)
        with ui.element("section").classes("live-cameras").props('aria-label="Cameras"'):
            cameras = state.cameras()
            if not cameras:
                no_camera("No camera yet")
            for camera in cameras:
                _camera(state, camera)
        with ui.element("section").classes("live-words panel").props('aria-label="What is known"'):
            html(_UPDATE_S, "words", lambda: _words(state))


def _figures(state: ConsoleState) -> None:
    shown: dict[str, ui.label] = {}
    with ui.element("dl").classes("figures"):
        for name, title, _ in _FIGURES:
            with ui.element("div"):
                with ui.element("dt"):
                    ui.label(title)
                with ui.element("dd"):
                    shown[name] = ui.label()

    def update() -> None:
        for name, _, form in _FIGURES:
            value = state.history.latest(name)
            shown[name].set_text("–" if value is None else form.format(value))

    every(_UPDATE_S, update)


def _camera(state: ConsoleState, camera: str) -> None:
    with ui.element("div").classes("panel camera"):
        with ui.row().classes("panel-head"):
            ui.label(camera).classes("panel-title")
            rate = ui.label().classes("soft")
            ui.space()
            tint = ui.switch("markers").props(f'dense aria-label="Tint what {camera} takes for markers"')
        view = CameraView(camera, f"Picture of camera {camera}")
    tint.on_value_change(lambda event: view.tint(state.markers_of(camera) if event.value else ()))

    def update() -> None:
        hz = state.history.latest(f"rate_hz.{camera}")
        rate.set_text("" if hz is None else f"{hz:.0f} frames/s")

    every(1.0, update)


def _words(state: ConsoleState) -> str:
    """The hands and objects as one piece of HTML, plain to a screen reader."""
    parts: list[str] = []
    for hand, pose in sorted(state.poses.items()):
        parts.append(f"<h2>{escape(readable(hand))}</h2><p>{escape(hand_line(pose))}</p>{joints(pose)}")
        now = [gesture_line(one) for (whose, _), one in sorted(state.gestures.items()) if whose == hand]
        items = "".join(f"<li>{escape(line)}</li>" for line in now or ["none now"])
        parts.append(f"<h3>Gestures</h3><ul>{items}</ul>")
    for name, one in sorted(state.objects.items()):
        near = [contact for contact in state.contacts.values() if contact.object == name]
        parts.append(f"<h2>{escape(readable(name))}</h2><p>{escape(object_line(one, near))}</p>")
    return "".join(parts) or f"<h2>No hand</h2><p class='soft'>{escape(_why_none(state))}</p>"


def joints(pose: HandPose) -> str:
    """Return the 26 joints as HTML dots with their states, one row per finger."""
    rows: dict[str, str] = {}
    for name, state, tracked in joint_states(pose):
        finger = name.split("-")[0]
        finger = {"palm": "hand", "wrist": "hand", "pinky": "little"}.get(finger, finger)
        kind = state.split()[0] + ("" if tracked else " dim")
        words = escape(f"{readable(name.replace('-', ' '))}: {state}{'' if tracked else ', not seen now'}")
        dot = f"<span class='joint {kind}' role='img' aria-label='{words}' title='{words}'></span>"
        rows[finger] = rows.get(finger, "") + dot
    lines = "".join(f"<tr><th scope='row'>{finger}</th><td>{dots}</td></tr>" for finger, dots in rows.items())
    legend = "".join(
        f"<span class='key'><span class='joint {kind}'></span>{kind}</span>"
        for kind in ("measured", "solved", "held", "wrist", "unknown")
    )
    return f"<table class='joints'>{lines}</table><p class='legend'>{legend}</p>"


def _why_none(state: ConsoleState) -> str:
    if not state.link.up:
        return state.link.reason
    if "master" not in state.alive:
        return "No master runs. The Set-up page starts one, or: phalanx run"
    return "The master sees no hand. Is it before all cameras? The Checklist page shows what is wrong."
