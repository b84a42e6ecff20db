"""Messages that cross a process boundary. Arrays are read-only; NaN means "not seen".

On the wire a message is one msgpack map; an array is its little-endian bytes, so that NaN
travels as itself and a message costs no Python loop. Rivals of markers are rare, and none at
all travel as no bytes: so the detections of 24 markers fit one Ethernet packet. `decode` is
the only way in: whatever it returns has the right shapes and no infinity. Every field is
described in docs/wire.md.
"""

from copy import copy
from enum import IntEnum
from functools import cache
from math import inf, isinf, nan
from typing import Annotated, Literal, TypeAlias, TypeVar, cast

import msgspec
import numpy as np
from msgspec import Meta, Struct, field

from common.arrays import Bool, Code, Float, Ids
from common.errors import MessageError

WIRE_VERSION = 11
MAX_MARKERS = 48
MAX_TAGS = 16  # in one frame: their corners fit one Ethernet packet
JOINT_COUNT = 26
FINGER_COUNT = 5
MAX_PREVIEW_BYTES = 256 * 1024
MAX_STILL_BYTES = 900 * 1024
MAX_BODY_CHARACTERS = 64 * 1024
MAX_CHECKS = 64

# The look-ahead: in Python `$` also matches before a final line feed, and names become keys and file names.
Name = Annotated[str, Meta(min_length=1, max_length=64, pattern=r"^[A-Za-z0-9_.-]+(?!\n)$")]
Count = Annotated[int, Meta(ge=0, le=2**63 - 1)]
TimeNs = Annotated[int, Meta(ge=-(2**63), le=2**63 - 1)]
Finite = Annotated[float, Meta(ge=-1e18, le=1e18)]


class Source(IntEnum):
    """Where the pose of one joint comes from."""

    NONE = 0
    MEASURED = 1
    SOLVED = 2
    HELD = 3
    WRIST = 4


class Level(IntEnum):
    """What a wrist device solved a finger from (Digits, UIST 2012: two levels)."""

    NONE = 0
    FK = 1
    IK = 2


class ObjectSource(IntEnum):
    """What the pose of an object comes from."""

    NONE = 0
    MARKERS = 1
    TAGS = 2
    TRACKER = 3
    HELD = 4


GestureKind = Literal["pose", "pinch", "dial", "tap", "point"]
Phase = Literal["begin", "update", "end"]
CheckCode = Literal[
    "camera_absent",
    "auto_mode",
    "exposure_drift",
    "colour_collision",
    "marker_unseen",
    "background_in_range",
    "calibration_absent",
    "calibration_stale",
    "camera_moved",
    "clock_unsynchronised",
    "packet_loss",
    "rate_low",
    "too_hot",
    "disk_full",
    "strobe_slipped",
    "imu_silent",
    "twin_sender",
    "version_mismatch",
    "secret_mismatch",
]


