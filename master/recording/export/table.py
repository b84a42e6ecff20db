"""Tables hold named columns with units and are written as CSV or Parquet.

Tidy tables: one row for each epoch. A name is what it is of, the quantity, and its unit:
`index_finger_tip_x_m`. Joints are those of docs/frames.md with _ for -. What was not observed is empty: NaN
becomes no value at all. A Parquet column carries its unit, frame and meaning as metadata, the file what it is
of; a CSV has names alone.
"""

from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, Protocol, cast

import numpy as np
import numpy.typing as npt
import pyarrow
from pyarrow import csv, parquet

from common.arrays import Float, Int
from common.calibration.files import replacing
from common.hand.model import FINGERS, JOINTS
from common.messages import Gesture, ObjectSource, Source
from master.outputs.poses import Poses
from master.outputs.result_files import Contacts, ObjectPoses

RIG = "rig"
_AXES = ("x", "y", "z")
_QUATERNION = ("qw", "qx", "qy", "qz")
_ANGLES = ("abduction", "flexion", "pip", "dip")
_THUMB_ANGLES = ("abduction", "flexion", "mcp", "ip")
_SOURCES = np.array([one.name.lower() for one in Source])
_OBJECT_SOURCES = np.array([one.name.lower() for one in ObjectSource])


@dataclass(frozen=True, slots=True, eq=False)
class Column:
    """One column of a table."""

    name: str
    values: npt.NDArray[Any]  # (T,) numbers, truth values or texts; NaN: not observed
    unit: str = ""  # ns, s, m, rad or nothing
    frame: str = ""  # in which its numbers are, or nothing
    text: str = ""  # what it is


def hand_columns(poses: Poses, begin_t_ns: int) -> list[Column]:
    """A hand's poses; `begin_t_ns` is second 0."""
    out = [*_times(poses.t_ns, begin_t_ns, "the time at which the pose holds")]
    for joint, title in enumerate(JOINTS):
        out += _joint_columns(poses, joint, title)
    for finger, title in enumerate(FINGERS):
        names = _ANGLES if finger else _THUMB_ANGLES
        angles, text = poses.angles_rad[:, finger], "angle, zero in the rest pose"
        out += [Column(f"{title}_{name}_rad", angles[:, k], "rad", "", text) for k, name in enumerate(names)]
    out += [
        Column(f"wrist_{name}_rad", poses.wrist_angles_rad[:, k], "rad", "forearm", "bend of the wrist")
        for k, name in enumerate(("flexion", "deviation"))
    ]
    out.append(
        Column("latency_ns", poses.latency_ns, "ns", "", "from the last frame to the pose; 0: offline")
    )
    return out


def _joint_columns(poses: Poses, joint: int, title: str) -> Iterator[Column]:
    name = title.replace("-", "_")
    yield from _place(name, poses.position_m[:, joint], "joint position")
    yield from _quaternion(name, poses.orientation_wxyz[:, joint], "joint orientation, joint axes to rig")
    yield Column(f"{name}_valid", poses.valid[:, joint], text="the pose of the joint may be used")
    yield Column(f"{name}_tracked", poses.tracked[:, joint], text="it is observed now, not inferred")
    spread = np.sqrt(np.trace(poses.cov_m2[:, joint], axis1=1, axis2=2) / 3.0)
    yield Column(
        f"{name}_sigma_m", spread, "m", "", "standard deviation of the position, per axis in the mean"
    )
    yield Column(
        f"{name}_source", _SOURCES[poses.source[:, joint]], text=f"what it comes from: {', '.join(_SOURCES)}"
    )


def object_columns(poses: ObjectPoses, begin_t_ns: int) -> list[Column]:
    """An object's poses."""
    return [
        *_times(poses.t_ns, begin_t_ns, "the time at which the pose holds"),
        *_place("", poses.position_m, "position of the object's own frame"),
        *_quaternion("", poses.orientation_wxyz, "orientation, object axes to rig"),
        *(
            Column(
                f"sigma_{axis}_{unit}",
                np.sqrt(poses.cov[:, k, k]),
                unit,
                RIG,
                f"standard deviation {'along' if unit == 'm' else 'of a rotation about'} {axis}",
            )
            for k, (axis, unit) in enumerate([(axis, unit) for unit in ("m", "rad") for axis in _AXES])
        ),
        Column("residual_m", poses.residual_m, "m", "", "by which what was measured misses the object"),
        Column(
            "source",
            _OBJECT_SOURCES[poses.source],
            text=f"what the pose comes from: {', '.join(_OBJECT_SOURCES)}",
        ),
        Column("tracked", poses.tracked, text="measured now, not held"),
        Column("seen", poses.seen, text="features that the pose rests on"),
        Column("expected", poses.expected, text="features that would be seen with nothing before it"),
        Column("occluded", poses.occluded, text="something hides a part of it"),
        Column("latency_ns", poses.latency_ns, "ns", "", "from the last frame to the pose; 0: offline"),
    ]


