"""Log a wrist device with its light, and images of cameras, to Rerun."""

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
import rerun as rr

from common.arrays import Float, Image
from common.errors import PictureError
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import matrix_to_quaternion, quaternion_to_matrix
from common.hand.model import TIPS
from common.messages import (
    FINGER_COUNT,
    Source,
    WristDetections,
)
from common.messages.picture_size import Size, jpeg_size
from master.outputs.drawing import (
    LASER_RGB,
    RAY_RGB,
    SOURCE_RGB,
    TRUTH_RGB,
    DevicePlace,
    fan,
    pack,
    series_rgb,
)
from master.outputs.poses import Poses
from master.outputs.rerun_blueprint import (
    TIMELINE,
    WORLD,
    Columns,
    camera_path,
    seen,
)
from master.rig.wrist import WristSetup

_FAN_LINE_M = 0.0003
_WRIST_ANGLES = ("flexion", "deviation")
_FINGER_RGB = [series_rgb(finger) for finger in range(FINGER_COUNT)]


class WristLayer:
    """Logger of one wrist device to a recording that belongs to the caller."""

    def __init__(
        self,
        recording: rr.RecordingStream,
        camera: str,
        setup: WristSetup,
        spread: Float,
        group: str = "",
        *,
        in_rig: bool,
    ) -> None:
        """Log what never changes.

        Args:
            spread: Directions (K, 3) of the device's light, see `fan_rays`.
            group: What stands behind the paths of laser and plots, see `RerunScene`.
            in_rig: Poses are in the frame of a rig of markers, not of the device's camera.
        """
        self._rows, self._setup, self._in_rig = Columns(recording), setup, in_rig
        self._laser, self._group = f"{WORLD}/laser{group}", group
        self._level_world: Float | None = None
        self._camera, self._model = camera, setup.optics
        for i, name in enumerate(_WRIST_ANGLES if in_rig else ()):
            self._rows.name(f"plots/wrist_angles_deg{group}/{name}", name, series_rgb(i))
        lines = fan(setup.laser_m, spread)
        recording.log(
            f"{self._laser}/fan",
            rr.LineStrips3D(lines, colors=[(*LASER_RGB, 90)], radii=_FAN_LINE_M),
            static=True,
        )

    def log_poses(self, poses: Poses) -> None:
        """Log laser points, sights and how the forearm is held, of a batch of poses."""
        t, points, tips = poses.t_ns, poses.laser_m, poses.position_m[:, TIPS]
        if self._in_rig:
            place = DevicePlace.of(poses, self._setup.model)
            T = place.cameras(self._setup.T_camera_palm)
            self._log_placed(poses, place, T)
            points = np.where(np.isfinite(T[:, :1, 3:]), points, np.nan)  # of a lost hand nobody knows where
            tips = (tips - T[:, None, :3, 3]) @ T[:, :3, :3]
        else:
            self._log_held(poses)
        colours = np.broadcast_to(pack(_FINGER_RGB), points.shape[:2])
        point_m = 0.0025
        self._rows.points(f"{self._laser}/points", t, points, seen(points), colours, point_m)
        rays, centre = rr.new_entity_path([WORLD, "rays", self._camera]), self._model.centre
        self._rows.rays(f"{rays}/laser", t, centre, points, int(pack([RAY_RGB], alpha=150)[0]))
        tips = np.where(poses.tracked[:, TIPS, None], tips, np.nan)
        self._rows.rays(f"{rays}/tips", t, centre, tips, int(pack([TRUTH_RGB], alpha=90)[0]))
        point_px = 3.0
        self._rows.pixels(
            f"{camera_path(self._camera)}/laser", t, self._model.project(points), colours, point_px
        )
        self._rows.scalars(
            f"plots/seen{self._group}/laser_points", t, seen(points).sum(axis=1).astype(np.float64)
        )

    def _log_placed(self, poses: Poses, place: DevicePlace, T_rig_camera: Float) -> None:
        """Move the device to where the forearm is, and draw that."""
        known = np.flatnonzero(np.isfinite(T_rig_camera).all(axis=(1, 2)))
        if len(known):
            xyzw = np.roll(matrix_to_quaternion(T_rig_camera[known, :3, :3]), -1, axis=-1)
            for path in (
                camera_path(self._camera),
                self._laser,
                rr.new_entity_path([WORLD, "rays", self._camera]),
            ):
                columns = rr.Transform3D.columns(translation=T_rig_camera[known, :3, 3], quaternion=xyzw)
                self._rows.send(path, poses.t_ns[known], columns, None)
        root, t = rr.new_entity_path([WORLD, "hand", poses.hand]), poses.t_ns
        colour = int(pack([SOURCE_RGB[Source.WRIST]])[0])
        bone_m = 0.0025
        forearm_m = 0.16  # of it, as long as a hand
        self._rows.lines(f"{root}/forearm", t, place.arm_m(forearm_m), colour, bone_m)
        self._rows.lines(
            f"{root}/forearm_uncertainty", t, place.uncertainty_m(forearm_m), colour, _FAN_LINE_M
        )
        for i, name in enumerate(_WRIST_ANGLES):
            self._rows.scalars(
                f"plots/wrist_angles_deg{self._group}/{name}", t, np.degrees(place.wrist_angles_rad[:, i])
            )

    def _log_held(self, poses: Poses) -> None:
        """Turn the scene: y down along gravity, the first viewing direction ahead."""
        known = np.flatnonzero(np.isfinite(poses.palm_world_wxyz).all(axis=1))
        if not len(known):
            return
        world_camera = (
            quaternion_to_matrix(poses.palm_world_wxyz[known]) @ self._setup.T_camera_palm[:3, :3].T
        )
        if self._level_world is None:
            self._level_world = _level(world_camera[0])
        orientation = matrix_to_quaternion(self._level_world @ world_camera)
        columns = rr.Transform3D.columns(quaternion=orientation[:, [1, 2, 3, 0]])
        self._rows.send(WORLD, poses.t_ns[known], columns, None)

    def log_detections(self, frames: Sequence[WristDetections]) -> None:
        """Log laser and fingertips as the camera saw them; frames in order of time."""
        t = np.array([frame.t_ns for frame in frames], np.int64)
        colours = np.broadcast_to(pack(_FINGER_RGB), (len(frames), FINGER_COUNT))
        path = f"{camera_path(self._camera)}/detections"
        for name, uv in (
            ("laser", np.array([frame.laser_uv for frame in frames])),
            ("tips", np.array([frame.tip_uv for frame in frames])),
        ):
            detected_px = 4.0
            self._rows.pixels(f"{path}/{name}", t, uv, colours, detected_px)


