"""A wrist device's camera sees a checkerboard, one place after another.

For the calibration of a wrist device without hardware; the frames are ambient, laser and LED. The board is flat,
exact and white paper (Lambert); a wall stands behind it. Light falls off as it does: LEDs with the square of the
distance, with the cosine on the paper and with their own lobe, the lens with a power of it; the laser is a sheet of
Gaussian thickness within its fan. The sensor is linear, its noise that of photons and of reading. Not modelled:
motion, since the board is held still.
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from common.arrays import Float, Image
from common.calibration import CameraCalibration, RigCalibration
from common.calibration.rig import Laser, LaserPlane
from common.errors import CalibrationError
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import rotation_vector_to_matrix
from common.recording.frame_recording import Illumination, Manifest
from common.recording.recorded_files import write_npz
from common.sim.light import Float32
from common.sim.record import FIRST_NS, TRUTH, RenderedFrame, write_frames
from common.sim.wrist.record import ORDER

WHITE = 0.75  # reflectance at 850 nm
LED_AT_M = 0.20  # where white paper before the lens fills LED_LEVEL of the range
LED_LOBE = 1.0  # LEDs behind a diffuser: power of the cosine
LENS_POWER = 2.2  # of the cosine: a wide lens keeps more light at its rim than the natural fourth power
TILT_RAD, ROLL_RAD = np.radians(40.0), np.radians(25.0)


@dataclass(frozen=True, slots=True, eq=False)
class WristBoardScene:
    """Poses of a board before a wrist camera.

    Attributes:
        rig: Wrist rig with `laser_plane` and `led`.
        camera: Its camera file, with intrinsics.
        columns, rows: Inner corners; square_m: side of a square [m].
        poses: (N, 4, 4) board -> camera [m], held one after the other. Origin of the board: its first inner
            corner, x along a row, y to the next row, z away from the viewer; the square between the first
            four corners is dark.
        ambient: Level of white paper in the light of the room, of the whole range.
        seed: Of the noise.
    """

    rig: RigCalibration
    camera: CameraCalibration
    columns: int
    rows: int
    square_m: float
    poses: Float
    ambient: float = 0.10
    seed: int = 0

    def __post_init__(self) -> None:
        if self.rig.laser_plane is None or self.rig.led is None:
            raise CalibrationError(
                f"rig {self.rig.name!r}: a wrist device needs the keys laser_plane and led"
            )

    def optics(self) -> CameraModel:
        """The camera as geometry, in its own frame.

        Raises:
            CalibrationError: It has no intrinsics: a simulated camera must have a lens.
        """
        return CameraModel.of(self.camera, np.eye(4))


def board_poses(
    optics: CameraModel,
    columns: int,
    rows: int,
    square_m: float,
    plane: LaserPlane | None,
    count: int,
    seed: int,
) -> Float:
    """Board poses (count, 4, 4) as a person shows them: whole, near and far, tilted.

    They are crossed by the laser; without a plane they are anywhere in the image.

    Raises:
        CalibrationError: The plane passes the camera's view, or the board is too large or small for it.
    """
    rng = np.random.default_rng([seed, 7])
    half = np.array([columns - 1, rows - 1]) * 0.5
    x, y = np.meshgrid([-1.0, columns], [-1.0, rows])
    rim = np.stack([x.ravel() - half[0], y.ravel() - half[1], np.zeros(4)], axis=1) * square_m
    most = np.array([TILT_RAD, TILT_RAD, ROLL_RAD])
    found: list[Float] = []
    for _ in range(500 * count):
        near_m, far_m = 0.14, 0.34
        z = 1.0 / rng.uniform(1.0 / far_m, 1.0 / near_m)
        reach = 0.9 * np.array([optics.width_px, optics.height_px]) / np.diag(optics.matrix)[:2] / 2.0
        T = np.eye(4)
        T[:3, :3] = rotation_vector_to_matrix(rng.uniform(-most, most))
        T[:3, 3] = np.append(rng.uniform(-reach, reach), 1.0) * z
        around = rim @ T[:3, :3].T + T[:3, 3]
        uv = optics.project(around)
        inside = (uv > 3.0) & (uv < np.array([optics.width_px, optics.height_px]) - 4.0)
        if inside.all() and (plane is None or _crossed(around, plane) > square_m):
            T[:3, 3] -= T[:3, :3] @ np.append(half * square_m, 0.0)
            found.append(T)
        if len(found) == count:
            return np.stack(found)
    raise CalibrationError("a board of this size cannot be shown to this camera so that its laser crosses it")


def _crossed(points: Float, plane: LaserPlane) -> float:
    """How far [m] points (n, 3) reach to both sides of a plane, the lesser of both."""
    side = points @ np.array(plane.normal) - plane.offset_m
    return float(min(side.max(), -side.min()))


class WristBoardRenderer:
    """Renderer of a board scene; an image is a pure function of pose and light."""

    def __init__(self, scene: WristBoardScene) -> None:
        """Prepare the rays; CalibrationError: the camera has no intrinsics."""
        self._scene = scene
        optics = scene.optics()
        height, width = optics.height_px, optics.width_px
        u, v = np.meshgrid(np.arange(width), np.arange(height))
        xy = optics.undistort(np.stack([u, v], axis=-1).astype(np.float64))
        down, along = np.gradient(xy, axis=0), np.gradient(xy, axis=1)
        fine = 3  # rays per pixel and axis
        part = (np.arange(fine) + 0.5) / fine - 0.5
        self._rays = [
            np.moveaxis(xy + du * along + dv * down, -1, 0).astype(np.float32) for dv in part for du in part
        ]
        self._lens = ((1.0 + (xy**2).sum(axis=-1)) ** (-0.5 * LENS_POWER)).astype(np.float32)

    def render(self, pose: int, lit: Illumination) -> Image:
        """Image (H, W) of the board in pose number `pose`."""
        scene = self._scene
        T = scene.poses[pose]
        light = np.zeros(self._lens.shape, np.float32)
        for x, y in self._rays:
            light += self._radiance(T, x, y, lit)
        light *= self._lens / np.float32(len(self._rays))
        return self._exposed(light, pose, lit)

    def _radiance(self, T: Float, x: Float32, y: Float32, lit: Illumination) -> Float32:
        """Light (H, W), 1 = the sensor's range, along rays (x, y, 1)."""
        scene, normal = self._scene, T[:3, 2].astype(np.float32)
        facing = normal[0] * x + normal[1] * y + normal[2]
        depth = np.float32(T[:3, 2] @ T[:3, 3]) / np.where(np.abs(facing) > 1e-6, facing, np.float32(1e-6))
        a, b = (T[:3, :2].T / scene.square_m).astype(np.float32)
        a0, b0 = (T[:3, :2].T @ T[:3, 3] / scene.square_m).astype(np.float32)
        i = depth * (a[0] * x + a[1] * y + a[2]) - a0
        j = depth * (b[0] * x + b[1] * y + b[2]) - b0
        n, m = scene.columns, scene.rows
        margin = 0.5  # white paper around the squares, of a square
        rim = np.float32(1.0 + margin)
        on = (depth > 0) & (i > -rim) & (i < n - 1 + rim) & (j > -rim) & (j < m - 1 + rim)
        squares = (i > -1) & (i < n) & (j > -1) & (j < m)
        dark = squares & ((np.floor(i) + np.floor(j)) % 2 == 0)
        black, wall = 0.06, 0.35  # reflectance at 850 nm
        reflectance = np.where(on, np.where(dark, black, WHITE), wall).astype(np.float32)
        wall_m = 0.8
        z = np.where(on, depth, np.float32(wall_m))
        facing = np.where(on, normal[:, None, None], np.array([0, 0, 1], np.float32)[:, None, None])
        points = np.stack([z * x, z * y, z])
        total = np.full(x.shape, np.float32(scene.ambient / WHITE))
        if lit is Illumination.LED:
            total += self._led(points, facing)
        elif lit is Illumination.LASER:
            total += self._laser(points, facing)
        return reflectance * total

    def _led(self, points: Float32, facing: Float32) -> Float32:
        """Irradiance (H, W) of all LEDs: lobe, inverse square, cosine."""
        assert self._scene.rig.led is not None  # the scene has refused it
        total = np.zeros(points.shape[1:], np.float32)
        for led in self._scene.rig.led:
            way = points - np.array(led, np.float32)[:, None, None]
            square = (way**2).sum(axis=0)
            cosine = np.maximum((way * facing).sum(axis=0), 0.0) / np.sqrt(square)
            lobe = (np.maximum(way[2], 0.0) / np.sqrt(square)) ** np.float32(LED_LOBE)
            total += cosine * lobe / square
        led_level = 0.55
        scale = led_level / WHITE * LED_AT_M**2 / len(self._scene.rig.led)
        return np.asarray(total * np.float32(scale), np.float32)

    def _laser(self, points: Float32, facing: Float32) -> Float32:
        """Irradiance (H, W) of the sheet of light within its fan."""
        plane = self._scene.rig.laser_plane
        assert plane is not None  # the scene has refused it
        normal = np.array(plane.normal, np.float32)[:, None, None]
        off = (points * normal).sum(axis=0) - np.float32(plane.offset_m)
        laser = self._scene.rig.laser or Laser()
        n = np.array(plane.normal)
        origin = np.array(laser.origin) if laser.origin is not None else n * plane.offset_m
        way = points - origin.astype(np.float32)[:, None, None]
        distance = np.sqrt((way**2).sum(axis=0))
        along = np.abs((way * facing).sum(axis=0)) / distance
        sheet_sigma_m = 4e-4
        sheet = np.exp(-0.5 * (off / np.float32(sheet_sigma_m)) ** 2)
        ahead = np.array(laser.forward) if laser.forward is not None else np.array([0, 0, 1.0]) - n[2] * n
        ahead = ahead / np.linalg.norm(ahead)
        toward = (way * ahead.astype(np.float32)[:, None, None]).sum(axis=0) / distance
        lit = toward > np.float32(np.cos(0.5 * (laser.fan_rad or np.pi)))
        laser_level = 0.65  # on white paper at LED_AT_M; falls with the distance, as a fan spreads
        return np.asarray(
            lit * sheet * along * np.float32(laser_level / WHITE * LED_AT_M) / distance, np.float32
        )

    def _exposed(self, light: Float32, pose: int, lit: Illumination) -> Image:
        """Image of the sensor: blur of the lens, noise of photons and of reading, 8 bits."""
        lens_sigma_px = 0.55
        blurred = np.asarray(cv2.GaussianBlur(light, (5, 5), lens_sigma_px), np.float64)
        rng = np.random.default_rng([self._scene.seed, pose, ORDER.index(lit)])
        black_level, full = 2.0, 255.0
        level = black_level + (full - black_level) * blurred
        read_sigma, electrons = 0.7, 40.0  # levels; electrons per level
        sigma = np.sqrt(read_sigma**2 + np.maximum(level - black_level, 0.0) / electrons)
        return np.clip(np.rint(level + sigma * rng.standard_normal(level.shape)), 0.0, full).astype(np.uint8)