class Message(Struct, frozen=True, eq=False, forbid_unknown_fields=True, tag_field="type"):
    """Base of all messages: immutable, tagged with its own name, unknown fields refused."""


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
        quality: Confidence (M,) in 0..1: 1 is a whole, unambiguous, well exposed marker.
        sigma_px: Standard deviation per axis (M,) [px] of `uv` as the centroid of all that the camera would see of
            the whole marker: noise, doubt of occlusion, size. Positive where `uv` is seen, NaN elsewhere.
        rival_uv: (M, 2) [px], as `uv`: a second place of the same colour, where the slave could not exclude that
            this is the marker. NaN: none, the usual case. Only where `uv` is seen.
            A row that is NaN in all was not seen.
        t_sigma_ns: Standard deviation of `t_ns` [ns]: of the sender's stamp until `ingest`, with that of the clock
            conversion afterwards. 0: exact, or not known (a recording).
    """

    camera: Name
    session: Count
    seq: Count
    t_ns: TimeNs
    ready_t_ns: TimeNs
    uv: Float
    area: Float
    quality: Float
    sigma_px: Float
    rival_uv: Float
    t_sigma_ns: Annotated[float, Meta(ge=0.0, le=1e18)] = 0.0

    def __post_init__(self) -> None:
        m = len(self.area)
        if m > MAX_MARKERS:
            raise ValueError(f"{m} markers, at most {MAX_MARKERS}")
        _freeze(self, "uv", np.float64, (m, 2))
        _freeze(self, "area", np.float64, (m,))
        _freeze(self, "quality", np.float64, (m,))
        _freeze(self, "sigma_px", np.float64, (m,))
        # A list is faster than numpy for so few.
        for u, sigma in zip(self.uv[:, 0].tolist(), self.sigma_px.tolist(), strict=True):
            if (u != u) != (sigma != sigma) or sigma <= 0.0:
                raise ValueError("sigma_px: must be positive where uv is seen and NaN elsewhere")
        if self.rival_uv.size == 0:
            msgspec.structs.force_setattr(self, "rival_uv", _nowhere(m))
            return
        _freeze(self, "rival_uv", np.float64, (m, 2))
        if not np.isnan(self.rival_uv[np.isnan(self.uv[:, 0])]).all():
            raise ValueError("rival_uv: a rival of a marker that is not seen")

    @property
    def has_rivals(self) -> bool:
        """Whether a marker has a rival."""
        return self.rival_uv is not _nowhere(len(self.area)) and not bool(np.isnan(self.rival_uv).all())


class WristDetections(Message, frozen=True, eq=False, tag=True):
    """What the camera of a wrist device saw in one strobed triple (ambient, laser, LED), fingers thumb ... little.

    Pixels are of the distorted image, (0, 0) = centre of the top-left pixel; NaN: not seen.

    Attributes:
        camera: Camera name, the rig's only one.
        session: Random id of the sending process; a restart is a new session.
        seq: Frame counter of the laser frame. It rises by more than one from triple to triple.
        t_ns: Middle of the exposure of row 0 of the laser frame [ns], sender's clock until `ingest`, then the master's.
        ready_t_ns: When the last frame of the triple was handed to the slave [ns], same clock as `t_ns`.
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
    laser_uv: Float
    laser_sigma_px: Float
    laser_px: Float
    tip_uv: Float
    tip_sigma_px: Float
    tip_depth: Float
    t_sigma_ns: Annotated[float, Meta(ge=0.0, le=1e18)] = 0.0
    exposure_us: Annotated[float, Meta(ge=0.0, le=1e9)] = 0.0

    def __post_init__(self) -> None:
        for name in ("laser_uv", "tip_uv"):
            _freeze(self, name, np.float64, (FINGER_COUNT, 2))
        for name in ("laser_sigma_px", "laser_px", "tip_sigma_px", "tip_depth"):
            _freeze(self, name, np.float64, (FINGER_COUNT,))
        for what, uv, sigma in (
            ("laser", self.laser_uv, self.laser_sigma_px),
            ("tip", self.tip_uv, self.tip_sigma_px),
        ):
            unseen = np.isnan(uv).any(axis=1)
            if (np.isnan(sigma) != unseen).any() or (sigma <= 0.0).any():
                raise ValueError(
                    f"{what}_sigma_px: must be positive where {what}_uv is seen and NaN elsewhere"
                )


class TagDetections(Message, frozen=True, eq=False, tag=True):
    """The fiducial tags (AprilTag, ArUco) that one camera found in one frame. Not every frame needs to be searched.

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
    uv: Float
    sigma_px: Float
    t_sigma_ns: Annotated[float, Meta(ge=0.0, le=1e18)] = 0.0

    def __post_init__(self) -> None:
        n = len(self.ids)
        if n > MAX_TAGS:
            raise ValueError(f"{n} tags, at most {MAX_TAGS}")
        _freeze(self, "ids", np.uint16, (n,))
        _freeze(self, "uv", np.float64, (n, 4, 2))
        _freeze(self, "sigma_px", np.float64, (n,))
        if (self.ids[1:] <= self.ids[:-1]).any():
            raise ValueError("ids: must rise, each once")
        if np.isnan(self.uv).any() or not (self.sigma_px > 0.0).all():
            raise ValueError("uv, sigma_px: a tag that was found has corners and a positive sigma")


class TrackerPose(Message, frozen=True, eq=False, tag=True):
    """Where a device that tracks itself (a Vive tracker under Lighthouse) says it is, in its system's own frame.

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
    position_m: Float
    orientation_wxyz: Float

    def __post_init__(self) -> None:
        _freeze(self, "position_m", np.float64, (3,))
        _freeze(self, "orientation_wxyz", np.float64, (4,))


