"""Setup of one wrist device: device and hand, its laser, and how to read it."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from common.arrays import Float
from common.calibration import CameraCalibration, FilterCalibration, ImuCalibration, RigCalibration, Volume
from common.calibration.rig import FingerLine
from common.hand.model import FINGERS, HandModel
from common.hand.wrist import WristDevice, forearm_palm


@dataclass(frozen=True, slots=True, eq=False)
class WristSetup(WristDevice):
    """A wrist rig as arrays, in the frame of its camera, which is the rig frame.

    Attributes:
        laser_m: (3,) where the laser light comes from, in its plane.
        lines: Finger -> the measured line its laser point moves along; of none, the simulated one counts.
        cubic: Flexion by the cubic printed in the paper and not by the table of this hand.
        solver_mode: What fingers are solved from: "fk", "ik" or "auto".
        filter: Of the laser points, where frames follow each other.
        volume: What the rig states, or None.
        frame_s: From frame to frame of its camera.
        late_ns: How much later frames are taken than their stamps state [ns].
        imu: The IMU on the forearm, where it is known how that is mounted; or None.
    """

    laser_m: Float
    lines: dict[str, FingerLine]
    cubic: bool
    solver_mode: Literal["fk", "ik", "auto"]
    filter: FilterCalibration
    volume: Volume | None = None
    late_ns: int = 0
    frame_s: float = 1.0 / 90.0
    imu: ImuCalibration | None = None

    @classmethod
    def of(cls, rig: RigCalibration, camera: CameraCalibration, model: HandModel) -> "WristSetup":
        """Build and check.

        Where the rig does not state where its laser is, it is put at the foot of the camera on its plane: the
        laser of such a device sits beside the lens.

        Raises:
            CalibrationError: As of `WristDevice.joined`.
        """
        device = WristDevice.joined(rig, camera, model)
        normal, offset_m = device.normal, device.offset_m
        origin = rig.laser.origin if rig.laser is not None else None
        laser = offset_m * normal if origin is None else np.array(origin)
        return cls(
            optics=device.optics,
            model=device.model,
            T_camera_palm=device.T_camera_palm,
            normal=normal,
            offset_m=offset_m,
            laser_m=laser + (offset_m - laser @ normal) * normal,
            lines={name: rig.finger_lines[name] for name in FINGERS if name in rig.finger_lines},
            cubic=rig.forward == "cubic",
            solver_mode=rig.solver_mode,
            filter=rig.filter,
            volume=rig.volume,
            frame_s=1.0 / camera.frame_rate_hz,
            late_ns=round(1e3 * rig.stamp_offset_us.get(camera.name, 0.0)),
            imu=rig.imu if rig.imu is not None and rig.imu.q_palm_imu is not None else None,
        )

    def flexed(self, wrist_angles_rad: Float) -> "WristSetup":
        """Return the setup with the wrist flexed by (2,) [rad] (`common.hand.wrist`)."""
        T = self.T_camera_palm.copy()
        T[:3, :3] = T[:3, :3] @ forearm_palm(wrist_angles_rad)
        return replace(self, T_camera_palm=T)
