"""Calibration files have one base type, are read in bounds, replaced whole.

A file is bounded in size and nesting, has no key twice and no NaN, and every value has its type. msgspec decodes and
checks the types. Of two equal keys it keeps the last, and a file of a million brackets ends in a RecursionError: the
first is looked for after it by a second, untyped pass, the second before it.
"""

import hashlib
import json
import math
import os
import re
import tempfile
from collections.abc import Generator, Iterable
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Annotated, TypeVar, cast

import msgspec
import numpy as np
from msgspec import Meta, Struct

from common.errors import CalibrationError

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
# [Hz] cut-off of a filter; above the rate it does nothing
Frequency = Annotated[float, Meta(ge=1e-3, le=1e6)]
Duration = Annotated[float, Meta(ge=0.0, le=3600.0)]  # [s]
StampOffset = Annotated[float, Meta(ge=-1e6, le=1e6)]  # [us] a second: more is another frame, not its stamp
# of a unit vector or quaternion, as rounding leaves it
UnitComponent = Annotated[float, Meta(ge=-1.01, le=1.01)]
Vector3 = tuple[Coordinate, Coordinate, Coordinate]
Direction = tuple[UnitComponent, UnitComponent, UnitComponent]
Quaternion = tuple[UnitComponent, UnitComponent, UnitComponent, UnitComponent]
Row4 = tuple[Coordinate, Coordinate, Coordinate, Coordinate]  # of a rotation, checked, and a translation [m]
Matrix4 = tuple[Row4, Row4, Row4, Row4]


UNIT_WITHIN = 1e-2  # of the length of a quaternion: what rounding leaves of one, and far from any mistake


def check_quaternion(value: Quaternion, where: str) -> None:
    """Refuse a quaternion that is not of length 1: CalibrationError with `where`."""
    if abs((length := math.hypot(*value)) - 1.0) > UNIT_WITHIN:
        raise CalibrationError(f"{where}: length {length:.4g}, a rotation is a quaternion wxyz of length 1")


class Part(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, omit_defaults=False):
    """Base of every calibration type."""


class Provenance(Part, frozen=True):
    """Provenance of a measured part of a file: when, by what and from which data.

    `residual`: quantity with its unit -> value, such as rms_px: how well the fit agrees.
    """

    date: Annotated[str, Meta(pattern=r"^\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ(?!\n)$")]
    tool: str
    data: tuple[str, ...]
    residual: dict[str, Number]
    note: str = ""


def date_now() -> str:
    """This moment, as `Provenance.date` has it."""
    return datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


MAX_BYTES = 4 << 20  # the largest file of ours, a hand with its provenance, has 12 kB
MAX_DEPTH = 32  # ours have 7 levels

T = TypeVar("T")

_STRING = re.compile(rb'"(?:[^"\\]++|\\.)*+"?', re.DOTALL)  # possessive: linear in time on any input
_STEP = re.compile(r"\.(\w+)|\[(\d+)\]|\[\.\.\.\]")
_STEPS = np.zeros(256, np.int8)
_STEPS[list(b"[{")] = 1
_STEPS[list(b"]}")] = -1


def read_json(path: Path, kind: type[T]) -> T:
    """Read one JSON file as `kind`; raises as `read_bytes` and `decode_json`."""
    return decode_json(read_bytes(path), kind, str(path))


def read_bytes(path: Path) -> bytes:
    """Read the bytes of a file that is meant to be JSON; its size is looked at first.

    Raises:
        CalibrationError: It cannot be read, or is too large.
    """
    try:
        with path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            raw = file.read(MAX_BYTES + 1) if size <= MAX_BYTES else b""
    except (OSError, ValueError) as error:  # ValueError: a NUL in the path
        raise CalibrationError(f"{path}: cannot read: {getattr(error, 'strerror', error)}") from error
    _check_size(max(size, len(raw)), str(path))
    return raw


def decode_json(raw: bytes, kind: type[T], where: str) -> T:
    """Decode JSON as `kind`; `where` names the source in errors.

    Raises:
        CalibrationError: Too large, nested too deeply, not JSON, a key that is unknown, missing or there twice, or a
            value of another type or out of range. The text has `where` and the path of the key.
    """
    _check_size(len(raw), where)
    if (depth := _depth(raw)) > MAX_DEPTH:
        raise CalibrationError(f"{where}: nested {depth} levels deep, at most {MAX_DEPTH} are allowed")
    try:
        value = msgspec.json.decode(raw, type=kind)
        root = json.loads(raw, strict=False, object_pairs_hook=_object, parse_int=str, parse_float=str)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise CalibrationError(f"{where}: {_printable(_with_keys(str(error), raw, kind))}") from error
    if (twice := _duplicate(root)) is not None:
        raise CalibrationError(f"{where}: duplicate key - at `{_printable('$' + twice)}`; remove one of them")
    return value


def _check_size(size: int, where: str) -> None:
    if size > MAX_BYTES:
        raise CalibrationError(f"{where}: larger than 4 MiB; no JSON file of ours is")


def _depth(raw: bytes) -> int:
    """How deeply brackets are nested, outside of strings."""
    bare = np.frombuffer(_STRING.sub(b"", raw), np.uint8)
    return int(np.cumsum(_STEPS[bare], dtype=np.int32).max(initial=0))


class _Repeating(dict[str, object]):
    """An object of a file in which `key` stands twice."""

    key = ""


