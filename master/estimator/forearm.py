"""The palm by an IMU that sits on the forearm, through a wrist that bends.

The IMU measures how the forearm lies in a world of its own, whose z axis is up; the hand hangs on it by the wrist:

    R_rig_palm = R_rig_world exp(tilt) R_z(heading) R_world_forearm R_forearm_palm(bend)

`imu.q_rig_world` states where up is in the rig. Tilt, heading and bend are unknowns of the estimator
(`master.estimator.extras`); here is what comes and goes: samples, sessions and clocks.

An IMU that restarts lies in a new world, and the heading begins anew. Mostly it shows: silent for a while, it begins
to count its drift again. If not, palms that contradict for long reveal it.
"""

from collections import Counter
from math import atan2, cos, hypot, isnan, nan, pi, sin, sqrt

import numpy as np

from common.arrays import Float
from common.calibration import ImuCalibration
from common.geometry.transforms import Wxyz, matrix_of, matrix_to_quaternion, quaternion_product
from common.hand.wrist_joint import wrist_quaternion
from master.estimator.epoch import OrientationMeasurement
from master.estimator.imu_samples import Between, OrientationSamples
from master.estimator.palm_imu import SURE_RAD, rotation_of
from master.estimator.settings import DEFAULT
from master.estimator.wrist_device import HEADING, TILT, WRIST_ANGLES

ANYWHERE_RAD = pi / sqrt(3.0)  # standard deviation of a uniform circle
LOST_RAD = 1.0  # a heading less sure than this may point anywhere
_PROCESS_NOISE2, _MOST2 = (
    np.radians([0.2, 5.0]) ** 2
)  # [rad^2/s] a heading walks at least and, unless evenly, at most
_EYE = np.eye(3)
NO_WORLD = np.full(4, np.nan), np.full(2, np.nan)


