"""Pose of a board before one camera, and its uncertainty.

The start of all that boards measure of a wrist device.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Float
from common.errors import FitError
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import cross, transform
from common.recording.frame_recording import Illumination
from master.calibrate.cameras.boards import Board, board_corners
from master.calibrate.cameras.detect import find_board
from master.calibrate.cameras.first_guess import place_board
from master.calibrate.wrist.lit_views import LitView


@dataclass(frozen=True, slots=True, eq=False)
class BoardPose:
    """A board in the camera's frame.

    Attributes:
        T_camera_board: (4, 4) [m].
        centre_m: (3,) middle of the corners, about which `covariance` turns.
        covariance: (6, 6) of small turns [rad] about the camera's axes and shifts [m], in this order.
        rms_px: What is left at the corners.
    """

    T_camera_board: Float
    centre_m: Float
    covariance: Float
    rms_px: float


def lens_of_model(optics: CameraModel) -> Float:
    """A camera's lens (9,) in the order of `bundle.LENS`."""
    k = optics.matrix
    return np.array([k[0, 0], k[1, 1], k[0, 2], k[1, 2], *optics.distortion])


def board_pose(view: LitView, board: Board, optics: CameraModel) -> BoardPose:
    """Estimate the board pose of one view.

    At the middle of its strobe cycle where both of its ends show the board.

    Raises:
        RecordingError: An image cannot be read.
        FitError: No board, a wrong one, or one that moved; the text is the reason.
    """
    seen: list[Float] = []
    for lit in (Illumination.AMBIENT, Illumination.LED):
        image = view.load(lit)
        if image is None:
            continue
        if image.shape != (optics.height_px, optics.width_px):
            raise FitError(
                f"its image is {image.shape[1]} x {image.shape[0]} px,"
                f" the camera {optics.width_px} x {optics.height_px}"
            )
        if (observation := find_board(board, image)) is not None:
            seen.append(observation.corners_px)
    if not seen:
        raise FitError("no board found: show all of it with its white margin, sharp and not too bright")
    # The ambient frame comes before the laser's and the LED's after it: their mean is where the board was between.
    moved = float(np.nanmedian(np.linalg.norm(seen[0] - seen[-1], axis=1)))
    # between the frames of a strobe cycle; half of it is what a constant speed leaves unexplained
    moved_px = 1.0
    if not moved <= moved_px:
        raise FitError(f"the board moved by {moved:.1f} px between the frames: hold it still")
    return place_corners(np.mean(seen, axis=0), board, optics)


def place_corners(corners_px: Float, board: Board, optics: CameraModel) -> BoardPose:
    """The pose of a board from its corners (N, 2) [px], NaN where not seen.

    Raises:
        FitError: The corners do not agree with a flat board before this lens.
    """
    known = np.isfinite(corners_px[:, 0])
    drawn = board_corners(board)[known]
    T, rms = place_board(drawn, corners_px[known], lens_of_model(optics))
    most_rms_px = 1.0  # beyond it, it is another board or another lens
    if not rms <= most_rms_px:
        raise FitError(
            f"corners are off by {rms:.2f} px: the size of the board, its flatness or the intrinsics are wrong"
        )
    points = transform(T, drawn)
    centre = points.mean(axis=0)
    jacobian = np.stack([_pixel_derivative(points, centre, k, optics) for k in range(6)], axis=-1).reshape(
        -1, 6
    )
    dof = 2.0 * len(drawn) - 6.0
    # of the detector on rendered boards: what few corners that happen to agree do not get below
    corner_sigma_px = 0.05
    sigma = max(rms * np.sqrt(len(drawn) / dof), corner_sigma_px)
    return BoardPose(T, centre, sigma**2 * np.linalg.inv(jacobian.T @ jacobian), rms)


def _pixel_derivative(points: Float, centre: Float, k: int, optics: CameraModel) -> Float:
    """Derivative (n, 2) of the pixels by the k-th turn or shift."""
    step = np.zeros(3)
    step[k % 3] = 1e-5
    shift = cross(np.broadcast_to(step, points.shape), points - centre) if k < 3 else step
    return (optics.project(points + shift) - optics.project(points - shift)) / 2e-5
