"""A rig file places its cameras, IMU and wrist device.

What belongs to a wrist device is in the frame of its camera (OpenCV axes).
"""

import math
from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Annotated, Literal, get_args

import numpy as np
from msgspec import Meta
from msgspec.structs import replace

from common.arrays import Float
from common.calibration.files import (
    UNIT_WITHIN,
    Angle,
    Direction,
    Frequency,
    Length,
    Matrix4,
    NonNegative,
    Part,
    Provenance,
    Quaternion,
    Rate,
    StampOffset,
    Vector3,
    check_quaternion,
)
from common.calibration.hand import Finger, HandProfile, Side
from common.calibration.object_profile import check_pose
from common.calibration.strobe import StrobeCalibration, check_strobe
from common.errors import CalibrationError
from common.messages import MAX_MARKERS, Name

FLAT_FIELD_TERMS = (1, 3, 6, 10, 15, 21, 28)  # of polynomials in two variables, by degree
Reach = Annotated[float, Meta(ge=-1.0, le=1.0)]  # [m] the device sees the fingers of the hand that wears it
Place = tuple[Reach, Reach, Reach]
Coefficient = Annotated[float, Meta(ge=-1e6, le=1e6)]


LASER_ACROSS = (
    0.2  # by which a direction may leave the laser's plane: 12 degrees, far more than a line is bent
)


class LaserPlane(Part, frozen=True):
    """Plane normal . X = offset in the wrist camera's frame."""

    normal: Direction
    offset_m: Reach


class Laser(Part, frozen=True):
    """Laser line of the wrist device, as far as known, in the wrist camera's frame."""

    origin: Place | None = None
    forward: Direction | None = None
    right: Direction | None = None
    fan_rad: Annotated[float, Meta(ge=1e-3, le=math.pi)] | None = None
    baseline: Annotated[float, Meta(ge=1e-4, le=1.0)] | None = None


class FlatField(Part, frozen=True):
    """Relative brightness of a uniformly white surface across the image; axis: 1.

    The surface is at one distance, seen along its normal. A polynomial in the normalised image point
    (x, y) = (X / Z, Y / Z); `coefficients` of 1, x, y, x^2, x y, y^2, x^3, x^2 y, ..., every degree whole.
    """

    coefficients: Annotated[tuple[Coefficient, ...], Meta(min_length=1, max_length=FLAT_FIELD_TERMS[-1])]


class FingerLine(Part, frozen=True):
    """Line along which the laser point of one finger moves during flexion.

    Attributes:
        origin_m: A point of the line, where the finger is straightest.
        direction: Unit vector, the principal axis of motion, towards what a bent finger reflects.
        range_m: How far along it the finger's points lie, from the straightest to the most bent.
        residual_m: RMS distance of the points from the line.
    """

    origin_m: Place
    direction: Direction
    range_m: tuple[Reach, Reach]
    residual_m: Annotated[float, Meta(ge=0.0, le=1.0)]


def check_wrist(
    plane: LaserPlane | None, laser: Laser | None, lines: Mapping[str, FingerLine], where: str
) -> None:
    """Refuse what the types alone cannot: CalibrationError with `where` and the key."""
    directions = {
        "laser_plane.normal": None if plane is None else plane.normal,
        "laser.forward": None if laser is None else laser.forward,
        "laser.right": None if laser is None else laser.right,
    }
    min_offset_m = 1e-3  # of the laser's plane from the camera: nearer, it measures no depth
    if plane is not None and abs(plane.offset_m) < min_offset_m:
        raise CalibrationError(
            f"{where}: laser_plane.offset_m: {plane.offset_m:g}, the plane runs through the camera, which then sees no"
            f" depth on it; it is {min_offset_m:g} or more to either side"
        )
    for key, way in directions.items():
        if way is not None and abs(math.hypot(*way) - 1.0) > UNIT_WITHIN:
            raise CalibrationError(f"{where}: {key}: length {math.hypot(*way):.4g}, not 1")
        if way is None or plane is None or not key.startswith("laser."):
            continue
        leaves = abs(sum(a * b for a, b in zip(plane.normal, way, strict=True)))
        if leaves > LASER_ACROSS:
            raise CalibrationError(f"{where}: {key}: leaves laser_plane by {leaves:.2f} of its length")
    for finger, line in lines.items():
        if finger not in get_args(Finger):
            raise CalibrationError(
                f"{where}: finger_lines: {finger!r} is none of {', '.join(get_args(Finger))}"
            )
        if abs((length := math.hypot(*line.direction)) - 1.0) > UNIT_WITHIN:
            raise CalibrationError(f"{where}: finger_lines.{finger}.direction: length {length:.4g}, not 1")
        if line.range_m[0] >= line.range_m[1]:
            raise CalibrationError(f"{where}: finger_lines.{finger}.range_m: must rise")


