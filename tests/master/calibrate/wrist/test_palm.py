"""The palm's pose from a board whose mounting is known by hand calculation."""

import numpy as np
import pytest

from common.arrays import Float
from common.errors import FitError
from common.geometry.transforms import (
    matrix_to_rotation_vector,
    rigid,
    transform,
)
from master.calibrate.cameras.boards import Checkerboard, board_corners
from master.calibrate.wrist.device import BoardPose, place_corners
from master.calibrate.wrist.palm import BoardOffset, palm_from_board
from tests.master.calibrate.wrist.devices import OPTICS, RIG

BOARD = Checkerboard(7, 4, 0.010)
OFFSET = BoardOffset(0.085, 0.004, 0.022, 1.0)
TRUE = np.array(RIG.T_camera_palm)
KNUCKLES = np.array([0.0, 0.0, 0.08])


def seen_on_palm(noise_px: float = 0.0, seed: int = 0, *, rotated: bool = False) -> BoardPose:
    """The board on the true palm, by its corners."""
    uv = OPTICS.project(transform(TRUE @ OFFSET.T_palm_board(BOARD), board_corners(BOARD)))
    uv = uv + noise_px * np.random.default_rng(seed).standard_normal(uv.shape)
    return place_corners(uv[::-1] if rotated else uv, BOARD, OPTICS)


def errors(T: Float) -> tuple[float, float]:
    """Turn [deg] and the knuckles' shift [mm] against the truth."""
    rotation = matrix_to_rotation_vector(T[:3, :3] @ TRUE[:3, :3].T)
    shift = transform(T, KNUCKLES) - transform(TRUE, KNUCKLES)
    return float(np.degrees(np.linalg.norm(rotation))), float(1e3 * np.linalg.norm(shift))


@pytest.mark.parametrize("thumb_side", [1.0, -1.0])
def test_the_mounting_is_as_described(thumb_side: float) -> None:
    # 7 x 4 corners of 10 mm: the nearest row is 85 mm from the wrist, the farthest 115; 3 squares to each side.
    corners = transform(
        BoardOffset(0.085, 0.004, 0.022, thumb_side).T_palm_board(BOARD), board_corners(BOARD)
    )
    middle = 0.004 * thumb_side
    np.testing.assert_allclose(corners[0], [middle - 0.03, -0.022, 0.115], atol=1e-12)
    np.testing.assert_allclose(corners[6], [middle + 0.03, -0.022, 0.115], atol=1e-12)
    np.testing.assert_allclose(corners[-1], [middle + 0.03, -0.022, 0.085], atol=1e-12)


@pytest.mark.parametrize("rotated", [False, True])
def test_exact_corners_give_the_exact_palm_whichever_end_is_up(rotated: bool) -> None:
    fit = palm_from_board([seen_on_palm(rotated=rotated)], BOARD, OFFSET)
    rotation, shift = errors(fit.T_camera_palm)
    assert rotation < 0.01
    assert shift < 0.01


@pytest.mark.parametrize("seed", range(2))
def test_corners_of_a_tenth_of_a_pixel_give_it_within_a_quarter_degree_and_millimetre(seed: int) -> None:
    fit = palm_from_board([seen_on_palm(0.1, 10 * seed + k) for k in range(3)], BOARD, OFFSET)
    rotation, shift = errors(fit.T_camera_palm)
    assert rotation < 0.25
    assert shift < 0.25
    assert rotation < 4.0 * np.sqrt(3.0) * np.degrees(fit.rotation_sigma_rad)


def test_a_hand_that_moved_and_a_board_not_seen_are_refused() -> None:
    still = seen_on_palm()
    T = still.T_camera_board.copy()
    T[0, 3] += 0.008
    moved = BoardPose(T, still.centre_m, still.covariance, still.rms_px)
    with pytest.raises(FitError, match="board moved by"):
        palm_from_board([still, still, moved], BOARD, OFFSET)
    with pytest.raises(FitError, match="seen in no view"):
        palm_from_board([], BOARD, OFFSET)


def test_a_board_too_small_to_measure_its_tilt_is_refused() -> None:
    tiny = Checkerboard(3, 3, 0.001)
    far = rigid(np.eye(3), np.array([0.0, 0.0, 0.3]))
    rng = np.random.default_rng(0)
    uv = OPTICS.project(transform(far, board_corners(tiny)))
    placed = place_corners(uv + 0.1 * rng.standard_normal(uv.shape), tiny, OPTICS)
    with pytest.raises(FitError, match="take a larger board"):
        palm_from_board([placed], tiny, OFFSET)
