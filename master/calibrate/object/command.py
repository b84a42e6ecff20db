"""`phalanx calibrate object`: where the beads of a new object sit.

Measured by moving it before the cameras.
"""

from argparse import Namespace
from pathlib import Path

from common.calibration import RigCalibration, load
from common.calibration.object_profile import ObjectProfile
from common.errors import CalibrationError, FitError
from common.geometry.camera_model import CameraModel
from common.recording.frame_recording import open_recording
from common.terminal import echo
from master.calibrate.object.measure import measure_object
from master.calibrate.object.save import (
    add_to_rig,
    measured_profile,
    report_json,
    report_lines,
    write_object,
)
from master.calibrate.object.seen import Seen, rows_of, seen_by
from master.calibrate.time.commands import geometry_of
from master.calibrate.tree_files import load_marker_rig
from master.commands.summary import write_summary
from master.replay.recorded import recorded_detections


def object_command(options: Namespace) -> None:
    """Measure where the beads of a rigid object sit."""
    _check_together(
        options.live, options.recording, options.detections, options.rig, options.add_to_rig, options.out
    )
    base, where = base_of(options.calibration, options.name, options.like)
    given = (
        None
        if options.markers is None
        else tuple(part.strip() for part in options.markers.split(",") if part.strip())
    )
    if options.live:
        assert options.rig is not None
        used = load_marker_rig(options.calibration, options.rig)
        names = names_of(given, base, used)
        from master.calibrate.object.live import observe_live

        seen, data = observe_live(options.bus, used, names, options.seconds, echo), "live"
    else:
        assert options.recording is not None
        assert options.detections is not None
        used, names, seen = recorded(
            options.recording, options.detections, options.rig, options.calibration, given, base
        )
        data = options.recording.resolve().name
    try:
        found = measure_object(seen)
        profile, misses = measured_profile(
            found, options.name, radii(names, options.radius_mm, base), data, base, where
        )
    except FitError as error:
        raise FitError(f"{data}: {error}") from error
    for line in report_lines(found, profile, misses):
        echo(line)
    if options.picture is not None:
        from master.calibrate.object.picture import draw_object  # matplotlib takes a second to import

        draw_object(options.picture, found, profile)
        echo(f"drew {options.picture}")
    written = _write(options.out, profile, options.rig or used.name, used, options.add_to_rig)
    if options.json_file is not None:
        write_summary(options.json_file, report_json(found, profile, misses) | {"written": written})


def base_of(calibration: Path, name: str, like: Path | None) -> tuple[ObjectProfile | None, str]:
    """Return the object file whose frame and other parts are kept, and its name.

    None: there is none.

    Raises:
        CalibrationError: It is missing or broken.
    """
    path = calibration / "objects" / f"{name}.json" if like is None else like
    if like is None and not path.exists():
        return None, ""
    return load(path, ObjectProfile), path.name


def names_of(
    given: tuple[str, ...] | None, base: ObjectProfile | None, rig: RigCalibration
) -> tuple[str, ...]:
    """Return the names of the beads.

    As given, of the file, or all that sit on no hand.

    Raises:
        CalibrationError: Fewer than three, one stands twice, or the rig does not have them.
    """
    names = given or (tuple(base.markers) if base is not None and base.markers else rig.free_markers)
    if len(names) < 3 or len(set(names)) < len(names):
        raise CalibrationError(
            "--markers: three different beads or more determine the orientation of an object, these are"
            f" {', '.join(names) or 'none'}"
        )
    rows_of(rig, names)
    return names


def radii(names: tuple[str, ...], radius_mm: float | None, base: ObjectProfile | None) -> dict[str, float]:
    """Return the radius of each bead [m].

    As given, as the file has it, or the usual.
    """
    there = {} if base is None else {name: bead.radius_m for name, bead in base.markers.items()}
    return {
        name: there.get(name, 0.008) if radius_mm is None else round(1e-3 * radius_mm, 7) for name in names
    }


def recorded(
    recording: Path,
    detections: Path,
    rig: str | None,
    calibration: Path,
    given: tuple[str, ...] | None,
    base: ObjectProfile | None,
) -> tuple[RigCalibration, tuple[str, ...], Seen]:
    """Rig, beads, and what was seen of them in a recording.

    Raises:
        RecordingError: A file of it is missing or broken.
        CalibrationError: Its frames are unrelated, the rig does not fit it, or has not these beads.
    """
    opened = open_recording(recording)
    used, cameras = geometry_of(opened, rig, calibration)
    if not opened.manifest.continuous:
        raise CalibrationError(
            f"{recording}: its frames are unrelated poses (continuous is false): an object that moves is needed"
        )
    if len(used.cameras) < 2:
        raise CalibrationError(f"rig {used.name!r}: cameras: two or more are needed")
    names = names_of(given, base, used)
    models = {camera: CameraModel.of(cameras[camera], used.camera_pose(camera)) for camera in used.cameras}
    messages = [
        message
        for camera in used.cameras
        for message in recorded_detections(detections, camera, len(used.markers))
    ]
    messages.sort(key=lambda message: message.t_ns)
    rates = {camera: cameras[camera].frame_rate_hz for camera in used.cameras}
    return used, names, seen_by(used, models, rates, messages, names)


def _check_together(
    live: bool,
    recording: Path | None,
    detections: Path | None,
    rig: str | None,
    adds: bool,
    out: Path | None,
) -> None:
    if live == (recording is not None) or live == (detections is not None):
        raise CalibrationError("give --live, or --recording FOLDER and --detections DIR of the motion")
    if live and rig is None:
        raise CalibrationError("--live needs --rig: that of the running master")
    if adds and out is None:
        raise CalibrationError("--add-to-rig writes into the tree --out: give --out DIR")


def _write(
    out: Path | None, profile: ObjectProfile, rig_name: str, rig: RigCalibration, adds: bool
) -> list[str]:
    if out is None:
        echo("nothing written: give --out DIR")
        return []
    written = [str(write_object(out, profile))]
    echo(f"wrote {written[0]}: markers")
    if adds:
        written.append(str(add_to_rig(out, rig_name, rig, profile.name)))
        echo(f"wrote {written[1]}: objects")
    elif profile.name not in rig.objects:
        echo(
            f'to track it: "objects": ["{profile.name}"] in rigs/{rig_name}.json (or again with --add-to-rig)'
        )
    return written
