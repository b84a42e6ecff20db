"""What the master knows of one wrist device before the first message: optics, laser, palm and hand, checked."""

from dataclasses import dataclass

import numpy as np

from common.arrays import Float
from common.calibration import CameraCalibration, FilterCalibration, RigCalibration, Volume
from common.camera_model import CameraModel
from common.errors import CalibrationError
from common.geometry import invert
from common.hand_model import FINGERS, HandModel
from common.wrist_calibration import FingerLine


@dataclass(frozen=True, slots=True, eq=False)
class WristSetup:
    """A wrist rig as arrays, in the frame of its camera, which is the rig frame.

    Attributes:
        optics: The camera; its place in the rig is the identity.
        model: The hand.
        T_camera_palm: (4, 4) [m].
        normal: (3,) unit normal of the laser plane, normal . X = offset.
        offset_m: Its distance from the camera.
        laser_m: (3,) where the laser light comes from, in its plane.
        lines: Finger -> the measured line its laser point moves along; of none, the simulated one counts.
        cubic: Flexion by the cubic printed in the paper and not by the table of this hand.
        filter: Of the laser points, where frames follow each other.
        volume: What the rig states, or None.
        late_ns: How much later frames are taken than their stamps say [ns].
    """

    optics: CameraModel
    model: HandModel
    T_camera_palm: Float
    normal: Float
    offset_m: float
    laser_m: Float
    lines: dict[str, FingerLine]
    cubic: bool
    filter: FilterCalibration
    volume: Volume | None = None
    late_ns: int = 0

    @classmethod
    def of(cls, rig: RigCalibration, camera: CameraCalibration, model: HandModel) -> "WristSetup":
        """Build and check.

        Where the rig does not say where its laser is, it is put at the foot of the camera on its plane: the laser of
        such a device sits beside the lens.

        Raises:
            CalibrationError: The rig is no wrist rig, or lacks laser plane, palm pose or the camera's intrinsics.
        """
        where = f"rig {rig.name!r}"
        if rig.kind != "wrist":
            raise CalibrationError(f"{where}: kind is {rig.kind!r}, a wrist device needs 'wrist'")
        if camera.name not in rig.cameras:
            raise CalibrationError(f"{where}: cameras: {camera.name!r} is not {', '.join(rig.cameras)}")
        if rig.laser_plane is None:
            raise CalibrationError(
                f"{where}: laser_plane is missing, which `phalanx-master calibrate laser-plane` measures"
            )
        if rig.T_camera_palm is None:
            raise CalibrationError(
                f"{where}: T_camera_palm is missing, which `phalanx-master calibrate palm` measures"
            )
        palm = np.array(rig.T_camera_palm, dtype=np.float64)
        if not np.allclose(palm @ invert(palm), np.eye(4), atol=1e-4) or np.linalg.det(palm[:3, :3]) < 0.0:
            raise CalibrationError(f"{where}: T_camera_palm: no rigid transform")
        normal = np.array(rig.laser_plane.normal)
        length = float(np.linalg.norm(normal))
        normal, offset_m = normal / length, rig.laser_plane.offset_m / length
        origin = rig.laser.origin if rig.laser is not None else None
        laser = offset_m * normal if origin is None else np.array(origin)
        return cls(
            optics=CameraModel.of(camera, np.eye(4)),
            model=model,
            T_camera_palm=palm,
            normal=normal,
            offset_m=offset_m,
            laser_m=laser + (offset_m - laser @ normal) * normal,
            lines={name: rig.finger_lines[name] for name in FINGERS if name in rig.finger_lines},
            cubic=rig.forward == "cubic",
            filter=rig.filter,
            volume=rig.volume,
            late_ns=round(1e3 * rig.stamp_offset_us.get(camera.name, 0.0)),
        )
