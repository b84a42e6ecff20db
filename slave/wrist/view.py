"""What a wrist device knows of itself: its camera, its laser plane, its LEDs, and whose palm it looks at.

Everything is in the frame of the wrist camera. The device is strapped to the forearm and the palm pose is calibrated:
so the palm stands still in the image, and the roots of the fingers are known pixels.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Float
from common.calibration import CameraCalibration, HandProfile, RigCalibration
from common.camera_model import CameraModel
from common.errors import CalibrationError
from common.hand_model import HandModel
from common.wrist_calibration import FlatField

_ROTATION_WITHIN = 1e-3  # of a rotation matrix: what rounding leaves of one


@dataclass(frozen=True, slots=True, eq=False)
class WristView:
    """A wrist rig, its camera and its hand, checked.

    Attributes:
        optics: The camera; its rig frame is its own.
        model: The hand, left or right.
        T_camera_palm: Palm frame -> camera frame (4, 4) [m].
        normal: Unit normal (3,) of the laser plane.
        offset_m: The plane is normal . X = offset_m.
        led_m: LEDs (L, 3) [m]; none known: (0, 3).
        flat_field: What the LEDs make of a white surface, where it was measured.
    """

    optics: CameraModel
    model: HandModel
    T_camera_palm: Float
    normal: Float
    offset_m: float
    led_m: Float
    flat_field: FlatField | None

    @classmethod
    def of(cls, rig: RigCalibration, camera: CameraCalibration, hand: HandProfile) -> "WristView":
        """Bring the three files together.

        Raises:
            CalibrationError: The rig is none of a wrist device, belongs to another camera, or lacks its laser plane
                or palm pose; the camera lacks its intrinsics; a joint of the hand is wrong.
        """
        where = f"rig {rig.name!r}"
        if rig.kind != "wrist":
            raise CalibrationError(f"{where}: kind is {rig.kind!r}; a wrist device needs 'wrist'")
        if rig.cameras != (camera.name,):
            raise CalibrationError(
                f"{where}: cameras: {', '.join(rig.cameras)}; the camera file is that of {camera.name!r}"
            )
        if rig.laser_plane is None:
            raise CalibrationError(
                f"{where}: laser_plane is missing: calibrate the laser plane of the device"
            )
        if rig.T_camera_palm is None:
            raise CalibrationError(f"{where}: T_camera_palm is missing: calibrate the pose of the palm")
        T_camera_palm = np.array(rig.T_camera_palm, dtype=np.float64)
        turned = T_camera_palm[:3, :3]
        if (
            not np.allclose(turned @ turned.T, np.eye(3), atol=_ROTATION_WITHIN)
            or np.linalg.det(turned) < 0.0
            or not np.array_equal(T_camera_palm[3], [0.0, 0.0, 0.0, 1.0])
        ):
            raise CalibrationError(f"{where}: T_camera_palm: not a rotation and a shift, last row 0 0 0 1")
        normal = np.array(rig.laser_plane.normal)
        length = float(np.linalg.norm(normal))
        return cls(
            optics=CameraModel.of(camera, np.eye(4)),
            model=HandModel.of(hand),
            T_camera_palm=T_camera_palm,
            normal=normal / length,
            offset_m=rig.laser_plane.offset_m / length,
            led_m=np.array(rig.led or (), dtype=np.float64).reshape(-1, 3),
            flat_field=rig.flat_field,
        )

    def on_plane(self, uv: Float) -> Float:
        """Where the rays through pixels (..., 2) meet the laser plane (..., 3) [m] (D7).

        NaN where the pixel is, and where the plane is behind the camera or along the ray.
        """
        xy = self.optics.undistort(uv)
        ray = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)
        along = ray @ self.normal
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = self.offset_m / along
        return np.where(depth > 0.0, depth, np.nan)[..., None] * ray
