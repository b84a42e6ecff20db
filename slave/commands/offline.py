"""Detect in whole recordings, and calibrate marker colours from them.

`phalanx-slave run -o` writes one file per camera with the same bytes on every run, without clock or network;
`phalanx-slave colours` writes a camera file. A recording or file that is missing, broken or cannot be written raises
`RecordingError` or `CalibrationError`.
"""

import argparse
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import cv2
import msgspec
import numpy as np

from common.arrays import Float, Int
from common.calibration import CameraCalibration, HandProfile, load, save
from common.calibration.rig import painted_alike
from common.command_line import UsageError, echo, remark
from common.errors import CalibrationError, RecordingError
from common.recording.frame_recording import MANIFEST, FrameRecording, FrameRow, load_manifest, open_recording
from common.recording.pictures import FramePictures
from common.recording.recorded_files import write_npz
from slave.cameras.replay import is_grey
from slave.markers.autocolour import by_clicks, by_hand, by_hues, calibrate_moving, checked, frames_for
from slave.markers.autocolour_things import spread
from slave.markers.colours import ColourRow, calibrate, report
from slave.markers.reloadable import detector_for
from slave.markers.white_balance import Inline
from slave.wrist.offline import RecordedWristDetections

if TYPE_CHECKING:
    from slave.tags.offline import RecordedTags, TagCollector


@dataclass(frozen=True, slots=True, eq=False)
class RecordedDetections:
    """Content of detections_<camera>.npz: T frames, M markers, NaN = not seen.

    Attributes:
        t_ns: (T,) middle of the exposure of row 0 [ns].
        seq: (T,) frame counters.
        uv: (T, M, 2) centroids [px], distorted image.
        area_px2: (T, M) visible areas [px^2].
        quality: (T, M) 0..1, the probability that it is the marker.
        sigma_px: (T, M) standard deviation of the centroids per axis [px].
        alt_uv: (T, M, 2) second places of the same colour [px]; NaN: none.
    """

    t_ns: Int
    seq: Int
    uv: Float
    area_px2: Float
    quality: Float
    sigma_px: Float
    alt_uv: Float


def camera_of(recording: FrameRecording, camera: str, calibration: Path | None) -> CameraCalibration:
    """The camera of a recording, with the colours of `calibration` if given."""
    recording.frames_of(camera)  # refuses an unknown name
    own = recording.manifest.cameras[camera]
    if calibration is None:
        if own.markers is None:
            raise CalibrationError(
                f"{recording.folder}/recording.json: cameras.{camera}.markers: missing; give --calibration DIR with "
                f"DIR/cameras/{camera}.json (make it with `phalanx-slave colours`)"
            )
        return own
    path = calibration / "cameras" / f"{camera}.json"
    markers = load(path, CameraCalibration).markers
    if markers is None:
        clicks = " ".join(f"--click {name}=U,V" for name in recording.manifest.marker_rig().markers)
        raise CalibrationError(
            f"{path}: markers: missing; make them: phalanx-slave colours {recording.folder} --camera {camera}"
            f" {clicks} -o {path}  (U,V: a pixel on each marker in the camera's first picture)"
        )
    return msgspec.structs.replace(own, markers=markers)


def _opened(folder: Path, camera: str) -> tuple[FrameRecording, tuple[FrameRow, ...]]:
    """A recording, and the frames of one camera in it."""
    recording = open_recording(folder)
    if not (rows := recording.frames_of(camera)):
        raise RecordingError(f"{folder}/frames.csv: no frame of camera {camera!r}")
    return recording, rows


