"""Simulated IMU on a hand or forearm.

Raw output of a common part; it does not know its orientation.

The motion's exact rates, as means since the last sample, and forces, and on top of them the errors of a part, an
LSM6DSO if none is named. The
accelerometer's zero is off by as much as the tilt may be by the rig's file: gravity then points elsewhere, and
no filter can know better. Zeros and scale are the same for a whole recording; the gyroscope's zero wanders a little, as
in a part that warms up. That of a wrist device sits on the forearm, at the wrist joint (`OnForearm`).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from math import ceil, floor, pi, radians, sqrt

import numpy as np

from common.arrays import Float
from common.calibration import ImuCalibration
from common.errors import CalibrationError
from common.geometry.transforms import matrix_to_rotation_vector, quaternion_to_matrix
from common.messages import ImuSample
from common.sim.motion import HandMotion
from common.sim.scene import Scene
from common.sim.wrist.motion import OnForearm
from common.sim.wrist.scene import WristScene

GRAVITY_M_S2 = 9.81
_WANDER_RAD_S = radians(0.03)
_NOTHING, _NO_QUATERNION = np.full(3, np.nan), np.full(4, np.nan)
_UNPLACED = "imu: q_palm_imu and q_rig_world: missing; an IMU is simulated as it is mounted"


@dataclass(frozen=True, slots=True)
class InertialPart:
    """Errors of a kind of inertial sensor, one sigma.

    Noise per root hertz; zero and scale of its gyroscope.
    """

    gyro_noise: float
    accel_noise: float
    zero_rad_s: float
    scale: float


LSM6DSO = InertialPart(radians(3.8e-3), 70e-6 * GRAVITY_M_S2, radians(1.0), 0.01)  # ST, DS12140, table 2
ICM20948 = InertialPart(
    radians(0.015), 230e-6 * GRAVITY_M_S2, radians(2.5), 0.015
)  # TDK, DS-000189, tables 1, 2


class SimulatedImu:
    """Simulated IMU of a rig during a motion.

    Pure in time: holds the errors of this recording.
    """

    def __init__(
        self, motion: HandMotion, imu: ImuCalibration, seed: int, part: InertialPart = LSM6DSO
    ) -> None:
        """Draw the errors of one recording.

        Args:
            motion: Of what it is mounted on, as a palm's (`OnForearm` for a forearm).
            imu: How it is mounted.
            seed: Same seed, same errors.
            part: Which sensor.

        Raises:
            CalibrationError: The rig's file does not state how the IMU is mounted, or how its world lies to the rig.
        """
        if imu.q_palm_imu is None or imu.q_rig_world is None:
            raise CalibrationError(_UNPLACED)
        self._motion, self._imu, self._seed, self._part = motion, imu, seed, part
        self._palm_imu = quaternion_to_matrix(np.array(imu.q_palm_imu))
        self._up = quaternion_to_matrix(np.array(imu.q_rig_world))[:, 2]
        rng = np.random.default_rng([seed, 0])
        self._zero = part.zero_rad_s * rng.normal(size=3)
        self._phase = rng.uniform(0.0, 2.0 * pi, 3)
        self._scale = np.eye(3) + part.scale * rng.normal(size=(3, 3))
        self._zero_g = imu.orientation_sigma_rad * GRAVITY_M_S2 * rng.normal(size=3)

    @property
    def rate_hz(self) -> float:
        """Samples per second, by the IMU's own clock."""
        return self._imu.rate_hz

    @classmethod
    def of(cls, scene: Scene | WristScene) -> "SimulatedImu":
        """Return the IMU of a scene's rig.

        On the palm in a marker rig, on the forearm in a wrist device.

        Raises:
            CalibrationError: The rig has none, or it is not known how that is mounted.
        """
        if scene.rig.imu is None:
            raise CalibrationError(f"rig {scene.rig.name!r}: imu: missing; there is none to simulate")
        if not scene.rig.imu.placed:
            raise CalibrationError(f"rig {scene.rig.name!r}: {_UNPLACED}")
        motion = OnForearm(scene.motion) if isinstance(scene, WristScene) else scene.motion
        return cls(motion, scene.rig.imu, scene.seed)

    def around(self, start_s: float, stop_s: float, zero_ns: int = 0) -> Iterator[ImuSample]:
        """Yield all samples of a span of scene time [s] and of a lead-in before it.

        The lead-in is as long as a filter takes to settle.

        `t_ns` counts from scene time 0 at `zero_ns`; there is none before that.
        """
        rate = self._imu.rate_hz
        before_s, after_s = 2.0, 0.1  # a filter has to settle before the first frame
        for seq in range(max(ceil((start_s - before_s) * rate), 0), floor((stop_s + after_s) * rate) + 1):
            t_s = seq / rate
            yield self.sample(seq, t_s, zero_ns + round(t_s * 1e9))

    def bias_rad_s(self, t_s: float) -> Float:
        """Return the gyroscope bias (3,) [rad/s]: its reading at rest."""
        wander_s = 200.0
        return self._zero + _WANDER_RAD_S * np.sin(2.0 * pi * t_s / wander_s + self._phase)

    def sample(self, seq: int, t_s: float, t_ns: int) -> ImuSample:
        """Sample `seq`, at scene time `t_s` [s], stamped `t_ns`."""
        half_step_s = 1e-3  # for accelerations
        before, now, after = (self._motion.at(t_s + h).T_rig_palm for h in (-half_step_s, 0.0, half_step_s))
        rig_imu = now[:3, :3] @ self._palm_imu
        last = self._motion.at(t_s - 1.0 / self._imu.rate_hz).T_rig_palm[:3, :3]
        step = matrix_to_rotation_vector(last.T @ now[:3, :3])  # palm axes
        moved = (after[:3, 3] - 2.0 * now[:3, 3] + before[:3, 3]) / half_step_s**2
        new = sqrt(0.5 * self._imu.rate_hz) * np.random.default_rng([self._seed, 1, seq]).normal(size=(2, 3))
        rate = (
            self._palm_imu.T @ step * self._imu.rate_hz
        )  # the mean since the last sample, as a low-pass leaves it
        return ImuSample(
            source=self._imu.name,
            session=0,
            seq=seq,
            t_ns=t_ns,
            gyro_rad_s=self._scale @ rate + self.bias_rad_s(t_s) + self._part.gyro_noise * new[0],
            accel_m_s2=rig_imu.T @ (moved + GRAVITY_M_S2 * self._up)
            + self._zero_g
            + self._part.accel_noise * new[1],
            mag_ut=_NOTHING,
            orientation_wxyz=_NO_QUATERNION,
        )
