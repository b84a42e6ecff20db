"""Page Tune: settings and colours of each camera, and the filter of each rig.

Every change acts at once.
"""

from nicegui import ui

from master.console.camera_panel import CameraPanel
from master.console.filter_panel import filter_panel
from master.console.state import ConsoleState


def build(state: ConsoleState) -> None:
    """Fill the page."""
    cameras = state.cameras()
    rigs = state.rigs()
    if not cameras:
        with ui.element("div").classes("panel empty"):
            ui.label("No camera to tune yet")
            ui.label("The Set-up page starts one.").classes("soft")
        return
    filtered = [name for name, rig in rigs.items() if rig.kind == "markers"]
    names = [*cameras, *(f"filter of {rig}" for rig in filtered)]
    with (
        ui.tabs().classes("tune-tabs").props("dense no-caps align=left outside-arrows mobile-arrows") as tabs
    ):
        for name in names:
            ui.tab(name, icon="videocam" if name in cameras else "filter_alt").props("inline-label")
    with ui.tab_panels(tabs, value=names[0], animated=False).classes("tune-panels").props("keep-alive=false"):
        for camera in cameras:
            markers = tuple(name for rig in rigs.values() if camera in rig.cameras for name in rig.markers)
            with ui.tab_panel(camera):
                CameraPanel(state, camera, markers)
        for rig in filtered:
            with ui.tab_panel(f"filter of {rig}"):
                filter_panel(state, rig)
