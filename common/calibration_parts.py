"""What the types of calibration files are made of: their base, and numbers with their bounds."""

from datetime import UTC, datetime
from typing import Annotated

from msgspec import Meta, Struct

Positive = Annotated[float, Meta(gt=0.0, le=1e9)]
NonNegative = Annotated[float, Meta(ge=0.0, le=1e9)]
Number = Annotated[float, Meta(ge=-1e9, le=1e9)]
Vector3 = tuple[Number, Number, Number]
Quaternion = tuple[Number, Number, Number, Number]
Row4 = tuple[Number, Number, Number, Number]
Matrix4 = tuple[Row4, Row4, Row4, Row4]


class Part(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, omit_defaults=False):
    """Base of every calibration type."""


class Provenance(Part, frozen=True):
    """Where a measured part of a file comes from: when, by what, from which data, and how well the fit agrees.

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
