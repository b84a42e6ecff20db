"""The blueprint lays the viewer out, and columns and states fill it.

The scene on the left, cameras below it, plots on the right. Rows go to the viewer as columns, a batch at a
time: 2 or 3 poses live, many to a file. What lasts (a pose of the hand, a held object) is a lane of states.
"""

from collections.abc import Sequence
from typing import cast

import numpy as np
import numpy.typing as npt
import rerun as rr
import rerun.blueprint as rrb

from common.arrays import Bool, Float, Int
from common.messages import Source
from master.outputs.drawing import OBJECT_RGB, SOURCE_MEANING, SOURCE_RGB, ObjectAppearance, Rgb
from master.rig.setup import RigSetup

TIMELINE = "capture"
WORLD = "world"
STATES, EVENTS = "states", "events"  # what lasts, as lanes; what happened, as lines of text

_RATE = "Rate [poses/s]"
# title, entity, range of the axis (None: as the data is), whether its lines need a legend
_PLOTS: tuple[tuple[str, str, tuple[float, float] | None, bool], ...] = (
    ("Latency [ms]", "plots/latency_ms", (0.0, 60.0), False),
    (_RATE, "plots/rate_hz", None, False),
    ("Error against the truth [mm]", "plots/error_mm", (0.0, 20.0), True),
    ("Fingers to object [mm]", "plots/contact_mm", (-10.0, 60.0), True),
    ("Bend of the wrist [deg]", "plots/wrist_angles_deg", (-60.0, 60.0), True),
    ("PIP flexion (thumb: MCP) [deg]", "plots/pip_deg", (-10.0, 120.0), True),
    ("Marker: raw to filtered [mm]", "plots/jitter_mm", (0.0, 5.0), True),
    ("Joints tracked; markers, or laser points, seen", "plots/seen", (0.0, 30.0), True),
    ("Health", "plots/health", None, True),
)
_TABS = 4  # the last so many share one place
_BACKGROUND = rrb.Background(color=(22, 24, 28))
# Beside and above the hand, which is 0.3-0.5 m in front of the cameras; they stay in the picture on the left.
_EYE_M, _TARGET_M = (0.21, -0.12, 0.0), (0.012, 0.018, 0.36)
# Of a wrist device: from above the palm and behind the camera, beside the forearm, towards the fingers.
_WRIST_EYE_M, _WRIST_TARGET_M = (0.17, -0.17, -0.10), (0.0, 0.035, 0.12)


def camera_path(camera: str) -> str:
    """Entity of one camera: its place, pinhole, image and what it detected."""
    return rr.new_entity_path([WORLD, "cameras", camera])


def blueprint(setups: Sequence[RigSetup], *, live: bool, with_truth: bool) -> rrb.Blueprint:
    """Return the layout; plots follow the last 10 s of a live run, or show all."""
    cameras = {name: camera for setup in setups for name, camera in setup.cameras.items()}
    hidden = [f"- {WORLD}/hand/{setup.hand.profile.name}/uncertainty" for setup in setups]
    plot_span_s = 10.0
    span = rrb.VisibleTimeRange(
        TIMELINE,
        start=rrb.TimeRangeBoundary.cursor_relative(seconds=-plot_span_s),
        end=rrb.TimeRangeBoundary.cursor_relative(),
    )
    views = [
        rrb.Spatial2DView(
            origin=camera_path(name),
            contents=["$origin/**", f"{WORLD}/hand/**", f"{WORLD}/objects/**", *hidden],
            name=f"Camera {name}",
            background=_BACKGROUND,
        )
        for name in cameras
    ]
    plots = _plots(setups, span if live else None, with_truth=with_truth)
    legend_view = rrb.TextDocumentView(origin="about", name="Colours")
    events = rrb.TextLogView(origin=EVENTS, name="Events")
    tabs = rrb.Tabs(*plots[-_TABS:], events, legend_view, active_tab=0)
    lanes = rrb.StateTimelineView(
        origin=STATES, name="Gestures and held objects", time_ranges=span if live else None
    )
    cameras_a_row = 4
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(
                _scene_view(setups),
                rrb.Grid(*views, grid_columns=min(len(views), cameras_a_row)),
                row_shares=[3, 2],
            ),
            rrb.Vertical(tabs, *plots[:-_TABS], lanes, row_shares=[1.5] + [1] * (len(plots) - _TABS) + [1.4]),
            column_shares=[3, 2],
        ),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
    )


