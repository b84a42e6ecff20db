"""Cameras that look at a board, with truth: corners with noise, or images, and views wrong on purpose."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import cv2
import numpy as np

from common.arrays import Float
from common.geometry.transforms import axis_rotation, invert, rigid, rotation_vector_to_matrix, transform
from master.calibrate.cameras.boards import Board, Charuco, Checkerboard, ImageObservation, board_corners
from master.calibrate.cameras.views import BoardViews, View

SIZE = (640, 480)
LENS = np.array([530.0, 531.0, 322.0, 241.0, -0.28, 0.09, 0.001, -0.0005, 0.0])


@dataclass(frozen=True, eq=False)
class Scene:
    """Truth of a session.

    Attributes:
        board: The board.
        lenses: Camera -> (9,) in the order of `bundle.LENS`.
        T_camera_rig: Camera -> (4, 4) [m].
        T_rig_board: One pose (V, 4, 4) [m] per view.
        shape_m: How far the real corners are from the drawn ones (N, 3) [m].
        moved: (view, camera) -> where the board was when that camera looked (4, 4) [m].
    """

    board: Board
    lenses: Mapping[str, Float]
    T_camera_rig: Mapping[str, Float]
    T_rig_board: Float
    shape_m: Float
    moved: Mapping[tuple[int, str], Float] = field(default_factory=dict)

    def corners(self, view: int, camera: str) -> Float:
        """True pixels (N, 2) of the corners, also outside the image."""
        points = board_corners(self.board) + self.shape_m
        pose = self.moved.get((view, camera), self.T_rig_board[view])
        seen = transform(self.T_camera_rig[camera] @ pose, points)
        lens = self.lenses[camera]
        matrix = np.array([[lens[0], 0, lens[2]], [0, lens[1], lens[3]], [0, 0, 1.0]])
        uv, _ = cv2.projectPoints(seen, np.zeros(3), np.zeros(3), matrix, lens[4:])
        return np.asarray(uv, dtype=np.float64).reshape(-1, 2)

    def views(self, noise_px: float, seed: int) -> BoardViews:
        """Corners with noise; a camera sees a view if all corners are in its image, ChArUco: 12 of them."""
        rng = np.random.default_rng(seed)
        views: list[View] = []
        unseen: list[str] = []
        for number in range(len(self.T_rig_board)):
            observations: dict[str, ImageObservation] = {}
            for camera in self.lenses:
                uv = self.corners(number, camera)
                inside = ((uv > 4) & (uv < np.array(SIZE) - 5)).all(axis=1)
                uv = uv + rng.normal(0.0, noise_px * rng.uniform(0.8, 1.25), uv.shape)
                if inside.sum() < (12 if isinstance(self.board, Charuco) else len(uv)):
                    unseen.append(f"{number:02d} {camera}")
                    continue
                uv[~inside] = np.nan
                observations[camera] = ImageObservation(uv, float(rng.uniform(0.7, 1.1)))
            if observations:
                views.append(View(f"{number:02d}", observations))
        return BoardViews(self.board, dict.fromkeys(self.lenses, SIZE), tuple(views), tuple(unseen))


def scene(
    seed: int,
    cameras: int = 2,
    views: int = 18,
    board: Board | None = None,
    *,
    baseline_m: float = 0.08,
    tilt_deg: float = 40.0,
    shape_mm: float = 0.0,
) -> Scene:
    """Cameras in an arc that look at one place, and boards about it, tilted, near and far, all over the images."""
    rng = np.random.default_rng(seed)
    board = board or Checkerboard(9, 6, 0.025)
    names = ["left", "right", "top", "side"][:cameras]
    lenses = {name: LENS * np.r_[1 + rng.normal(0, 0.01, 4), 1 + rng.normal(0, 0.1, 5)] for name in names}
    T_camera_rig: dict[str, Float] = {}
    for i, name in enumerate(names):
        centre = np.array([baseline_m * i, -0.01 * (i % 2) * i, 0.0])
        rotation = axis_rotation(1, -np.arctan2(centre[0], 0.9)) @ rotation_vector_to_matrix(
            rng.normal(0, 0.02, 3)
        )
        T_camera_rig[name] = np.eye(4) if i == 0 else invert(rigid(rotation, centre))
    drawn = board_corners(board)
    middle = drawn.mean(axis=0)
    extent = float(np.linalg.norm(np.ptp(drawn, axis=0)))
    poses: list[Float] = []
    mean_x = baseline_m * (cameras - 1) / 2
    while len(poses) < views:
        axis = rng.normal(size=2)
        tilt = np.radians(rng.uniform(0.3, 1.0) * tilt_deg) * axis / np.linalg.norm(axis)
        rotation = rotation_vector_to_matrix(np.array([*tilt, 0.0])) @ axis_rotation(
            2, rng.uniform(-0.6, 0.6)
        )
        z = extent * rng.uniform(1.1, 2.6)
        place = np.array([mean_x + rng.uniform(-0.4, 0.4) * z, rng.uniform(-0.3, 0.3) * z, z])
        T = rigid(rotation, place - rotation @ middle)
        trial = Scene(board, lenses, T_camera_rig, T[None], np.zeros_like(drawn))
        uv = [trial.corners(0, name) for name in names]
        inside = [((p > 6) & (p < np.array(SIZE) - 7)).all() for p in uv]
        if all(inside[:2]):
            poses.append(T)
    bend = rng.normal(size=(3, 6))
    x, y = (drawn[:, :2] / np.abs(drawn[:, :2]).max()).T
    basis = np.stack([x * y, x**2, y**2, x**3, y**3, x**2 * y])
    shape = (bend * [[0.4], [0.4], [1.0]]) @ basis
    shape = (shape - shape.mean(axis=1, keepdims=True)).T
    shape = shape_mm * 1e-3 * shape / np.sqrt((shape**2).mean()) if shape_mm else np.zeros_like(drawn)
    return Scene(board, lenses, T_camera_rig, np.stack(poses), shape)


def nudged(pose: Float, millimetres: float, seed: int) -> Float:
    """A board's pose (4, 4) moved by so much in a random direction, turned a little too."""
    rng = np.random.default_rng(seed)
    way = rng.normal(size=3)
    rotation = rotation_vector_to_matrix(rng.normal(0, millimetres * 1e-3, 3))
    return rigid(rotation @ pose[:3, :3], pose[:3, 3] + millimetres * 1e-3 * way / np.linalg.norm(way))
