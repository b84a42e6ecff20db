"""Page Live: camera pictures, the hand in 3D, its tracking state and gestures."""

from html import escape

from nicegui import ui

from common.messages import HandPose
from master.console.controls import (
    CameraView,
    HandBox,
    every,
    gesture_lines,
    hand_line,
    joint_states,
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
        _cameras(state)
        with ui.element("section").classes("live-words panel").props('aria-label="What is known"'):
            _hands(state)


def _figures(state: ConsoleState) -> None:
    with ui.element("dl").classes("figures"):
        shown: list[tuple[str, str, ui.label]] = []
        for name, title, form in _FIGURES:
            with ui.element("div"):
                with ui.element("dt"):
                    ui.label(title)
                with ui.element("dd"):
                    shown.append((name, form, ui.label("–")))

    def update() -> None:
        for name, form, label in shown:
            value = state.history.latest(name)
            label.set_text("–" if value is None else form.format(value))

    ui.timer(_UPDATE_S, update)


def _cameras(state: ConsoleState) -> None:
    cameras = state.cameras()
    with ui.element("section").classes("live-cameras").props('aria-label="Cameras"'):
        if not cameras:
            with ui.element("div").classes("panel empty"):
                ui.label("No camera yet")
                ui.label("The Set-up page starts one.").classes("soft")
        for camera in cameras:
            _camera(state, camera)


def _camera(state: ConsoleState, camera: str) -> None:
    markers = tuple(name for rig in state.rigs().values() if camera in rig.cameras for name in rig.markers)
    with ui.element("div").classes("panel camera"):
        with ui.row().classes("panel-head"):
            ui.label(camera).classes("panel-title")
            rate = ui.label().classes("soft")
            ui.space()
            view: list[CameraView] = []
            ui.switch("markers", on_change=lambda e: view[0].tint(markers if e.value else ())).props(
                f'dense aria-label="Tint what {camera} takes for markers"'
            )
        view.append(CameraView(camera, f"Picture of camera {camera}"))

    def update() -> None:
        hz = state.history.latest(f"rate_hz.{camera}")
        rate.set_text("" if hz is None else f"{hz:.0f} frames/s")

    ui.timer(1.0, update)


def _hands(state: ConsoleState) -> None:
    """Build the text on the hands as one piece of HTML, plain to a screen reader."""
    text = ui.html("", sanitize=False).classes("words")

    def update() -> None:
        parts: list[str] = []
        for hand, pose in sorted(state.poses.items()):
            parts.append(f"<h2>{escape(readable(hand))}</h2><p>{escape(hand_line(pose))}</p>{joints(pose)}")
            lines = gesture_lines(state.gestures, hand)
            parts.append("<h3>Gestures</h3>" + _items(lines or ["none now"]))
        for name, one in sorted(state.objects.items()):
            near = [contact for contact in state.contacts.values() if contact.object == name]
            parts.append(f"<h2>{escape(readable(name))}</h2><p>{escape(object_line(one, near))}</p>")
        if not parts:
            parts.append(f"<h2>No hand</h2><p class='soft'>{escape(_why_none(state))}</p>")
        text.set_content("".join(parts))

    every(_UPDATE_S, update)


def joints(pose: HandPose) -> str:
    """Return the 26 joints as HTML dots with their states, one row per finger."""
    rows: dict[str, list[str]] = {}
    for name, state, tracked in joint_states(pose):
        finger = name.split("-")[0]
        finger = {"palm": "hand", "wrist": "hand", "pinky": "little"}.get(finger, finger)
        kind = state.split()[0] + ("" if tracked else " dim")
        words = escape(f"{readable(name.replace('-', ' '))}: {state}{'' if tracked else ', not seen now'}")
        dot = f"<span class='joint {kind}' role='img' aria-label='{words}' title='{words}'></span>"
        rows.setdefault(finger, []).append(dot)
    lines = "".join(
        f"<tr><th scope='row'>{escape(finger)}</th><td>{''.join(dots)}</td></tr>"
        for finger, dots in rows.items()
    )
    legend = "".join(
        f"<span class='key'><span class='joint {kind}'></span>{kind}</span>"
        for kind in ("measured", "solved", "held", "wrist", "unknown")
    )
    return f"<table class='joints'>{lines}</table><p class='legend'>{legend}</p>"


def _items(lines: list[str]) -> str:
    return "<ul>" + "".join(f"<li>{escape(line)}</li>" for line in lines) + "</ul>"


def _why_none(state: ConsoleState) -> str:
    if not state.link.up:
        return state.link.reason
    if "master" not in state.alive:
        return "No master runs. The Set-up page starts one, or: phalanx run"
    return "The master sees no hand. Is it before all cameras? The Checklist page shows what is wrong."
