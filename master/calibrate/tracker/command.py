"""`phalanx-master calibrate tracker`: where a tracking system lies in the rig, and its device on an object."""

from pathlib import Path
from typing import Annotated

import typer
from msgspec.structs import replace

from common.calibration import load
from common.errors import CalibrationError, FitError
from common.object_profile import ObjectProfile
from master.calibrate.tracker.registration import Registration, register
from master.calibrate.tracker.save import read_motion, write_motion, write_registration
from master.calibrate.tree_files import load_marker_rig
from master.options import CALIB_JSON, HERE_BUS, BusEnd, Calibration, JsonFile, ResultTree
from master.summary import write_summary

Name = Annotated[str, typer.Argument(help="The object: a file of CALIBRATION/objects.", show_default=False)]
Motion = Annotated[
    Path | None,
    typer.Option("--motion", help="An .npz of object and tracker poses, as --keep writes (docs/tracker.md)."),
]
Live = Annotated[bool, typer.Option("--live", help="Do the motion now, before the running master.")]
Rig = Annotated[str, typer.Option("--rig", help="Rig whose cameras see the object.")]
Tracker = Annotated[
    str | None, typer.Option(help="Name of the device on it; default: `tracker` of the object's file.")
]
Seconds = Annotated[float, typer.Option(min=10.0, help="How many seconds a live motion may take at most.")]
Keep = Annotated[Path | None, typer.Option(help="Keep the live motion in this .npz.")]
Picture = Annotated[Path | None, typer.Option(help="Write a picture of what was seen and left to this .png.")]


def tracker(
    name: Name,
    motion: Motion = None,
    live: Live = False,
    rig: Rig = "desk-cube",
    calibration: Calibration = CALIB_JSON,
    device: Tracker = None,
    seconds: Seconds = 90.0,
    keep: Keep = None,
    out: ResultTree = None,
    json_file: JsonFile = None,
    picture: Picture = None,
    bus: BusEnd = HERE_BUS,
) -> None:
    """Find where a tracking system (Lighthouse) lies in the rig, and where its device sits on an object.

    The device is fixed to an object that the cameras see by markers or tags. Turn it about all its axes, a quarter turn
    and back, and carry it to all sides for twenty seconds. Which way the system's own axes point does not matter. The
    lag between the clocks is found as well. Nothing is written without --out.

    Examples:

      phalanx-master calibrate tracker cube --live --rig desk-cube --keep motion.npz --out calib_json

      phalanx-master calibrate tracker cube --motion motion.npz --rig desk-cube --picture tracker.png
    """
    if live == (motion is not None):
        raise CalibrationError("give --live, or --motion FILE of a motion that was kept")
    used = load_marker_rig(calibration, rig)
    profile = profile_of(calibration, name, device)
    if motion is None:
        from master.calibrate.tracker.live import observe_live

        session = observe_live(bus, profile, seconds, typer.echo)
        objects, tracked, source = session.objects, session.tracked, "live"
        if keep is not None:
            write_motion(keep, objects, tracked)
            typer.echo(f"kept {keep}")
    else:
        objects, tracked = read_motion(motion, profile)
        source = motion.name
    try:
        found = register(objects, tracked)
    except FitError as error:
        raise FitError(f"{source}: {error}") from error
    for line in found.report:
        typer.echo(line)
    if picture is not None:
        from master.calibrate.tracker.picture import draw_registration  # matplotlib takes a second to import

        draw_registration(picture, found)
        typer.echo(f"drew {picture}")
    written: list[str] = []
    if out is None:
        typer.echo("nothing written: give --out DIR")
    else:
        paths = write_registration(out, rig, used, profile, found, source)
        written = [str(path) for path in paths]
        typer.echo(f"wrote {written[0]}: T_rig_tracking; {written[1]}: T_object_tracker, stamp_offset_us")
    if json_file is not None:
        write_summary(json_file, summary(found) | {"written": written})


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
            f"{path}: neither markers nor tags: cameras cannot see where the object is, and nothing else tells where "
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
