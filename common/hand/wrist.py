"""The wrist joins forearm and palm and carries the wrist device.

Everything of the device is in the frame of its camera. It is strapped to the forearm and the palm pose is calibrated:
so the palm stands still in the image, and the roots of the fingers are known pixels.

`wrist_angles_rad` (..., 2) is flexion and deviation, 0 where forearm and palm agree. A flexion is a rotation about
the palm's x, positive where the fingers go to the side of the palm of the hand, a deviation one about its y, positive
towards the thumb of a right hand:

    R_forearm_palm = R_y(deviation) R_x(flexion)

The palm frame has its origin in the wrist joint, so a bend moves nothing but the turn: a camera on the forearm whose
`T_camera_palm` was calibrated with a straight wrist sees the palm at T_camera_palm [R_forearm_palm, 0].
"""

from dataclasses import dataclass
from math import cos, sin

import numpy as np

from common.arrays import Float
from common.calibration import CameraCalibration, RigCalibration
from common.errors import CalibrationError
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import Wxyz, intersect_plane, transform
from common.hand.model import CHAINS, HandModel

_ORIGIN = np.zeros(3)


@dataclass(frozen=True, slots=True, eq=False)
class WristDevice:
    """Camera, laser plane, palm and hand.

    Attributes:
        optics: The camera; its rig frame is its own.
        T_camera_palm: Palm frame -> camera frame (4, 4) [m].
        normal: Unit normal (3,) of the laser plane.
        offset_m: The plane is normal . X = offset_m.
    """

    optics: CameraModel
    model: HandModel
    T_camera_palm: Float
    normal: Float
    offset_m: float

    @staticmethod
    def joined(rig: RigCalibration, camera: CameraCalibration, model: HandModel) -> "WristDevice":
        """Bring the files together.

        Raises:
            CalibrationError: The rig is none of a wrist device, belongs to another camera, or lacks its laser plane
                or palm pose; these are impossible; the camera lacks its intrinsics.
        """
        where = f"rig {rig.name!r}"
        if rig.kind != "wrist":
            raise CalibrationError(f"{where}: kind is {rig.kind!r}; a wrist device needs 'wrist'")
        if rig.cameras != (camera.name,):
            raise CalibrationError(
                f"{where}: cameras: {', '.join(rig.cameras)}; the camera file is that of {camera.name!r}"
            )
        normal, offset_m = laser_plane_of(rig, where)
        if rig.T_camera_palm is None:
            raise CalibrationError(
                f"{where}: T_camera_palm is missing, which `phalanx calibrate wrist palm` measures"
            )
        palm, optics = np.array(rig.T_camera_palm, dtype=np.float64), CameraModel.of(camera, np.eye(4))
        _check_before(optics, transform(palm, model.rest_position_m[CHAINS[1:, 0]]), where)
        return WristDevice(optics, model, palm, normal, offset_m)

    def on_plane(self, uv: Float) -> Float:
        """Intersect the rays of pixels (..., 2) with the laser plane: (..., 3) [m].

        Triangulation by one camera and a plane of light (Kim et al. 2012). NaN where the pixel is, and where the plane
        is behind the camera or along the ray.
        """
        return intersect_plane(_ORIGIN, self.optics.ray(uv), self.normal, self.offset_m)


def laser_plane_of(rig: RigCalibration, where: str) -> tuple[Float, float]:
    """Unit normal (3,) and offset [m] of the laser plane, camera frame.

    Raises:
        CalibrationError: It is not measured, or crosses no finger; with `where`.
    """
    if rig.laser_plane is None:
        raise CalibrationError(
            f"{where}: laser_plane is missing, which `phalanx calibrate wrist laser-plane` measures"
        )
    normal = np.array(rig.laser_plane.normal)
    length = float(np.linalg.norm(normal))
    normal, offset_m = normal / length, rig.laser_plane.offset_m / length
    across = 0.5  # of the normal's length along y: a plane tilted by more than 60 degrees crosses no finger
    least_m = 1e-3  # a plane nearer to the lens than this measures no distance
    if abs(normal[1]) < across or offset_m * normal[1] < least_m:
        raise CalibrationError(
            f"{where}: laser_plane: normal {', '.join(f'{n:.3f}' for n in normal)}, offset_m {offset_m:.4f}: the plane"
            " must cross the fingers on the palm's side of the lens, its normal about y and y positive where it is"
        )
    return normal, offset_m


def _check_before(optics: CameraModel, knuckles_m: Float, where: str) -> None:
    """Reject knuckles (4, 3) [m] behind the camera or far beside its image."""
    size = np.array([optics.width_px, optics.height_px])
    uv = optics.project(knuckles_m) / size
    field_margin = 1.0  # image sizes from the middle: half an image beside it
    farthest_m = 0.5  # a forearm
    if not (np.abs(uv - 0.5) <= field_margin).all() or knuckles_m[:, 2].max() > farthest_m:
        places = ", ".join(f"{1e3 * x:.0f} {1e3 * y:.0f} {1e3 * z:.0f}" for x, y, z in knuckles_m)
        raise CalibrationError(
            f"{where}: T_camera_palm: puts the knuckles of index ... little at {places} mm from the camera, where it"
            " does not see them"
        )


STRAIGHT = np.zeros(2)
STRAIGHT.flags.writeable = False


def forearm_palm(wrist_angles_rad: Float) -> Float:
    """Rotations (..., 3, 3), palm axes -> forearm axes, of bends (..., 2) [rad]."""
    flexion, deviation = wrist_angles_rad[..., 0], wrist_angles_rad[..., 1]
    c, s, cd, sd = np.cos(flexion), np.sin(flexion), np.cos(deviation), np.sin(deviation)
    R = np.zeros((*wrist_angles_rad.shape[:-1], 3, 3))
    R[..., 0, 0], R[..., 0, 1], R[..., 0, 2] = cd, sd * s, sd * c
    R[..., 1, 1], R[..., 1, 2] = c, -s
    R[..., 2, 0], R[..., 2, 1], R[..., 2, 2] = -sd, cd * s, cd * c
    return R


def wrist_quaternion(flexion_rad: float, deviation_rad: float) -> Wxyz:
    """The quaternion of `forearm_palm` of one bend."""
    c, s = cos(0.5 * flexion_rad), sin(0.5 * flexion_rad)
    cd, sd = cos(0.5 * deviation_rad), sin(0.5 * deviation_rad)
    return cd * c, cd * s, sd * c, -sd * s


def wrist_angles_of(R_forearm_palm: Float) -> Float:
    """Wrist angles (..., 2) [rad] of rotations (..., 3, 3), exact if about x and y."""
    deviation = np.arctan2(-R_forearm_palm[..., 2, 0], R_forearm_palm[..., 0, 0])
    flexion = np.arctan2(-R_forearm_palm[..., 1, 2], R_forearm_palm[..., 1, 1])
    return np.stack([flexion, deviation], axis=-1)
