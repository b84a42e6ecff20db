"""Panels of steps 3 and 6 start the cameras and the master."""

import numpy as np
from nicegui import ui

from common.messages import HandPose
from master.console.controls import every
from master.console.setup.commands import VIEWS
from master.console.setup.parts import Desk, command_line, heading, previews


def panel_start(desk: Desk) -> None:
    """Fill the panel."""
    session = desk.session
    heading("Start cameras", "They run without lens, place and colours until these are measured.")
    here = [camera for camera in session.plan.cameras if camera.kind != "pi"]
    for camera in session.plan.cameras:
        if camera.kind == "pi":
            copy, run = session.commands.pi(camera)
            command_line(f"For {camera.name}, first here: bring the files to its Pi", copy)
            command_line(f"then on the Pi of {camera.name}: start its slave; it appears below by itself", run)
    if session.state.settings.beacon.startswith("127.") and len(here) < len(session.plan.cameras):
        ui.label(
            "This console speaks to this computer only. For Pis start it as: phalanx console --keys DIR"
            " --beacon 192.168.1.255:47800 --bind 0.0.0.0:47801 --bus tls/0.0.0.0:47802"
        ).classes("setup-error")
    view = None
    if session.plan.simulated:
        chosen = session.view if session.view in VIEWS else "still"
        view = ui.select(VIEWS, label="What the simulated cameras look at", value=chosen).classes("w-96")

    def go() -> None:
        if here:
            session.start_cameras(session.view if view is None else str(view.value))
        if session.master is None and not session.foreign_master:
            session.start_master()

    def end() -> None:
        session.stop_cameras()
        session.stop_master()

    with ui.row():
        ui.button("Start cameras" if here else "Look for cameras", on_click=lambda: desk.attempt(go)).props(
            'icon="play_arrow"'
        )
        ui.button("Stop", on_click=lambda: desk.attempt(end)).props('flat icon="stop"')
        ui.button("Next: lenses and places", on_click=lambda: desk.go("lens")).props("flat")
    who = ui.label().props('role="status"')
    wrong = ui.label().classes("setup-error").props('role="alert"')
    previews(desk)

    def look() -> None:
        alive = session.state.alive
        names = [camera.name for camera in session.plan.cameras]
        absent = [name for name in names if name not in alive]
        who.set_text(f"waiting for {', '.join(absent)}" if absent else f"all {len(names)} cameras are there")
        wrong.set_text("\n".join(session.failures()))

    every(0.5, look)


def panel_track(desk: Desk) -> None:
    """Fill the panel."""
    session = desk.session
    heading("Track", "The master estimates the hand from what the cameras see, and reports what is wrong.")

    def go() -> None:
        if not session.tracks:
            session.start_master()
        session.show("standard" if session.view in ("still", "board") else session.view)

    with ui.row():
        ui.button("Start tracking", on_click=lambda: desk.attempt(go)).props('icon="play_arrow"')
        ui.button("Stop", on_click=lambda: desk.attempt(session.stop_master)).props('flat icon="stop"')
        ui.button("See the hand", on_click=lambda: ui.navigate.to("/live")).props('flat icon="visibility"')
    status = ui.label().classes("text-h6").props('role="status" data-testid="tracking"')
    hands = ui.label().classes("setup-text")
    items = ui.label().classes("setup-text")
    wrong = ui.label().classes("setup-error").props('role="alert"')

    def look() -> None:
        poses, checklist = session.state.poses.values(), session.state.checklist
        if any(pose.tracked.any() for pose in poses):
            status.set_text("A hand is tracked")
        elif session.tracks:
            status.set_text("The master runs; it waits for cameras and a hand")
        else:
            met = "The cameras are met; nothing is tracked yet"
            status.set_text(met if session.meets else "No master runs")
        hands.set_text("\n".join(sentence(pose) for pose in poses))
        wrong.set_text("\n".join(session.failures()))
        lines = [] if checklist is None else [f"{item.sentence} {item.fix}" for item in checklist.items]
        items.set_text("\n".join(lines) or "Checklist: all well" * (checklist is not None))

    every(0.5, look)


def sentence(pose: HandPose) -> str:
    """One pose in words: how many markers are seen, where the palm is."""
    seen = int(np.isfinite(pose.markers_raw_m).all(axis=1).sum())
    middle = 1e2 * np.nanmean(pose.position_m, axis=0)
    return f"{pose.hand}: {seen} of {len(pose.markers_raw_m)} markers seen; it is {middle[2]:.0f} cm before the cameras"
