"""Simulated calibration board in front of the cameras of a rig.

For the calibration of cameras without hardware: the board is held still, rotated, held again, as a person does it. It
is flat and exact, each pixel is the mean of the part of the board that it sees, light falls off with the board's
tilt, and the sensor's noise is that of every simulated camera. Not modelled: motion blur and rolling shutter, since a
board is measured while it is held still.
"""

from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, field
from typing import NamedTuple

import cv2
import numpy as np

from common.arrays import Float, Image
from common.calibration import CameraCalibration, RigCalibration
from common.errors import CalibrationError
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import invert
from common.sim.light import LENS_SIGMA_PX, Float32, NoiseTiles, encode
from common.sim.scene import optics_of


class BoardSettings(NamedTuple):
    """Board of the simulated calibration, and how it is held."""

    # inner corners
    columns: int = 9
    rows: int = 6
    square_m: float = 0.025
    texels_per_m: float = 8000.0
    fine: int = 3  # rays per pixel and axis
    poses: int = 24
    held_s: float = 1.6
    moved_s: float = 0.6


BOARD = BoardSettings()
TILT_RAD, ROLL_RAD = np.radians(38.0), np.radians(25.0)


@dataclass(frozen=True, slots=True, eq=False)
class Print:
    """Appearance of a flat thing, as shares of the way between two colours.

    Attributes:
        texture: (rows, columns) shares, `texels_per_m`; above 0 on the thing.
        origin: Texel (2,), column first, at the origin of the thing's frame.
        wall: Share of what lies behind.
        none_bgr, all_bgr: (3,) linear light of the shares 0 and 1, blue first, of a thing that faces the
            camera.
    """

    texture: Float32
    origin: Float
    wall: float
    none_bgr: Float
    all_bgr: Float


@dataclass(frozen=True, slots=True, eq=False)
class BoardScene:
    """Checkerboard of 9 x 6 inner corners, squares of 25 mm, moved through the view.

    Attributes:
        seed: Of the poses and the noise.
        poses: (POSES, 4, 4) board -> rig [m]: held one after the other. The board's origin is its first inner
            corner, +x along a row of COLUMNS corners, +y to the next row, +z away from the viewer.
    """

    rig: RigCalibration
    cameras: Mapping[str, CameraCalibration]
    seed: int
    optics: Mapping[str, CameraModel] = field(init=False)
    poses: Float = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "optics", optics_of(self.rig, self.cameras))
        object.__setattr__(self, "poses", self.find_poses())

    def find_poses(self) -> Float:
        """Poses (K, 4, 4) [m] that one camera, mostly all, see whole: tilted every way.

        Raises:
            CalibrationError: No pose was found that the rig's first camera sees whole: it looks past the volume.
        """
        optics = list(self.optics.values())
        rng = np.random.default_rng([self.seed, 5])
        found: list[Float] = []
        for _ in range(200 * BOARD.poses):
            first_camera = optics[len(found) % len(optics)]
            T = first_camera.T_rig_camera @ _before(first_camera, rng)
            seen = [_sees(camera, T) for camera in optics]
            if seen[len(found) % len(optics)] and (all(seen) or len(found) % 4 == 3):
                found.append(T)
            if len(found) == BOARD.poses:
                return np.stack(found)
        raise CalibrationError(
            "scene board: the cameras of this rig have no view in common that holds a board"
        )

    def printed(self) -> Print:
        """What is seen of it, a share of 1 being all light."""
        step = round(BOARD.square_m * BOARD.texels_per_m)
        margin_m = 0.0125  # white paper around the squares
        margin = round(margin_m * BOARD.texels_per_m)
        y, x = np.indices(((BOARD.rows + 1) * step, (BOARD.columns + 1) * step)) // step
        white, black, wall = 0.62, 0.035, 0.10  # linear light
        squares = np.where((x + y) % 2 == 0, black, white).astype(np.float32)
        texture = np.pad(squares, margin, constant_values=white)
        # Texel k covers k - 0.5 .. k + 0.5: the edge between two squares lies half a texel before the second.
        corner = np.full(2, margin + step - 0.5)
        return Print(texture, corner, wall, np.zeros(3), np.ones(3))

    def T_rig_board(self, t_s: float) -> Float:
        """Return the pose (4, 4) [m] at scene time `t_s` [s]; the poses repeat."""
        count, step_s = len(self.poses), BOARD.held_s + BOARD.moved_s
        k = int(max(t_s, 0.0) // step_s)
        past = max(t_s, 0.0) - k * step_s - BOARD.held_s
        now, then = self.poses[k % count], self.poses[(k + 1) % count]
        return now if past <= 0.0 else _between(now, then, past / BOARD.moved_s)


def board_corners() -> Float:
    """Inner corners (ROWS * COLUMNS, 3) [m], row by row, board frame."""
    x, y = np.meshgrid(np.arange(BOARD.columns), np.arange(BOARD.rows))
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1).astype(np.float64) * BOARD.square_m


