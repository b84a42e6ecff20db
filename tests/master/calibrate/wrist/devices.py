"""Wrist devices and boards before them, for the tests of their calibration."""

from functools import cache

import numpy as np
from msgspec.structs import replace

from common.arrays import Float, Image
from common.calibration import CameraCalibration, RigCalibration, load
from common.calibration.rig import LaserPlane
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import rotation_vector_to_matrix
from common.recording.frame_recording import Illumination
from common.sim.wrist.board import WristBoardRenderer, WristBoardScene, board_poses
from common.sim.wrist.record import ORDER
from master.calibrate.cameras.boards import Checkerboard
from master.calibrate.wrist.device import LitView
from tests.conftest import ROOT

BOARD = Checkerboard(9, 6, 0.015)
CAMERA = load(ROOT / "calib_json/cameras/wrist.json", CameraCalibration)
RIG = load(ROOT / "calib_json/rigs/wrist.json", RigCalibration)
OPTICS = CameraModel.of(CAMERA, np.eye(4))
FOCAL_PX = float(OPTICS.matrix[0, 0])


def plane_of(seed: int) -> LaserPlane:
    """A laser as somebody mounted it: tilted by up to 6 degrees, 26 to 34 mm from the camera."""
    rng = np.random.default_rng([seed, 1])
    x, y, z = rotation_vector_to_matrix(np.radians(rng.uniform(-6.0, 6.0, 3))) @ np.array([0.0, 0.995, 0.1])
    length = float(np.linalg.norm([x, y, z]))
    normal = (float(x) / length, float(y) / length, float(z) / length)
    return LaserPlane(normal=normal, offset_m=0.03 + float(rng.uniform(-0.004, 0.004)))


def scene_of(seed: int, views: int, *, anywhere: bool = False) -> WristBoardScene:
    """A board shown to that device."""
    plane = plane_of(seed)
    poses = board_poses(
        OPTICS, BOARD.columns, BOARD.rows, BOARD.square_m, None if anywhere else plane, views, seed
    )
    rig = replace(RIG, laser_plane=plane, laser=None, strobe=None, flat_field=None)
    return WristBoardScene(rig, CAMERA, BOARD.columns, BOARD.rows, BOARD.square_m, poses, seed=seed)


@cache
def cycles_of(seed: int, views: int) -> tuple[dict[Illumination, Image], ...]:
    """The rendered triples of such a scene."""
    renderer = WristBoardRenderer(scene_of(seed, views))
    return tuple({lit: renderer.render(pose, lit) for lit in ORDER} for pose in range(views))


def view_of(name: str, frames: dict[Illumination, Image]) -> LitView:
    """Frames in memory as a view."""
    return LitView(name, {lit: lambda image=image: image for lit, image in frames.items()})


def angle_deg(a: Float, b: Float) -> float:
    """Between two directions (3,), exact for small ones."""
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))
