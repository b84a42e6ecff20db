"""`phalanx calibrate wrist palm`: the palm pose before the wrist camera.

From a board that lies on the palm.
"""

from argparse import Namespace
from pathlib import Path

import numpy as np
from msgspec.structs import replace

from common.arrays import Float
from common.calibration import HandProfile, RigCalibration, load
from common.errors import FitError
from common.geometry.transforms import invert
from common.hand.model import HandModel
from common.recording.frame_recording import Illumination
from master.calibrate.cameras.boards import Board
from master.calibrate.cameras.lens_files import matrix_of
from master.calibrate.cameras.options import board_of
from master.calibrate.tree_files import provenance
from master.calibrate.wrist.board_pose import BoardPose, board_pose
from master.calibrate.wrist.device import Device, device_of, print_line, write_device
from master.calibrate.wrist.lit_views import grouped_by_reason, lit_views
from master.calibrate.wrist.palm_board import BoardOffset, PalmFit, palm_from_board
from master.commands.summary import write_summary


def palm(options: Namespace) -> None:
    """Measure where the palm is before the wrist camera."""
    device = device_of(options.source, options.rig, options.calibration, options.out)
    model = HandModel.of(
        load(options.hand or options.calibration / "hands" / f"{device.rig.hand}.json", HandProfile)
    )
    offset = BoardOffset(
        1e-3 * options.wrist_mm, 1e-3 * options.aside_mm, 1e-3 * options.depth_mm, model.side_sign
    )
    try:
        fit = _by_board(
            options.source,
            board_of(options.board, options.square_mm, options.marker_mm, options.dictionary),
            offset,
            device,
        )
    except FitError as error:
        raise FitError(f"{options.source}: {error}") from error
    print_line(report_lines(fit))
    written = write_device(options.out, device, rig_with_palm(device, fit), "T_camera_palm")
    if options.json_file is not None:
        report: dict[str, object] = {
            "T_camera_palm": fit.T_camera_palm.tolist(),
            "rotation_sigma_deg": float(np.degrees(fit.rotation_sigma_rad)),
            "shift_sigma_mm": 1e3 * fit.shift_sigma_m,
            "residual": fit.residual,
            "written": None if written is None else str(written),
        }
        write_summary(options.json_file, report)


def _by_board(source: Path, board: Board, offset: BoardOffset, device: Device) -> PalmFit:
    placed: list[BoardPose] = []
    refused: dict[str, str] = {}
    for view in lit_views(source, device.camera.name, Illumination.LED):
        try:
            placed.append(board_pose(view, board, device.optics))
        except FitError as error:
            refused[view.name] = str(error)
    print_line(f"left out: {reason}" for reason in grouped_by_reason(refused))
    return palm_from_board(placed, board, offset)


def report_lines(fit: PalmFit) -> list[str]:
    """The result for a person, as things that a ruler can check."""
    T_palm_camera = invert(fit.T_camera_palm)
    side, up, along = 1e3 * T_palm_camera[:3, 3]
    look: Float = T_palm_camera[:3, 2]
    down = float(np.degrees(np.arctan2(look[1], look[2])))
    where = f"{-up:.1f} mm above the wrist joint, {along:+.1f} mm along the hand, {side:+.1f} mm aside"
    lines = [
        f"palm from {fit.note}",
        f"  the camera is {where}; it looks {down:.1f} deg down to the palm",
        f"  ± {np.degrees(fit.rotation_sigma_rad):.2f} deg, ± {1e3 * fit.shift_sigma_m:.2f} mm",
    ]
    lines.append("  " + ", ".join(f"{name} {value:g}" for name, value in fit.residual.items()))
    return lines


def rig_with_palm(device: Device, fit: PalmFit) -> RigCalibration:
    """The device's rig with the new pose and where it comes from."""
    residual = fit.residual | {
        "rotation_sigma_deg": round(float(np.degrees(fit.rotation_sigma_rad)), 4),
        "shift_sigma_mm": round(1e3 * fit.shift_sigma_m, 4),
    }
    how = provenance("calibrate wrist palm", (device.source,), residual, fit.note)
    rig = device.rig
    return replace(
        rig,
        T_camera_palm=matrix_of(fit.T_camera_palm),
        provenance=rig.provenance | {"T_camera_palm": how},
    )
