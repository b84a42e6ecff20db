"""Calibration of a wrist device, in the frame of its camera (OpenCV axes).

These are parts of its rig file.
"""

import math
from collections.abc import Mapping
from typing import Annotated

from msgspec import Meta

from common.calibration.parts import Direction, Part
from common.errors import CalibrationError

FLAT_FIELD_TERMS = (1, 3, 6, 10, 15, 21, 28)  # of polynomials in two variables, by degree
Reach = Annotated[float, Meta(ge=-1.0, le=1.0)]  # [m] the device sees the fingers of the hand that wears it
Place = tuple[Reach, Reach, Reach]
Coefficient = Annotated[float, Meta(ge=-1e6, le=1e6)]
_FINGERS = ("thumb", "index", "middle", "ring", "little")


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
    """Relative brightness across the image of a uniformly white surface.

    The surface is at one distance, seen along its normal; 1 on the axis.

    A polynomial in the normalised image point (x, y) = (X / Z, Y / Z); `coefficients` of 1, x, y, x^2, x y, y^2, x^3,
    x^2 y, ..., every degree whole.
    """

    coefficients: Annotated[tuple[Coefficient, ...], Meta(min_length=1, max_length=FLAT_FIELD_TERMS[-1])]


class FingerLine(Part, frozen=True):
    """Line along which the laser point of one finger moves during flexion.

    It is the principal axis of motion.

    Attributes:
        origin_m: A point of the line, where the finger is straightest.
        direction: Unit vector, towards what a bent finger reflects.
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
    """Refuse what the types alone cannot see.

    Raises:
        CalibrationError: With `where` and the key.
    """
    directions = {
        "laser_plane.normal": None if plane is None else plane.normal,
        "laser.forward": None if laser is None else laser.forward,
        "laser.right": None if laser is None else laser.right,
    }
    # of the laser's plane from the camera: nearer, it is seen along itself, and measures no depth
    min_offset_m = 1e-3
    if plane is not None and abs(plane.offset_m) < min_offset_m:
        raise CalibrationError(
            f"{where}: laser_plane.offset_m: {plane.offset_m:g}, the plane runs through the camera, which then sees no"
            f" depth on it; it is {min_offset_m:g} or more to either side"
        )
    unit_within = 1e-2  # of the length of a direction: what rounding leaves of one
    for key, way in directions.items():
        if way is not None and abs(math.hypot(*way) - 1.0) > unit_within:
            raise CalibrationError(f"{where}: {key}: length {math.hypot(*way):.4g}, not 1")
        if way is None or plane is None or not key.startswith("laser."):
            continue
        leaves = abs(sum(a * b for a, b in zip(plane.normal, way, strict=True)))
        # of a direction that should lie in a plane: 12 degrees, far more than a line laser is bent
        across = 0.2
        if leaves > across:
            raise CalibrationError(f"{where}: {key}: leaves laser_plane by {leaves:.2f} of its length")
    for finger, line in lines.items():
        if finger not in _FINGERS:
            raise CalibrationError(f"{where}: finger_lines: {finger!r} is none of {', '.join(_FINGERS)}")
        if abs(math.hypot(*line.direction) - 1.0) > unit_within:
            length = math.hypot(*line.direction)
            raise CalibrationError(f"{where}: finger_lines.{finger}.direction: length {length:.4g}, not 1")
        if line.range_m[0] >= line.range_m[1]:
            raise CalibrationError(f"{where}: finger_lines.{finger}.range_m: must rise")


def check_flat_field(field: FlatField | None, where: str) -> None:
    """Refuse a flat field whose polynomial is not whole.

    Raises:
        CalibrationError: With `where` and the key.
    """
    if field is not None and len(field.coefficients) not in FLAT_FIELD_TERMS:
        raise CalibrationError(
            f"{where}: flat_field.coefficients: {len(field.coefficients)} of them; a polynomial of whole degrees has"
            f" {', '.join(map(str, FLAT_FIELD_TERMS))}"
        )