class ImuSample(Message, frozen=True, eq=False, tag=True):
    """What one inertial sensor measured at one instant, in its own axes. NaN: it has no such sensor, or no value.

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
            which was anywhere [rad]. NaN: who made the orientation does not say.
    """

    source: Name
    session: Count
    seq: Count
    t_ns: TimeNs
    gyro_rad_s: Float
    accel_m_s2: Float
    mag_ut: Float
    orientation_wxyz: Float
    heading_sigma_rad: float = nan

    def __post_init__(self) -> None:
        _freeze(self, "gyro_rad_s", np.float64, (3,))
        _freeze(self, "accel_m_s2", np.float64, (3,))
        _freeze(self, "mag_ut", np.float64, (3,))
        _freeze(self, "orientation_wxyz", np.float64, (4,))
        if self.heading_sigma_rad < 0.0 or isinf(self.heading_sigma_rad):
            raise ValueError(f"heading_sigma_rad: {self.heading_sigma_rad}: must be 0 or more, or NaN")


class HandPose(Message, frozen=True, eq=False, tag=True):
    """One hand at one instant, in the joint order of XR_EXT_hand_tracking (26 joints).

    Attributes:
        hand: Name of the hand profile.
        t_ns: The instant at which the pose holds [ns], master's clock.
        position_m: Joint positions (26, 3) [m], rig frame.
        orientation_wxyz: Joint orientations (26, 4), unit quaternions, joint -> rig frame,
            OpenXR axes (-z along the bone to the tip, +y dorsal).
        radius_m: Joint radii (26,) [m].
        valid: (26,) the pose of the joint may be used.
        tracked: (26,) the joint is observed now, not inferred. Tracked implies valid.
        cov_m2: Position covariance (26, 3, 3) [m^2], rig frame. NaN: unknown.
        source: (26,) `Source` codes.
        angles_rad: (5, 4) [rad]: abduction, flexion (MCP; thumb CMC), PIP (thumb MCP),
            DIP (thumb IP), zero in the profile's rest pose.
        markers_m: Filtered cap centroids (M, 3) [m], rig frame. NaN: not seen.
        markers_raw_m: The same before the filter.
        markers_cov_m2: Covariances (M, 3, 3) [m^2] of `markers_raw_m`, rig frame. NaN: not seen.
        inside_volume: (26,) the joint lies in the volume that the rig states; all True where it states none. Outside,
            accuracy is not known; that alone does not clear `valid`.
        latency_ns: From the hand-over of the last contributing frame to its slave, to
            the publication of this pose [ns]; 0 in an offline run.
        laser_m: (5, 3) where the laser of a wrist device meets thumb ... little [m], frame of its camera. NaN: not
            seen, or no such device.
        level: (5,) `Level` codes: what a wrist device solved each finger from.
        ambiguous: (5,) another pose of the finger explains what the wrist device saw as well; this is the one that
            fits the past, or habit.
        palm_world_wxyz: (4,) quaternion, palm axes -> the world of the IMU on a wrist device, whose z axis is
            vertical. NaN: not known, or no such device.
        palm_world_sigma_rad: (2,) its standard deviations: tilt against the vertical per axis, heading about it.
        wrist_bend_rad: (2,) flexion and deviation of the wrist between a device on the forearm and the palm
            (`common.wrist_bend`). NaN: no such device, or nothing tells.
        wrist_bend_sigma_rad: (2,) their standard deviations.
    """

    hand: Name
    t_ns: TimeNs
    position_m: Float
    orientation_wxyz: Float
    radius_m: Float
    valid: Bool
    tracked: Bool
    cov_m2: Float
    source: Code
    angles_rad: Float
    markers_m: Float
    markers_raw_m: Float
    markers_cov_m2: Float
    inside_volume: Bool
    latency_ns: TimeNs = 0
    laser_m: Float = field(default_factory=lambda: _NO_LASER)
    level: Code = field(default_factory=lambda: _NO_LEVEL)
    ambiguous: Bool = field(default_factory=lambda: _NOT_AMBIGUOUS)
    palm_world_wxyz: Float = field(default_factory=lambda: _NO_ROTATION)
    palm_world_sigma_rad: Float = field(default_factory=lambda: _NO_SIGMA)
    wrist_bend_rad: Float = field(default_factory=lambda: _NO_SIGMA)
    wrist_bend_sigma_rad: Float = field(default_factory=lambda: _NO_SIGMA)

    def __post_init__(self) -> None:
        j = JOINT_COUNT
        m = self.markers_m.size // 3
        if m > MAX_MARKERS:
            raise ValueError(f"{m} markers, at most {MAX_MARKERS}")
        _freeze(self, "position_m", np.float64, (j, 3))
        _freeze(self, "orientation_wxyz", np.float64, (j, 4))
        _freeze(self, "radius_m", np.float64, (j,))
        _freeze(self, "valid", np.bool_, (j,))
        _freeze(self, "tracked", np.bool_, (j,))
        _freeze(self, "cov_m2", np.float64, (j, 3, 3))
        _freeze(self, "source", np.uint8, (j,))
        if self.source.max() > max(Source):
            raise ValueError(f"source: {self.source.max()} is no Source code")
        _freeze(self, "angles_rad", np.float64, (FINGER_COUNT, 4))
        _freeze(self, "markers_m", np.float64, (m, 3))
        _freeze(self, "markers_raw_m", np.float64, (m, 3))
        _freeze(self, "markers_cov_m2", np.float64, (m, 3, 3))
        _freeze(self, "inside_volume", np.bool_, (j,))
        _freeze(self, "laser_m", np.float64, (FINGER_COUNT, 3))
        _freeze(self, "level", np.uint8, (FINGER_COUNT,))
        if self.level.max() > max(Level):
            raise ValueError(f"level: {self.level.max()} is no Level code")
        _freeze(self, "ambiguous", np.bool_, (FINGER_COUNT,))
        _freeze(self, "palm_world_wxyz", np.float64, (4,))
        _freeze(self, "palm_world_sigma_rad", np.float64, (2,))
        _freeze(self, "wrist_bend_rad", np.float64, (2,))
        _freeze(self, "wrist_bend_sigma_rad", np.float64, (2,))