def detect_recording(
    folder: Path,
    camera: str,
    calibration: Path | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
    tags: "TagCollector | None" = None,
    *,
    windows_only: bool = False,
) -> RecordedDetections:
    """Detect the markers in every frame of one camera.

    The colours, of the calib_json tree `calibration` or the recording's, follow the light where the camera has
    references. `progress` is called with frames done and in all; `tags` is given every frame, too; `windows_only` as
    `MarkerDetector`.
    """
    recording, rows = _opened(folder, camera)
    model = camera_of(recording, camera, calibration)
    rig = recording.manifest.marker_rig()
    names, clicks = rig.markers, recording.manifest.clicks.get(camera)
    detector = detector_for(model, names, Inline(), clicks, free=rig.free_markers)
    detector.plain.windows_only = windows_only
    shape = (len(rows), len(names))
    uv, alt_uv = np.full((*shape, 2), np.nan), np.full((*shape, 2), np.nan)
    area, quality, sigma_px = np.full(shape, np.nan), np.full(shape, np.nan), np.full(shape, np.nan)
    pictures = FramePictures(folder, (model.width_px, model.height_px))
    for i, row in enumerate(rows):
        if i > 0 and not recording.manifest.continuous:
            detector = detector.fresh()
        image = pictures.read(row.file)
        found = detector.push(image, row.t_ns)
        if tags is not None:
            tags.push(image, row)
        uv[i], area[i], quality[i] = found.uv, found.area, found.quality
        sigma_px[i], alt_uv[i] = found.sigma_px, found.alt_uv
        progress(i + 1, len(rows))
    t_ns = np.array([row.t_ns for row in rows], np.int64)
    seq = np.array([row.seq for row in rows], np.int64)
    return RecordedDetections(t_ns, seq, uv, area, quality, sigma_px, alt_uv)


def calibrate_colours(
    folder: Path,
    camera: str,
    output: Path,
    *,
    clicks: Mapping[str, tuple[float, float]] | None = None,
    auto: bool = False,
    like: Path | None = None,
    hand: Path | None = None,
    notify: Callable[[str], None] = lambda _text: None,
) -> list[ColourRow]:
    """Make the colour ranges of one camera from a recording; write its camera file.

    With clicks, from the clicked colours of the first frame. Without, or where `auto`, `like` or `hand` ask for it,
    from what moves with the hand in all frames. Hands of one rig are painted alike: colours of the first hand's
    markers are those of the others', too.

    Args:
        folder: Recording. Its `clicks` name one pixel per marker in the camera's first frame, or none.
        camera: Camera name.
        output: Camera file to write: the recording's, with `markers` filled.
        clicks: Marker -> (u, v) [px] in the camera's first frame, before those of the recording.
        auto: Use all frames though there are clicks; these then only name the marker colours.
        like: Camera file whose hues name the marker colours; the shape of the hand checks them where it can.
        hand: Hand profile whose shape names the marker colours, or checks their names; by default
            calib_json/hands/<hand of the rig>.json.
        notify: Receives lines of progress.

    Raises:
        RecordingError: The recording is broken, has no frame of the camera, or clicks for some markers only.
        FitError: A click is not on a marker colour, two look the same, or the frames do not determine the colours or
            their names for certain; the message states what to do.
        CalibrationError: A file cannot be read or written.
    """
    recording, rows = _opened(folder, camera)
    rig = recording.manifest.marker_rig()
    if unknown := sorted((clicks or {}).keys() - set(rig.markers)):
        raise RecordingError(
            f"--click: rig {rig.name!r} has no marker {unknown[0]!r}; it has {', '.join(rig.markers)}"
        )
    clicks = {**recording.manifest.clicks.get(camera, {}), **(clicks or {})}
    first = painted_alike(rig.markers)
    names = tuple(dict.fromkeys(first.values()))
    missing = [name for name in names if name not in clicks]
    moving = auto or like is not None or hand is not None or not clicks
    if missing and not moving:
        raise RecordingError(
            f"{folder}/recording.json: clicks.{camera}: nothing for {', '.join(missing)}; give one pixel [u, v] on "
            f"each marker in the first frame (--click NAME=U,V), or --auto"
        )
    own = recording.manifest.cameras[camera]
    pictures = FramePictures(folder, (own.width_px, own.height_px))
    if not moving:
        image = pictures.read(rows[0].file)
        table = calibrate(image, {name: clicks[name] for name in names})
    else:
        profile = Path("calib_json/hands") / f"{rig.hand}.json" if hand is None else hand
        if like is not None:
            namer = by_hues(load(like, CameraCalibration).markers, names, str(like), notify)
            if hand is not None or profile.exists():
                shape = load(profile, HandProfile)
                if hand is not None or shape.markers.keys() >= set(names):
                    namer = checked(namer, by_hand(shape, names, notify), notify)
        elif hand is None and not missing:
            namer = by_clicks(clicks, names, own.width_px)
        else:
            namer = by_hand(load(profile, HandProfile), names, notify)
        chosen = spread(len(rows), frames_for(own.width_px * own.height_px))
        notify(f"{camera}: reading {len(chosen)} of {len(rows)} frames")
        images = [pictures.read(rows[k].file) for k in chosen]
        table = calibrate_moving(images, names, namer, notify)
    make_folder(output.parent)
    made = {row.name: row.range for row in table}
    save(output, msgspec.structs.replace(own, markers={name: made[one] for name, one in first.items()}))
    return table


