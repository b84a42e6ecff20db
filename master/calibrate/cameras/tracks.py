"""Corners of a moving board are carried to instants common to all cameras.

A view is an instant at which the slowest camera took a frame. The corners of the others are interpolated between
their own frames, by the parabola through three where there are three. What remains unknown is by how much a
camera's times lag its exposures (buffers of a driver hold a frame or more): that is an unknown of the bundle, which
the corners' speeds determine (`bundle.Bundle.delay_s`).

Frames come from a video or a folder of pictures per camera. Frame k of a camera is its k-th row in the table of
times; where the table has another number of rows than the camera has frames, its column of frame numbers says which
they are. Videos without a table are taken by their frame rate, all begun at once.
"""

import csv
import io
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from common.arrays import Float, Image, Int
from common.errors import FitError, PictureError, RecordingError
from common.recording.frame_recording import MANIFEST, FrameRow, Illumination, open_recording
from common.recording.pictures import ENDINGS as VIDEOS
from common.recording.pictures import FramePictures, VideoFrames
from common.recording.recorded_files import read_table
from master.calibrate.cameras.boards import Board, ImageObservation
from master.calibrate.cameras.views import (
    ENDINGS,
    MOST_VIEWS,
    BoardViews,
    Finder,
    View,
    check_alike,
    files_by_folder,
    files_in,
    is_new,
    load_image,
    natural,
)


@dataclass(frozen=True, slots=True, eq=False)
class Stream:
    """The frames of one camera, read one after the other."""

    numbers: tuple[int, ...]  # how they are called in reports
    t_s: Float  # (T,) rising
    read: Callable[[int], Image]  # number -> frame; PictureError: it cannot be decoded
    source: str  # file or folder, for messages


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """The board in frames of one camera."""

    numbers: tuple[int, ...]
    t_s: Float  # (T,) rising
    found: tuple[ImageObservation | None, ...]

    def at(self, t_s: float) -> ImageObservation | None:
        """The board at an instant by this camera's clock; None: not seen about then."""
        k = int(np.abs(self.t_s - t_s).argmin())
        here, away_s = self.found[k], t_s - float(self.t_s[k])
        slopes: list[tuple[float, Float]] = []
        for j in (k - 1, k + 1):
            beside = self.found[j] if 0 <= j < len(self.found) else None
            gap_s = float(self.t_s[j] - self.t_s[k]) if beside is not None else np.inf
            if here is not None and beside is not None and abs(gap_s) < _LONGEST_GAP_S:
                slopes.append((gap_s, (beside.corners_px - here.corners_px) / gap_s))
        if here is None:
            return None
        if not slopes:  # its own instant, or pictures that are taken seldom, of a board at rest
            gap_s = min(
                (abs(float(t) - float(self.t_s[k])) for t in self.t_s if t != self.t_s[k]), default=np.inf
            )
            return here if abs(away_s) <= (0.5 * gap_s if gap_s >= _LONGEST_GAP_S else 0.0) else None
        if not any(abs(away_s) <= 0.51 * abs(gap) and away_s * gap >= 0.0 for gap, _ in slopes):
            return None
        uv, (gap_s, speed) = here.corners_px, slopes[-1]
        bend: Float = np.zeros_like(uv)  # half the acceleration
        if len(slopes) == 2:
            bend = (speed - slopes[0][1]) / (gap_s - slopes[0][0])
            speed = speed - bend * gap_s
            one = np.isnan(speed)  # corners seen in one of the neighbours alone
            bend = np.where(one, 0.0, bend)
            speed = np.where(one, np.where(np.isnan(slopes[0][1]), slopes[1][1], slopes[0][1]), speed)
        carried = uv + (speed + bend * away_s) * away_s
        if np.isfinite(carried[:, 0]).sum() < 8:
            return None
        return ImageObservation(carried, here.blur_px, speed + 2.0 * bend * away_s)