def check_flat_field(field: FlatField | None, where: str) -> None:
    """Refuse a polynomial that is not whole: CalibrationError with `where`, the key."""
    if field is not None and len(field.coefficients) not in FLAT_FIELD_TERMS:
        raise CalibrationError(
            f"{where}: flat_field.coefficients: {len(field.coefficients)} of them; a polynomial of whole degrees has"
            f" {', '.join(map(str, FLAT_FIELD_TERMS))}"
        )


Markers = Annotated[tuple[Name, ...], Meta(min_length=1, max_length=MAX_MARKERS)]

# [m px] Baseline times focal length, from 0.1 mm and 10 px to 100 m and 1e7 px.
DepthFactor = Annotated[float, Meta(ge=1e-3, le=1e9)]
Drift = Annotated[float, Meta(ge=0.0, le=10.0)]  # [rad/s] far more than the bias of any gyroscope


class PowerLawCalibration(Part, frozen=True):
    """Depth D = k x^z with x = u_left - u_right [px] (Kalbfleisch's corrected depth)."""

    k_m: DepthFactor
    z: Annotated[float, Meta(ge=-3.0, le=-0.1)]


class AffineDisparityCalibration(Part, frozen=True):
    """Disparity x = a / D + x0 [px]."""

    a_m_px: DepthFactor
    x0_px: Annotated[float, Meta(ge=-32768.0, le=32768.0)]


class FilterCalibration(Part, frozen=True):
    """1 € filter of the hand and its markers.

    Cut-off at rest, its rise per speed [Hz per m/s], and the cut-off of the speed. `jitter_m`: what may be left of the
    noise of each signal at rest; noisier ones are filtered more.
    """

    min_cutoff_hz: Frequency = 10.0
    beta: NonNegative = 3000.0
    d_cutoff_hz: Frequency = 2.5
    jitter_m: Length = 3e-4


class Volume(Part, frozen=True):
    """A box in the rig frame, sides along its axes: where the rig was tested."""

    low_m: Vector3
    high_m: Vector3


class ImuCalibration(Part, frozen=True):
    """IMU fixed to the palm; its orientation is used if mounting and world are known.

    `q_palm_imu`: quaternion wxyz, its axes -> palm frame. `q_rig_world`: its world, whose z axis is vertical -> rig
    frame. `orientation_sigma_rad`: per axis, of the tilt against the vertical. `heading_sigma_rad`: of the turn about
    the vertical, which drifts by `heading_drift_rad_s`; null: not known at all, as without a magnetometer.
    `stamp_offset_us`: how much later its samples were taken than their stamps state.
    """

    name: Name = "imu"
    rate_hz: Rate = 120.0
    q_palm_imu: Quaternion | None = None
    q_rig_world: Quaternion | None = None
    orientation_sigma_rad: Angle = math.radians(2.0)
    heading_sigma_rad: Angle | None = None
    heading_drift_rad_s: Drift = 0.0
    stamp_offset_us: StampOffset = 0.0

    @property
    def placed(self) -> bool:
        """Whether its orientation determines that of the palm in the rig."""
        return self.q_palm_imu is not None and self.q_rig_world is not None


