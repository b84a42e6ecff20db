"""Simulated sensors measure a scene: an IMU, and a tracker on an object.

IMU: the motion's exact rates, as means since the last sample, and forces, and on top of them the errors of a part, an
LSM6DSO if none is named. The accelerometer's zero is off by as much as the tilt may be by the rig's file: gravity
then points elsewhere, and no filter can know better. Zeros and scale are the same for a whole recording; the
gyroscope's zero wanders a little, as in a part that warms up. That of a wrist device sits on the forearm, at the
wrist joint (`OnForearm`).

Vive tracker: what base stations would measure, in a frame of their own, y up. Where T_rig_tracking and
T_object_tracker are not measured yet they are as somebody would have set them up, so that the procedure that measures
them has something to find. The noise is that of Lighthouse: 0.3 mm and 0.05 degrees that wander within a tenth of a
second, beside some white noise (Niehorster, Li & Lappe, i-Perception 2017, found 0.2 mm RMS at rest); and now and
then something stands between tracker and base station for half a second.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from math import ceil, floor, pi, radians, sqrt

import numpy as np

from common.arrays import Float
from common.calibration import ImuCalibration, RigCalibration
from common.calibration.object_profile import ObjectProfile
from common.errors import CalibrationError
from common.geometry.transforms import (
    axis_rotation,
    invert,
    matrix_to_rotation_vector,
    quaternion_to_matrix,
    rigid,
    rotation_vector_to_matrix,
)
from common.messages import ImuSample
from common.sim.motion import HandMotion
from common.sim.scene import Scene
from common.sim.wrist.motion import OnForearm
from common.sim.wrist.scene import WristScene

GRAVITY_M_S2 = 9.81
_WANDER_RAD_S = radians(0.03)
_UNPLACED = "imu: q_palm_imu and q_rig_world: missing; an IMU is simulated as it is mounted"
_NOTHING, _NO_QUATERNION = np.full(3, np.nan), np.full(4, np.nan)


@dataclass(frozen=True, slots=True)
class InertialPart:
    """Errors of an inertial sensor, one sigma: noise per root hertz, zero, scale."""

    gyro_noise: float
    accel_noise: float
    zero_rad_s: float
    scale: float


LSM6DSO = InertialPart(radians(3.8e-3), 70e-6 * GRAVITY_M_S2, radians(1.0), 0.01)  # ST, DS12140, table 2


class SimulatedImu:
    """Simulated IMU of a rig during a motion; pure in time."""

    def __init__(
        self, motion: HandMotion, imu: ImuCalibration, seed: int, part: InertialPart = LSM6DSO
    ) -> None:
        """Draw the errors of one recording of a palm (`OnForearm`: of a forearm).

        Raises:
            CalibrationError: The rig's file does not state how the IMU is mounted, or how its world lies to
                the rig.
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
        """IMU of a scene's rig: on the palm, or of a wrist device on the forearm.

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
        """Yield samples of a span [s] and a filter's lead-in; scene time 0 is `zero_ns`."""
        rate = self.rate_hz
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
        # the mean since the last sample, as a low-pass leaves it
        rate = self._palm_imu.T @ step * self._imu.rate_hz
        force = rig_imu.T @ (moved + GRAVITY_M_S2 * self._up)
        return ImuSample(
            source=self._imu.name,
            session=0,
            seq=seq,
            t_ns=t_ns,
            gyro_rad_s=self._scale @ rate + self.bias_rad_s(t_s) + self._part.gyro_noise * new[0],
            accel_m_s2=force + self._zero_g + self._part.accel_noise * new[1],
            mag_ut=_NOTHING,
            orientation_wxyz=_NO_QUATERNION,
        )


WANDER_M, WANDER_RAD = 3e-4, np.radians(0.05)
WHITE_M, WHITE_RAD = 1e-4, np.radians(0.01)
_WAVES = 6  # of each wandering quantity
_RATES_HZ = (0.5, 8.0)
# Set up by somebody: the stations' frame has y up and its origin behind the cameras, turned by some angle; the rig's
# y points down. The tracker is screwed to the object's side.
SET_UP_TRACKING = rigid(axis_rotation(1, 0.96) @ np.diag([1.0, -1.0, -1.0]), np.array([0.62, 1.35, -0.84]))
SET_UP_TRACKER = rigid(
    rotation_vector_to_matrix(np.array([0.9, -0.5, 1.4])), np.array([0.031, -0.022, -0.064])
)


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedTracker:
    """Simulated tracker that reports its pose at any time of a scene; pure in time.

    Attributes:
        name: Object that it sits on.
        T_rig_tracking: (4, 4) frame of the base stations -> rig.
        T_object_tracker: (4, 4) tracker -> object.
        seed: Of the noise.
    """

    scene: Scene
    name: str
    T_rig_tracking: Float
    T_object_tracker: Float
    seed: int

    @classmethod
    def of(cls, scene: Scene, profile: ObjectProfile, seed: int) -> "SimulatedTracker":
        """Create the tracker of an object, where the files of rig and object state it.

        Raises:
            CalibrationError: The scene does not know the object.
        """
        if profile.name not in scene.rig.objects:
            raise CalibrationError(f"object {profile.name!r}: rig {scene.rig.name!r} has no such object")
        return cls(scene, profile.name, tracking_of(scene.rig), tracker_of(profile), seed)

    def pose(self, t_s: float) -> Float | None:
        """`T_tracking_device` (4, 4) [m] at scene time [s]; None: no station is seen."""
        hidden_every_s, hidden_s = 17.0, 0.5
        phase = np.random.default_rng([self.seed, 5]).uniform(0.0, hidden_every_s)
        if (t_s + phase) % hidden_every_s < hidden_s:
            return None
        truth = self.scene.truth(t_s).objects[self.name]
        place = invert(self.T_rig_tracking) @ truth @ self.T_object_tracker
        off = self._off(t_s)
        return rigid(rotation_vector_to_matrix(off[3:]) @ place[:3, :3], place[:3, 3] + off[:3])

    def _off(self, t_s: float) -> Float:
        """Error (6,) of a moment: place [m], turn [rad], in the stations' frame."""
        rng = np.random.default_rng([self.seed, 6])
        rates = rng.uniform(*_RATES_HZ, (6, _WAVES))
        phases = rng.uniform(0.0, 2.0 * np.pi, (6, _WAVES))
        waves = np.sin(2.0 * np.pi * rates * t_s + phases).sum(axis=1) * np.sqrt(2.0 / _WAVES)
        white = np.random.default_rng([self.seed, 7, round(max(t_s, 0.0) * 1e6)]).normal(size=6)
        wander = np.repeat([WANDER_M, WANDER_RAD], 3)
        return wander * waves + np.repeat([WHITE_M, WHITE_RAD], 3) * white


def tracking_of(rig: RigCalibration) -> Float:
    """`T_rig_tracking` (4, 4) of a rig's file; a simulated one where not measured."""
    return SET_UP_TRACKING if rig.T_rig_tracking is None else np.array(rig.T_rig_tracking, dtype=np.float64)


def tracker_of(profile: ObjectProfile) -> Float:
    """`T_object_tracker` (4, 4) of a file; a simulated one where not measured."""
    mounted = profile.T_object_tracker
    return SET_UP_TRACKER if mounted is None else np.array(mounted, dtype=np.float64)