class ObjectPose(Message, frozen=True, eq=False, tag=True):
    """One rigid object at one instant.

    Attributes:
        object: Name of the object file.
        t_ns: The instant at which the pose holds [ns], master's clock.
        position_m: (3,) of the object's own frame [m], rig frame. NaN: never seen yet, or not for long.
        orientation_wxyz: (4,) unit quaternion, object axes -> rig frame. NaN with the position.
        cov: (6, 6) of position [m] and of a small turn about the rig's axes [rad]. NaN: unknown.
        residual_m: Root mean square by which what was measured misses the object in this pose [m]. NaN: not measured.
        source: `ObjectSource` code.
        tracked: The pose is measured now, not held.
        seen: How many of its features (markers, tags) the pose rests on.
        expected: How many would be seen by some camera, as it is turned, with nothing before it.
        occluded: Something hides a part of it: fewer are seen than expected.
        latency_ns: From the hand-over of the last contributing frame to its slave, to the publication of this pose
            [ns]; 0 in an offline run.
    """

    object: Name
    t_ns: TimeNs
    position_m: Float
    orientation_wxyz: Float
    cov: Float
    residual_m: float
    source: Annotated[int, Meta(ge=0, le=int(max(ObjectSource)))]
    tracked: bool
    seen: Annotated[int, Meta(ge=0, le=MAX_MARKERS)]
    expected: Annotated[int, Meta(ge=0, le=MAX_MARKERS)]
    occluded: bool
    latency_ns: TimeNs = 0

    def __post_init__(self) -> None:
        _freeze(self, "position_m", np.float64, (3,))
        _freeze(self, "orientation_wxyz", np.float64, (4,))
        _freeze(self, "cov", np.float64, (6, 6))
        if self.residual_m < 0.0 or isinf(self.residual_m):
            raise ValueError(f"residual_m: {self.residual_m}: must be 0 or more, or NaN")


