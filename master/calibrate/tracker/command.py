"""`phalanx calibrate tracker`: registration of a tracking system to the rig.

Also of its device on an object.
"""

from argparse import Namespace
from pathlib import Path

from msgspec.structs import replace

from common.calibration import load
from common.calibration.object_profile import ObjectProfile
from common.errors import CalibrationError, FitError
from common.terminal import echo
from master.calibrate.tracker.registration import Registration, register
from master.calibrate.tracker.save import read_motion, write_motion, write_registration
from master.calibrate.tree_files import load_marker_rig
from master.commands.summary import write_summary


def tracker(options: Namespace) -> None:
    """Register a tracking system (Lighthouse) to the rig and its device to an object."""
    if options.live == (options.motion is not None):
        raise CalibrationError("give --live, or --motion FILE of a motion that was kept")
    used = load_marker_rig(options.calibration, options.rig)
    profile = profile_of(options.calibration, options.name, options.device)
    if options.motion is None:
        from master.calibrate.tracker.live import observe_live

        session = observe_live(options.bus, profile, options.seconds, echo)
        objects, tracked, source = session.objects, session.tracked, "live"
        if options.keep is not None:
            write_motion(options.keep, objects, tracked)
            echo(f"kept {options.keep}")
    else:
        objects, tracked = read_motion(options.motion, profile)
        source = options.motion.name
    try:
        found = register(objects, tracked)
    except FitError as error:
        raise FitError(f"{source}: {error}") from error
    for line in found.report:
        echo(line)
    if options.picture is not None:
        from master.calibrate.tracker.picture import draw_registration  # matplotlib takes a second to import

        draw_registration(options.picture, found)
        echo(f"drew {options.picture}")
    written: list[str] = []
    if options.out is None:
        echo("nothing written: give --out DIR")
    else:
        paths = write_registration(options.out, options.rig, used, profile, found, source)
        written = [str(path) for path in paths]
        echo(f"wrote {written[0]}: T_rig_tracking; {written[1]}: T_object_tracker, stamp_offset_us")
    if options.json_file is not None:
        write_summary(options.json_file, summary(found) | {"written": written})


def profile_of(calibration: Path, name: str, device: str | None) -> ObjectProfile:
    """The object, with the name of the device on it.

    Raises:
        CalibrationError: The file is missing or broken, no device is named, or cameras cannot see the object.
    """
    path = calibration / "objects" / f"{name}.json"
    profile = load(path, ObjectProfile)
    if device is not None:
        profile = replace(profile, tracker=device)
    if profile.tracker is None:
        raise CalibrationError(
            f"{path}: tracker: no device is named: write its name there, or give --device NAME"
        )
    if not profile.markers and profile.tags is None:
        raise CalibrationError(
            f"{path}: neither markers nor tags: cameras cannot see where the object is, and nothing else shows where "
            "the tracker sits on it"
        )
    return profile


def summary(found: Registration) -> dict[str, object]:
    """What was measured, as numbers."""
    placed = found.fit.placed
    return {
        "T_rig_tracking": placed.T_rig_tracking.tolist(),
        "T_object_tracker": placed.T_object_tracker.tolist(),
        "late_ms": 1e3 * placed.late_s,
        "instants": len(found.fit.t_s),
        "shared_s": found.coverage.shared_s,
        **found.figures,
    }
