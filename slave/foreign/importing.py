"""Make a recording of foreign videos and pictures.

It makes calibration, times and rows. A video or picture gets a second name in the recording's folder (a hard link),
which takes no room; where the disks differ it is copied. It is read once, to count its frames and what is broken.
"""

import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from common.arrays import Int
from common.calibration import CameraCalibration, RigCalibration, load
from common.calibration.object_profile import ObjectProfile
from common.errors import PictureError, RecordingError
from common.messages.picture_size import size_of
from common.recording.frame_recording import MANIFEST, FrameRow, Illumination, Manifest, load_manifest
from common.recording.frame_writing import RecordingWriter, refuse_occupied
from common.recording.pictures import VideoFrames, decode, frame_name, read_picture
from slave.foreign.sources import (
    Source,
    Timed,
    by_rate,
    by_table,
    found_in,
    pictures_in,
    read_times,
    rig_for,
    sources_of,
)

NOTE = "imported from "


@dataclass(frozen=True, slots=True, eq=False)
class _Imported:
    """What one camera took: its frames, their names in the recording, their times."""

    source: Source
    files: Mapping[int, str]
    timed: Timed
    simultaneous: bool


def import_pictures(
    calibration: Path,
    out: Path,
    notify: Callable[[str], None],
    paths: Sequence[Path] = (),
    named: Mapping[str, Path] | None = None,
    rig_name: str | None = None,
    times: Path | None = None,
) -> dict[str, int]:
    """Write the recording; return camera -> number of its frames.

    A former import in the same folder is replaced, nothing else is.

    Args:
        calibration: calib_json tree.
        paths: Videos, folders of pictures, or folders of these.
        named: Camera -> its video or folder of pictures.
        rig_name: None: the rig that has these cameras.
        times: Table of the times of all cameras; None: those beside each video, or its own.

    Raises:
        PhalanxError: A file is missing or broken, of no camera or of another size than by the camera file, or has no
            frame that can be decoded; the message states what to do.
    """
    paths, named = found_in(paths), named or {}
    for path in named.values():
        if found_in([path]) != [path]:
            raise RecordingError(f"{path}: must be one video or one folder of pictures")
    rig = rig_for(calibration, rig_name, paths, named)
    if rig.kind != "markers":
        raise RecordingError(
            f"rig {rig.name!r}: the strobed frames of a wrist device come from `phalanx-slave record`"
        )
    if unknown := sorted(named.keys() - set(rig.cameras)):
        raise RecordingError(f"--camera {unknown[0]}: rig {rig.name!r} has {', '.join(rig.cameras)}")
    sources = [Source(camera, path) for camera, path in named.items()]
    if paths:
        sources += sources_of(paths, rig, notify)
    if twice := {s.camera for s in sources if [o.camera for o in sources].count(s.camera) > 1}:
        raise RecordingError(f"--camera {min(twice)}: is given twice")
    if absent := [name for name in rig.cameras if all(source.camera != name for source in sources)]:
        notify(f"rig {rig.name!r} has {', '.join(absent)}, too, of which there is nothing")
    rig = _only(rig, sources)
    files = {s.camera: calibration / "cameras" / f"{s.camera}.json" for s in sources}
    cameras = {name: load(file, CameraCalibration) for name, file in files.items()}
    imported = [_imported(s, cameras[s.camera], files[s.camera], times, notify) for s in sources]
    own = [one.source for one in imported if one.simultaneous]
    if own and len(own) < len(imported):
        raise RecordingError(
            f"{own[0].path}: no table of times, but others have one: give one for every camera"
        )
    if len(own) > 1:
        notify(
            "the first frames of all cameras are taken as simultaneous; where they are not, give their --times"
        )
    _clear(out)
    manifest = Manifest(
        version=1,
        kind="markers",
        cameras=cameras,
        rig=rig,
        note=NOTE + ", ".join(source.path.name for source in sources),
        objects={name: load(calibration / "objects" / f"{name}.json", ObjectProfile) for name in rig.objects},
    )
    _write(out, manifest, imported)
    return {one.source.camera: len(one.timed.number) for one in imported}


def _only(rig: RigCalibration, sources: Sequence[Source]) -> RigCalibration:
    names = tuple(name for name in rig.cameras if any(source.camera == name for source in sources))
    places = {name: rig.T_rig_camera[name] for name in names if name in rig.T_rig_camera}
    return msgspec.structs.replace(rig, cameras=names, T_rig_camera=places)


