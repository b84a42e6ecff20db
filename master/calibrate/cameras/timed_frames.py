"""Frames with times: a video or a folder of pictures per camera, and a table.

Frame k of a camera is its k-th row in the table; where the table has another number of rows than the camera has
frames, its column of frame numbers says which they are. Videos without a table are taken by their frame rate, all
begun at once.
"""

import csv
import io
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from common.arrays import Float
from common.errors import PictureError, RecordingError
from common.recording.frame_recording import MANIFEST
from common.recording.pictures import ENDINGS as VIDEOS
from common.recording.pictures import VideoFrames
from common.recording.recorded_files import read_table
from master.calibrate.cameras.tracks import Stream
from master.calibrate.cameras.views import ENDINGS, load_image, natural

_CAMERA = ("cam_id", "camera", "port")
_TIME = {"frame_time": 1.0, "t_s": 1.0, "time": 1.0, "t_ns": 1e-9}  # column -> its unit [s]
_FRAME = ("frame_index", "frame")
COLUMNS = "cam_id or camera; frame_time or t_s (seconds), or t_ns; and, if you like, frame_index or frame"


def streams_of(
    folder: Path, cameras: Sequence[str], notify: Callable[[str], None]
) -> dict[str, Stream] | None:
    """Videos of a folder, or its folders of pictures with a table of times; None: it has neither.

    Args:
        cameras: Those wanted; none: all.

    Raises:
        RecordingError: A video cannot be opened, the table does not fit, or a wanted camera is not there.
    """
    if not folder.is_dir() or (folder / MANIFEST).is_file():
        return None
    table, videos = _table_in(folder), _videos_in(folder)
    pictures = {sub.name: _files(sub, ENDINGS) for sub in sorted(folder.iterdir()) if sub.is_dir()}
    pictures = {
        name: sorted(own, key=lambda file: natural(file.stem)) for name, own in pictures.items() if own
    }
    found = videos or (pictures if table is not None else {})
    if not found:
        return None
    if missing := [camera for camera in cameras if camera not in found]:
        raise RecordingError(f"{folder}: nothing of camera {missing[0]!r}; there are {', '.join(found)}")
    wanted = cameras or tuple(found)
    if videos:
        return _of_videos({name: videos[name] for name in wanted}, table, notify)
    times = times_of(table, {name: len(pictures[name]) for name in wanted}) if table else {}
    return {
        name: Stream(*times[name], lambda k, own=pictures[name]: load_image(own[k]), str(folder / name))
        for name in wanted
    }


def _videos_in(folder: Path) -> dict[str, Path]:
    """Camera -> its video: in the folder, by name, or one alone in a folder that is named as the camera."""
    found = {file.stem: file for file in _files(folder, VIDEOS)}
    for sub in sorted(folder.iterdir()) if not found else ():
        own = _files(sub, VIDEOS) if sub.is_dir() else []
        if len(own) > 1:
            found |= {file.stem: file for file in own}
        elif own:
            found[sub.name] = own[0]
    return found


def _of_videos(
    videos: Mapping[str, Path], table: Path | None, notify: Callable[[str], None]
) -> dict[str, Stream]:
    """The frames of videos, by a table of times, or by their rates."""
    opened: dict[str, VideoFrames] = {}
    for name, path in videos.items():
        try:
            opened[name] = VideoFrames(path)
        except OSError as error:
            raise RecordingError(f"{path}: cannot read: {error.strerror}") from error
        except PictureError as error:
            raise RecordingError(f"{path}: {error}") from error
    if table is not None:
        counts = {name: video.count for name, video in opened.items()}
        times = times_of(table, counts)
    else:
        times = {}
        for name, video in opened.items():
            if video.rate_hz <= 0.0 or video.count < 2:
                raise RecordingError(
                    f"{videos[name]}: states no frame rate or number of frames: give a table {TABLES[0]} beside it"
                    f" with the columns {COLUMNS}"
                )
            times[name] = tuple(range(video.count)), np.arange(video.count) / video.rate_hz
        if len(videos) > 1:
            notify(f"no table of times ({', '.join(TABLES)}): frames of one number are taken as simultaneous")
    return {name: Stream(*times[name], opened[name].image, str(path)) for name, path in videos.items()}


