"""Make one recording of several, or of foreign videos: `--join`, `--from`.

Every camera, and the IMU, is recorded by a process of its own, into a folder of its own. Cameras of one rig become a
recording of that rig; those of several rigs, such as marker cameras and the wrist device of one hand, one of all
rigs. Times can be compared as they are when they are on one clock: one start of one machine. Between machines only
the wall clocks relate the clocks to each other, as well as NTP or PTP keeps those together; so that is done only on
request. What is broken or does not belong together raises `RecordingError`, which names file and key.
"""

import argparse
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec

from common.calibration import RigCalibration
from common.command_line import echo, remark
from common.errors import PictureError, RecordingError
from common.imu.csv_table import IMU, read_imu, write_imu
from common.messages import ImuSample
from common.recording.frame_recording import (
    MAX_TIME_NS,
    FrameRecording,
    FrameRow,
    Manifest,
    open_recording,
)
from common.recording.frame_writing import RecordingWriter, refuse_occupied
from common.recording.pictures import read_picture
from slave.recorder import megabytes

TRUTH = "truth.npz"


def join_recordings(
    folders: Sequence[Path],
    output: Path,
    by_wall_clock: bool = False,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, int]:
    """Write one recording of all `folders`; return camera -> number of frames.

    Times are on the clock of the first; the file of a camera is that of the recording which has its frames.
    `by_wall_clock` trusts the wall clocks where the clocks differ; `progress` is called with frames done and in all.
    """
    refuse_occupied(output)
    parts = [open_recording(folder) for folder in folders]
    first = parts[0]
    for k, part in enumerate(parts):
        for before in parts[: k or 1]:
            _check_alike(before, part)
    shifts_ns = [_shift_ns(first, part, by_wall_clock) for part in parts]
    _check_overlap(parts, shifts_ns)
    samples = _imu(parts, shifts_ns)
    manifest, owners = _manifest(parts)
    frames: list[tuple[int, FrameRow, Path]] = []
    for part, shift_ns in zip(parts, shifts_ns, strict=True):
        frames += [(row.t_ns + shift_ns, row, part.folder / row.file) for row in part.rows]
        if any(abs(t_ns) > MAX_TIME_NS for t_ns, _, _ in frames):
            raise RecordingError(
                f"{part.folder}: its times on the clock of {first.folder} are beyond any clock"
            )
    frames.sort(key=lambda frame: (frame[0], frame[1].camera))
    _check_space(output, [path for _, _, path in frames])
    _write(RecordingWriter(output, manifest), frames, progress)
    if samples:
        write_imu(output, samples)
    return {name: len(part.frames_of(name)) for name, part in owners.items()}


def _manifest(parts: Sequence[FrameRecording]) -> tuple[Manifest, dict[str, FrameRecording]]:
    """Manifest of the joined recording, and the part that has each camera's frames."""
    owners = _owners(parts)
    cameras = {name: file for part in reversed(parts) for name, file in part.manifest.cameras.items()}
    names = dict.fromkeys(name for part in parts for name in part.manifest.cameras)
    rigs = {name: rig for part in parts for name, rig in _rigs(part).items()}
    rig, *more = sorted(rigs.values(), key=lambda rig: rig.kind != "markers") or [None]
    kinds = {part.manifest.kind for part in parts}
    manifest = msgspec.structs.replace(
        parts[0].manifest,
        kind=kinds.pop() if len(kinds) == 1 else "both",
        cameras={n: owners[n].manifest.cameras[n] if n in owners else cameras[n] for n in names},
        rig=rig,
        rigs=tuple(more),
        clicks={
            name: part.manifest.clicks[name] for name, part in owners.items() if name in part.manifest.clicks
        },
        objects={name: file for part in reversed(parts) for name, file in part.manifest.objects.items()},
        note="; ".join(dict.fromkeys(part.manifest.note for part in parts if part.manifest.note)),
    )
    return manifest, {name: owners[name] for name in names if name in owners}


def _rigs(part: FrameRecording) -> dict[str, RigCalibration]:
    """Its rigs by name, the main one first."""
    return {rig.name: rig for rig in (part.manifest.rig, *part.manifest.rigs) if rig is not None}


def _imu(parts: Sequence[FrameRecording], shifts_ns: Sequence[int]) -> tuple[ImuSample, ...]:
    """Samples of the one part that has an IMU, if any, on the clock of the first."""
    both = zip(parts, shifts_ns, strict=True)
    having = [(part.folder, shift_ns) for part, shift_ns in both if (part.folder / IMU).exists()]
    if len(having) > 1:
        raise RecordingError(
            f"{having[1][0] / IMU}: {having[0][0]} has an IMU as well; move one of the files away"
        )
    return tuple(
        msgspec.structs.replace(sample, t_ns=sample.t_ns + shift_ns)
        for folder, shift_ns in having
        for sample in read_imu(folder, "imu")
    )


def _write(
    writer: RecordingWriter,
    frames: Sequence[tuple[int, FrameRow, Path]],
    progress: Callable[[int, int], None],
) -> None:
    try:
        for done, (t_ns, row, path) in enumerate(frames, start=1):
            try:
                png = read_picture(path)
            except OSError as error:
                raise RecordingError(f"{path}: cannot read: {error.strerror}") from error
            except PictureError as error:
                raise RecordingError(f"{path}: {error}") from error
            writer.add(row.camera, row.seq, t_ns, row.illumination, png)
            progress(done, len(frames))
    finally:
        writer.close()


