"""Building blocks of the calibration file types.

Their base class, and numbers with their bounds.
"""

from datetime import UTC, datetime
from typing import Annotated

from msgspec import Meta, Struct

# Bounds are generous, from a phone to machine vision: they stop numbers that cannot be (1e-300, 1e300), and with them
# divisions by nothing and overflows, not hardware that nobody thought of.
Number = Annotated[float, Meta(ge=-1e9, le=1e9)]  # without unit, or of several: residuals
Positive = Annotated[float, Meta(ge=1e-6, le=1e6)]  # a factor
NonNegative = Annotated[float, Meta(ge=0.0, le=1e6)]  # a factor that may be nothing
Coordinate = Annotated[float, Meta(ge=-100.0, le=100.0)]  # [m] a rig stands in one hall
Length = Annotated[float, Meta(ge=1e-6, le=100.0)]  # [m] from noise under a macro lens to a hall
Distance = Annotated[float, Meta(ge=0.0, le=100.0)]  # [m] a length that may be nothing
Angle = Annotated[float, Meta(ge=1e-6, le=6.2832)]  # [rad] up to a turn
Rate = Annotated[float, Meta(ge=0.1, le=1e5)]  # [Hz] of samples: an IMU gives up to 32 kHz
Frequency = Annotated[
    float, Meta(ge=1e-3, le=1e6)
]  # [Hz] cut-off of a filter; above the rate it does nothing
Duration = Annotated[float, Meta(ge=0.0, le=3600.0)]  # [s]
StampOffset = Annotated[float, Meta(ge=-1e6, le=1e6)]  # [us] a second: more is another frame, not its stamp
UnitComponent = Annotated[
    float, Meta(ge=-1.01, le=1.01)
]  # of a unit vector or quaternion, as rounding leaves it
Vector3 = tuple[Coordinate, Coordinate, Coordinate]
Direction = tuple[UnitComponent, UnitComponent, UnitComponent]
Quaternion = tuple[UnitComponent, UnitComponent, UnitComponent, UnitComponent]
Row4 = tuple[Coordinate, Coordinate, Coordinate, Coordinate]  # of a rotation, checked, and a translation [m]
Matrix4 = tuple[Row4, Row4, Row4, Row4]


class Part(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, omit_defaults=False):
    """Base of every calibration type."""


class Provenance(Part, frozen=True):
    """Provenance of a measured part of a file.

    When and by what it was measured, from which data, and how well the fit agrees.

    `residual`: quantity with its unit -> value, such as rms_px.
    """

    date: Annotated[str, Meta(pattern=r"^\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ(?!\n)$")]
    tool: str
    data: tuple[str, ...]
    residual: dict[str, Number]
    note: str = ""


def date_now() -> str:
    """This moment, as `Provenance.date` has it."""
    return datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
