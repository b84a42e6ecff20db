"""Find which camera a foreign file is of, and when its frames were taken.

Times come from a table, the video's own stamps, or a constant rate. What is none, or could be meant in several ways,
raises `RecordingError`, which names file and line.
"""

import csv
import io
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from common.arrays import Float, Int
from common.calibration import RigCalibration, load
from common.errors import RecordingError
from common.messages.parts import MAX_TIME_NS
from common.recording.pictures import ENDINGS as VIDEOS
from common.recording.recorded_files import read_table

PICTURES = (".png", ".jpg", ".jpeg")


@dataclass(frozen=True, slots=True)
class Source:
    """A video, or a folder of pictures, that one camera of the rig took."""

    camera: str
    path: Path

    @property
    def is_video(self) -> bool:
        """Whether it is a video."""
        return self.path.is_file()


def natural(path: Path) -> tuple[tuple[int, str], ...]:
    """Order in which 2 comes before 10."""
    parts = re.split(r"(\d+)", path.name)
    return tuple((int(part), "") if part.isdigit() else (-1, part) for part in parts if part)


def pictures_in(folder: Path) -> list[Path]:
    """The pictures of a folder, in the order of their numbers."""
    return sorted(_with(folder, PICTURES), key=natural)


def found_in(paths: Sequence[Path]) -> list[Path]:
    """Videos and folders of pictures that are named, or in a folder that is named."""
    found: list[Path] = []
    for path in paths:
        if path.is_file():
            if path.suffix.lower() not in VIDEOS:
                raise RecordingError(f"{path}: is no video ({', '.join(VIDEOS)}), nor a folder of pictures")
            found.append(path)
            continue
        if not path.is_dir():
            raise RecordingError(f"{path}: no such file or folder")
        videos, own = _with(path, VIDEOS), pictures_in(path)
        folders = [sub for sub in path.iterdir() if sub.is_dir() and pictures_in(sub)]
        kinds = [kind for kind in (videos, [path] if own else [], folders) if kind]
        if len(kinds) != 1:
            what = (
                "videos and pictures side by side" if kinds else "no recording.json, no video and no picture"
            )
            raise RecordingError(
                f"{path}: {what}; give a recording, a video or a folder of pictures for each camera, or a folder with"
                " one of these for each"
            )
        found += sorted(kinds[0], key=natural)
    return found


def sources_of(paths: Sequence[Path], rig: RigCalibration, notify: Callable[[str], None]) -> list[Source]:
    """Assign a camera to each path: by its name, or, if none has one, by order."""
    known = [path for path in paths if path.stem in rig.cameras]
    fix = "say whose they are: --camera NAME=PATH for each"
    if len(known) == len(paths):
        named = [Source(path.stem, path) for path in paths]
        if len({one.camera for one in named}) < len(named):
            raise RecordingError(f"{', '.join(map(str, paths))}: two are of one camera; {fix}")
        return named
    cameras = ", ".join(rig.cameras)
    if known:
        strange = next(path for path in paths if path not in known)
        raise RecordingError(
            f"{strange}: rig {rig.name!r} has no camera {strange.stem!r}, but {cameras}; {fix}"
        )
    if len(paths) != len(rig.cameras):
        raise RecordingError(
            f"{len(paths)} videos or folders, none named as a camera, for the {len(rig.cameras)} cameras of rig"
            f" {rig.name!r} ({cameras}); {fix}"
        )
    found = [Source(camera, path) for camera, path in zip(rig.cameras, paths, strict=True)]
    notify(
        "no name is that of a camera; in the order of the rig: "
        + ", ".join(f"{s.camera} = {s.path}" for s in found)
    )
    return found


def rig_for(
    calibration: Path, name: str | None, paths: Sequence[Path], named: Mapping[str, Path]
) -> RigCalibration:
    """The rig `name`; None: the one marker rig that has these cameras, and no other."""
    folder = calibration / "rigs"
    if name is not None:
        return load(folder / f"{name}.json", RigCalibration)
    rigs = [load(path, RigCalibration) for path in sorted(folder.glob("*.json"))]
    rigs = [rig for rig in rigs if rig.kind == "markers"]
    if not rigs:
        raise RecordingError(
            f"{folder}: no rig of marker cameras; `phalanx calibrate cameras stereo` makes one"
        )
    wanted = {*named, *(path.stem for path in paths)}
    for fits in (
        [rig for rig in rigs if wanted == set(rig.cameras)],
        [rig for rig in rigs if wanted < set(rig.cameras)],
        rigs,
    ):
        if len(fits) == 1:
            return fits[0]
        if fits:
            raise RecordingError(f"{folder}: which rig? --rig {' or '.join(rig.name for rig in fits)}")
    raise AssertionError("there are rigs")