def _object(pairs: list[tuple[str, object]]) -> dict[str, object]:
    found = dict(pairs)
    if len(found) == len(pairs):
        return found
    seen = set[str]()
    repeating = _Repeating(found)
    repeating.key = next(key for key, _ in pairs if key in seen or seen.add(key))
    return repeating


def _duplicate(value: object) -> str | None:
    """Path of the first key that stands twice in what `_object` made, or None."""
    if isinstance(value, _Repeating):
        return _step(value.key)
    if isinstance(value, dict):
        steps = [(_step(key), part) for key, part in cast(dict[str, object], value).items()]
    elif isinstance(value, list):
        steps = [(f"[{i}]", part) for i, part in enumerate(cast(list[object], value))]
    else:
        return None
    for step, part in steps:
        if (inner := _duplicate(part)) is not None:
            return step + inner
    return None


def _with_keys(text: str, raw: bytes, kind: type[object]) -> str:
    """The error of msgspec with the keys of a map, where it has `[...]`."""
    if (place := text.rfind("`$")) < 0 or "[...]" not in text[place:]:
        return text
    try:
        root = holder = [msgspec.json.decode(raw)]
    except msgspec.MsgspecError:  # malformed further on
        return text
    if _error_of(root[0], kind) != text:  # of a key that stands twice
        return text
    at: object = 0
    path = "$"
    for step in _STEP.finditer(text, place):
        value = cast(dict[object, object], holder)[at]
        if step[0] == "[...]":
            if not isinstance(value, dict):
                return text
            key: object = _culprit(root, holder, at, kind, text)
            path += _step(str(key))
        else:
            key = int(step[2]) if step[2] else step[1]
            path += step[0]
        holder, at = cast(list[object], cast(dict[object, object], holder)[at]), key
    return f"{text[:place]}`{path}`"


def _culprit(root: list[object], holder: list[object], at: object, kind: type[object], text: str) -> str:
    """Key of the map at `holder[at]` whose value gives `text`; only it is left there."""
    parts = cast(dict[object, dict[str, object]], holder)
    value = parts[at]
    keys = list(value)
    while len(keys) > 1:
        half = keys[: len(keys) // 2]
        parts[at] = {key: value[key] for key in half}
        keys = half if _error_of(root[0], kind) == text else keys[len(keys) // 2 :]
    parts[at] = {key: value[key] for key in keys}
    return keys[0]


def _error_of(value: object, kind: type[object]) -> str:
    try:
        msgspec.json.decode(msgspec.json.encode(value), type=kind)
    except msgspec.MsgspecError as error:
        return str(error)
    return ""


def _step(key: str) -> str:
    return f".{key}" if re.fullmatch(r"[\w-]+", key) else f"[{json.dumps(key)}]"


def _printable(text: str) -> str:
    """Escape control characters and cut the middle of a long text, for one line."""
    max_text = 600  # of an error: keys of a file may be as long as the file
    text = "".join(
        c if c.isprintable() else c.encode("unicode_escape").decode() for c in text[: 4 * max_text]
    )
    return text if len(text) <= max_text else f"{text[: max_text // 2]} ... {text[-max_text // 2 :]}"


@contextmanager
def replacing(path: Path) -> Generator[IO[bytes], None, None]:
    """Open a new file beside `path` that replaces it at the end of the block.

    A reader sees the old file or the new one, also after a power cut. It is deleted if the block fails.

    Raises:
        OSError: The folder is missing, read-only or full; the old file is untouched.
    """
    temporary = None
    try:
        # Beside it, because only within one file system is a replacement a single step.
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix=f".{path.name}.", delete=False) as file:
            temporary = Path(file.name)
            yield file
            file.flush()
            os.fsync(file.fileno())  # before the new name: a power cut must not leave an empty file under it
        temporary.chmod(0o644)  # it was made for its owner alone
        temporary.replace(path)
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


PLAIN = "letters, digits, _ . -, at most 64, not dots alone"
_PLAIN = re.compile(r"[A-Za-z0-9_.-]{1,64}")


def is_plain(name: str) -> bool:
    """Whether it is a `Name` that can stand as a part of a path."""
    return _PLAIN.fullmatch(name) is not None and name.strip(".") != ""


@dataclass(frozen=True, slots=True)
class _Look:
    """A file as it was: time [ns], inode and size; digest of its content."""

    stat: tuple[int, int, int]
    digest: bytes


class MonitoredFiles:
    """Files and their content at the last check; a check costs one `stat` per file."""

    def __init__(self) -> None:
        self._seen: dict[Path, _Look | None] = {}

    def changed(self, paths: Iterable[Path]) -> bool:
        """Whether a file's content is new, or a file has appeared or disappeared.

        Each change is reported once. The first look at a file reports a change: whoever read it before may have read
        another content.
        """
        found = False
        for path in paths:
            before = self._seen.get(path)
            now = _look(path, before)
            known = path in self._seen
            self._seen[path] = now
            found |= not known or (now and now.digest) != (before and before.digest)
        return found


def _look(path: Path, before: _Look | None) -> _Look | None:
    try:
        status = path.stat()
        stat = (status.st_mtime_ns, status.st_ino, status.st_size)
        if before is not None and stat == before.stat:
            return before
        return _Look(stat, hashlib.sha256(path.read_bytes()).digest())
    except OSError:  # gone, or not to be read: whoever loads it reports why
        return None
