"""How processes are and what they are asked: health, checklist, commands, and pictures for people."""

from math import isfinite
from typing import Annotated, Literal

from msgspec import Meta, Struct
from msgspec.structs import force_setattr

from common.message_parts import (
    MAX_COUNT,
    MAX_NUMBER,
    Count,
    Finite,
    Message,
    Name,
    Sentence,
    Text,
    TimeNs,
    printable,
)

MAX_PREVIEW_BYTES = 256 * 1024
MAX_STILL_BYTES = 900 * 1024
MAX_BODY_CHARACTERS = 64 * 1024
MAX_CHECKS = 64
MAX_NUMBERS = 512
_NAME = 64
_JPEG_START = b"\xff\xd8\xff"

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
    "marker_mismatch",
]


class Health(Message, frozen=True, eq=False, tag=True):
    """What a process counted since it started.

    Whatever is counted, the report can be read: counts stay at their largest value, gauges that are no number are left
    out, texts lose what cannot be printed.

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
    counts: Annotated[dict[Name, Count], Meta(max_length=MAX_NUMBERS)]
    gauges: Annotated[dict[Name, Finite], Meta(max_length=MAX_NUMBERS)]
    host: Text = ""
    version: Text = ""

    def __post_init__(self) -> None:
        counts = list(self.counts.items())[:MAX_NUMBERS]
        gauges = [(name, value) for name, value in self.gauges.items() if isfinite(value)][:MAX_NUMBERS]
        force_setattr(self, "counts", {name[:_NAME]: max(0, min(n, MAX_COUNT)) for name, n in counts})
        clamped = {name[:_NAME]: max(-MAX_NUMBER, min(value, MAX_NUMBER)) for name, value in gauges}
        force_setattr(self, "gauges", clamped)
        force_setattr(self, "host", printable(self.host)[:_NAME])
        force_setattr(self, "version", printable(self.version)[:_NAME])


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
    sentence: Sentence
    fix: Sentence


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
