"""Measure an object: guide its user, fit and save.

The object is moved before the cameras, live on a running master or in a recording; every second the guide
reports what is seen and what is still missing. Bead positions go into the object's file, the rest of an old
file is kept.
"""

from argparse import Namespace
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from msgspec.structs import replace

from common.arrays import Float
from common.calibration import RigCalibration, load
from common.calibration.object_profile import Bead, ObjectProfile, check_object
from common.clock import Clock, SystemClock
from common.command_line import echo
from common.errors import CalibrationError, FitError
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import transform
from common.messages import HandPose
from common.recording.frame_recording import open_recording
from master.calibrate.object.bundle import Seen, first_body, rows_of, seen_by, seen_in, usable
from master.calibrate.object.measure import (
    ENOUGH,
    ENOUGH_LOOKS,
    MOTION,
    OWN,
    Measurement,
    frame_of,
    looks_of,
    measure_object,
)
from master.calibrate.time_offsets import detections_of, geometry_of
from master.calibrate.tree_files import (
    load_marker_rig,
    print_lines,
    provenance,
    refusals_named,
    rig_in_tree,
    vector_of,
    write_object,
    write_rig,
)
from master.commands.summary import write_summary
from master.run.process import join_bus

Receive = Callable[[float], HandPose | None]


def guide(
    receive: Receive,
    rig: RigCalibration,
    names: Sequence[str],
    clock: Clock,
    notify: Callable[[str], None],
    longest_s: float,
) -> Seen:
    """Lead a person through the motion until it is enough, or the time is over.

    `receive` gives the next pose of the running master, waiting at most so long [s]; `notify` is called with
    one line at a time.

    Raises:
        CalibrationError: As `seen_in`.
        FitError: No pose came.
    """
    poses = list[HandPose]()
    notify(MOTION)
    begin_ns = printed_ns = clock.now_ns()
    while clock.now_ns() - begin_ns < longest_s * 1e9:
        pose = receive(0.05)
        if pose is not None:
            poses.append(pose)
        now_ns = clock.now_ns()
        if now_ns - printed_ns < 1_000_000_000:
            continue
        printed_ns = now_ns
        if not poses:
            notify("no pose comes: is `phalanx run` running, on this --bus?")
            continue
        line, enough = progress(seen_in(poses, rig, names))
        notify(line)
        if enough:
            break
    if not poses:
        raise FitError("no pose came: is `phalanx run` running, on this --bus?")
    return seen_in(poses, rig, names)


def progress(seen: Seen) -> tuple[str, bool]:
    """Progress and what is still missing, for a person; and whether it is enough."""
    rows = np.flatnonzero(usable(seen))
    whole = int(seen.known.all(axis=1).sum())
    looks = 0
    if len(rows):
        shown = 200  # epochs from which ways of turning are counted while it goes on
        rows = rows[np.unique(np.linspace(0, len(rows) - 1, shown).astype(np.int64))]
        try:
            some = Seen(seen.names, seen.t_s[rows], seen.points_m[rows], seen.cov_m2[rows])
            looks = looks_of(first_body(some)[1])
        except FitError:
            looks = 0
    share = min(whole / ENOUGH, looks / ENOUGH_LOOKS, 1.0)
    recent = seen.known[-30:].mean(axis=0)
    poor = [name for name, part in zip(seen.names, recent, strict=True) if part < 0.5]
    if poor:
        hint = f"not seen by two cameras: {', '.join(poor)}"
    elif share >= 1.0:
        hint = "done"
    elif looks / ENOUGH_LOOKS < whole / ENOUGH:
        hint = "turn it about another axis, and carry it elsewhere"
    else:
        hint = "go on like this"
    return f"{100 * share:3.0f} %  {whole} epochs, {looks} ways of turning and places. {hint}", share >= 1.0


def observe_live(
    bus: str, rig: RigCalibration, names: Sequence[str], longest_s: float, notify: Callable[[str], None]
) -> Seen:
    """Lead the user through the motion, on the bus of a running master.

    Raises:
        BusError: Nobody listens there.
        CalibrationError: The master runs another rig.
        FitError: No pose came.
    """
    link = join_bus(bus)
    try:
        poses = link.subscribe("hand", depth=512)  # poses that may wait while a line is printed

        def receive(timeout_s: float) -> HandPose | None:
            message = poses.get(timeout_s)
            # A wrist device alone reports hands without markers.
            return message if isinstance(message, HandPose) and len(message.markers_raw_m) else None

        return guide(receive, rig, names, SystemClock(), notify, longest_s)
    finally:
        link.close()


TOOL = "calibrate object"


def measured_profile(
    found: Measurement,
    name: str,
    radius_m: Mapping[str, float],
    data: str,
    like: ObjectProfile | None,
    like_where: str,
) -> tuple[ObjectProfile, dict[str, float]]:
    """The object, and the displacement of each bead from an old file [m].

    `data` names what it was measured from. Frame and other parts are those of `like`, which file `like_where`
    holds; None: a frame of its own, and nothing else.

    Raises:
        FitError: The frame of `like` cannot be kept.
        CalibrationError: The object is none that can be tracked.
    """
    if like is None:
        T, misses, frame = found.T_own_body, dict[str, float](), OWN
    else:
        T, misses = frame_of(found.bundle.beads_m, found.names, like, like_where)
        frame = f"frame of {like_where}"
    places = transform(T, found.bundle.beads_m)
    beads = {
        bead: Bead(position_m=vector_of(place), radius_m=radius_m[bead])
        for bead, place in zip(found.names, places, strict=True)
    }
    residual = {f"{bead}_rms_mm": _mm(rms) for bead, rms in zip(found.names, found.rms_m, strict=True)}
    residual |= {f"{bead}_sigma_mm": _mm(by) for bead, by in zip(found.names, found.sigma_m, strict=True)}
    how = provenance(TOOL, (data,), residual | {"looks": float(found.looks)}, frame)
    base = ObjectProfile(version=1, name=name) if like is None else replace(like, name=name)
    profile = replace(base, markers=beads, provenance=base.provenance | {"markers": how})
    check_object(profile, name)
    return profile, misses