class BoardRenderer:
    """Images of a board scene by one camera; a frame is a pure function of t.

    Holds rays, print and noise, and the last picture without noise: most of the time the board is held.
    """

    def __init__(self, scene: BoardScene, camera: str) -> None:
        self._scene, self._optics = scene, scene.optics[camera]
        height, width = self._optics.height_px, self._optics.width_px
        fine = (np.arange(BOARD.fine) + 0.5) / BOARD.fine - 0.5
        u = (np.arange(width)[:, None] + fine).ravel()
        v = (np.arange(height)[:, None] + fine).ravel()
        uv = np.stack(np.meshgrid(u, v), axis=-1)
        self._xy = self._optics.undistort(uv).astype(np.float32)
        self._print = scene.printed()
        self._noise = NoiseTiles(height, width, scene.seed * 64 + scene.rig.cameras.index(camera))
        self._gains_bgr = np.ones(3, dtype=np.float32)
        self._drawn: tuple[Float, Image] | None = None

    def exposed(self, exposure_us: float, gains_bgr: Float) -> "BoardRenderer":
        """Return the renderer at channel gains (3,), blue first; nothing is smeared."""
        del exposure_us
        other = copy(self)
        other._gains_bgr = np.array(gains_bgr, dtype=np.float32)
        other._drawn = None
        return other

    def render(self, t_s: float) -> Image:
        """Image (H, W, 3) BGR of scene time `t_s` [s]."""
        T_rig_board = self._scene.T_rig_board(t_s)
        if self._drawn is None or not np.array_equal(T_rig_board, self._drawn[0]):
            self._drawn = T_rig_board, self._draw(invert(self._optics.T_rig_camera) @ T_rig_board)
        image = self._drawn[1].copy()
        self._noise.add_to(image, round(t_s * 1e6))
        return image

    def _draw(self, T: Float) -> Image:
        """Image (H, W, 3) BGR without noise of a board at T (4, 4) [m], camera frame."""
        # board (x, y, 1) -> ray: the columns of rotation and translation of a plane (Hartley & Zisserman, 8.1.1)
        to_board = np.linalg.inv(T[:3, [0, 1, 3]])
        texels = np.diag([BOARD.texels_per_m, BOARD.texels_per_m, 1.0]) @ to_board
        texels[:2] += self._print.origin[:, None] * texels[2]
        u, v = cv2.split(cv2.perspectiveTransform(self._xy, texels))
        shade = 0.55 + 0.45 * abs(float(T[2, 2]))
        texture, border = self._print.texture, cv2.BORDER_CONSTANT
        seen = cv2.remap(texture, u, v, cv2.INTER_LINEAR, borderMode=border, borderValue=(0.0,))
        board: Float32 = np.asarray(seen, np.float32)
        fine = np.where(board > 0.0, board * np.float32(shade), np.float32(self._print.wall))
        size = (self._optics.width_px, self._optics.height_px)
        sharp = cv2.resize(fine, size, interpolation=cv2.INTER_AREA)
        light = cv2.GaussianBlur(sharp, (5, 5), 1.5 * LENS_SIGMA_PX)
        none = np.float32(self._print.none_bgr)
        colour = none + light[..., None] * (np.float32(self._print.all_bgr) - none)
        return encode(np.asarray(colour * self._gains_bgr, np.float32))


def _before(camera: CameraModel, rng: np.random.Generator) -> Float:
    """Random pose (4, 4), camera frame, of the board with its middle in the view."""
    near_m, far_m = 0.34, 0.70
    z = 1.0 / rng.uniform(1.0 / far_m, 1.0 / near_m)
    reach = np.array([camera.width_px / camera.matrix[0, 0], camera.height_px / camera.matrix[1, 1]]) / 2.0
    into_view = 0.92  # share of the half view that corners may reach
    middle = np.append(rng.uniform(-1.0, 1.0, 2) * into_view * reach, 1.0) * z
    T = np.eye(4)
    most = np.array([TILT_RAD, TILT_RAD, ROLL_RAD])
    T[:3, :3] = cv2.Rodrigues(rng.uniform(-most, most))[0]
    T[:3, 3] = middle - T[:3, :3] @ board_corners().mean(axis=0)
    return T


def _sees(camera: CameraModel, T: Float) -> bool:
    """Whether the board and half a square around it are in a camera's picture."""
    n, m = BOARD.columns, BOARD.rows
    rim = np.array([[-1, -1, 0], [n, -1, 0], [n, m, 0], [-1, m, 0]]) * BOARD.square_m
    uv = camera.project(rim @ T[:3, :3].T + T[:3, 3])
    inside = (uv > 2.0) & (uv < np.array([camera.width_px, camera.height_px]) - 3.0)
    return bool(inside.all())


def _between(now: Float, then: Float, share: float) -> Float:
    """Interpolate between two poses about one axis, with smooth start and end."""
    s = share * share * (3.0 - 2.0 * share)
    rotation = np.asarray(cv2.Rodrigues(then[:3, :3] @ now[:3, :3].T)[0], np.float64)
    T = np.eye(4)
    T[:3, :3] = np.asarray(cv2.Rodrigues(rotation * s)[0], np.float64) @ now[:3, :3]
    T[:3, 3] = (1.0 - s) * now[:3, 3] + s * then[:3, 3]
    return T
