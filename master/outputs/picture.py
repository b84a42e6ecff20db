"""The picture shows a run and its rig on 1600 x 900 pixels.

The rig frame is that of a camera that looks along +z at the back of the hand, y down; the hand is shown as
that camera sees it, turned a little to the side, so it stands upright. All axes of the hand and of the rig
have one scale. The hand of a wrist device, whose camera looks along the palm, is shown from above the palm
and behind the wrist.
"""

from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from common.arrays import Float
from common.calibration import RigCalibration
from common.calibration.files import replacing
from common.geometry.transforms import axis_rotation
from common.hand.model import FINGER_JOINTS, TIPS, WRIST, HandModel
from common.messages import Source
from master.outputs.drawing import (
    INK,
    PAPER,
    RAY_RGB,
    SOURCE_MEANING,
    SOURCE_RGB,
    TRUTH_RGB,
    Colour,
    Rgb,
    View,
    draw_panels,
    entry,
    render_hand,
    series_rgb,
    style,
    unit,
)
from master.outputs.picture_overlays import ResultPicture, WristPicture
from master.outputs.poses import Poses, PosesTruth
from master.outputs.result_files import cannot_write
from master.rig.merge import edges

STRIPS = (*((WRIST, *joints) for joints in FINGER_JOINTS), (7, 12, 17, 22))
_RIG_YAW, _RIG_PITCH = np.deg2rad(52.0), np.deg2rad(-38.0)


def draw_rig(
    figure: Figure, poses: Poses, row: int, rig: RigCalibration, wrist: WristPicture | None = None
) -> None:
    """Draw cameras, rays to the caps, hand and volume from the side, lower left."""
    axes = figure.add_axes((0.012, 0.02, 0.215, 0.33))
    style(axes, "Rig, seen from the side")
    axes.set_xticks([])
    axes.set_yticks([])
    axes.set_aspect("equal", adjustable="datalim")
    rotation = axis_rotation(0, _RIG_PITCH) @ axis_rotation(1, _RIG_YAW)
    at = np.where(poses.valid[row][:, None], poses.position_m[row], np.nan) @ rotation.T
    for strip in STRIPS:
        axes.plot(at[list(strip), 0], at[list(strip), 1], color=unit((237, 184, 153)), lw=1.8)
    caps = poses.markers_m[row] @ rotation.T
    middle = np.mean([rig.camera_pose(name)[:3, 3] for name in rig.cameras], axis=0) @ rotation.T
    if rig.volume is not None:
        for edge in edges(rig.volume) @ rotation.T:
            axes.plot(edge[:, 0], edge[:, 1], color=INK, lw=0.7, alpha=0.35)
    for name in rig.cameras:
        pose = rig.camera_pose(name)
        centre = pose[:3, 3] @ rotation.T
        for cap in caps:
            axes.plot([centre[0], cap[0]], [centre[1], cap[1]], color=unit(RAY_RGB), lw=0.6, alpha=0.55)
        _frustum(axes, pose, rotation)
        away = (centre - middle)[:2] * [1.0, -1.0]
        away = 17.0 * away / max(float(np.linalg.norm(away)), 1e-6)
        axes.annotate(name, (float(centre[0]), float(centre[1])), (float(away[0]), float(away[1])),
                      textcoords="offset points", color=INK, size=10, ha="center", va="center")  # fmt: skip
    if wrist is not None:
        _frustum(axes, wrist.pose(poses, row), rotation, unit(SOURCE_RGB[Source.WRIST]))
    axes.invert_yaxis()
    axes.margins(0.2)  # room for the names


def _frustum(axes: Axes, pose: Float, rotation: Float, colour: Colour = INK) -> None:
    d, w, h = 0.05, 0.03, 0.0225
    corners = np.array([[-w, -h, d], [w, -h, d], [w, h, d], [-w, h, d], [-w, -h, d]])
    image = (corners @ pose[:3, :3].T + pose[:3, 3]) @ rotation.T
    centre = pose[:3, 3] @ rotation.T
    axes.plot(image[:, 0], image[:, 1], color=colour, lw=1.2)
    for corner in image[:4]:
        axes.plot([centre[0], corner[0]], [centre[1], corner[1]], color=colour, lw=1.2)


