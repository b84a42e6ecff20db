"""Typed files of calib_json: JSON enters, checked values leave, or an error.

A rig is a JSON file, not a class: cameras, markers, depth model and hand are data. Units stand in the key names where
they are not SI; an unknown key is refused with file and key. docs/schema has the JSON schema of each file type.
"""

import inspect
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import msgspec
from msgspec import Struct

from common.calibration.camera import CameraCalibration, HsvRange, Intrinsics, RoiMargin, check_camera
from common.calibration.files import (
    UNIT_WITHIN,
    Matrix4,
    Positive,
    Provenance,
    Quaternion,
    Vector3,
    decode_json,
    read_bytes,
    replacing,
)
from common.calibration.gesture_settings import GestureSettings, check_gestures
from common.calibration.hand import (
    Couplings,
    Finger,
    FingerLimits,
    HandProfile,
    Limits,
    MarkerMount,
    PalmarScale,
    Posture,
    Preset,
    RestJoint,
    check_hand,
)
from common.calibration.object_profile import ObjectProfile, check_object
from common.calibration.output_settings import OutputSettings, check_outputs
from common.calibration.rig import (
    AffineDisparityCalibration,
    FilterCalibration,
    ImuCalibration,
    Laser,
    PowerLawCalibration,
    RigCalibration,
    Volume,
    check_rig,
)
from common.errors import CalibrationError

__all__ = [
    "UNIT_WITHIN",
    "AffineDisparityCalibration",
    "CameraCalibration",
    "Couplings",
    "FilterCalibration",
    "Finger",
    "FingerLimits",
    "HandProfile",
    "HsvRange",
    "ImuCalibration",
    "Intrinsics",
    "Laser",
    "Limits",
    "MarkerMount",
    "Matrix4",
    "PalmarScale",
    "Positive",
    "Posture",
    "PowerLawCalibration",
    "Preset",
    "Provenance",
    "Quaternion",
    "RestJoint",
    "RigCalibration",
    "RoiMargin",
    "Vector3",
    "Volume",
    "check",
    "compact_numbers",
    "load",
    "parse",
    "save",
    "schema",
]

StructT = TypeVar("StructT", bound=Struct)
_CHECKS: Mapping[type[Struct], Callable[[Any, str], None]] = {
    RigCalibration: check_rig,
    ObjectProfile: check_object,
    GestureSettings: check_gestures,
    OutputSettings: check_outputs,
    CameraCalibration: check_camera,
    HandProfile: check_hand,
}


def load(path: Path, kind: type[StructT]) -> StructT:
    """Read one calibration file.

    Raises:
        CalibrationError: Missing, too large, not JSON, a key unknown, missing, there twice or out of range, or parts
            that contradict each other. The text names the file and the key.
    """
    return parse(read_bytes(path), kind, str(path))


def parse(raw: bytes, kind: type[StructT], where: str) -> StructT:
    """Decode JSON bytes as `kind`, as `load`; `where` names the source in errors."""
    value = decode_json(raw, kind, where)
    check(value, where)
    return value


def check(value: Struct, where: str) -> None:
    """Refuse contradictions within a file: CalibrationError with `where` and the key."""
    if (check_own := _CHECKS.get(type(value))) is not None:
        check_own(value, where)


def save(path: Path, value: Struct) -> None:
    """Write a calibration file atomically.

    Raises:
        CalibrationError: The folder is missing, read-only or full, or the value would not come back
            as it is (a NaN, a number out of range); the old file is untouched.
    """
    formatted = msgspec.json.format(msgspec.json.encode(value), indent=1).decode()
    text = compact_numbers(formatted).encode() + b"\n"
    if parse(text, type(value), str(path)) != value:
        raise CalibrationError(f"{path}: a NaN, or a list in place of a tuple, would not come back as it is")
    try:
        with replacing(path) as file:
            file.write(text)
    except OSError as error:
        raise CalibrationError(f"{path}: cannot write: {error.strerror}") from error


_STRING_OR_NUMBERS = re.compile(r'"(?:[^"\\]|\\.)*"|\[[\s\d.,eE+-]+\]')


def compact_numbers(text: str) -> str:
    """Put arrays of plain numbers on one line, for people; strings are unchanged."""

    def compact(found: re.Match[str]) -> str:
        part = found[0]
        return part if part[0] == '"' else "[" + ", ".join(part[1:-1].replace(",", " ").split()) + "]"

    return _STRING_OR_NUMBERS.sub(compact, text)


def schema(kind: type[Struct]) -> bytes:
    """The formatted JSON schema of a file type, the same on every Python version."""
    content = msgspec.json.schema(kind)
    for part in content["$defs"].values():
        # Python 3.13 takes the indentation out of docstrings when it compiles them, earlier ones do not.
        part["description"] = inspect.cleandoc(part["description"])
    return msgspec.json.format(msgspec.json.encode(content), indent=1)