def _level(world_camera: Float) -> Float:
    """Rotation from the IMU's world to x right, y down, z ahead.

    Ahead is where the camera looks, or its image's top where it looks up.
    """
    up = np.array([0.0, 0.0, 1.0])
    upright = 0.98  # cosine of 11 degrees off the vertical
    along = world_camera[:, 2] if abs(world_camera[2, 2]) < upright else -world_camera[:, 1]
    ahead = along - (along @ up) * up
    ahead /= np.linalg.norm(ahead)
    return np.stack([np.cross(ahead, up), -up, ahead])


class CameraImages:
    """Logger of camera images to a recording that belongs to the caller."""

    def __init__(self, recording: rr.RecordingStream, models: Mapping[str, CameraModel]) -> None:
        """Take the cameras of the rig by name."""
        self._rec = recording
        self._models = models
        self._last_ns: dict[str, int] = {}
        self._size: dict[str, tuple[int, int]] = {}

    def log(self, camera: str, image: Image | bytes, t_ns: int, shown_ns: int | None = None) -> bool:
        """Show an image of a camera at its full size; return whether it was logged.

        Dropped are more than 10 a second, images of a camera that the rig does not have, bytes that are no JPEG, and
        what claims to be larger than the camera's picture.

        Args:
            image: (H, W, 3) BGR, (H, W) grey, or a whole JPEG file as bytes.
            t_ns: Capture time [ns].
            shown_ns: Where it stands on the timeline [ns]; None: at `t_ns`.
        """
        last = self._last_ns.get(camera)
        image_period_ns = 100_000_000  # images at most at 10 Hz: they cost the viewer more than all else
        if last is not None and 0 <= t_ns - last < image_period_ns:
            return False
        model = self._models.get(camera)
        size = _size(image)
        if model is None or size is None or size[0] > model.width_px or size[1] > model.height_px:
            return False
        self._last_ns[camera] = t_ns
        if isinstance(image, bytes):
            jpeg = image
        else:
            jpeg_quality = 80
            jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality])[1].tobytes()
        path = f"{camera_path(camera)}/image"
        if self._size.get(camera) != size:
            # The pinhole and all centroids are in pixels of the camera; a preview has fewer.
            scale = [model.width_px / size[0], model.height_px / size[1], 1.0]
            self._rec.log(path, rr.Transform3D(scale=scale), static=True)
            self._size[camera] = size
        self._rec.set_time(TIMELINE, duration=np.timedelta64(t_ns if shown_ns is None else shown_ns, "ns"))
        self._rec.log(path, rr.EncodedImage(contents=jpeg, media_type="image/jpeg"))
        return True


def _size(image: Image | bytes) -> Size | None:
    """Width and height [px]; None: no JPEG."""
    if not isinstance(image, bytes):
        return image.shape[1], image.shape[0]
    try:
        return jpeg_size(image)
    except PictureError:
        return None
