"""Typed files of calib_json: load, validate, save atomically. An unknown key is refused with file and key.

A rig is a JSON file, not a class: cameras, markers, depth model and hand are data. Units stand in the key
names where they are not SI. The JSON schema of each file is exported to docs/ from these types.
"""

import inspect
import math
import re
from pathlib import Path
from typing import Annotated, Literal, TypeVar

import msgspec
import numpy as np
from msgspec import Meta, Struct

from common.arrays import Float
from common.calibration_parts import (
    Matrix4,
    NonNegative,
    Number,
    Part,
    Positive,
    Provenance,
    Quaternion,
    Vector3,
)
from common.errors import CalibrationError
from common.gesture_settings import GestureSettings, check_gestures
from common.messages import MAX_MARKERS, Name
from common.object_profile import ObjectProfile, check_object, check_pose
from common.output_settings import OutputSettings, check_outputs
from common.replacing import replacing
from common.strobe_calibration import StrobeCalibration, check_strobe
from common.wrist_calibration import FingerLine, FlatField, Laser, LaserPlane, check_flat_field, check_wrist

Hsv = tuple[
    Annotated[int, Meta(ge=0, le=179)], Annotated[int, Meta(ge=0, le=255)], Annotated[int, Meta(ge=0, le=255)]
]
RoiMargin = Annotated[float, Meta(ge=0.01, le=0.5)]
LinearLight = Annotated[float, Meta(gt=0.0, le=1.0)]
Markers = Annotated[tuple[Name, ...], Meta(min_length=1, max_length=MAX_MARKERS)]

UNIT_WITHIN = 1e-2  # of the length of a quaternion: what rounding leaves of one, and far from any mistake
StructT = TypeVar("StructT", bound=Struct)


class Intrinsics(Part, frozen=True):
    """Pinhole and distortion, OpenCV's convention; distortion = k1, k2, p1, p2, k3."""

    fx_px: Positive
    fy_px: Positive
    cx_px: Number
    cy_px: Number
    distortion: tuple[Number, Number, Number, Number, Number] = (0.0, 0.0, 0.0, 0.0, 0.0)


class HsvRange(Part, frozen=True):
    """Colour of one marker in OpenCV's HSV (H 0-179); hsv_low[0] > hsv_high[0] wraps through 0.

    `reference_bgr_linear` is the mean colour of the paint in linear light, blue first, 1 = white, at calibration; with
    it a slave follows changes of the light.
    """

    hsv_low: Hsv
    hsv_high: Hsv
    reference_bgr_linear: tuple[LinearLight, LinearLight, LinearLight] | None = None


class CameraCalibration(Part, frozen=True):
    """cameras/<name>.json: mode, exposure, optics and marker colours of one camera.

    `roi_margin`: how far from where it is expected a marker is still taken for itself, as a share of the image width
    beside its own size.
    """

    version: Literal[1]
    name: Name
    width_px: Annotated[int, Meta(ge=16, le=16384)]
    height_px: Annotated[int, Meta(ge=16, le=16384)]
    frame_rate_hz: Positive
    exposure_us: Positive
    analogue_gain: Positive
    colour_gains: tuple[Positive, Positive]
    row_time_us: NonNegative
    focus_m: Positive | None = None  # of a lens with a motor; the intrinsics are those of this distance
    intrinsics: Intrinsics | None = None
    markers: dict[Name, HsvRange] | None = None
    roi_margin: RoiMargin = 0.0625
    provenance: dict[str, Provenance] = {}


class PowerLawCalibration(Part, frozen=True):
    """Depth D = k x^z with x = u_left - u_right [px] (Kalbfleisch's corrected depth)."""

    k_m: Positive
    z: Annotated[float, Meta(ge=-3.0, lt=0.0)]


class AffineDisparityCalibration(Part, frozen=True):
    """Disparity x = a / D + x0 [px]."""

    a_m_px: Positive
    x0_px: Number


class FilterCalibration(Part, frozen=True):
    """The 1 € filter of the 3D markers: cut-off at rest, its rise per speed [Hz per m/s], cut-off of the speed.

    `jitter_m`: what may be left of the noise of a marker at rest, per axis; noisier axes are filtered more.
    """

    min_cutoff_hz: Positive = 6.0
    beta: NonNegative = 120.0
    d_cutoff_hz: Positive = 6.0
    jitter_m: Positive = 3e-4