def _with(folder: Path, endings: Sequence[str]) -> list[Path]:
    return [
        file
        for file in folder.iterdir()
        if file.suffix.lower() in endings and file.is_file() and not file.name.startswith(".")
    ]


Times = Mapping[int, int]
"""Number of a frame, from 0 -> when it was taken [ns]."""


@dataclass(frozen=True, slots=True, eq=False)
class Timed:
    """The frames that have a time."""

    number: Int  # (T,) their numbers
    t_ns: Int  # (T,) [ns], rising
    note: str  # where the times are from, for people


def read_times(path: Path, camera: str) -> Times:
    """The times of one camera in a table with a header.

    The columns are `frame`, `time` in seconds or `t_ns`, and `camera` where it is of several; others do not matter.
    """
    try:
        reader = csv.DictReader(io.StringIO(read_table(path.parent, path.name), newline=""))
        columns = reader.fieldnames or ()
        unit = next((name for name in ("t_ns", "time") if name in columns), None)
        if unit is None or "frame" not in columns:
            raise RecordingError(
                f"{path}: the header must have frame and time (seconds) or t_ns, and camera where it is of several"
                f" cameras; it has {', '.join(columns) or 'nothing'}"
            )
        scale = 1 if unit == "t_ns" else 1_000_000_000
        times: dict[int, int] = {}
        for row in reader:
            if row.get("camera", camera) == camera:
                frame = _integer(path, reader.line_num, "frame", row["frame"], 1)
                if frame in times:
                    raise RecordingError(
                        f"{path}: line {reader.line_num}: frame {frame} of {camera!r} is there twice"
                    )
                times[frame] = _integer(path, reader.line_num, unit, row[unit], scale)
    except FileNotFoundError as error:
        raise RecordingError(f"{path}: cannot read: {error.strerror}") from error
    except csv.Error as error:
        raise RecordingError(f"{path}: not a table of text: {error}") from error
    if not times:
        raise RecordingError(f"{path}: no time of camera {camera!r}")
    return times


def by_table(path: Path, times: Times, number: Int) -> Timed:
    """The frames (T,) that a table has a time of."""
    if 0 not in times and len(number) and max(times) == number[-1] + 1:
        raise RecordingError(
            f"{path}: frames are counted from 0; this one begins at {min(times)} and ends one late"
        )
    kept = np.array([n for n in number if int(n) in times], np.int64)
    if not len(kept):
        raise RecordingError(f"{path}: no time of any of the {len(number)} frames 0 to {number[-1]}")
    t_ns = np.array([times[int(n)] for n in kept], np.int64)
    if (late := np.flatnonzero(np.diff(t_ns) <= 0)).size:
        raise RecordingError(
            f"{path}: frame {kept[late[0] + 1]}: its time is not after that of the frame before"
        )
    without, absent = len(number) - len(kept), len(times) - len(kept)
    note = f"times of {path.name}"
    note += f", {without} frames without one left out" if without else ""
    note += f", {absent} times of frames that are not there" if absent else ""
    return Timed(kept, t_ns, note)


def by_rate(number: Int, rate_hz: float, whose: str) -> Timed:
    """Frames at a constant rate, the first of them at 0."""
    since: Float = (number - number[0]) * (1e9 / rate_hz)
    t_ns = np.round(since).astype(np.int64)
    return Timed(number, t_ns, f"{rate_hz:g} frames per second, {whose}")


def _integer(path: Path, line: int, column: str, text: str | None, scale: int) -> int:
    """A number times `scale`, rounded; exactly, as seconds since 1970 need."""
    try:
        value = Decimal((text or "").strip()) * scale
        if (
            value.is_finite()
            and abs(value) <= MAX_TIME_NS
            and (column != "frame" or value == int(value) >= 0)
        ):
            return round(value)
    except InvalidOperation:
        pass
    raise RecordingError(
        f"{path}: line {line}: {column}: {text!r} is no {'number from 0' if column == 'frame' else 'time'}"
    )
