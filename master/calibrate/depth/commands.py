"""`phalanx-master calibrate depth`: the published session, from known distances to the two laws of raw disparity."""

import os
from pathlib import Path
from typing import Annotated, Literal

import typer

from common.arrays import Float
from common.calibration import RigCalibration
from common.errors import CalibrationError
from common.frame_recording import FrameRecording
from common.keys import link_key
from master.calibrate.depth.fit import ideal_of
from master.calibrate.depth.live import sweep_live
from master.calibrate.depth.report import fit_depth, report_json, report_lines
from master.calibrate.depth.save import conclusion, rig_to_write, write_laws
from master.calibrate.depth.source import (
    Measured,
    Pair,
    from_recording,
    from_table,
    load_pair,
    pair_of,
    parse_target,
)
from master.calibrate.depth.sweep import checked
from master.calibrate.depth.verify import laws_of
from master.fabrik.depth import DepthLaw
from master.options import (
    CALIB_JSON,
    HERE_BEACON,
    HERE_BIND,
    Beacon,
    Bind,
    JsonFile,
    KeyFile,
    RecordingRig,
    ResultTree,
    address,
)
from master.summary import write_summary

Source = Annotated[
    Path | None,
    typer.Argument(help="Folder of a recording, or a .csv; none with --live.", show_default=False),
]
Detections = Annotated[
    Path | None, typer.Option(help="Folder with detections_<camera>.npz of the recording.")
]
Marker = Annotated[
    str | None, typer.Option(help="Marker whose paint the target has; default: the only one seen.")
]
Distances = Annotated[
    str | None, typer.Option(help="FIRST:LAST:STEP in metres, a list, or a .csv; default: truth.npz.")
]
Calibration = Annotated[Path, typer.Option(help="Folder with rigs/ and cameras/.")]
Target = Annotated[str, typer.Option(help="Its shape, WIDTHxHEIGHT or round: the lens shifts its centroid.")]
Picture = Annotated[Path | None, typer.Option(help="Write a picture of the errors to this .png.")]
FovDeg = Annotated[
    float | None, typer.Option(help="Nominal horizontal field of view, for cameras without intrinsics.")
]
Use = Annotated[
    Literal["power_law", "affine_disparity", "stereo"] | None,
    typer.Option(help="Also make this the rig's depth_model."),
]
Live = Annotated[bool, typer.Option("--live", help="Measure now, with the running slaves.")]
SaveTable = Annotated[
    Path | None, typer.Option("--save", help="With --live: keep the readings in this .csv.")
]
Frames = Annotated[int, typer.Option(min=8, help="With --live: frames to average, at least.")]
Seconds = Annotated[float, typer.Option(min=1.0, max=60.0, help="With --live: time to average.")]

_SWEEP = "1.00:0.20:-0.05"  # the published one


def depth(
    source: Source = None,
    detections: Detections = None,
    marker: Marker = None,
    distances: Distances = None,
    rig: RecordingRig = None,
    calibration: Calibration = CALIB_JSON,
    target: Target = "75x50",
    fov_deg: FovDeg = None,
    out: ResultTree = None,
    use: Use = None,
    json_file: JsonFile = None,
    picture: Picture = None,
    live: Live = False,
    save_table: SaveTable = None,
    frames: Frames = 30,
    seconds: Seconds = 1.0,
    beacon: Beacon = HERE_BEACON,
    bind: Bind = HERE_BIND,
    key_file: KeyFile = None,
) -> None:
    """Fit depth to disparity from a target at known distances: the power law D = k x^z, and x = a/D + x0.

    Examples:

      phalanx-master calibrate depth RECORDING --detections DIR --distances 1.00:0.20:-0.05 --out calib_json

      phalanx-master calibrate depth sweep.csv                       columns distance_m,disparity_px

      phalanx-master calibrate depth --live --rig desk --marker index --out calib_json
    """
    outline = parse_target(target)
    _refuse_idle("--live", source=live and source, detections=live and detections)
    _refuse_idle("a measurement without --live", save=not live and save_table)
    if live:
        link = (address(beacon, "--beacon"), address(bind, "--bind"), link_key(os.environ, key_file))
        pair = load_pair(calibration, rig or "desk", fov_deg)
        measured = sweep_live(pair, marker, distances or _SWEEP, frames, seconds, link, save_table, outline)
    else:
        measured = measured_from(source, detections, marker, distances, rig, calibration, fov_deg, outline)
    pair = measured.pair
    base = rig_to_write(pair, out)
    with measured.named():
        sweep = checked(measured.sweep, pair.cameras, pair.size_px)
        report = fit_depth(sweep, laws_before(pair, base))
    typer.echo(measured.about)
    for line in report_lines(report):
        typer.echo(line)
    written = None if out is None else write_laws(out, base, report, measured, use)
    typer.echo(conclusion(report, base, use, written))
    if json_file is not None:
        write_summary(json_file, report_json(report) | {"written": None if written is None else str(written)})
    if picture is not None:
        from master.calibrate.depth.picture import draw_errors

        draw_errors(picture, measured.about, sweep.distance_m, report.errors, used=report.used)


def measured_from(
    source: Path | None,
    detections: Path | None,
    marker: str | None,
    distances: str | None,
    rig: str | None,
    calibration: Path,
    fov_deg: float | None,
    outline: Float,
) -> Measured:
    """The sweep of a recording or a table.

    Raises:
        PhalanxError: What the user gave does not make one; the text says what is missing.
    """
    if source is None:
        raise CalibrationError("what to read is missing: give the folder of a recording, a .csv, or --live")
    if source.is_dir():

        def pair_for(recording: FrameRecording) -> Pair:
            manifest = recording.manifest
            return (
                pair_of(manifest.marker_rig(), manifest.cameras)
                if rig is None
                else load_pair(calibration, rig, fov_deg, manifest.cameras)
            )

        return from_recording(source, detections, marker, distances, pair_for, outline)
    if source.suffix.lower() != ".csv":
        raise CalibrationError(
            f"{source}: {'neither' if source.exists() else 'does not exist; give'} the folder of a recording"
            f" {'nor' if source.exists() else 'or'} a .csv"
        )
    _refuse_idle(f"{source}, a table", detections=detections, marker=marker, distances=distances)
    return from_table(source, Pair() if rig is None else load_pair(calibration, rig, fov_deg), outline)


def laws_before(pair: Pair, rig: RigCalibration | None) -> dict[str, DepthLaw]:
    """The laws without this fit: that of ideal cameras, and what the rig file holds."""
    laws: dict[str, DepthLaw] = {}
    if pair.models is not None:
        laws["ideal"] = ideal_of(*pair.models)
    previous = {} if rig is None else laws_of(rig)
    return laws | {f"previous {name.partition('_')[0]}": law for name, law in previous.items()}


def _refuse_idle(where: str, **options: object) -> None:
    """Refuse options that `where` does not use, rather than to leave them out silently."""
    for name, value in options.items():
        if value:
            option = "a recording or a table" if name == "source" else f"--{name}"
            raise CalibrationError(f"{option} has no meaning with {where}: leave it out")
