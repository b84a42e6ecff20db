"""A painted card at known distances, for `calibrate depth` without hardware.

The published target, 75 x 50 mm in a finger's colour (Kalbfleisch, section VI), stands between the lenses and faces
them, before a wall of the grey of the desk. It is drawn as the checkerboard is; its colour is that of a flat marker in
the light of all scenes with a hand.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Float
from common.errors import CalibrationError
from common.geometry.srgb import to_linear
from common.geometry.transforms import axis_rotation
from common.sim.board import BOARD, BoardScene, Print
from common.sim.light import DESK_LINEAR_RGB, TO_LIGHT_RIG, face_shade, marker_colour

MARKER = "index"
WIDTH_M, HEIGHT_M = 0.075, 0.050
ROLL_RAD = np.radians(
    4.0
)  # no hand holds it along the rows, where rays in thirds of a pixel would draw it 0.1 px off
DISTANCES_M = (*(round(0.88 - 0.03 * k, 2) for k in range(15)), 0.40, 0.35)  # closest where the hand is


@dataclass(frozen=True, slots=True, eq=False)
class CardScene(BoardScene):
    """A card held at DISTANCES_M before the middle between the first two lenses.

    It moves along the axis of the first camera.

    Its frame: origin in its middle, z the axis of the first camera, x and y that camera's, turned by ROLL_RAD.
    """

    def find_poses(self) -> Float:
        """As `BoardScene`.

        Raises:
            CalibrationError: The rig has one camera.
        """
        if len(self.rig.cameras) < 2:
            raise CalibrationError(f"scene card: rig {self.rig.name!r} has one camera, a depth needs two")
        first, second = (self.rig.camera_pose(name) for name in self.rig.cameras[:2])
        axis = first[:3, 2]
        across = 0.5 * (second[:3, 3] - first[:3, 3])
        foot = first[:3, 3] + across - (across @ axis) * axis
        poses = np.tile(first, (len(DISTANCES_M), 1, 1))
        poses[:, :3, :3] = first[:3, :3] @ axis_rotation(2, ROLL_RAD)
        poses[:, :3, 3] = foot + np.array(DISTANCES_M)[:, None] * axis
        return poses

    def printed(self) -> Print:
        """As `BoardScene`."""
        columns, rows = round(WIDTH_M * BOARD.texels_per_m), round(HEIGHT_M * BOARD.texels_per_m)
        facing = -float(TO_LIGHT_RIG @ self.poses[0, :3, 2])
        colour = np.array(face_shade(marker_colour(MARKER), facing)) / 255.0
        return Print(
            np.ones((rows, columns), np.float32),
            np.array([0.5 * columns - 0.5, 0.5 * rows - 0.5]),
            0.0,
            np.array(DESK_LINEAR_RGB)[::-1],
            to_linear(colour),
        )
