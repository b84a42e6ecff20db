"""Panel of step 6: the master tracks, and reports whether all is well."""

import numpy as np
from nicegui import ui

from common.messages import HandPose
from master.console.setup.parts import Desk, heading


def build(desk: Desk) -> None:
    """Fill the panel."""
    session = desk.session
    heading("Track", "The master estimates the hand from what the cameras see, and reports what is wrong.")

    def go() -> bool:
        if not session.tracks:
            session.start_master()
        session.show("standard" if session.view in ("still", "board") else session.view)
        return True

    def end() -> None:
        session.stop_master()

    async def start() -> None:
        await desk.attempt(go)

    async def stop() -> None:
        await desk.attempt(end)

    with ui.row():
        ui.button("Start tracking", on_click=start).props('icon="play_arrow"')
        ui.button("Stop", on_click=stop).props('flat icon="stop"')
        ui.button("See the hand", on_click=lambda: ui.navigate.to("/live")).props('flat icon="visibility"')
    status = ui.label().classes("text-h6").props('role="status" data-testid="tracking"')
    hands = ui.label().classes("setup-text")
    items = ui.column().classes("w-full")
    wrong = ui.label().classes("setup-error").props('role="alert"')
    shown: tuple[str, ...] | None = None

    def look() -> None:
        nonlocal shown
        state = session.state
        poses = state.poses
        status.set_text(_state(desk, any(pose.tracked.any() for pose in poses.values())))
        hands.set_text("\n".join(sentence(pose) for pose in poses.values()))
        wrong.set_text("\n".join(session.failures()))
        checklist = state.checklist
        lines = () if checklist is None else tuple(f"{item.sentence} {item.fix}" for item in checklist.items)
        lines = ("Checklist: all well",) if checklist is not None and not lines else lines
        if lines != shown:
            shown = lines
            items.clear()
            with items:
                for line in lines:
                    ui.label(line).classes("setup-text")

    look()
    poll_s = 0.5
    ui.timer(poll_s, look)


def _state(desk: Desk, posing: bool) -> str:
    session = desk.session
    if posing:
        return "A hand is tracked"
    if session.tracks:
        return "The master runs; it waits for cameras and a hand"
    if session.meets:
        return "The cameras are met; nothing is tracked yet"
    return "No master runs"


def sentence(pose: HandPose) -> str:
    """One pose in words: how many markers are seen, where the palm is."""
    seen = int(np.isfinite(pose.markers_raw_m).all(axis=1).sum())
    middle = 1e2 * np.nanmean(pose.position_m, axis=0)
    return f"{pose.hand}: {seen} of {len(pose.markers_raw_m)} markers seen; it is {middle[2]:.0f} cm before the cameras"
