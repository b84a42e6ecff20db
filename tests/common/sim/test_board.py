"""The simulated board: its corners lie where the cameras must see them, held still, and every camera is asked for."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from common.arrays import Float
from common.calibration import CameraCalibration, RigCalibration, load
from common.errors import CalibrationError
from common.geometry.transforms import transform
from common.sim.board import BOARD, BoardRenderer, BoardScene, board_corners

CALIB = Path(__file__).parents[3] / "calib_json"
RIG = load(CALIB / "rigs" / "desk.json", RigCalibration)
CAMERAS = {name: load(CALIB / "cameras" / f"{name}.json", CameraCalibration) for name in RIG.cameras}
SCENE = BoardScene(RIG, CAMERAS, 7)
STEP_S = BOARD.held_s + BOARD.moved_s


def seen_at(renderer: BoardRenderer, camera: str, t_s: float) -> tuple[Float, Float]:
    """Corners (54, 2) as found near the truth, and the truth [px]."""
    truth = SCENE.optics[camera].project(transform(SCENE.T_rig_board(t_s), board_corners()))
    grey = np.asarray(cv2.cvtColor(renderer.render(t_s), cv2.COLOR_BGR2GRAY))
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-3)
    start = truth.astype(np.float32).reshape(-1, 1, 2)
    found = cv2.cornerSubPix(grey, start, (5, 5), (-1, -1), criteria)
    return np.asarray(found, np.float64).reshape(-1, 2), truth


@pytest.mark.parametrize("camera", RIG.cameras)
def test_corners_are_drawn_where_the_camera_sees_them(camera: str) -> None:
    renderer = BoardRenderer(SCENE, camera)
    whole = [k for k in range(len(SCENE.poses)) if k % 4 != 3 or RIG.cameras[k % 2] == camera]
    errors = np.concatenate(
        [np.subtract(*seen_at(renderer, camera, k * STEP_S)) for k in whole[:: len(whole) // 6]]
    )
    assert np.abs(errors.mean(axis=0)).max() < 0.02  # half a texel or half a pixel off would show here
    assert errors.std() < 0.08


def test_an_untouched_picture_shows_the_whole_board() -> None:
    grey = np.asarray(cv2.cvtColor(BoardRenderer(SCENE, "left").render(0.0), cv2.COLOR_BGR2GRAY))
    found, corners = cv2.findChessboardCornersSB(grey, (BOARD.columns, BOARD.rows))
    assert found
    assert np.asarray(corners).reshape(-1, 2).shape == (BOARD.columns * BOARD.rows, 2)


def test_the_board_is_held_and_then_moved() -> None:
    for k in range(3):
        start = k * STEP_S
        np.testing.assert_array_equal(SCENE.T_rig_board(start), SCENE.T_rig_board(start + BOARD.held_s))
        assert not np.allclose(SCENE.T_rig_board(start), SCENE.T_rig_board(start + STEP_S), atol=1e-3)
    way = np.array(
        [SCENE.T_rig_board(BOARD.held_s + BOARD.moved_s * s)[:3, 3] for s in np.linspace(0.0, 1.0, 31)]
    )
    assert np.linalg.norm(np.diff(way, axis=0), axis=1).max() < 0.05  # it moves, it does not jump
    for T in SCENE.poses:
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-9)
        assert np.linalg.det(T[:3, :3]) > 0.0


def test_squares_have_their_size() -> None:
    edge = board_corners().reshape(BOARD.rows, BOARD.columns, 3)
    np.testing.assert_allclose(np.linalg.norm(np.diff(edge, axis=1), axis=2), BOARD.square_m)
    np.testing.assert_allclose(np.linalg.norm(np.diff(edge, axis=0), axis=2), BOARD.square_m)


def test_more_light_is_a_brighter_picture() -> None:
    renderer = BoardRenderer(SCENE, "left")
    darker = renderer.exposed(1000.0, np.full(3, 0.3))
    assert darker.render(0.0).mean() < 0.75 * renderer.render(0.0).mean()


def test_a_camera_without_lens_or_file_is_refused() -> None:
    with pytest.raises(CalibrationError, match="camera file"):
        BoardScene(RIG, {"left": CAMERAS["left"]}, 7)
    with pytest.raises(KeyError):
        BoardRenderer(SCENE, "middle")
