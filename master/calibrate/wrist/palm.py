"""The command `wrist palm` finds the palm's pose from a board that lies on it.

**How the board lies.** Flat on the palm and the straight fingers, print towards the camera; its rows across
the hand, its columns along the middle finger. Which end is up does not matter: that whose corners lie farther
from the camera is towards the fingers. Three lengths define where it is, all measured with a ruler:

- `wrist_m`: along the hand from the crease of the wrist (the wrist joint, the palm frame's origin) to the row
  of inner corners nearest to it;
- `aside_m`: from the middle finger's line to the middle of the board, positive towards the thumb;
- `depth_m`: from the axis of the wrist joint, half of the wrist's thickness below the skin, up to the print.

In palm axes (z to the fingers, y out of the back): board x = +x, board y = -z, board z (into the board) = +y.
"""

from argparse import Namespace
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from common.arrays import Float
from common.calibration import HandProfile, RigCalibration, load
from common.errors import FitError
from common.geometry.transforms import invert, matrix_to_rotation_vector, rigid, rotation_vector_to_matrix
from common.hand.model import HandModel
from common.recording.frame_recording import Illumination
from master.calibrate.cameras.boards import Board, board_in, grid_shape
from master.calibrate.report import finish
from master.calibrate.tree_files import matrix_of, print_lines, refusals_named
from master.calibrate.wrist.device import (
    BoardPose,
    board_in_views,
    board_pose,
    device_of,
    grouped_by_reason,
    lit_views,
    of_views,
    writes_key,
)

_FLAT = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # board axes -> palm axes
_MOVED_RAD = np.radians(2.0)
_SHIFT_LIMIT_M, _ROTATION_LIMIT_RAD = 1e-3, np.radians(1.0)  # how sure the pose must be


@dataclass(frozen=True, slots=True)
class BoardOffset:
    """Position of the board on the palm, as the module describes.

    `thumb_side`: +1 where the thumb is at +x of the palm (right hand), else -1.
    """

    wrist_m: float
    aside_m: float
    depth_m: float
    thumb_side: float

    def T_palm_board(self, board: Board) -> Float:
        """(4, 4) [m]."""
        rows, columns = grid_shape(board)
        nearest = np.array([(columns - 1) / 2.0, rows - 1.0, 0.0]) * board.square_m
        at = np.array([self.thumb_side * self.aside_m, -self.depth_m, self.wrist_m])
        return rigid(_FLAT, at - _FLAT @ nearest)


@dataclass(frozen=True, slots=True, eq=False)
class PalmFit:
    """The palm in the camera's frame."""

    T_camera_palm: Float  # (4, 4) [m]
    # this and shift_sigma_m: standard deviation in the least certain direction, of the measurement itself;
    # errors of the ruler or the hand's shape are not in it
    rotation_sigma_rad: float
    shift_sigma_m: float
    residual: dict[str, float]  # quantity with its unit -> value
    note: str  # what it is from


def palm_from_board(placed: Sequence[BoardPose], board: Board, offset: BoardOffset) -> PalmFit:
    """The palm's pose, as mean over views in which the hand did not move.

    Raises:
        FitError: No view, a board whose pose is ambiguous, a hand that moved between the views.
    """
    if not placed:
        raise FitError(
            "the board is seen in no view: lay it on the palm, print up, all of it before the camera"
        )
    poses = [_upright(one.T_camera_board, board) for one in placed]
    first = poses[0]
    rotation_vectors = np.array([matrix_to_rotation_vector(pose[:3, :3] @ first[:3, :3].T) for pose in poses])
    middle = np.append((np.array(grid_shape(board)[::-1]) - 1) * board.square_m / 2.0, [0.0, 1.0])
    at = np.array([(pose @ middle)[:3] for pose in poses])
    spread = float(np.linalg.norm(rotation_vectors - np.median(rotation_vectors, axis=0), axis=1).max())
    shifted = float(np.linalg.norm(at - np.median(at, axis=0), axis=1).max())
    if spread > _MOVED_RAD or shifted > 0.003:  # between views: the hand shifted in the device
        raise FitError(
            f"the board moved by {1e3 * shifted:.1f} mm and {np.degrees(spread):.1f} deg between the views: hold the"
            " hand still in the device, and fix the board to it"
        )
    rotation = rotation_vector_to_matrix(rotation_vectors.mean(axis=0)) @ first[:3, :3]
    T_camera_board = rigid(rotation, at.mean(axis=0) - rotation @ middle[:3])
    # One thing seen several times in one place: corners err alike, so the views do not average it away.
    cov = np.mean([one.covariance for one in placed], axis=0)
    rotation_sigma, shift_sigma = (
        float(np.sqrt(np.linalg.eigvalsh(part)[-1])) for part in (cov[:3, :3], cov[3:, 3:])
    )
    if rotation_sigma > _ROTATION_LIMIT_RAD or shift_sigma > _SHIFT_LIMIT_M:
        raise FitError(
            f"the board's pose is known to {np.degrees(rotation_sigma):.1f} deg and {1e3 * shift_sigma:.1f} mm only"
            f" (limits {np.degrees(_ROTATION_LIMIT_RAD):.0f} deg, {1e3 * _SHIFT_LIMIT_M:.0f} mm): take a larger board,"
            " sharp and well lit"
        )
    return PalmFit(
        T_camera_board @ invert(offset.T_palm_board(board)),
        rotation_sigma,
        shift_sigma,
        {
            "rms_px": round(float(np.sqrt(np.mean([one.rms_px**2 for one in placed]))), 4),
            "between_views_mm": round(1e3 * shifted, 4),
            "between_views_deg": round(float(np.degrees(spread)), 4),
        },
        f"{len(placed)} views of a board on the palm: {1e3 * offset.wrist_m:g} mm from the wrist,"
        f" {1e3 * offset.aside_m:g} mm aside, {1e3 * offset.depth_m:g} mm above the joint",
    )