def _scene_view(setups: Sequence[RigSetup]) -> rrb.Spatial3DView:
    """Everything in space, from where all of it is in the picture."""
    with_markers = any(setup.has_markers for setup in setups)
    position, target = (_eye_of(setups), _TARGET_M) if with_markers else (_WRIST_EYE_M, _WRIST_TARGET_M)
    eye = rrb.EyeControls3D(position=position, look_target=target, eye_up=(0.0, -1.0, 0.0))
    return rrb.Spatial3DView(
        origin="/",  # above the world: a wrist device's is turned as the forearm is held
        contents=f"{WORLD}/**",
        name="Hand and rig",
        background=_BACKGROUND,
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=eye,
    )


def _plots(
    setups: Sequence[RigSetup], span: rrb.VisibleTimeRange | None, *, with_truth: bool
) -> list[rrb.TimeSeriesView]:
    """The plots of what these rigs have, over `span`, or over all."""
    cameras = [camera for setup in setups for camera in setup.cameras.values()]
    rate_hz = max(camera.frame_rate_hz for camera in cameras)  # of the fastest
    with_markers = any(setup.has_markers for setup in setups)
    with_wrist = any(setup.has_markers and setup.wrist is not None for setup in setups)
    rejected = {name for name, there in (
        ("plots/jitter_mm", with_markers), ("plots/error_mm", with_truth), ("plots/wrist_angles_deg", with_wrist),
        ("plots/contact_mm", any(setup.objects for setup in setups)),
    ) if not there}  # fmt: skip
    rows = [
        (n, p, (0.0, 1.25 * rate_hz) if n == _RATE else r, several)
        for n, p, r, several in _PLOTS
        if p not in rejected
    ]
    return [
        rrb.TimeSeriesView(
            origin=path,
            name=name,
            time_ranges=span,
            axis_y=None if fixed is None else rrb.ScalarAxis(range=fixed),
            plot_legend=rrb.PlotLegend(visible=several, corner=rrb.Corner2D.LeftTop),
        )
        for name, path, fixed, several in rows
    ]


def _eye_of(setups: Sequence[RigSetup]) -> tuple[float, float, float]:
    """Viewpoint [m] of the scene from which every static camera is in the picture."""
    target, eye = np.array(_TARGET_M), np.array(_EYE_M)
    models = [model for setup in setups if setup.has_markers for model in setup.models.values()]
    reach = max(float(np.linalg.norm(model.centre - target)) for model in models)
    # cameras farther from the hand than that stand around it: the eye steps back, to 1.5 of the farthest
    around_m = 0.45
    if reach > around_m:
        eye = target + 1.5 * reach * (eye - target) / np.linalg.norm(eye - target)
    x, y, z = (float(value) for value in eye)
    return x, y, z


def legend() -> str:
    """Return Markdown text that explains the colours of the scene."""
    names = {source: f"rgb{SOURCE_RGB[source]}" for source in Source}
    lines = [f"- **{s.name.lower()}** {names[s]}: {SOURCE_MEANING[s]}" for s in Source]
    return (
        "# Colours\nBones and joints by source; a joint at half brightness is valid but not tracked now.\n\n"
        + "\n".join(lines)
        + "\n- **red joint**: an angle is at its limit\n- **thin grey hand**: the truth, where it is known\n"
        "- of a wrist device: **red fan**: its laser; **points in it**: where that meets each finger; **yellow, grey "
        "lines**: sights of the camera to these points, and to the tips that are tracked\n"
        "- **pink bar behind the wrist**: the forearm that wears the device, beside cameras of markers; **pink ring**: "
        "where its end is at 2 sigma of the wrist's bend\n"
        "- **small dim / large bright markers**: before / after the filter\n"
        + "".join(
            f"- **object** rgb{OBJECT_RGB[look]}: {look.value}\n"
            for look in ObjectAppearance
            if look is not ObjectAppearance.GONE
        )
        + "- **red, yellow spots on it**: where a finger touches it, or is nearer than 3 cm, with the distance in mm\n"
        "- **pink line**: a pinch; **yellow circle**: a dial, by how much it was turned; **blue arrow**: pointing\n"
        "- **ellipsoids**: 2 sigma of the finger tips, where that is less than 3 cm\n"
        "- **grey box**: the volume that the rig states; outside it, accuracy was not tested\n"
        "- camera views: dots are the markers as triangulated, the hand is drawn without lens distortion"
    )


PIXEL_CENTRE = 0.5  # Rerun: (0, 0) is the corner of the first pixel; here: its centre


