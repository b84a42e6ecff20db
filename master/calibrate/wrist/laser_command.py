"""`phalanx calibrate wrist laser-plane`: the laser plane in the camera frame.

Views of a board that the laser crosses enter.
"""

from argparse import Namespace
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from msgspec.structs import replace

from common.calibration import RigCalibration
from common.command_line import echo
from common.errors import FitError
from common.geometry.camera_model import CameraModel
from common.recording.frame_recording import Illumination
from master.calibrate.cameras.boards import Board, board_in
from master.calibrate.tree_files import print_lines, provenance, refusals_named, write_report
from master.calibrate.wrist.device import (
    Device,
    LitView,
    board_pose,
    device_of,
    grouped_by_reason,
    lit_views,
    write_device,
)
from master.calibrate.wrist.plane import PlaneFit, ViewLine, fit_plane, line_on_board


@dataclass(frozen=True, slots=True)
class LinesSeen:
    """Lines of the views that show one, and of every other view the reason."""

    lines: tuple[ViewLine, ...]
    refused: Mapping[str, str]


def laser_plane(options: Namespace) -> None:
    """Measure the plane of a wrist device's laser, from ten views of a board."""
    device = device_of(options.source, options.rig, options.calibration, options.out)
    views = lit_views(options.source, device.camera.name, Illumination.LASER)
    seen = lines_of(views, board_in(options), device.optics)
    with refusals_named(options.source, grouped_by_reason(seen.refused)):
        fit = fit_plane(seen.lines)
    print_lines(report_lines(fit, seen, len(views)))
    if options.picture is not None:
        from master.calibrate.picture import draw_plane

        draw_plane(options.picture, fit, seen.lines, device.optics)
        echo(f"drew {options.picture}")
    written = write_device(options.out, device, rig_with_plane(device, fit), "laser_plane")
    write_report(options.json_file, report_json(fit, seen), written)


def lines_of(views: tuple[LitView, ...], board: Board, optics: CameraModel) -> LinesSeen:
    """The laser's line on the board of every view.

    Raises:
        RecordingError: An image cannot be read.
    """
    focal = float(np.sqrt(optics.matrix[0, 0] * optics.matrix[1, 1]))
    lines: list[ViewLine] = []
    refused: dict[str, str] = {}
    for view in views:
        laser, ambient = view.load(Illumination.LASER), view.load(Illumination.AMBIENT)
        assert laser is not None  # `lit_views` gives whole ones
        assert ambient is not None
        try:
            placed = board_pose(view, board, optics)
            if laser.shape != ambient.shape:
                raise FitError("its frames differ in size")
            line = line_on_board(laser, ambient, placed, board, optics)
        except FitError as error:
            refused[view.name] = str(error)
            continue
        lines.append(ViewLine.of(view.name, line, placed, focal))
    return LinesSeen(tuple(lines), refused)


def report_lines(fit: PlaneFit, seen: LinesSeen, views: int) -> list[str]:
    """The result for a person."""
    x, y, z = fit.plane.normal
    used = int(fit.used.sum())
    points = sum(len(line.points_m) for line, own in zip(seen.lines, fit.used, strict=True) if own)
    lines = [
        f"laser plane from {points} points in {used} of {views} views, {1e3 * fit.rms_m:.3f} mm rms from it",
        f"  normal {x:+.5f} {y:+.5f} {z:+.5f}  ± {np.degrees(fit.normal_sigma_rad):.3f} deg",
        f"  offset {1e3 * fit.plane.offset_m:.3f} ± {1e3 * fit.offset_sigma_m:.3f} mm",
    ]
    wrong = [
        f"view {line.name}: {1e3 * off:.2f} mm off the plane of the others"
        for line, own, off in zip(seen.lines, fit.used, fit.off_m, strict=True)
        if not own
    ]
    if seen.refused or wrong:
        reasons = (*grouped_by_reason(seen.refused), *wrong)
        lines += [f"left out ({len(seen.refused) + len(wrong)}):", *(f"  {reason}" for reason in reasons)]
    return lines


def report_json(fit: PlaneFit, seen: LinesSeen) -> dict[str, object]:
    """The same for programs."""
    return {
        "normal": list(fit.plane.normal),
        "offset_mm": 1e3 * fit.plane.offset_m,
        "normal_sigma_deg": round(float(np.degrees(fit.normal_sigma_rad)), 6),
        "offset_sigma_mm": round(1e3 * fit.offset_sigma_m, 6),
        "covariance_normal_offset_m": fit.covariance.tolist(),
        "rms_mm": round(1e3 * fit.rms_m, 6),
        "views": {
            line.name: {"rms_mm": round(1e3 * float(off), 6), "used": bool(own), "points": len(line.points_m)}
            for line, own, off in zip(seen.lines, fit.used, fit.off_m, strict=True)
        },
        "refused": dict(seen.refused),
    }


def rig_with_plane(device: Device, fit: PlaneFit) -> RigCalibration:
    """The device's rig with the new plane and where it comes from."""
    residual = {
        "rms_mm": round(1e3 * fit.rms_m, 4),
        "normal_sigma_deg": round(float(np.degrees(fit.normal_sigma_rad)), 4),
        "offset_sigma_mm": round(1e3 * fit.offset_sigma_m, 4),
    }
    note = f"{int(fit.used.sum())} of {len(fit.used)} views of a board"
    how = provenance("calibrate wrist laser-plane", (device.source,), residual, note)
    rig = device.rig
    return replace(rig, laser_plane=fit.plane, provenance=rig.provenance | {"laser_plane": how})