def add_to_rig(out: Path, rig_name: str, rig: RigCalibration, name: str) -> Path:
    """Name the object in rigs/<rig_name>.json of the tree `out`; return its path.

    Raises:
        CalibrationError: The file there is broken, of other cameras, or cannot be written.
    """
    there = rig_in_tree(out, rig_name, rig)
    if name not in there.objects:
        there = replace(there, objects=(*there.objects, name))
    return write_rig(out, rig_name, there)


def report_lines(found: Measurement, profile: ObjectProfile, misses: Mapping[str, float]) -> list[str]:
    """The table for a person."""
    bundle = found.bundle
    whole = int(bundle.seen.known.all(axis=1).sum())
    lines = [
        f"{len(bundle.T)} epochs, {whole} with all beads; turned and carried to {found.looks} ways",
        f"{'bead':12} {'x':>8} {'y':>8} {'z':>8} {'+-':>6} {'left':>6} {'outlier_share':>7}   [mm]",
    ]
    for row, name in enumerate(found.names):
        x, y, z = (1e3 * value for value in profile.markers[name].position_m)
        lines.append(
            f"{name:12} {x:8.2f} {y:8.2f} {z:8.2f} {1e3 * found.sigma_m[row]:6.2f} {1e3 * found.rms_m[row]:6.2f}"
            f" {100 * found.outlier_share[row]:5.1f} %"
            + (f"   {1e3 * misses[name]:.2f} from where the file had it" if name in misses else "")
        )
    lines.append(f"what is left is {bundle.spread:.2f} times what the covariances expect")
    if found.looks < ENOUGH_LOOKS:
        lines.append("better: turn it further about all its axes, and carry it to more places")
    return lines


def report_json(found: Measurement, profile: ObjectProfile, misses: Mapping[str, float]) -> dict[str, object]:
    """The same for programs [mm]."""
    return {
        "object": profile.name,
        "instants": len(found.bundle.T),
        "looks": found.looks,
        "spread": round(found.bundle.spread, 3),
        "beads": {
            name: {
                "position_mm": [_mm(value) for value in profile.markers[name].position_m],
                "sigma_mm": _mm(found.sigma_m[row]),
                "rms_mm": _mm(found.rms_m[row]),
                "outlier_share": round(float(found.outlier_share[row]), 4),
                "moved_mm": _mm(misses[name]) if name in misses else None,
            }
            for row, name in enumerate(found.names)
        },
    }


def _mm(value: float | Float) -> float:
    return round(1e3 * float(value), 3)


def object_command(options: Namespace) -> None:
    """Measure where the beads of a rigid object sit."""
    _check_together(options)
    base, where = base_of(options.calibration, options.name, options.like)
    given = None
    if options.markers is not None:
        given = tuple(part.strip() for part in options.markers.split(",") if part.strip())
    if options.live:
        assert options.rig is not None
        used = load_marker_rig(options.calibration, options.rig)
        names = names_of(given, base, used)
        seen, data = observe_live(options.bus, used, names, options.seconds, echo), "live"
    else:
        assert options.recording is not None
        assert options.detections is not None
        used, names, seen = recorded(
            options.recording, options.detections, options.rig, options.calibration, given, base
        )
        data = options.recording.resolve().name
    with refusals_named(data):
        found = measure_object(seen)
        radius_m = radii(names, options.radius_mm, base)
        profile, misses = measured_profile(found, options.name, radius_m, data, base, where)
    print_lines(report_lines(found, profile, misses))
    if options.picture is not None:
        from master.calibrate.picture import draw_object

        draw_object(options.picture, found, profile)
        echo(f"drew {options.picture}")
    written = _write(options.out, profile, options.rig or used.name, used, options.add_to_rig)
    if options.json_file is not None:
        write_summary(options.json_file, report_json(found, profile, misses) | {"written": written})


def base_of(calibration: Path, name: str, like: Path | None) -> tuple[ObjectProfile | None, str]:
    """The object file whose frame and other parts are kept, and its name; or None.

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
    """Names of the beads: as given, of the file, or all that sit on no hand.

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
    """Radius of each bead [m]: as given, as the file has it, or the usual."""
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
    rates = {camera: cameras[camera].frame_rate_hz for camera in used.cameras}
    return used, names, seen_by(used, models, rates, detections_of(used, detections), names)


def _check_together(options: Namespace) -> None:
    live: bool = options.live
    if live == (options.recording is not None) or live == (options.detections is not None):
        raise CalibrationError("give --live, or --recording FOLDER and --detections DIR of the motion")
    if live and options.rig is None:
        raise CalibrationError("--live needs --rig: that of the running master")
    if options.add_to_rig and options.out is None:
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
