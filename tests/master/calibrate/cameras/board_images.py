"""Images of the boards of a scene: four by four rays per pixel through the true lens, blur and noise."""

from functools import lru_cache

import cv2
import numpy as np

from common.arrays import Float, Image
from common.geometry.transforms import transform
from master.calibrate.cameras.boards import Board, Charuco, CircleGrid
from tests.master.calibrate.cameras.board_scenes import SIZE, Scene

_RAYS = 4  # per pixel and direction
_RIM = 0.6  # squares of white paper around the board
Box = tuple[int, int, int, int]
"""First and last column, first and last row, the last ones left out."""


def _matrix(lens: Float) -> Float:
    return np.array([[lens[0], 0, lens[2]], [0, lens[1], lens[3]], [0, 0, 1.0]])


def _box(board: Board, across: float, down: float, pose: Float, lens: Float) -> Box:
    """The pixels on which the paper may lie: all others show the wall."""
    side = np.linspace(0.0, 1.0, 60)
    low, high = np.zeros_like(side), np.ones_like(side)
    x = np.concatenate([side, side, low, high]) * (across + 2 * _RIM) - _RIM - 1.0
    y = np.concatenate([low, high, side, side]) * (down + 2 * _RIM) - _RIM - 1.0
    outline = transform(pose, board.square_m * np.stack([x, y, np.zeros_like(x)], axis=1))
    uv, _ = cv2.projectPoints(outline, np.zeros(3), np.zeros(3), _matrix(lens), lens[4:])
    least, most = (np.asarray(edge(uv.reshape(-1, 2), axis=0)) for edge in (np.min, np.max))
    first = np.clip(np.floor(least) - 2, 0, SIZE).astype(int).tolist()
    last = np.clip(np.ceil(most) + 3, 0, SIZE).astype(int).tolist()
    return first[0], last[0], first[1], last[1]


@lru_cache(maxsize=8)
def _middles(lens: tuple[float, ...]) -> Float:
    """Normalized points (H + 2, W + 2, 2) of the middles of all pixels, and of one more on every side."""
    u, v = (np.arange(-1.0, size + 1.0) for size in SIZE)
    uv, values = np.stack(np.meshgrid(u, v), axis=-1), np.array(lens)
    points = cv2.undistortPoints(uv.reshape(-1, 1, 2), _matrix(values), values[4:], criteria=(3, 30, 1e-10))
    return np.asarray(points, dtype=np.float64).reshape(*uv.shape)


def _rays(lens: Float, box: Box) -> Float:
    """Normalized points (h * RAYS, w * RAYS, 2) of all rays of a lens within a box of pixels.

    Between the middles of pixels they are interpolated, which is off by less than a thousandth of a pixel.
    """
    points = _middles(tuple(lens.tolist()))
    for axis, (first, last) in ((1, box[:2]), (0, box[2:])):
        at = (np.arange(first * _RAYS, last * _RAYS) + 0.5) / _RAYS + 0.5
        below = np.floor(at).astype(np.int64)
        share = np.expand_dims(at - below, (0, 2) if axis else (1, 2))
        points = (1.0 - share) * points.take(below, axis) + share * points.take(below + 1, axis)
    return points


def _texture(board: Board) -> tuple[Image, float]:
    """The board from its top left corner, and its pixels per square."""
    if isinstance(board, Charuco):
        return np.asarray(
            board.pattern().generateImage((board.columns * 96, board.rows * 96), marginSize=0), np.uint8
        ), 96.0
    if isinstance(board, CircleGrid):
        y, x = (np.indices((96 * (board.rows + 1), 96 * (board.columns + 1))) + 0.5) / 96.0
        dark = np.hypot(x - np.rint(x), y - np.rint(y)) < 0.5 * board.circle_m / board.square_m
        inner = (x > 0.5) & (y > 0.5) & (x < board.columns + 0.5) & (y < board.rows + 0.5)
        return np.where(dark & inner, 0, 255).astype(np.uint8), 96.0
    squares = np.add.outer(np.arange(board.rows + 1), np.arange(board.columns + 1)) % 2
    return np.kron(squares * 255, np.ones((96, 96))).astype(np.uint8), 96.0


def render(
    scene: Scene, view: int, camera: str, seed: int, *, blur_px: float = 0.9, noise: float = 3.0
) -> Image:
    """The image (H, W) of one camera; the board is flat."""
    rng = np.random.default_rng([seed, view, *camera.encode()])
    pose = scene.T_camera_rig[camera] @ scene.moved.get((view, camera), scene.T_rig_board[view])
    texture, per_square = _texture(scene.board)
    across, down = texture.shape[1] / per_square, texture.shape[0] / per_square
    box = _box(scene.board, across, down, pose, scene.lenses[camera])
    rays = _rays(scene.lenses[camera], box)
    to_board = np.linalg.inv(np.column_stack([pose[:3, 0], pose[:3, 1], pose[:3, 3]]))
    x, y, w = to_board @ np.concatenate([rays, np.ones((*rays.shape[:2], 1))], axis=-1).reshape(-1, 3).T
    # Squares from the top left corner; the board's frame begins at its first inner corner.
    a = (x / w / scene.board.square_m + 1.0).reshape(rays.shape[:2])
    b = (y / w / scene.board.square_m + 1.0).reshape(rays.shape[:2])
    light = cv2.remap(
        texture,
        (a * per_square - 0.5).astype(np.float32),
        (b * per_square - 0.5).astype(np.float32),
        cv2.INTER_NEAREST,
        borderMode=cv2.BORDER_REPLICATE,
    ).astype(np.float64)
    on = (a > 0) & (a < across) & (b > 0) & (b < down)
    paper = (a > -_RIM) & (a < across + _RIM) & (b > -_RIM) & (b < down + _RIM)
    shown = np.where(on, 35.0 + light * 0.65, np.where(paper, 201.0, 95.0))
    image = np.full(SIZE[::-1], 95.0)
    shown = shown.reshape(box[3] - box[2], _RAYS, box[1] - box[0], _RAYS)
    image[box[2] : box[3], box[0] : box[1]] = shown.mean(axis=(1, 3))
    image = cv2.GaussianBlur(image, (0, 0), blur_px) + rng.normal(0.0, noise, image.shape)
    return np.clip(image.round(), 0, 255).astype(np.uint8)