def _imported(
    source: Source,
    camera: CameraCalibration,
    file: Path,
    times: Path | None,
    notify: Callable[[str], None],
) -> _Imported:
    """Numbers, names and times of the frames of one camera, reported in one line."""
    size = (camera.width_px, camera.height_px)
    try:
        read = _video if source.is_video else _pictures
        number, files, own, faults = read(source, size, camera.frame_rate_hz, file)
    except OSError as error:
        raise RecordingError(f"{source.path}: cannot read: {error.strerror}") from error
    except PictureError as error:
        raise RecordingError(f"{source.path}: {error}") from error
    stem = source.path.stem if source.is_video else source.path.name
    sidecar = source.path.parent / f"{stem}.csv"
    table = times or (sidecar if sidecar.is_file() else None)
    timed = own if table is None else by_table(table, read_times(table, source.camera), number)
    if timed is None:
        raise RecordingError(
            f"{source.path}: has no times and no frame rate; give --times FILE.csv (frame,time)"
        )
    seconds = 1e-9 * float(timed.t_ns[-1] - timed.t_ns[0])
    notify(
        f"{source.camera}: {source.path}: {len(timed.number)} frames in {seconds:.2f} s ({timed.note}){faults}"
    )
    return _Imported(source, files, timed, table is None)


_Read = tuple[Int, Mapping[int, str], Timed | None, str]
"""Numbers (T,) of the frames that decode, their names in the recording, their own times, and what is broken."""


def _video(source: Source, size: tuple[int, int], _rate_hz: float, file: Path) -> _Read:
    video = VideoFrames(source.path)
    try:
        _check_size(source, video.size_px, size, file)
        times = video.times()
    finally:
        video.close()
    name = source.camera + source.path.suffix.lower()
    own: Timed | None = None
    if times.stamped:
        own = Timed(times.number, times.t_ns, "time stamps of the video")
    elif times.rate_hz > 0.0:
        own = by_rate(times.number, times.rate_hz, "as the video states")
    faults = f"; {times.broken} frames between them cannot be decoded" if times.broken else ""
    if times.missing > 0:
        stated = times.missing + int(times.number[-1]) + 1
        faults += f"; it ends {times.missing} frames before the {stated} that it states"
    return times.number, {int(n): frame_name(name, int(n)) for n in times.number}, own, faults


def _pictures(source: Source, size: tuple[int, int], rate_hz: float, file: Path) -> _Read:
    files: dict[int, str] = {}
    pictures = pictures_in(source.path)
    for number, picture in enumerate(pictures):
        data = read_picture(picture)
        try:
            found = size_of(data)
        except PictureError:
            continue
        _check_size(source, found, size, file)
        try:
            decode(data, size)
        except PictureError:
            continue
        files[number] = f"{source.camera}/{number:06d}{picture.suffix.lower()}"
    if not files:
        raise PictureError(f"not one of its {len(pictures)} pictures can be decoded")
    number = np.array(list(files), np.int64)
    broken = len(pictures) - len(files)
    faults = f"; {broken} pictures cannot be decoded" if broken else ""
    return number, files, by_rate(number, rate_hz, "as the camera file states"), faults


def _check_size(source: Source, found: tuple[int, int], size: tuple[int, int], file: Path) -> None:
    if found != size:
        raise RecordingError(
            f"{source.path}: is of {found[0]} x {found[1]} px, the calibration {file} of {size[0]} x {size[1]}: record "
            "in the size that was calibrated, or calibrate in this one (`phalanx calibrate cameras stereo`)"
        )


def _write(out: Path, manifest: Manifest, imported: Sequence[_Imported]) -> None:
    first = min(int(one.timed.t_ns[0]) for one in imported)  # tables may count from any time
    rows: list[FrameRow] = []
    for one in imported:
        shift = int(one.timed.t_ns[0]) if one.simultaneous else first  # or all begin at 0
        for number, t_ns in zip(one.timed.number.tolist(), one.timed.t_ns.tolist(), strict=True):
            file = one.files[number]
            rows.append(FrameRow(one.source.camera, number, t_ns - shift, Illumination.NONE, file))
    writer = RecordingWriter(out, manifest)
    try:
        for one in imported:
            _place(out, one)
        for row in sorted(rows, key=lambda row: (row.t_ns, row.camera)):
            writer.refer(row)
    finally:
        writer.close()


def _place(out: Path, one: _Imported) -> None:
    """Give the video or the pictures of a camera their names in the recording."""
    if one.source.is_video:
        pairs = [(one.source.path, out / (one.source.camera + one.source.path.suffix.lower()))]
    else:
        pictures = pictures_in(one.source.path)
        pairs = [(pictures[number], out / file) for number, file in one.files.items()]
    for source, name in pairs:
        try:
            name.parent.mkdir(exist_ok=True)
            try:
                os.link(source.resolve(), name)
            except OSError:  # another disk, or one without hard links
                shutil.copyfile(source, name)
        except OSError as error:
            raise RecordingError(f"{name}: cannot write: {error.strerror}") from error


def _clear(out: Path) -> None:
    """Take a former import away; refuse anything else."""
    if (out / MANIFEST).is_file() and load_manifest(out).note.startswith(NOTE):
        shutil.rmtree(out)
    refuse_occupied(out)