def _check_alike(first: FrameRecording, other: FrameRecording) -> None:
    if (other.folder / TRUTH).exists():
        raise RecordingError(f"{other.folder / TRUTH}: a truth cannot be joined; move this file away")
    if not other.rows:
        raise RecordingError(f"{other.folder}/frames.csv: no frame in it")
    if first.manifest.continuous != other.manifest.continuous:
        raise _differ(first, other, "continuous")
    ours, theirs = _rigs(first), _rigs(other)
    common = ours.keys() & theirs.keys()
    for name in sorted(common):
        one, two = (msgspec.to_builtins(rigs[name]) for rigs in (ours, theirs))
        if one != two:
            raise _differ(first, other, "rig." + next(key for key in one if one[key] != two.get(key)))
    if ours.keys() == theirs.keys():
        if first.manifest.kind != other.manifest.kind:
            raise _differ(first, other, "kind")
        if strange := other.manifest.cameras.keys() ^ first.manifest.cameras.keys():
            raise RecordingError(
                f"{other.folder}/recording.json: cameras: {min(strange)!r} is in only one of it and {first.folder}"
            )
        return
    shared = {camera for name in common for camera in ours[name].cameras}
    if twice := (first.manifest.cameras.keys() & other.manifest.cameras.keys()) - shared:
        raise RecordingError(
            f"{other.folder}/recording.json: cameras: {min(twice)!r} is that of another rig in {first.folder}"
        )


def _differ(first: FrameRecording, other: FrameRecording, key: str) -> RecordingError:
    return RecordingError(
        f"{other.folder}/recording.json: {key} differs from that of {first.folder}: "
        f"cameras of one recording must be recorded with one calibration"
    )


def _owners(parts: Sequence[FrameRecording]) -> dict[str, FrameRecording]:
    owners: dict[str, FrameRecording] = {}
    for part in parts:
        for camera in sorted({row.camera for row in part.rows}):
            if camera in owners:
                raise RecordingError(
                    f"{part.folder}: frames of camera {camera!r} are in {owners[camera].folder} as well"
                )
            owners[camera] = part
    return owners


def _shift_ns(first: FrameRecording, part: FrameRecording, by_wall_clock: bool) -> int:
    """What to add to the times of `part` to have them on the clock of `first` [ns]."""
    ours, theirs = first.manifest.clock, part.manifest.clock
    if ours is None or theirs is None:
        raise RecordingError(
            f"{(first if ours is None else part).folder}/recording.json: clock: missing; the clock of its times is "
            "unknown"
        )
    if ours.id == theirs.id:
        return 0
    if not by_wall_clock:
        raise RecordingError(
            f"{part.folder}: its clock is not that of {first.folder}: another machine, or a restart between them. "
            f"With --by-wall-clock the wall clocks of the machines are trusted: 1 ms between them is 1 mm at 1 m/s"
        )
    return theirs.wall_ahead_ns - ours.wall_ahead_ns


def _check_overlap(parts: Sequence[FrameRecording], shifts_ns: Sequence[int]) -> None:
    both = list(zip(parts, shifts_ns, strict=True))
    begin_ns, late = max((min(r.t_ns for r in part.rows) + shift, part.folder) for part, shift in both)
    end_ns, early = min((max(r.t_ns for r in part.rows) + shift, part.folder) for part, shift in both)
    if begin_ns > end_ns:
        raise RecordingError(
            f"{late} begins {(begin_ns - end_ns) * 1e-9:.3f} s after the end of {early}: no moment is seen by all"
        )


def _check_space(output: Path, files: Sequence[Path]) -> None:
    needed = 0
    for path in files:
        try:
            needed += path.stat().st_size
        except OSError as error:
            raise RecordingError(f"{path}: cannot read: {error.strerror}") from error
    there = next(folder for folder in (output.absolute(), *output.absolute().parents) if folder.is_dir())
    free = shutil.disk_usage(there).free
    if needed > free:
        raise RecordingError(
            f"{output}: {megabytes(needed)} are needed, {megabytes(free)} are free on the disk"
        )


def join(options: argparse.Namespace) -> int:
    """Run `record --join`."""

    def progress(done: int, total: int) -> None:
        if done % 500 == 0:
            remark(f"{done} of {total} frames")

    counts = join_recordings(options.join, options.output, options.by_wall_clock, progress)
    echo(f"{options.output}: " + ", ".join(f"{name} {count} frames" for name, count in counts.items()))
    return 0


def import_foreign(options: argparse.Namespace) -> int:
    """Run `record --from`."""
    from slave.foreign.importing import import_pictures

    paths: list[Path] = []
    named: dict[str, Path] = {}
    for text in options.foreign:
        name, path = camera_path(text)
        if name is None:
            paths.append(path)
        elif name in named:
            raise RecordingError(f"--from {name}=: is given twice")
        else:
            named[name] = path
    calibration = options.calibration or Path("calib_json")
    import_pictures(calibration, options.output, echo, paths, named, options.rig, options.times)
    echo(f"recording in {options.output}")
    return 0


def camera_path(text: str) -> tuple[str | None, Path]:
    """Split [NAME=]PATH; a path with `=` in it counts as a path if it exists."""
    name, equals, path = text.partition("=")
    if Path(text).exists() or not (name and equals and path):
        return None, Path(text)
    return name, Path(path)
