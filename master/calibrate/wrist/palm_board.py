"""The palm's pose before a wrist camera, from a board that lies on the palm.

**How the board lies.** Flat on the palm and the straight fingers, print towards the camera; its rows across the hand,
its columns along the middle finger. Which end is up does not matter: that whose corners lie farther from the camera is
towards the fingers. Three lengths define where it is, all measured with a ruler:

- `wrist_m`: along the hand from the crease of the wrist (the wrist joint, the palm frame's origin) to the row of
  inner corners nearest to it;
- `aside_m`: from the middle finger's line to the middle of the board, positive towards the thumb;
- `depth_m`: from the axis of the wrist joint, half of the wrist's thickness below the skin, up to the print.

In palm axes (z to the fingers, y out of the back): board x = +x, board y = -z, board z (into the board) = +y.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from common.arrays import Float
from common.errors import FitError
from common.geometry.transforms import invert, matrix_to_rotation_vector, rigid, rotation_vector_to_matrix
from master.calibrate.cameras.boards import Board, grid_shape
from master.calibrate.wrist.board_pose import BoardPose

_FLAT = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # board axes -> palm axes
_MOVED_RAD = np.radians(2.0)
_ROTATION_LIMIT_RAD = np.radians(1.0)  # how sure the pose must be


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
    """The palm in the camera's frame.

    Attributes:
        T_camera_palm: (4, 4) [m].
        rotation_sigma_rad, shift_sigma_m: Standard deviation in the least certain direction, of the measurement itself;
            what the ruler or the hand's shape adds is not in it.
        residual: Quantity with its unit -> value.
        note: What it is from.
    """

    T_camera_palm: Float
    rotation_sigma_rad: float
    shift_sigma_m: float
    residual: dict[str, float]
    note: str


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
    moved_m = 0.003  # between views: the hand shifted in the device
    if spread > _MOVED_RAD or shifted > moved_m:
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
    shift_limit_m = 1e-3  # how sure the pose must be
    if rotation_sigma > _ROTATION_LIMIT_RAD or shift_sigma > shift_limit_m:
        raise FitError(
            f"the board's pose is known to {np.degrees(rotation_sigma):.1f} deg and {1e3 * shift_sigma:.1f} mm only"
            f" (limits {np.degrees(_ROTATION_LIMIT_RAD):.0f} deg, {1e3 * shift_limit_m:.0f} mm): take a larger board,"
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
    """Return the same board with its first row towards the fingers.

    That is, away from the camera.
    """
    if T_camera_board[2, 1] <= 0.0:  # board y points from the fingers to the wrist
        return T_camera_board
    rows, columns = grid_shape(board)
    other = np.diag([-1.0, -1.0, 1.0, 1.0])
    other[:2, 3] = np.array([columns - 1, rows - 1]) * board.square_m
    return T_camera_board @ other