WIDTH_PX, HEIGHT_PX = 1600, 900
_DPI = 100
_HAND_BOX = (0.19, 0.0, 0.43, 0.87)  # left, bottom, width, height of the figure
_HAND_BOX_ABOVE = (0.19, 0.205, 0.43, 0.665)  # a strip of gestures
_SKIN = np.array([1.0, 0.79, 0.67])
_YAW, _PITCH = np.deg2rad(-20.0), np.deg2rad(-12.0)
_WRIST_YAW, _WRIST_PITCH = np.deg2rad(30.0), np.deg2rad(58.0)
# Key figures of the summary, in the order of importance: key, label, format.
_FIGURES = (
    ("poses_per_s", "poses / s", "{:.1f}"),
    ("latency_p50_ms", "ms latency p50", "{:.1f}"),
    ("latency_p99_ms", "ms latency p99", "{:.1f}"),
    ("lost", "lost", "{:.0f}"),
    ("object_mm", "mm object error", "{:.1f}"),
    ("object_deg", "deg object error", "{:.1f}"),
    ("gestures_right", "gestures right", "{:.0f}"),
    ("marker_mm", "mm marker error", "{:.1f}"),
    ("laser_mm", "mm laser error", "{:.2f}"),
    ("joint_mm", "mm joint error", "{:.1f}"),
    ("joint_mm_visible", "mm joints, visible", "{:.1f}"),
    ("pip_deg_visible", "deg PIP, visible", "{:.1f}"),
    ("pip_rms_deg", "deg PIP, rms", "{:.1f}"),
    ("forearm_tilt_deg", "deg forearm tilt", "{:.1f}"),
)


def draw_summary(
    path: Path,
    poses: Poses,
    rig: RigCalibration,
    model: HandModel,
    summary: Mapping[str, float],
    truth: PosesTruth | None = None,
    row: int | None = None,
    wrist: WristPicture | None = None,
    results: ResultPicture | None = None,
) -> None:
    """Write the picture as PNG.

    Args:
        path: The file; replaced only by a complete one.
        poses: The run; without a valid pose the picture states so.
        model: The hand; its name, side and limits are shown.
        summary: Key figures by the names of the summary JSON; others are left out.
        truth: Row by row with `poses`; drawn as a ghost, and as error over time.
        row: The pose to show; None: an open hand with as many tracked joints as there are.
        results: Objects and gestures of the run; a strip of the latter stands below the hand, if there are any.

    Raises:
        RecordingError: The file cannot be written; nothing half written is left.
    """
    figure = Figure(figsize=(WIDTH_PX / _DPI, HEIGHT_PX / _DPI), dpi=_DPI, facecolor=PAPER)
    FigureCanvasAgg(figure)
    _header(figure, rig, wrist, model, summary)
    row = best_row(poses) if row is None else row
    if row is None:
        figure.text(0.3, 0.45, "no valid pose in this run", color=INK, size=20, ha="center")
    else:
        _hand(figure, poses, row, model, truth, wrist, results)
        if wrist is None or wrist.in_rig:
            draw_rig(figure, poses, row, rig, wrist)
        else:
            wrist.draw_camera(figure, poses, row, truth)
        draw_panels(figure, poses, row, model, truth)
    try:
        with replacing(path) as file:
            # No creation date or version inside: the same run gives the same picture.
            figure.savefig(file, format="png", dpi=_DPI, facecolor=PAPER, metadata={"Software": None})
    except OSError as error:
        raise cannot_write(path, error) from error