_LONGEST_GAP_S = 0.35  # between frames: a hand moves a board to and fro in a second or two


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """What all cameras saw of one board, each at its own times."""

    board: Board
    sizes_px: Mapping[str, tuple[int, int]]
    tracks: Mapping[str, Track]

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras."""
        return tuple(self.sizes_px)

    def views(self, delay_s: Mapping[str, float]) -> BoardViews:
        """Views of instants in all places of the board, the stillest of each.

        `delay_s`: by how much each camera's times lag its exposures.
        """
        slowest = max(self.tracks, key=lambda name: _step_s(self.tracks[name].t_s))
        reference = self.tracks[slowest]
        views: list[tuple[float, View]] = []
        for number, t_s in zip(reference.numbers, reference.t_s - delay_s[slowest], strict=True):
            seen = {name: track.at(float(t_s) + delay_s[name]) for name, track in self.tracks.items()}
            observations = {name: found for name, found in seen.items() if found is not None}
            if observations:
                speeds = [s.speed_px_s for s in observations.values() if s.speed_px_s is not None]
                fastest = max(
                    (float(np.nanmedian(np.linalg.norm(s, axis=1))) for s in speeds), default=np.inf
                )
                views.append((fastest, View(str(number), observations)))
        chosen: list[View] = []
        for _, view in sorted(views, key=lambda pair: pair[0]):
            if len(chosen) < MOST_VIEWS and is_new(view.observations, chosen, self.sizes_px, _NEW):
                chosen.append(view)
        return BoardViews(self.board, self.sizes_px, tuple(sorted(chosen, key=lambda v: int(v.name))))


_NEW = 0.01  # of the image's width: how far corners must be from where another view has them


def track(board: Board, streams: Mapping[str, Stream], progress: Callable[[str], None]) -> Tracks:
    """Find the board in frames of all cameras, of long streams in bursts.

    Raises:
        FitError: The board is in none of the frames, or no frame of a camera can be decoded.
    """
    finder, tracks, sizes = Finder(board), dict[str, Track](), dict[str, tuple[int, int]]()
    every = _wanted({name: stream.t_s for name, stream in streams.items()})
    for name, stream in streams.items():
        wanted: list[int] = every[name].tolist()
        found, broken = list[ImageObservation | None](), ""
        for done, i in enumerate(wanted, 1):
            try:
                image = stream.read(stream.numbers[i])
                check_alike(sizes, name, str(stream.numbers[i]), image)
                found.append(finder.find(image))
            except PictureError as error:
                found.append(None)
                broken = str(error)
            if done % 50 == 0 or done == len(wanted):
                seen = sum(one is not None for one in found)
                progress(f"{name}: {done} of {len(wanted)} frames, the board in {seen}")
        if name not in sizes:
            raise FitError(f"{stream.source}: {broken}")
        tracks[name] = Track(tuple(stream.numbers[i] for i in wanted), stream.t_s[wanted], tuple(found))
    if not any(one for own in tracks.values() for one in own.found):
        raise FitError(
            f"no {board} in any of {sum(len(t.found) for t in tracks.values())} frames: {finder.advice()}"
        )
    return Tracks(finder.board, sizes, tracks)


def _step_s(t_s: Float) -> float:
    """Usual time between frames [s]."""
    return float(np.median(np.diff(t_s))) if len(t_s) > 1 else np.inf


def _wanted(t_s: Mapping[str, Float]) -> dict[str, Int]:
    """Indices of the frames to look at: about 15 a second of each camera.

    Of more than 600 frames they are in 40 bursts of a second, at the same times for all cameras.
    """
    usual_hz, most = 15.0, 600
    thinned = {
        name: np.arange(0, len(t), max(round(1.0 / (usual_hz * max(_step_s(t), 1e-6))), 1), dtype=np.int64)
        for name, t in t_s.items()
    }
    if max(map(len, thinned.values())) <= most:
        return thinned
    first, last = max(float(t[0]) for t in t_s.values()), min(float(t[-1]) for t in t_s.values())
    begins = np.linspace(first, max(last - 1.0, first), round(most / usual_hz))
    found: dict[str, Int] = {}
    for name, frames in thinned.items():
        since = np.searchsorted(begins, t_s[name][frames], side="right") - 1
        found[name] = frames[(since >= 0) & (t_s[name][frames] < begins[since] + 1.0)]
    return found


_CAMERA = ("cam_id", "camera", "port")
_TIME = {"frame_time": 1.0, "t_s": 1.0, "time": 1.0, "t_ns": 1e-9}  # column -> its unit [s]
_FRAME = ("frame_index", "frame")
COLUMNS = "cam_id or camera; frame_time or t_s (seconds), or t_ns; and, if you like, frame_index or frame"


def streams_of(
    folder: Path, cameras: Sequence[str], notify: Callable[[str], None]
) -> dict[str, Stream] | None:
    """Frames of a recording, videos, or pictures with times; None: it has none.

    Args:
        cameras: Those wanted; none: all.

    Raises:
        RecordingError: A video cannot be opened, the table does not fit, or a wanted camera is not there.
    """
    if (folder / MANIFEST).is_file():
        return _of_recording(folder, cameras)
    if not folder.is_dir():
        return None
    table, videos = _table_in(folder), _videos_in(folder)
    if not videos and table is None:
        return None
    pictures = {} if videos else files_by_folder(folder, ENDINGS)
    found = videos or pictures
    if not found:
        return None
    if missing := [camera for camera in cameras if camera not in found]:
        raise RecordingError(f"{folder}: nothing of camera {missing[0]!r}; there are {', '.join(found)}")
    wanted = cameras or tuple(found)
    if table is None or videos:
        return _of_videos({name: videos[name] for name in wanted}, table, notify)
    times = times_of(table, {name: len(pictures[name]) for name in wanted})
    ordered = {name: sorted(pictures[name], key=lambda file: natural(file.stem)) for name in wanted}
    return {
        name: Stream(*times[name], lambda k, own=own: load_image(own[k]), str(folder / name))
        for name, own in ordered.items()
    }


def _of_recording(folder: Path, cameras: Sequence[str]) -> dict[str, Stream]:
    """The frames of a recording that show a board, by their time stamps."""
    recording = open_recording(folder)
    streams: dict[str, Stream] = {}
    for name in cameras or tuple(recording.manifest.cameras):
        rows = {row.seq: row for row in _showing(recording.frames_of(name))}
        if not rows:
            raise RecordingError(f"{folder}: camera {name!r} has no frame")
        camera = recording.manifest.cameras[name]
        pictures = FramePictures(folder, (camera.width_px, camera.height_px))
        t_s = 1e-9 * np.array([row.t_ns for row in rows.values()], np.float64)
        streams[name] = Stream(
            tuple(rows), t_s, lambda k, rows=rows, read=pictures.read: read(rows[k].file), str(folder)
        )
    return streams


def _showing(rows: Sequence[FrameRow]) -> list[FrameRow]:
    """The frames that show a board.

    Of strobed ones those with the LEDs on, which are there in the dark too, and no second frame of the same
    moment; never those with a laser's line across the corners.
    """
    lit = {row.illumination for row in rows}
    for best in (Illumination.LED, Illumination.AMBIENT):
        if best in lit:
            return [row for row in rows if row.illumination is best]
    return [row for row in rows if row.illumination is Illumination.NONE]


def _videos_in(folder: Path) -> dict[str, Path]:
    """Camera -> its video: named as the camera, or alone in a folder that is."""
    if found := {file.stem: file for file in files_in(folder, VIDEOS)}:
        return found
    for name, own in files_by_folder(folder, VIDEOS).items():
        found |= {name: own[0]} if len(own) == 1 else {file.stem: file for file in own}
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
        back = np.flatnonzero(steps <= 0)
        if len(steps) < 1 or back.size:
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
