"""What a wrist device adds to the viewer's scene: the fan of its laser, where that meets each finger, and its sights.

world/laser/fan                      the laser's light, as far as the rig says where it goes
world/laser/points                   where it meets each finger, in the finger's colour
world/rays/CAM/laser, /tips          from the camera to those points, and to the tips that are tracked
world/cameras/CAM/laser              the same points as this camera should see them
world/cameras/CAM/detections/...     laser, tips: as it saw them, where that is known
"""

from collections.abc import Sequence

import numpy as np
import rerun as rr

from common.arrays import Float
from common.camera_model import CameraModel
from common.hand_model import TIPS
from common.messages import FINGER_COUNT, WristDetections
from master.outputs.laser_fan import LASER_RGB, fan
from master.outputs.palette import RAY_RGB, TRUTH_RGB, pack, series_rgb
from master.outputs.poses import Poses
from master.outputs.rerun_blueprint import WORLD, camera_path
from master.outputs.rerun_columns import Columns, seen
from master.wrist.setup import WristSetup

_FAN_LINE_M = 0.0003
_POINT_M = 0.0025
_DETECTED_PX, _POINT_PX = 4.0, 3.0
_FINGER_RGB = [series_rgb(finger) for finger in range(FINGER_COUNT)]


class WristLayer:
    """Logs one wrist device to a recording that belongs to the caller; holds nothing that changes."""

    def __init__(
        self, recording: rr.RecordingStream, camera: str, model: CameraModel, setup: WristSetup, spread: Float
    ) -> None:
        """Log the laser's fan; `spread` are its rays' directions (K, 3), see `fan_rays`."""
        self._rows = Columns(recording)
        self._camera, self._model = camera, model
        lines = fan(setup.laser_m, spread)
        recording.log(
            f"{WORLD}/laser/fan",
            rr.LineStrips3D(lines, colors=[(*LASER_RGB, 90)], radii=_FAN_LINE_M),
            static=True,
        )

    def log_poses(self, poses: Poses) -> None:
        """Log laser points and sights of a batch of poses."""
        t, points = poses.t_ns, poses.laser_m
        colours = np.broadcast_to(pack(_FINGER_RGB), points.shape[:2])
        self._rows.points(f"{WORLD}/laser/points", t, points, seen(points), colours, _POINT_M)
        rays, centre = rr.new_entity_path([WORLD, "rays", self._camera]), self._model.centre
        self._rows.rays(f"{rays}/laser", t, centre, points, int(pack([RAY_RGB], alpha=150)[0]))
        tips = np.where(poses.tracked[:, TIPS, None], poses.position_m[:, TIPS], np.nan)
        self._rows.rays(f"{rays}/tips", t, centre, tips, int(pack([TRUTH_RGB], alpha=90)[0]))
        self._rows.pixels(
            f"{camera_path(self._camera)}/laser", t, self._model.project(points), colours, _POINT_PX
        )
        self._rows.scalars("plots/seen/laser_points", t, seen(points).sum(axis=1).astype(np.float64))

    def log_detections(self, frames: Sequence[WristDetections]) -> None:
        """Log what the camera saw of laser and fingertips, in its image; frames in the order of time."""
        t = np.array([frame.t_ns for frame in frames], np.int64)
        colours = np.broadcast_to(pack(_FINGER_RGB), (len(frames), FINGER_COUNT))
        path = f"{camera_path(self._camera)}/detections"
        for name, uv in (
            ("laser", np.array([frame.laser_uv for frame in frames])),
            ("tips", np.array([frame.tip_uv for frame in frames])),
        ):
            self._rows.pixels(f"{path}/{name}", t, uv, colours, _DETECTED_PX)