def best_row(poses: Poses, results: ResultPicture | None = None) -> int | None:
    """Choose the row to show in the picture; None: no pose is valid.

    Preferred: all joints valid if possible, an object held or known, most joints tracked, fingers spread.
    """
    whole = poses.valid.sum(axis=1)
    if not whole.any():
        return None
    tips = poses.position_m[:, TIPS]
    reach = np.linalg.norm(tips - poses.position_m[:, WRIST, None], axis=-1).sum(axis=1)
    spread = np.linalg.norm(np.diff(tips, axis=1), axis=-1).sum(axis=1)
    score = 0.0 if results is None else 500.0 * results.interest(poses.t_ns)
    score = score + whole * 100.0 + poses.tracked.sum(axis=1) * 10.0 + np.nan_to_num(reach + spread)
    score = np.where(whole > 0, score, -1.0)
    return int(np.argmax(score))


def _header(
    figure: Figure,
    rig: RigCalibration,
    wrist: WristPicture | None,
    model: HandModel,
    summary: Mapping[str, float],
) -> None:
    figure.text(0.018, 0.948, "Phalanx", color=INK, size=25, weight="bold", va="center")
    most_figures = 10
    shown = [(label, form.format(summary[key])) for key, label, form in _FIGURES if key in summary]
    shown = shown[:most_figures]
    many = len(shown) > 8
    wrist_rigs = [wrist.rig] if wrist is not None and wrist.in_rig else []
    count = len(rig.cameras) + len(wrist_rigs)
    rigs, cameras = (
        f"rig {' and '.join([rig.name, *wrist_rigs])}",
        f"{count} camera{'s' if count > 1 else ''}",
    )
    hand = f"hand {model.profile.name} ({model.profile.side})"
    watched = f"{rigs} · {cameras}"
    # letters of what was tracked that fit in one line beside eight figures, and beside more
    line, half_line = 52, 36
    if len(watched) > half_line:
        watched = f"{rigs}\n{cameras}"
    what = watched + (" · " if len(watched + hand) <= line and not many else "\n") + hand
    figure.text(0.019, 0.925, what, color=INK, alpha=0.75, size=12, va="top")
    for i, (label, value) in enumerate(reversed(shown)):
        # of the width, between eight figures and between more
        figure_step, figure_step_narrow = 0.0845, 0.0735
        x = 0.945 - i * (figure_step_narrow if many else figure_step)
        figure.text(x, 0.949, value, color=INK, size=21, weight="bold", ha="center", va="center")
        figure.text(x, 0.905, label, color=INK, alpha=0.75, size=9 if many else 10, ha="center", va="center")


def _hand(
    figure: Figure,
    poses: Poses,
    row: int,
    model: HandModel,
    truth: PosesTruth | None,
    wrist: WristPicture | None,
    results: ResultPicture | None,
) -> None:
    box = _HAND_BOX
    if results is not None and results.gestures:
        box = _HAND_BOX_ABOVE
        results.draw_strip(figure, poses.t_ns, row)
    at = np.where(poses.valid[row][:, None], poses.position_m[row], np.nan)
    if wrist is None or wrist.in_rig:
        rotated = axis_rotation(0, _PITCH) @ axis_rotation(1, _YAW * model.side_sign)  # thumb to the eye
    else:
        rotated = axis_rotation(0, _WRIST_PITCH) @ axis_rotation(2, _WRIST_YAW * model.side_sign)
    shown = [at] if wrist is None else [at, wrist.reach_m(poses, row)]
    t_ns = int(poses.t_ns[row])
    view = fit_view(
        np.concatenate(shown if results is None else [*shown, results.points_m(t_ns)]), rotated, box
    )
    axes = figure.add_axes(box)
    axes.set_axis_off()
    axes.set_xlim(0, view.width_px)
    axes.set_ylim(view.height_px, 0)
    brightness, covered = render_hand(view, at, poses.radius_m[row])
    rgba = np.concatenate([brightness[..., None] * _SKIN, 0.8 * covered[..., None]], axis=-1)
    axes.imshow(
        np.clip(rgba, 0.0, 1.0), extent=(0, view.width_px, view.height_px, 0), interpolation="bilinear"
    )
    if truth is not None:
        _bones(axes, view.project(truth.joints_m[row]), [TRUTH_RGB] * 26, width=1.3, dashes=(3, 2))
    rgb = {source.value: SOURCE_RGB[source] for source in Source}
    colours = [rgb.get(code, SOURCE_RGB[Source.NONE]) for code in poses.source[row].tolist()]
    pixels = view.project(at)
    _bones(axes, pixels, colours, width=3.4)
    for joint in np.flatnonzero(poses.valid[row]).tolist():
        edge = unit(colours[joint])
        face = edge if poses.tracked[row, joint] else PAPER
        axes.plot(pixels[joint, 0], pixels[joint, 1], "o", ms=8, mfc=face, mec=edge, mew=2.0, zorder=6)
    caps = view.project(poses.markers_m[row])
    for m in range(poses.marker_count):
        ring = unit(series_rgb(m))
        axes.plot(caps[m, 0], caps[m, 1], "o", mfc="none", mec=ring, mew=2.4, ms=19, zorder=7)
    more = [] if wrist is None else wrist.draw_laser(axes, view, poses, row)
    more += [] if results is None else results.draw(axes, view, t_ns)
    _scale_bar(axes, view)
    _legend(figure, poses, truth, more)


