"""Images of the boards of a scene: four by four rays per pixel through the true lens, blur and noise."""

from functools import lru_cache

import cv2
import numpy as np

from common.arrays import Float, Image
from master.calibrate.cameras.boards import Board, Charuco
from tests.master.calibrate.cameras.board_scenes import SIZE, Scene

_RAYS = 4  # per pixel and direction


@lru_cache(maxsize=8)
def _rays(lens: tuple[float, ...]) -> Float:
    """Normalized points (H * RAYS, W * RAYS, 2) of all rays of a lens."""
    width, height = SIZE
    u = (np.arange(width * _RAYS) + 0.5) / _RAYS - 0.5
    v = (np.arange(height * _RAYS) + 0.5) / _RAYS - 0.5
    uv = np.stack(np.meshgrid(u, v), axis=-1)
    matrix = np.array([[lens[0], 0, lens[2]], [0, lens[1], lens[3]], [0, 0, 1.0]])
    points = cv2.undistortPoints(uv.reshape(-1, 1, 2), matrix, np.array(lens[4:]), criteria=(3, 30, 1e-10))
    return np.asarray(points, dtype=np.float64).reshape(*uv.shape)


def _texture(board: Board) -> tuple[Image, float]:
    """The board from its top left corner, and its pixels per square."""
    if isinstance(board, Charuco):
        return np.asarray(
            board.pattern().generateImage((board.columns * 96, board.rows * 96), marginSize=0), np.uint8
        ), 96.0
    squares = np.add.outer(np.arange(board.rows + 1), np.arange(board.columns + 1)) % 2
    return np.kron(squares * 255, np.ones((96, 96))).astype(np.uint8), 96.0


def render(
    scene: Scene, view: int, camera: str, seed: int, *, blur_px: float = 0.9, noise: float = 3.0
) -> Image:
    """The image (H, W) of one camera; the board is flat."""
    rng = np.random.default_rng([seed, view, *camera.encode()])
    pose = scene.T_camera_rig[camera] @ scene.moved.get((view, camera), scene.T_rig_board[view])
    rays = _rays(tuple(scene.lenses[camera]))
    to_board = np.linalg.inv(np.column_stack([pose[:3, 0], pose[:3, 1], pose[:3, 3]]))
    x, y, w = to_board @ np.concatenate([rays, np.ones((*rays.shape[:2], 1))], axis=-1).reshape(-1, 3).T
    texture, per_square = _texture(scene.board)
    # Squares from the top left corner; the board's frame begins at its first inner corner.
    a = (x / w / scene.board.square_m + 1.0).reshape(rays.shape[:2])
    b = (y / w / scene.board.square_m + 1.0).reshape(rays.shape[:2])
    across, down = texture.shape[1] / per_square, texture.shape[0] / per_square
    light = cv2.remap(
        texture,
        (a * per_square - 0.5).astype(np.float32),
        (b * per_square - 0.5).astype(np.float32),
        cv2.INTER_NEAREST,
        borderMode=cv2.BORDER_REPLICATE,
    ).astype(np.float64)
    on = (a > 0) & (a < across) & (b > 0) & (b < down)
    paper = (a > -0.6) & (a < across + 0.6) & (b > -0.6) & (b < down + 0.6)
    image = np.where(on, 35.0 + light * 0.65, np.where(paper, 201.0, 95.0))
    image = image.reshape(SIZE[1], _RAYS, SIZE[0], _RAYS).mean(axis=(1, 3))
    image = cv2.GaussianBlur(image, (0, 0), blur_px) + rng.normal(0.0, noise, image.shape)
    return np.clip(image.round(), 0, 255).astype(np.uint8)
