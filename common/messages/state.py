"""Processes publish their state and metrics and receive requests.

A `Health` with a metric that is not in the table is refused, where it is made and where it is received. `<...>` in a
name stands for a name of the rig (a camera, a marker, a sender) or of a device's control. docs/metrics.md is made of
it.
"""

import re
from collections.abc import Iterable
from functools import lru_cache
from math import isfinite
from typing import Annotated, Literal, NamedTuple

from msgspec import Meta, Struct
from msgspec.structs import force_setattr

from common.errors import PictureError
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
from common.messages.picture_size import MAX_PIXELS, jpeg_size


class Metric(NamedTuple):
    """One published metric.

    Attributes:
        name: As in `Health.metrics`, with `<...>` where names of the rig stand.
        unit: SI or as the name says; "1": a ratio or a count; "0/1": a truth.
        process: Who publishes it: master, camera, imu, tracker, slave (all three), sender, recorder, player.
        text: What it is.
    """

    name: str
    unit: str
    process: str
    text: str


METRICS = (
    Metric("rate_hz", "1/s", "slave", "frames, samples or poses per second since the last report"),
    Metric("away_s", "s", "slave", "for how long the device has been lost; 0: it is there"),
    Metric("<device>.away_s", "s", "slave", "the same of a further device"),
    Metric("temperature_c", "°C", "slave", "of the hottest zone of the machine, or of the IMU"),
    Metric("temperature_limit_c", "°C", "slave", "at which that zone is throttled"),
    Metric(
        "throttled",
        "bits",
        "slave",
        "flags of the firmware that hold now: undervoltage, capped, throttled, hot",
    ),
    Metric("disk_free_mb", "MB", "slave", "free where the slave writes"),
    Metric("detect_us", "µs", "camera", "mean time of a detection"),
    Metric("detect_worst_us", "µs", "camera", "longest since the last report"),
    Metric("exposure_us", "µs", "camera", "exposure time as the camera has it"),
    Metric("analogue_gain", "1", "camera", "as the camera has it"),
    Metric("digital_gain", "1", "camera", "as the camera has it"),
    Metric("red_gain", "1", "camera", "white balance, relative to green"),
    Metric("blue_gain", "1", "camera", "white balance, relative to green"),
    Metric("frame_rate_hz", "1/s", "camera", "as the camera has it"),
    Metric("focus_dioptres", "1/m", "camera", "lens position"),
    Metric("sensor_celsius", "°C", "camera", "of the image sensor"),
    Metric("row_time_us", "µs", "camera", "readout time of a row"),
    Metric("control.<control>", "code", "camera", "a control of a USB camera, in codes of its maker"),
    Metric("sync_locked", "0/1", "camera", "it runs in step with the other Pi cameras"),
    Metric("sync_error_us", "µs", "camera", "last correction of a camera that follows; 0: below 50 µs"),
    Metric("wanted.<setting>", "as the setting", "camera", "what the camera file in use says of it"),
    Metric("roi_margin", "1", "camera", "margin of the windows in which markers are searched"),
    *(
        Metric(f"marker.<marker>.{channel}_{end}", "code", "camera", "bound of the colour range in use")
        for channel in "hsv"
        for end in ("low", "high")
    ),
    Metric("width_px", "px", "camera", "of the camera file in use"),
    Metric("height_px", "px", "camera", "of the camera file in use"),
    Metric("colour.<marker>", "code", "camera", "checksum of the colour range in use"),
    Metric("overlap.<marker>..<marker>", "hues", "camera", "how many hues two colour ranges share"),
    Metric("alike.<marker>..<marker>", "hues", "camera", "between two markers that look alike"),
    Metric("ambiguous.<marker>.u", "px", "camera", "where something else of the marker's colour was last"),
    Metric("ambiguous.<marker>.v", "px", "camera", "where something else of the marker's colour was last"),
    Metric("pick.pixels", "px", "camera", "answer to a click: pixels of that colour"),
    Metric("pick.own_share", "1", "camera", "answer to a click: share of them within the range"),
    Metric("pick.skin_share", "1", "camera", "answer to a click: share of the skin within the range"),
    Metric("pick.background_px", "px", "camera", "answer to a click: background within the range, per frame"),
    Metric("light_red", "1", "camera", "red against green, relative to calibration"),
    Metric("light_blue", "1", "camera", "blue against green, relative to calibration"),
    Metric("light_exposure", "1", "camera", "green, relative to calibration"),
    Metric("raw.megabytes", "MB", "camera", "written of the raw frames of this recording"),
    Metric("raw.on", "0/1", "camera", "raw frames are kept now"),
    Metric("battery_percent", "%", "imu", "of the IMU"),
    Metric("bias_x_rad_s", "rad/s", "imu", "estimated bias of the gyroscope"),
    Metric("bias_y_rad_s", "rad/s", "imu", "estimated bias of the gyroscope"),
    Metric("bias_z_rad_s", "rad/s", "imu", "estimated bias of the gyroscope"),
    Metric("heading_sigma_rad", "rad", "imu", "standard deviation of the drift about the vertical"),
    Metric("at_rest", "0/1", "imu", "the IMU does not move"),
    Metric("tracked", "0/1", "tracker", "the device knows where it is"),
    Metric("poses_per_s", "1/s", "master, player", "hands published per second"),
    Metric("latency_p50_ms", "ms", "master", "hand-over of the last frame to publication, median"),
    Metric("latency_p99_ms", "ms", "master", "the same, 99th percentile"),
    Metric("object_latency_p50_ms", "ms", "master", "the same of objects that were tracked, median"),
    Metric("object_latency_p99_ms", "ms", "master", "the same, 99th percentile"),
    Metric("camera_hz.<camera>", "1/s", "master", "rate of a camera, by its time stamps"),
    Metric("<sender>.clock_offset_us", "µs", "master", "its clock against the master's"),
    Metric("<sender>.clock_sigma_us", "µs", "master", "standard deviation of that"),
    Metric("<sender>.clock_drift_ppm", "ppm", "master", "how much faster its clock runs"),
    Metric("<camera>.phase_us", "µs", "master", "when it exposes against the other cameras"),
    Metric("<camera>.phase_spread_us", "µs", "master", "spread of that"),
    Metric(
        "<camera>.residual_offset_us",
        "µs",
        "master",
        "how much later its frames are than stamped, by the tracks",
    ),
    Metric("<camera>.residual_sigma_us", "µs", "master", "standard deviation of that"),
    Metric("open_bus", "0/1", "master", "anybody in the network may read the bus"),
    Metric("on.<output>", "0/1", "sender", "this output is switched on"),
    Metric("open.<output>", "0/1", "sender", "somebody takes what it sends"),
    Metric("recorder.seconds", "s", "recorder", "length so far"),
    Metric("recorder.megabytes", "MB", "recorder", "written so far"),
    Metric("recorder.megabytes_per_s", "MB/s", "recorder", "written per second"),
    Metric("recorder.free_gb", "GB", "recorder", "free on its disk"),
    Metric("play.position_s", "s", "player", "where it is"),
    Metric("play.length_s", "s", "player", "of the recording"),
    Metric("play.speed", "1", "player", "1: as recorded"),
    Metric("play.paused", "0/1", "player", "it stands still"),
)