class Forearm:
    """Push machine. Holds the samples of an IMU, and since when palms contradict it.

    Attributes:
        lost: Whether the IMU began anew since `orientation_at` was asked.
        counts: `orientation.used`, epochs that had a sample, `orientation.absent`, those farther than 50 ms from any;
            samples rejected, as of `OrientationSamples`; `forearm.begun`, how often the heading began anew, and
            `forearm.outlier`, palms that contradicted it.
    """

    def __init__(self, imu: ImuCalibration, counts: Counter[str] | None = None) -> None:
        """Follow the IMU of a rig file, counting into `counts` if given.

        Raises:
            CalibrationError: The file does not state how it is mounted.
        """
        self.counts: Counter[str] = Counter() if counts is None else counts
        self._imu, self._imu_forearm = imu, _wxyz(rotation_of("q_palm_imu", imu.q_palm_imu).T)
        self._rig_world = (
            None if imu.q_rig_world is None else _wxyz(rotation_of("q_rig_world", imu.q_rig_world))
        )
        self._samples = OrientationSamples(self.counts, imu.heading_drift_rad_s, imu.stamp_offset_us)
        self._sample_ns, self._sample_drift_rad = 0, nan
        self._asked_ns: int | None = None
        self._drift_rad = 0.0
        self._contrary_ns: list[int] = []
        self.lost = False

    @property
    def placed(self) -> bool:
        """Return whether the file states where up is in the rig."""
        return self._rig_world is not None

    def push(self, t_ns: int, wxyz: Float, heading_sigma_rad: float = nan) -> None:
        """Take one sample of the IMU.

        The quaternion (4,) is IMU axes -> its world, and the heading drift is given if reported.
        """
        self._samples.push(t_ns, wxyz, heading_sigma_rad)
        if isnan(sum(wxyz.tolist())):
            return
        silent_s = 1e-9 * abs(t_ns - self._sample_ns)
        restarted_s = 0.25  # an IMU that begins anew is silent for longer, until it knows where up is
        if silent_s > restarted_s and heading_sigma_rad < self._sample_drift_rad:
            # A drift does not shrink in silence: the IMU counts from a new beginning, in a new world.
            self.lost, self._drift_rad = True, heading_sigma_rad
        self._sample_ns, self._sample_drift_rad = t_ns, heading_sigma_rad

    def orientation_at(self, t_ns: int, z: Float, z_cov: Float) -> OrientationMeasurement | None:
        """Return how the forearm rotates the palm at an epoch.

        None: no sample is near, or the rig does not place the IMU's world.

        Args:
            t_ns: The epoch.
            z, z_cov: The estimator's extras.
        """
        found = self._between(t_ns)
        if found is None or self._rig_world is None:
            return None
        process_noise = self._process_noise_rad2(t_ns, found)
        tilted, half_heading = self._tilted(self._rig_world, z), 0.5 * float(z[HEADING])
        heading = cos(half_heading), 0.0, 0.0, sin(half_heading)
        rotation = matrix_of(quaternion_product(quaternion_product(tilted, heading), self._forearm(found)))
        sigma = hypot(DEFAULT.strap_rad, DEFAULT.palm_process_noise_rad_s * found.away_s)
        axes = matrix_of(self._rig_world).T.copy()  # about x and y of the world the forearm tilts,
        axes[2] = matrix_of(tilted)[:, 2]  # about the estimated vertical it turns
        wide = (
            z_cov[HEADING, HEADING]
            + process_noise
            + np.trace(z_cov[WRIST_ANGLES : WRIST_ANGLES + 2, WRIST_ANGLES : WRIST_ANGLES + 2])
        )
        return OrientationMeasurement(
            rotation, _EYE / sigma**2, bool(wide < SURE_RAD**2), axes, process_noise
        )

    def heading_of(self, t_ns: int, R_rig_palm: Float, z: Float) -> float | None:
        """The heading that comes nearest to a palm (3, 3) [rad]; None: no sample is near."""
        found = self._samples.between(t_ns)
        if found is None or self._rig_world is None:
            return None
        flexion, deviation = z[WRIST_ANGLES : WRIST_ANGLES + 2].tolist()
        palm = matrix_of(quaternion_product(self._forearm(found), wrist_quaternion(flexion, deviation)))
        rotation = matrix_of(self._tilted(self._rig_world, z)).T @ R_rig_palm @ palm.T
        return atan2(rotation[1, 0] - rotation[0, 1], rotation[0, 0] + rotation[1, 1])

    def contradicted(self, t_ns: int, *, by_palm: bool) -> bool:
        """Note whether the palm contradicts the forearm at an epoch.

        Return whether it did so for long, and is right.
        """
        if not by_palm:
            self._contrary_ns.clear()
            return False
        self.counts["forearm.outlier"] += 1
        self._contrary_ns.append(t_ns)
        contrary_ns, contrary = 500_000_000, 5  # what contradicts for so long, and so often, is right
        long = abs(t_ns - self._contrary_ns[0]) > contrary_ns
        return long and len(self._contrary_ns) >= contrary

    def world_at(self, t_ns: int, wrist_angles_rad: Float, wrist_cov: Float) -> tuple[Float, Float]:
        """Return the palm orientation at a time in the IMU's own world.

        This needs no heading.

        Args:
            t_ns: The epoch.
            wrist_angles_rad, wrist_cov: (2,), (2, 2) of the wrist.

        Returns:
            Quaternion (4,), palm axes -> the IMU's world, and standard deviations (2,) [rad]: tilt per axis, heading;
            NaN: not known.
        """
        found = self._between(t_ns)
        if found is None:
            return NO_WORLD
        half_heading = DEFAULT.palm_process_noise_rad_s * found.away_s
        forearm, (flexion, deviation) = self._forearm(found), wrist_angles_rad.tolist()
        (ff, fd), (_, dd) = wrist_cov.tolist()
        c, s = cos(deviation), sin(deviation)
        # Along each axis of the world: what a flexion, about the forearm's x as it deviates, and a deviation leave.
        about = [(c * x - s * z, y) for x, y, z in matrix_of(forearm).tolist()]
        x, y, z = (u * u * ff + 2.0 * u * v * fd + v * v * dd for u, v in about)
        tilt = hypot(self._imu.orientation_sigma_rad, half_heading, sqrt(0.5 * (x + y)))
        heading = hypot(self._imu.heading_sigma_rad or 0.0, found.drift_rad, half_heading, sqrt(z))
        palm = np.array(quaternion_product(forearm, wrist_quaternion(flexion, deviation)))
        return -palm if palm[0] < 0.0 else palm, np.array([tilt, min(heading, ANYWHERE_RAD)])

    def _between(self, t_ns: int) -> Between | None:
        found = self._samples.between(t_ns)
        self.counts["orientation.absent" if found is None else "orientation.used"] += 1
        return found

    def _forearm(self, found: Between) -> Wxyz:
        """The forearm in the IMU's world."""
        return quaternion_product(found.q_wxyz, self._imu_forearm)

    @staticmethod
    def _tilted(rig_world: Wxyz, z: Float) -> Wxyz:
        """Return the IMU's world in the rig, tilted by the estimated tilt."""
        x, y = z[TILT : TILT + 2].tolist()
        angle = hypot(x, y)
        small_rad = 1e-9  # a tilt by less is taken as small
        share = sin(0.5 * angle) / angle if angle > small_rad else 0.5
        return quaternion_product(rig_world, (cos(0.5 * angle), share * x, share * y, 0.0))

    def _process_noise_rad2(self, t_ns: int, found: Between) -> float:
        """Variance [rad^2] of what the heading has drifted since the epoch before.

        Drifts that a filter reports are no walks: mostly an unknown bias, whose variance grows with the square
        of the time. Of a long silence that counts; from epoch to epoch it is a walk, of as much as can be followed.
        """
        since_s = 0.0 if self._asked_ns is None else 1e-9 * abs(t_ns - self._asked_ns)
        even_rad = abs(found.drift_rad - self._drift_rad)
        process_noise = found.drift_rad**2 - self._drift_rad**2
        if found.drift_rad >= ANYWHERE_RAD:  # as much as is ever reported
            even_rad, process_noise = max(even_rad, self._imu.heading_drift_rad_s * since_s), _MOST2 * since_s
        self._asked_ns, self._drift_rad = t_ns, found.drift_rad
        return float(max(even_rad**2, min(max(process_noise, _PROCESS_NOISE2 * since_s), _MOST2 * since_s)))


def _wxyz(rotation: Float) -> Wxyz:
    """The unit quaternion of a rotation (3, 3)."""
    w, x, y, z = matrix_to_quaternion(rotation).tolist()
    return w, x, y, z
