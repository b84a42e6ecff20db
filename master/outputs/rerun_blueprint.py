"""How the viewer is laid out when it opens: the scene on the left, cameras below it, plots on the right."""

import rerun as rr
import rerun.blueprint as rrb

from common.calibration import RigCalibration
from common.messages import Source
from master.outputs.palette import SOURCE_MEANING, SOURCE_RGB

TIMELINE = "capture"
WORLD = "world"

_PLOTS = (
    ("Latency [ms]", "plots/latency_ms"),
    ("Rate [Hz]", "plots/rate_hz"),
    ("Error against the truth [mm]", "plots/error_mm"),
    ("Marker: raw to filtered [mm]", "plots/jitter_mm"),
    ("PIP flexion (thumb MCP) [deg]", "plots/pip_deg"),
    ("Joints tracked, markers seen", "plots/seen"),
    ("Health", "plots/health"),
)
_EYE_HEIGHT_M, _EYE_BACK_M, _HAND_M = 0.12, 0.18, 0.42
_PLOT_SPAN_S = 10.0


def camera_path(camera: str) -> str:
    """Entity of one camera: its place, pinhole, image and what it detected."""
    return rr.new_entity_path([WORLD, "cameras", camera])


def blueprint(rig: RigCalibration, *, live: bool, with_truth: bool) -> rrb.Blueprint:
    """The saved layout for `rig`; plots follow the last 10 s of a live run and show all of a recorded one.

    Args:
        rig: Names the cameras.
        live: The data streams in.
        with_truth: There is a truth to show errors against.
    """
    span = rrb.VisibleTimeRange(
        TIMELINE,
        start=rrb.TimeRangeBoundary.cursor_relative(seconds=-_PLOT_SPAN_S),
        end=rrb.TimeRangeBoundary.cursor_relative(),
    )
    eye = rrb.EyeControls3D(
        position=(0.25, -_EYE_HEIGHT_M, -_EYE_BACK_M),
        look_target=(0.04, 0.0, _HAND_M),
        eye_up=(0.0, -1.0, 0.0),
    )
    scene = rrb.Spatial3DView(origin=WORLD, name="Hand and rig", eye_controls=eye)
    cameras = [
        rrb.Spatial2DView(origin=camera_path(name), contents=["$origin/**", f"{WORLD}/hand/**"], name=name)
        for name in rig.cameras
    ]
    plots = [
        rrb.TimeSeriesView(origin=path, name=name, time_ranges=span if live else None)
        for name, path in _PLOTS
        if with_truth or path != "plots/error_mm"
    ]
    legend = rrb.TextDocumentView(origin="about", name="Colours")
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(scene, rrb.Horizontal(*cameras), row_shares=[3, 1.4]),
            rrb.Vertical(
                rrb.Tabs(*plots[-3:], legend, active_tab=0), *plots[:-3], row_shares=[1] * (len(plots) - 2)
            ),
            column_shares=[3, 2],
        ),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
    )


def legend() -> str:
    """Markdown text that says what the colours of the scene mean."""
    names = {source: f"rgb{SOURCE_RGB[source]}" for source in Source}
    lines = [f"- **{s.name.lower()}** {names[s]}: {SOURCE_MEANING[s]}" for s in Source]
    return (
        "# Colours\nBones and joints by source; a joint at half brightness is valid but not tracked now.\n\n"
        + "\n".join(lines)
        + "\n- **red joint**: an angle is at its limit\n- **thin grey hand**: the truth, where it is known\n"
        "- **small dim / large bright markers**: before / after the filter\n"
        "- **ellipsoids**: 2 sigma of the finger tips\n"
        "- camera views draw the hand without lens distortion"
    )