class RigCalibration(Part, frozen=True):
    """rigs/<name>.json: which cameras, where, which markers, depth model, whose hand.

    `free_markers` are those of `markers` that sit on no hand: they are placed and filtered, no hand is fitted to them.
    `objects`: files of the objects that are tracked; their markers are free ones. `T_rig_tracking`: where the frame of
    a system whose devices track themselves (Lighthouse) lies in the rig. `gestures`: file of what counts as a gesture;
    null: as calib_json/gestures/default.json has it.
    `solver`: whose hand is published: that of the card's line (fabrik), or that which the estimator makes from there.
    `other_hands`: hands of its markers besides `hand`; each marker is that of the hand whose file mounts it, and
    `left_thumb` the `thumb` of the left hand. Hands painted alike have the same colour ranges in the camera files.
    `T_world_rig`: where the rig lies in the frame that several rigs share; null: its frame is that one.
    `stamp_offset_us`: how much later the frames of a camera were taken than their stamps state.
    From `laser_plane` on, the keys of a wrist rig, in its camera's frame; `forward`: how the place of the laser on a
    finger becomes its flexion, by the table of this hand or by the cubic printed in the paper; `finger_lines`: finger
    -> the line along which its laser point moves. `solver_mode`: fingers from the laser alone, by joint coupling (fk),
    from laser and fingertip, without a tip not at all (ik), or from what there is (auto). `strobe`: laser and LEDs as
    lights, and how long they may shine.
    """

    version: Literal[1]
    name: Name
    kind: Literal["markers", "wrist"]
    cameras: Annotated[tuple[Name, ...], Meta(min_length=1, max_length=32)]
    hand: Name
    markers: Markers = ("thumb", "index", "middle", "ring", "little", "back")
    free_markers: tuple[Name, ...] = ()
    objects: tuple[Name, ...] = ()
    other_hands: tuple[Name, ...] = ()
    T_rig_camera: dict[Name, Matrix4] = {}
    T_world_rig: Matrix4 | None = None
    T_rig_tracking: Matrix4 | None = None
    gestures: Name | None = None
    depth_model: Literal["power_law", "affine_disparity", "stereo"] = "stereo"
    power_law: PowerLawCalibration | None = None
    affine_disparity: AffineDisparityCalibration | None = None
    solver: Literal["estimator", "fabrik"] = "estimator"
    frame_sync: Literal["interpolate", "predict"] = "interpolate"
    filter: FilterCalibration = FilterCalibration()
    volume: Volume | None = None
    stamp_offset_us: dict[Name, StampOffset] = {}
    provenance: dict[str, Provenance] = {}
    laser_plane: LaserPlane | None = None
    laser: Laser | None = None
    T_camera_palm: Matrix4 | None = None
    led: Annotated[tuple[Vector3, ...], Meta(max_length=64)] | None = None
    flat_field: FlatField | None = None
    finger_lines: dict[Name, FingerLine] = {}
    forward: Literal["table", "cubic"] = "table"
    solver_mode: Literal["fk", "ik", "auto"] = "auto"
    imu: ImuCalibration | None = None
    strobe: StrobeCalibration | None = None

    def camera_pose(self, camera: str) -> Float:
        """`T_rig_camera` (4, 4) [m]; the frame of a wrist rig is its camera's.

        Raises:
            CalibrationError: The rig's places are not measured yet.
        """
        if self.kind == "wrist":
            return np.eye(4)
        if camera not in self.T_rig_camera:
            raise CalibrationError(
                f"rig {self.name!r}: T_rig_camera: camera {camera!r} has no place yet, which"
                " `phalanx calibrate cameras stereo` measures"
            )
        return np.array(self.T_rig_camera[camera], dtype=np.float64)


def check_rig(rig: RigCalibration, where: str) -> None:
    """Refuse keys that contradict each other: CalibrationError with `where`, the key."""
    for key in ("cameras", "markers", "objects"):
        if len(set(getattr(rig, key))) != len(getattr(rig, key)):
            raise CalibrationError(f"{where}: {key}: a name stands twice")
    for key, whole in (("free_markers", "markers"), ("stamp_offset_us", "cameras")):
        if others := set(getattr(rig, key)) - set(getattr(rig, whole)):
            raise CalibrationError(f"{where}: {key}: {min(others)!r} is not one of {whole}")
    if rig.volume is not None and any(
        a >= b for a, b in zip(rig.volume.low_m, rig.volume.high_m, strict=True)
    ):
        raise CalibrationError(f"{where}: volume: low_m must be below high_m in every axis")
    if rig.imu is not None:
        _check_imu(rig.imu, rig.cameras, where)
    check_wrist(rig.laser_plane, rig.laser, rig.finger_lines, where)
    check_flat_field(rig.flat_field, where)
    check_strobe(rig.strobe, None if rig.laser is None else rig.laser.fan_rad, where)
    if rig.kind == "wrist":
        if len(rig.cameras) != 1:
            raise CalibrationError(f"{where}: cameras: a wrist device has one, not {len(rig.cameras)}")
        if rig.T_camera_palm is not None:
            check_pose(np.array(rig.T_camera_palm), f"{where}: T_camera_palm")
        for key in ("other_hands", "T_world_rig", "objects", "T_rig_tracking"):
            if getattr(rig, key):
                raise CalibrationError(f"{where}: {key}: of marker rigs; a wrist device is worn by one hand")
        return
    if len({rig.hand, *rig.other_hands}) != 1 + len(rig.other_hands):
        raise CalibrationError(f"{where}: other_hands: a hand stands twice")
    for key, pose in (("T_world_rig", rig.T_world_rig), ("T_rig_tracking", rig.T_rig_tracking)):
        if pose is not None:
            check_pose(np.array(pose), f"{where}: {key}")
    # None at all: a rig that is still to be measured.
    for camera in rig.cameras if rig.T_rig_camera else ():
        if camera not in rig.T_rig_camera:
            raise CalibrationError(f"{where}: T_rig_camera: camera {camera!r} is missing")
        check_pose(rig.camera_pose(camera), f"{where}: T_rig_camera.{camera}")
    check_places(rig, where)
    if rig.depth_model != "stereo" and getattr(rig, rig.depth_model) is None:
        raise CalibrationError(
            f"{where}: depth_model is {rig.depth_model!r} but the key {rig.depth_model!r} is missing: set depth_model"
            f" to 'stereo' until `phalanx calibrate depth --use {rig.depth_model}` has fitted it"
        )


