"""Small view of the whole rig in the picture of a run.

Cameras, rays to the caps, hand, and the volume that the rig's file states.
"""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from common.arrays import Float
from common.calibration import RigCalibration
from common.geometry.transforms import axis_rotation
from common.hand.model import FINGER_JOINTS, WRIST
from common.messages import Source
from master.monitor.volume import edges
from master.outputs.palette import RAY_RGB, SOURCE_RGB
from master.outputs.picture_panels import INK, Colour, style, unit
from master.outputs.picture_wrist import WristPicture
from master.outputs.poses import Poses

STRIPS = (*((WRIST, *joints) for joints in FINGER_JOINTS), (7, 12, 17, 22))
_RIG_YAW, _RIG_PITCH = np.deg2rad(52.0), np.deg2rad(-38.0)


def draw_rig(
    figure: Figure, poses: Poses, row: int, rig: RigCalibration, wrist: WristPicture | None = None
) -> None:
    """Draw it from the side, lower left."""
    axes = figure.add_axes((0.012, 0.02, 0.215, 0.33))
    style(axes, "Rig, seen from the side")
    axes.set_xticks([])
    axes.set_yticks([])
    axes.set_aspect("equal", adjustable="datalim")
    rotation = axis_rotation(0, _RIG_PITCH) @ axis_rotation(1, _RIG_YAW)
    at = np.where(poses.valid[row][:, None], poses.position_m[row], np.nan) @ rotation.T
    for strip in STRIPS:
        axes.plot(at[list(strip), 0], at[list(strip), 1], color=unit((237, 184, 153)), lw=1.8)
    caps = poses.markers_m[row] @ rotation.T
    middle = np.mean([rig.camera_pose(name)[:3, 3] for name in rig.cameras], axis=0) @ rotation.T
    if rig.volume is not None:
        for edge in edges(rig.volume) @ rotation.T:
            axes.plot(edge[:, 0], edge[:, 1], color=INK, lw=0.7, alpha=0.35)
    for name in rig.cameras:
        pose = rig.camera_pose(name)
        centre = pose[:3, 3] @ rotation.T
        for cap in caps:
            axes.plot([centre[0], cap[0]], [centre[1], cap[1]], color=unit(RAY_RGB), lw=0.6, alpha=0.55)
        _frustum(axes, pose, rotation)
        away = (centre - middle)[:2] * [1.0, -1.0]
        away = 17.0 * away / max(float(np.linalg.norm(away)), 1e-6)
        axes.annotate(name, (float(centre[0]), float(centre[1])), (float(away[0]), float(away[1])),
                      textcoords="offset points", color=INK, size=10, ha="center", va="center")  # fmt: skip
    if wrist is not None:
        _frustum(axes, wrist.pose(poses, row), rotation, unit(SOURCE_RGB[Source.WRIST]))
    axes.invert_yaxis()
    axes.margins(0.2)  # room for the names


def _frustum(axes: Axes, pose: Float, rotation: Float, colour: Colour = INK) -> None:
    d, w, h = 0.05, 0.03, 0.0225
    corners = np.array([[-w, -h, d], [w, -h, d], [w, h, d], [-w, h, d], [-w, -h, d]])
    image = (corners @ pose[:3, :3].T + pose[:3, 3]) @ rotation.T
    centre = pose[:3, 3] @ rotation.T
    axes.plot(image[:, 0], image[:, 1], color=colour, lw=1.2)
    for corner in image[:4]:
        axes.plot([centre[0], corner[0]], [centre[1], corner[1]], color=colour, lw=1.2)
