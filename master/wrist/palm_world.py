"""How the palm of a wrist device lies against the vertical: the IMU's orientation at an instant, as it is mounted.

Camera, IMU and palm are one body: the device is strapped to the forearm. So the palm's turn in the IMU's world is

    R_world_palm = R_world_imu R_palm_imu^T

at the instant of a pose.
"""

from collections import Counter, deque

import numpy as np

from common.arrays import Float
from common.calibration import ImuCalibration
from common.errors import CalibrationError
from common.geometry import matrix_to_quaternion, quaternion_to_matrix
from master.ik.orientation import REACH_NS, slerp

_KEPT = 512
_NONE = np.full(4, np.nan), np.full(2, np.nan)


class PalmWorld:
    """Push machine. Holds the newest samples of one IMU, and when it was first heard.

    Attributes:
        counts: `orientation.used`, instants that had one, `orientation.absent`, those that had none.
    """

    def __init__(self, imu: ImuCalibration, counts: Counter[str] | None = None) -> None:
        """Follow the IMU of a rig file, counting into `counts` if given.

        Raises:
            CalibrationError: The file does not say how it is mounted.
        """
        if imu.q_palm_imu is None:
            raise CalibrationError(
                "imu.q_palm_imu: missing; without it nobody knows how the IMU lies on the palm"
            )
        self._imu, self._palm_imu = imu, quaternion_to_matrix(np.array(imu.q_palm_imu))
        self.counts: Counter[str] = Counter() if counts is None else counts
        self._samples: deque[tuple[int, Float]] = deque(maxlen=_KEPT)
        self._first_ns: int | None = None

    def push(self, t_ns: int, wxyz: Float) -> None:
        """Take one sample: quaternion (4,), IMU axes -> its world; NaN: it does not know."""
        if not np.isfinite(wxyz).all():
            self.counts["orientation.missing"] += 1
            return
        self._first_ns = t_ns if self._first_ns is None else self._first_ns
        self._samples.append((t_ns, wxyz / np.linalg.norm(wxyz)))

    def at(self, t_ns: int) -> tuple[Float, Float]:
        """Palm axes -> the IMU's world (4,), and its standard deviations (2,) [rad]: tilt per axis, heading."""
        before = next((one for one in reversed(self._samples) if one[0] <= t_ns), None)
        after = next((one for one in self._samples if one[0] > t_ns), before)
        before = before or after
        if before is None or after is None or min(abs(t_ns - before[0]), abs(t_ns - after[0])) > REACH_NS:
            self.counts["orientation.absent"] += 1
            return _NONE
        self.counts["orientation.used"] += 1
        span = after[0] - before[0]
        wxyz = slerp(before[1], after[1], (t_ns - before[0]) / span) if span > 0 else before[1]
        drifted = self._imu.heading_drift_rad_s * max(t_ns - (self._first_ns or t_ns), 0) * 1e-9
        palm = quaternion_to_matrix(wxyz) @ self._palm_imu.T
        heading = float(np.hypot(self._imu.heading_sigma_rad or 0.0, drifted))
        return matrix_to_quaternion(palm), np.array([self._imu.orientation_sigma_rad, heading])
