"""How the palm lies at any instant by an IMU on it: its own orientation, mounted and placed, and how sure that is.

An IMU tells its axes in a world of its own, whose z axis is vertical:

    R_rig_palm = R_rig_world R_world_imu R_palm_imu^T

Two of the three numbers are held by gravity: the tilt against the vertical. The third, the heading about it, is only
summed up from angular rates and drifts, unless a magnetometer holds it. So the covariance is narrow across the vertical
and wide about it. A heading of which nothing is known is taken from the hand as it was solved, and left to it.
"""

from collections import Counter, deque
from dataclasses import dataclass
from math import atan2

import numpy as np

from common.arrays import Float
from common.calibration import UNIT_WITHIN, ImuCalibration, Quaternion
from common.errors import CalibrationError
from common.geometry import matrix_to_quaternion, quaternion_to_matrix, rotation_vector_to_matrix
from master.ik.hand import HandSolution
from master.ik.palm import Orientation

REACH_NS = 50_000_000  # farther from an instant a sample tells nothing of it
_KEPT = 512  # half a second of the fastest sensors; instants lie at most two camera periods behind
_TURN_RAD_S = 3.0  # as fast as a palm turns unseen: `Priors.palm_walk_rad_s`
_LOST_RAD = 1.0  # a heading less sure than this may point anywhere (a uniform circle has 1.8)
_FREE_RAD = 10.0  # tells nothing beside any marker
_STRAIGHT = 1e-9  # sine of an angle below which an arc is a straight line


@dataclass(frozen=True, slots=True, eq=False)
class _Sample:
    t_ns: int
    q_wxyz: Float


class OrientationTrack:
    """Push machine. Holds the newest samples of one IMU, and when it was first heard.

    Attributes:
        counts: `orientation.used`, instants that had one, `orientation.absent`, those that had none; samples left out:
            `orientation.missing`, `orientation.not_unit`, `orientation.late`.
    """

    def __init__(self, imu: ImuCalibration, counts: Counter[str] | None = None) -> None:
        """Follow the IMU of a rig file, counting into `counts` if given.

        Raises:
            CalibrationError: The file does not say how it is mounted, or how its world lies to the rig.
        """
        self._imu = imu
        self._palm_imu = _known("q_palm_imu", imu.q_palm_imu)
        self._rig_world = _known("q_rig_world", imu.q_rig_world)
        self._up = self._rig_world[:, 2]
        self.counts: Counter[str] = Counter() if counts is None else counts
        self._samples: deque[_Sample] = deque(maxlen=_KEPT)
        self._first_ns: int | None = None

    def push(self, t_ns: int, orientation_wxyz: Float) -> None:
        """Take one sample: quaternion (4,), IMU axes -> its world, q as good as -q.

        What is no rotation is left out. A sample long before the newest means that a clock was set back, or that the
        newest came from a time that is not yet: the others are forgotten.
        """
        length = float(np.linalg.norm(orientation_wxyz))
        if np.isnan(length):
            self.counts["orientation.missing"] += 1
        elif abs(length - 1.0) > UNIT_WITHIN:
            self.counts["orientation.not_unit"] += 1
        else:
            if self._samples and t_ns <= (newest_ns := self._samples[-1].t_ns):
                if newest_ns - t_ns <= REACH_NS:
                    self.counts["orientation.late"] += 1
                    return
                self._samples.clear()
            self._first_ns = t_ns if self._first_ns is None else min(self._first_ns, t_ns)
            self._samples.append(_Sample(t_ns, orientation_wxyz / length))

    def at(self, t_ns: int, near: HandSolution | None) -> Orientation | None:
        """The palm's orientation at an instant; None where no sample is near enough.

        Args:
            t_ns: The instant.
            near: The hand as it was solved, which gives the heading where the IMU has none; None: not known.
        """
        found = self._between(t_ns)
        heading_rad = self._heading_rad(t_ns)
        if found is None or (heading_rad is None and near is None):
            self.counts["orientation.absent"] += 1
            return None
        self.counts["orientation.used"] += 1
        q, away_s = found
        rotation = self._rig_world @ quaternion_to_matrix(q) @ self._palm_imu.T
        if heading_rad is None and near is not None:
            rotation = _turn_about(self._up, near.T_rig_palm[:3, :3] @ rotation.T) @ rotation
        tilt_2 = self._imu.orientation_sigma_rad**2 + (_TURN_RAD_S * away_s) ** 2
        about_2 = max((_FREE_RAD if heading_rad is None else heading_rad) ** 2, tilt_2)
        return Orientation(rotation, tilt_2 * np.eye(3) + (about_2 - tilt_2) * np.outer(self._up, self._up))

    def _heading_rad(self, t_ns: int) -> float | None:
        """Standard deviation of the heading; None: not known."""
        sigma, since_ns = self._imu.heading_sigma_rad, self._first_ns
        if sigma is None or since_ns is None:
            return None
        drift = self._imu.heading_drift_rad_s * max(t_ns - since_ns, 0) * 1e-9
        grown = float(np.hypot(sigma, drift))
        return grown if grown < _LOST_RAD else None

    def _between(self, t_ns: int) -> tuple[Float, float] | None:
        """Quaternion at an instant, and how far from samples that is [s]; None: too far.

        The times to both sides count as resistors in parallel do: with one side alone it is the time to that.
        """
        before: _Sample | None = None
        after: _Sample | None = None
        for sample in reversed(self._samples):
            if sample.t_ns <= t_ns:
                before = sample
                break
            after = sample
        if before is not None and t_ns - before.t_ns > REACH_NS:
            before = None
        if after is not None and after.t_ns - t_ns > REACH_NS:
            after = None
        if before is not None and after is not None:
            a, b = t_ns - before.t_ns, after.t_ns - t_ns
            return slerp(before.q_wxyz, after.q_wxyz, a / (a + b)), 1e-9 * a * b / (a + b)
        one = before or after
        return None if one is None else (one.q_wxyz, 1e-9 * abs(t_ns - one.t_ns))


def slerp(first: Float, second: Float, share: float) -> Float:
    """Unit quaternion (4,) on the shorter arc between two, at `share` 0...1 of the way (Shoemake, 1985)."""
    cosine = float(first @ second)
    other = second if cosine >= 0.0 else -second
    angle = np.arccos(min(abs(cosine), 1.0))
    sine = np.sin(angle)
    if sine < _STRAIGHT:
        return first
    return (np.sin((1.0 - share) * angle) * first + np.sin(share * angle) * other) / sine


def _turn_about(axis: Float, rotation: Float) -> Float:
    """The turn (3, 3) about a unit axis (3,) that comes nearest to a rotation (3, 3): its twist."""
    w, *v = matrix_to_quaternion(rotation)
    return rotation_vector_to_matrix(2.0 * atan2(float(np.array(v) @ axis), float(w)) * axis)


def _known(key: str, value: Quaternion | None) -> Float:
    if value is None:
        raise CalibrationError(
            f"imu.{key}: missing; the orientation of the IMU cannot be used without: a quaternion wxyz of length 1"
        )
    return quaternion_to_matrix(np.array(value))