class Volume(Part, frozen=True):
    """A box in the rig frame, sides along its axes: where the rig was tested."""

    low_m: Vector3
    high_m: Vector3


class ImuCalibration(Part, frozen=True):
    """An IMU fixed to the palm, as far as known; its orientation is used where mounting and world are.

    `q_palm_imu`: quaternion wxyz, its axes -> palm frame. `q_rig_world`: its world, whose z axis is vertical -> rig
    frame. `orientation_sigma_rad`: per axis, of the tilt against the vertical. `heading_sigma_rad`: of the turn about
    the vertical, which drifts by `heading_drift_rad_s`; null: not known at all, as without a magnetometer.
    `stamp_offset_us`: how much later its samples were taken than their stamps say.
    """

    name: Name = "imu"
    rate_hz: Positive = 120.0
    q_palm_imu: Quaternion | None = None
    q_rig_world: Quaternion | None = None
    orientation_sigma_rad: Positive = math.radians(2.0)
    heading_sigma_rad: Positive | None = None
    heading_drift_rad_s: NonNegative = 0.0
    stamp_offset_us: Number = 0.0

    @property
    def placed(self) -> bool:
        """Whether its orientation tells that of the palm in the rig."""
        return self.q_palm_imu is not None and self.q_rig_world is not None