def _pattern(name: str) -> str:
    return "".join(
        "[^\\x00-\\x1f]+" if part.startswith("<") else re.escape(part) for part in re.split(r"(<\w+>)", name)
    )


_KNOWN = re.compile("|".join(f"(?:{_pattern(metric.name)})" for metric in METRICS))
_CUT = tuple(metric.name.partition("<")[0] for metric in METRICS if "<" in metric.name)


@lru_cache(maxsize=4096)
def is_known(name: str) -> bool:
    """Whether a metric of this name is in the table; a full-length name may be cut."""
    if _KNOWN.fullmatch(name):
        return True
    return len(name) == MAX_NAME_CHARACTERS and any(head and name.startswith(head) for head in _CUT)


def unknown(names: Iterable[str]) -> list[str]:
    """Return the names that are not in the table."""
    return [name for name in names if not is_known(name)]


def metrics_page() -> str:
    """Return docs/metrics.md: one row per published metric."""
    head = (
        "# Metrics\n\nWhat processes publish in `Health.metrics` once a second (`phalanx/health/<name>`). A metric "
        "that is not in this table is refused.\n\n`<...>` stands for a name of the rig, of a device's control or of an "
        "output. A name has at most 64 characters; a longer one is cut.\n\nThis page is made by `make schema`.\n\n"
        "| metric | unit | published by | what it is |\n|---|---|---|---|\n"
    )
    return head + "".join(f"| `{one.name}` | {one.unit} | {one.process} | {one.text} |\n" for one in METRICS)


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
        metrics: Quantity -> value now, by the table of `common.messages.state`; others are refused.
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
    """All faults at one time. Empty: all is well.

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
    """Backlog of a master that records, valid until it reports another.

    Attributes:
        source: Process name: "master".
        t_ns: When the next message shown was there [ns], master's clock.
        skip: How many epochs of each hand are skipped, at most, between two that are solved; 0: none.
    """

    source: Name
    t_ns: TimeNs
    skip: Annotated[int, Meta(ge=0, le=64)]


class Preview(Message, frozen=True, eq=False, tag=True):
    """Small picture of what a camera sees, for a person; nothing is measured in it.

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
    """One whole frame of a camera, on request, to calibrate the camera from.

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
    """Refuse no JPEG, or too many bytes, pixels or scans (ValueError)."""
    if len(jpeg) > most:
        raise ValueError(f"jpeg: {len(jpeg)} bytes, expected a JPEG of at most {most}")
    try:
        width, height = jpeg_size(jpeg)
    except PictureError as error:
        raise ValueError(f"jpeg: {error}") from error
    if width * height > MAX_PIXELS:
        raise ValueError(f"jpeg: claims {width} x {height} px, more than {MAX_PIXELS}")