def record_wrist_board(
    folder: Path,
    scene: WristBoardScene,
    rig: RigCalibration | None = None,
    illuminations: tuple[Illumination, ...] = ORDER,
) -> int:
    """Render every pose as one strobe cycle and return the number of poses.

    Args:
        folder: New or empty. Gets a recording of raw frames of kind "wrist", and truth.npz with
            T_camera_board.
        rig: The device by its manifest; None: the truth.
        illuminations: Frames of a strobe cycle that are kept; the others were lost.

    Raises:
        RecordingError: The folder holds something already, or cannot be written.
    """
    renderer = WristBoardRenderer(scene)
    manifest = Manifest(
        version=1,
        kind="wrist",
        cameras={scene.camera.name: scene.camera},
        rig=rig or scene.rig,
        continuous=False,
        note=f"board of {scene.columns} x {scene.rows} inner corners, {1e3 * scene.square_m:g} mm; one pose per cycle",
    )
    period_ns, held_ns, poses = 11_111_111, 500_000_000, len(scene.poses)
    frames = (
        RenderedFrame(
            scene.camera.name,
            3 * pose + k,
            FIRST_NS + pose * held_ns + k * period_ns,
            lit,
            renderer.render(pose, lit),
        )
        for pose in range(poses)
        for k, lit in enumerate(ORDER)
        if lit in illuminations
    )
    write_frames(folder, manifest, frames)
    write_npz(folder / TRUTH, {"T_camera_board": scene.poses})
    return poses