class RigCalibration(Part, frozen=True):
    """rigs/<name>.json: which cameras, where, which markers, which depth model, whose hand.

    `free_markers` are those of `markers` that sit on no hand: they are placed and filtered, no hand is fitted to them.
    `objects`: files of the objects that are tracked; their markers are free ones. `T_rig_tracking`: where the frame of
    a system whose devices track themselves (Lighthouse) lies in the rig. `gestures`: file of what counts as a gesture;
    null: as calib_json/gestures/default.json has it.
    `other_hands`: hands of its markers besides `hand`; each marker is that of the hand whose file mounts it.
    `T_world_rig`: where the rig lies in the frame that several rigs share; null: its frame is that one.
    `stamp_offset_us`: how much later the frames of a camera were taken than their stamps say.
    From `laser_plane` on, the keys of a wrist rig, in its camera's frame; `forward`: how the place of the laser on a
    finger becomes its flexion, by the table of this hand or by the cubic printed in the paper; `finger_lines`: finger
    -> the line along which its laser point moves. `level`: fingers from the laser alone, bent as habit has it (fk),
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
    pairing: Literal["interpolate", "predict"] = "interpolate"
    filter: FilterCalibration = FilterCalibration()
    volume: Volume | None = None
    stamp_offset_us: dict[Name, Number] = {}
    provenance: dict[str, Provenance] = {}
    laser_plane: LaserPlane | None = None
    laser: Laser | None = None
    T_camera_palm: Matrix4 | None = None
    led: tuple[Vector3, ...] | None = None
    flat_field: FlatField | None = None
    finger_lines: dict[Name, FingerLine] = {}
    forward: Literal["table", "cubic"] = "table"
    level: Literal["fk", "ik", "auto"] = "auto"
    imu: ImuCalibration | None = None
    strobe: StrobeCalibration | None = None

    def camera_pose(self, camera: str) -> Float:
        """`T_rig_camera` (4, 4) [m] of one camera; the frame of a wrist rig is that of its camera.

        Raises:
            CalibrationError: The rig's places are not measured yet.
        """
        if self.kind == "wrist":
            return np.eye(4)
        if camera not in self.T_rig_camera:
            raise CalibrationError(
                f"rig {self.name!r}: T_rig_camera: camera {camera!r} has no place yet, which"
                " `phalanx-master calibrate stereo` measures"
            )
        return np.array(self.T_rig_camera[camera], dtype=np.float64)


class RestJoint(Part, frozen=True):
    """One joint of the flat hand, palm frame; OpenXR axes: -z along the bone to the tip, +y dorsal."""

    position_m: Vector3
    orientation_wxyz: Quaternion


class MarkerMount(Part, frozen=True):
    """Where a painted cap sits: the joint it is fixed to (or palm_frame), its centroid there, its painted length."""

    joint: str
    offset_m: Vector3
    painted_m: Positive = 0.016


Span = tuple[Number, Number]
Share = Annotated[float, Meta(ge=0.0, le=1.0)]


class FingerLimits(Part, frozen=True):
    """Low and high of the four angles [rad], zero in the rest pose; for the thumb CMC, CMC, MCP, IP.

    `spread_at_full_flexion`: share of the abduction range that is left at the highest flexion, less on the way there;
    1: the range stays.
    """

    abduction_rad: Span
    flexion_rad: Span
    pip_rad: Span
    dip_rad: Span
    spread_at_full_flexion: Share = 1.0


class Limits(Part, frozen=True):
    """Limits of the five fingers."""

    thumb: FingerLimits
    index: FingerLimits
    middle: FingerLimits
    ring: FingerLimits
    little: FingerLimits


class Couplings(Part, frozen=True):
    """Natural relations between the angles of index ... little; each can be switched off.

    `dip_per_pip` None: the DIP is free. `dip_spread_rad`: standard deviation of the DIP about that ratio; 0: it is
    kept exactly. `mcp_per_pip` None: no natural flexion. `neighbours`: fingers side by side tend to bend alike.
    """

    dip_per_pip: NonNegative | None = 2.0 / 3.0
    dip_spread_rad: Annotated[float, Meta(ge=0.0, le=3.2)] = 0.0
    mcp_per_pip: NonNegative | None = 0.54
    neighbours: bool = True


Preset = Literal["K", "D"]
Finger = Literal["thumb", "index", "middle", "ring", "little"]
PalmarScale = Annotated[float, Meta(ge=0.5, le=2.0)]


class HandProfile(Part, frozen=True):
    """hands/<name>.json: bones and markers of one hand, optionally radii, skin, limits and couplings.

    Limits and couplings may be the name of a preset: K (Kalbfleisch; also where there are none) or D (Digits).
    `palmar_scale`: finger -> how thick its palmar flesh is against that which the radii or the size of the hand tell,
    as a wrist device measures it; 1 where a finger is not named.
    """

    version: Literal[1]
    name: Name
    side: Literal["left", "right"]
    rest_joints: dict[str, RestJoint]
    markers: dict[Name, MarkerMount]
    radius_m: dict[str, Positive] | None = None
    palmar_scale: dict[Finger, PalmarScale] = {}
    limits_rad: Limits | Preset | None = None
    couplings: Couplings | Preset | None = None
    provenance: dict[str, Provenance] = {}


def load(path: Path, kind: type[StructT]) -> StructT:
    """Read one calibration file.

    Raises:
        CalibrationError: Missing, not JSON, a key unknown, missing or out of range, or parts that
            contradict each other. The text names the file and the key.
    """
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise CalibrationError(f"{path}: cannot read: {error.strerror}") from error
    return parse(raw, kind, str(path))


def parse(raw: bytes, kind: type[StructT], where: str) -> StructT:
    """Decode JSON bytes as `kind`; `where` names the source in errors.

    Raises:
        CalibrationError: As `load`.
    """
    try:
        value = msgspec.json.decode(raw, type=kind)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise CalibrationError(f"{where}: {error}") from error
    check(value, where)
    return value


def check(value: Struct, where: str) -> None:
    """Refuse what the types alone cannot: parts of one file that contradict each other.

    Raises:
        CalibrationError: With `where` and the key.
    """
    if isinstance(value, RigCalibration):
        _check_rig(value, where)
    elif isinstance(value, ObjectProfile):
        check_object(value, where)
    elif isinstance(value, GestureSettings):
        check_gestures(value, where)
    elif isinstance(value, OutputSettings):
        check_outputs(value, where)
    elif isinstance(value, CameraCalibration):
        for name, colour in (value.markers or {}).items():
            for i, letter in ((1, "S"), (2, "V")):
                if colour.hsv_low[i] > colour.hsv_high[i]:
                    raise CalibrationError(
                        f"{where}: markers.{name}: {letter} of hsv_low is above hsv_high (only H may wrap)"
                    )


def _check_rig(rig: RigCalibration, where: str) -> None:
    if len(set(rig.cameras)) != len(rig.cameras):
        raise CalibrationError(f"{where}: cameras: a name stands twice")
    if len(set(rig.markers)) != len(rig.markers):
        raise CalibrationError(f"{where}: markers: a name stands twice")
    for name in rig.free_markers:
        if name not in rig.markers:
            raise CalibrationError(f"{where}: free_markers: {name!r} is not one of markers")
    for name in rig.stamp_offset_us:
        if name not in rig.cameras:
            raise CalibrationError(f"{where}: stamp_offset_us: {name!r} is not one of cameras")
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
        for key in ("other_hands", "T_world_rig", "objects", "T_rig_tracking"):
            if getattr(rig, key):
                raise CalibrationError(f"{where}: {key}: of marker rigs; a wrist device is worn by one hand")
        return
    if len({rig.hand, *rig.other_hands}) != 1 + len(rig.other_hands):
        raise CalibrationError(f"{where}: other_hands: a hand stands twice")
    if len(set(rig.objects)) != len(rig.objects):
        raise CalibrationError(f"{where}: objects: a name stands twice")
    for key, pose in (("T_world_rig", rig.T_world_rig), ("T_rig_tracking", rig.T_rig_tracking)):
        if pose is not None:
            check_pose(np.array(pose), f"{where}: {key}")
    # None at all: a rig that is still to be measured.
    for camera in rig.cameras if rig.T_rig_camera else ():
        if camera not in rig.T_rig_camera:
            raise CalibrationError(f"{where}: T_rig_camera: camera {camera!r} is missing")
        check_pose(rig.camera_pose(camera), f"{where}: T_rig_camera.{camera}")
    if rig.depth_model != "stereo" and getattr(rig, rig.depth_model) is None:
        raise CalibrationError(
            f"{where}: depth_model is {rig.depth_model!r} but the key {rig.depth_model!r} is missing"
        )


def _check_imu(imu: ImuCalibration, cameras: tuple[str, ...], where: str) -> None:
    if imu.name in cameras:
        raise CalibrationError(
            f"{where}: imu.name: {imu.name!r} is a camera; every sender has a name of its own"
        )
    for key, value in (("q_palm_imu", imu.q_palm_imu), ("q_rig_world", imu.q_rig_world)):
        if value is not None and abs(math.hypot(*value) - 1.0) > UNIT_WITHIN:
            raise CalibrationError(
                f"{where}: imu.{key}: length {math.hypot(*value):.4g}, a rotation is a quaternion wxyz of length 1"
            )


def save(path: Path, value: Struct) -> None:
    """Write a calibration file atomically: a reader sees the old file or the new one, never half.

    Raises:
        CalibrationError: The folder is missing, read-only or full, or the value would not come back
            as it is (a NaN, a number out of range); the old file is untouched.
    """
    text = (
        compact_numbers(msgspec.json.format(msgspec.json.encode(value), indent=1).decode()).encode() + b"\n"
    )
    if parse(text, type(value), str(path)) != value:
        raise CalibrationError(f"{path}: a NaN, or a list in place of a tuple, would not come back as it is")
    try:
        with replacing(path) as file:
            file.write(text)
    except OSError as error:
        raise CalibrationError(f"{path}: cannot write: {error.strerror}") from error


_STRING_OR_NUMBERS = re.compile(r'"(?:[^"\\]|\\.)*"|\[[\s\d.,eE+-]+\]')


def compact_numbers(text: str) -> str:
    """Put arrays of plain numbers on one line, so that a calibration file stays readable; strings stay."""

    def compact(found: re.Match[str]) -> str:
        part = found[0]
        return part if part[0] == '"' else "[" + ", ".join(part[1:-1].replace(",", " ").split()) + "]"

    return _STRING_OR_NUMBERS.sub(compact, text)


def schema(kind: type[Struct]) -> bytes:
    """JSON schema of one file type, formatted; the same bytes on every Python version."""
    content = msgspec.json.schema(kind)
    for part in content["$defs"].values():
        # Python 3.13 takes the indentation out of docstrings when it compiles them, earlier ones do not.
        part["description"] = inspect.cleandoc(part["description"])
    return msgspec.json.format(msgspec.json.encode(content), indent=1)