def check_places(rig: RigCalibration, where: str) -> None:
    """Refuse cameras in one place, whose rays have no depth (CalibrationError)."""
    centres = [(name, rig.camera_pose(name)[:3, 3]) for name in rig.cameras if name in rig.T_rig_camera]
    for (one, a), (other, b) in combinations(centres, 2):
        min_baseline_m = 1e-3  # no two lenses fit into less
        if (apart := math.dist(a, b)) < min_baseline_m:
            raise CalibrationError(
                f"{where}: T_rig_camera.{other}: {1e3 * apart:.2g} mm from camera {one!r}; two cameras are at least"
                f" {1e3 * min_baseline_m:g} mm apart"
            )


def _check_imu(imu: ImuCalibration, cameras: tuple[str, ...], where: str) -> None:
    if imu.name in cameras:
        raise CalibrationError(
            f"{where}: imu.name: {imu.name!r} is a camera; every sender has a name of its own"
        )
    for key, value in (("q_palm_imu", imu.q_palm_imu), ("q_rig_world", imu.q_rig_world)):
        if value is not None:
            check_quaternion(value, f"{where}: imu.{key}")


def unsided(marker: str) -> str:
    """The marker on any hand: `thumb` of `left_thumb`; they may be painted alike."""
    side, _, name = marker.partition("_")
    return name if name and side in get_args(Side) else marker


def painted_alike(markers: Sequence[str]) -> dict[str, str]:
    """Marker -> the first that may be painted like it: itself, or another hand's."""
    return {marker: next(one for one in markers if unsided(one) == unsided(marker)) for marker in markers}


def rigs_by_hand(
    rig: RigCalibration, hands: Mapping[str, HandProfile]
) -> list[tuple[str, RigCalibration, tuple[int, ...]]]:
    """Split a rig into (hand, the rig for that hand alone, its rows of the markers).

    A rig with `other_hands` watches several; each of its markers is that of the hand that mounts it. `left_thumb` is
    the `thumb` of the left hand, and is called so in the rig for that hand; `right_thumb` likewise. Free markers and
    objects stay with its first hand.

    Raises:
        CalibrationError: A marker is mounted by none of the hands or by two, or a hand mounts none.
    """
    if len(hands) == 1:
        return [(rig.hand, rig, tuple(range(len(rig.markers))))]
    owners: dict[str, dict[str, str]] = {marker: {} for marker in rig.markers}
    for name, hand in hands.items():
        for mounted in hand.markers:
            sided = f"{hand.side}_{mounted}"
            owners.get(sided if sided in owners else mounted, {})[name] = mounted
    owners |= {marker: {rig.hand: marker} for marker in rig.free_markers}
    for marker, named in owners.items():
        if len(named) != 1:
            who = " and ".join(named) or f"none of {', '.join(hands)}"
            raise CalibrationError(
                f"rig {rig.name!r}: other_hands: marker {marker!r} is mounted by {who}; each is of one hand"
            )
    parts: list[tuple[str, RigCalibration, tuple[int, ...]]] = []
    for name in hands:
        chosen = tuple(m for m, marker in enumerate(rig.markers) if name in owners[marker])
        if not chosen:
            raise CalibrationError(f"rig {rig.name!r}: other_hands: {name!r} mounts none of its markers")
        own = replace(
            rig,
            hand=name,
            other_hands=(),
            markers=tuple(owners[rig.markers[m]][name] for m in chosen),
            free_markers=rig.free_markers if name == rig.hand else (),
            objects=rig.objects if name == rig.hand else (),
        )
        parts.append((name, own, chosen))
    return parts


def terms_of(xy: Float, degree: int) -> Float:
    """Polynomial terms (..., T) at normalised image points (..., 2), see `FlatField`."""
    x, y = xy[..., 0], xy[..., 1]
    return np.stack([x ** (d - k) * y**k for d in range(degree + 1) for k in range(d + 1)], axis=-1)


def field_at(field: FlatField, xy: Float) -> Float:
    """The polynomial (...) at normalised image points (..., 2)."""
    return terms_of(xy, FLAT_FIELD_TERMS.index(len(field.coefficients))) @ np.array(field.coefficients)


def flat_of(field: FlatField, xy: Float) -> Float:
    """Flat field (...) at normalised image points (..., 2), 0.02 or more."""
    least = 0.02  # a polynomial beyond where it was measured must not turn the image inside out
    return np.maximum(field_at(field, xy), least)