class Contact(Message, frozen=True, eq=False, tag=True):
    """How near a hand is to an object, and where it touches it.

    Attributes:
        hand: Name of the hand profile.
        object: Name of the object file.
        t_ns: The instant [ns], that of the hand's pose, master's clock.
        distance_m: (5,) from the skin of the last segment of thumb ... little to the surface of the object [m],
            negative inside. NaN: finger or object is not known.
        sigma_m: (5,) standard deviations of these.
        point_m: (5, 3) the point of the object's surface that is nearest to each [m], rig frame.
        touching: (5,) the finger touches: with hysteresis, so that it does not flicker.
        palm_distance_m: From the palm's skin to the surface [m].
        held: The hand has a grip of it: the thumb or the palm, and a finger against them.
    """

    hand: Name
    object: Name
    t_ns: TimeNs
    distance_m: Float
    sigma_m: Float
    point_m: Float
    touching: Bool
    palm_distance_m: float
    held: bool

    def __post_init__(self) -> None:
        _freeze(self, "distance_m", np.float64, (FINGER_COUNT,))
        _freeze(self, "sigma_m", np.float64, (FINGER_COUNT,))
        _freeze(self, "point_m", np.float64, (FINGER_COUNT, 3))
        _freeze(self, "touching", np.bool_, (FINGER_COUNT,))
        if isinf(self.palm_distance_m):
            raise ValueError("palm_distance_m: infinite value")


class Gesture(Message, frozen=True, eq=False, tag=True):
    """What a hand says. One that lasts begins, is repeated with every pose of the hand, and ends.

    Attributes:
        hand: Name of the hand profile.
        t_ns: The instant [ns], that of the hand's pose, master's clock.
        kind: `pose` (the hand is held in a shape), `pinch` (thumb and a finger), `dial` (a grip that turns), `tap`
            (the thumb on a part of a finger; begins and ends in one message of phase `end`), `point` (a ray).
        name: Which one: the pose (open_palm, counting_two, pointing, small_grasp, large_grasp, pinch, or one that was
            taught); of a pinch the finger; of a tap the key (0 ... 9, star, hash); else the kind again.
        phase: begin, update, end.
        began_t_ns: When it began [ns], same clock as `t_ns`.
        confidence: 0..1.
        distance_m: Of a pinch: between the skin of thumb and finger [m].
        strength: Of a pinch: 0 (open) .. 1 (closed).
        angle_rad: Of a dial: by how much it was turned since it began, clockwise as the user sees the back of the hand.
        origin_m: (3,) of a pointing ray [m], rig frame; of a pinch the middle between the two; of a dial its centre.
        direction: (3,) unit vector of a pointing ray, rig frame; of a dial its axis.
    """

    hand: Name
    t_ns: TimeNs
    kind: GestureKind
    name: Name
    phase: Phase
    began_t_ns: TimeNs
    confidence: Annotated[float, Meta(ge=0.0, le=1.0)]
    distance_m: float = nan
    strength: float = nan
    angle_rad: float = nan
    origin_m: Float = field(default_factory=lambda: _NO_POINT)
    direction: Float = field(default_factory=lambda: _NO_POINT)

    def __post_init__(self) -> None:
        _freeze(self, "origin_m", np.float64, (3,))
        _freeze(self, "direction", np.float64, (3,))
        for name in ("distance_m", "strength", "angle_rad"):
            if isinf(getattr(self, name)):
                raise ValueError(f"{name}: infinite value")


class Health(Message, frozen=True, eq=False, tag=True):
    """What a process counted since it started.

    Attributes:
        source: Process name: a camera, or "master".
        session: Random id of the process.
        t_ns: Moment of the report [ns], clock of the source.
        counts: Event name -> how often (frames, dropped, refused by reason, ...).
        gauges: Quantity name with its unit -> value now (rate_hz, offset_us, ...).
        host: Name of the machine that the process runs on; empty: not told.
        version: Of the program; empty: not told.
    """

    source: Name
    session: Count
    t_ns: TimeNs
    counts: Annotated[dict[Name, Count], Meta(max_length=512)]
    gauges: Annotated[dict[Name, Finite], Meta(max_length=512)]
    host: Annotated[str, Meta(max_length=64)] = ""
    version: Annotated[str, Meta(max_length=64)] = ""


