"""Recording of raw frames.

A folder with recording.json (the manifest), frames.csv and pictures or videos. The manifest comes first, and a frame's
row after its file: so whatever ended the recording, only the last row can be cut. A cut last row is dropped with a
warning; every other broken row is an error.
"""

import csv
import io
import logging
import re
from collections import Counter
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Literal

from msgspec import Struct

from common.calibration import CameraCalibration, RigCalibration, check, load
from common.calibration.camera import Pixel
from common.calibration.files import PLAIN, is_plain
from common.calibration.object_profile import ObjectProfile
from common.errors import CalibrationError, RecordingError
from common.messages import TimeNs
from common.messages.parts import MAX_TIME_NS
from common.recording.recorded_files import read_table, refuse_links

MANIFEST = "recording.json"
FRAMES = "frames.csv"
COLUMNS = ("camera", "seq", "t_ns", "illumination", "file")
_INTEGER = re.compile(r"-?[0-9]{1,19}")
_LOG = logging.getLogger(__name__)


class Illumination(StrEnum):
    """What lit a frame."""

    NONE = "none"
    AMBIENT = "ambient"
    LASER = "laser"
    LED = "led"


class RecordedClock(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The clock of `t_ns`.

    Attributes:
        id: One monotonic clock: one start of one machine. Times of equal ids can be compared as they are.
        wall_ahead_ns: The machine's wall clock minus this clock when the recording began [ns].
    """

    id: str
    wall_ahead_ns: TimeNs


class Manifest(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """recording.json: the calibration a recording was made with, and how to read it.

    Attributes:
        cameras: Camera name -> the camera file's content.
        rig: The rig file's content; `rigs` where there are several.
        clicks: Camera -> marker -> (u, v) [px] of a pixel on that marker in the first frame.
        continuous: False: frames are unrelated poses, each solved anew by reinitialising.
        clock: The clock of all `t_ns`; None: not known.
        objects: Object name -> the object file's content, of the objects that the rigs name.
    """

    version: Literal[1]
    kind: Literal["markers", "wrist", "both"]
    cameras: dict[str, CameraCalibration]
    rig: RigCalibration | None = None
    rigs: tuple[RigCalibration, ...] = ()
    clicks: dict[str, dict[str, tuple[Pixel, Pixel]]] = {}
    continuous: bool = True
    note: str = ""
    clock: RecordedClock | None = None
    objects: dict[str, ObjectProfile] = {}

    @property
    def all_rigs(self) -> tuple[RigCalibration, ...]:
        """Every rig, those of markers first."""
        rigs = [rig for rig in (self.rig, *self.rigs) if rig is not None]
        return tuple(sorted(rigs, key=lambda rig: rig.kind != "markers"))

    def rig_named(self, name: str | None) -> RigCalibration:
        """Return the rig `name`; None: the marker rig, or else the wrist rig.

        Raises:
            RecordingError: There is no such rig.
        """
        for rig in self.all_rigs:
            if name in (None, rig.name):
                return rig
        known = ", ".join(rig.name for rig in self.all_rigs) or "none"
        raise RecordingError(f"{MANIFEST}: no rig {name or ''!r}; it has {known}")

    def marker_rig(self) -> RigCalibration:
        """The marker rig, or RecordingError."""
        return self._rig_of("markers")

    def wrist_rig(self) -> RigCalibration:
        """The wrist rig, or RecordingError."""
        return self._rig_of("wrist")

    def _rig_of(self, kind: str) -> RigCalibration:
        for rig in self.all_rigs:
            if rig.kind == kind:
                return rig
        raise RecordingError(f"{MANIFEST}: no rig of kind {kind!r}")


@dataclass(frozen=True, slots=True)
class FrameRow:
    """One line of frames.csv.

    Attributes:
        seq: Frame counter of the camera.
        t_ns: Middle of the exposure of row 0 [ns].
        file: A picture, FOLDER/NAME, or a frame of a video, VIDEO/NUMBER (`common.recording.pictures`).
    """

    camera: str
    seq: int
    t_ns: int
    illumination: Illumination
    file: str


@dataclass(frozen=True, slots=True)
class FrameRecording:
    """Opened recording: folder, manifest, frame table in the order of the file."""

    folder: Path
    manifest: Manifest
    rows: tuple[FrameRow, ...]

    def frames_of(self, camera: str) -> tuple[FrameRow, ...]:
        """Rows of one camera, by `t_ns`; RecordingError if there is no such camera."""
        if camera not in self.manifest.cameras:
            known = ", ".join(sorted(self.manifest.cameras))
            raise RecordingError(f"{self.folder}: no camera {camera!r}; it has {known}")
        return tuple(sorted((row for row in self.rows if row.camera == camera), key=lambda row: row.t_ns))


def load_manifest(folder: Path) -> Manifest:
    """Read the manifest alone.

    Raises:
        RecordingError: It is missing or broken, or leads out of the folder; the text names file and key.
    """
    refuse_links(folder, [MANIFEST])
    try:
        manifest = load(folder / MANIFEST, Manifest)
        check_manifest(manifest, str(folder / MANIFEST))
    except CalibrationError as error:
        raise RecordingError(str(error)) from error
    return manifest


def open_recording(folder: Path) -> FrameRecording:
    """Read manifest and frame table; the images stay on disk.

    Raises:
        RecordingError: A file is missing or broken, or leads out of the folder; the text names file, line and column.
    """
    manifest = load_manifest(folder)
    path = folder / FRAMES
    try:
        rows = _rows(path, read_table(folder, FRAMES))
    except FileNotFoundError as error:
        raise RecordingError(f"{path}: cannot read: {error.strerror}") from error
    except csv.Error as error:
        raise RecordingError(f"{path}: not a table of text: {error}") from error
    unknown = {row.camera for row in rows} - manifest.cameras.keys()
    if unknown:
        raise RecordingError(f"{path}: camera {min(unknown)!r} is not in {MANIFEST}")
    refuse_links(folder, (row.file for row in rows))
    repeated = Counter(row.camera for row in rows)
    repeated -= Counter(camera for camera, _ in {(row.camera, row.t_ns) for row in rows})
    for camera, count in repeated.items():
        _LOG.warning(
            "%s: camera %s: frames with the time of another one: %d; of one time only one gives a pose",
            path,
            camera,
            count,
        )
    return FrameRecording(folder, manifest, rows)


def check_manifest(manifest: Manifest, where: str) -> None:
    """Check the files inside the manifest: CalibrationError with `where` and the key."""
    for key, names in (("cameras", manifest.cameras), ("objects", manifest.objects)):
        for name in names:
            if not is_plain(name):
                raise CalibrationError(f"{where}: {key}: {name[:80]!r}: must be {PLAIN}")
    for name, camera in manifest.cameras.items():
        check(camera, f"{where}: cameras.{name}")
    for name, profile in manifest.objects.items():
        check(profile, f"{where}: objects.{name}")
    for rig in (manifest.rig, *manifest.rigs):
        if rig is None:
            continue
        check(rig, f"{where}: rig {rig.name!r}")
        if missing := set(rig.cameras) - manifest.cameras.keys():
            raise CalibrationError(f"{where}: cameras: {min(missing)!r} of rig {rig.name!r} is missing")


def _rows(path: Path, text: str) -> tuple[FrameRow, ...]:
    """All rows of frames.csv; a cut last one is rejected with a warning."""
    reader = csv.reader(io.StringIO(text, newline=""))
    if tuple(next(reader, ())) != COLUMNS:
        raise RecordingError(f"{path}: header must be {','.join(COLUMNS)}")
    lines = [(reader.line_num, line) for line in reader if line]
    if not lines or text.endswith("\n"):
        return tuple(_row(path, number, line) for number, line in lines)
    rows = [_row(path, number, line) for number, line in lines[:-1]]
    number, line = lines[-1]
    try:
        last = _row(path, number, line)
    except RecordingError:
        last = None
    # Five columns may still be a name cut short; a table written by hand may just lack its last line feed.
    if last is not None and (path.parent / last.file).is_file():
        rows.append(last)
    else:
        _LOG.warning("%s: line %d is cut, left out: the recording was not ended, but broke off", path, number)
    return tuple(rows)


def _row(path: Path, number: int, line: list[str]) -> FrameRow:
    where = f"{path}: line {number}"
    if len(line) != len(COLUMNS) or not all(line):
        raise RecordingError(f"{where}: expected the {len(COLUMNS)} columns {','.join(COLUMNS)}, got {line}")
    camera, seq, t_ns, illumination, file = line
    for column, text in (("seq", seq), ("t_ns", t_ns)):
        if not _INTEGER.fullmatch(text) or abs(int(text)) > MAX_TIME_NS:
            raise RecordingError(f"{where}: {column}: {text!r} is not an integer of at most {MAX_TIME_NS}")
    if illumination not in set(Illumination):
        raise RecordingError(f"{where}: illumination: {illumination!r} is none of {', '.join(Illumination)}")
    if not all(map(is_plain, file.split("/"))):
        raise RecordingError(
            f"{where}: file: {file[:80]!r} is outside the recording's folder, or not FOLDER/NAME: each must be {PLAIN}"
        )
    return FrameRow(camera, int(seq), int(t_ns), Illumination(illumination), file)