def contact_columns(near: Contacts, begin_t_ns: int) -> list[Column]:
    """How near a hand was to an object."""
    out = [*_times(near.t_ns, begin_t_ns, "that of the hand's pose")]
    for finger, name in enumerate(FINGERS):
        out += [
            Column(
                f"{name}_distance_m", near.distance_m[:, finger], "m", "", "skin to surface; negative inside"
            ),
            Column(f"{name}_sigma_m", near.sigma_m[:, finger], "m", "", "standard deviation of the distance"),
            *_place(f"{name}_nearest", near.point_m[:, finger], "nearest point of the object's surface"),
            Column(f"{name}_touching", near.touching[:, finger], text="the finger touches"),
        ]
    out.append(
        Column(
            "palm_distance_m", near.palm_distance_m, "m", "", "skin of the palm to surface; negative inside"
        )
    )
    return [*out, Column("held", near.held, text="the hand has a grip of it")]


def gesture_columns(gestures: Sequence[Gesture], begin_t_ns: int) -> list[Column]:
    """All gestures of all hands, a row for each message."""

    def of(name: str, kind: type) -> npt.NDArray[Any]:
        return cast(npt.NDArray[Any], np.array([getattr(one, name) for one in gestures], kind))

    def points(name: str) -> Float:
        return np.array([getattr(one, name) for one in gestures], np.float64).reshape(-1, 3)

    began = of("began_t_ns", np.int64)
    return [
        *_times(of("t_ns", np.int64), begin_t_ns, "that of the hand's pose"),
        *(
            Column(name, of(name, np.str_), text=text)
            for name, text in (
                ("hand", "name of the hand profile"),
                ("kind", "pose, pinch, dial, tap or point"),
                ("name", "which one"),
                ("phase", "begin, update or end"),
            )
        ),
        Column("began_t_ns", began, "ns", "", "when it began"),
        Column("confidence", of("confidence", np.float64), text="0 to 1"),
        Column("distance_m", of("distance_m", np.float64), "m", "", "of a pinch: from skin to skin"),
        Column("strength", of("strength", np.float64), text="of a pinch: 0 open, 1 closed"),
        Column("angle_rad", of("angle_rad", np.float64), "rad", "", "of a dial: turned since it began"),
        *_place("origin", points("origin_m"), "of a ray, a pinch or a dial"),
        *(
            Column(f"direction_{axis}", points("direction")[:, k], "", RIG, "unit vector of a ray or a dial")
            for k, axis in enumerate(_AXES)
        ),
    ]


def _times(t_ns: Int, begin_t_ns: int, text: str) -> Iterator[Column]:
    yield Column("t_ns", t_ns, "ns", "", f"{text}; the master's monotonic clock")
    yield Column(
        "seconds", (t_ns - begin_t_ns) * 1e-9, "s", "", "the same, after the beginning of the source"
    )


def _place(name: str, values: Float, text: str) -> Iterator[Column]:
    before = f"{name}_" if name else ""
    for k, axis in enumerate(_AXES):
        yield Column(f"{before}{axis}_m", values[:, k], "m", RIG, text)


def _quaternion(name: str, values: Float, text: str) -> Iterator[Column]:
    before = f"{name}_" if name else ""
    for k, part in enumerate(_QUATERNION):
        yield Column(f"{before}{part}", values[:, k], "", RIG, f"{text}; unit quaternion")


TableKind = Literal["csv", "parquet"]
_arrow, _csv, _parquet = (cast(Any, module) for module in (pyarrow, csv, parquet))  # they have no types


class _Writer(Protocol):
    def write_table(self, table: object) -> None: ...
    def close(self) -> None: ...


def write_table(
    path: Path,
    kind: TableKind,
    empty: Sequence[Column],
    batches: Iterable[Sequence[Column]],
    about: Mapping[str, str],
) -> int:
    """Write a table; return how many rows were written.

    Args:
        empty: The columns, with no rows or any: what an empty table consists of.
        batches: The rows, each batch with the same columns.
        about: What the table is, for the metadata of a Parquet file.

    Raises:
        OSError: It cannot be written; nothing half written is left.
    """
    rows = 0
    schema = _schema(empty, about)
    with replacing(path) as file, _writer(kind, file, schema) as writer:
        for batch in batches:
            arrays = [_arrow.array(one.values, from_pandas=True) for one in batch]
            writer.write_table(_arrow.Table.from_arrays(arrays, schema=schema))
            rows += len(batch[0].values)
    return rows


@contextmanager
def _writer(kind: TableKind, file: object, schema: object) -> Generator[_Writer]:
    """The library's writer into an open file."""
    opens = {"csv": _csv.CSVWriter, "parquet": partial(_parquet.ParquetWriter, compression="zstd")}
    writer: _Writer = opens[kind](file, schema)
    try:
        yield writer
    finally:
        writer.close()


def _schema(columns: Sequence[Column], about: Mapping[str, str]) -> object:
    """Names, types and meanings."""
    fields = [
        _arrow.field(
            one.name,
            _kind(one),
            metadata={
                key: value
                for key, value in (("unit", one.unit), ("frame", one.frame), ("description", one.text))
                if value
            },
        )
        for one in columns
    ]
    return _arrow.schema(fields, metadata=dict(about))


def _kind(column: Column) -> object:
    kinds = {"f": _arrow.float64(), "i": _arrow.int64(), "b": _arrow.bool_(), "U": _arrow.string()}
    return kinds[np.asarray(column.values).dtype.kind]