class Columns:
    """Sender of rows to a recording that belongs to the caller, each at its `t_ns`."""

    def __init__(self, recording: rr.RecordingStream) -> None:
        self._rec = recording

    def send(self, path: str, t_ns: Int, columns: rr.ComponentColumnList, lengths: Int | None) -> None:
        """Send rows of `lengths` (T,) instances (0 clears the last row); None: one each."""
        index = rr.TimeColumn(TIMELINE, duration=cast("list[np.timedelta64]", t_ns.astype("timedelta64[ns]")))
        parts = columns if lengths is None else columns.partition(lengths)
        self._rec.send_columns(path, [index], parts)

    def points(
        self,
        path: str,
        t_ns: Int,
        at: Float,
        shown: Bool,
        colours: npt.NDArray[np.uint32],
        radii: Float | float,
    ) -> None:
        """Those of the points (T, N, 3) that are `shown` (T, N), in colours (T, N)."""
        each = np.broadcast_to(radii, shown.sum())
        columns = rr.Points3D.columns(positions=at[shown], colors=colours[shown], radii=each)
        self.send(path, t_ns, columns, shown.sum(axis=1))

    def pixels(
        self, path: str, t_ns: Int, uv: Float, colours: npt.NDArray[np.uint32], radius_px: float
    ) -> None:
        """Send those of the pixels (T, N, 2) that are not NaN, in colours (T, N)."""
        shown = seen(uv)
        columns = rr.Points2D.columns(
            positions=uv[shown] + PIXEL_CENTRE, colors=colours[shown], radii=np.full(shown.sum(), radius_px)
        )
        self.send(path, t_ns, columns, shown.sum(axis=1))

    def strips(
        self,
        path: str,
        t_ns: Int,
        strips: Sequence[Float],
        lengths: Int,
        colours: int | npt.NDArray[np.uint32],
        radius_m: float,
        labels: Sequence[str] | None = None,
    ) -> None:
        """Send line strips (K, 3), `lengths` (T,) of them a row, in given colours."""
        count = len(strips)
        columns = rr.LineStrips3D.columns(
            strips=strips,
            radii=np.full(count, radius_m),
            colors=np.full(count, colours, np.uint32),
            labels=labels,
        )
        self.send(path, t_ns, columns, lengths)

    def rays(self, path: str, t_ns: Int, origin: Float, to: Float, colour: int) -> None:
        """Lines from `origin` (3,) to those of the points (T, N, 3) that are not NaN."""
        shown = seen(to)
        rays = [np.stack([origin, point]) for point in to[shown]]
        self.strips(path, t_ns, rays, shown.sum(axis=1), colour, 0.0003)

    def lines(self, path: str, t_ns: Int, strips: Float, colour: int, radius_m: float) -> None:
        """One line a row through its points (T, K, 3); none where one of them is NaN."""
        shown = np.asarray(seen(strips).all(axis=1), np.bool_)
        self.strips(path, t_ns, list(strips[shown]), shown.astype(np.int64), colour, radius_m)

    def scalars(self, path: str, t_ns: Int, values: Float) -> None:
        """Send one number per row; at NaN the viewer breaks the line."""
        self.send(path, t_ns, rr.Scalars.columns(scalars=values), None)

    def name(self, path: str, name: str, rgb: Rgb) -> None:
        """Name and colour of a plotted line."""
        self._rec.log(path, rr.SeriesLines(names=name, colors=[rgb]), static=True)


def seen(points: Float) -> Bool:
    """Which of the points (..., D) are not NaN, (...)."""
    return np.asarray(~np.isnan(points).any(axis=-1), np.bool_)


class States:
    """Logger of state changes to a recording that belongs to the caller."""

    def __init__(self, recording: rr.RecordingStream) -> None:
        self._rec = recording
        self._last: dict[str, str | None] = {}

    def log(self, lane: str, t_ns: int, state: str | None) -> None:
        """Log the state of a lane (a path of names) if it changed; None: no state."""
        if self._last.get(lane) == state:
            return
        self._last[lane] = state
        self.at(t_ns)
        path = rr.new_entity_path([STATES, *lane.split("/")])
        self._rec.log(path, rr.Clear(recursive=False) if state is None else rr.StateChange(state=state))

    def at(self, t_ns: int) -> None:
        """Let what is logged row by row stand at this time."""
        self._rec.set_time(TIMELINE, duration=np.timedelta64(t_ns, "ns"))
