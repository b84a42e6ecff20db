"""Messages of senders: markers, wrist fingers, tags, IMU samples, tracker poses."""

from functools import cache
from math import nan
from typing import Annotated, TypeAlias

import numpy as np
from msgspec import Meta
from msgspec.structs import force_setattr

from common.arrays import Float, Ids
from common.messages.parts import (
    FINGER_COUNT,
    MAX_MARKERS,
    MAX_PICTURE,
    MAX_TAGS,
    Count,
    Layout,
    Message,
    Name,
    Pixels,
    SensedMetres,
    SigmaPx,
    TimeNs,
    TimeSigmaNs,
    UnitQuaternion,
    refuse_bad_quaternion,
    refuse_beyond,
    refuse_parts,
    refuse_sigma,
    within,
)


class MarkerDetections(Message, frozen=True, eq=False, tag=True):
    """What one camera saw in one frame.

    Attributes:
        camera: Camera name, a member of the rig's `cameras`.
        session: Random id of the sending process; a restart is a new session.
        seq: Frame counter of this camera; a gap is a dropped frame.
        t_ns: Middle of the exposure of row 0 [ns], sender's clock until `ingest`, then the master's.
        ready_t_ns: When the frame was handed to the slave [ns], same clock as `t_ns`.
        uv: Marker centroids (M, 2) [px], distorted image, (0, 0) = centre of the top-left pixel.
        area: Blob areas (M,) [px^2].
        quality: Probability (M,) 0..1 that what was found is the marker.
        sigma_px: Standard deviation per axis (M,) [px] of `uv` as the centroid of all that the camera would see of the
            whole marker: noise, uncertainty from occlusion, size. Positive where `uv` is seen, NaN elsewhere.
        alt_uv: (M, 2) [px], as `uv`: a second place of the same colour, where the slave could not exclude that this is
            the marker. NaN: none, the usual case. Only where `uv` is seen. A row that is NaN in all was not seen.
        t_sigma_ns: Standard deviation of `t_ns` [ns]: of the sender's stamp until `ingest`, with that of the clock
            conversion afterwards. 0: exact, or not known (a recording).
    """

    camera: Name
    session: Count
    seq: Count
    t_ns: TimeNs
    ready_t_ns: TimeNs
    uv: Pixels
    area: Annotated[Float, within(0.0, MAX_PICTURE**2)]
    quality: Annotated[Float, within(0.0, 1.0)]
    sigma_px: SigmaPx
    alt_uv: Pixels
    t_sigma_ns: TimeSigmaNs = 0.0

    def __post_init__(self) -> None:
        m = len(self.area)
        if m > MAX_MARKERS:
            raise ValueError(f"{m} markers, at most {MAX_MARKERS}")
        if self.alt_uv.size == 0:
            force_setattr(self, "alt_uv", nowhere(m))
        _marker_arrays(m).freeze(self)
        refuse_sigma(self, "sigma_px", "uv")
        if self.alt_uv is nowhere(m):
            return
        refuse_parts(self, "alt_uv")
        if not np.isnan(self.alt_uv[np.isnan(self.uv[:, 0])]).all():
            raise ValueError("alt_uv: an alternative to a marker that is not seen")

    @property
    def has_alternatives(self) -> bool:
        """Return whether any marker has an alternative."""
        return self.alt_uv is not nowhere(len(self.area)) and not bool(np.isnan(self.alt_uv).all())


class WristDetections(Message, frozen=True, eq=False, tag=True):
    """Detections of a wrist device's camera in one strobe cycle: ambient, laser, LED.

    Fingers thumb ... little. Pixels are of the distorted image, (0, 0) = centre of the top-left pixel; NaN: not seen.

    Attributes:
        camera: Camera name, the rig's only one.
        session: Random id of the sending process; a restart is a new session.
        seq: Frame counter of the laser frame. It rises by more than one from strobe cycle to strobe cycle.
        t_ns: Middle of the exposure of row 0 of the laser frame [ns], sender's clock until `ingest`, then the
            master's.
        ready_t_ns: When the last frame of the strobe cycle was handed to the slave [ns], same clock as `t_ns`.
        laser_uv: (5, 2) centroids of the part of the laser line that lies on each finger and is seen.
        laser_sigma_px: (5,) their standard deviation per axis; positive where `laser_uv` is seen, NaN elsewhere.
        laser_px: (5,) length of that part in the image.
        tip_uv: (5, 2) fingertips.
        tip_sigma_px: (5,) their standard deviation per axis; positive where `tip_uv` is seen, NaN elsewhere.
        tip_depth: (5,) distance of the fingertips by the fall-off of the LED light, relative: the unit is the rig's
            own and constant, not the metre.
        t_sigma_ns: Standard deviation of `t_ns` [ns], as in `MarkerDetections`.
        exposure_us: Exposure time [us] of the frames; 0: not known.
    """

    camera: Name
    session: Count
    seq: Count
    t_ns: TimeNs
    ready_t_ns: TimeNs
    laser_uv: Pixels
    laser_sigma_px: SigmaPx
    laser_px: Annotated[Float, within(0.0, 2 * MAX_PICTURE)]
    tip_uv: Pixels
    tip_sigma_px: SigmaPx
    tip_depth: Annotated[Float, within(0.0, 1e6)]
    t_sigma_ns: TimeSigmaNs = 0.0
    exposure_us: Annotated[float, Meta(ge=0.0, le=1e7)] = 0.0

    def __post_init__(self) -> None:
        _CYCLE_ARRAYS.freeze(self)
        for uv, sigma in (("laser_uv", "laser_sigma_px"), ("tip_uv", "tip_sigma_px")):
            refuse_sigma(self, sigma, uv)


