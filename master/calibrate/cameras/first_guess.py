"""Initial guess of a bundle.

A lens by trial of focal lengths, boards by PnP; bad views do not mislead it.
"""

from collections.abc import Sequence

import cv2
import numpy as np

from common.arrays import Float, Int
from common.geometry.transforms import rigid

_FOCAL = np.geomspace(0.35, 6.0, 24)  # of the image's width: 110 to 10 degrees of view


def guess_lens(observations: Sequence[tuple[Int, Float]], drawn_m: Float, size_px: tuple[int, int]) -> Float:
    """Return an initial lens without distortion.

    Shape (9,), by the focal length under which the middle image fits best.

    The middle one: up to half of the images may be wrong altogether.

    Args:
        observations: Numbers (n,) and places (n, 2) [px] of the corners of each image.
        drawn_m: Corners of the board (N, 3) [m].
        size_px: Width and height of the images.
    """
    width, height = size_px
    lenses = [
        np.array([f * width, f * width, (width - 1) / 2, (height - 1) / 2, 0, 0, 0, 0, 0]) for f in _FOCAL
    ]
    errors = [
        np.median([place_board(drawn_m[corners], uv, lens)[1] for corners, uv in observations])
        for lens in lenses
    ]
    return lenses[int(np.argmin(errors))]


def place_board(corners_m: Float, uv: Float, lens: Float) -> tuple[Float, float]:
    """T_camera_board (4, 4) [m] and rms [px] of one image of a flat board.

    Args:
        corners_m: Corners (n, 3) [m], z = 0, at least four.
        uv: Where they are seen (n, 2) [px].
        lens: (9,) in the order of `bundle.LENS`.

    A plane seen from afar has two poses that look alike (Schweighofer and Pinz, 2006): both are refined.
    """
    matrix = np.array([[lens[0], 0.0, lens[2]], [0.0, lens[1], lens[3]], [0.0, 0.0, 1.0]])
    best = np.eye(4), np.inf
    _, rotation_vectors, moves, _ = cv2.solvePnPGeneric(
        corners_m, uv, matrix, lens[4:], flags=cv2.SOLVEPNP_IPPE
    )
    for rotation_vector, move in zip(rotation_vectors, moves, strict=True):
        rotation_vector, move = cv2.solvePnPRefineLM(corners_m, uv, matrix, lens[4:], rotation_vector, move)
        again, _ = cv2.projectPoints(corners_m, rotation_vector, move, matrix, lens[4:])
        off = np.asarray(again, dtype=np.float64).reshape(-1, 2) - uv
        error = float(np.sqrt((off**2).sum(axis=1).mean()))
        if error < best[1] and float(np.asarray(move).ravel()[2]) > 0:
            rotation = np.asarray(cv2.Rodrigues(rotation_vector)[0], dtype=np.float64)
            best = rigid(rotation, np.asarray(move, dtype=np.float64).ravel()), error
    return best
