"""Tracker line of one object: device poses in, object pose in the rig out.

    T_rig_object(t) = T_rig_tracking T_tracking_device(t) inv(T_object_tracker)

The device tracks itself: each of its poses is one of the object, at its own time, which is the stamp and
`stamp_offset_us`. Its covariance is the registration's: what was left of it against the cameras, which has
the device's jitter and the cameras' errors in it, and its own; both are of the object's own frame, the lever
included.

**It has lost itself**, or its base stations: the last pose is held, ever less sure, for half a second; then
there is none. **It leaps**, as it does by a mirror: a pose that no hand could have carried it to is passed
over, unless it stays there. Nothing measures how the pose misses anything, so `residual_m` is NaN.
"""

from collections import Counter

import numpy as np
from msgspec.structs import replace

from common.arrays import Float
from common.calibration import RigCalibration
from common.calibration.object_profile import ObjectProfile
from common.errors import CalibrationError
from common.geometry.transforms import invert, matrix_to_quaternion, quaternion_to_matrix, rigid
from common.messages import ObjectPose, ObjectSource, TrackerPose
from master.objects.line import HELD_S, SolvedObject, no_pose

# of a registration without figures, such as one made by hand
_UNKNOWN_M, _UNKNOWN_RAD = 5e-3, np.radians(1.5)


def registered(profile: ObjectProfile, rig: RigCalibration) -> bool:
    """Whether an object has a tracker whose poses mean something in the rig."""
    known = profile.T_object_tracker is not None and rig.T_rig_tracking is not None
    return profile.tracker is not None and known


class TrackerLine:
    """Push machine: one tracker's device poses to object poses.

    Holds the last pose, since when there is none, and a leap that is not accepted yet. Counts poses that were
    `lost`, and those passed over as a `leap`, or because they were `late` or `broken`.
    """

    def __init__(self, profile: ObjectProfile, rig: RigCalibration) -> None:
        """Set up an object with a tracker; the rig defines where the tracking lies.

        Raises:
            CalibrationError: The tracker is not registered yet.
        """
        if profile.tracker is None or profile.T_object_tracker is None or rig.T_rig_tracking is None:
            missing = "T_rig_tracking" if rig.T_rig_tracking is None else "T_object_tracker"
            raise CalibrationError(
                f"object {profile.name!r}: its tracker {profile.tracker!r} is not registered to rig {rig.name!r},"
                f" {missing} is missing: phalanx calibrate tracker {profile.name}"
            )
        self.name, self.source = profile.name, profile.tracker
        self._T_rig_tracking = np.array(rig.T_rig_tracking, dtype=np.float64)
        self._T_device_object = invert(np.array(profile.T_object_tracker, dtype=np.float64))
        self._late_ns = round(1e3 * profile.stamp_offset_us)
        self._cov = covariance_of(profile)
        self._last: ObjectPose | None = None
        self._session: int | None = None
        self._newest_ns: int | None = None
        self._leapt: tuple[int, Float] | None = None  # when the leap began, and where
        self.counts: Counter[str] = Counter()

    def push(self, message: TrackerPose) -> list[SolvedObject]:
        """Take a device pose on the master's clock; return the object's, if not late.

        Raises:
            ValueError: It is of another device.
        """
        if message.source != self.source:
            raise ValueError(f"tracker {message.source!r}, this is the line of {self.source!r}")
        if message.session != self._session:  # its clock, or its system, may be another one
            self._session, self._newest_ns = message.session, None
        t_ns = message.t_ns + self._late_ns
        if self._newest_ns is not None and t_ns <= self._newest_ns:
            self.counts["late"] += 1
            return []
        self._newest_ns = t_ns
        pose = self._measured(t_ns, message)
        return [SolvedObject(self._held(t_ns) if pose is None else pose, message.t_ns)]

    def _measured(self, t_ns: int, message: TrackerPose) -> ObjectPose | None:
        """Return the object's pose; None: tracking is lost, or the report impossible."""
        place, quaternion = message.position_m, message.orientation_wxyz
        if np.isnan(place).any() or np.isnan(quaternion).any():
            self.counts["lost"] += 1
            return None
        unit_within = 1e-2
        if abs(float(np.linalg.norm(quaternion)) - 1.0) > unit_within:
            self.counts["broken"] += 1
            return None
        T = self._T_rig_tracking @ rigid(quaternion_to_matrix(quaternion), place) @ self._T_device_object
        if self._leaps(t_ns, T[:3, 3]):
            self.counts["leap"] += 1
            return None
        self._last = ObjectPose(
            object=self.name,
            t_ns=t_ns,
            position_m=T[:3, 3],
            orientation_wxyz=matrix_to_quaternion(T[:3, :3]),
            cov=self._cov,
            residual_m=float("nan"),
            source=ObjectSource.TRACKER,
            tracked=True,
            seen=1,
            expected=1,
            occluded=False,
        )
        return self._last

    def _leaps(self, t_ns: int, place_m: Float) -> bool:
        """Check for a leap that no hand could make; after a while it is accepted."""
        if self._last is None:
            return False
        way = float(np.linalg.norm(place_m - self._last.position_m))
        since_s = max(1e-9 * (t_ns - self._last.t_ns), 1e-3)
        # a leap: farther and faster than that; and how long it is doubted
        leap_m, leap_m_s, leap_s = 0.08, 8.0, 0.15
        if self._leapt is not None:
            leapt_ns, where = self._leapt
            recent = 0 <= t_ns - leapt_ns < round(1e9 * leap_s)
            if recent and way > leap_m and np.linalg.norm(place_m - where) < way:
                return True
            self._leapt = None
            if not recent:
                return False
        if way > leap_m and way > leap_m_s * since_s:
            self._leapt = t_ns, place_m
            return True
        return False

    def _held(self, t_ns: int) -> ObjectPose:
        """Where it was, for a while; then nowhere."""
        last = self._last
        since_s = np.inf if last is None else 1e-9 * (t_ns - last.t_ns)
        if last is None or not 0.0 <= since_s <= HELD_S:
            return no_pose(self.name, t_ns, expected=1, occluded=True)
        wanders_m_s, wanders_rad_s = 0.3, 2.0  # what a held pose may have become wrong by
        spread = np.repeat([wanders_m_s * since_s, wanders_rad_s * since_s], 3) ** 2
        return replace(
            last,
            t_ns=t_ns,
            cov=self._cov + np.diag(spread),
            source=ObjectSource.HELD,
            tracked=False,
            seen=0,
            occluded=True,
        )


def covariance_of(profile: ObjectProfile) -> Float:
    """Return a tracked pose's covariance (6, 6), by the figures of its registration."""
    how = profile.provenance.get("T_object_tracker")
    residual = {} if how is None else how.residual
    place_m = np.hypot(residual.get("position_mm", 0.0), residual.get("position_sigma_mm", 0.0)) * 1e-3
    rotation_rad = np.radians(
        np.hypot(residual.get("rotation_deg", 0.0), residual.get("rotation_sigma_deg", 0.0))
    )
    # The figures are of the whole offset: a third of its square belongs to each axis.
    place_m = place_m / np.sqrt(3.0) if place_m > 0.0 else _UNKNOWN_M
    rotation_rad = rotation_rad / np.sqrt(3.0) if rotation_rad > 0.0 else _UNKNOWN_RAD
    return np.diag(np.repeat([place_m, rotation_rad], 3) ** 2)