def _upright(T_camera_board: Float, board: Board) -> Float:
    """The board with its first row towards the fingers, that is, off the camera."""
    if T_camera_board[2, 1] <= 0.0:  # board y points from the fingers to the wrist
        return T_camera_board
    rows, columns = grid_shape(board)
    other = np.diag([-1.0, -1.0, 1.0, 1.0])
    other[:2, 3] = np.array([columns - 1, rows - 1]) * board.square_m
    return T_camera_board @ other


def palm(options: Namespace) -> None:
    """Measure where the palm is before the wrist camera."""
    device = device_of(options.source, options.rig, options.calibration, options.out)
    model = HandModel.of(
        load(options.hand or options.calibration / "hands" / f"{device.rig.hand}.json", HandProfile)
    )
    offset = BoardOffset(
        1e-3 * options.wrist_mm, 1e-3 * options.aside_mm, 1e-3 * options.depth_mm, model.side_sign
    )
    with refusals_named(options.source):
        views = lit_views(options.source, device.camera.name, Illumination.LED)
        board = board_in_views(views, board_in(options))
        placed, refused = of_views(views, lambda view: board_pose(view, board, device.optics))
        print_lines(f"left out: {reason}" for reason in grouped_by_reason(refused))
        fit = palm_from_board(tuple(placed.values()), board, offset)
        refuse_elsewhere(fit.T_camera_palm, device.rig)
    sigma = {
        "rotation_sigma_deg": float(np.degrees(fit.rotation_sigma_rad)),
        "shift_sigma_mm": 1e3 * fit.shift_sigma_m,
    }
    report: dict[str, object] = {
        "T_camera_palm": fit.T_camera_palm.tolist(),
        **sigma,
        "residual": fit.residual,
    }
    pose = matrix_of(fit.T_camera_palm)
    write = writes_key(device, "palm", "T_camera_palm", pose, fit.residual | sigma, fit.note)
    finish(options, report_lines(fit), report, None, write)


def refuse_elsewhere(T_camera_palm: Float, rig: RigCalibration) -> None:
    """Refuse a palm far from where the rig file has it, as by another size of square."""
    if rig.T_camera_palm is None:
        return
    moved = T_camera_palm @ invert(np.array(rig.T_camera_palm))
    turn = float(np.linalg.norm(matrix_to_rotation_vector(moved[:3, :3])))
    shift = float(np.linalg.norm(T_camera_palm[:3, 3] - np.array(rig.T_camera_palm)[:3, 3]))
    if shift > 0.03 or turn > np.radians(30.0):  # a drawing is right to a centimetre and ten degrees
        raise FitError(
            f"the palm lies {1e3 * shift:.0f} mm and {np.degrees(turn):.0f} deg from where the rig file has it: check"
            " --board (columns across the hand), --square-mm and what the ruler measured; of a rebuilt device take"
            " T_camera_palm out of the rig file first"
        )


def report_lines(fit: PalmFit) -> list[str]:
    """The result for a person, as things that a ruler can check."""
    T_palm_camera = invert(fit.T_camera_palm)
    side, up, along = 1e3 * T_palm_camera[:3, 3]
    look: Float = T_palm_camera[:3, 2]
    down = float(np.degrees(np.arctan2(look[1], look[2])))
    where = f"{-up:.1f} mm above the wrist joint, {along:+.1f} mm along the hand, {side:+.1f} mm aside"
    return [
        f"palm from {fit.note}",
        f"  the camera is {where}; it looks {down:.1f} deg down to the palm",
        f"  ± {np.degrees(fit.rotation_sigma_rad):.2f} deg, ± {1e3 * fit.shift_sigma_m:.2f} mm",
        "  " + ", ".join(f"{name} {value:g}" for name, value in fit.residual.items()),
    ]