class CheckItem(Struct, frozen=True, forbid_unknown_fields=True):
    """One thing that is not as it should be.

    Attributes:
        code: Which kind; programs go by it.
        subject: Whose: a camera, an IMU, a camera and its marker (`left.index`), a process.
        sentence: What is wrong, for a person.
        fix: What to do.
    """

    code: CheckCode
    subject: Name
    sentence: Annotated[str, Meta(min_length=1, max_length=500)]
    fix: Annotated[str, Meta(min_length=1, max_length=500)]


class Checklist(Message, frozen=True, eq=False, tag=True):
    """All that is not as it should be at one instant; empty: all is well.

    Attributes:
        source: Process name: "master".
        session: Random id of the process.
        t_ns: Moment of the report [ns], clock of the source.
        items: Each code and subject once, in the order of `CheckCode`, then of subjects.
    """

    source: Name
    session: Count
    t_ns: TimeNs
    items: Annotated[tuple[CheckItem, ...], Meta(max_length=MAX_CHECKS)]


class Command(Message, frozen=True, eq=False, tag=True):
    """An order to one process, answered by a `Health` of that process.

    Attributes:
        target: Process name.
        verb: What to do; each process documents its verbs ("report", "stop").
        body: What the verb needs, as JSON; empty for most.
    """

    target: Name
    verb: Name
    body: Annotated[str, Meta(max_length=MAX_BODY_CHARACTERS)] = ""


class Backlog(Message, frozen=True, eq=False, tag=True):
    """How far behind a master is that records, from the message on that it shows next until it says otherwise.

    Attributes:
        source: Process name: "master".
        t_ns: When that message was there [ns], master's clock.
        leave_out: How many instants of each hand are left out between two that are solved; 0: it is not behind.
    """

    source: Name
    t_ns: TimeNs
    leave_out: Annotated[int, Meta(ge=0, le=64)]


class Preview(Message, frozen=True, eq=False, tag=True):
    """What a camera sees, small, for the eyes of whoever asked. Nothing is measured in it.

    Attributes:
        camera: Camera name.
        t_ns: Middle of the exposure of row 0 [ns], sender's clock.
        jpeg: A whole JPEG file of the view, usually of half the camera's width and height.
    """

    camera: Name
    t_ns: TimeNs
    jpeg: Annotated[bytes, Meta(max_length=MAX_PREVIEW_BYTES)]

    def __post_init__(self) -> None:
        if len(self.jpeg) > MAX_PREVIEW_BYTES or not self.jpeg.startswith(_JPEG_START):
            raise ValueError(f"jpeg: {len(self.jpeg)} bytes, expected a JPEG of at most {MAX_PREVIEW_BYTES}")


class Still(Message, frozen=True, eq=False, tag=True):
    """One whole frame of a camera, on request: what the cameras themselves are calibrated from.

    Attributes:
        camera: Camera name.
        seq: Frame counter of this camera.
        t_ns: Middle of the exposure of row 0 [ns], sender's clock.
        jpeg: A whole JPEG file of the camera's width and height.
    """

    camera: Name
    seq: Count
    t_ns: TimeNs
    jpeg: Annotated[bytes, Meta(max_length=MAX_STILL_BYTES)]

    def __post_init__(self) -> None:
        if len(self.jpeg) > MAX_STILL_BYTES or not self.jpeg.startswith(_JPEG_START):
            raise ValueError(f"jpeg: {len(self.jpeg)} bytes, expected a JPEG of at most {MAX_STILL_BYTES}")


Detections: TypeAlias = MarkerDetections | WristDetections  # what a camera sends, of either kind
Told: TypeAlias = HandPose | ObjectPose | Contact | Gesture  # what a master makes of it
AnyMessage: TypeAlias = (
    MarkerDetections
    | WristDetections
    | TagDetections
    | TrackerPose
    | ImuSample
    | HandPose
    | ObjectPose
    | Contact
    | Gesture
    | Health
    | Checklist
    | Command
    | Backlog
    | Preview
    | Still
)

MessageT = TypeVar("MessageT", bound=Message)

