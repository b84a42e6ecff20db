"""State of processes and requests to them.

Health, checklist, commands, and pictures for people.
"""

from math import isfinite
from typing import Annotated, Literal

from msgspec import Meta, Struct
from msgspec.structs import force_setattr

from common.errors import PictureError
from common.messages.metrics import unknown
from common.messages.parts import (
    MAX_COUNT,
    MAX_NAME_CHARACTERS,
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
from common.recording.picture_size import MAX_PIXELS, jpeg_size

MAX_PREVIEW_BYTES = 256 * 1024
MAX_STILL_BYTES = 900 * 1024
MAX_BODY_CHARACTERS = 64 * 1024
MAX_CHECKS = 64
MAX_NUMBERS = 512

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
    "duplicate_sender",
    "version_mismatch",
    "secret_mismatch",
    "marker_mismatch",
]


class Health(Message, frozen=True, eq=False, tag=True):
    """What a process counted since it started.

    Whatever is counted, the report is readable: counts stay at their maximum, metrics that are no number are left
    out, texts lose what cannot be printed.

    Attributes:
        source: Process name: a camera, or "master".
        session: Random id of the process.
        t_ns: Moment of the report [ns], clock of the source.
        counts: Event name -> how often (frames, dropped, refused by reason, ...).
        metrics: Quantity -> value now, by the table of `common.messages.metrics`; others are refused.
        host: Name of the machine that the process runs on; empty: not reported.
        version: Of the program; empty: not reported.
    """

    source: Name
    session: Count
    t_ns: TimeNs
    counts: Annotated[dict[Name, Count], Meta(max_length=MAX_NUMBERS)]
    metrics: Annotated[dict[Name, Finite], Meta(max_length=MAX_NUMBERS)]
    host: Text = ""
    version: Text = ""

    def __post_init__(self) -> None:
        counts = list(self.counts.items())[:MAX_NUMBERS]
        metrics = [(name, value) for name, value in self.metrics.items() if isfinite(value)][:MAX_NUMBERS]
        if strange := unknown(name[:MAX_NAME_CHARACTERS] for name, _ in metrics):
            raise ValueError(f"metrics: {strange[0]!r} is not in the table of metrics (docs/metrics.md)")
        force_setattr(
            self, "counts", {name[:MAX_NAME_CHARACTERS]: max(0, min(n, MAX_COUNT)) for name, n in counts}
        )
        clamped = {
            name[:MAX_NAME_CHARACTERS]: max(-MAX_NUMBER, min(value, MAX_NUMBER)) for name, value in metrics
        }
        force_setattr(self, "metrics", clamped)
        force_setattr(self, "host", printable(self.host)[:MAX_NAME_CHARACTERS])
        force_setattr(self, "version", printable(self.version)[:MAX_NAME_CHARACTERS])


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
    """All faults at one time.

    Empty: all is well.

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
    """Backlog of a master that records.

    Valid from the next message shown until the master reports otherwise.

    Attributes:
        source: Process name: "master".
        t_ns: When that message was there [ns], master's clock.
        skip: How many epochs of each hand are skipped, at most, between two that are solved; 0: none.
    """

    source: Name
    t_ns: TimeNs
    skip: Annotated[int, Meta(ge=0, le=64)]


class Preview(Message, frozen=True, eq=False, tag=True):
    """Small picture of what a camera sees, for a person who requested it.

    Nothing is measured in it.

    Attributes:
        camera: Camera name.
        t_ns: Middle of the exposure of row 0 [ns], sender's clock.
        jpeg: A whole JPEG file of the view, usually of half the camera's width and height: 256 KiB, sides of at most
            16384 px, 2^26 px, 64 scans.
    """

    camera: Name
    t_ns: TimeNs
    jpeg: Annotated[bytes, Meta(max_length=MAX_PREVIEW_BYTES)]

    def __post_init__(self) -> None:
        _check_jpeg(self.jpeg, MAX_PREVIEW_BYTES)


class Still(Message, frozen=True, eq=False, tag=True):
    """One whole frame of a camera, on request.

    The cameras themselves are calibrated from it.

    Attributes:
        camera: Camera name.
        seq: Frame counter of this camera.
        t_ns: Middle of the exposure of row 0 [ns], sender's clock.
        jpeg: A whole JPEG file of the camera's width and height: 900 KiB, otherwise as that of a preview.
    """

    camera: Name
    seq: Count
    t_ns: TimeNs
    jpeg: Annotated[bytes, Meta(max_length=MAX_STILL_BYTES)]

    def __post_init__(self) -> None:
        _check_jpeg(self.jpeg, MAX_STILL_BYTES)


def _check_jpeg(jpeg: bytes, most: int) -> None:
    """Refuse a JPEG that no camera of ours sends.

    Whoever decodes it compares its size with the camera file as well.

    Raises:
        ValueError: Too many bytes, no JPEG, or one that claims too many pixels or scans.
    """
    if len(jpeg) > most:
        raise ValueError(f"jpeg: {len(jpeg)} bytes, expected a JPEG of at most {most}")
    try:
        width, height = jpeg_size(jpeg)
    except PictureError as error:
        raise ValueError(f"jpeg: {error}") from error
    if width * height > MAX_PIXELS:
        raise ValueError(f"jpeg: claims {width} x {height} px, more than {MAX_PIXELS}")