def make_folder(folder: Path) -> None:
    """Make the folder of a result: a new calibration tree begins with its first file."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecordingError(f"{folder}: cannot make the folder: {error.strerror}") from error


def tag_collector(folder: Path, camera: str, calibration: Path | None) -> "TagCollector | None":
    """What finds the tags of a recording's objects; None: none of them has any."""
    recording = open_recording(folder)
    manifest = recording.manifest
    recording.frames_of(camera)  # refuses an unknown name
    rig = manifest.marker_rig()
    if not rig.objects:
        return None
    from slave.tags.offline import TagCollector, tagged_objects

    objects = tagged_objects(manifest.objects, rig, calibration)
    return TagCollector(manifest.cameras[camera], objects, manifest.continuous) if objects else None


def save_detections(path: Path, found: "RecordedDetections | RecordedWristDetections | RecordedTags") -> None:
    """Write detections_<camera>.npz or tags_<camera>.npz; equal content, equal bytes."""
    make_folder(path.parent)
    try:
        write_npz(path, {name: getattr(found, name) for name in found.__slots__})
    except OSError as error:
        raise RecordingError(f"{path}: cannot write: {error.strerror}") from error


def detect(options: argparse.Namespace) -> int:
    """Run `run -o`: detect markers, or fingers before a wrist device, in every frame."""
    kind, _, folder = str(options.camera).partition(":")
    if kind != "replay" or not folder:
        raise UsageError("-o writes what is detected in a recording: --camera replay:FOLDER")
    camera, recording, calibration = str(options.name), Path(folder), options.calibration

    def progress(done: int, total: int) -> None:
        if done % 500 == 0 or done == total:
            remark(f"{camera}: {done} of {total} frames")

    if is_grey(load_manifest(recording), camera):
        if options.scan == "windows":
            raise CalibrationError(f"--scan: camera {camera!r} sees no markers")
        from slave.wrist.offline import detect_wrist_recording

        done = detect_wrist_recording(recording, camera, calibration, options.hand, progress)
        remark(f"{camera}: {done.summary()}")
        save_detections(options.output, done.detections)
        return 0
    if options.hand is not None:
        raise CalibrationError(f"--hand: camera {camera!r} sees markers; only a wrist camera knows a hand")
    tags = tag_collector(recording, camera, calibration)
    windows = options.scan == "windows"
    found = detect_recording(recording, camera, calibration, progress, tags, windows_only=windows)
    save_detections(options.output, found)
    if tags is not None:
        save_detections(options.output.parent / f"tags_{camera}.npz", tags.all())
    return 0


def run(options: argparse.Namespace) -> int:
    """Run `colours`: write the camera file and print which colours collide."""
    cv2.setNumThreads(1)
    with _recording(options) as folder:
        table = calibrate_colours(
            folder,
            options.camera,
            options.output,
            clicks=dict(options.click),
            auto=options.auto,
            like=options.like,
            hand=options.hand,
            notify=remark,
        )
    echo(report(table))
    return 0


@contextmanager
def _recording(options: argparse.Namespace) -> Generator[Path]:
    """The recording; of a video or pictures one that lasts as long as it is needed."""
    from slave.foreign.importing import import_pictures

    if (options.recording / MANIFEST).is_file():
        if options.calibration is not None or options.rig is not None:
            raise RecordingError(
                f"--calibration, --rig: {options.recording} is a recording, which has its own"
            )
        yield options.recording
        return
    if options.calibration is None:
        raise RecordingError(
            f"{options.recording}: no {MANIFEST} in it; of a video or pictures give --calibration DIR, whose"
            f" cameras/{options.camera}.json they are of"
        )
    with TemporaryDirectory() as folder:
        named = {options.camera: options.recording}
        recording = Path(folder) / "recording"
        import_pictures(options.calibration, recording, remark, named=named, rig_name=options.rig)
        yield recording