def fit_view(at: Float, rotation: Float, box: tuple[float, float, float, float] = _HAND_BOX) -> View:
    """The view in which the points (N, 3) [m] fill the hand's box."""
    width, height = round(box[2] * WIDTH_PX), round(box[3] * HEIGHT_PX)
    rotated = at @ rotation.T
    low, high = np.nanmin(rotated, axis=0), np.nanmax(rotated, axis=0)
    margin_m = 0.027  # of flesh around the joints
    span = high - low + 2 * margin_m
    fill = 0.90  # share of the box that the hand may take
    scale = fill * min(width / span[0], height / span[1])
    return View(rotation, (low + high) / 2 @ rotation, float(scale), width, height)


def _bones(
    axes: Axes, pixels: Float, colours: list[Rgb], width: float, dashes: tuple[float, float] | None = None
) -> None:
    """Every bone in the colour of its far joint."""
    for strip in STRIPS:
        for a, b in pairwise(strip):
            line = Line2D(pixels[[a, b], 0], pixels[[a, b], 1], lw=width, color=unit(colours[b]), zorder=5)
            line.set_solid_capstyle("round")
            if dashes is not None:
                line.set_dashes(dashes)
            axes.add_line(line)


def _scale_bar(axes: Axes, view: View) -> None:
    length = 0.05 * view.scale_px_m
    x, y = view.width_px - 40 - length, view.height_px - 34
    axes.plot([x, x + length], [y, y], color=INK, lw=2.5)
    axes.text(x + length / 2, y - 9, "5 cm", color=INK, size=11, ha="center", va="bottom")


def _legend(figure: Figure, poses: Poses, truth: PosesTruth | None, more: list[Line2D]) -> None:
    used = [source for source in Source if (poses.source[poses.valid] == source).any()]
    entries = [
        Line2D([], [], color=unit(SOURCE_RGB[s]), marker="o", mfc=PAPER, mew=2, lw=3, label=SOURCE_MEANING[s])
        for s in used
    ]
    entries.append(entry(INK, marker="o", label="filled: tracked now"))
    if poses.marker_count:
        entries.append(entry(INK, marker="o", ms=13, mfc="none", mew=2, label="marker, filtered"))
    entries += more
    if truth is not None:
        entries.append(entry(unit(TRUTH_RGB), ls="--", lw=1.3, label="truth"))
    figure.legend(
        handles=entries,
        loc="upper left",
        bbox_to_anchor=(0.010, 0.85),
        frameon=False,
        fontsize=11,
        labelspacing=0.8,
        labelcolor=INK,
    )
