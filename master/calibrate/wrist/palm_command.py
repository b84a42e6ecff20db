"""`phalanx-master calibrate palm`: where the palm is before the wrist camera, from a board on it or from a curl."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from msgspec.structs import replace

from common.arrays import Float
from common.calibration import HandProfile, RigCalibration, load
from common.errors import CalibrationError, FitError
from common.frame_recording import MANIFEST, Illumination
from common.geometry import invert
from common.hand_model import HandModel
from master.calibrate.cameras.boards import Board
from master.calibrate.cameras.lens_files import matrix_of
from master.calibrate.cameras.options import Dictionary, MarkerMm, board_of
from master.calibrate.tree_files import provenance
from master.calibrate.wrist.curled import read_curled
from master.calibrate.wrist.device import Device, device_of, say, write_device
from master.calibrate.wrist.lit_views import lit_views, told_by_reason
from master.calibrate.wrist.palm_board import Mounting, PalmFit, palm_from_board
from master.calibrate.wrist.placed import PlacedBoard, placed_board
from master.options import CALIB_JSON, Calibration, JsonFile, RecordingRig, ResultTree
from master.summary import write_summary
from master.wrist.setup import WristSetup

Source = Annotated[
    Path,
    typer.Argument(
        help="A recording of the board on the palm, or of a curl; or images VIEW_ambient.png, VIEW_led.png.",
        show_default=False,
    ),
]
BoardSize = Annotated[
    str | None,
    typer.Option("--board", help="COLUMNSxROWS of a board on the palm: inner corners, columns across it."),
]
SquareMm = Annotated[
    float | None, typer.Option(help="With --board: side of a square in mm, measured on the print.")
]
WristMm = Annotated[
    float | None,
    typer.Option(
        help="With --board: mm along the hand from the wrist crease to the nearest row of inner corners."
    ),
]
AsideMm = Annotated[
    float,
    typer.Option(
        help="With --board: mm from the middle finger's line to the board's middle, to the thumb +."
    ),
]
DepthMm = Annotated[
    float | None,
    typer.Option(help="With --board: mm from the axis of the wrist up to the print."),
]
Detections = Annotated[
    Path | None,
    typer.Option(help="Of a curl: folder with detections_<camera>.npz of it, instead of --board."),
]
Hand = Annotated[
    Path | None, typer.Option("--hand", help="Hand file; default: the rig's `hand` in CALIBRATION/hands.")
]


def palm(
    source: Source,
    board: BoardSize = None,
    square_mm: SquareMm = None,
    marker_mm: MarkerMm = None,
    dictionary: Dictionary = "4X4_50",
    wrist_mm: WristMm = None,
    aside_mm: AsideMm = 0.0,
    depth_mm: DepthMm = None,
    detections: Detections = None,
    hand: Hand = None,
    rig: RecordingRig = None,
    calibration: Calibration = CALIB_JSON,
    out: ResultTree = None,
    json_file: JsonFile = None,
) -> None:
    """Measure where the palm is before the wrist camera: from a board that lies on it, or from a guided curl.

    The board lies flat on palm and straight fingers, print to the camera, columns along the middle finger. A curl
    needs the user's hand file, the laser plane, and a pose in the rig that is right to a centimetre and ten degrees.
    Nothing is written without --out.

    Examples:

      phalanx-master calibrate palm RECORDING --board 7x4 --square-mm 10 --wrist-mm 70 --depth-mm 22 --rig wrist

      phalanx-master calibrate palm RECORDING --detections found --hand calib_json/hands/me.json --rig wrist
    """
    device = device_of(source, rig, calibration, out)
    model = HandModel.of(load(hand or calibration / "hands" / f"{device.rig.hand}.json", HandProfile))
    try:
        if board is None:
            fit = _by_hand(source, detections, device, model)
        else:
            pattern = board_of(board, _needed(square_mm, "--square-mm"), marker_mm, dictionary)
            mounting = Mounting(
                1e-3 * _needed(wrist_mm, "--wrist-mm"),
                1e-3 * aside_mm,
                1e-3 * _needed(depth_mm, "--depth-mm"),
                model.side_sign,
            )
            fit = _by_board(source, pattern, mounting, device)
    except FitError as error:
        raise FitError(f"{source}: {error}") from error
    say(report_lines(fit))
    written = write_device(out, device, rig_with_palm(device, fit), "T_camera_palm")
    if json_file is not None:
        told: dict[str, object] = {
            "T_camera_palm": fit.T_camera_palm.tolist(),
            "turn_sigma_deg": float(np.degrees(fit.turn_sigma_rad)),
            "shift_sigma_mm": 1e3 * fit.shift_sigma_m,
            "residual": fit.residual,
            "written": None if written is None else str(written),
        }
        write_summary(json_file, told)


def _needed(value: float | None, option: str) -> float:
    if value is None:
        raise CalibrationError(
            f"{option}: missing; a board on the palm needs --square-mm, --wrist-mm and --depth-mm"
        )
    return value


def _by_board(source: Path, board: Board, mounting: Mounting, device: Device) -> PalmFit:
    placed: list[PlacedBoard] = []
    refused: dict[str, str] = {}
    for view in lit_views(source, device.camera.name, Illumination.LED):
        try:
            placed.append(placed_board(view, board, device.optics))
        except FitError as error:
            refused[view.name] = str(error)
    say(f"left out: {reason}" for reason in told_by_reason(refused))
    return palm_from_board(placed, board, mounting)


def _by_hand(source: Path, detections: Path | None, device: Device, model: HandModel) -> PalmFit:
    if detections is None:
        found = "the recording of a curl" if (source / MANIFEST).is_file() else "images"
        raise CalibrationError(
            f"{source}: from {found} needs --board with --square-mm, --wrist-mm, --depth-mm, or --detections DIR:"
            f" make it with phalanx-slave detect {source} --camera {device.camera.name}"
            f" -o DIR/detections_{device.camera.name}.npz"
        )
    if device.rig.T_camera_palm is None:
        raise CalibrationError(
            f"rig {device.file_name!r}: T_camera_palm: a curl needs a first guess, such as from the drawing of the"
            " device; or lay a board on the palm (--board)"
        )
    from master.calibrate.wrist.palm_hand import palm_from_hand

    return palm_from_hand(read_curled(detections, device), WristSetup.of(device.rig, device.camera, model))


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
        f"  ± {np.degrees(fit.turn_sigma_rad):.2f} deg, ± {1e3 * fit.shift_sigma_m:.2f} mm",
    ]
    lines.append("  " + ", ".join(f"{name} {value:g}" for name, value in fit.residual.items()))
    return lines


def rig_with_palm(device: Device, fit: PalmFit) -> RigCalibration:
    """The device's rig with the new pose and where it comes from."""
    residual = fit.residual | {
        "turn_sigma_deg": round(float(np.degrees(fit.turn_sigma_rad)), 4),
        "shift_sigma_mm": round(1e3 * fit.shift_sigma_m, 4),
    }
    how = provenance("calibrate palm", (device.source,), residual, fit.note)
    rig = device.rig
    return replace(
        rig,
        T_camera_palm=matrix_of(fit.T_camera_palm),
        provenance=rig.provenance | {"T_camera_palm": how},
    )