class TagDetections(Message, frozen=True, eq=False, tag=True):
    """Fiducial tags (AprilTag, ArUco) that one camera found in one frame.

    Not every frame needs to be searched.

    Attributes:
        camera: Camera name, a member of the rig's `cameras`.
        session: Random id of the sending process; a restart is a new session.
        seq: Frame counter of this camera; it may rise by more than one.
        t_ns: Middle of the exposure of row 0 [ns], sender's clock until `ingest`, then the master's.
        ready_t_ns: When the frame was handed to the slave [ns], same clock as `t_ns`.
        ids: (N,) their numbers in the family, rising.
        uv: (N, 4, 2) corners [px], distorted image, (0, 0) = centre of the top-left pixel; of the tag as printed top
            left, top right, bottom right, bottom left.
        sigma_px: (N,) standard deviation per axis of the corners.
        t_sigma_ns: Standard deviation of `t_ns` [ns], as in `MarkerDetections`.
    """

    camera: Name
    session: Count
    seq: Count
    t_ns: TimeNs
    ready_t_ns: TimeNs
    ids: Ids
    uv: Pixels
    sigma_px: SigmaPx
    t_sigma_ns: TimeSigmaNs = 0.0

    def __post_init__(self) -> None:
        n = len(self.ids)
        if n > MAX_TAGS:
            raise ValueError(f"{n} tags, at most {MAX_TAGS}")
        _tag_arrays(n).freeze(self)
        if (self.ids[1:] <= self.ids[:-1]).any():
            raise ValueError("ids: must rise, each once")
        if np.isnan(self.uv).any() or np.isnan(self.sigma_px).any():
            raise ValueError("uv, sigma_px: a tag that was found has corners and a positive sigma")


class TrackerPose(Message, frozen=True, eq=False, tag=True):
    """Pose of a device that tracks itself, as the device reports it.

    In its system's own frame, for example a Vive tracker under Lighthouse.

    Attributes:
        source: Name of the device, the `tracker` of an object file.
        session: Random id of the sending process; a restart is a new session.
        seq: Pose counter of this device; a gap is a dropped pose.
        t_ns: When the pose holds [ns], sender's clock until `ingest`, then the master's.
        position_m: (3,) of the device [m], frame of its system. NaN: it has lost itself.
        orientation_wxyz: (4,) quaternion, device axes -> its system's. NaN: it has lost itself.
    """

    source: Name
    session: Count
    seq: Count
    t_ns: TimeNs
    position_m: SensedMetres
    orientation_wxyz: UnitQuaternion

    def __post_init__(self) -> None:
        _TRACKER_ARRAYS.freeze(self)
        refuse_parts(self, "position_m")
        refuse_bad_quaternion(self, "orientation_wxyz")


class ImuSample(Message, frozen=True, eq=False, tag=True):
    """Measurement of one inertial sensor at one time, in its own axes.

    NaN: it has no such sensor, or no value.

    Attributes:
        source: Name of the sensor, that of the rig's `imu`.
        session: Random id of the sending process; a restart is a new session.
        seq: Sample counter of this sensor; a gap is a dropped sample.
        t_ns: When it was measured [ns], sender's clock until `ingest`, then the master's.
        gyro_rad_s: Angular velocity (3,) [rad/s].
        accel_m_s2: Specific force (3,) [m/s^2]: at rest it points up, 9.81 long.
        mag_ut: Magnetic field (3,) [uT].
        orientation_wxyz: (4,) quaternion, sensor axes -> the sensor's world, whose z axis is vertical.
        heading_sigma_rad: Standard deviation of what its turn about the vertical has drifted since its beginning,
            which was anywhere [rad]. NaN: the source of the orientation does not report it.
    """

    source: Name
    session: Count
    seq: Count
    t_ns: TimeNs
    gyro_rad_s: Annotated[Float, within(-200.0, 200.0)]
    accel_m_s2: Annotated[Float, within(-5000.0, 5000.0)]
    mag_ut: Annotated[Float, within(-1e5, 1e5)]
    orientation_wxyz: UnitQuaternion
    heading_sigma_rad: Annotated[float, within(0.0, 1e3)] = nan

    def __post_init__(self) -> None:
        _IMU_ARRAYS.freeze(self)
        refuse_bad_quaternion(self, "orientation_wxyz")
        refuse_beyond(self, "heading_sigma_rad")


Detections: TypeAlias = MarkerDetections | WristDetections  # what a camera sends, of either kind


@cache
def nowhere(markers: int) -> Float:
    """Empty alternatives (M, 2) for markers of which none has one; read-only."""
    nowhere = np.full((markers, 2), np.nan)
    nowhere.flags.writeable = False
    return nowhere


@cache
def _marker_arrays(m: int) -> Layout:
    return Layout(MarkerDetections, uv=(m, 2), area=(m,), quality=(m,), sigma_px=(m,), alt_uv=(m, 2))


@cache
def _tag_arrays(n: int) -> Layout:
    return Layout(TagDetections, ids=(n,), uv=(n, 4, 2), sigma_px=(n,))


_CYCLE_ARRAYS = Layout(
    WristDetections,
    laser_uv=(FINGER_COUNT, 2),
    laser_sigma_px=(FINGER_COUNT,),
    laser_px=(FINGER_COUNT,),
    tip_uv=(FINGER_COUNT, 2),
    tip_sigma_px=(FINGER_COUNT,),
    tip_depth=(FINGER_COUNT,),
)
_TRACKER_ARRAYS = Layout(TrackerPose, position_m=(3,), orientation_wxyz=(4,))
_IMU_ARRAYS = Layout(ImuSample, gyro_rad_s=(3,), accel_m_s2=(3,), mag_ut=(3,), orientation_wxyz=(4,))
