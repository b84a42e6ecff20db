"""An IMU on the back of a simulated hand: exact rates and forces, and the orientation that fusion would make of them.

The error of such an orientation is not white: the tilt is off by what the accelerometer's bias makes of gravity and the
heading by what summed-up rates have become, both the same for a whole recording; little of it is new in every sample.
Where the rig's file says that the heading is not known, it begins anywhere.
"""

from collections.abc import Iterator
from math import ceil, floor

import numpy as np

from common.arrays import Float
from common.calibration import ImuCalibration
from common.errors import CalibrationError
from common.geometry import matrix_to_quaternion, quaternion_to_matrix, rotation_vector_to_matrix, unskew
from common.messages import ImuSample
from common.sim.motion import HandMotion
from common.sim.scene import Scene
from common.sim.wrist.scene import WristScene

_NEW_SHARE = 0.25  # of the standard deviation, new in every sample
_HALF_STEP_S = 1e-3  # for rates and accelerations
_GRAVITY_M_S2 = 9.81
_MORE_S = 0.1
_NOTHING = np.full(3, np.nan)
_UNPLACED = "imu: q_palm_imu and q_rig_world: missing; an IMU is simulated as it is mounted"


class SimulatedImu:
    """What the IMU of a rig would say of a motion. Pure in time: holds the errors of this recording."""

    def __init__(self, motion: HandMotion, imu: ImuCalibration, seed: int) -> None:
        """Draw the errors of one recording.

        Raises:
            CalibrationError: The rig's file does not say how the IMU is mounted, or how its world lies to the rig.
        """
        if imu.q_palm_imu is None or imu.q_rig_world is None:
            raise CalibrationError(_UNPLACED)
        self._motion, self._imu, self._seed = motion, imu, seed
        self._palm_imu = quaternion_to_matrix(np.array(imu.q_palm_imu))
        self._rig_world = quaternion_to_matrix(np.array(imu.q_rig_world))
        rng = np.random.default_rng([seed, 0])
        lasting = np.sqrt(1.0 - _NEW_SHARE**2) * imu.orientation_sigma_rad
        self._tilt = lasting * rng.normal(size=3)
        drift_sign = rng.choice([-1.0, 1.0])
        self._drift_rad_s = float(drift_sign * imu.heading_drift_rad_s)
        known = imu.heading_sigma_rad
        self._heading_rad = float(rng.uniform(-np.pi, np.pi) if known is None else known * rng.normal())
        self._tilt -= self._up * (self._up @ self._tilt)

    @property
    def rate_hz(self) -> float:
        """Samples per second, by the IMU's own clock."""
        return self._imu.rate_hz

    @property
    def _up(self) -> Float:
        return self._rig_world[:, 2]

    @classmethod
    def of(cls, scene: Scene | WristScene) -> "SimulatedImu":
        """The IMU of a scene's rig.

        Raises:
            CalibrationError: The rig has none, or it is not known how that is mounted.
        """
        if scene.rig.imu is None:
            raise CalibrationError(f"rig {scene.rig.name!r}: imu: missing; there is none to simulate")
        if not scene.rig.imu.placed:
            raise CalibrationError(f"rig {scene.rig.name!r}: {_UNPLACED}")
        return cls(scene.motion, scene.rig.imu, scene.seed)

    def around(self, start_s: float, stop_s: float, zero_ns: int = 0) -> Iterator[ImuSample]:
        """All samples of a span of scene time [s] and a little more; `t_ns` counts from scene time 0 at `zero_ns`."""
        rate = self._imu.rate_hz
        for seq in range(max(ceil((start_s - _MORE_S) * rate), 0), floor((stop_s + _MORE_S) * rate) + 1):
            t_s = seq / rate
            yield self.sample(seq, t_s, zero_ns + round(t_s * 1e9))

    def sample(self, seq: int, t_s: float, t_ns: int) -> ImuSample:
        """Sample `seq`, at scene time `t_s` [s], stamped `t_ns`."""
        before, now, after = (self._motion.at(t_s + h).T_rig_palm for h in (-_HALF_STEP_S, 0.0, _HALF_STEP_S))
        rig_imu = now[:3, :3] @ self._palm_imu
        turned = unskew(
            before[:3, :3].T @ after[:3, :3]
        )  # palm axes; the sine of so small an angle is the angle
        moved = (after[:3, 3] - 2.0 * now[:3, 3] + before[:3, 3]) / _HALF_STEP_S**2
        new = np.random.default_rng([self._seed, 1, seq]).normal(size=3)
        error = self._tilt + _NEW_SHARE * self._imu.orientation_sigma_rad * new
        heading = (self._heading_rad + self._drift_rad_s * max(t_s, 0.0)) * self._up
        wrong = rotation_vector_to_matrix(heading) @ rotation_vector_to_matrix(error)
        return ImuSample(
            source=self._imu.name,
            session=0,
            seq=seq,
            t_ns=t_ns,
            gyro_rad_s=self._palm_imu.T @ turned / (2.0 * _HALF_STEP_S),
            accel_m_s2=rig_imu.T @ (moved + _GRAVITY_M_S2 * self._up),
            mag_ut=_NOTHING,
            orientation_wxyz=matrix_to_quaternion(self._rig_world.T @ wrong @ rig_imu),
        )