TABLES = ("timestamps.csv", "frame_times.csv", "times.csv")


def _table_in(folder: Path) -> Path | None:
    """The table of times of a folder; None: there is none."""
    return next((folder / name for name in TABLES if (folder / name).is_file()), None)


def times_of(path: Path, counts: Mapping[str, int]) -> dict[str, tuple[tuple[int, ...], Float]]:
    """Camera -> numbers and times (T,) [s] of its frames, by a table.

    `counts` are the frames that each camera has; 0: not known.

    Raises:
        RecordingError: Columns are missing, a camera is, times go back or are of another unit, or the rows fit no
            frames; the message states which.
    """
    reader = csv.DictReader(io.StringIO(read_table(path.parent, path.name), newline=""))
    columns = reader.fieldnames or ()
    camera, time, frame = (
        next((c for c in known if c in columns), None) for known in (_CAMERA, _TIME, _FRAME)
    )
    if camera is None or time is None:
        raise RecordingError(f"{path}: needs the columns {COLUMNS}; it has {', '.join(columns) or 'nothing'}")
    rows: dict[str, list[tuple[int, float]]] = {}
    for row in reader:
        try:
            t_s = float(row[time]) * _TIME[time]
            rows.setdefault(row[camera].strip(), []).append((int(row[frame]) if frame else 0, t_s))
            if not np.isfinite(t_s):
                raise ValueError
        except (TypeError, ValueError, AttributeError):
            raise RecordingError(
                f"{path}: line {reader.line_num}: {time} or {frame or camera} is no number"
            ) from None
    found: dict[str, tuple[tuple[int, ...], Float]] = {}
    for name, count in counts.items():
        key = next((key for key in rows if key == name or _number(key) == _number(name) is not None), None)
        if key is None:
            raise RecordingError(
                f"{path}: has no row of camera {name!r}; it has {', '.join(rows) or 'no row'}"
            )
        numbers, t_s = tuple(number for number, _ in rows[key]), np.array([t for _, t in rows[key]])
        if frame is None or len(numbers) == count:
            if count and len(numbers) != count:
                raise RecordingError(
                    f"{path}: {len(numbers)} rows of camera {name!r}, which has {count} frames: one row a frame, or a"
                    " column frame_index that says of which frames the times are"
                )
            numbers = tuple(range(len(numbers)))
        elif count and not 0 <= min(numbers) <= max(numbers) < count:
            raise RecordingError(
                f"{path}: {frame} of camera {name!r} is {min(numbers)} to {max(numbers)}, but it has {count} frames"
            )
        found[name] = numbers, t_s
        steps = np.diff(t_s)
        if len(steps) < 1 or (back := np.flatnonzero(steps <= 0)).size:
            where = (
                f"row {back[0] + 2} of camera {name!r} is not later than the one before"
                if len(steps)
                else "one row"
            )
            raise RecordingError(f"{path}: {where}: times of a camera must rise")
        if not 1e-4 < (usual := float(np.median(steps))) < 100.0:
            raise RecordingError(
                f"{path}: frames of camera {name!r} are {usual:g} s apart: {time} is in another unit; seconds are"
                " called frame_time or t_s, nanoseconds t_ns"
            )
    spans = {name: (float(t[0]), float(t[-1])) for name, (_, t) in found.items()}
    if max(first for first, _ in spans.values()) >= min(last for _, last in spans.values()):
        raise RecordingError(f"{path}: the cameras' times do not overlap: {spans}; they must be of one clock")
    return found


def _number(name: str) -> int | None:
    digits = re.search(r"(\d+)$", name)
    return None if digits is None else int(digits[1])


def _files(folder: Path, endings: Sequence[str]) -> list[Path]:
    return sorted(
        file
        for file in folder.iterdir()
        if file.suffix.lower() in endings and file.is_file() and not file.name.startswith(".")
    )