_JPEG_START = b"\xff\xd8\xff"
_INFINITE = np.array(inf).tobytes(), np.array(-inf).tobytes()  # there is one of each sign, unlike NaN
_NONE = np.empty((0, 2))
_NO_LASER = np.full((FINGER_COUNT, 3), np.nan)
_NO_LEVEL = np.zeros(FINGER_COUNT, dtype=np.uint8)
_NOT_AMBIGUOUS = np.zeros(FINGER_COUNT, dtype=np.bool_)
_NO_ROTATION, _NO_SIGMA, _NO_POINT = np.full(4, np.nan), np.full(2, np.nan), np.full(3, np.nan)
for _nothing in (_NO_LASER, _NO_LEVEL, _NOT_AMBIGUOUS, _NO_ROTATION, _NO_SIGMA, _NO_POINT):
    _nothing.flags.writeable = False
_ENCODER = msgspec.msgpack.Encoder(enc_hook=lambda array: _to_bytes(array))
_DECODER = msgspec.msgpack.Decoder(
    MarkerDetections
    | WristDetections
    | TagDetections
    | TrackerPose
    | ImuSample
    | HandPose
    | ObjectPose
    | Contact
    | Gesture
    | Health
    | Checklist
    | Command
    | Backlog
    | Preview
    | Still,
    dec_hook=lambda kind, raw: _from_bytes(kind, raw),
)


def encode(message: Message) -> bytes:
    """Return the message as msgpack bytes."""
    if isinstance(message, MarkerDetections) and not message.has_rivals:
        message = copy(message)
        msgspec.structs.force_setattr(message, "rival_uv", _NONE)
    return _ENCODER.encode(message)


def decode(data: bytes | memoryview) -> AnyMessage:
    """Return the message in `data`.

    Raises:
        MessageError: The bytes are not exactly one message of ours: broken msgpack,
            unknown type or field, wrong shape, an infinity, a number out of range.
    """
    try:
        return cast(AnyMessage, _DECODER.decode(data))
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise MessageError(f"not a message: {error}") from error


def restamped(message: MessageT, **numbers: float) -> MessageT:
    """The same message with other numbers in these fields, as times are; neither they nor its arrays are checked again.

    `msgspec.structs.replace` looks at every array once more, which costs more than all else that becomes of a message
    on its way in.
    """
    message = copy(message)
    for name, number in numbers.items():
        msgspec.structs.force_setattr(message, name, number)
    return message


def _to_bytes(array: object) -> bytes:
    if not isinstance(array, np.ndarray):
        raise NotImplementedError(f"cannot encode {type(array)}")
    return np.ascontiguousarray(cast(Float | Bool | Code | Ids, array)).tobytes()


_WIRE_DTYPE = {Float: np.dtype("<f8"), Bool: np.dtype("?"), Code: np.dtype("u1"), Ids: np.dtype("<u2")}


def _from_bytes(kind: type, raw: object) -> object:
    if not isinstance(raw, bytes):
        raise ValueError("array is not bytes")
    dtype = _WIRE_DTYPE[kind]
    if len(raw) % dtype.itemsize:
        raise ValueError("array is cut")
    if dtype.kind == "b" and raw.translate(None, b"\0\1"):
        raise ValueError("truth value is neither 0 nor 1")
    return np.frombuffer(raw, dtype)


@cache
def _nowhere(markers: int) -> Float:
    """The rivals of so many markers of which none has one, (M, 2), read-only; at most 49 are ever made."""
    nowhere = np.full((markers, 2), np.nan)
    nowhere.flags.writeable = False
    return nowhere


def _freeze(message: Message, field: str, dtype: type[np.generic], shape: tuple[int, ...]) -> None:
    """Give `field` its shape, refuse an infinity, and make it read-only (copied if it was not)."""
    given = getattr(message, field)
    array = np.asarray(given, dtype=dtype)
    if array.shape != shape:
        try:
            array = array.reshape(shape)
        except ValueError as error:
            raise ValueError(f"{field}: shape {array.shape}, expected {shape}") from error
    if dtype is np.float64 and _infinite(array):
        raise ValueError(f"{field}: infinite value")
    if array.flags.writeable:
        array = array.copy()
        array.flags.writeable = False
    if array is not given:
        msgspec.structs.force_setattr(message, field, array)


def _infinite(array: np.ndarray) -> bool:
    """Whether there is an infinity; its bytes are looked for first, for that takes a tenth of the time."""
    raw = array.tobytes()
    return any(sign in raw for sign in _INFINITE) and bool(np.isinf(array).any())
